"""Data of Figures 7, 13 to 16 and 19 of Lie-X: sensitivity, ranked candidates, key frames.

- Fig. 7: mean and median joint error, mm at home size, over the number of initial poses Kt, rounds
  C, regressor trees, their depth, and metric trees, one varied at a time around the method's
  default values; a base that has rounds of its own (`Method.base_rounds`, our hand's) keeps them.
- Figs. 13 to 16: candidates of one rendered image that no tree was grown on, ranked by the learned
  metric, and their errors after every joint and round of Algorithm 1.
- Fig. 19: one cut-out test sequence of each of the fish's actions; surface and dive from the side.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from liex_lab.body.skeleton import Skeleton
from liex_lab.estimation.calibration import run_on
from liex_lab.estimation.cascade import Candidates, Cascade
from liex_lab.estimation.initial import N_DIRECTIONS
from liex_lab.estimation.method import Method, method_of
from liex_lab.estimation.model import Model
from liex_lab.estimation.training import (
    Proposals,
    TrainingSet,
    joint_error,
    start_candidates,
    train_cascade,
    train_metric,
)
from liex_lab.evaluation.scores import rank_correlation
from liex_lab.runtime.progress import Progress, silent
from liex_lab.scene._height_map_kernels import CropCamera
from liex_lab.scene.height_maps import in_camera_frame

from ...training.action_model import cut_sequences
from ...training.agent_tracks import Scenario, filmed_at
from ...training.pose_model import recipe_of, rendered_set

Array = NDArray[np.float64]

SWEEP_PROTOCOL = (
    "Mean joint error in mm at home size on rendered images that no tree has seen, half of them "
    "degraded as in training. Every point but those of the initial poses is a model of its own, "
    "all on the same few images, so the errors are larger than those of the tables; only their "
    "course counts."
)
PROTOCOL = (
    "Rendered images that no tree has seen, cut out by the product's foreground. The one shown is "
    "that whose best ranked candidate has the median error of all, so it is neither the best nor "
    "the worst."
)
INITIAL_POSES = "initial poses"
_PROPOSED = (
    "not varied: a forest proposes the initial poses of this variant, two for each of its trees"
)
_KEY_FRAMES = 4
_FROM_THE_SIDE = ("surface", "dive")
_MOST_DOTS = 1_500  # of a body


@dataclass(frozen=True)
class Sweep:
    """The budget of a sweep, and the values to try in addition to the method's own.

    Attributes:
        n_images: images that each model is trained on.
        n_test: images that it is tested on.
        values: (name of the parameter, values) for each of the five.
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


def chosen_values(method: Method) -> dict[str, int]:
    """The method's own value of each of the five parameters."""
    return {
        INITIAL_POSES: method.n_candidates,
        "rounds": method.rounds,
        "trees": method.regressors.n_trees,
        "tree depth": method.regressors.max_depth,
        "metric trees": method.metric.n_trees,
    }


def with_value(method: Method, number: str, value: int) -> Method:
    """The method with one of the five parameters changed."""
    if number == INITIAL_POSES:
        return replace(method, n_candidates=value, top_k=min(value, method.top_k))
    if number == "rounds":
        return replace(method, rounds=value)
    if number == "metric trees":
        return replace(method, metric=replace(method.metric, n_trees=value))
    changed = {"n_trees" if number == "trees" else "max_depth": value}
    return replace(method, regressors=replace(method.regressors, **changed))


def sensitivity(
    skeleton: Skeleton, variant: str, sweep: Sweep, progress: Progress = silent
) -> dict[str, Any]:
    """Curves of a variant: mean and median error, mm, over the values of each parameter.

    Args:
        skeleton: the animal's skeleton.
        variant: `paper` or `default`.
        sweep: images and values.
        progress: called point by point.

    Returns:
        `curves` by parameter, the method's `chosen` values, the parameters `left_out` with the
        reason, amounts, seed and protocol.
    """
    method = method_of(variant, skeleton)
    recipe = _near_home_size(skeleton)
    data = rendered_set(skeleton, method, recipe, 0, sweep.n_images, silent)
    test = rendered_set(skeleton, method, recipe, sweep.n_images, sweep.n_test, silent)
    left_out = {} if method.proposals is None else {INITIAL_POSES: _PROPOSED}
    own = {name: n for name, n in chosen_values(method).items() if name not in left_out}
    points = [
        (number, value)
        for number, values in sweep.values
        if number in own
        for value in sorted({*values, own[number]})
    ]
    curves: dict[str, list[dict[str, float]]] = {number: [] for number, _ in points}
    base = _train(data, skeleton, method, recipe.seed)
    for k, (number, value) in enumerate(points):
        progress(k, len(points), f"{skeleton.name}, {variant}: {number} {value}")
        changed = with_value(method, number, value)
        cascade, metric = _retrained(base, data, method, number, changed, recipe.seed)
        mean, median = _errors(replace(cascade, method=changed), metric, test, recipe.seed)
        curves[number].append({"value": value, "mean_mm": mean, "median_mm": median})
    return {
        "variant": variant,
        "n_images": len(data.size),
        "n_test": int(test.animal.sum()),
        "seed": recipe.seed,
        "chosen": own,
        "left_out": left_out,
        "curves": curves,
        "protocol": SWEEP_PROTOCOL,
    }


def _near_home_size(skeleton: Skeleton) -> Any:
    """The default's recipe, with animals of the sizes that the paper's variant is trained on."""
    return replace(recipe_of("default", skeleton), sizes=recipe_of("paper", skeleton).sizes)


def _train(
    data: TrainingSet, skeleton: Skeleton, method: Method, seed: int
) -> tuple[Cascade, Candidates, Any]:
    """A small cascade, the final state of its training candidates, and its learned metric."""
    rng = np.random.default_rng(seed)
    cascade, candidates = train_cascade(data, skeleton, method, rng, lambda share, what: None)
    return cascade, candidates, train_metric(data, cascade, candidates, rng)


def _retrained(
    base: tuple[Cascade, Candidates, Any],
    data: TrainingSet,
    method: Method,
    number: str,
    changed: Method,
    seed: int,
) -> tuple[Cascade, Any]:
    """Cascade and metric for a changed parameter, retrained only as far as needed."""
    cascade, candidates, metric = base
    if number == INITIAL_POSES or changed == method:
        return cascade, metric
    if number == "metric trees":
        rng = np.random.default_rng(seed + 1)
        return cascade, train_metric(data, replace(cascade, method=changed), candidates, rng)
    cascade, _, metric = _train(data, cascade.skeleton, changed, seed)
    return cascade, metric


def _errors(cascade: Cascade, metric: Any, test: TrainingSet, seed: int) -> tuple[float, float]:
    """Mean and median joint error of the chosen poses, mm at home size."""
    model = Model(cascade, metric, None, {})
    error = run_on(model, test, np.random.default_rng(seed)).joint_error.mean(axis=1)
    return float(error.mean()), float(np.median(error))


def illustrate(model: Model, n_images: int = 128) -> dict[str, Any]:
    """Data for the figures of candidates and convergence, for a model on unseen images.

    Returns:
        `ranked`: the example's candidates, best score first; `rank_correlation`: mean over images
            of Spearman's correlation of score and error over an image's candidates; `steps`:
            errors, mm at home size (the example's at its own size), after every joint and round;
            `heights`, `true_px` and `edges` of the example; amounts and protocol.
    """
    skeleton, method = model.skeleton, model.method
    data = _unseen(skeleton, model, n_images)
    n, k = len(data.size), method.n_candidates
    proposals = None
    if (forest := model.cascade.proposals) is not None:
        k = min(k, N_DIRECTIONS * forest.n_trees)
        no_tree_saw = np.zeros((forest.n_trees, n), np.bool_)
        proposals = Proposals(forest, no_tree_saw)
    method_k = replace(method, training_candidates=k)
    candidates = start_candidates(data, skeleton, method_k, np.random.default_rng(0), proposals)
    names, errors, positions = _follow(model.cascade, data, candidates)
    samples = model.cascade.metric_samples(data.images, candidates)
    scores = model.cascade.predict(model.metric, samples)[:, 0].astype(float).reshape(n, k)
    final = errors[-1].reshape(n, k)
    best = scores.argmin(axis=1)
    example = int(np.argsort(final[np.arange(n), best])[n // 2])
    rows = example * k + np.argsort(scores[example], kind="stable")
    of_best = np.arange(n) * k + best
    size = data.size[example] if method.session_size else 1.0
    correlations = [rank_correlation(a, b) for a, b in zip(scores, final, strict=True)]
    return {
        "animal": skeleton.name,
        "variant": method.variant,
        "n_images": n,
        "n_candidates": k,
        "protocol": PROTOCOL,
        "edges": skeleton.edges,
        "heights": data.images.heights[example],
        "true_px": _pixels(data.truth.positions[example][None], data, example)[0],
        "ranked": {
            "joints_px": _pixels(positions[-1][rows], data, example),
            "score_mm": scores.ravel()[rows] * size,
            "error_mm": final.ravel()[rows] * size,
        },
        "rank_correlation": float(np.mean(correlations)),
        "steps": {
            "names": names,
            "median_mm": [float(np.median(e)) for e in errors],
            "low_mm": [float(np.quantile(e, 0.25)) for e in errors],
            "high_mm": [float(np.quantile(e, 0.75)) for e in errors],
            "best_mm": [float(e[of_best].mean()) for e in errors],
            "example_mm": [float(e[rows[0]] * size) for e in errors],
            "joints_px": [_pixels(p[rows[:1]], data, example)[0] for p in positions],
        },
    }


def _unseen(skeleton: Skeleton, model: Model, n: int) -> TrainingSet:
    """Images (n) of animals near home size, beyond those used for forests and calibration."""
    recipe = _near_home_size(skeleton)
    first = recipe.n_images + recipe.n_correction + recipe.n_calibration
    data = rendered_set(skeleton, model.method, recipe, first, n, silent)
    rows = np.flatnonzero(data.animal)[:n]

    def some(part: Any) -> Any:
        return type(part)(*(getattr(part, name)[rows] for name in type(part).__annotations__))

    return TrainingSet(some(data.images), some(data.truth), data.size[rows], data.animal[rows])


def _follow(
    cascade: Cascade, data: TrainingSet, candidates: Candidates
) -> tuple[list[str], list[Array], list[Array]]:
    """Names, errors (n K,) mm at home size, and positions after each step of Algorithm 1."""
    skeleton = cascade.skeleton
    names: list[str] = []
    errors: list[Array] = []
    positions: list[Array] = []
    left = list(range(1, skeleton.n_joints))  # joints that are not solved yet

    def note(name: str) -> None:
        for joint in left:
            cascade.place(candidates, joint)  # straight on from its parent's current position
        names.append(name)
        errors.append(joint_error(candidates, data.truth))
        positions.append(candidates.positions.copy())

    note("start")
    for joint, c in cascade.steps(data.images, candidates):
        left = [one for one in left if one != joint]
        note(f"{skeleton.names[joint]} {c + 1}")
    return names, errors, positions


def _pixels(positions: Array, data: TrainingSet, image: int) -> Array:
    """Columns and rows (m, J, 2) of joints (m, J, 3) of one image's view in its height map."""
    packed = data.images.crop_cameras[image]
    camera = CropCamera(*packed)
    joints = in_camera_frame(positions, np.repeat(packed[None], len(positions), 0))
    x, y, z = np.moveaxis(joints, -1, 0)
    uv = np.stack([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy], axis=-1)
    return (uv - [camera.u0, camera.v0]) / camera.step


def acted_key_frames(animal: str = "fish") -> list[dict[str, Any]]:
    """Data for Fig. 19 from the first test sequence of each action.

    Returns:
        For each action `word`; `side`, whether it is viewed from the side; `path_mm` (n, 2) of the
        middle of the body; `bodies_mm`, for each key frame the points (m, 2) visible to the camera;
        `skeletons_mm` (k, J, 2); `edges`; and `seconds`, its length.
    """
    first: dict[str, Scenario] = {}
    for scenario in cut_sequences(animal, True):
        first.setdefault(scenario.word, scenario)
    return [_key_frames(scenario) for scenario in first.values()]


def _key_frames(scenario: Scenario) -> dict[str, Any]:

    side = scenario.word in _FROM_THE_SIDE
    film = filmed_at(scenario, _KEY_FRAMES)
    middle = film.joints.mean(axis=1)
    axes = np.eye(3)[:2]
    if side:
        axes = np.array([[*_direction(middle), 0.0], [0.0, 0.0, 1.0]])
    some = [points[:: max(1, -(-len(points) // _MOST_DOTS))] for points in film.points]
    return {
        "word": scenario.word,
        "side": side,
        "path_mm": (middle - middle[0]) @ axes.T,
        "bodies_mm": [(points - middle[0]) @ axes.T for points in some],
        "skeletons_mm": (film.joints[film.rows] - middle[0]) @ axes.T,
        "edges": film.edges,
        "seconds": (len(middle) - 1) / scenario.rate_hz,
    }


def _direction(path: Array) -> Array:
    """The main horizontal direction (2,) of a path (n, 3), pointing from its start to its end."""
    off = path[:, :2] - path[:, :2].mean(axis=0)
    axis = np.linalg.svd(off, full_matrices=False)[2][0]
    return np.asarray(axis if (path[-1, :2] - path[0, :2]) @ axis >= 0 else -axis)
