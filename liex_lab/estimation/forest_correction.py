"""The last correction: the chosen pose's joints, all at once, moved by what a forest has learned of
chosen poses.

Candidates are moved by forests that were trained on starts as they come; their weighted mean is not
one of them, and is off in ways of its own. A small boosted forest that is trained on chosen poses
of images that no other tree has seen takes out what of this can be foretold. It asks about one pose
a frame and so costs next to nothing.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from liex_lab.body.pose import Pose
from liex_lab.estimation.cascade import Candidates, ImageSet, mm_per_px
from liex_lab.estimation.model import Model
from liex_lab.estimation.scoring import Chosen
from liex_lab.forests.forest import Samples, predict

Array = NDArray[np.float64]

_LOG_UNIT = 500.0  # a threshold is an integer


def corrected(chosen: Chosen, model: Model, images: ImageSet, size: float) -> Chosen:
    """The chosen poses of n frames, whose height maps are `images`, after the model's last
    correction.
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
    """What a corrector sees of one pose for each of n height maps: what lies about every joint, and
    beside the numbers that every forest sees how many mm a pixel covers, for an outline loses about
    one of them all round.
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
    pixel = mm_per_px(images.looks) / size
    scalars = np.column_stack([samples.scalars, _LOG_UNIT * np.log(pixel)]).astype(np.float32)
    return replace(samples, scalars=scalars)


def moves_to(pose: Pose, model: Model, joints: Array, size: float) -> Array:
    """What a corrector should say (n, 3 J): from the joints of the poses (n) to the true ones (n,
    J, 3) mm, seen from the base joint, at home size.
    """
    frames = pose.frames(model.skeleton)
    moves = np.einsum("nji,nkj->nki", frames.rotation[:, 0], joints - frames.translation) / size
    return moves.reshape(len(moves), -1)
