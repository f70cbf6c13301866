"""A pose taken into the picture: the last step, after the regressors and the learned metric have said about where."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from liex_lab.body.balls import Balls
from liex_lab.body.pose import Pose
from liex_lab.body.skeleton import Skeleton
from liex_lab.estimation import _explain as explaining
from liex_lab.estimation import _refine as kernels
from liex_lab.geometry import SE3

Array = NDArray[np.float64]

_ROBUST_MM = 10.0  # in tenths of the balls' usual radius: a reading this far off counts a quarter
_BESIDE = 0.3  # what a ball beside the animal weighs against a reading
# what it costs to leave the pose that the regressors found, in squares of that unit: a radian of the base, a unit of
# place, of log scale, and a radian of a joint
_PRIOR = np.array([2e4, 1.0, 2e4, 200.0])


@dataclass(frozen=True)
class Refiner:
    """A skeleton and its balls as the kernels want them: free (F, 2) joint and axis of every angle, moves (J, F) which
    of them turn which joint.
    """

    skeleton: Skeleton
    balls: Balls
    free: NDArray[np.int64]
    moves: NDArray[np.bool_]

    @staticmethod
    def of(skeleton: Skeleton, balls: Balls) -> Refiner:
        """For a skeleton of any shape."""
        free = [(j, k) for j in range(1, skeleton.n_joints) for k in range(3) if skeleton.axes[j, k]]
        above = np.eye(skeleton.n_joints, dtype=bool)  # [j, a]: a is j or one of its ancestors
        for parent, child in skeleton.edges:
            above[child] |= above[parent]
        pairs = np.array(free, np.int64).reshape(-1, 2)
        return Refiner(skeleton, balls, pairs, np.ascontiguousarray(above[:, pairs[:, 0]]))

    def refine(self, pose: Pose, heights: NDArray[np.int16], looks: Array, size: float, n_steps: int) -> Pose:
        """Poses (n) in their view frames, each moved into its height map (n, S, S) cut as looks (n, 17) say."""
        s, b = self.skeleton, self.balls
        unit = b.unit_mm * size
        rotation, position = pose.root.rotation.copy(), pose.root.translation.copy()
        angles, scale = pose.angles.copy(), pose.scale.copy()
        limits = s.limits[self.free[:, 0], self.free[:, 1]]
        prior = _PRIOR * np.array([unit**2, 1.0, unit**2, unit**2])
        kernels.refine_all(
            heights, looks, s.parents, s.offsets, s.rest, self.free, limits, self.moves, b.joints, b.offsets, b.share,
            b.radius, b.n_own, n_steps, _ROBUST_MM * unit, _BESIDE, prior, rotation, position, angles, scale,
        )  # fmt: skip
        return Pose(SE3(rotation, position), angles, scale)

    def fit(self, pose: Pose, heights: NDArray[np.int16], looks: Array, moments: Array, size: float) -> Array:
        """How well poses (n) explain the picture (n, N_FIT); see `_explain.explain`."""
        frames, b, n = pose.frames(self.skeleton), self.balls, len(pose.scale)
        out = np.empty((n, explaining.N_FIT), np.float32)
        explaining.explain_all(
            heights, looks, moments, np.arange(n, dtype=np.int32), frames.rotation, frames.translation, pose.scale,
            np.full(n, size), b.unit_mm, b.n_own, b.joints, b.offsets, b.share, b.radius, out,
        )  # fmt: skip
        return out.astype(float)
