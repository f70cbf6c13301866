"""Candidate selection: weighted mean of the best-scored poses on the manifold; expected error.

Lie-X Algorithm 1 returns the candidate with the lowest score of the learned metric. Here the best k
candidates near that one are averaged with weights

    w_i ~ exp(-(score_i - score_best) / tau);

rotations use the chordal mean, the polar projection of sum_i w_i R_i, or follow from the mean
joints. A boosted forest then predicts the mean joint error of the chosen pose from its scores, its
spread and the posture (the "expectation forest", ours).

Candidates are moved by forests trained on initial poses; their weighted mean is a new pose
with errors of its own. A small forest, grown by stochastic gradient boosting (Friedman 2002) on
chosen poses of images that no other tree was grown on, predicts the residual x_j - x_j_hat of every
joint j, in the base's frame, at home size, and corrects its predictable part (the "forest
correction", ours). It is evaluated for one pose per frame, at negligible cost.
"""

from dataclasses import dataclass, fields, replace

import numpy as np

from liex_lab.arrays import Array, NDArray
from liex_lab.body.pose import Pose
from liex_lab.body.skeleton import Skeleton
from liex_lab.estimation.cascade import Candidates, ImageSet
from liex_lab.estimation.method import Method
from liex_lab.estimation.model import ErrorCalibration, Model
from liex_lab.forests._kernels import VIEW
from liex_lab.forests.forest import Samples, predict
from liex_lab.geometry import SE3, so3
from liex_lab.runtime.memory import Rows
from liex_lab.scene.height_maps import mm_per_px, moment_columns

LOG_UNIT = 10.0  # of logarithms that a forest predicts: its leaves are kept as float16
LEAST_MM = 0.1  # least expected error, at the reference length


@dataclass(frozen=True)
class Chosen(Rows):
    """One pose for each of n frames, in the view frame of the frame; NaN if no animal was found.

    Attributes:
        pose: (n) poses; `choose` includes the frames of their joints.
        sd_root: (n, 6) standard deviation of the root over candidates, rad and mm, in its own
            frame.
        sd_angles: (n, J, 3) standard deviation of the joints' rotation vectors over candidates,
            rad.
        sd_mm: (n, J) expected standard deviation of each joint along one axis, mm.
        error_mm: (n,) expected mean joint error, mm.
        score: (n,) weighted mean of the scores, mm at home size.
        spread: (n,) spread of the averaged candidates about the chosen pose, mm at home size.
        doubts: (n, 4) evidence against the pose, mm at home size: the best score, the best score of
            a candidate in the opposite direction, the standard deviation of the good scores, and
            the mean distance of all candidates from the pose.
        fit: (n, F) residuals of the pose against the height map if the method uses them, else F =
            0, see `_residual_kernels.explain`.
        frame_scale: (n,) the animal's size over home size as estimated from this frame alone.
        scale_trust: (n,) reliability of that size, higher is better.
    """

    pose: Pose
    sd_root: Array
    sd_angles: Array
    sd_mm: Array
    error_mm: Array
    score: Array
    spread: Array
    doubts: Array
    fit: Array
    frame_scale: Array
    scale_trust: Array

    def spread_over(self, usable: NDArray[np.bool_]) -> "Chosen":
        """These poses as the usable ones of n frames, in order; rows of NaN elsewhere."""

        def rows(values: Array) -> Array:
            """Rows of all frames, NaN where the frame is not usable."""
            out = np.full((len(usable), *values.shape[1:]), np.nan)
            out[usable] = values
            return out

        pose = self.pose
        root = SE3(rows(pose.root.rotation), rows(pose.root.translation))
        others = (rows(getattr(self, field.name)) for field in fields(self)[1:])
        return Chosen(Pose(root, rows(pose.angles), rows(pose.scale)), *others)


def choose(
    skeleton: Skeleton,
    method: Method,
    calibration: ErrorCalibration,
    size: float,
    rotations: Array,
    positions: Array,
    scores: Array,
) -> Chosen:
    """Average the best candidates of each frame on the manifold.

    The `top_k` candidates with the lowest predicted error near the best one are averaged with
    weights exp(-(score - best) / tau). In an unbranched skeleton each bone then rotates by the
    smallest rotation onto its mean direction, and the scale follows from the total length; a
    branched one is averaged joint by joint, see `mean_pose`.

    Args:
        skeleton: the animal's skeleton.
        method: states top_k, tau and the radius of the average.
        calibration: converts score and spread to an expected error.
        size: the animal's size over home size.
        rotations: (n, K, J, 3, 3) joint frames of the candidates, view frame.
        positions: (n, K, J, 3) joints of the candidates, mm, view frame.
        scores: (n, K) predicted errors, mm at home size.

    Returns:
        The chosen poses with spreads and expected errors.
    """
    order = np.argsort(scores, axis=1, kind="stable")[:, : method.top_k]
    score = np.take_along_axis(scores, order, axis=1)
    joints = np.take_along_axis(positions, order[..., None, None], axis=1)
    turned = np.take_along_axis(rotations, order[..., None, None, None], axis=1)
    near = np.linalg.norm(joints - joints[:, :1], axis=-1).mean(-1) < method.top_radius_mm * size
    weight = np.where(near, np.exp(-(score - score[:, :1]) / method.top_tau), 0.0)
    weight = weight / weight.sum(axis=1, keepdims=True)
    mean = np.einsum("nk,nkjd->njd", weight, joints)
    if skeleton.is_chain:
        pose = Pose.from_joints(
            skeleton, mean, np.einsum("nk,nkd->nd", weight, turned[:, :, 0, :, 2])
        ).placed(skeleton)
    else:
        pose = mean_pose(skeleton, turned, joints, weight).placed(skeleton)
        mean = pose.joints(skeleton)
    distance = np.linalg.norm(joints - mean[:, None], axis=-1)
    variance = np.einsum("nk,nkj->nj", weight, distance**2)
    mean_score = np.sum(weight * score, axis=1)
    spread = np.sqrt(variance.mean(axis=1)) / size
    expected = (
        calibration.offset + calibration.slope * mean_score + calibration.spread_slope * spread
    )
    expected = np.maximum(expected, LEAST_MM * skeleton.relative_size) * size
    share = np.array(calibration.joint_share or (1.0,) * skeleton.n_joints)
    # of three equal components, see columns.json
    sd_mm = expected[:, None] * share / np.sqrt(3.0)
    sd_root, sd_angles = _spread_of_coordinates(skeleton, pose, turned, joints, weight)
    # the score of the opposite direction if no candidate has it
    doubts = _doubts(positions, scores, mean, score, size, 40.0 * skeleton.relative_size)
    return Chosen(
        pose,
        sd_root,
        sd_angles,
        sd_mm,
        expected,
        mean_score,
        spread,
        doubts,
        np.zeros((len(score), 0)),
        pose.scale,
        -mean_score,
    )


def mean_pose(skeleton: Skeleton, turned: Array, joints: Array, weight: Array) -> Pose:
    """Weighted mean of poses of a kinematic tree, on the group.

    The base has the chordal mean rotation and the mean position. Every other joint has the mean of
    its rotation vectors relative to its parent about its free axes, so bones keep their lengths and
    hinges their axes; the scale is the mean scale.

    Args:
        skeleton: the animal's skeleton.
        turned: (n, k, J, 3, 3) joint frames of the k poses of each mean.
        joints: (n, k, J, 3) their joints, mm.
        weight: (n, k) weights of sum 1.

    Returns:
        (n) mean poses.
    """
    root = SE3(
        so3.nearest_rotation(np.einsum("nk,nkab->nab", weight, turned[:, :, 0])),
        np.einsum("nk,nkd->nd", weight, joints[:, :, 0]),
    )
    moving = np.array(skeleton.solved[1:])
    parents = skeleton.parents[moving]
    local = (
        np.swapaxes(turned[:, :, parents] @ skeleton.rest[moving], -1, -2) @ turned[:, :, moving]
    )
    angles = np.zeros((len(turned), skeleton.n_joints, 3))
    angles[:, moving] = np.einsum("nk,nkjd->njd", weight, so3.log(local)) * skeleton.axes[moving]
    bones = joints[:, :, 1:] - joints[:, :, skeleton.parents[1:]]
    length = np.einsum("nk,nk->n", weight, np.linalg.norm(bones, axis=-1).sum(axis=2))
    return Pose(root, angles, length / np.linalg.norm(skeleton.offsets[1:], axis=-1).sum())


def with_best(
    skeleton: Skeleton, pose: Pose, k: int, rotations: Array, positions: Array, scores: Array
) -> Pose:
    """Add the best-scored candidates of each frame to given poses.

    Args:
        skeleton: the animal's skeleton.
        pose: (n) poses.
        k: number of candidates to add per frame.
        rotations: (n, K, J, 3, 3) joint frames of the candidates, view frame.
        positions: (n, K, J, 3) joints of the candidates, mm, view frame.
        scores: (n, K) predicted errors.

    Returns:
        (n, 1 + k) poses: the given one, then the k candidates with the lowest scores.
    """
    order = np.argsort(scores, axis=1, kind="stable")[:, :k]
    n, k, j = *order.shape, skeleton.n_joints
    turned = np.take_along_axis(rotations, order[..., None, None, None], axis=1).reshape(
        n * k, 1, j, 3, 3
    )
    joints = np.take_along_axis(positions, order[..., None, None], axis=1).reshape(n * k, 1, j, 3)
    best = mean_pose(skeleton, turned, joints, np.ones((n * k, 1)))

    def beside(first: Array, others: Array) -> Array:
        """`first` (n, ...) and `others` (n k, ...) as one array (n, 1 + k, ...)."""
        return np.concatenate([first[:, None], others.reshape(n, k, *first.shape[1:])], axis=1)

    root = SE3(
        beside(pose.root.rotation, best.root.rotation),
        beside(pose.root.translation, best.root.translation),
    )
    return Pose(root, beside(pose.angles, best.angles), beside(pose.scale, best.scale))


def _doubts(
    positions: Array, scores: Array, mean: Array, good: Array, size: float, no_opposite_mm: float
) -> Array:
    """`Chosen.doubts` of all candidates.

    Computed from the chosen joints (n, J, 3) and the scores (n, k) of the averaged candidates; the
    direction of a pose is that from its base to its last joint, as in the training of the bundled
    models' expectation forests (the tip of a chain, the little finger's of a hand).
    """
    along = positions[:, :, -1] - positions[:, :, 0]
    backwards = np.einsum("nkd,nd->nk", along, mean[:, -1] - mean[:, 0]) < 0
    opposite = np.where(backwards, scores, no_opposite_mm).min(axis=1)
    distance = np.linalg.norm(positions - mean[:, None], axis=-1).mean(axis=(1, 2)) / size
    return np.stack([scores.min(axis=1), opposite, good.std(axis=1), distance], axis=1)


def with_expected_error(chosen: Chosen, model: Model, images: ImageSet, size: float) -> Chosen:
    """Replace the expected errors by predictions of the model's expectation forest.

    Args:
        chosen: n chosen poses.
        model: the model; without an expectation forest nothing changes.
        images: the n height maps.
        size: the animal's size over home size.

    Returns:
        The same poses with new error_mm, and sd_mm scaled alike.
    """
    if model.expectation is None or not len(chosen.score):
        return chosen
    samples = clue_samples(chosen, model.skeleton, images, size)
    error = predict(model.expectation, samples)[:, 0].astype(float)
    if model.calibration.logarithmic:
        error = np.exp(error / LOG_UNIT)
    error = np.maximum(error, LEAST_MM * model.skeleton.relative_size) * size
    return replace(chosen, error_mm=error, sd_mm=chosen.sd_mm * (error / chosen.error_mm)[:, None])


def clue_samples(chosen: Chosen, skeleton: Skeleton, images: ImageSet, size: float) -> Samples:
    """Features of chosen poses for the expectation forest: numbers only, no depth.

    They are scores and doubts, the posture, the animal's visible size, roundness and height, the
    size of a pixel in mm, the spreads over candidates, and the residuals against the height map.
    Lengths are those of an animal of the reference length; all numbers are in hundredths.

    Args:
        chosen: n chosen poses.
        skeleton: the animal's skeleton.
        images: the n height maps.
        size: the animal's size over home size.

    Returns:
        n samples whose scalars are the features, on a blank height map.
    """
    pose = chosen.pose
    unit = skeleton.relative_size
    whole = size * skeleton.relative_size
    blob = moment_columns(images.moments)
    clues = np.stack(
        [
            chosen.score / unit,
            chosen.spread / unit,
            *chosen.doubts.T / unit,
            10 * pose.root.rotation[:, 2, 0],
            10 * pose.root.rotation[:, 2, 1],
            10 * np.abs(pose.angles).sum(axis=(1, 2)),
            10 * pose.scale / size,
            5 * np.log(np.maximum(blob.area_mm2, 1.0) / size**2),
            5 * np.log(np.maximum(blob.volume_mm3, 1.0) / size**3),
            blob.sd_along / whole,
            blob.sd_across / whole,
            10 * (mm_per_px(images.crop_cameras) / whole),
            *chosen.sd_root.T[:3] * 10,
            *chosen.sd_root.T[3:] / whole,
            10 * chosen.sd_angles.sum(axis=(1, 2)),
            *chosen.fit.T / 50,
        ],
        axis=1,
    )
    return blank_samples((100.0 * clues).astype(np.float32))


def blank_samples(scalars: NDArray[np.float32]) -> Samples:
    """Samples of scalars (n, F) alone, on one blank height map."""
    n = len(scalars)
    blank = np.zeros((1, 2, 2), np.int16), np.zeros(n, np.int32), np.ones(n, np.float32)
    return Samples(*blank, np.zeros((n, 1, VIEW), np.float32), scalars)


def _spread_of_coordinates(
    skeleton: Skeleton, pose: Pose, turned: Array, joints: Array, weight: Array
) -> tuple[Array, Array]:
    """Standard deviations of candidates about the chosen pose.

    Of the root's twist (n, 6) and of the joints' rotation vectors (n, J, 3).
    """
    root = SE3(pose.root.rotation[:, None], pose.root.translation[:, None])
    twist = (root.inverse() @ SE3(turned[:, :, 0], joints[:, :, 0])).log()
    sd_root = np.sqrt(np.einsum("nk,nkd->nd", weight, twist**2))
    mean = pose.frames(skeleton).rotation
    moving = np.array(skeleton.solved[1:])
    parents = skeleton.parents[moving]
    local = np.swapaxes(turned[:, :, parents], -1, -2) @ turned[:, :, moving]
    mean_local = np.swapaxes(mean[:, parents], -1, -2) @ mean[:, moving]
    turn = so3.log(np.swapaxes(mean_local, -1, -2)[:, None] @ local)
    sd_angles = np.zeros((*mean.shape[:2], 3))
    sd_angles[:, moving] = (
        np.sqrt(np.einsum("nk,nkjd->njd", weight, turn**2)) * skeleton.axes[moving]
    )
    return sd_root, sd_angles


# Forest correction of the chosen pose.


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
    frames = chosen.pose.frames(model.skeleton)
    moves = predict(model.corrector, pose_samples(chosen.pose, model, images, size)).astype(float)
    moves = size * moves.reshape(len(moves), -1, 3)
    base = frames.rotation[:, 0]
    joints = frames.translation + np.einsum("nij,nkj->nki", base, moves)
    return replace(chosen, pose=Pose.from_joints(model.skeleton, joints, base[:, :, 2]))


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
    # a threshold is an integer
    scalars = np.column_stack([samples.scalars, 500.0 * np.log(pixel)]).astype(np.float32)
    return replace(samples, scalars=scalars)
