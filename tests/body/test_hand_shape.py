"""Hands of many people: their own bones, their own girth, and an arm behind them."""

import numpy as np

from liex_lab.body import Pose, Skeleton
from liex_lab.body.variation import ARM_MM, arm_vertices, draw_hands, forearms
from liex_lab.geometry import SE3, so3

HAND = Skeleton.load("hand")


def test_everybody_has_bones_of_their_own_length_in_any_pose() -> None:
    rng = np.random.default_rng(0)
    shape = draw_hands(rng, HAND, "train", 12)
    angles = rng.uniform(HAND.limits[..., 0], HAND.limits[..., 1], (12, HAND.n_joints, 3))
    pose = Pose(SE3.exp(rng.normal(0.0, 1.0, (12, 6))), angles, rng.uniform(0.8, 1.2, 12))
    rotations, positions = shape.joints(HAND, pose)
    np.testing.assert_array_equal(rotations, pose.frames(HAND).rotation)
    bones = np.linalg.norm(positions[:, 1:] - positions[:, HAND.parents[1:]], axis=-1)
    own = np.linalg.norm(shape.offsets[:, 1:], axis=-1) * pose.scale[:, None]
    np.testing.assert_allclose(bones, own, rtol=1e-9)
    assert (own / pose.scale[:, None]).std(axis=0).max() > 0.5  # and people differ


def test_the_other_familys_hands_are_thicker_or_thinner_than_any_trained_on() -> None:
    rng = np.random.default_rng(4)
    usual, other = (
        draw_hands(rng, HAND, family, 400).flesh.radii.mean(axis=(1, 2))
        for family in ("train", "other")
    )
    low, high = np.quantile(usual, [0.1, 0.9])
    assert ((other < low) | (other > high)).mean() > 0.9


def test_whoever_holds_out_a_hand_stands_behind_it() -> None:
    rng = np.random.default_rng(5)
    n = 200
    shape = draw_hands(rng, HAND, "train", n)
    pose = Pose(
        SE3(so3.exp(rng.normal(0.0, 2.0, (n, 3))), np.tile([0.0, 0.0, 700.0], (n, 1))),
        np.zeros((n, HAND.n_joints, 3)),
        np.ones(n),
    )
    rotations, positions = shape.joints(HAND, pose)
    frame, elbow = forearms(rng, rotations, positions, pose.scale)
    wrist = positions[:, 1:3].mean(axis=1)
    np.testing.assert_allclose(np.linalg.norm(wrist - elbow, axis=1), ARM_MM, rtol=1e-9)
    assert (elbow[:, 2] >= wrist[:, 2] - 1e-6).all()
    mesh = arm_vertices(frame, elbow, elbow + np.array([0.0, 0.0, 200.0]), pose.scale, shape.arm)
    assert np.isfinite(mesh).all()
    gap = np.linalg.norm(mesh - wrist[:, None], axis=-1).min(axis=1)
    assert gap.max() < 45.0  # it reaches the hand
