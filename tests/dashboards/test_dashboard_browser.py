"""The dashboard in a real browser, with a study of two hundred sessions: what is clicked happens, and nothing else."""

from __future__ import annotations

import csv
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from liex_lab.dashboards.app import make_app, serve
from liex_lab.dashboards.app_data import StudyData
from liex_lab.pipelines.listing import list_sessions
from playwright.sync_api import Page, expect

from tests.dashboards import copies
from tests.dashboards.conftest import Watched

N_SESSIONS = 200
SOON_S = 20.0  # from the study file to the list on the screen; measured: 3 s on two quiet cores
KEY = "sub-m003_ses-01"


class Served:
    """A dashboard that answers, and how its replay was asked for."""

    def __init__(self, study: Path) -> None:
        self.began = time.monotonic()
        self.asked: list[tuple[Path, float]] = []
        data = StudyData(*list_sessions(study))
        data.warm()
        app = make_app(data, show_replay=lambda replay, at_s: self.asked.append((replay, at_s)))
        ready = threading.Event()

        def told(port: int) -> None:
            self.address = f"http://127.0.0.1:{port}"
            ready.set()

        threading.Thread(target=serve, args=(app, "127.0.0.1", 0, told), daemon=True).start()
        assert ready.wait(20)


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    return Served(copies.study(tmp_path_factory.mktemp("study"), N_SESSIONS))


def rows(page: Page) -> list[str]:
    return page.locator("tbody tr td:first-child").all_inner_texts()


def test_two_hundred_sessions_open_in_seconds_are_sorted_filtered_and_had_as_csv(
    served: Served, watched: Watched
) -> None:
    page = watched.page
    page.goto(served.address)
    page.wait_for_selector("tbody tr")
    assert time.monotonic() - served.began < SOON_S
    assert len(rows(page)) == N_SESSIONS
    page.get_by_role("button", name="with a pose").click()
    page.wait_for_selector("th[aria-sort='ascending']")
    assert set(rows(page)[-2:]) == {"sub-m000_ses-02", "sub-m001_ses-01"}  # of those nothing is known
    page.get_by_placeholder("any word").first.fill("failed")
    expect(page.locator("tbody tr")).to_have_count(1)
    assert "frame 33 cannot be read; copy it again" in page.locator("tbody").inner_text()
    with page.expect_download() as waiting:
        page.get_by_role("link", name="Download CSV").click()
    with open(waiting.value.path(), encoding="utf-8", newline="") as file:
        table = list(csv.DictReader(file))
    assert len(table) == N_SESSIONS
    assert {row["group"] for row in table} == set(copies.GROUPS)
    watched.nothing_went_wrong()


def test_an_ethogram_leads_to_the_frame_and_its_replay(served: Served, watched: Watched) -> None:
    page = watched.page
    page.goto(f"{served.address}/ethograms")
    page.wait_for_selector("#ethograms .hm image, #ethograms image")
    plot = page.locator("#ethograms .nsewdrag").bounding_box()
    assert plot is not None
    page.mouse.click(plot["x"] + plot["width"] * 0.5, plot["y"] + 6)
    page.wait_for_selector("#frame-facts dd")
    assert page.url.startswith(f"{served.address}/session/sub-m")
    moment = page.locator("#moment").input_value()
    at_s = float(moment)
    assert at_s == pytest.approx(3.0, abs=0.1)  # the middle of 6 s
    page.get_by_role("button", name="frame ▶", exact=True).click()
    expect(page.locator("#moment")).not_to_have_value(moment)
    assert 0.0 < float(page.locator("#moment").input_value()) - at_s < 0.05
    page.get_by_role("button", name="flagged ▶").click()
    page.get_by_text("not_found").wait_for()
    page.get_by_text("no pose in this frame").wait_for()
    page.get_by_role("button", name="Open the replay here").click()
    page.get_by_text("Rerun shows the replay at").wait_for()
    (replay, shown_s) = served.asked[-1]
    assert replay.name == "session.rrd"
    assert shown_s == pytest.approx(float(page.locator("#moment").input_value()))
    assert f"--at {shown_s:.3f}" in page.locator("#replay-command").inner_text()
    watched.nothing_went_wrong()


def test_a_measure_is_chosen_and_its_groups_compared_with_names_as_text(served: Served, watched: Watched) -> None:
    page = watched.page
    page.goto(f"{served.address}/groups")
    page.wait_for_selector(".verdict")
    page.locator("#measure").click()
    page.get_by_role("option", name="mean speed mm s").click()
    expect(page.locator("#measure-meaning")).to_contain_text("mean speed")
    expect(page.locator(".verdict")).to_contain_text("mm/s")
    verdict = page.locator(".verdict").inner_text()
    assert "Hedges' g" in verdict
    assert "100 animals" in verdict
    assert "control - <b>drug</b> %{y}" in verdict
    assert page.locator(".js-plotly-plot b, .js-plotly-plot tspan[style*='bold']").count() == 0
    watched.nothing_went_wrong()


@pytest.mark.parametrize("path", ["/", "/ethograms", "/groups", f"/session/{KEY}?t=2.5"])
def test_every_page_fits_a_phone(served: Served, watched: Watched, path: str) -> None:
    page = watched.page
    page.set_viewport_size({"width": 390, "height": 800})
    page.goto(f"{served.address}{path}")
    page.wait_for_selector("h1")
    page.wait_for_load_state("networkidle")
    assert page.evaluate("document.documentElement.scrollWidth") <= 390
    watched.nothing_went_wrong()


def test_everything_can_be_reached_with_the_keyboard_and_is_seen_when_it_is(served: Served, watched: Watched) -> None:
    page = watched.page
    page.goto(f"{served.address}/session/{KEY}?t=2.5")
    page.wait_for_selector("#frame-facts dd")
    named, seen = [], []
    for _ in range(60):
        page.keyboard.press("Tab")
        about = page.evaluate("""() => { const one = document.activeElement, style = getComputedStyle(one);
            const outer = one.closest('.dash-input-container');
            const ring = [style, ...(outer ? [getComputedStyle(outer)] : [])].some(
                s => parseFloat(s.outlineWidth) >= 2 && s.outlineStyle !== 'none');
            return [one.innerText || one.getAttribute('aria-label') || one.id || one.tagName, ring || one.type]; }""")
        named.append(str(about[0]))
        seen.append(about[1])
    assert named[:4] == ["Skip to the content", "Sessions", "Ethograms", "Groups"]
    assert "frame ▶" in named
    assert "Open the replay here" in named, named
    assert [name for name, ring in zip(named, seen, strict=True) if ring is not True] == []
    unnamed = page.evaluate("""[...document.querySelectorAll('input:not([type=hidden])')].filter(
        one => !one.labels.length && !one.getAttribute('aria-label')).map(one => one.outerHTML)""")
    assert unnamed == []
    watched.nothing_went_wrong()
