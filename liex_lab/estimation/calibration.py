"""Stacking on held-out images: corrections, head-tail classifier and error calibration of a model.

Learning from a model's own choices requires images that no tree was grown on (stacked
generalisation, Wolpert 1992): the forest correction and the ridge correction of the chosen pose,
the head-tail classifier, and the expectation forest, which predicts the error of a chosen pose in
mm. The last is calibrated by cross-fitting: the 5 % and 95 % quantiles of true over predicted error
come from predictions for folds excluded from the forest's training (as in split conformal
prediction).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from liex_lab.body.pose import Pose
from liex_lab.estimation.cascade import ImageSet
from liex_lab.estimation.estimator import PoseEstimator
from liex_lab.estimation.forest_correction import moves_to, pose_samples
from liex_lab.estimation.head_tail import HeadTailClassifier, both_directions, laid_along
from liex_lab.estimation.model import ErrorCalibration, Model
from liex_lab.estimation.ridge_correction import RidgeCorrection
from liex_lab.estimation.scoring import LEAST_MM, LOG_UNIT, Chosen, clue_samples
from liex_lab.estimation.training import TrainingSet, quantised
from liex_lab.forests.forest import Samples, predict
from liex_lab.forests.grow import GrowthPlan, boost_forest
from liex_lab.scene.height_maps import HeightMaps, crop_columns

Array = NDArray[np.float64]

_CAP_MM = 25.0  # at the reference length; a lost pose must not dominate the calibration
# standard deviation (log) of a session's size, estimated over many frames with the ridge
# correction, and without
_SIZE_SD = 0.05
_SETTLED_SIZE_SD = 0.02
_GUESS_SD = 0.08
_DOUBTFUL_SHARE = 0.97  # of ordinary images are trusted
_GROUP = 50  # images share a size guess, as the frames of a recording do
_EXPECTATION = GrowthPlan(
    n_trees=120,
    max_depth=6,
    min_leaf=40,
    n_tests=60,
    one_probe_share=0.0,
    scalar_share=1.0,
    depth_share=0.3,
    bag_share=0.5,
)
_SHRINKAGE = 0.12
# at the reference length: larger errors are gross
_CORRECTED_MM = 12.0
_CORRECTION_SHRINKAGE = 0.1
_FOLDS = 4


@dataclass(frozen=True)
class Trial:
    """A model's own choices for n images with known truth.

    Attributes:
        score: (n,) score of the chosen pose, mm at home size.
        spread: (n,) spread of the averaged candidates, mm at home size.
        joint_error: (n, J) distance of each joint from the truth, mm at home size.
        clues: n samples, the features of the expectation forest.
    """

    score: Array
    spread: Array
    joint_error: Array
    clues: Samples


@dataclass(frozen=True)
class _Group:
    """Images that share a guess of the size, as the frames of a recording do.

    Attributes:
        rows: (m,) their rows in the set.
        images: their height maps.
        size: the guess over home size.
        chosen: the model's choices for them.
        positions: (m, K, J, 3) their candidates, mm, view frame.
        scores: (m, K) scores of the candidates, mm at home size.
    """

    rows: NDArray[np.int64]
    images: ImageSet
    size: float
    chosen: Chosen
    positions: Array
    scores: Array


def _choices(
    model: Model, data: TrainingSet, rng: np.random.Generator, size_sd: float = _SIZE_SD
) -> Iterator[_Group]:
    """Let a model choose poses for the images of animals.

    In order of size; each group of images shares one guess of the size, with an error of `size_sd`
    (log).
    """
    animals = np.flatnonzero(data.animal)
    order = animals[np.argsort(data.size[animals], kind="stable")]
    estimator = PoseEstimator(model)
    for rows in np.array_split(order, max(1, len(order) // _GROUP)):
        size = float(np.median(data.size[rows]) * np.exp(size_sd * rng.standard_normal()))
        size = size if model.method.session_size else 1.0
        images = data.images[rows]
        crop_cameras = images.crop_cameras
        camera = crop_columns(crop_cameras)
        crops = HeightMaps(
            images.heights,
            np.stack([camera.u0, camera.v0], axis=-1).astype(np.int32),
            camera.step.astype(np.int32),
            np.full(len(rows), 1),
            images.moments,
            camera.distance,
            np.ones(len(rows), np.int64),
        )
        rotations, positions, _, scores = estimator.candidates(crops, crop_cameras, size)
        chosen = estimator.pick(images, size, rotations, positions, scores)
        yield _Group(rows, images, size, chosen, positions, scores)


def run_on(model: Model, data: TrainingSet, rng: np.random.Generator) -> Trial:
    """Let a model choose poses for images with truth, and measure their errors.

    Args:
        model: the model.
        data: images with truth; those without an animal are excluded.
        rng: source of the errors of the assumed sizes.

    Returns:
        Scores, spreads, errors and features of the choices, in order of the animals' size.
    """
    skeleton = model.skeleton
    scores_of = []
    spreads = []
    joint_errors = []
    clues = []
    for group in _choices(
        model, data, rng, _SIZE_SD if model.settler is None else _SETTLED_SIZE_SD
    ):
        picked = group.chosen
        images = group.images
        joint_error = np.linalg.norm(
            picked.pose.joints(skeleton) - data.truth.positions[group.rows], axis=-1
        )
        scores_of.append(picked.score)
        spreads.append(picked.spread)
        joint_errors.append(joint_error / group.size)
        blank = clue_samples(picked, skeleton, images.moments, images.crop_cameras, group.size)
        clues.append(blank.scalars)
    scalars = np.concatenate(clues)
    n = len(scalars)
    samples = Samples(
        blank.heights,
        np.zeros(n, np.int32),
        np.ones(n, np.float32),
        np.zeros((n, 1, blank.views.shape[2]), np.float32),
        scalars,
    )
    return Trial(
        np.concatenate(scores_of), np.concatenate(spreads), np.concatenate(joint_errors), samples
    )


def with_corrector(model: Model, data: TrainingSet, rng: np.random.Generator) -> Model:
    """Add the forest correction of chosen poses, learned on images that no tree was grown on.

    Poses with a gross error, such as the wrong direction, are excluded. Branched skeletons have no
    such correction, as their poses are not determined by the positions of their joints.

    Args:
        model: the model; returned unchanged if its method has no corrector.
        data: held-out images with truth.
        rng: source of size errors, bags and seeds.
    """
    plan = model.method.corrector
    worst = _CORRECTED_MM * model.skeleton.relative_size
    if plan is None or not model.skeleton.is_chain:
        return model
    parts = []
    moves = []
    for group in _choices(model, data, rng):
        true = data.truth.positions[group.rows]
        joint_error = np.linalg.norm(group.chosen.pose.joints(model.skeleton) - true, axis=-1).mean(
            axis=1
        )
        near = np.flatnonzero(joint_error < worst * group.size)
        samples = pose_samples(group.chosen.pose, model, group.images, group.size)
        samples = Samples(
            data.images.heights,
            group.rows.astype(np.int32),
            samples.inverse_size,
            samples.views,
            samples.scalars,
        )
        parts.append(samples[near])
        moves.append(moves_to(group.chosen.pose, model, true, group.size)[near])
    labels = np.concatenate(moves).astype(np.float32)
    return replace(
        model,
        corrector=quantised(
            boost_forest(Samples.join(parts), labels, plan, _CORRECTION_SHRINKAGE, rng)
        ),
    )


def with_settler(model: Model, data: TrainingSet, rng: np.random.Generator) -> Model:
    """Add the ridge correction of chosen poses, learned on images that no tree was grown on.

    Args:
        model: the model; returned unchanged if its method has no ridge correction.
        data: held-out images with truth.
        rng: source of the errors of the assumed sizes.
    """
    if not model.method.settle:
        return model
    groups = list(_choices(model, data, rng, _GUESS_SD))
    rows = np.concatenate([group.rows for group in groups])
    sizes = np.concatenate([np.full(len(group.rows), group.size) for group in groups])
    pose = Pose.join([group.chosen.pose for group in groups])
    settler = RidgeCorrection.fit(
        model.skeleton, pose, data.images[rows], sizes, data.truth.positions[rows], data.size[rows]
    )
    return replace(model, settler=settler.table)


def with_facing(model: Model, data: TrainingSet, seed: int) -> Model:
    """Add the head-tail classifier, learned on images that no tree was grown on.

    It learns from the best candidate of each direction.

    Args:
        model: the model; returned unchanged if its method has no such classifier.
        data: held-out images with truth.
        seed: of the size errors and of the network's training.
    """
    skeleton = model.skeleton
    if not model.method.tells_facing:
        return model
    resampled = []
    right = []
    for group in _choices(model, data, np.random.default_rng(seed)):
        true = data.truth.positions[group.rows]
        along = true[:, skeleton.tip] - true[:, 0]
        best, opposite, behind, _ = both_directions(group.positions, group.scores, skeleton.tip)
        for k, there in (
            (best, np.isfinite(group.scores.min(axis=1))),
            (opposite, np.isfinite(behind)),
        ):
            rows = np.flatnonzero(there)
            joints = group.positions[rows, k[rows]]
            resampled.append(
                laid_along(skeleton, group.images[rows], joints, np.full(len(rows), group.size))
            )
            right.append(
                np.einsum("nd,nd->n", joints[:, skeleton.tip] - joints[:, 0], along[rows]) > 0
            )
    return replace(
        model, facing=HeadTailClassifier.fit(np.concatenate(resampled), np.concatenate(right), seed)
    )


def _rows(samples: Samples, index: NDArray[np.int64]) -> Samples:
    """Some of the samples, each on a height map of its own, so that bags are drawn over samples."""
    n = len(index)
    return Samples(
        np.zeros((n, 1, 1), np.int16),
        np.arange(n, dtype=np.int32),
        samples.inverse_size[index],
        samples.views[index],
        samples.scalars[index],
    )


def calibrate(model: Model, data: TrainingSet, rng: np.random.Generator) -> Model:
    """Add the expectation forest and the calibration, learned on held-out images.

    The boosted forest predicts the logarithm of the true error of the chosen pose, capped at 25 mm
    at the reference length: errors differ by factors, and in mm the few gross ones would dominate.
    The ratios of true to predicted error that bound 90 % of the images, and the limit above which a
    pose is flagged (97 % quantile of the predictions), come from 4-fold cross-fitting.

    Args:
        model: the model with its corrections.
        data: held-out images with truth.
        rng: source of size errors, folds, bags and seeds.

    Returns:
        The model with new expectation and calibration; area_mm2 is kept.
    """
    trial = run_on(model, data, rng)
    error = trial.joint_error.mean(axis=1)
    capped = np.minimum(error, _CAP_MM * model.skeleton.relative_size)
    # errors differ by factors: in millimetres the few gross ones would dominate
    target = (LOG_UNIT * np.log(capped))[:, None].astype(np.float32)
    n = len(error)
    fold = rng.permutation(n) % _FOLDS
    predicted = np.empty(n)
    for k in range(_FOLDS):
        others = np.flatnonzero(fold != k)
        unseen = np.flatnonzero(fold == k)
        forest = boost_forest(
            _rows(trial.clues, others), target[others], _EXPECTATION, _SHRINKAGE, rng
        )
        predicted[unseen] = np.exp(predict(forest, _rows(trial.clues, unseen))[:, 0] / LOG_UNIT)
    gain = capped.mean() / predicted.mean()  # from the median of the expected error to its mean
    predicted = np.maximum(gain * predicted, LEAST_MM * model.skeleton.relative_size)
    low, high = np.quantile(error / predicted, [0.05, 0.95])
    shifted = target + np.float32(LOG_UNIT * np.log(gain))
    expectation = quantised(
        boost_forest(_rows(trial.clues, np.arange(n)), shifted, _EXPECTATION, _SHRINKAGE, rng)
    )
    design = np.stack([np.ones(n), trial.score, trial.spread], axis=1)
    line, *_ = np.linalg.lstsq(design, capped, rcond=None)
    calibration = ErrorCalibration(
        offset=float(line[0]),
        slope=float(line[1]),
        spread_slope=float(line[2]),
        quantiles=(float(low), float(high)),
        joint_share=tuple(
            float(x) for x in np.median(trial.joint_error, axis=0) / np.median(error)
        ),
        doubtful_mm=float(np.quantile(predicted, _DOUBTFUL_SHARE)),
        area_mm2=model.calibration.area_mm2,
        logarithmic=True,
    )
    return replace(model, expectation=expectation, calibration=calibration)
