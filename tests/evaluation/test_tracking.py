"""The figures of tracking, on tracks whose every error is known."""

from __future__ import annotations

import numpy as np
import pytest

from liex_lab.evaluation.tracking import Followed, figures
from liex_lab.simulation.corruptions import Event

N, J = 40, 5
TRUTH = np.zeros((N, J, 3))
TRUTH[..., 0] = 10.0 * np.arange(J)


def followed(off_mm: np.ndarray, sd_mm: float = 1.0) -> Followed:
    """Every joint is off by so much along y."""
    joints = TRUTH.copy()
    joints[..., 1] += off_mm[:, None]
    return Followed(joints, TRUTH, np.full((N, J, 3), sd_mm), 100.0)


def test_errors_ratios_and_losses_are_counted_over_the_right_frames():
    alone = np.full(N, 4.0)
    alone[:4] = np.nan
    mine = np.full(N, 1.0)
    mine[:2], mine[2:4] = np.nan, 9.0
    result = figures([followed(mine)], [followed(alone)], [[]], 40.0)
    assert result["mean_joint_error_mm"] == pytest.approx(np.nanmean(mine))
    assert result["ratio_to_single"] == pytest.approx(0.25), (
        "frames that the single frames lost do not count there"
    )
    assert result["lost_rate"] == pytest.approx(2 / N)
    assert result["longest_flip_frames"] == 0
    assert result["recovery_frames"] is None


def test_a_flip_is_counted_in_frames_in_a_row():
    row = followed(np.zeros(N))
    row.joints[[3, 10, 11, 12, 20]] = TRUTH[0, ::-1]
    assert figures([row], [row], [[]], 40.0)["longest_flip_frames"] == 3


def test_intervals_cover_what_lies_within_them():
    row = followed(np.where(np.arange(N) < 10, 2.0, 1.0), sd_mm=1.0)
    # of three coordinates one is off, by twice its sd in a quarter of the frames
    assert figures([row], [row], [[]], 40.0)["interval90_coverage"] == pytest.approx(1 - 0.25 / 3)


def test_recovery_counts_from_the_end_of_the_worst_occlusion():
    off = np.zeros(N)
    off[5:14], off[20:22] = 30.0, np.nan
    events = [Event("hidden", 5, 10), Event("holes", 18, 22), Event("hidden", 19, 20)]
    assert figures([followed(off)], [followed(off)], [events], 40.0)["recovery_frames"] == 4
    off[5:] = 30.0
    assert figures([followed(off)], [followed(off)], [events], 40.0)["recovery_frames"] == 30


def test_a_row_that_never_finds_the_animal_has_only_that_to_say():
    assert figures([followed(np.full(N, np.nan))], [followed(np.zeros(N))], [[]], 40.0) == {
        "lost_rate": 1.0
    }


def test_who_gives_up_frames_in_view_gains_nothing_by_it():
    sure, shy = np.full(N, 4.0), np.full(N, 1.0)
    shy[10:20] = np.nan
    events = [Event("hidden", 10, 15)]
    result = figures([followed(shy)], [followed(sure)], [events], 40.0)
    # of 35 frames in view five have no pose, which is an error of 20 mm
    assert result["in_view_ratio"] == pytest.approx((30 * 1.0 + 5 * 20.0) / 35 / 4.0)
    assert result["in_view_p95_ratio"] == pytest.approx(5.0)
    assert result["ratio_to_single"] == pytest.approx(0.25)
