"""The row a biologist reads first adds up."""

from __future__ import annotations

import numpy as np
import pytest

from liex_lab.behaviour import ACTIONS, measure
from liex_lab.behaviour.summary_columns import summary_columns
from tests.behaviour.test_kinematics import tables_of
from tests.sessions.walking_mouse import SPINE_MM, WalkingMouse, steady


def summary_of(mouse: WalkingMouse):
    return measure(*tables_of(mouse)).summary.iloc[0]


def test_distance_speed_and_rearing_of_a_known_walk():
    row = summary_of(WalkingMouse(steady(10.0), speed_mm_s=200.0, rear_s=(4.0, 6.0)))
    assert row["distance_m"] == pytest.approx(2.0, rel=1e-3)
    assert row["mean_speed_mm_s"] == pytest.approx(200.0, rel=1e-3)
    assert row["median_speed_mm_s"] == pytest.approx(200.0, rel=1e-3)
    assert row["rear_count"] == 1
    assert row["rear_s"] == pytest.approx(1.9, abs=0.1)
    assert row["distance_moving_m"] == pytest.approx(0.2 * row["walk_s"], rel=1e-3)
    assert row["spine_mm"] == pytest.approx(SPINE_MM)
    assert row["duration_s"] == pytest.approx(10.0, abs=1e-6)


def test_the_time_budget_is_of_the_observed_time_and_adds_up():
    times = np.delete(steady(10.0), slice(100, 130))
    row = summary_of(WalkingMouse(times, rear_s=(6.0, 7.0), lost=tuple(range(30, 60))))
    assert row["n_frames"] == 270
    assert row["n_lost"] == 30
    assert row["duration_s"] == pytest.approx(10.0, abs=1e-6)
    assert row["observed_s"] == pytest.approx(8.0, abs=1e-6)
    words = [*ACTIONS, "unlabelled"]
    assert sum(row[f"{word}_s"] for word in words) == pytest.approx(row["observed_s"])
    assert sum(row[f"{word}_share"] for word in words) == pytest.approx(1.0)


def test_an_animal_never_seen_has_a_row_that_says_so():
    row = summary_of(WalkingMouse(steady(1.0), lost=tuple(range(30))))
    assert (row["n_lost"], row["observed_s"], row["rear_count"]) == (30, 0.0, 0)
    assert np.isnan(row["mean_speed_mm_s"])


def test_the_row_has_the_listed_columns():
    summary = measure(*tables_of(WalkingMouse(steady(1.0)))).summary
    assert list(summary.columns) == [column.name for column in summary_columns(ACTIONS)]
    assert len(summary) == 1
