"""The last step of an animal that is one chain, seen along the optical axis: its pose settles under
its back.

The regressors see a long animal's depth from its base joint, at one end of it. Once the whole chain
is in place, all of its back can be held against it: a linear map, fitted on pictures that no tree
has seen, takes what is seen along the mid-line to how much deeper each joint lies, how far the
chain has slid along itself, and how much larger the animal is.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from liex_lab.body.pose import Pose
from liex_lab.body.skeleton import Skeleton
from liex_lab.estimation import _profile_kernels as kernels
from liex_lab.estimation.cascade import ImageSet, mm_per_px

Array = NDArray[np.float64]

_MOST_SHARE = 0.08  # of the length: readings farther from the back than this are not the back
SURE_SHARE = 1 / 3  # of the frames tell the size: those that see most of the animal's far end
N_OTHERS = 15  # clues that are not of one joint
_RIDGE = 1e-2  # of the features' variance
_LEAST_SPREAD = 1e-6
_TAIL = 0.01  # of what a clue was seen to be: beyond it is taken for the last that was seen
# a product's last bits depend on how many frames are asked about at once, and a frame's pose must
# not
_DECIMALS = 12
# of the length, and in logarithms: poses farther off are not learned from
_SLID_SHARE = 0.1
_SIZE_LOG = 0.25


@dataclass(frozen=True)
class Settler:
    """table (F, J + 4): the least and most of each of the `clues`, and the weights that lead from
    them to the rise of each joint, the slide along the chain (both over the animal's length) and
    the logarithm of the true over the assumed size.
    """

    skeleton: Skeleton
    table: Array

    @staticmethod
    def serves(skeleton: Skeleton) -> bool:
        """Whether the animal is one chain."""
        return bool((skeleton.parents[1:] == np.arange(skeleton.n_joints - 1)).all())

    @staticmethod
    def fit(
        skeleton: Skeleton,
        pose: Pose,
        images: ImageSet,
        size: Array,
        true_joints: Array,
        true_size: Array,
    ) -> Settler:
        """From chosen poses (n) with their assumed sizes (n,) and the truth, all in the
        view frame.
        """
        joints = pose.joints(skeleton)
        features = clues(skeleton, pose, joints, images, size)
        length = skeleton.length * size
        off = (true_joints - joints) / length[:, None, None]
        slide = np.sum(off * tangents(joints), axis=-1).mean(axis=1)
        grown = np.log(true_size / size)
        labels = np.column_stack([off[..., 2], slide, grown])
        good = (np.linalg.norm(off, axis=-1).mean(axis=1) < _SLID_SHARE) & (
            np.abs(grown) < _SIZE_LOG
        )
        x = features[good]
        y = labels[good]
        bounds = np.quantile(x, [_TAIL, 1.0 - _TAIL], axis=0)
        x = np.clip(x, *bounds)
        # from all of them: those that see its far end best were mostly taken for smaller than they
        # are
        return Settler(skeleton, np.column_stack([*bounds, _linear(x, y)]))

    def settle(self, pose: Pose, images: ImageSet, size: float) -> Settled:
        """Poses (n) put right, and what each of them says about the animal's size."""
        skeleton = self.skeleton
        n = len(pose.scale)
        joints = pose.joints(skeleton)
        seen = clues(skeleton, pose, joints, images, np.full(n, size))
        told = (np.clip(seen, self.table[:, 0], self.table[:, 1]) @ self.table[:, 2:]).round(
            _DECIMALS
        )
        length = skeleton.length * size
        moved = joints + length * told[:, -2, None, None] * tangents(joints)
        moved[..., 2] += length * told[:, :-2]
        return Settled(
            Pose.from_joints(skeleton, moved, pose.root.rotation[..., 2]),
            told[:, -1],
            far_end_seen(seen),
        )


@dataclass(frozen=True)
class Settled:
    """Poses (n) under their backs; grown (n,): the logarithm of the animal's true over its assumed
    size as each tells; clear (n,): how much of the animal's far end it sees, without which no one
    knows its size.
    """

    pose: Pose
    grown: Array
    clear: Array


def _linear(x: Array, y: Array) -> Array:
    """Ridge regression: weights (F, K) from clues (n, F), of which the first is constant, to labels
    (n, K).
    """
    middle = x.mean(axis=0)
    spread = x.std(axis=0)
    per = np.where(
        spread > _LEAST_SPREAD, 1.0 / np.maximum(spread, _LEAST_SPREAD), 0.0
    )  # a constant tells nothing
    scaled = (x - middle) * per
    ridge = _RIDGE * len(x) * np.eye(x.shape[1])
    weights = (
        np.linalg.solve(scaled.T @ scaled + ridge, scaled.T @ (y - y.mean(axis=0))) * per[:, None]
    )
    weights[0] = y.mean(axis=0) - middle @ weights
    return np.asarray(weights)


def far_end_seen(seen: Array) -> Array:
    """How much (n,) is seen of the last quarter of a chain, out of `clues` (n, F)."""
    j = (seen.shape[1] - N_OTHERS) // 2
    return np.asarray(seen[:, 1 + j + 3 * j // 4 : 1 + 2 * j].mean(axis=1))


def tangents(joints: Array) -> Array:
    """Unit vectors (n, J, 3) along chains (n, J, 3), in the picture's plane."""
    way = np.gradient(joints, axis=1)
    way[..., 2] = 0.0
    return np.asarray(way / np.maximum(np.linalg.norm(way, axis=-1, keepdims=True), 1e-9))


def clues(skeleton: Skeleton, pose: Pose, joints: Array, images: ImageSet, size: Array) -> Array:
    """What is seen along the mid-lines of poses (n) with joints (n, J, 3) mm, (n, F), lengths over
    the animal's own.

    A constant, the height of the back over each joint and how much of it is seen, how far the
    animal reaches past the chain's ends, how the base lies, how much the animal is bent, how large
    a pixel is, and the bones' scale.
    """
    n, j = joints.shape[:2]
    length = skeleton.length * size
    seen = np.empty((n, 2 * j + 2))
    kernels.look_along(
        images.heights, images.looks, np.ascontiguousarray(joints), length, _MOST_SHARE, seen
    )
    share = np.minimum(seen[:, j : 2 * j] * 2.0, 1.0)
    back = np.clip(seen[:, :j] / length[:, None], -2 * _MOST_SHARE, 2 * _MOST_SHARE) * (share > 0)
    ends = seen[:, 2 * j :] / length[:, None]
    rise = pose.root.rotation[:, 2, 0]
    roll = pose.root.rotation[:, 2, 1]
    bent = np.abs(pose.angles[..., 2]).sum(axis=1)
    pixel = mm_per_px(images.looks) / length
    return np.column_stack(
        [
            np.ones(n),
            back,
            share,
            ends,
            ends**2,
            rise,
            np.abs(rise),
            rise**2,
            np.abs(roll),
            roll**2,
            bent,
            pixel,
            ends * pixel[:, None],
            np.log(pose.scale / size),
        ]
    )
