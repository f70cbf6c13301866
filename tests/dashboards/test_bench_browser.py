"""The page "Measure" in a real browser: a recording is chosen, examined, and its findings shown."""

import pytest
from playwright.sync_api import expect

from liex_lab.sessions import Session
from tests.dashboards.conftest import Watched
from tests.dashboards.served import Served
from tests.recordings.writers import depth_frames, write_mcap


@pytest.fixture
def served(own: Session) -> Served:
    folder = own.path.parent / "day1"
    folder.mkdir()
    write_mcap(folder / "mouse.mcap", depth_frames(6))
    return Served(own.path.parent)


@pytest.mark.slow
def test_a_recording_is_chosen_and_examined(served: Served, watched: Watched) -> None:
    page = watched.page
    page.goto(served.address)
    page.get_by_role("link", name="Measure").click()
    page.get_by_role("link", name="day1/").click()
    page.get_by_role("button", name="Examine").click()
    expect(page.locator("#job-title")).to_have_text(
        "Examine day1/mouse.mcap: done", timeout=120_000
    )
    expect(page.locator("#job-lines")).to_contain_text("frames/s")
    watched.nothing_went_wrong()
