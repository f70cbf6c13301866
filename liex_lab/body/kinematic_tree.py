"""A skeleton's kinematic tree as the record of arrays that numba kernels take."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from liex_lab.body.skeleton import Skeleton

Array = NDArray[np.float64]


class KinematicTree(NamedTuple):
    """A kinematic tree of J joints with F free angles beyond the base.

    Attributes:
        parents: (J,) parent of each joint.
        offsets: (J, 3) each joint in its parent's frame, mm at home.
        rest: (J, 3, 3) rotation from the parent's frame to the joint's at home.
        axes: (J, 3) bool, the free axes.
        turning: (J,) bool, joints with a free axis.
        free: (F, 2) joint and axis of every free angle beyond the base.
        tip: joint whose direction from the base says which way the animal lies.
    """

    parents: NDArray[np.int64]
    offsets: Array
    rest: Array
    axes: NDArray[np.bool_]
    turning: NDArray[np.bool_]
    free: NDArray[np.int64]
    tip: int

    @staticmethod
    def of(skeleton: Skeleton) -> KinematicTree:
        """The record of a skeleton.

        Args:
            skeleton: the animal's skeleton.
        """
        free = np.argwhere(skeleton.axes)
        return KinematicTree(
            skeleton.parents,
            skeleton.offsets,
            skeleton.rest,
            skeleton.axes,
            np.asarray(skeleton.axes.any(axis=1)),
            free[free[:, 0] > 0],
            skeleton.tip,
        )
