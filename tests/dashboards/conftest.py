"""One session and one study for all tests of views, and a browser whose every complaint and every
request to another machine is kept.
"""

import shutil
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
from liex_lab.dashboards.report.report import write_report
from playwright.sync_api import Browser, Page, Route, expect

from liex_lab.plan import Plan
from liex_lab.recordings.timestamps import find_gaps, median_step
from liex_lab.scene.floor import Floor
from liex_lab.scene.scene import Arena, Fixture, Scene
from liex_lab.scene.zones import Zone
from liex_lab.sessions import Session
from tests.dashboards import copies
from tests.dashboards.served import Served
from tests.sessions.walking_mouse import FLOOR_MM, SMALL, WalkingMouse, steady, write

_PATIENCE_MS = 30_000  # of a busy machine
KEY = "walker"
MOUSE = WalkingMouse(np.delete(steady(6.0), slice(40, 46)), rear_s=(2.0, 3.0), lost=(150, 151))
NEST = Zone("nest <1>", circle_mm=(100.0, 0.0, 60.0))
HOUSE = Fixture((120.0, -40.0), 62.0, 9000.0)
LEVEL = Floor.from_plane(np.array([0.0, 0.0, 1.0]), FLOOR_MM, SMALL)


@pytest.fixture(scope="session")
def walker(tmp_path_factory: pytest.TempPathFactory) -> Session:
    """A session with its report, which nobody may change: 6 s, a rear from 2 to 3 s, a gap of the
    camera, two frames without a pose, walls, a zone and a fixture.
    """
    return write(
        tmp_path_factory.mktemp("walker") / f"{KEY}.liex",
        MOUSE,
        name=KEY,
        arena=Arena("round", (0.0, 0.0), 220.0),
        zones=(NEST,),
        scene=Scene(LEVEL, fixtures=(HOUSE,)),
        gaps=find_gaps(MOUSE.times_ns, median_step(MOUSE.times_ns)),
        problems=["Dark & <cold>."],
        model={"name": "mouse", "sha256": "ab" * 32},
        plan_toml=Plan.load("mouse").to_toml(),
        report=write_report,
    )


@pytest.fixture
def own(walker: Session, tmp_path: Path) -> Session:
    """A copy of that session, alone in a folder, for tests that change it."""
    return Session.open(shutil.copytree(walker.path, tmp_path / "study" / walker.path.name))


@pytest.fixture(scope="session")
def study(walker: Session, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A study of a dozen copies, which nobody may change."""
    return copies.study(walker, tmp_path_factory.mktemp("study"), 12)


@pytest.fixture(scope="session")
def served(walker: Session, tmp_path_factory: pytest.TempPathFactory) -> Served:
    """A dashboard of such a study, whose sessions may be corrected and reviewed."""
    return Served(copies.study(walker, tmp_path_factory.mktemp("served"), 12))


@dataclass
class Watched:
    """A page, what it complained of, and what it asked other machines for (it got nothing)."""

    page: Page
    complaints: list[str] = field(default_factory=list)
    outside: list[str] = field(default_factory=list)

    def nothing_went_wrong(self) -> None:
        assert self.complaints == []
        assert self.outside == []


def watch(page: Page) -> Watched:
    watched = Watched(page)

    def pass_on(route: Route) -> None:
        if route.request.url.startswith(("http://127.0.0.1:", "file:", "data:", "blob:")):
            route.continue_()
        else:
            watched.outside.append(route.request.url)
            route.abort()

    page.route("**/*", pass_on)
    page.on(
        "console",
        lambda said: watched.complaints.append(said.text) if said.type == "error" else None,
    )
    page.on("pageerror", lambda error: watched.complaints.append(str(error)))
    return watched


def fits_a_phone(page: Page) -> bool:
    """Whether nothing of the page runs out of a phone's screen."""
    page.set_viewport_size({"width": 390, "height": 800})
    return bool(page.evaluate("document.documentElement.scrollWidth") <= 390)


def until(page: Page, true: Callable[[], bool]) -> None:
    """Wait for something that a page's own script may not be asked for, by its policy."""
    end = time.monotonic() + 30.0
    while not true():
        assert time.monotonic() < end
        page.wait_for_timeout(50)


@pytest.fixture
def watched(browser: Browser) -> Iterator[Watched]:
    """A page on a screen of 1400 x 900."""
    expect.set_options(timeout=_PATIENCE_MS)
    page = browser.new_page(viewport={"width": 1400, "height": 900}, accept_downloads=True)
    page.set_default_timeout(_PATIENCE_MS)
    yield watch(page)
    page.close()
