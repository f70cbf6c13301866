"""A pose: root transform in SE(3), joint rotation vectors and one scale, of one animal or a batch.

The kinematic chain of Lie-X section 3 in coordinates: joint j's transform relative to its parent is
exp of a rotation vector about its free axes, after a fixed bone; the product of these exponentials
along the tree gives every joint (`forward_kinematics`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from liex_lab.arrays import Array, ArrayLike, NDArray
from liex_lab.body.skeleton import Skeleton
from liex_lab.geometry import SE3, so3
from liex_lab.runtime.memory import Rows


def forward_kinematics(
    skeleton: Skeleton, root: SE3, angles: Array, scale: Array
) -> tuple[Array, Array]:
    """Rotations and positions of all joints of many poses, by the product of exponentials.

    Args:
        skeleton: the kinematic tree.
        root: T_frame_root (...), mm.
        angles: (..., J, 3) rad, relative to the parent.
        scale: (...) of the bones.

    Returns:
        Joint rotations (..., J, 3, 3) and positions (..., J, 3) mm, in the root's outer frame.
    """
    local = skeleton.rest @ so3.exp(angles)
    n_joints = skeleton.n_joints
    rotation = np.empty((*root.translation.shape[:-1], n_joints, 3, 3))
    position = np.empty((*root.translation.shape[:-1], n_joints, 3))
    rotation[..., 0, :, :] = root.rotation
    position[..., 0, :] = root.translation
    size = np.asarray(scale, float)[..., None]
    for j in range(1, n_joints):
        parent = skeleton.parents[j]
        offset = np.einsum("...ij,j->...i", rotation[..., parent, :, :], skeleton.offsets[j])
        position[..., j, :] = position[..., parent, :] + size * offset
        rotation[..., j, :, :] = rotation[..., parent, :, :] @ local[..., j, :, :]
    return rotation, position


def aim(direction_from: Array, direction_to: Array) -> Array:
    """The smallest rotation vectors that rotate directions onto others.

    The axis is a x b, the angle atan2(|a x b|, a . b). Opposite directions have no unique smallest
    rotation; they rotate by pi about some perpendicular axis.

    Args:
        direction_from: (..., 3), any length but 0.
        direction_to: (..., 3), any length but 0.

    Returns:
        (..., 3) rad.
    """
    a = _unit(direction_from)
    b = _unit(direction_to)
    cross = so3.cross(a, b)
    sine = _length(cross)
    angle = np.arctan2(sine, np.sum(a * b, axis=-1, keepdims=True))
    if np.all(sine > 1e-12):
        return cross / sine * angle
    # any axis perpendicular to a is valid if the cross product vanishes
    helper = np.where(np.abs(a[..., :1]) < 0.9, [1.0, 0.0, 0.0], [0.0, 1.0, 0.0])
    axis = np.where(
        sine > 1e-12, cross / np.where(sine > 1e-12, sine, 1.0), _unit(so3.cross(a, helper))
    )
    return axis * angle


def _length(v: Array) -> Array:
    """(..., 1) of vectors (..., 3)."""
    return np.sqrt(np.sum(v * v, axis=-1, keepdims=True))


def _unit(v: Array) -> Array:
    return v / _length(v)


# A skeleton's kinematic tree as a record of arrays for numba kernels.


class KinematicTree(NamedTuple):
    """A kinematic tree of J joints with F free angles beyond the base.

    Attributes:
        parents: (J,) parent of each joint.
        offsets: (J, 3) each joint in its parent's frame, mm at home.
        rest: (J, 3, 3) rotation from the parent's frame to the joint's at home.
        axes: (J, 3) bool, the free axes.
        turning: (J,) bool, joints with a free axis.
        free: (F, 2) joint and axis of every free angle beyond the base.
        tip: joint whose direction from the base is the animal's heading.
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
        """The record of a skeleton."""
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


@dataclass(frozen=True)
class Pose(Rows):
    """Skeleton coordinates, one pose or a batch (...).

    Attributes:
        root: T_frame_root (...), the base joint in the pose's frame, mm.
        angles: (..., J, 3) rad, rotation vectors of each joint relative to its parent, zero at the
            base and on axes that are not free.
        scale: (...) of all bones.
    """

    root: SE3
    angles: Array
    scale: Array

    @staticmethod
    def home(skeleton: Skeleton, *batch: int) -> Pose:
        """The straight pose at the origin, pointing along x, or a batch of the given shape."""
        return Pose(SE3.identity(*batch), np.zeros((*batch, skeleton.n_joints, 3)), np.ones(batch))

    def frames(self, skeleton: Skeleton) -> SE3:
        """T_frame_joint of every joint, a batch (..., J), mm."""
        return SE3(*forward_kinematics(skeleton, self.root, self.angles, self.scale))

    def joints(self, skeleton: Skeleton) -> Array:
        """Joint positions (..., J, 3) mm in the pose's frame."""
        return self.frames(skeleton).translation

    def placed(self, skeleton: Skeleton) -> PlacedPose:
        """The same poses with precomputed frames of their joints."""
        return PlacedPose(self.root, self.angles, self.scale, self.frames(skeleton))

    def moved(self, T_new_old: SE3) -> Pose:
        """The same posture in another frame.

        Args:
            T_new_old: transforms the present frame to the new one; broadcasts with the batch.
        """
        return Pose(T_new_old @ self.root, self.angles, self.scale)

    @staticmethod
    def from_joints(skeleton: Skeleton, joints: ArrayLike, up: ArrayLike) -> Pose:
        """The pose (...) whose bones point along given joint positions of one chain.

        Each joint rotates by the smallest rotation that aims its bone; the base's roll is chosen so
        that its z axis is as near to `up` as its bone allows. Bones keep their proportions; the
        scale is computed from the total length.

        Args:
            skeleton: one chain of joints (mouse, fish).
            joints: (..., J, 3) mm.
            up: (3,) or (..., 3), any length.
        """
        at = np.asarray(joints, float)
        children = skeleton.next_joint
        along = at[..., 1:, :] - at[..., skeleton.parents[1:], :]
        length = np.linalg.norm(along, axis=-1)
        scale = length.sum(-1) / np.linalg.norm(skeleton.offsets[1:], axis=-1).sum()
        forward = _unit(along[..., 0, :] * np.sign(skeleton.offsets[children[0], 0]))
        # a base that points straight up or down has no yaw: use the next axis
        upward = np.broadcast_to(np.asarray(up, float), forward.shape)
        vertical = np.abs(np.sum(forward * upward, axis=-1, keepdims=True)) > 0.999 * _length(
            upward
        )
        side = _unit(so3.cross(np.where(vertical, np.roll(upward, 1, axis=-1), upward), forward))
        rotation = np.stack([forward, side, so3.cross(forward, side)], axis=-1)
        root = SE3(rotation, at[..., 0, :])
        angles = np.zeros(at.shape)
        for j in range(1, skeleton.n_joints):
            rotation = rotation @ skeleton.rest[j]
            child = children[j]
            if child < 0:
                continue
            wanted = np.einsum("...ji,...j->...i", rotation, at[..., child, :] - at[..., j, :])
            angles[..., j, :] = aim(skeleton.offsets[child], wanted)
            rotation = rotation @ so3.exp(angles[..., j, :])
        return Pose(root, angles, scale)


@dataclass(frozen=True)
class PlacedPose(Pose):
    """Poses with precomputed frames of their joints.

    Its arrays must not be modified, as the frames would become invalid. `moved` returns a plain
    `Pose`.

    Attributes:
        T_frame_joint: (..., J) frames of the joints, mm.
    """

    T_frame_joint: SE3

    def frames(self, skeleton: Skeleton) -> SE3:
        """T_frame_joint of every joint, a batch (..., J), mm."""
        return self.T_frame_joint


# Inverse kinematics: least-squares fit of poses to measured points of the body.


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
    lower, upper = np.moveaxis(skeleton.limits, -1, 0)
    pose = start
    n = len(points)
    damping = np.full(n, _DAMPING[0])
    middle = np.clip(0.0, lower, upper)
    free = KinematicTree.of(skeleton).free
    j, k = free.T
    index = np.arange(6, 6 + len(free))
    cost, residual = _cost(skeleton, pose, points, points_of_joints, middle)
    for _ in range(n_steps):
        slope = _jacobian(skeleton, pose, points_of_joints, free)
        if keep_scale:
            slope[..., -1] = 0.0
        at = pose.angles[:, j, k]
        gradient = np.einsum("nri,nr->ni", slope, residual.reshape(n, -1))
        gradient[:, index] += _REST_MM**2 * (at - middle[j, k])
        curvature = np.einsum("nri,nrk->nik", slope, slope)
        curvature[:, index, index] += _REST_MM**2
        direction = gradient[:, index]
        fixed = np.zeros(gradient.shape, bool)  # pushed against a limit
        fixed[:, index] = ((at <= lower[j, k]) & (direction > 0)) | (
            (at >= upper[j, k]) & (direction < 0)
        )
        step = _step(curvature, gradient, damping, fixed)
        tried = _after_step(pose, step, free, lower, upper)
        tried_cost, tried_residual = _cost(skeleton, tried, points, points_of_joints, middle)
        better = tried_cost < cost
        pose = Pose.join([pose, tried])[np.arange(n) + n * better]
        cost = np.where(better, tried_cost, cost)
        residual = np.where(better[:, None, None], tried_residual, residual)
        damping = np.clip(np.where(better, damping / 5.0, damping * 4.0), *_DAMPING[1:])
    return Fit(pose, np.linalg.norm(residual, axis=-1))


def _cost(
    skeleton: Skeleton, pose: Pose, points: Array, points_of_joints: Array, middle: Array
) -> tuple[Array, Array]:
    """Sum of squares (n,) and residuals (n, M, 3) mm."""
    residual = np.einsum("mj,njd->nmd", points_of_joints, pose.joints(skeleton)) - points
    bent = ((pose.angles - middle) * skeleton.axes)[:, 1:]
    return np.sum(residual**2, axis=(1, 2)) + _REST_MM**2 * np.sum(bent**2, axis=(1, 2)), residual


def _jacobian(
    skeleton: Skeleton, pose: Pose, points_of_joints: Array, free: NDArray[np.int64]
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
    index = np.arange(gradient.shape[1])
    matrix = curvature.copy()
    matrix[:, index, index] *= 1.0 + damping[:, None]
    matrix[:, index, index] += 1e-9
    matrix[fixed[:, :, None] | fixed[:, None, :]] = 0.0
    matrix[:, index, index] += fixed
    return -np.asarray(np.linalg.solve(matrix, np.where(fixed, 0.0, gradient)[..., None]), float)[
        ..., 0
    ]


def _after_step(
    pose: Pose, step: Array, free: NDArray[np.int64], lower: Array, upper: Array
) -> Pose:
    """The poses after steps (n, P)."""
    angles = pose.angles.copy()
    j, k = free.T
    angles[:, j, k] = np.clip(angles[:, j, k] + step[:, 6:-1], lower[j, k], upper[j, k])
    return Pose(
        pose.root @ SE3.exp(step[:, :6]),
        angles,
        pose.scale * np.exp(np.clip(step[:, -1], -0.3, 0.3)),
    )
