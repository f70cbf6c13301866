"""Rearing is counted, pauses and runs are told apart, and no bout crosses a gap."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from liex_lab.behaviour import MouseRules, find_bouts
from liex_lab.behaviour.bouts import hysteresis, tidy
from liex_lab.behaviour.kinematics import kinematics
from liex_lab.plan import Plan
from liex_lab.tables.rows import stop_times
from tests.behaviour.test_kinematics import tables_of
from tests.sessions.walking_mouse import WalkingMouse, steady


def bouts_of(mouse: WalkingMouse, rules: MouseRules | None = None) -> pd.DataFrame:
    frames, poses = tables_of(mouse)
    return find_bouts(frames, kinematics(frames, poses), rules)


def test_a_rear_is_found_once_with_its_rise_and_its_fall():
    bouts = bouts_of(WalkingMouse(steady(4.0), rear_s=(1.0, 2.2)))
    assert list(bouts["action"]) == ["walk", "rear", "walk"]
    rear = bouts.iloc[1]
    assert rear["start_s"] == pytest.approx(
        1.06, abs=0.04
    )  # two thirds of 40 mm are reached 0.05 s into the rise
    assert rear["stop_s"] == pytest.approx(2.15, abs=0.04)
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


def test_bouts_are_half_open_ordered_and_do_not_overlap():
    mouse = WalkingMouse(
        np.delete(steady(6.0), slice(100, 104)), rear_s=(1.0, 2.0), lost=(120, 121)
    )
    bouts = bouts_of(mouse)
    assert (bouts["stop_s"].to_numpy()[:-1] <= bouts["start_s"].to_numpy()[1:] + 1e-9).all()
    assert (bouts["stop_frame"].to_numpy()[:-1] <= bouts["start_frame"].to_numpy()[1:]).all()
    assert (bouts["stop_s"] > bouts["start_s"]).all()


def test_a_bout_ends_at_a_gap_one_step_after_its_last_frame():
    bouts = bouts_of(WalkingMouse(np.delete(steady(2.0), slice(30, 40))))
    assert list(bouts["action"]) == ["walk", "walk"]
    assert bouts["stop_s"].iloc[0] == pytest.approx(1.0, abs=1e-6)
    assert bouts["start_s"].iloc[1] == pytest.approx(40 / 30, abs=1e-6)
    assert bouts["duration_s"].sum() == pytest.approx(50 / 30, abs=1e-6)


def test_a_small_animal_rears_at_a_share_of_its_length_and_a_large_one_at_40_mm():
    rules = MouseRules()
    assert rules.rear_mm(90.0) == 40.0
    assert rules.rear_mm(52.0) == pytest.approx(31.2)
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
        tidy(mask, np.ones(40, bool), np.zeros(40, np.int64), time, stop_times(time), MouseRules())
    )
    assert bouts == [(0, 6), (20, 23)]
    taken = np.ones(40, bool)
    taken[2:4] = False  # another action holds the frames between
    bouts = list(tidy(mask, taken, np.zeros(40, np.int64), time, stop_times(time), MouseRules()))
    assert bouts == [(20, 23)]


def test_an_animal_that_is_never_seen_has_no_bouts():
    bouts = bouts_of(WalkingMouse(steady(1.0), lost=tuple(range(30))))
    assert len(bouts) == 0
    assert "peak_speed_mm_s" in bouts.columns
