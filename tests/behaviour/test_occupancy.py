"""Time on the floor is neither lost nor made."""

from __future__ import annotations

import numpy as np
import pytest

from liex_lab.behaviour.places import hold_times, occupancy


@pytest.mark.parametrize("sd_mm", [0.0, 5.0, 40.0])
def test_the_cells_add_up_to_the_observed_time(sd_mm):
    rng = np.random.default_rng(0)
    xy = rng.uniform(-120.0, 120.0, (500, 2))
    xy[100:150] = np.nan
    hold = rng.uniform(0.01, 0.1, 500)
    found = occupancy(xy, hold, [-120.0, -120.0], [120.0, 120.0], sd_mm)
    seen = np.isfinite(xy).all(axis=1)
    assert found.n == 450
    assert found.observed_s == pytest.approx(hold[seen].sum())
    area = np.outer(np.diff(found.y_mm), np.diff(found.x_mm)) / 100.0
    assert (found.per_cm2 * area).sum() == pytest.approx(found.observed_s)


def test_a_place_outside_of_the_rectangle_widens_it():
    found = occupancy([[500.0, 0.0]], [2.0], [-100.0, -100.0], [100.0, 100.0])
    assert found.observed_s == pytest.approx(2.0)
    assert found.x_mm[-1] >= 500.0


def test_where_it_sat_is_the_fullest_cell():
    xy = np.array([[10.0, -40.0]] * 50 + [[-60.0, 60.0]] * 5)
    found = occupancy(xy, np.full(55, 0.1), [-100.0, -100.0], [100.0, 100.0])
    row, column = np.unravel_index(found.time_s.argmax(), found.time_s.shape)
    assert found.x_mm[column] <= 10.0 + 5.0 <= found.x_mm[column + 1] + 5.0
    assert found.y_mm[row] - 5.0 <= -40.0 <= found.y_mm[row + 1] + 5.0


def test_nobody_seen_is_no_time_and_no_error():
    found = occupancy(np.full((3, 2), np.nan), np.ones(3), [0.0, 0.0], [10.0, 10.0])
    assert (found.n, found.observed_s) == (0, 0.0)


def test_the_last_frame_and_one_before_a_gap_count_as_long_as_usual():
    np.testing.assert_allclose(hold_times([0.0, 0.1, 0.2, 5.0, 5.1]), [0.1, 0.1, 0.1, 0.1, 0.1])
