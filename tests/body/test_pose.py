"""Poses that keep the frames of their joints give what forward kinematics gives, run once."""

from __future__ import annotations

import numpy as np
import pytest

from liex_lab.body import pose as pose_module
from liex_lab.body.pose import PlacedPose, Pose
from liex_lab.body.skeleton import Skeleton
from liex_lab.estimation.method import METHODS
from liex_lab.estimation.model import ErrorCalibration
from liex_lab.estimation.scoring import choose
from liex_lab.geometry import SE3, so3

MOUSE = Skeleton.load("mouse")


def bent(n: int, seed: int = 0) -> Pose:
    """Poses (n) of random place, posture and size."""
    rng = np.random.default_rng(seed)
    root = SE3(so3.exp(rng.normal(0, 0.6, (n, 3))), rng.normal(0, 30, (n, 3)))
    angles = rng.normal(0, 0.3, (n, MOUSE.n_joints, 3)) * MOUSE.axes
    return Pose(root, angles, rng.uniform(0.8, 1.2, n))


@pytest.mark.parametrize("rows", [slice(2, 5), np.array([6, 0]), np.arange(8) % 3 == 0])
def test_a_placed_pose_and_some_of_it_have_the_frames_of_the_pose_to_the_bit(rows):
    pose = bent(8)
    placed = pose.placed(MOUSE)
    for plain, kept in ((pose, placed), (pose[rows], placed[rows])):
        assert isinstance(kept, PlacedPose)
        frames = plain.frames(MOUSE)
        np.testing.assert_array_equal(kept.frames(MOUSE).rotation, frames.rotation)
        np.testing.assert_array_equal(kept.frames(MOUSE).translation, frames.translation)
        np.testing.assert_array_equal(kept.joints(MOUSE), plain.joints(MOUSE))


def test_a_placed_pose_in_another_frame_is_placed_anew():
    pose = bent(4)
    T = SE3(so3.exp(np.array([0.1, -0.7, 0.4])), np.array([10.0, -20.0, 700.0]))
    moved = pose.placed(MOUSE).moved(T)
    assert not isinstance(moved, PlacedPose)
    np.testing.assert_array_equal(moved.joints(MOUSE), pose.moved(T).joints(MOUSE))
    np.testing.assert_allclose(moved.joints(MOUSE), T @ pose.joints(MOUSE), atol=1e-9)


@pytest.mark.parametrize("animal", ["mouse", "hand"])
def test_choosing_a_pose_runs_forward_kinematics_once_for_all_who_ask_for_its_joints(
    animal, monkeypatch
):
    skeleton = Skeleton.load(animal)
    home = Pose.home(skeleton, 3, 4).frames(skeleton)
    runs = []
    real = pose_module.forward_kinematics

    def counted(*what):
        runs.append(what)
        return real(*what)

    monkeypatch.setattr(pose_module, "forward_kinematics", counted)
    scores = np.random.default_rng(1).uniform(1, 9, (3, 4))
    picked = choose(
        skeleton,
        METHODS["default"],
        ErrorCalibration(),
        1.0,
        home.rotation,
        home.translation,
        scores,
    )
    kept = picked.pose.frames(skeleton)
    assert len(runs) == 1
    placed = Pose(picked.pose.root, picked.pose.angles, picked.pose.scale).frames(skeleton)
    np.testing.assert_array_equal(kept.rotation, placed.rotation)
