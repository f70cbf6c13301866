"""The report in a real browser: on a phone, a screen and paper nothing runs out of the page, and
nothing goes wrong.
"""

from pathlib import Path

import pytest

from liex_lab.sessions import Session
from tests.dashboards.conftest import Watched

_EMPTY = (
    "[...document.querySelectorAll('svg')].filter(svg => svg.getBoundingClientRect().height < "
    "5).length"
)
_BROKEN = "[...document.images].filter(image => !image.naturalWidth).length"
# on paper: what runs over its right edge, and figures that two pages would share
_A4_PX = 718  # the width of A4 between margins of 10 mm at 96 dpi
_A4_HIGH_PX = 1017  # its height between margins of 14 mm
# a box that may not be broken and is not higher than a page is on one page as a whole
_CUT = """high => [...document.querySelectorAll('svg, .cards, .problems')]
    .filter(box => box.getClientRects().length)
    .map(box => box.closest('figure') || box)
    .filter(box => getComputedStyle(box).breakInside !== 'avoid'
        || box.getBoundingClientRect().height > high)
    .map(box => box.outerHTML.slice(0, 80))"""


@pytest.fixture
def report(walker: Session) -> Path:
    return walker.path / "report.html"


@pytest.mark.parametrize("width", [360, pytest.param(1000, marks=pytest.mark.nightly)])
def test_the_report_fits_a_phone_and_a_screen(report: Path, width: int, watched: Watched) -> None:
    watched.page.set_viewport_size({"width": width, "height": 800})
    watched.page.goto(report.as_uri())
    assert watched.page.evaluate("document.documentElement.scrollWidth") <= width
    assert watched.page.evaluate(_EMPTY) == 0
    assert watched.page.evaluate(_BROKEN) == 0
    watched.nothing_went_wrong()


@pytest.mark.nightly
def test_the_report_can_be_printed(report: Path, watched: Watched) -> None:
    page = watched.page
    page.set_viewport_size({"width": _A4_PX, "height": 1000})
    page.emulate_media(media="print", color_scheme="dark")
    page.goto(report.as_uri())
    assert page.evaluate("document.documentElement.scrollWidth") <= _A4_PX
    assert page.evaluate("getComputedStyle(document.body).backgroundColor") == "rgb(255, 255, 255)"
    assert page.locator("nav").is_hidden()
    clipped = """[...document.querySelectorAll('.scroll, .over, .cards')].filter(
        box => box.scrollWidth > box.clientWidth + 1
            && getComputedStyle(box).overflowX !== 'visible').length"""
    assert page.evaluate(clipped) == 0  # on paper nobody scrolls
    assert page.evaluate("document.querySelectorAll('svg').length") > 8
    assert page.evaluate(_CUT, _A4_HIGH_PX) == []
    shown = page.pdf(format="A4", print_background=True)
    assert shown.startswith(b"%PDF")
    watched.nothing_went_wrong()
