"""The figures of an evaluation agree with what a reader works out by hand."""

from __future__ import annotations

import numpy as np
import pytest

from liex_lab.evaluation.pose import (
    PoseErrors,
    angle_between_axes,
    count_reversals,
    rank_correlation,
)

KEYS = [
    "mean_joint_error_mm",
    "median_joint_error_mm",
    "p95_joint_error_mm",
    "flip_rate",
    "lost_rate",
    "spearman_predicted_error",
    "interval90_coverage",
]


def line(*x: float, n_joints: int = 3) -> np.ndarray:
    """Animals (n, J, 3) along x whose joints stand 10 mm apart, the base at x."""
    joints = np.zeros((len(x), n_joints, 3))
    joints[:, :, 0] = np.array(x)[:, None] + 10.0 * np.arange(n_joints)
    return joints


def five_frames() -> PoseErrors:
    """Off by 1, 2 and 4 mm, turned round, and lost."""
    true = line(0, 0, 0, 0, 0)
    measured = line(1, 2, 0, 0, 0)
    measured[2, :, 1] = 4.0
    measured[3] = measured[3, ::-1]  # the middle joint stays, the ends are 20 mm off
    measured[4] = np.nan
    predicted = np.array([1.0, 4.0, 3.0, 20.0, np.nan])
    return PoseErrors.compare(measured, true, 2, predicted, np.array([0.6, 1.5]))


def test_errors_of_each_joint_and_frame_are_distances():
    errors = five_frames()
    np.testing.assert_allclose(errors.error_mm, [1, 2, 4, 40 / 3, np.nan])
    np.testing.assert_allclose(errors.joint_mm[3], [20, 0, 20])
    assert errors.flipped.tolist() == [False, False, False, True, False]
    np.testing.assert_allclose(errors.low_mm[:4], [0.6, 2.4, 1.8, 12.0])
    np.testing.assert_allclose(errors.high_mm[:4], [1.5, 6.0, 4.5, 30.0])


def test_the_summary_agrees_with_hand_computed_numbers():
    summary = five_frames().summary()
    assert list(summary) == KEYS
    assert summary["mean_joint_error_mm"] == pytest.approx((1 + 2 + 4 + 40 / 3) / 4)
    assert summary["median_joint_error_mm"] == pytest.approx(3.0)
    assert summary["p95_joint_error_mm"] == pytest.approx(4 + 0.85 * (40 / 3 - 4))
    assert summary["flip_rate"] == 0.25
    assert summary["lost_rate"] == pytest.approx(0.2)
    assert summary["interval90_coverage"] == 0.75  # 2 mm lies below its interval
    assert summary["spearman_predicted_error"] == pytest.approx(
        0.8
    )  # ranks 1 3 2 4 against 1 2 3 4
    assert all(isinstance(value, float) for value in summary.values())


def test_errors_of_two_recordings_join_into_one():
    one, two = five_frames(), five_frames()
    both = PoseErrors.join([one, two])
    np.testing.assert_array_equal(both.error_mm, np.concatenate([one.error_mm, two.error_mm]))
    assert both.joint_mm.shape == (10, 3)
    assert both.summary()["mean_joint_error_mm"] == pytest.approx(
        one.summary()["mean_joint_error_mm"]
    )


def test_the_summary_of_a_recording_without_a_measured_frame_has_the_same_names():
    nothing = np.full((4, 3, 3), np.nan)
    errors = PoseErrors.compare(
        nothing, line(0, 0, 0, 0), 2, np.full(4, np.nan), np.array([0.5, 2.0])
    )
    summary = errors.summary()
    assert list(summary) == KEYS
    assert summary.pop("lost_rate") == 1.0
    assert set(summary.values()) == {None}


@pytest.mark.parametrize(
    ("b", "rho"), [([1, 4, 9, 16], 1.0), ([16, 9, 4, 1], -1.0), ([2, 1, 4, 3], 0.6)]
)
def test_rank_correlation_looks_at_order_alone(b, rho):
    assert rank_correlation(np.array([1.0, 2.0, 3.0, 4.0]), np.array(b, float)) == pytest.approx(
        rho
    )


@pytest.mark.parametrize(
    ("a", "b", "degrees"),
    [
        (0, 0, 0),
        (0, 180, 0),
        (10, 350, 20),
        (10, 170, 20),
        (0, 90, 90),
        (5, 94, 89),
        (-100, 85, 5),
        (725, 7, 2),
    ],
)
def test_two_axes_differ_by_a_right_angle_at_most(a, b, degrees):
    both = np.radians([a]), np.radians([b])
    assert np.degrees(angle_between_axes(*both)) == pytest.approx(degrees, abs=1e-9)
    assert np.degrees(angle_between_axes(*both[::-1])) == pytest.approx(degrees, abs=1e-9)


def test_an_unknown_axis_stays_unknown():
    assert np.isnan(angle_between_axes(np.array([np.nan]), np.array([1.0]))).all()


@pytest.mark.parametrize(
    ("degrees", "expected"),
    [
        ([0, 10, 20, 30], 0),
        ([0, 180, 0, 0], 2),
        ([0, 89, 178, 267, 356], 0),
        ([0, 91, 91, 0], 2),
        ([170, -170, 175], 0),  # over the seam, not round
        ([0, np.nan, np.nan, 180, 180], 1),
        ([np.nan, np.nan], 0),
        ([5], 0),
        ([], 0),
    ],
)
def test_a_reversal_is_a_turn_of_more_than_a_right_angle_between_measured_frames(degrees, expected):
    assert count_reversals(np.radians(np.array(degrees, float))) == expected
