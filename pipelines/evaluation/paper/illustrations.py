"""Candidates of one image ranked by the learned metric, and their convergence (Lie-X Fig 13-16).

On rendered images that no tree has seen: the image shown is that whose best ranked candidate has
the median error of all. Numbers: score and true error of each candidate, mm; Spearman's correlation
of score and error over an image's candidates, mean over images; quartiles of the error over all
candidates after every joint and round of Algorithm 1.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from liex_lab.runtime.progress import silent

if TYPE_CHECKING:
    from liex_lab.body.skeleton import Skeleton
    from liex_lab.estimation.cascade import Candidates, Cascade
    from liex_lab.estimation.model import Model
    from liex_lab.estimation.training import TrainingSet

Array = NDArray[np.float64]

PROTOCOL = (
    "Rendered images that no tree has seen, cut out by the product's foreground. The one shown is "
    "that whose best ranked candidate has the median error of all, so it is neither the best nor "
    "the worst."
)


def illustrate(model: Model, n_images: int = 128) -> dict[str, Any]:
    """What the figures of candidates and convergence show, for a model on unseen images.

    Args:
        model: the pose model.
        n_images: number of images.

    Returns:
        `ranked`: the example's candidates, best score first; `rank_correlation`: mean over images
        of Spearman's correlation of score and error over an image's candidates; `steps`: error, mm
        at home size (of the example its own), after every joint and round; `heights`, `true_px` and
        `edges` of the example; amounts and protocol.
    """
    from liex_lab.estimation.initial import N_DIRECTIONS
    from liex_lab.estimation.training import Proposals, start_candidates

    skeleton = model.skeleton
    method = model.method
    data = _unseen(skeleton, model, n_images)
    rng = np.random.default_rng(0)
    k = method.n_candidates
    n = len(data.size)
    seen = None
    if (forest := model.cascade.proposals) is not None:
        k = min(k, N_DIRECTIONS * forest.n_trees)
        seen = Proposals(
            forest, np.zeros((forest.n_trees, n), np.bool_)
        )  # no tree has seen any of them
    candidates = start_candidates(data, skeleton, replace(method, training_candidates=k), rng, seen)
    names, errors, positions = _follow(model.cascade, data, candidates)
    scores = _scores(model, data, candidates).reshape(n, k)
    final = errors[-1].reshape(n, k)
    best = scores.argmin(axis=1)
    chosen_error = final[np.arange(n), best]
    example = int(np.argsort(chosen_error)[n // 2])
    rows = example * k + np.argsort(scores[example], kind="stable")
    of_best = np.arange(n) * k + best
    size = data.size[example] if method.session_size else 1.0
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
        "rank_correlation": _rank_correlation(scores, final),
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
    """Images (n) of animals near home size that come after those of forests and calibration."""
    from liex_lab.estimation.training import TrainingSet

    from ...training.pose_model import recipe_of, rendered_set

    recipe = recipe_of("default", skeleton)
    first = recipe.n_images + recipe.n_correction + recipe.n_calibration
    recipe = replace(recipe, sizes=recipe_of("paper", skeleton).sizes)
    data = rendered_set(skeleton, model.method, recipe, first, n, silent)
    rows = np.flatnonzero(data.animal)[:n]

    def some(part: Any) -> Any:
        return type(part)(*(getattr(part, name)[rows] for name in type(part).__annotations__))

    return TrainingSet(some(data.images), some(data.truth), data.size[rows], data.animal[rows])


def _follow(
    cascade: Cascade, data: TrainingSet, candidates: Candidates
) -> tuple[list[str], list[Array], list[Array]]:
    """Names, errors (n K,) mm at home size, and positions after each step of Algorithm 1."""
    from liex_lab.estimation.training import joint_error

    skeleton = cascade.skeleton
    names = ["start"]
    errors = []
    positions = []
    solved: set[int] = {0}

    def note() -> None:
        for joint in range(1, skeleton.n_joints):
            if joint not in solved:
                cascade.place(candidates, joint)  # straight on from where its parent is now
        errors.append(joint_error(candidates, data.truth))
        positions.append(candidates.positions.copy())

    note()
    for joint, c in cascade.steps(data.images, candidates):
        solved.add(joint)
        names.append(f"{skeleton.names[joint]} {c + 1}")
        note()
    return names, errors, positions


def _scores(model: Model, data: TrainingSet, candidates: Candidates) -> Array:
    """What the learned metric says of finished candidates (n K,), mm at home size."""
    samples = model.cascade.metric_samples(data.images, candidates)
    return model.cascade.predict(model.metric, samples)[:, 0].astype(float)


def _rank_correlation(scores: Array, errors: Array) -> float:
    from liex_lab.evaluation.pose import rank_correlation

    return float(np.mean([rank_correlation(a, b) for a, b in zip(scores, errors, strict=True)]))


def _pixels(positions: Array, data: TrainingSet, image: int) -> Array:
    """Where joints (m, J, 3) of one image's view frame lie in its height map: column and row (m, J,
    2).
    """
    from liex_lab.scene.height_maps import CropCamera, in_camera_frame

    look = data.images.crop_cameras[image]
    x, y, z = np.moveaxis(
        in_camera_frame(positions, np.repeat(look[None], len(positions), 0)), -1, 0
    )
    camera = CropCamera(*look)
    uv = np.stack([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy], axis=-1)
    return (uv - [camera.u0, camera.v0]) / camera.step
