"""Sensitivity of the pose error to the method's five numbers (Lie-X Fig 7), one varied at a time.

Swept are the number of initial poses Kt, rounds C, regressor trees, their depth, and metric trees,
around the method's own values; a base that has rounds of its own (`Method.base_rounds`, our hand's)
keeps them. Numbers: mean and median joint error, mm at home size, on 1,024
rendered images that no tree has seen, half of them degraded. Every point but those of Kt is a model
of its own, on 2,048 images, so errors are larger than in the tables; only the course counts.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from liex_lab.runtime.progress import Progress, silent

if TYPE_CHECKING:
    from liex_lab.body.skeleton import Skeleton
    from liex_lab.estimation.cascade import Candidates, Cascade
    from liex_lab.estimation.method import Method
    from liex_lab.estimation.training import TrainingSet
    from liex_lab.forests.forest import Forest

PROTOCOL = (
    "Mean joint error in mm at home size on rendered images that no tree has seen, half of them "
    "degraded as in training. Every point but those of the initial poses is a model of its own, "
    "all on the same few images, so the errors are larger than those of the tables; only their "
    "course counts."
)


INITIAL_POSES = "initial poses"
_PROPOSED = (
    "not varied: a forest proposes the initial poses of this variant, two for each of its trees"
)


@dataclass(frozen=True)
class Sweep:
    """The budget of a sweep, and the values tried beside the method's own.

    Attributes:
        n_images: images that each model is trained on.
        n_test: images that it is tested on.
        values: (name of the number, values) for each of the five.
    """

    n_images: int = 2_048
    n_test: int = 1_024
    values: tuple[tuple[str, tuple[int, ...]], ...] = (
        (INITIAL_POSES, (1, 2, 5, 10, 20, 40, 80)),
        ("rounds", (1, 2, 3, 5, 7)),
        ("trees", (1, 3, 6, 10, 20)),
        ("tree depth", (6, 10, 14, 18, 24)),
        ("metric trees", (2, 5, 10, 20, 40, 80)),
    )


@dataclass
class Trained:
    """A small model with what its metric can be grown anew from.

    Attributes:
        cascade: the regressors.
        candidates: the final state of the training candidates.
        metric: the learned metric.
    """

    cascade: Cascade
    candidates: Candidates
    metric: Forest


def chosen_values(method: Method) -> dict[str, int]:
    """The method's own value of each of the five numbers.

    Args:
        method: the variant.
    """
    return {
        INITIAL_POSES: method.n_candidates,
        "rounds": method.rounds,
        "trees": method.regressors.n_trees,
        "tree depth": method.regressors.max_depth,
        "metric trees": method.metric.n_trees,
    }


def with_value(method: Method, number: str, value: int) -> Method:
    """The method with one of the five numbers changed.

    Args:
        method: the variant.
        number: `initial poses`, `rounds`, `trees`, `tree depth`, or else `metric trees`.
        value: its new value.
    """
    if number == INITIAL_POSES:
        return replace(method, n_candidates=value, top_k=min(value, method.top_k))
    if number == "rounds":
        return replace(method, rounds=value)
    if number == "trees":
        return replace(method, regressors=replace(method.regressors, n_trees=value))
    if number == "tree depth":
        return replace(method, regressors=replace(method.regressors, max_depth=value))
    return replace(method, metric=replace(method.metric, n_trees=value))


def left_out(method: Method) -> dict[str, str]:
    """Which of the five numbers the method does not have to vary, with the reason for each.

    Args:
        method: the variant.
    """
    return {} if method.proposals is None else {INITIAL_POSES: _PROPOSED}


def sensitivity(
    skeleton: Skeleton, variant: str, sweep: Sweep, progress: Progress = silent
) -> dict[str, Any]:
    """Curves of a variant: mean and median error, mm, over the values of each number.

    Args:
        skeleton: the animal's skeleton.
        variant: `paper` or `default`.
        sweep: images and values.
        progress: told point by point.

    Returns:
        `curves` by number, the method's `chosen` values, the numbers `left_out` with the reason,
        amounts, seed and protocol.
    """
    from liex_lab.estimation.method import method_of

    from ...training.pose_model import recipe_of, rendered_set

    method = method_of(variant, skeleton)
    recipe = recipe_of("default", skeleton)
    recipe = replace(recipe, sizes=recipe_of("paper", skeleton).sizes)
    data = rendered_set(skeleton, method, recipe, 0, sweep.n_images, silent)
    test = rendered_set(skeleton, method, recipe, sweep.n_images, sweep.n_test, silent)
    own = chosen_values(method)
    base = _train(data, skeleton, method, recipe.seed)
    void = left_out(method)
    points = {
        number: sorted({*values, own[number]})
        for number, values in sweep.values
        if number not in void
    }
    n_points = sum(map(len, points.values()))
    done = 0
    curves: dict[str, list[dict[str, float]]] = {}
    for number, values in points.items():
        curves[number] = []
        for value in values:
            progress(done, n_points, f"{skeleton.name}, {variant}: {number} {value}")
            trained = _trained_with(base, data, method, number, value, recipe.seed)
            mean, median = _errors(trained, with_value(method, number, value), test, recipe.seed)
            curves[number].append({"value": value, "mean_mm": mean, "median_mm": median})
            done += 1
    return {
        "variant": variant,
        "n_images": len(data.size),
        "n_test": int(test.animal.sum()),
        "seed": recipe.seed,
        "chosen": {number: own[number] for number in own if number not in void},
        "left_out": void,
        "curves": curves,
        "protocol": PROTOCOL,
    }


def _train(data: TrainingSet, skeleton: Skeleton, method: Method, seed: int) -> Trained:
    from liex_lab.estimation.training import train_cascade, train_metric

    rng = np.random.default_rng(seed)
    cascade, candidates = train_cascade(data, skeleton, method, rng, lambda share, what: None)
    return Trained(cascade, candidates, train_metric(data, cascade, candidates, rng))


def _trained_with(
    base: Trained, data: TrainingSet, method: Method, number: str, value: int, seed: int
) -> Trained:
    """The base model where the number does not change training, else one of its own, as far as it
    has to be.
    """
    from liex_lab.estimation.training import train_metric

    changed = with_value(method, number, value)
    if number == INITIAL_POSES or changed == method:
        return base
    if number == "metric trees":
        cascade = replace(base.cascade, method=changed)
        return replace(
            base,
            metric=train_metric(data, cascade, base.candidates, np.random.default_rng(seed + 1)),
        )
    return _train(data, base.cascade.skeleton, changed, seed)


def _errors(trained: Trained, method: Method, test: TrainingSet, seed: int) -> tuple[float, float]:
    """Mean and median joint error of the chosen poses, mm at home size."""
    from liex_lab.estimation.calibration import run_on
    from liex_lab.estimation.model import Model

    model = Model(replace(trained.cascade, method=method), trained.metric, None, {})
    error = run_on(model, test, np.random.default_rng(seed)).joint_error.mean(axis=1)
    return float(error.mean()), float(np.median(error))
