"""The dashboard in a real browser, one story per page: what is clicked happens, nothing else."""

import csv
import re
from pathlib import Path

import pytest
from playwright.sync_api import Page, Route, expect

from liex_lab.cli.sessions import page_that_opens
from liex_lab.sessions import Session
from liex_lab.sessions.corrections import read_log
from tests.dashboards import copies
from tests.dashboards.conftest import Watched, fits_a_phone, until
from tests.dashboards.served import Served

N_SESSIONS = 12
KEY = "sub-m003_ses-01"


def rows(page: Page) -> list[str]:
    return page.locator("tbody tr td:first-child").all_inner_texts()


def test_sessions_are_sorted_filtered_and_had_as_csv_behind_a_token(
    served: Served, tmp_path: Path, watched: Watched
) -> None:
    guarded = Served(served.study, token="right")
    page = watched.page
    page.goto(page_that_opens(f"{guarded.address}/?token=right", tmp_path).as_uri())
    expect(page.locator("tbody tr")).to_have_count(N_SESSIONS)
    assert page.url == f"{guarded.address}/"  # the token is in no history
    page.get_by_role("button", name="with a pose").click()
    page.wait_for_selector("th[aria-sort='ascending']")
    # of those nothing is known
    assert set(rows(page)[-2:]) == {"sub-m000_ses-02", "sub-m001_ses-01"}
    page.get_by_placeholder("any word").first.fill("failed")
    expect(page.locator("tbody tr")).to_have_count(1)
    assert "frame 33 cannot be read; copy it again" in page.locator("tbody").inner_text()
    with page.expect_download() as waiting:
        page.get_by_role("link", name="Download CSV").click()
    with open(waiting.value.path(), encoding="utf-8", newline="") as file:
        table = list(csv.DictReader(file))
    assert len(table) == N_SESSIONS
    assert {row["group"] for row in table} == set(copies.GROUPS)
    assert fits_a_phone(page)
    page.goto(f"{guarded.address}/session/sub-m000_ses-02")
    expect(page.locator("main")).to_contain_text("frame 33 cannot be read; copy it again")
    page.wait_for_load_state("networkidle")
    watched.nothing_went_wrong()


def test_an_ethogram_leads_to_the_frame_and_its_replay(served: Served, watched: Watched) -> None:
    page = watched.page
    page.goto(f"{served.address}/ethograms")
    assert fits_a_phone(page)
    page.set_viewport_size({"width": 1400, "height": 900})
    row = page.locator("#ethograms .row").first
    box = row.bounding_box()
    assert box is not None
    page.mouse.move(box["x"] + box["width"] * 0.25, box["y"] + 6)
    page.mouse.down()
    page.mouse.move(box["x"] + box["width"] * 0.75, box["y"] + 6, steps=3)
    page.mouse.up()
    page.wait_for_url(re.compile("from=1.5.*to=4.5"))  # enlarged
    page.mouse.click(box["x"] + box["width"] * 0.5, box["y"] + 6)
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
    with page.expect_download() as waiting:
        page.get_by_role("link", name="trajectory.svg").click()
    assert "Trajectory" in Path(waiting.value.path()).read_text(encoding="utf-8")
    watched.nothing_went_wrong()


def line_s(page: Page) -> float:
    """Where the line through the curves of the whole session is, s."""
    return float(page.locator("#whole .cursor").get_attribute("data-at") or "nan")


def moment_s(page: Page) -> float:
    """The moment in its field, s; the page moves it to the nearest frame once it has loaded."""
    return float(page.locator("#moment").input_value())


def reached_by_keyboard(page: Page) -> None:
    """Everything up to the replay can be reached with the Tab key, and is outlined when it is."""
    named: list[str] = []
    rings = []
    while "Open the replay here" not in named and len(named) < 120:
        page.keyboard.press("Tab")
        about = page.evaluate("""() => {
            const one = document.activeElement, style = getComputedStyle(one);
            const ring = parseFloat(style.outlineWidth) >= 2 && style.outlineStyle !== 'none';
            const name = one.innerText || one.getAttribute('aria-label') || one.id || one.tagName;
            return [name, ring || one.type]; }""")
        named.append(str(about[0]))
        rings.append(about[1])
    assert named[:4] == ["Skip to the content", "Sessions", "Ethograms", "Groups"]
    assert "frame ▶" in named
    assert "Open the replay here" in named, named
    assert [name for name, ring in zip(named, rings, strict=True) if ring is not True] == []
    unnamed = page.evaluate("""[...document.querySelectorAll('input:not([type=hidden])')].filter(
        one => !one.labels.length && !one.getAttribute('aria-label')).map(one => one.outerHTML)""")
    assert unnamed == []


@pytest.mark.nightly
def test_the_line_through_the_whole_session_follows_the_moment_and_a_drag_enlarges(
    served: Served, watched: Watched
) -> None:
    page = watched.page
    held: list[Route] = []
    page.route("**/whole/*", lambda route: held.append(route))
    page.goto(f"{served.address}/session/{KEY}?t=2.5")
    page.wait_for_selector("#desk.is-open")
    reached_by_keyboard(page)
    page.locator("#moment").fill("1.5")  # before there are figures
    page.locator("#moment").blur()
    expect(page.locator("#moment-link a")).to_have_attribute("href", re.compile("t=1.5"))
    assert len(held) == 1
    page.unroute("**/whole/*")
    held[0].continue_()
    page.wait_for_selector("#frame-facts dd")
    until(page, lambda: line_s(page) == pytest.approx(moment_s(page)))
    at_s = moment_s(page)
    assert at_s == pytest.approx(1.5, abs=0.05)  # the frame that is nearest
    page.get_by_role("button", name="bout ▶").click()
    until(page, lambda: abs(moment_s(page) - at_s) > 0.05)
    expect(page.locator("#replay-command")).not_to_contain_text(f"--at {at_s:.3f}")
    until(page, lambda: line_s(page) == pytest.approx(moment_s(page)))
    drawn = page.locator("#whole svg").first
    drawn.scroll_into_view_if_needed()
    box = drawn.bounding_box()
    assert box is not None
    x, y = box["x"] + box["width"] * 0.56, box["y"] + box["height"] * 0.6  # 3 s
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x + 100, y, steps=3)
    with page.expect_response("**/whole/*from=*") as answered:
        page.mouse.up()
    enlarged = answered.value.json()
    assert enlarged["from_s"] == pytest.approx(3.0, abs=0.05)
    assert enlarged["to_s"] - enlarged["from_s"] < 1.0
    watched.nothing_went_wrong()


@pytest.mark.nightly
def test_a_person_corrects_by_sentences_and_takes_one_back(
    served: Served, watched: Watched
) -> None:
    page, key = watched.page, "sub-m004_ses-01"
    page.goto(f"{served.address}/session/{key}?t=2.5")
    page.wait_for_selector("#desk.is-open")
    page.get_by_text("Correct by a sentence").click()
    sentence, said = page.locator("#correct-sentence"), page.locator(".desk-message")
    made = page.locator("#correct-made li")

    def correct(words: str, n: int) -> None:
        sentence.fill(words)
        sentence.press("Enter")
        expect(made).to_have_count(n)
        expect(sentence).to_have_value("")

    sentence.fill("joint nose here")
    stage = page.locator(".desk-stage")
    stage.scroll_into_view_if_needed()
    box = stage.bounding_box()
    assert box is not None
    stage.click(position={"x": box["width"] * 0.5, "y": box["height"] * 0.4})
    expect(sentence).not_to_have_value("joint nose here")  # the pixel that was clicked
    words = sentence.input_value()
    u, v = (float(word) for word in words.split()[3:])
    correct(words, 1)
    correct("rename here pause", 2)
    folder = next(served.study.parent.rglob("sub-m004/ses-01/behav"))
    session = Session.open(folder)
    row = int((session.frames["time_s"] - 2.5).abs().to_numpy().argmin())
    poses = session.table("poses", None, [int(session.frames["frame_index"].iloc[row])]).set_index(
        "joint"
    )
    assert (poses.loc["nose", "u_px"], poses.loc["nose", "v_px"]) == pytest.approx((u, v), abs=1.5)
    assert "pause" in set(session.bouts["action"])
    made.last.get_by_role("button", name="Take back").click()
    expect(made).to_have_count(1)
    assert "pause" not in set(Session.open(folder).bouts["action"])
    assert len(read_log(folder).entries) == 3
    correct("rename here 'tail rattle' new", 2)
    expect(made.last).to_contain_text("is tail rattle")
    assert "tail rattle" in set(Session.open(folder).bouts["action"])
    watched.nothing_went_wrong()
    sentence.fill("rename here hop")
    sentence.press("Enter")
    expect(said).to_contain_text("the ethogram has no word 'hop'")
    sentence.fill("cut it here")
    sentence.press("Enter")
    expect(said).to_contain_text("a correction is written as one of: flip FROM TO")


def test_a_measure_is_chosen_and_its_groups_compared_with_names_as_text(
    served: Served, watched: Watched
) -> None:
    page = watched.page
    page.goto(f"{served.address}/groups")
    page.wait_for_selector(".verdict")
    page.locator("#measure").select_option("mean_speed_mm_s")
    expect(page.locator("#measure-meaning")).to_contain_text("mean speed")
    expect(page.locator(".verdict")).to_contain_text("cm/s")
    verdict = page.locator(".verdict").inner_text()
    assert "Hedges' g" in verdict
    assert f"{N_SESSIONS // 2} animals" in verdict
    assert "<b>drug</b> %{y} - control" in verdict
    assert "<b>drug</b> %{y}" in (page.locator("#group-figure svg").text_content() or "")
    assert page.locator("#group-figure b").count() == 0
    mark = page.locator("#group-figure a").last
    assert "animal m" in (mark.locator("title").text_content() or "")
    assert fits_a_phone(page)
    mark.click()
    page.wait_for_url(f"{served.address}/session/sub-m*")
    watched.nothing_went_wrong()
