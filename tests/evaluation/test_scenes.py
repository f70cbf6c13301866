"""Scores of scenes: what counts as found, as hidden, and as wrong but trusted."""

from __future__ import annotations

import numpy as np
import pytest

from liex_lab.evaluation.scenes import Individual, Tally, matched
from liex_lab.simulation.scenes.recording import TrueAnimal

N = 10
SPINE = 60.0


def joints(x: float = 0.0) -> np.ndarray:
    """A straight animal (N, 3, 3) along x, in every frame the same."""
    one = np.array([[0.0, 0.0, 700.0], [30.0, 0.0, 700.0], [60.0, 0.0, 700.0]])
    return np.tile(one + np.array([x, 0.0, 0.0]), (N, 1, 1))


def truth(x: float = 0.0, visible: float = 1.0) -> TrueAnimal:
    return TrueAnimal(SPINE, joints(x), np.full(N, visible))


def said(x: float = 0.0, trusted: bool = True) -> Individual:
    return Individual(joints(x), np.full(N, trusted))


def figures(
    truths: list[TrueAnimal], individuals: list[Individual], **how: bool
) -> dict[str, object]:
    tally = Tally()
    tally.add(truths, individuals, N, **how)
    return tally.figures()


def test_a_right_pose_is_found_and_right() -> None:
    row = figures([truth()], [said(3.0)])
    assert row == {
        "n_frames": N,
        "found": 1.0,
        "mean_joint_error_mm": pytest.approx(3.0),
        "median_joint_error_mm": pytest.approx(3.0),
        "flips": 0.0,
        "hidden_right": None,
        "trusted": 1.0,
        "wrong_but_trusted": 0.0,
    }


def test_a_trusted_pose_is_wrong_beyond_15_percent_of_the_spine() -> None:
    assert figures([truth()], [said(8.9)])["wrong_but_trusted"] == 0.0
    assert figures([truth()], [said(9.1)])["wrong_but_trusted"] == 1.0
    assert figures([truth()], [said(9.1, trusted=False)])["wrong_but_trusted"] == 0.0


def test_a_refusal_finds_nothing_and_trusts_nothing() -> None:
    row = figures([truth()], [])
    assert (row["found"], row["mean_joint_error_mm"], row["wrong_but_trusted"]) == (0.0, None, 0.0)


def test_where_there_is_no_animal_every_trusted_frame_is_wrong() -> None:
    row = figures([], [said()])
    assert (row["found"], row["wrong_but_trusted"]) == (None, 1.0)
    half = truth()
    half.joints_camera[: N // 2] = np.nan
    half.visible[: N // 2] = 0.0
    assert figures([half], [said()])["wrong_but_trusted"] == pytest.approx(0.5)


def test_an_animal_of_another_kind_makes_every_trusted_frame_wrong() -> None:
    row = figures([truth()], [said()], fits=False)
    assert (row["found"], row["wrong_but_trusted"]) == (None, 1.0)


def test_hidden_frames_are_right_without_a_trusted_pose() -> None:
    hidden = truth(visible=0.1)
    assert figures([hidden], [said()])["hidden_right"] == 0.0
    assert figures([hidden], [said(trusted=False)])["hidden_right"] == 1.0
    assert figures([hidden], [])["hidden_right"] == 1.0
    assert figures([hidden], [said()])["found"] is None


def test_head_and_tail_exchanged_is_a_flip() -> None:
    turned = Individual(joints()[:, ::-1].copy(), np.ones(N, np.bool_))
    assert figures([truth()], [turned])["flips"] == 1.0


def test_individuals_are_matched_with_the_animals_that_they_follow() -> None:
    two = [truth(0.0), truth(300.0)]
    assert matched(two, [said(301.0), said(2.0)]) == {0: 1, 1: 0}
    assert figures(two, [said(301.0), said(2.0)])["mean_joint_error_mm"] == pytest.approx(1.5)
    only = figures(two, [said(301.0)])
    assert (only["found"], only["wrong_but_trusted"]) == (0.5, 0.0)
    third = figures(two, [said(301.0), said(2.0), said(900.0)])
    assert third["wrong_but_trusted"] == pytest.approx(1 / 3)


def test_recordings_add_up() -> None:
    tally = Tally()
    tally.add([truth()], [said(2.0)], N)
    tally.add([truth()], [], N)
    row = tally.figures()
    assert (row["n_frames"], row["found"], row["trusted"]) == (2 * N, 0.5, 0.5)
