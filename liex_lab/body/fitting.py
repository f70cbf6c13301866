"""Inverse kinematics: least-squares fit of poses to measured points of the body.

Levenberg-Marquardt on the manifold of poses, many poses at once. The cost of a pose is

    sum_m |x_m(pose) - y_m|^2 + (1 mm)^2 sum |angle - home|^2,

where home is the angle nearest to zero within the limits: the second term determines angles that
the points do not constrain. A step rotates and moves the base by a twist on the right, T exp(xi),
and changes every joint's free angles and the logarithm of the scale. The damping is a share of the
curvature's diagonal (Marquardt 1963), divided by 5 after a step that lowers the cost, else
multiplied by 4; a coordinate pushed against its limit is fixed (projected, active set).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from liex_lab.body.kinematics import forward_kinematics
from liex_lab.body.pose import Pose
from liex_lab.body.skeleton import Skeleton
from liex_lab.geometry import SE3, so3

Array = NDArray[np.float64]

_DAMPING = (1e-3, 1e-9, 1e6)  # initial, least and largest damping, as a share of the curvature
# a joint bent by a radian costs as much as a point this far off; determines unconstrained angles
_REST_MM = 1.0


@dataclass(frozen=True)
class Fit:
    """Poses fitted to points.

    Attributes:
        pose: (n) poses, in the points' frame.
        residual_mm: (n, M) remaining distance at each point.
    """

    pose: Pose
    residual_mm: Array


def fit_poses(
    skeleton: Skeleton,
    points: Array,
    points_of_joints: Array,
    start: Pose,
    *,
    n_steps: int = 60,
    keep_scale: bool = False,
) -> Fit:
    """Fit poses to measured points by least squares.

    Args:
        skeleton: of the poses.
        points: (n, M, 3) mm, measured, in the frame of the poses.
        points_of_joints: (M, J) each point as a weighted mean of joints.
        start: (n) initial poses; their angles should be within the limits.
        n_steps: steps to try.
        keep_scale: whether the bone lengths are fixed.

    Returns:
        The fitted poses, within the joints' limits, and their residuals.
    """
    lower = skeleton.limits[..., 0]
    upper = skeleton.limits[..., 1]
    pose = start
    n = len(points)
    damping = np.full(n, _DAMPING[0])
    middle = np.clip(0.0, lower, upper)
    free = _free(skeleton)
    cost, residual = _cost(skeleton, pose, points, points_of_joints, middle)
    for _ in range(n_steps):
        slope = _jacobian(skeleton, pose, points_of_joints, free)
        if keep_scale:
            slope[..., -1] = 0.0
        bent = np.stack([pose.angles[:, j, k] - middle[j, k] for j, k in free], axis=1)
        gradient = np.einsum("nri,nr->ni", slope, residual.reshape(n, -1))
        gradient[:, 6:-1] += _REST_MM**2 * bent
        curvature = np.einsum("nri,nrk->nik", slope, slope)
        index = np.arange(6, 6 + len(free))
        curvature[:, index, index] += _REST_MM**2
        fixed = np.zeros(gradient.shape, bool)  # pushed against a limit
        for c, (j, k) in enumerate(free, start=6):
            at = pose.angles[:, j, k]
            direction = gradient[:, c]
            fixed[:, c] = ((at <= lower[j, k]) & (direction > 0)) | (
                (at >= upper[j, k]) & (direction < 0)
            )
        step = _step(curvature, gradient, damping, fixed)
        tried = _after_step(pose, step, free, lower, upper)
        tried_cost, tried_residual = _cost(skeleton, tried, points, points_of_joints, middle)
        better = tried_cost < cost
        pose = _chosen(better, tried, pose)
        cost = np.where(better, tried_cost, cost)
        residual = np.where(better[:, None, None], tried_residual, residual)
        damping = np.clip(np.where(better, damping / 5.0, damping * 4.0), *_DAMPING[1:])
    return Fit(pose, np.linalg.norm(residual, axis=-1))


def _free(skeleton: Skeleton) -> list[tuple[int, int]]:
    """(joint, axis) of every degree of freedom but the base's."""
    return [(j, k) for j in range(1, skeleton.n_joints) for k in range(3) if skeleton.axes[j, k]]


def _cost(
    skeleton: Skeleton, pose: Pose, points: Array, points_of_joints: Array, middle: Array
) -> tuple[Array, Array]:
    """Sum of squares (n,) and residuals (n, M, 3) mm."""
    residual = np.einsum("mj,njd->nmd", points_of_joints, pose.joints(skeleton)) - points
    bent = ((pose.angles - middle) * skeleton.axes)[:, 1:]
    return np.sum(residual**2, axis=(1, 2)) + _REST_MM**2 * np.sum(bent**2, axis=(1, 2)), residual


def _jacobian(
    skeleton: Skeleton, pose: Pose, points_of_joints: Array, free: list[tuple[int, int]]
) -> Array:
    """Derivatives (n, 3 M, 7 + free axes) of the points by base twist, joint angles and log
    scale.
    """
    rotation, position = forward_kinematics(skeleton, pose.root, pose.angles, pose.scale)
    n, n_joints = position.shape[:2]
    by = np.zeros((n, n_joints, 3, 7 + len(free)))
    out = position - position[:, :1]
    local = np.einsum("nji,nkj->nki", rotation[:, 0], out)
    by[..., :3] = -np.einsum("nij,nkjl->nkil", rotation[:, 0], so3.hat(local))
    by[..., 3:6] = rotation[:, None, 0]
    by[..., -1] = out
    below = _descendants(skeleton)
    turns = so3.left_jacobian(-pose.angles)  # the right Jacobian of the rotation vector
    for c, (j, k) in enumerate(free, start=6):
        axis = np.einsum("nij,nj->ni", rotation[:, j], turns[:, j, :, k])
        by[..., c][:, below[j]] = np.cross(
            axis[:, None], position[:, below[j]] - position[:, j : j + 1]
        )
    return np.einsum("mj,njdc->nmdc", points_of_joints, by).reshape(n, -1, by.shape[-1])


def _descendants(skeleton: Skeleton) -> list[NDArray[np.int64]]:
    """The joints that move when a joint rotates."""
    below: list[list[int]] = [[] for _ in range(skeleton.n_joints)]
    for j in range(skeleton.n_joints - 1, 0, -1):
        below[int(skeleton.parents[j])] += [j, *below[j]]
    return [np.array(sorted(rows), np.int64) for rows in below]


def _step(curvature: Array, gradient: Array, damping: Array, fixed: NDArray[np.bool_]) -> Array:
    """The damped Newton step (n, P); zero along fixed coordinates."""
    n_values = gradient.shape[1]
    index = np.arange(n_values)
    matrix = curvature.copy()
    matrix[:, index, index] *= 1.0 + damping[:, None]
    matrix[:, index, index] += 1e-9
    matrix[fixed[:, :, None] | fixed[:, None, :]] = 0.0
    matrix[:, index, index] += fixed
    return -np.asarray(np.linalg.solve(matrix, np.where(fixed, 0.0, gradient)[..., None]), float)[
        ..., 0
    ]


def _after_step(
    pose: Pose, step: Array, free: list[tuple[int, int]], lower: Array, upper: Array
) -> Pose:
    """The poses after steps (n, P)."""
    angles = pose.angles.copy()
    for c, (j, k) in enumerate(free, start=6):
        angles[:, j, k] = np.clip(angles[:, j, k] + step[:, c], lower[j, k], upper[j, k])
    return Pose(
        pose.root @ SE3.exp(step[:, :6]),
        angles,
        pose.scale * np.exp(np.clip(step[:, -1], -0.3, 0.3)),
    )


def _chosen(first: NDArray[np.bool_], a: Pose, b: Pose) -> Pose:
    """Rows of a where `first` (n,), else of b."""

    def pick(x: Array, y: Array) -> Array:
        return np.where(first.reshape(-1, *[1] * (x.ndim - 1)), x, y)

    root = SE3(pick(a.root.rotation, b.root.rotation), pick(a.root.translation, b.root.translation))
    return Pose(root, pick(a.angles, b.angles), pick(a.scale, b.scale))
