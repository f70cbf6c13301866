"""The figure in README.md: some of the report's own figures, rendered by a headless browser.

After `liex demo`, `photograph("mouse_walk.liex", "dashboards/assets/demo.png")` renders it
again, and `python docs/render_images.py` renders every image of README.md.
"""

from __future__ import annotations

import re
import subprocess
import tempfile
from pathlib import Path

from liex_lab.dashboards.figures.sets import for_the_page
from liex_lab.dashboards.report.contact_sheet import thumbnails
from liex_lab.dashboards.report.report import TEMPLATES

from liex_lab.sessions import Session

WIDTH = 860
HEIGHT = 1064
_SHOWN = 4  # of the contact sheet
_STYLE = f"""
:root {{ color-scheme: light; }}
main {{ width: {WIDTH}px; padding: 18px 22px; }}
.strip {{ grid-template-columns: repeat(2, 1fr); gap: 4px 12px; }}
.pair {{ display: grid; grid-template-columns: 1fr 420px; gap: 22px; margin-bottom: 6px; }}
svg image {{ image-rendering: pixelated; }}
"""


def page(session: Session) -> str:
    """HTML page of four fitted frames, the path over the floor, and actions and curves over time.

    Args:
        session: the opened session.
    """
    template = (TEMPLATES / "report.html.j2").read_text(encoding="utf-8")
    style = re.search(r"<style>(.*?)</style>", template, re.DOTALL)
    drawn = for_the_page(session, None)
    sheet = thumbnails(session)
    some = sorted(
        {round(k * (len(sheet) - 1) / (_SHOWN - 1)) for k in range(_SHOWN)} if sheet else ()
    )
    strip = "".join(
        f"<figure>{svg}<figcaption><b>{word.replace('_', ' ') or '–'}</b> · "
        f"{when}</figcaption></figure>"
        for svg, when, word, _ in (sheet[k] for k in some)
    )
    way = f"<figure>{drawn.get('trajectory', '')}</figure>"
    lines = "".join(f"<figure>{drawn.get(name, '')}</figure>" for name in ("ethogram", "curves"))
    css = (style[1] if style else "") + _STYLE
    body = f'<div class="pair"><div class="strip">{strip}</div>{way}</div>{lines}'
    return f'<!doctype html><meta charset="utf-8"><style>{css}</style><main>{body}</main>'


def photograph(session: str | Path, png: str | Path, browser: str = "chromium") -> Path:
    """Write the page of a session as a PNG.

    Args:
        session: the session's folder.
        png: the file to write.
        browser: the command of a Chromium.

    Returns:
        Path of the PNG.

    Raises:
        subprocess.CalledProcessError: the browser failed.
        subprocess.TimeoutExpired: the browser took longer than two minutes.
    """
    with tempfile.TemporaryDirectory(prefix="liex-") as folder:
        html = Path(folder) / "page.html"
        html.write_text(page(Session.open(session)), encoding="utf-8")
        command = [browser, "--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars"]
        subprocess.run(
            [
                *command,
                f"--window-size={WIDTH},{HEIGHT}",
                f"--screenshot={Path(png).resolve()}",
                html.as_uri(),
            ],
            check=True,
            capture_output=True,
            timeout=120,
        )
    return Path(png)
