"""Forward kinematics in batches, and its inverse for chains of known joint positions."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from liex_lab.body.skeleton import Skeleton
from liex_lab.geometry import SE3, so3

Array = NDArray[np.float64]


def forward_kinematics(skeleton: Skeleton, root: SE3, angles: Array, scale: Array) -> tuple[Array, Array]:
    """Joint rotations (..., J, 3, 3) and positions (..., J, 3) mm by the product of exponentials (Lie-X section 3).

    root: T_frame_root (...); angles (..., J, 3) rad relative to the parent; scale (...) of the bones.
    """
    local = skeleton.rest @ so3.exp(angles)
    n_joints = skeleton.n_joints
    rotation = np.empty((*root.translation.shape[:-1], n_joints, 3, 3))
    position = np.empty((*root.translation.shape[:-1], n_joints, 3))
    rotation[..., 0, :, :], position[..., 0, :] = root.rotation, root.translation
    size = np.asarray(scale, float)[..., None]
    for j in range(1, n_joints):
        parent = skeleton.parents[j]
        offset = np.einsum("...ij,j->...i", rotation[..., parent, :, :], skeleton.offsets[j])
        position[..., j, :] = position[..., parent, :] + size * offset
        rotation[..., j, :, :] = rotation[..., parent, :, :] @ local[..., j, :, :]
    return rotation, position


def aim(direction_from: Array, direction_to: Array) -> Array:
    """The smallest rotation vectors (..., 3) rad that turn directions (..., 3) onto others (..., 3).

    Opposite directions have no smallest rotation; they turn by pi about some perpendicular axis.
    """
    a = direction_from / np.linalg.norm(direction_from, axis=-1, keepdims=True)
    b = direction_to / np.linalg.norm(direction_to, axis=-1, keepdims=True)
    a, b = np.broadcast_arrays(a, b)
    cross = np.cross(a, b)
    sine = np.linalg.norm(cross, axis=-1, keepdims=True)
    angle = np.arctan2(sine, np.sum(a * b, axis=-1, keepdims=True))
    # any axis perpendicular to a will do when the cross product vanishes
    helper = np.where(np.abs(a[..., :1]) < 0.9, [1.0, 0.0, 0.0], [0.0, 1.0, 0.0])
    perpendicular = np.cross(a, helper)
    perpendicular = perpendicular / np.linalg.norm(perpendicular, axis=-1, keepdims=True)
    axis = np.where(sine > 1e-12, cross / np.where(sine > 1e-12, sine, 1.0), perpendicular)
    return axis * angle


def chain_from_joints(skeleton: Skeleton, joints: Array, up: Array) -> tuple[SE3, Array, Array]:
    """Root (...), angles (..., J, 3) and scale (...) of the chain through joint positions (..., J, 3) mm.

    up (3,) or (..., 3) is where the base's z axis should point as far as its bone allows. Serves skeletons of one chain
    (mouse, fish): every joint but the last has exactly one child.
    """
    children = skeleton.next_joint
    along = joints[..., 1:, :] - joints[..., skeleton.parents[1:], :]
    length = np.linalg.norm(along, axis=-1)
    scale = length.sum(-1) / np.linalg.norm(skeleton.offsets[1:], axis=-1).sum()
    bone = skeleton.offsets[children[0]]
    forward = along[..., 0, :] * np.sign(bone[0])
    forward = forward / np.linalg.norm(forward, axis=-1, keepdims=True)
    # a base that points straight up or down has no yaw of its own: lean on the next axis
    up = np.broadcast_to(up, forward.shape)
    level = np.linalg.norm(up, axis=-1, keepdims=True)
    vertical = np.abs(np.sum(forward * up, axis=-1, keepdims=True)) > 0.999 * level
    side = np.cross(np.where(vertical, np.roll(up, 1, axis=-1), up), forward)
    side = side / np.linalg.norm(side, axis=-1, keepdims=True)
    rotation = np.stack([forward, side, np.cross(forward, side)], axis=-1)
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
