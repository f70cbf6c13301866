"""Ridge regression that corrects the chosen pose of an unbranched animal by the back above it.

For animals viewed along the optical axis. The regressors estimate a long animal's depth from its
base joint, at one end of it. Once the whole spine is in place, all of its back can be compared with
it (ours). A linear map fitted by ridge regression (Hoerl and Kennard 1970),

    W = (X^T X + lambda n I)^-1 X^T Y        on standardised features X, lambda = 0.01,

on images that no tree was grown on, maps observations along the mid-line to the depth error of each
joint, the displacement of the spine along itself, and the relative error of the animal's size.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from liex_lab.body.pose import Pose
from liex_lab.body.skeleton import Skeleton
from liex_lab.estimation import _feature_kernels as kernels
from liex_lab.estimation.cascade import ImageSet
from liex_lab.runtime.shapes import check_shapes
from liex_lab.scene.height_maps import mm_per_px

Array = NDArray[np.float64]

_MOST_SHARE = 0.08  # of the length: readings farther from the back than this are not the back
SURE_SHARE = (
    1 / 3
)  # share of the frames used for the size: those that show most of the animal's far end
N_OTHERS = 15  # clues that are not of one joint
_RIDGE = 1e-2  # of the features' variance
_LEAST_SPREAD = 1e-6
_TAIL = 0.01  # quantile of a clue in training at which it is clipped
# a product's last bits depend on the batch size, and a frame's pose must not
_DECIMALS = 12
# of the length, and in logarithms: poses with larger errors are excluded
_SLID_SHARE = 0.1
_SIZE_LOG = 0.25


@dataclass(frozen=True)
class RidgeCorrection:
    """The fitted correction.

    Attributes:
        skeleton: the animal's skeleton, one unbranched chain.
        table: (F, J + 4), by columns: the least and the most of each feature of `clues` (beyond
            which it is clipped), then the weights of the features for the rise of each joint (J),
            the slide along the spine (both over the animal's length), and the logarithm of the true
            over the assumed size.
    """

    skeleton: Skeleton
    table: Array

    @staticmethod
    def serves(skeleton: Skeleton) -> bool:
        """Whether the correction applies: the skeleton is one unbranched chain."""
        return bool((skeleton.parents[1:] == np.arange(skeleton.n_joints - 1)).all())

    @staticmethod
    def fit(
        skeleton: Skeleton,
        pose: Pose,
        images: ImageSet,
        size: Array,
        true_joints: Array,
        true_size: Array,
    ) -> RidgeCorrection:
        """Fit the correction to chosen poses with known truth.

        Poses with an error of a tenth of the length or more, or of 0.25 in the logarithm of the
        size, are excluded. Features are clipped to their 1 % and 99 % quantiles.

        Args:
            skeleton: the animal's skeleton, one unbranched chain.
            pose: (n) chosen poses, view frame.
            images: n height maps with their crop cameras and moments.
            size: (n,) assumed size over home size.
            true_joints: (n, J, 3) true joints, mm, view frame.
            true_size: (n,) true size over home size.
        """
        joints = pose.joints(skeleton)
        features = clues(skeleton, pose, joints, images, size)
        length = skeleton.length * size
        error = (true_joints - joints) / length[:, None, None]
        slide = np.sum(error * tangents(joints), axis=-1).mean(axis=1)
        grown = np.log(true_size / size)
        labels = np.column_stack([error[..., 2], slide, grown])
        good = (np.linalg.norm(error, axis=-1).mean(axis=1) < _SLID_SHARE) & (
            np.abs(grown) < _SIZE_LOG
        )
        x = features[good]
        y = labels[good]
        bounds = np.quantile(x, [_TAIL, 1.0 - _TAIL], axis=0)
        x = np.clip(x, *bounds)
        # from all of them: those that show its far end best were mostly underestimated in size
        return RidgeCorrection(skeleton, np.column_stack([*bounds, _linear(x, y)]))

    def correct(self, pose: Pose, images: ImageSet, size: float) -> CorrectedRidge:
        """Correct poses, and estimate the animal's size from each of them.

        Args:
            pose: (n) chosen poses, view frame.
            images: n height maps with their crop cameras and moments.
            size: assumed size over home size.

        Returns:
            The corrected poses with their estimates of the size.
        """
        skeleton = self.skeleton
        n = len(pose.scale)
        joints = pose.joints(skeleton)
        features = clues(skeleton, pose, joints, images, np.full(n, size))
        correction = (
            np.clip(features, self.table[:, 0], self.table[:, 1]) @ self.table[:, 2:]
        ).round(_DECIMALS)
        length = skeleton.length * size
        moved = joints + length * correction[:, -2, None, None] * tangents(joints)
        moved[..., 2] += length * correction[:, :-2]
        return CorrectedRidge(
            Pose.from_joints(skeleton, moved, pose.root.rotation[..., 2]),
            correction[:, -1],
            far_end_visibility(features),
        )


@dataclass(frozen=True)
class CorrectedRidge:
    """Corrected poses and an estimate of the animal's size from each.

    Attributes:
        pose: (n) poses, view frame.
        grown: (n,) logarithm of the animal's true over its assumed size, as each pose estimates it.
        clear: (n,) in [0, 1], visible share of the animal's far end, which the size estimate
            requires.
    """

    pose: Pose
    grown: Array
    clear: Array


def _linear(x: Array, y: Array) -> Array:
    """Ridge regression from features (n, F), of which the first is constant, to labels (n, K).

    Returns the weights (F, K) for features that are not standardised.
    """
    middle = x.mean(axis=0)
    spread = x.std(axis=0)
    per = np.where(
        spread > _LEAST_SPREAD, 1.0 / np.maximum(spread, _LEAST_SPREAD), 0.0
    )  # a constant has no information
    scaled = (x - middle) * per
    ridge = _RIDGE * len(x) * np.eye(x.shape[1])
    weights = (
        np.linalg.solve(scaled.T @ scaled + ridge, scaled.T @ (y - y.mean(axis=0))) * per[:, None]
    )
    weights[0] = y.mean(axis=0) - middle @ weights
    return np.asarray(weights)


def far_end_visibility(features: Array) -> Array:
    """Visible share (n,), in [0, 1], of the last quarter of a chain of joints.

    Args:
        features: (n, F) features of `clues`.
    """
    j = (features.shape[1] - N_OTHERS) // 2
    return np.asarray(features[:, 1 + j + 3 * j // 4 : 1 + 2 * j].mean(axis=1))


def tangents(joints: Array) -> Array:
    """Unit tangents of chains of joints, in the image plane.

    Args:
        joints: (n, J, 3) joints, mm, view frame.

    Returns:
        (n, J, 3) unit vectors from base to tip with z = 0.
    """
    tangent = np.gradient(joints, axis=1)
    tangent[..., 2] = 0.0
    return np.asarray(tangent / np.maximum(np.linalg.norm(tangent, axis=-1, keepdims=True), 1e-9))


def clues(skeleton: Skeleton, pose: Pose, joints: Array, images: ImageSet, size: Array) -> Array:
    """Features of a pose against the height map along its mid-line.

    They are a constant, the height of the back over each joint (J) and its visible share (J), the
    extent of the animal past the ends of the chain and the square of that, the slope and roll of
    the base, the total bend, the size of a pixel, and the scale of the bones. Lengths are over the
    animal's own.

    Args:
        skeleton: the animal's skeleton, one unbranched chain.
        pose: (n) poses, view frame.
        joints: (n, J, 3) their joints, mm.
        images: n height maps with their crop cameras and moments.
        size: (n,) assumed size over home size.

    Returns:
        (n, F) features, F = 2 J + N_OTHERS.
    """
    n = len(images.heights)
    j = skeleton.n_joints
    check_shapes("poses", ("joints", joints, (n, j, 3)), ("size", size, (n,)))
    length = skeleton.length * size
    profile = np.empty((n, 2 * j + 2))
    kernels.back_profiles(
        images.heights,
        images.crop_cameras,
        np.ascontiguousarray(joints),
        length,
        _MOST_SHARE,
        profile,
    )
    share = np.minimum(profile[:, j : 2 * j] * 2.0, 1.0)
    back = np.clip(profile[:, :j] / length[:, None], -2 * _MOST_SHARE, 2 * _MOST_SHARE) * (
        share > 0
    )
    ends = profile[:, 2 * j :] / length[:, None]
    rise = pose.root.rotation[:, 2, 0]
    roll = pose.root.rotation[:, 2, 1]
    bent = np.abs(pose.angles[..., 2]).sum(axis=1)
    pixel = mm_per_px(images.crop_cameras) / length
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
