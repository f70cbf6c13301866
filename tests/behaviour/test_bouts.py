"""Rearing is counted, pauses and runs are told apart, and no bout crosses a gap."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from liex_lab.actions.vocabulary import MEASURES, WORDS
from liex_lab.behaviour import MouseRules, find_bouts
from liex_lab.behaviour.bouts import _READ, BoutReader, hysteresis, measure_bouts, recognise, tidy
from liex_lab.behaviour.kinematics import Joints, kinematics
from liex_lab.plan import Plan
from liex_lab.tables.rows import Rows, bout_rows, stop_times
from tests.actions.toy import going_and_staying, taught_to_lie
from tests.behaviour.test_kinematics import tables_of
from tests.behaviour.test_summary import named
from tests.sessions.walking_mouse import WalkingMouse, steady


def bouts_of(mouse: WalkingMouse, rules: MouseRules | None = None) -> pd.DataFrame:
    frames, poses = tables_of(mouse)
    return find_bouts(frames, kinematics(frames, poses), rules)


def test_a_rear_is_found_once_with_its_rise_and_its_fall():
    bouts = bouts_of(WalkingMouse(steady(4.0), rear_s=(1.0, 2.2)))
    assert list(bouts["action"]) == ["walk", "rear", "walk"]
    rear = bouts.iloc[1]
    assert rear["start_s"] == pytest.approx(
        1.04, abs=0.04
    )  # half of 0.4 lengths is reached 0.03 s into the rise
    assert rear["stop_s"] == pytest.approx(2.18, abs=0.04)
    assert rear["duration_s"] == pytest.approx(rear["stop_s"] - rear["start_s"])
    assert rear["peak_nose_height_mm"] > 80
    assert rear["path_mm"] == pytest.approx(200 * rear["duration_s"], rel=1e-2)
    assert (bouts["source"] == "rule").all()


@pytest.mark.parametrize(("speed", "word"), [(20.0, "pause"), (150.0, "walk"), (400.0, "run")])
def test_speed_names_the_stretch(speed, word):
    bouts = bouts_of(WalkingMouse(steady(2.0), speed_mm_s=speed, radius_mm=400.0))
    assert list(bouts["action"]) == [word]
    assert bouts["start_s"].iloc[0] == 0.0
    assert bouts["stop_s"].iloc[0] == pytest.approx(2.0)
    assert (bouts["start_frame"].iloc[0], bouts["stop_frame"].iloc[0]) == (0, 60)
    assert bouts["mean_speed_mm_s"].iloc[0] == pytest.approx(speed, rel=1e-2)
    assert bouts["net_turn_rad"].iloc[0] == pytest.approx(speed / 400.0 * 59 / 30, rel=1e-3)


@pytest.mark.parametrize(
    ("speed", "words"), [(5.0, ["pause", "groom", "pause"]), (30.0, ["pause"])]
)
def test_a_hunched_animal_grooms_if_it_stays_where_it_is(speed, words):
    frames, poses = tables_of(WalkingMouse(steady(3.0), speed_mm_s=speed, radius_mm=400.0))
    moved = kinematics(frames, poses)
    moved.loc[30:60, "reach_mm"] = 0.65 * frames["spine_mm"].median()
    assert list(find_bouts(frames, moved)["action"]) == words


def test_a_bout_ends_at_a_gap_one_step_after_its_last_frame():
    bouts = bouts_of(WalkingMouse(np.delete(steady(2.0), slice(30, 40))))
    assert list(bouts["action"]) == ["walk", "walk"]
    assert bouts["stop_s"].iloc[0] == pytest.approx(1.0, abs=1e-6)
    assert bouts["start_s"].iloc[1] == pytest.approx(40 / 30, abs=1e-6)
    assert bouts["duration_s"].sum() == pytest.approx(50 / 30, abs=1e-6)


def test_a_small_animal_rears_at_a_share_of_its_length_and_a_large_one_at_40_mm():
    rules = MouseRules()
    assert rules.rear_mm(110.0) == 40.0
    assert rules.rear_mm(52.0) == pytest.approx(20.8)
    assert "40 mm" in rules.definitions()["rear"]


def test_the_rules_take_the_thresholds_of_a_plan():
    settings = Plan().behaviour.model_dump()
    assert MouseRules(**settings) == MouseRules()
    fast = MouseRules(**{**settings, "pause_below_mm_s": 250.0})
    assert list(bouts_of(WalkingMouse(steady(2.0), speed_mm_s=200.0), fast)["action"]) == ["pause"]


def test_hysteresis_takes_the_flanks_but_no_bump_that_stays_below():
    values = np.array([0, 6, 9, 11, 9, 6, 0, 9, 9, 0, 12, 0.0])
    inside = hysteresis(values, 10.0, 8.0, np.zeros(12, np.int64))
    assert list(np.flatnonzero(inside)) == [2, 3, 4, 10]
    parted = hysteresis(values, 10.0, 8.0, np.array([0, 0, 0] + [1] * 9))
    assert list(np.flatnonzero(parted)) == [3, 4, 10]  # what lies across a gap is another stretch


def test_short_pauses_are_bridged_before_short_bouts_are_dropped():
    time: np.ndarray = np.arange(40) * 0.1
    mask = np.zeros(40, bool)
    mask[[0, 1, 4, 5, 10, 20, 21, 22]] = True  # 0-0.2, 0.4-0.6 | 1.0-1.1 | 2.0-2.3
    bouts = list(
        tidy(
            mask,
            np.ones(40, bool),
            np.zeros(40, np.int64),
            time,
            stop_times(time),
            0.33,
            0.23,
        )
    )
    assert bouts == [(0, 6), (20, 23)]
    taken = np.ones(40, bool)
    taken[2:4] = False  # another action holds the frames between
    bouts = list(tidy(mask, taken, np.zeros(40, np.int64), time, stop_times(time), 0.33, 0.23))
    assert bouts == [(20, 23)]


# No bout that a model named contradicts its printed definition; a person's is only flagged.


PRINTED = {word: one.printed for word, one in WORDS["mouse"].items()}


def check_of(mouse: WalkingMouse) -> BoutReader:
    return BoutReader(kinematics(*tables_of(mouse)), PRINTED)


def test_every_measure_that_a_definition_bounds_can_be_read() -> None:
    assert set(_READ) == set(MEASURES)


@pytest.mark.parametrize(
    ("speed_mm_s", "kept", "broken"),
    [
        (20.0, {"pause", "stretch_attend", "sniff"}, {"walk", "run", "dart"}),
        (120.0, {"walk"}, {"pause", "stretch_attend", "sniff", "freeze", "run", "dart"}),
        (400.0, {"run"}, {"walk", "pause", "turn_left"}),
    ],
)
def test_speed_decides_as_the_definitions_say(
    speed_mm_s: float, kept: set[str], broken: set[str]
) -> None:
    check = check_of(WalkingMouse(steady(4.0), speed_mm_s=speed_mm_s))
    for word in kept:
        assert check.broken(10, 25, word) == "", word
    for word in broken:
        assert "cm/s" in check.broken(10, 25, word) or "duration" in check.broken(10, 25, word)


def test_a_turn_to_the_other_side_or_a_small_one_is_none() -> None:
    mouse = WalkingMouse(steady(4.0), speed_mm_s=140.0, radius_mm=80.0)  # 100 degrees/s to its left
    check = check_of(mouse)
    assert check.broken(10, 40, "turn_left") == ""
    assert "net turn to its right -" in check.broken(10, 40, "turn_right")
    assert "not at least 30 degrees" in check.broken(10, 16, "turn_left")


def test_a_rear_needs_a_raised_nose() -> None:
    check = check_of(WalkingMouse(steady(6.0), rear_s=(2.0, 4.0)))
    assert check.broken(66, 110, "rear_supported") == ""
    assert "nose" in check.broken(130, 160, "rear_unsupported")


def test_a_bout_that_a_person_named_stays_and_says_what_does_not_hold() -> None:
    mouse = WalkingMouse(steady(4.0), speed_mm_s=120.0)
    bouts = named(mouse, ("pause", 1.0, 2.0), ("walk", 2.0, 3.0)).assign(source="human")
    found = measure_bouts(bouts, kinematics(*tables_of(mouse)), PRINTED)
    assert list(found["action"]) == ["pause", "walk"]
    assert list(found["contradicts"]) == ["mean and median speed 12 cm/s, not at most 5 cm/s", ""]
    unchecked = measure_bouts(bouts, kinematics(*tables_of(mouse)))
    assert list(unchecked["contradicts"]) == ["", ""]


def test_a_recogniser_cannot_name_what_contradicts_its_words() -> None:
    liar, one = taught_to_lie(), going_and_staying(11)
    free = liar.recognise(one.track)
    assert "pause" in {bout.action for bout in free.ethogram}
    found = recognise(liar, one.track)
    assert {refusal.action for refusal in found.refused} >= {"pause"}
    assert all(refusal.why for refusal in found.refused)
    rows = Rows(one.track, np.arange(one.track.n_frames), "toy", "mouse_1")
    frames = rows.frames_table
    moved = kinematics(*tables_of_track(rows))
    bouts = measure_bouts(bout_rows(found.ethogram, frames, "abc"), moved, PRINTED)
    assert set(bouts["contradicts"]) <= {""}
    before = measure_bouts(bout_rows(free.ethogram, frames, "abc"), moved, PRINTED)
    assert (before["contradicts"] != "").any()


def tables_of_track(rows: Rows) -> tuple[pd.DataFrame, Joints]:
    return rows.frames_table, Joints.of_track(rows.track)


def test_words_of_ones_own_are_not_checked() -> None:
    own = replace(taught_to_lie(), definitions={"pause": "my pause", "freeze": ""})
    one = going_and_staying(12)
    assert recognise(own, one.track).refused == ()
    assert recognise(own, one.track).ethogram == own.recognise(one.track).ethogram


def test_a_rear_is_raised_above_the_usual_tail_base_and_not_that_of_one_frame() -> None:
    mouse = WalkingMouse(steady(4.0))
    frames, poses = tables_of(mouse)
    poses = poses.copy()
    sunk = (poses["joint"] == "rump") & poses["time_s"].between(1.0, 2.0)
    poses.loc[sunk, "z_mm"] -= 60.0
    assert "rear" not in set(find_bouts(frames, kinematics(frames, poses))["action"])
