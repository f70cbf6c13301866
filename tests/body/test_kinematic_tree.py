"""The record of a kinematic tree says what its skeleton says."""

from __future__ import annotations

import numpy as np
import pytest

from liex_lab.body.kinematics import KinematicTree
from liex_lab.body.skeleton import Skeleton


@pytest.mark.parametrize("animal", ["mouse", "fish", "hand"])
def test_the_free_angles_are_those_of_the_joints_beyond_the_base_in_their_order(
    animal: str,
) -> None:
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


def test_a_skeleton_that_is_all_base_has_no_free_angles() -> None:
    mouse = Skeleton.load("mouse")
    mouse.axes[1:] = False
    tree = KinematicTree.of(mouse)
    assert tree.free.shape == (0, 2)
    assert not tree.turning[1:].any()
