"""A pose taken into the picture: the last step, after the regressors and the learned metric have
said about where.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from liex_lab.body.pose import Pose
from liex_lab.body.skeleton import Skeleton
from liex_lab.body.spheres import Balls
from liex_lab.estimation import _refine_kernels as kernels
from liex_lab.estimation import _residual_kernels as explaining
from liex_lab.estimation.cascade import ImageSet, body_of
from liex_lab.geometry import SE3

Array = NDArray[np.float64]

_ROBUST_MM = 10.0  # in tenths of the balls' usual radius: a reading this far off counts a quarter
_BESIDE = 0.3  # what a ball beside the animal weighs against a reading
# that all poses take, and how many of them take the others: those that then lie best
_FIRST_STEPS = 1
_GO_ON = 2
_BESIDE_MM = 4.0  # in that unit: what it weighs in the choice, if all balls were beside it
# what it costs to leave the pose that the regressors found, in squares of that unit: a radian of
# the base, a unit of
# place, of log scale, and a radian of a joint
_PRIOR = np.array([1e4, 0.5, 1e4, 60.0])


@dataclass(frozen=True)
class Refiner:
    """A skeleton and its body as the kernels want them."""

    skeleton: Skeleton
    tree: kernels.Tree
    body: explaining.Body

    @staticmethod
    def of(skeleton: Skeleton, balls: Balls) -> Refiner:
        """For a skeleton of any shape."""
        s = skeleton
        free = np.array(
            [(j, k) for j in range(1, s.n_joints) for k in range(3) if s.axes[j, k]], np.int64
        )
        free = free.reshape(-1, 2)
        above = np.eye(s.n_joints, dtype=bool)  # [j, a]: a is j or one of its ancestors
        for parent, child in s.edges:
            above[child] |= above[parent]
        moves = np.ascontiguousarray(above[:, free[:, 0]])
        limits = np.ascontiguousarray(s.limits[free[:, 0], free[:, 1]])
        movers = [np.flatnonzero(moves[one] | moves[other]) for one, other in balls.joints]
        turns = np.full((len(movers), max(map(len, movers), default=0)), -1, np.int64)
        for row, some in zip(turns, movers, strict=True):
            row[: len(some)] = some
        return Refiner(
            s,
            kernels.Tree(s.parents, s.offsets, s.rest, free, limits, moves, turns),
            body_of(balls),
        )

    def refine(
        self, pose: Pose, heights: NDArray[np.int16], looks: Array, size: float, n_steps: int
    ) -> Pose:
        """Poses (n, K) in their view frames, each moved into its height map (n, S, S) cut as looks
        (n, 17) say.
        """
        unit = self.body.unit_mm * size
        rotation = pose.root.rotation.copy()
        position = pose.root.translation.copy()
        angles = pose.angles.copy()
        scale = pose.scale.copy()
        wishes = kernels.Wishes(
            _ROBUST_MM * unit, _BESIDE, _PRIOR * np.array([unit**2, 1.0, unit**2, unit**2])
        )
        kernels.refine_all(
            heights, looks, self.tree, self.body, wishes, n_steps, rotation, position, angles, scale
        )
        return Pose(SE3(rotation, position), angles, scale)

    def fit(
        self, pose: Pose, heights: NDArray[np.int16], looks: Array, moments: Array, size: float
    ) -> Array:
        """How well poses (n, K) explain the picture (n, K, N_FIT); see `_explain.explain`."""
        frames, (n, k), j = pose.frames(self.skeleton), pose.scale.shape, self.skeleton.n_joints
        out = np.empty((n * k, explaining.N_FIT), np.float32)
        explaining.explain_all(
            heights,
            looks,
            moments,
            np.repeat(np.arange(n, dtype=np.int32), k),
            frames.rotation.reshape(-1, j, 3, 3),
            frames.translation.reshape(-1, j, 3),
            pose.scale.ravel(),
            np.full(n * k, size),
            self.body,
            out,
        )
        return out.reshape(n, k, -1).astype(float)

    def best(self, poses: Pose, images: ImageSet, size: float, n_steps: int) -> tuple[Pose, Array]:
        """The one of poses (n, K) that lies best in the picture once it was taken there (n), and
        its fit (n, N_FIT).

        A first step tells which are worth the others.
        """
        kept = poses
        rows = np.arange(len(poses.scale))[:, None]
        for n_more in (min(_FIRST_STEPS, n_steps), max(n_steps - _FIRST_STEPS, 0)):
            moved = self.refine(kept, images.heights, images.looks, size, n_more)
            fit = self.fit(moved, images.heights, images.looks, images.moments, size)
            order = rows, np.argsort(_apart(fit), axis=1, kind="stable")[:, :_GO_ON]
            kept = moved[order]
            fit = fit[order]
        return kept[:, 0], fit[:, 0]


def _apart(fit: Array) -> Array:
    """How far (n, K) mm poses are from what the picture shows, of their fit (n, K, N_FIT)."""
    off = (fit[..., explaining.OUT_OF] + fit[..., explaining.APART]) / explaining.MM_UNIT
    return np.asarray(off + _BESIDE_MM * fit[..., explaining.BESIDE] / explaining.SHARE_UNIT)
