"""Scores against truth agree with what a reader works out by hand."""

from typing import Any

import numpy as np
import pytest

from liex_lab.evaluation.scores import (
    Followed,
    MeasuredIndividual,
    PoseErrors,
    Tally,
    interval95,
    matched,
    tracking_figures,
)
from liex_lab.simulation.corruptions import Event
from liex_lab.simulation.recording import TrueAnimal

# single frames


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


def test_the_summary_agrees_with_hand_computed_numbers():
    errors = five_frames()
    np.testing.assert_allclose(errors.error_mm, [1, 2, 4, 40 / 3, np.nan])
    np.testing.assert_allclose(errors.joint_mm[3], [20, 0, 20])
    np.testing.assert_allclose(errors.low_mm[:4], [0.6, 2.4, 1.8, 12.0])
    np.testing.assert_allclose(errors.high_mm[:4], [1.5, 6.0, 4.5, 30.0])
    expected = {
        "mean_joint_error_mm": (1 + 2 + 4 + 40 / 3) / 4,
        "median_joint_error_mm": 3.0,
        "p95_joint_error_mm": 4 + 0.85 * (40 / 3 - 4),
        "flip_rate": 0.25,
        "lost_rate": 0.2,
        "spearman_predicted_error": 0.8,  # ranks 1 3 2 4 against 1 2 3 4
        "interval90_coverage": 0.75,  # 2 mm lies below its interval
    }
    assert errors.summary() == pytest.approx(expected)
    both = PoseErrors.join([errors, errors])
    assert both.joint_mm.shape == (10, 3)
    assert both.summary()["p95_joint_error_mm"] > expected["p95_joint_error_mm"]


# intervals by bootstrap over recordings


def test_frames_of_one_recording_do_not_count_as_many_animals():
    rng = np.random.default_rng(5)
    recording = np.repeat(np.arange(10), 100)
    error = rng.normal(0.0, 1.0, 10)[recording] + rng.normal(0.0, 0.01, 1000)
    low, high = interval95(error, recording, np.mean) or (0.0, 0.0)
    assert high - low > 0.6  # it would be 0.12 for 1000 independent frames


def test_lost_frames_are_left_out_and_one_recording_has_no_interval():
    recording = np.array([0, 0, 1, 1])
    error = np.array([1.0, np.nan, 2.0, np.nan])
    assert interval95(error, recording) == (1.0, 2.0)
    assert interval95(error[:2], recording[:2]) is None


# tracks whose every error is known

N, J = 40, 5
TRUTH = np.zeros((N, J, 3))
TRUTH[..., 0] = 10.0 * np.arange(J)


def followed(off_mm: np.ndarray, sd_mm: float = 1.0) -> Followed:
    """Every joint is off by so much along y."""
    joints = TRUTH.copy()
    joints[..., 1] += off_mm[:, None]
    return Followed(joints, TRUTH, np.full((N, J, 3), sd_mm), 100.0)


def figures_of(row: Followed, single: Followed | None = None, *events: Event) -> dict[str, Any]:
    return tracking_figures([row], [single or row], [events], 40.0)


def test_errors_ratios_and_losses_are_counted_over_the_right_frames():
    alone, mine = np.full(N, 4.0), np.full(N, 1.0)
    alone[:4] = np.nan
    mine[:2], mine[2:4] = np.nan, 9.0
    result = figures_of(followed(mine), followed(alone))
    assert result["mean_joint_error_mm"] == pytest.approx(np.nanmean(mine))
    assert result["ratio_to_single"] == pytest.approx(0.25), "lost single frames do not count"
    assert result["lost_rate"] == pytest.approx(2 / N)
    assert result["longest_flip_frames"] == 0
    assert result["recovery_frames"] is None
    nowhere = followed(np.full(N, np.nan))
    assert figures_of(nowhere, followed(mine)) == {"lost_rate": 1.0}


def test_a_flip_is_counted_in_frames_in_a_row_and_intervals_by_coordinate():
    row = followed(np.where(np.arange(N) < 10, 2.0, 1.0))
    # of three coordinates one is off, by twice its sd in a quarter of the frames
    assert figures_of(row)["interval90_coverage"] == pytest.approx(1 - 0.25 / 3)
    row.joints[[3, 10, 11, 12, 20]] = TRUTH[0, ::-1]
    assert figures_of(row)["longest_flip_frames"] == 3


def test_recovery_counts_from_the_end_of_the_worst_occlusion():
    off = np.zeros(N)
    off[5:14], off[20:22] = 30.0, np.nan
    events = [Event("hidden", 5, 10), Event("holes", 18, 22), Event("hidden", 19, 20)]
    assert figures_of(followed(off), None, *events)["recovery_frames"] == 4
    off[5:] = 30.0
    assert figures_of(followed(off), None, *events)["recovery_frames"] == 30


def test_giving_up_frames_in_view_gains_nothing():
    sure, shy = np.full(N, 4.0), np.full(N, 1.0)
    shy[10:20] = np.nan
    result = figures_of(followed(shy), followed(sure), Event("hidden", 10, 15))
    # of 35 frames in view five have no pose, which is an error of 20 mm
    assert result["in_view_ratio"] == pytest.approx((30 * 1.0 + 5 * 20.0) / 35 / 4.0)
    assert result["in_view_p95_ratio"] == pytest.approx(5.0)
    assert result["ratio_to_single"] == pytest.approx(0.25)


# scenes: what counts as found, as hidden, and as wrong but trusted

M = 10
SPINE = 60.0


def joints(x: float = 0.0) -> np.ndarray:
    """A straight animal (M, 3, 3) along x, in every frame the same."""
    one = np.array([[0.0, 0.0, 700.0], [30.0, 0.0, 700.0], [60.0, 0.0, 700.0]])
    return np.tile(one + np.array([x, 0.0, 0.0]), (M, 1, 1))


def truth(x: float = 0.0, visible: float = 1.0) -> TrueAnimal:
    return TrueAnimal(SPINE, joints(x), np.full(M, visible))


def one(x: float = 0.0, trusted: bool = True) -> MeasuredIndividual:
    return MeasuredIndividual(joints(x), np.full(M, trusted))


def scene(
    truths: list[TrueAnimal], individuals: list[MeasuredIndividual], fits: bool = True
) -> dict:
    tally = Tally()
    tally.add(truths, individuals, M, fits=fits)
    return tally.figures()


def test_a_right_pose_is_found_and_right():
    assert scene([truth()], [one(3.0)]) == {
        "n_frames": M,
        "found": 1.0,
        "mean_joint_error_mm": pytest.approx(3.0),
        "median_joint_error_mm": pytest.approx(3.0),
        "flips": 0.0,
        "hidden_right": None,
        "trusted": 1.0,
        "wrong_but_trusted": 0.0,
    }
    turned = MeasuredIndividual(joints()[:, ::-1].copy(), np.ones(M, np.bool_))
    assert scene([truth()], [turned])["flips"] == 1.0


@pytest.mark.parametrize(
    ("truths", "individuals", "fits", "name", "value"),
    [
        ([truth()], [one(8.9)], True, "wrong_but_trusted", 0.0),
        ([truth()], [one(9.1)], True, "wrong_but_trusted", 1.0),  # beyond 15 % of the spine
        ([truth()], [one(9.1, trusted=False)], True, "wrong_but_trusted", 0.0),
        ([truth()], [], True, "found", 0.0),  # refused
        ([truth()], [], True, "mean_joint_error_mm", None),
        ([truth()], [], True, "wrong_but_trusted", 0.0),
        ([], [one()], True, "found", None),  # there is no animal
        ([], [one()], True, "wrong_but_trusted", 1.0),
        ([truth()], [one()], False, "found", None),  # an animal of another kind than the plan's
        ([truth()], [one()], False, "wrong_but_trusted", 1.0),
        ([truth(visible=0.1)], [one()], True, "hidden_right", 0.0),
        ([truth(visible=0.1)], [one(trusted=False)], True, "hidden_right", 1.0),
        ([truth(visible=0.1)], [], True, "hidden_right", 1.0),
        ([truth(visible=0.1)], [one()], True, "found", None),
        ([truth(), truth(300.0)], [one(301.0), one(2.0)], True, "mean_joint_error_mm", 1.5),
        ([truth(), truth(300.0)], [one(301.0)], True, "found", 0.5),
        ([truth(), truth(300.0)], [one(301.0)], True, "wrong_but_trusted", 0.0),
        ([truth(), truth(300.0)], [one(301.0), one(2.0), one(900.0)], True, "trusted", 3.0),
        (
            [truth(), truth(300.0)],
            [one(301.0), one(2.0), one(900.0)],
            True,
            "wrong_but_trusted",
            1 / 3,
        ),
    ],
)
def test_what_counts_in_a_scene(truths, individuals, fits, name, value):
    found = scene(truths, individuals, fits)[name]
    assert found == (value if value is None else pytest.approx(value))


def test_an_animal_that_is_not_there_makes_trusted_frames_wrong_and_recordings_add_up():
    half = truth()
    half.joints_camera[: M // 2] = np.nan
    half.visible[: M // 2] = 0.0
    assert scene([half], [one()])["wrong_but_trusted"] == pytest.approx(0.5)
    assert matched([truth(0.0), truth(300.0)], [one(301.0), one(2.0)]) == {0: 1, 1: 0}
    tally = Tally()
    tally.add([truth()], [one(2.0)], M)
    tally.add([truth()], [], M)
    row = tally.figures()
    assert (row["n_frames"], row["found"], row["trusted"]) == (2 * M, 0.5, 0.5)
