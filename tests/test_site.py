"""The site of docs/ is built without a network and with warnings as errors, its examples are run,
and a page asks no other machine for anything.
"""

from __future__ import annotations

import functools
import http.server
import os
import re
import shutil
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from tests.conftest import REPOSITORY

if TYPE_CHECKING:
    from playwright.sync_api import Browser

pytestmark = pytest.mark.checks

LOOKED_AT = (
    "index.html",
    "start.html",
    "tutorials/mouse.html",
    "concepts/how-it-fails.html",
    "auto_examples/plot_3_intervals.html",
    "reference/python.html",
    "search.html?q=speed",
)


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Built once, from a copy, so that nothing is left in the repository."""
    place = tmp_path_factory.mktemp("site")
    made = shutil.ignore_patterns("auto_examples", "results", "_build", "__pycache__")
    shutil.copytree(REPOSITORY / "docs", place / "docs", ignore=made)
    (place / "dashboards").symlink_to(REPOSITORY / "dashboards")
    # a proxy where nobody listens: whatever asks for another machine fails
    nowhere = dict.fromkeys(("http_proxy", "https_proxy", "all_proxy"), "http://127.0.0.1:9")
    ran = subprocess.run(
        [sys.executable, "-m", "sphinx", "-W", "-q", "docs", "html"],
        cwd=place,
        env={**os.environ, **nowhere, "PYTHONPATH": str(REPOSITORY)},
        capture_output=True,
        text=True,
    )
    assert ran.returncode == 0, ran.stderr[-3000:]
    return place / "html"


@pytest.fixture(scope="module")
def address(site: Path) -> Iterator[str]:
    class Quiet(http.server.SimpleHTTPRequestHandler):
        def log_message(self, format: str, *arguments: object) -> None:
            pass

    handler = functools.partial(Quiet, directory=str(site))
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()


def test_every_example_was_run_and_drew_or_printed(site: Path) -> None:
    scripts = sorted((REPOSITORY / "docs" / "examples").glob("plot_*.py"))
    assert len(scripts) >= 7
    for script in scripts:
        page = (site / "auto_examples" / f"{script.stem}.html").read_text(encoding="utf-8")
        assert "sphx-glr-script-out" in page or "sphx-glr-single-img" in page, script.name
        assert "Traceback" not in page, script.name


def test_generated_pages_hold_what_the_program_says(site: Path) -> None:
    verbs = (site / "reference" / "command-line.html").read_text(encoding="utf-8")
    for verb in ("demo", "doctor", "run", "correct flip", "evaluate statistics"):
        assert f"liex {verb}<" in verbs, verb
    evidence = (site / "evidence.html").read_text(encoding="utf-8")
    assert re.search(r"<td><p>mouse, clean</p></td>\s*<td><p>2,000</p></td>", evidence)
    for page in site.rglob("*.html"):
        assert "&lt;!-- generated" not in page.read_text(encoding="utf-8"), page
    assert "spine_max_mm" in (site / "reference" / "plan.html").read_text(encoding="utf-8")
    assert ">run_session<" in (site / "reference" / "python.html").read_text(encoding="utf-8")


def test_a_page_asks_no_other_machine_and_fits_a_phone(
    site: Path, address: str, browser: Browser
) -> None:
    asked: list[str] = []
    broken: list[str] = []
    for width in (1280, 390):
        page = browser.new_page(viewport={"width": width, "height": 800})
        page.on("request", lambda request: asked.append(request.url))
        page.on("pageerror", lambda error: broken.append(str(error)))
        page.on(
            "response",
            lambda answer: broken.append(answer.url) if answer.status >= 400 else None,
        )
        for name in LOOKED_AT:
            page.goto(f"{address}/{name}", wait_until="networkidle")
            wide = page.evaluate("document.documentElement.scrollWidth")
            assert wide <= width, f"{name} is {wide} px wide on {width}"
        page.close()
    assert asked
    assert [url for url in asked if not url.startswith((address, "data:", "blob:"))] == []
    assert broken == []
