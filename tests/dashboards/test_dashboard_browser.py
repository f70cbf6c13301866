"""The dashboard in a real browser, with a study of two hundred sessions: what is clicked happens,
and nothing else.
"""

from __future__ import annotations

import csv
import re
import time
from pathlib import Path

import pytest
from playwright.sync_api import Page, Route, expect

from liex_lab.cli.study import page_that_opens
from liex_lab.sessions import Session
from liex_lab.sessions.corrections import read_log
from tests.dashboards import copies
from tests.dashboards.conftest import Watched, until
from tests.dashboards.served import Served

N_SESSIONS = 200
# from the study file to the list on the screen; measured: 4.5 s on two cores that had other work
SOON_S = 20.0
KEY = "sub-m003_ses-01"


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Served:
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
    assert set(rows(page)[-2:]) == {
        "sub-m000_ses-02",
        "sub-m001_ses-01",
    }  # of those nothing is known
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


def test_a_session_that_failed_is_shown_without_a_complaint_of_the_browser(
    served: Served, watched: Watched
) -> None:
    watched.page.goto(f"{served.address}/session/sub-m000_ses-02")
    expect(watched.page.locator("main")).to_contain_text("frame 33 cannot be read; copy it again")
    watched.page.wait_for_load_state("networkidle")
    watched.nothing_went_wrong()


def test_the_page_that_open_writes_leads_into_a_dashboard_with_a_token(
    tmp_path: Path, watched: Watched
) -> None:
    served = Served(copies.study(tmp_path / "study", 2), token="right")
    page = watched.page
    page.goto(page_that_opens(f"{served.address}/?token=right", tmp_path).as_uri())
    expect(page.locator("tbody tr")).to_have_count(2)
    assert page.url == f"{served.address}/"  # the token is in no history
    page.get_by_role("link", name="Ethograms").click()
    page.wait_for_selector("#ethograms image")
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
    page.get_by_role("button", name="Open the replay here").click()
    page.get_by_text("Rerun shows the replay at").wait_for()
    (replay, shown_s) = served.asked[-1]
    assert replay.name == "session.rrd"
    assert shown_s == pytest.approx(float(page.locator("#moment").input_value()))
    assert f"--at {shown_s:.3f}" in page.locator("#replay-command").inner_text()
    tools = page.locator(".modebar-btn").evaluate_all(
        "buttons => buttons.map(one => one.dataset.title)"
    )
    assert "Download plot as a PNG" in tools
    assert not any("hare" in tool or "loud" in tool for tool in tools), (
        tools
    )  # it would send the figure away
    watched.nothing_went_wrong()


def line_s(page: Page) -> float:
    """Where the line through the curves of the whole session stands, s."""
    plot = page.locator("#whole .js-plotly-plot")
    return float(plot.evaluate("plot => plot.layout.shapes[0].x0"))


def test_the_line_through_the_whole_session_goes_along_with_the_moment(
    served: Served, watched: Watched
) -> None:
    page = watched.page
    held: list[Route] = []

    def hold_figures(route: Route) -> None:
        if "session-figures.children" in (route.request.post_data or ""):
            held.append(route)
        else:
            route.fallback()

    page.route("**/_dash-update-component*", hold_figures)
    page.goto(f"{served.address}/session/{KEY}?t=2.5")
    page.wait_for_selector("#desk.is-open")
    page.locator("#moment").fill("1.5")  # before there are figures
    page.locator("#moment").blur()
    expect(page.locator("#moment-link a")).to_have_attribute("href", re.compile("t=1.5"))
    assert len(held) == 1
    held[0].continue_()
    page.wait_for_selector("#frame-facts dd")
    at_s = page.locator("#moment").input_value()
    assert float(at_s) == pytest.approx(1.5, abs=0.05)  # the frame that is nearest
    until(page, lambda: line_s(page) == pytest.approx(float(at_s)))
    page.get_by_role("button", name="bout ▶").click()
    expect(page.locator("#moment")).not_to_have_value(at_s)
    expect(page.locator("#replay-command")).not_to_contain_text(f"--at {float(at_s):.3f}")
    now_s = float(page.locator("#moment").input_value())
    until(page, lambda: line_s(page) == pytest.approx(now_s))
    watched.nothing_went_wrong()


_HELD_ANSWERS = """
window.held = {numbers: [], page: []};
const plain = window.fetch;
window.fetch = async (address, more) => {
  const answer = await plain(address, more), asked = String(more && more.body);
  const kind = asked.includes("frame-facts.children") ? "numbers"
    : window.leaving && asked.includes("page.children") ? "page" : null;
  if (kind) await new Promise((go) => {
    window.held[kind].push(go);
    document.documentElement.classList.add(`held-${kind}`);
  });
  return answer;
};
"""


def test_a_page_that_is_left_as_its_numbers_come_complains_of_nothing(
    served: Served, watched: Watched
) -> None:
    page = watched.page
    page.add_init_script(_HELD_ANSWERS)
    page.goto(f"{served.address}/session/{KEY}")
    page.wait_for_selector("#whole .js-plotly-plot")
    page.wait_for_selector("html.held-numbers")
    page.evaluate("window.leaving = true")
    page.get_by_role("link", name="Draw the region of the arena").click()
    page.wait_for_selector("html.held-page")
    page.evaluate("[...held.page, ...held.numbers].forEach((go) => go())")
    page.wait_for_selector("#region.is-open")
    page.wait_for_load_state("networkidle")
    watched.nothing_went_wrong()


def test_a_person_moves_a_joint_renames_a_bout_and_takes_it_back(
    served: Served, watched: Watched
) -> None:
    page, key = watched.page, "sub-m004_ses-01"
    page.goto(f"{served.address}/session/{key}?t=2.5")
    page.wait_for_selector("#frame-facts dd")  # what comes after the picture is there
    page.get_by_text("Correct by numbers").click()
    page.locator("#correct-joint").click()
    page.get_by_role("option", name="nose").click()
    page.locator(".desk-stage").scroll_into_view_if_needed()
    picture = page.locator(".desk-stage").bounding_box()
    assert picture is not None
    page.mouse.click(picture["x"] + picture["width"] * 0.5, picture["y"] + picture["height"] * 0.4)
    expect(page.locator("#correct-u")).not_to_have_value("")
    u, v = (float(page.locator(f"#correct-{name}").input_value()) for name in "uv")
    page.get_by_role("button", name="Put it under the pixel").click()
    page.get_by_text("1: nose of frame").wait_for()
    page.locator("#correct-action").click()
    page.get_by_role("option", name="pause").click()
    page.get_by_role("button", name="Rename the bout").click()
    page.get_by_text("is pause").wait_for()
    folder = next(served.study.parent.rglob("sub-m004/ses-01/behav"))
    session = Session.open(folder)
    row = int((session.frames["time_s"] - 2.5).abs().to_numpy().argmin())
    poses = session.table("poses", None, [int(session.frames["frame_index"].iloc[row])]).set_index(
        "joint"
    )
    assert (poses.loc["nose", "u_px"], poses.loc["nose", "v_px"]) == pytest.approx((u, v), abs=1.5)
    assert "pause" in set(session.bouts["action"])
    page.locator("#correct-made").get_by_role("button", name="Take back").last.click()
    expect(page.locator("#correct-made").get_by_role("button", name="Take back")).to_have_count(1)
    assert "pause" not in set(Session.open(folder).bouts["action"])
    assert len(read_log(folder).entries) == 3
    page.locator("#correct-new").fill("tail rattle")
    page.get_by_role("button", name="Rename the bout").click()
    page.get_by_text("is tail rattle").wait_for()
    assert "tail rattle" in set(Session.open(folder).bouts["action"])
    page.locator("#correct-action").click()
    page.get_by_role("option", name="tail rattle").click()  # no longer new
    page.locator("#correct-new").fill("hop")
    page.get_by_role("button", name="Rename the bout").click()
    expect(page.get_by_role("alert")).to_contain_text("got tail rattle and the new word hop")
    page.get_by_role("button", name="Cut that bout to the span").click()
    expect(page.get_by_role("alert")).to_contain_text("fill in from, to")
    watched.nothing_went_wrong()


def test_a_measure_is_chosen_and_its_groups_compared_with_names_as_text(
    served: Served, watched: Watched
) -> None:
    page = watched.page
    page.goto(f"{served.address}/groups")
    page.wait_for_selector(".verdict")
    page.locator("#measure").click()
    page.get_by_role("option", name="mean speed", exact=True).click()
    expect(page.locator("#measure-meaning")).to_contain_text("mean speed")
    expect(page.locator(".verdict")).to_contain_text("cm/s")
    verdict = page.locator(".verdict").inner_text()
    assert "Hedges' g" in verdict
    assert "100 animals" in verdict
    assert "<b>drug</b> %{y} - control" in verdict
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


def test_everything_can_be_reached_with_the_keyboard_and_is_seen_when_it_is(
    served: Served, watched: Watched
) -> None:
    page = watched.page
    page.goto(f"{served.address}/session/{KEY}?t=2.5")
    page.wait_for_selector("#frame-facts dd")
    named: list[str] = []
    seen = []
    while "Open the replay here" not in named and len(named) < 120:
        page.keyboard.press("Tab")
        about = page.evaluate("""() => {
            const one = document.activeElement, style = getComputedStyle(one);
            const outer = one.closest('.dash-input-container');
            const ring = [style, ...(outer ? [getComputedStyle(outer)] : [])].some(
                s => parseFloat(s.outlineWidth) >= 2 && s.outlineStyle !== 'none');
            const name = one.innerText || one.getAttribute('aria-label') || one.id || one.tagName;
            return [name, ring || one.type]; }""")
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
