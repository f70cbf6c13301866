"""Poses that keep the frames of their joints give what forward kinematics gives, run once."""

import numpy as np
import pytest

from liex_lab.body.pose import KinematicTree, PlacedPose, Pose
from liex_lab.body.skeleton import Skeleton
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


@pytest.mark.parametrize("animal", ["mouse", "fish", "hand"])
def test_the_free_angles_are_those_of_the_joints_beyond_the_base_in_their_order(animal):
    skeleton = Skeleton.load(animal)
    tree = KinematicTree.of(skeleton)
    expected = [
        (joint, axis)
        for joint in range(1, skeleton.n_joints)
        for axis in range(3)
        if skeleton.axes[joint, axis]
    ]
    assert [tuple(row) for row in tree.free.tolist()] == expected
    assert len(tree.free) == skeleton.dof - 6
    np.testing.assert_array_equal(np.flatnonzero(tree.turning), skeleton.solved)
    skeleton.axes[1:] = False  # all base
    assert KinematicTree.of(skeleton).free.shape == (0, 2)
