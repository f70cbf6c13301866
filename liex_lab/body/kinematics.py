"""Forward kinematics by the product of exponentials, and analytic inverse kinematics of a chain.

Lie-X section 3: with parent p, bone offset b_j, rest rotation Q_j and rotation vector w_j,

    t_j = t_p + s R_p b_j,   R_j = R_p Q_j exp(hat(w_j)).

The inverse aims the bones one by one with the smallest possible rotation.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from liex_lab.body.skeleton import Skeleton
from liex_lab.geometry import SE3, so3

Array = NDArray[np.float64]


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


def chain_from_joints(skeleton: Skeleton, joints: Array, up: Array) -> tuple[SE3, Array, Array]:
    """Root, angles and scale of the chain through given joint positions.

    For skeletons of one chain (mouse, fish): every joint but the last has exactly one child.

    Args:
        skeleton: one chain of joints.
        joints: (..., J, 3) mm.
        up: (3,) or (..., 3), desired direction of the base's z axis; if the base's bone is parallel
            to it, another axis is used.

    Returns:
        Root (...), angles (..., J, 3) rad and scale (...).
    """
    children = skeleton.next_joint
    along = joints[..., 1:, :] - joints[..., skeleton.parents[1:], :]
    length = np.linalg.norm(along, axis=-1)
    scale = length.sum(-1) / np.linalg.norm(skeleton.offsets[1:], axis=-1).sum()
    bone = skeleton.offsets[children[0]]
    forward = along[..., 0, :] * np.sign(bone[0])
    forward = _unit(forward)
    # a base that points straight up or down has no yaw: use the next axis
    up = np.broadcast_to(up, forward.shape)
    level = _length(up)
    vertical = np.abs(np.sum(forward * up, axis=-1, keepdims=True)) > 0.999 * level
    side = _unit(so3.cross(np.where(vertical, np.roll(up, 1, axis=-1), up), forward))
    rotation = np.stack([forward, side, so3.cross(forward, side)], axis=-1)
    root = SE3(rotation, joints[..., 0, :])
    angles = np.zeros(joints.shape)
    for j in range(1, skeleton.n_joints):
        rotation = rotation @ skeleton.rest[j]
        child = children[j]
        if child < 0:
            continue
        wanted = np.einsum("...ji,...j->...i", rotation, joints[..., child, :] - joints[..., j, :])
        angles[..., j, :] = aim(skeleton.offsets[child], wanted)
        rotation = rotation @ so3.exp(angles[..., j, :])
    return root, angles, scale


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
