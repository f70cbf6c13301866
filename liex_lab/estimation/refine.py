"""Gauss-Newton refinement of a pose against the height map: articulated ICP with a sphere model.

The last step, after the regressors and the learned metric (ours). The body is a set of spheres
carried by the kinematic tree. With p the tangent vector of the base, the logarithm of the scale and
the free angles, each step minimises

    sum_i w_i d_i(p)^2 + w_b sum_k b_k(p)^2 + (p - p0)^T diag(prior) (p - p0)

over signed distances d_i of depth readings to the nearest sphere and of spheres to the readings
behind them, both with robust Geman-McClure weights, distances b_k of spheres outside the animal to
its nearest pixel, and a prior at the pose of the regressors. The kernels are in `_refine_kernels`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from liex_lab.body.capsules import Spheres
from liex_lab.body.kinematics import KinematicTree
from liex_lab.body.pose import Pose
from liex_lab.body.skeleton import Skeleton
from liex_lab.estimation import _refine_kernels as kernels
from liex_lab.estimation import _residual_kernels as residual_kernels
from liex_lab.estimation.cascade import ImageSet, body_of
from liex_lab.geometry import SE3
from liex_lab.runtime.shapes import check_shapes
from liex_lab.scene._blob_kernels import N_MOMENTS
from liex_lab.scene._height_map_kernels import N_CROP_CAMERA

Array = NDArray[np.float64]

_ROBUST_MM = 10.0  # in tenths of the balls' usual radius: a reading this far off counts a quarter
_BESIDE = 0.3  # weight of a ball outside the animal relative to a reading
# steps of all poses, and number of the best poses that continue
_FIRST_STEPS = 1
_GO_ON = 2
_BESIDE_MM = 4.0  # in that unit: cost in the choice if all balls were outside the animal
# cost of leaving the pose of the regressors, in squares of that unit: a radian of the base, a unit
# of its position, of log scale, and a radian of a joint
_PRIOR = np.array([1e4, 0.5, 1e4, 60.0])


@dataclass(frozen=True)
class Refiner:
    """The Gauss-Newton refinement of poses of one skeleton.

    Attributes:
        skeleton: the animal's skeleton.
        tree: the kinematic tree as a record for the kernels.
        free_angles: its free angles, likewise.
        body: the sphere model, likewise.
    """

    skeleton: Skeleton
    tree: KinematicTree
    free_angles: kernels.FreeAngles
    body: residual_kernels.SphereModel

    @staticmethod
    def of(skeleton: Skeleton, balls: Spheres) -> Refiner:
        """The refinement for a skeleton of any shape.

        Args:
            skeleton: the animal's skeleton.
            balls: the sphere model of its body.
        """
        s = skeleton
        tree = KinematicTree.of(s)
        free = tree.free
        above = np.eye(s.n_joints, dtype=bool)  # [j, a]: a is j or one of its ancestors
        for parent, child in s.edges:
            above[child] |= above[parent]
        moves = np.ascontiguousarray(above[:, free[:, 0]])
        limits = np.ascontiguousarray(s.limits[free[:, 0], free[:, 1]])
        movers = [np.flatnonzero(moves[one] | moves[other]) for one, other in balls.joints]
        turns = np.full((len(movers), max(map(len, movers), default=0)), -1, np.int64)
        for row, some in zip(turns, movers, strict=True):
            row[: len(some)] = some
        return Refiner(s, tree, kernels.FreeAngles(limits, moves, turns), body_of(balls))

    def _check(self, pose: Pose, heights: NDArray[np.int16], crop_cameras: Array) -> None:
        """Refuse poses (n, K) of another body or for other height maps."""
        n_joints = self.skeleton.n_joints
        check_shapes(
            "poses to refine",
            ("rotations", pose.root.rotation, ("n", "K", 3, 3)),
            ("translations", pose.root.translation, ("n", "K", 3)),
            ("angles", pose.angles, ("n", "K", n_joints, 3)),
            ("scales", pose.scale, ("n", "K")),
            ("heights", heights, ("n", "S", "S")),
            ("crop_cameras", crop_cameras, ("n", N_CROP_CAMERA)),
        )

    def refine(
        self, pose: Pose, heights: NDArray[np.int16], crop_cameras: Array, size: float, n_steps: int
    ) -> Pose:
        """Fit poses to the height maps by Gauss-Newton steps.

        Args:
            pose: (n, K) poses in their view frames; not changed.
            heights: (n, S, S) int16 height maps, 1/16 mm, 0 outside the animal.
            crop_cameras: (n, 17) packed crop cameras of the height maps.
            size: the animal's size over home size.
            n_steps: number of Gauss-Newton steps.

        Returns:
            (n, K) refined poses.
        """
        unit = self.body.unit_mm * size
        self._check(pose, heights, crop_cameras)
        rotation = pose.root.rotation.copy()
        position = pose.root.translation.copy()
        angles = pose.angles.copy()
        scale = pose.scale.copy()
        weights = kernels.ResidualWeights(
            _ROBUST_MM * unit, _BESIDE, *(_PRIOR * np.array([unit**2, 1.0, unit**2, unit**2]))
        )
        kernels.refine_all(
            heights,
            crop_cameras,
            self.tree,
            self.free_angles,
            self.body,
            weights,
            n_steps,
            rotation,
            position,
            angles,
            scale,
        )
        return Pose(SE3(rotation, position), angles, scale)

    def fit(
        self,
        pose: Pose,
        heights: NDArray[np.int16],
        crop_cameras: Array,
        moments: Array,
        size: float,
    ) -> Array:
        """Residuals of poses against the height maps.

        Args:
            pose: (n, K) poses in their view frames.
            heights: (n, S, S) int16 height maps, 1/16 mm, 0 where there is no animal.
            crop_cameras: (n, 17) packed crop cameras of the height maps.
            moments: (n, 9) moments of the height maps.
            size: the animal's size over home size.

        Returns:
            (n, K, N_FIT) residuals, see `_residual_kernels.explain`.
        """
        self._check(pose, heights, crop_cameras)
        check_shapes("height maps", ("moments", moments, (len(heights), N_MOMENTS)))
        frames = pose.frames(self.skeleton)
        n, k = pose.scale.shape
        j = self.skeleton.n_joints
        out = np.empty((n * k, residual_kernels.N_FIT), np.float32)
        residual_kernels.explain_all(
            heights,
            crop_cameras,
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
        """Refine poses and choose the one that fits each height map best.

        All K poses are refined by one step, and the best two by the remaining steps.

        Args:
            poses: (n, K) poses in their view frames.
            images: n height maps with their crop cameras and moments.
            size: the animal's size over home size.
            n_steps: number of Gauss-Newton steps in all.

        Returns:
            (n) poses, and their residuals (n, N_FIT).
        """
        kept = poses
        rows = np.arange(len(poses.scale))[:, None]
        for n_more in (min(_FIRST_STEPS, n_steps), max(n_steps - _FIRST_STEPS, 0)):
            moved = self.refine(kept, images.heights, images.crop_cameras, size, n_more)
            fit = self.fit(moved, images.heights, images.crop_cameras, images.moments, size)
            order = rows, np.argsort(_apart(fit), axis=1, kind="stable")[:, :_GO_ON]
            kept = moved[order]
            fit = fit[order]
        return kept[:, 0], fit[:, 0]


def _apart(fit: Array) -> Array:
    """Distance (n, K) mm of poses from the readings, from their residuals (n, K, N_FIT)."""
    distance = (
        fit[..., residual_kernels.OUT_OF] + fit[..., residual_kernels.APART]
    ) / residual_kernels.MM_UNIT
    return np.asarray(
        distance + _BESIDE_MM * fit[..., residual_kernels.BESIDE] / residual_kernels.SHARE_UNIT
    )
