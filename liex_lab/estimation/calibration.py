"""What is learned of a model's own choices, on images that no tree has seen: their last correction,
and how far off they are in millimetres.
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
from liex_lab.estimation.head_tail import Facing, both_ways, laid_along
from liex_lab.estimation.model import Calibration, Model
from liex_lab.estimation.ridge_correction import Settler
from liex_lab.estimation.scoring import LEAST_MM, LOG_UNIT, Chosen, clue_samples
from liex_lab.estimation.training import TrainingSet, quantised
from liex_lab.foreground.background_segmenter import Crops
from liex_lab.forests.forest import Samples, predict
from liex_lab.forests.grow import GrowthPlan, boost_forest

Array = NDArray[np.float64]

_CAP_MM = 25.0  # at the reference length; a lost pose must not decide what an ordinary score means
# how far off (log) the size of a session is once it has been estimated over many frames, where
# poses settle, and before
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
# at the reference length: what is farther off is another pose
_CORRECTED_MM = 12.0
_CORRECTION_SHRINKAGE = 0.1
_FOLDS = 4


@dataclass(frozen=True)
class Trial:
    """A model's own choices for images with known truth: scores (n,), spreads (n,), joint errors
    (n, J) mm at home size, and what the expectation forest sees of them.
    """

    score: Array
    spread: Array
    joint_error: Array
    clues: Samples


@dataclass(frozen=True)
class _Group:
    """Images that share a guess of the size, as the frames of a recording do: their rows in the
    set, the guess over home size, the model's choices for them, and the candidates (m, K, J, 3) mm
    behind these with their scores (m, K).
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
    """Let a model choose. Images of animals are taken in order of size, and each group of them
    shares one guess, off by size_sd (log).
    """
    animals = np.flatnonzero(data.animal)
    order = animals[np.argsort(data.size[animals], kind="stable")]
    estimator = PoseEstimator(model)
    for rows in np.array_split(order, max(1, len(order) // _GROUP)):
        size = float(np.median(data.size[rows]) * np.exp(size_sd * rng.standard_normal()))
        size = size if model.method.session_size else 1.0
        images = data.images[rows]
        looks = images.looks
        crops = Crops(
            images.heights,
            looks[:, 14:16].astype(np.int32),
            looks[:, 16].astype(np.int32),
            np.full(len(rows), 1),
            images.moments,
            looks[:, 13],
            np.ones(len(rows), np.int64),
        )
        rotations, positions, _, scores = estimator.candidates(crops, looks, size)
        chosen = estimator.pick(images, size, rotations, positions, scores)
        yield _Group(rows, images, size, chosen, positions, scores)


def run_on(model: Model, data: TrainingSet, rng: np.random.Generator) -> Trial:
    """The choices of a model for the animals among the images, and how far off they are."""
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
        off = np.linalg.norm(
            picked.pose.joints(skeleton) - data.truth.positions[group.rows], axis=-1
        )
        scores_of.append(picked.score)
        spreads.append(picked.spread)
        joint_errors.append(off / group.size)
        blank = clue_samples(picked, skeleton, images.moments, images.looks, group.size)
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
    """The model with the last correction of its choices, learned from images that no tree has seen.

    What is off by more than an ordinary error, as a pose that points the other way, teaches
    nothing. Skeletons that branch have no such correction: their poses do not follow from the
    places of their joints.
    """
    plan = model.method.corrector
    worst = _CORRECTED_MM * model.skeleton.relative_size
    if plan is None or not model.skeleton.is_chain:
        return model
    parts = []
    moves = []
    for group in _choices(model, data, rng):
        true = data.truth.positions[group.rows]
        off = np.linalg.norm(group.chosen.pose.joints(model.skeleton) - true, axis=-1).mean(axis=1)
        near = np.flatnonzero(off < worst * group.size)
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
    """The model with how its choices settle, where the method has them settle, from images that no
    tree has seen.
    """
    if not model.method.settle:
        return model
    groups = list(_choices(model, data, rng, _GUESS_SD))
    rows = np.concatenate([group.rows for group in groups])
    sizes = np.concatenate([np.full(len(group.rows), group.size) for group in groups])
    pose = Pose.join([group.chosen.pose for group in groups])
    settler = Settler.fit(
        model.skeleton, pose, data.images[rows], sizes, data.truth.positions[rows], data.size[rows]
    )
    return replace(model, settler=settler.table)


def with_facing(model: Model, data: TrainingSet, seed: int) -> Model:
    """The model with what tells head from tail, where the method has it, learned from candidates
    for images that no tree has seen: the best one of each way.
    """
    skeleton = model.skeleton
    if not model.method.tells_facing:
        return model
    pictures = []
    right = []
    for group in _choices(model, data, np.random.default_rng(seed)):
        true = data.truth.positions[group.rows]
        along = true[:, skeleton.tip] - true[:, 0]
        best, opposite, behind, _ = both_ways(group.positions, group.scores, skeleton.tip)
        for k, there in (
            (best, np.isfinite(group.scores.min(axis=1))),
            (opposite, np.isfinite(behind)),
        ):
            rows = np.flatnonzero(there)
            joints = group.positions[rows, k[rows]]
            pictures.append(
                laid_along(skeleton, group.images[rows], joints, np.full(len(rows), group.size))
            )
            right.append(
                np.einsum("nd,nd->n", joints[:, skeleton.tip] - joints[:, 0], along[rows]) > 0
            )
    return replace(model, facing=Facing.fit(np.concatenate(pictures), np.concatenate(right), seed))


def _rows(samples: Samples, index: NDArray[np.int64]) -> Samples:
    """Some of the samples, each on a map of its own so that bags are drawn over samples."""
    n = len(index)
    return Samples(
        np.zeros((n, 1, 1), np.int16),
        np.arange(n, dtype=np.int32),
        samples.inverse_size[index],
        samples.views[index],
        samples.scalars[index],
    )


def calibrate(model: Model, data: TrainingSet, rng: np.random.Generator) -> Model:
    """The model with its expectation forest and calibration, from held-out images.

    The forest predicts the true error of the chosen pose. The ratios of true to predicted error
    that bound 90 % of the images, and the limit of what is doubtful, come from predictions for
    images that their forest has not seen.
    """
    trial = run_on(model, data, rng)
    error = trial.joint_error.mean(axis=1)
    capped = np.minimum(error, _CAP_MM * model.skeleton.relative_size)
    # errors differ by factors: in millimetres the few that are lost would decide what the forest
    # looks at
    target = (LOG_UNIT * np.log(capped))[:, None].astype(np.float32)
    n = len(error)
    fold = rng.permutation(n) % _FOLDS
    predicted = np.empty(n)
    for k in range(_FOLDS):
        seen = np.flatnonzero(fold != k)
        unseen = np.flatnonzero(fold == k)
        forest = boost_forest(_rows(trial.clues, seen), target[seen], _EXPECTATION, _SHRINKAGE, rng)
        predicted[unseen] = np.exp(predict(forest, _rows(trial.clues, unseen))[:, 0] / LOG_UNIT)
    gain = capped.mean() / predicted.mean()  # from the middle of what to expect to its mean
    predicted = np.maximum(gain * predicted, LEAST_MM * model.skeleton.relative_size)
    low, high = np.quantile(error / predicted, [0.05, 0.95])
    shifted = target + np.float32(LOG_UNIT * np.log(gain))
    expectation = quantised(
        boost_forest(_rows(trial.clues, np.arange(n)), shifted, _EXPECTATION, _SHRINKAGE, rng)
    )
    design = np.stack([np.ones(n), trial.score, trial.spread], axis=1)
    line, *_ = np.linalg.lstsq(design, capped, rcond=None)
    calibration = Calibration(
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
