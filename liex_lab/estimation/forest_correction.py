"""Boosted regression forest that corrects all joints of the chosen pose at once (ours).

Candidates are moved by forests trained on initial poses; their weighted mean is none of them and
has errors of its own. A small forest, grown by stochastic gradient boosting (Friedman 2002) on
chosen poses of images that no other tree was grown on, predicts the residual

    x_j - x_j_hat        of every joint j, in the base's frame, at home size,

and corrects its predictable part. It is evaluated for one pose per frame, at negligible cost.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from liex_lab.body.pose import Pose
from liex_lab.estimation.cascade import Candidates, ImageSet
from liex_lab.estimation.model import Model
from liex_lab.estimation.scoring import Chosen
from liex_lab.forests.forest import Samples, predict
from liex_lab.scene.height_maps import mm_per_px

Array = NDArray[np.float64]

_LOG_UNIT = 500.0  # a threshold is an integer


def corrected(chosen: Chosen, model: Model, images: ImageSet, size: float) -> Chosen:
    """Apply the model's forest correction to chosen poses.

    Args:
        chosen: n chosen poses, view frame.
        model: the model; without a corrector the poses are unchanged.
        images: the n height maps.
        size: the animal's size over home size.

    Returns:
        The choices with corrected poses; scores and errors are kept.
    """
    if model.corrector is None or not len(chosen.score):
        return chosen
    skeleton = model.skeleton
    frames = chosen.pose.frames(model.skeleton)
    moves = predict(model.corrector, pose_samples(chosen.pose, model, images, size)).astype(float)
    moves = size * moves.reshape(len(moves), -1, 3)
    joints = frames.translation + np.einsum("nij,nkj->nki", frames.rotation[:, 0], moves)
    return replace(chosen, pose=Pose.from_joints(skeleton, joints, frames.rotation[:, 0, :, 2]))


def pose_samples(pose: Pose, model: Model, images: ImageSet, size: float) -> Samples:
    """Features of one pose per height map for the corrector.

    They are the views from all joints, the scalars of every forest, and the logarithm of the size
    of a pixel in mm, as an outline loses about a pixel on all sides.

    Args:
        pose: (n) poses, view frame.
        model: its cascade computes the features.
        images: the n height maps.
        size: the animal's size over home size.

    Returns:
        n samples with J views.
    """
    frames = pose.frames(model.skeleton)
    n = len(pose.scale)
    candidates = Candidates(
        np.arange(n, dtype=np.int32),
        frames.rotation,
        frames.translation,
        pose.scale,
        np.full(n, size),
    )
    samples = model.cascade.samples(images, candidates, list(range(model.skeleton.n_joints)))
    pixel = mm_per_px(images.crop_cameras) / size
    scalars = np.column_stack([samples.scalars, _LOG_UNIT * np.log(pixel)]).astype(np.float32)
    return replace(samples, scalars=scalars)


def moves_to(pose: Pose, model: Model, joints: Array, size: float) -> Array:
    """Labels of the corrector: the moves from a pose's joints to the true ones.

    Args:
        pose: (n) poses, view frame.
        model: gives the skeleton.
        joints: (n, J, 3) true joints, mm, view frame.
        size: the animal's size over home size.

    Returns:
        (n, 3 J) moves in the frame of the base joint, mm at home size.
    """
    frames = pose.frames(model.skeleton)
    moves = np.einsum("nji,nkj->nki", frames.rotation[:, 0], joints - frames.translation) / size
    return moves.reshape(len(moves), -1)
