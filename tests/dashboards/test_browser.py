"""The report in a real browser: on a phone and on a screen nothing runs out of the page, and nothing goes wrong."""

from __future__ import annotations

import html
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from liex_lab.dashboards.report import render

from liex_lab.recordings.walls import Arena
from liex_lab.recordings.zones import Zone
from tests.sessions.walking_mouse import WalkingMouse, steady, write

# The page in a frame as wide as a phone or a screen; what does not fit and what fails to load goes into the title
_FRAME = """<!doctype html><iframe style="width:{width}px;height:800px;border:0" srcdoc="{page}"></iframe><script>
const frame = document.querySelector("iframe");
frame.onload = () => {{
  const inner = frame.contentDocument, root = inner.documentElement;
  const broken = [...inner.images].filter(image => !image.naturalWidth).length;
  const empty = [...inner.querySelectorAll("svg")].filter(svg => svg.getBoundingClientRect().height < 5).length;
  document.title = [root.scrollWidth, frame.clientWidth, broken, empty].join(" ");
}};
</script>"""


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> str:
    mouse = WalkingMouse(np.delete(steady(14.0), slice(40, 46)), rear_s=(2.0, 3.0), lost=(60, 61))
    nest = Zone("a nest with a rather long name", polygon_mm=((0.0, 0.0), (90.0, 0.0), (90.0, 90.0)))
    bowl = Arena("round", (0.0, 0.0), 220.0)
    return render(write(tmp_path_factory.mktemp("browser") / "c.liex", mouse, arena=bowl, zones=(nest,)))


@pytest.mark.parametrize("width", [360, 1000])
def test_the_report_fits_a_phone_and_a_screen(page: str, width: int, tmp_path: Path) -> None:
    browser = shutil.which("chromium")
    if browser is None:
        pytest.skip("no chromium is installed")
    file = tmp_path / "frame.html"
    file.write_text(_FRAME.format(width=width, page=html.escape(page)), encoding="utf-8")
    flags = ["--headless", "--no-sandbox", "--disable-gpu", "--window-size=1200,900", "--enable-logging=stderr",
             "--virtual-time-budget=5000", f"--user-data-dir={tmp_path / 'profile'}"]  # fmt: skip
    ran = subprocess.run(
        [browser, *flags, "--dump-dom", file.as_uri()], capture_output=True, text=True, timeout=120, check=True
    )
    title = re.search(r"<title>([\d ]+)</title>", ran.stdout)
    assert title is not None, ran.stderr[-2000:]
    needed, given, broken, empty = map(int, title[1].split())
    assert given == width
    assert needed <= width
    assert (broken, empty) == (0, 0)
    assert "CONSOLE" not in ran.stderr
