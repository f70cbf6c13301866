"""What the learned metric's score means in millimetres, found on images that no tree has seen."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from liex_lab.body.pose import Pose
from liex_lab.estimation.estimator import PoseEstimator
from liex_lab.estimation.model import Calibration, Model
from liex_lab.estimation.scoring import LEAST_MM, LOG_UNIT, Chosen, clue_samples
from liex_lab.estimation.settle import Settler
from liex_lab.estimation.training import TrainingSet, quantised
from liex_lab.forests.forest import Samples, predict
from liex_lab.forests.grow import GrowthPlan, boost_forest
from liex_lab.recordings.foreground import Crops

Array = NDArray[np.float64]

_CAP_MM = 25.0  # at the reference length; a lost pose must not decide what an ordinary score means
# how far off (log) the size of a session is once it has been estimated over many frames, where poses settle, and before
_SIZE_SD, _SETTLED_SIZE_SD, _GUESS_SD = 0.05, 0.02, 0.08
_DOUBTFUL_SHARE = 0.97  # of ordinary images are trusted
_GROUP = 50  # images share a size guess, as the frames of a recording do
_EXPECTATION = GrowthPlan(
    n_trees=120, max_depth=6, min_leaf=40, n_tests=60, one_probe_share=0.0, scalar_share=1.0, depth_share=0.3,
    bag_share=0.5,
)  # fmt: skip
_SHRINKAGE = 0.12
_FOLDS = 4


@dataclass(frozen=True)
class Trial:
    """A model's own choices for images with known truth: scores (n,), spreads (n,), joint errors (n, J) mm at home
    size, and what the expectation forest sees of them.
    """

    score: Array
    spread: Array
    joint_error: Array
    clues: Samples


@dataclass(frozen=True)
class _Picks:
    """What a model chose for some images: rows (n,) of the set, the size that was assumed, how they were cut."""

    rows: NDArray[np.int64]
    size: float
    looks: Array
    moments: Array
    chosen: Chosen


def _picks(model: Model, data: TrainingSet, size_sd: float, rng: np.random.Generator) -> Iterator[_Picks]:
    """Let a model choose. Images are taken in order of size, and each group of them shares one guess of it, off by
    size_sd (log).
    """
    animals = np.flatnonzero(data.animal)
    order = animals[np.argsort(data.size[animals], kind="stable")]
    estimator = PoseEstimator(model)
    for rows in np.array_split(order, max(1, len(order) // _GROUP)):
        size = float(np.median(data.size[rows]) * np.exp(size_sd * rng.standard_normal()))
        size = size if model.method.session_size else 1.0
        looks, moments = data.images.looks[rows], data.images.moments[rows]
        crops = Crops(
            data.images.heights[rows], looks[:, 14:16].astype(np.int32), looks[:, 16].astype(np.int32),
            np.full(len(rows), 1), moments, looks[:, 13], np.ones(len(rows), np.int64),
        )  # fmt: skip
        rotations, positions, _, scores = estimator.candidates(crops, looks, size)
        picked = estimator.pick(crops.heights, looks, size, rotations, positions, scores)
        yield _Picks(rows, size, looks, moments, picked)


def fit_settler(model: Model, data: TrainingSet, rng: np.random.Generator) -> Settler:
    """How the poses that a model chooses settle, from images with known truth."""
    picks = list(_picks(model, data, _GUESS_SD, rng))
    rows = np.concatenate([p.rows for p in picks])
    sizes = np.concatenate([np.full(len(p.rows), p.size) for p in picks])
    pose = Pose.join([p.chosen.pose for p in picks])
    return Settler.fit(
        model.skeleton, pose, data.images.heights[rows], data.images.looks[rows], sizes, data.truth.positions[rows],
        data.size[rows],
    )  # fmt: skip


def run_on(model: Model, data: TrainingSet, rng: np.random.Generator) -> Trial:
    """What a model's choices are worth, see `_picks`."""
    skeleton = model.skeleton
    scores_of, spreads, joint_errors, clues = [], [], [], []
    for p in _picks(model, data, _SIZE_SD if model.settler is None else _SETTLED_SIZE_SD, rng):
        off = np.linalg.norm(p.chosen.pose.joints(skeleton) - data.truth.positions[p.rows], axis=-1)
        scores_of.append(p.chosen.score)
        spreads.append(p.chosen.spread)
        joint_errors.append(off / p.size)
        clues.append(clue_samples(p.chosen, skeleton, p.moments, p.looks, p.size))
    scalars, blank = np.concatenate([samples.scalars for samples in clues]), clues[-1]
    n = len(scalars)
    samples = Samples(
        blank.heights, np.zeros(n, np.int32), np.ones(n, np.float32),
        np.zeros((n, 1, blank.views.shape[2]), np.float32), scalars,
    )  # fmt: skip
    return Trial(np.concatenate(scores_of), np.concatenate(spreads), np.concatenate(joint_errors), samples)


def _rows(samples: Samples, index: NDArray[np.int64]) -> Samples:
    """Some of the samples, each on a map of its own so that bags are drawn over samples."""
    n = len(index)
    return Samples(
        np.zeros((n, 1, 1), np.int16), np.arange(n, dtype=np.int32), samples.inverse_size[index], samples.views[index],
        samples.scalars[index],
    )  # fmt: skip


def calibrate(model: Model, data: TrainingSet, rng: np.random.Generator) -> Model:
    """The model with its expectation forest and calibration, from held-out images.

    The forest predicts the true error of the chosen pose. The ratios of true to predicted error that bound 90 % of the
    images, and the limit of what is doubtful, come from predictions for images that their forest has not seen.
    """
    if model.method.settle:
        model = replace(model, settler=fit_settler(model, data, rng).table)
    trial = run_on(model, data, rng)
    error = trial.joint_error.mean(axis=1)
    capped = np.minimum(error, _CAP_MM * model.skeleton.relative_size)
    # errors differ by factors: in millimetres the few that are lost would decide what the forest looks at
    target = (LOG_UNIT * np.log(capped))[:, None].astype(np.float32)
    n = len(error)
    fold, predicted = rng.permutation(n) % _FOLDS, np.empty(n)
    for k in range(_FOLDS):
        seen, unseen = np.flatnonzero(fold != k), np.flatnonzero(fold == k)
        forest = boost_forest(_rows(trial.clues, seen), target[seen], _EXPECTATION, _SHRINKAGE, rng)
        predicted[unseen] = np.exp(predict(forest, _rows(trial.clues, unseen))[:, 0] / LOG_UNIT)
    gain = capped.mean() / predicted.mean()  # from the middle of what to expect to its mean
    predicted = np.maximum(gain * predicted, LEAST_MM * model.skeleton.relative_size)
    low, high = np.quantile(error / predicted, [0.05, 0.95])
    shifted = target + np.float32(LOG_UNIT * np.log(gain))
    expectation = quantised(boost_forest(_rows(trial.clues, np.arange(n)), shifted, _EXPECTATION, _SHRINKAGE, rng))
    design = np.stack([np.ones(n), trial.score, trial.spread], axis=1)
    line, *_ = np.linalg.lstsq(design, capped, rcond=None)
    calibration = Calibration(
        offset=float(line[0]),
        slope=float(line[1]),
        spread_slope=float(line[2]),
        quantiles=(float(low), float(high)),
        joint_share=tuple(float(x) for x in np.median(trial.joint_error, axis=0) / np.median(error)),
        doubtful_mm=float(np.quantile(predicted, _DOUBTFUL_SHARE)),
        area_mm2=model.calibration.area_mm2,
        logarithmic=True,
    )
    return replace(model, expectation=expectation, calibration=calibration)
