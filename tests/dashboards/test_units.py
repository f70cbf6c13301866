"""People read cm/s, degrees and whole words."""

from __future__ import annotations

import numpy as np
import pytest
from liex_lab.dashboards.units import counted, shown, titled


def test_speeds_and_angles_are_shown_in_cm_s_and_degrees() -> None:
    value, unit = shown(120.0, "mm/s")
    assert (value, unit) == (pytest.approx(12.0), "cm/s")
    angles, unit = shown(np.array([np.pi, -np.pi / 2]), "rad")
    assert unit == "°"
    np.testing.assert_allclose(angles, [180.0, -90.0])
    assert shown(3, "") == (3, "")
    assert shown(62.9, "mm") == (62.9, "mm")


def test_a_column_is_titled_without_its_unit() -> None:
    assert titled("mean_speed_mm_s", "mm/s") == "mean speed"
    assert titled("mean_abs_yaw_rate_rad_s", "rad/s") == "mean abs yaw rate"
    assert titled("n_lost", "") == "n lost"
    assert titled("distance_m", "m") == "distance"


def test_one_thing_is_not_several() -> None:
    assert counted(1, "stretch", "stretches") == "1 stretch"
    assert counted(2, "stretch", "stretches") == "2 stretches"
    assert counted(1200, "frame") == "1,200 frames"
    assert counted(0, "gap") == "0 gaps"
