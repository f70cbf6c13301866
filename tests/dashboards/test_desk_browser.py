"""The page to correct in, in a real browser: joints dragged, actions named by keys, head and tail
exchanged, playing, taking back, doubtful places and crossings one after the other.
"""

import time
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from playwright.sync_api import Locator, Page, Route, expect

from liex_lab.api import run_session
from liex_lab.plan import Plan
from liex_lab.sessions import Session
from liex_lab.sessions.corrections import read_log
from tests.dashboards.conftest import KEY, MOUSE, Watched, fits_a_phone, until
from tests.dashboards.served import Served
from tests.dashboards.test_crossings import FLIPS, put_flips

TRACKED = "synthetic:walk?seed=3&frames=30&sensor=primesense-qvga&spine_mm=70"


def suggest(folder: Path) -> pd.DataFrame:
    """Two stretches that a recogniser would be unsure of."""
    rows = [(0.5, 1.0, "walk", "run", 0.4), (4.0, 4.5, "<b>walk</b>", "pause", 0.3)]
    return pd.DataFrame(rows, columns=["start_s", "stop_s", "guess", "or_else", "uncertainty"])


@pytest.fixture(scope="module")
def tracked(tmp_path_factory: pytest.TempPathFactory) -> Served:
    """A session whose track can be made again, for it keeps what its single frames said."""
    plan = Plan.load("mouse").with_settings(["animal.spine_mm=70", f"session.name={KEY}"])
    folder = tmp_path_factory.mktemp("measured")
    run_session(TRACKED, plan, folder)
    return Served(folder)


@pytest.fixture
def served(own: Session) -> Served:
    return Served(own.path.parent, suggest=suggest)


def opened(served: Served, page: Page, at_s: float) -> Locator:
    """The picture of the session's page, once it is there."""
    page.goto(f"{served.address}/session/{KEY}?t={at_s}")
    page.wait_for_selector("#desk.is-open")
    expect(page.locator(".desk-saved")).to_contain_text("all saved")
    stage = page.locator(".desk-stage")
    stage.scroll_into_view_if_needed()
    return stage


def session(served: Served) -> Session:
    return Session.open(served.study / f"{KEY}.liex")


def joint_on_screen(
    page: Page, stage: Locator, row: int, joint: int, settle: bool = False
) -> tuple[float, float]:
    """Where a joint is drawn, perhaps two frames of the screen later."""
    if settle:
        page.evaluate("new Promise(go => requestAnimationFrame(() => requestAnimationFrame(go)))")
    at = page.evaluate(
        """([row, joint]) => import('/assets/desk.mjs').then(module => module.drawn(row, joint))""",
        [row, joint],
    )
    box = stage.bounding_box()
    assert box is not None
    assert at is not None
    return box["x"] + at[0], box["y"] + at[1]


def at_rest(page: Page, stage: Locator, row: int, joint: int) -> tuple[float, float]:
    """Where a joint is drawn once the view moves no more."""
    places = [joint_on_screen(page, stage, row, joint)]

    def rests() -> bool:
        places.append(joint_on_screen(page, stage, row, joint, settle=True))
        return places[-1] == pytest.approx(places[-2], abs=0.1)

    until(page, rests)
    return places[-1]


def test_a_joint_is_dragged_and_its_frame_follows(served: Served, watched: Watched) -> None:
    page = watched.page
    stage = opened(served, page, 1.0)
    row, nose = 30, len(MOUSE.skeleton.names) - 1
    before = session(served).poses
    x, y = at_rest(page, stage, row, nose)
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x - 20, y + 8, steps=4)
    page.mouse.up()
    expect(page.locator(".desk-message")).to_contain_text("nose of frame 30 to")
    expect(page.locator(".desk-saved")).to_contain_text("1 correction stands, all saved")
    now = session(served)
    assert now.frames["flag"].iloc[row] == "corrected"
    place = [pose[["u_px", "v_px"]].to_numpy(float)[5 * row + nose] for pose in (before, now.poses)]
    scale = page.evaluate("import('/assets/desk.mjs').then(module => module.drawn(0, 0, true))")
    assert place[1] - place[0] == pytest.approx(np.array([-20, 8]) / scale, abs=1.0)
    until(
        page,
        lambda: (
            joint_on_screen(page, stage, row, nose)
            == pytest.approx((x - 20, y + 8), abs=1.2 * scale)
        ),
    )
    page.keyboard.press("u")
    expect(page.locator(".desk-saved")).to_contain_text("0 corrections stand, all saved")
    watched.nothing_went_wrong()


@pytest.mark.nightly
def test_a_joint_dragged_off_the_animal_keeps_its_height_and_can_be_redone(
    served: Served, watched: Watched
) -> None:
    page = watched.page
    row, said = 75, page.locator(".desk-message")
    stage = opened(served, page, float(MOUSE.times_s[row]))
    nose = session(served).poses.iloc[5 * row + 4]
    x, y = at_rest(page, stage, row, 4)
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x - 90, y + 90, steps=6)
    expect(said).to_contain_text(f"{nose['z_mm']:.1f}) mm, height kept")
    page.mouse.up()
    expect(page.locator(".desk-saved")).to_contain_text("1 correction stands, all saved")
    expect(said).to_contain_text("height kept: the pixel is not on the animal")
    page.keyboard.press("u")
    expect(page.locator(".desk-saved")).to_contain_text("0 corrections stand, all saved")
    expect(said).to_contain_text("is taken back")
    opened(served, page, 1.0)  # as after a restart: the log knows it
    page.get_by_role("button", name="Redo", exact=True).click()
    expect(page.locator(".desk-saved")).to_contain_text("1 correction stands, all saved")
    expect(said).to_contain_text("made again: nose of frame")
    page.keyboard.press("u")
    expect(page.locator(".desk-saved")).to_contain_text("0 corrections stand, all saved")
    expect(page.locator("#correct-made")).to_contain_text("Redo: nose of frame")
    page.keyboard.press("r")
    expect(page.locator(".desk-saved")).to_contain_text("1 correction stands, all saved")
    page.keyboard.press("r")
    expect(said).to_contain_text("nothing was taken back since the last")


def bands_and_doubts_are_above_the_fold(page: Page) -> None:
    """And a click leaves the keys to the page."""
    expect(page.locator(".desk-doubts li")).not_to_have_count(0)
    for part in (".desk-bar >> nth=0", ".desk-all", ".desk-doubts"):
        box = page.locator(part).bounding_box()
        assert box is not None
        assert box["y"] + box["height"] <= 900, part
    page.get_by_text("Keys and mouse").click()
    page.keyboard.press(" ")
    expect(page.locator(".desk-play")).to_contain_text("Pause")
    expect(page.locator(".desk-keys")).to_have_attribute("open", "")
    page.keyboard.press(" ")
    expect(page.locator(".desk-play")).to_contain_text("Play")


def keys_belong_to_a_field(page: Page) -> None:
    page.get_by_text("Correct by a sentence").click()
    page.locator("#correct-sentence").fill("")
    page.locator("#correct-sentence").type("f 1u")
    expect(page.locator("#correct-sentence")).to_have_value("f 1u")
    expect(page.locator(".desk-play")).to_contain_text("Play")
    page.locator("#correct-sentence").fill("")
    page.get_by_text("Correct by a sentence").click()


@pytest.mark.nightly
def test_an_action_is_named_by_a_key_and_taken_back_by_another(
    served: Served, watched: Watched
) -> None:
    page = watched.page
    page.goto(f"{served.address}/session/{KEY}")
    page.wait_for_selector("#desk.is-open")
    bands_and_doubts_are_above_the_fold(page)
    opened(served, page, 1.0)
    keys_belong_to_a_field(page)
    assert read_log(served.study / f"{KEY}.liex").entries == ()
    page.locator(".desk-stage").click()
    was = session(served).bouts["action"].tolist()
    words = page.locator(".desk-actions button").evaluate_all("all => all.map(a => a.dataset.word)")
    new = next(word for word in words if word not in was)
    expect(page.locator(".desk-actions button.is-now")).to_have_attribute("data-word", "walk")
    page.keyboard.press(str(words.index(new) + 1))
    expect(page.locator(".desk-actions button.is-now")).to_have_attribute("data-word", new)
    expect(page.locator(".desk-saved")).to_contain_text("1 correction stands, all saved")
    assert new in session(served).bouts["action"].tolist()
    expect(page.locator("#correct-made")).to_contain_text(f"is {new}")
    page.keyboard.press("u")
    expect(page.locator(".desk-saved")).to_contain_text("0 corrections stand, all saved")
    assert session(served).bouts["action"].tolist() == was
    page.keyboard.press("u")
    expect(page.locator(".desk-message")).to_contain_text("nothing of this visit is left")
    opened(served, page, 4.0)
    page.keyboard.press("[")  # a span of ten frames gets a bout of its own
    for _ in range(9):
        page.keyboard.press("ArrowRight")
    page.keyboard.press("]")
    expect(page.locator(".desk-message")).to_contain_text("marked 4.00 to 4.33 s")
    page.keyboard.press(str(words.index(new) + 1))
    expect(page.locator(".desk-saved")).to_contain_text("1 correction stands, all saved")
    bouts = session(served).bouts
    assert bouts[bouts["action"] == new]["duration_s"].tolist() == pytest.approx([1 / 3], abs=0.01)
    page.keyboard.press("f")  # head and tail: this session has nothing to make the track of again
    expect(page.locator(".desk-message.is-wrong")).to_be_visible()
    assert len(read_log(served.study / f"{KEY}.liex").standing) == 1
    assert fits_a_phone(page)
    watched.nothing_went_wrong()


def to_nose(served: Served) -> np.ndarray:
    """From rump to nose (n, 3), mm."""
    poses = session(served).poses.set_index("joint")[["x_mm", "y_mm", "z_mm"]]
    return np.asarray(poses.loc["nose"].to_numpy() - poses.loc["rump"].to_numpy())


@pytest.mark.nightly
def test_f_exchanges_head_and_tail_in_the_marked_span_and_u_takes_it_back(
    tracked: Served, watched: Watched
) -> None:
    page = watched.page
    stage = opened(tracked, page, 0.3)
    before, nose = to_nose(tracked), len(MOUSE.skeleton.names) - 1
    page.keyboard.press("x")
    expect(page.locator(".desk-message")).to_contain_text("there is no crossing")
    page.keyboard.press("[")
    for _ in range(8):
        page.keyboard.press("ArrowRight")
    page.keyboard.press("]")
    for _ in range(4):
        page.keyboard.press("ArrowLeft")
    nose_was = at_rest(page, stage, 13, nose)
    page.keyboard.press("f")
    expect(page.locator(".desk-message")).to_contain_text(
        "head and tail exchanged in frames 9 to 17"
    )
    expect(page.locator(".desk-saved")).to_contain_text("1 correction stands, all saved")
    expect(page.locator(".desk-message")).to_contain_text("disagrees with the frames around it")
    agree = np.sum(before * to_nose(tracked), axis=1)
    assert np.flatnonzero(agree < 0).tolist() == list(range(9, 18))
    until(page, lambda: joint_on_screen(page, stage, 13, nose) != pytest.approx(nose_was, abs=20.0))
    page.keyboard.press("x")
    expect(page.locator(".desk-message")).to_contain_text("head and tail exchanged by a person")
    page.keyboard.press("u")
    expect(page.locator(".desk-saved")).to_contain_text("0 corrections stand, all saved")
    np.testing.assert_array_equal(to_nose(tracked), before)
    watched.nothing_went_wrong()


@pytest.mark.nightly
def test_it_plays_at_the_pace_that_is_asked_for(served: Served, watched: Watched) -> None:
    page, asked = watched.page, list[str]()
    page.on("request", lambda request: asked.append(request.url.removeprefix(served.address)))
    opened(served, page, 0.0)
    images = [address for address in asked if "/frame/0.png" in address]
    assert images == [f"/desk/{KEY}/frame/0.png?box=0,0,65536,65536"]
    page.wait_for_selector("#frame-facts dd")
    assert asked.index(images[0]) < asked.index(f"/whole/{KEY}")  # the image before the figures
    assert asked.count(f"/desk/{KEY}/about") == 1
    clock = page.locator(".desk-clock")

    def now() -> float:
        return float(clock.inner_text().split(" ")[0])

    def told() -> float:
        return float(page.locator("#moment").input_value())

    page.keyboard.press(",")
    page.keyboard.press(",")
    expect(page.get_by_label("speed of playing")).to_have_value("0.25")
    page.keyboard.press(" ")
    expect(page.locator(".desk-play")).to_contain_text("Pause")
    until(page, lambda: now() > 0.1)
    began, at_s = time.monotonic(), now()
    until(page, lambda: now() > at_s + 0.15)
    pace = (now() - at_s) / (time.monotonic() - began)
    assert 0.05 < pace < 0.35  # a busy machine may be slower, never faster
    page.keyboard.press(" ")
    expect(page.locator(".desk-play")).to_contain_text("Play")
    stood = now()
    until(page, lambda: told() == pytest.approx(stood, abs=0.002))  # the curves follow
    page.keyboard.press("ArrowRight")
    until(page, lambda: now() == pytest.approx(stood + 1 / 30, abs=0.002))
    page.keyboard.press("ArrowLeft")
    until(page, lambda: now() == pytest.approx(stood, abs=0.002))
    page.get_by_label("speed of playing").select_option("4")
    page.keyboard.press(" ")
    until(page, lambda: now() == pytest.approx(float(MOUSE.times_s[-1]), abs=0.01))
    expect(page.locator(".desk-play")).to_contain_text("Play")  # it ends by itself
    watched.nothing_went_wrong()


@pytest.mark.nightly
def test_doubts_and_crossings_are_gone_to_one_after_the_other_and_stay_so(
    served: Served, watched: Watched
) -> None:
    put_flips(served.study / f"{KEY}.liex", FLIPS[:2] + FLIPS[3:])
    page, held = watched.page, list[Route]()
    page.route("**/crossings", lambda route: held.append(route))
    with page.expect_request("**/crossings"):
        opened(served, page, 0.0)
    page.keyboard.press("x")  # too early: gone to once it is found
    expect(page.locator(".desk-message")).to_contain_text("crossings are still being searched for")
    held.pop().continue_()
    expect(page.locator(".desk-message")).to_contain_text("crossing 1 of 3, 0.50 to 0.80 s")
    page.unroute("**/crossings")
    listed = page.locator(".desk-doubts li")
    expect(listed).to_have_count(2)
    assert "<b>walk</b> or pause?" in listed.nth(1).inner_text()  # names are text
    page.keyboard.press("n")
    expect(page.locator(".desk-message")).to_contain_text("0.50 to 1.00 s: walk or run?")
    expect(page.locator(".desk-clock")).to_contain_text("0.7")
    page.keyboard.press("k")
    expect(page.locator(".desk-message")).to_contain_text("4.00 to 4.50 s")
    expect(page.locator(".desk-side h3 .muted")).to_have_text("1 of 2 left")
    opened(served, page, 0.0)
    expect(page.locator(".desk-side h3 .muted")).to_have_text("1 of 2 left")
    page.keyboard.press("n")
    expect(page.locator(".desk-message")).to_contain_text("4.00 to 4.50 s")
    page.keyboard.press("k")
    expect(page.locator(".desk-message")).to_contain_text("all places in doubt have been reviewed")
    side, said = page.locator(".desk-side"), page.locator(".desk-message")
    expect(side.locator(".desk-crossings")).to_have_text("3 in all")
    page.keyboard.press("x")
    expect(said).to_contain_text("from the beginning again: crossing 1 of 3, 0.50 to 0.80 s")
    expect(page.locator(".desk-clock")).to_contain_text("0.500 s")
    side.get_by_role("button", name="Next crossing").click()
    expect(said).to_contain_text("crossing 2 of 3, 2.00 to 2.50 s: head and tail exchanged by a")
    page.keyboard.press("Shift+X")
    expect(said).to_contain_text("crossing 1 of 3")
    side.get_by_role("button", name="previous crossing").click()
    expect(said).to_contain_text("from the end again: crossing 3 of 3")
    watched.nothing_went_wrong()
