"""Measurement of the rows of Tables 1 to 3: each method's results on each split, and its speed.

A row is one method with one or several runs: three training draws of the paper's variant, each with
five initial poses if it has only one. Lie-X assumes one object in the depth image and a skeleton of
"proper scaling" (sections 3 and 4), so the choice of object and its size must not distinguish the
methods: our default estimator chooses for all. `wrong` marks frames in which the chosen component
is another object, `wrong_alone` those in which the choice by area and volume, which the paper's
variant and the baselines would make, is. A component is another object if its centroid is farther
from the middle of the true joints than 0.8 spines. All numbers are mm.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from operator import attrgetter
from typing import Any

import numpy as np

from liex_lab.arrays import Array, NDArray
from liex_lab.baselines.baseline import (
    Guesses,
    PlainMean,
    chosen,
    second_is_likelier,
)
from liex_lab.body.skeleton import Skeleton
from liex_lab.estimation import estimator, training
from liex_lab.estimation.cascade import N_DIRECTIONS, Candidates, Cascade, TrainingSet
from liex_lab.estimation.method import Method, method_of
from liex_lab.estimation.model import Model
from liex_lab.evaluation.scores import PoseErrors, interval95, plain, rank_correlation
from liex_lab.geometry import SE3
from liex_lab.plan import Plan
from liex_lab.runtime.progress import Progress, silent
from liex_lab.scene import _height_map_kernels, height_maps
from liex_lab.simulation.recording import RenderedRecording

from ...build import build_scene, plan_of
from ...training.action_model import Scenario, cut_sequences, rendered, staged
from ...training.pose_model import estimator_of, recipe_of, rendered_set
from ..pose import Subject, subject_of, unpacked
from ..speed import SpeedSample, two_cores

Tests = Mapping[str, Sequence[RenderedRecording]]  # by split

ROWS = ("default", "paper", "paper-one-pose", "paper-no-metric", "rf", "cnn")
SWEPT = ("paper", "default")  # whose curves (Fig. 7) and failures (Fig. 17) are drawn
# number of trainings that a row is pooled over, if several
TRAINING_DRAWS = {"paper": 3, "paper-one-pose": 3, "paper-no-metric": 3}
START_DRAWS = 5  # draws of the only initial pose, for each training
_RATE_FRAMES = 128
_RATE_REPEATS = 3
_DIGITS = 2  # of a joint's position, mm


def runs_of(animal: str, variant: str, progress: Progress = silent) -> list[Subject]:
    """The runs of a row: its models, from the cache or trained now, with their initial poses.

    Raises:
        MissingPackageError: the row is the CNN and torch is not installed.
    """
    if variant not in TRAINING_DRAWS:
        return [subject_of(animal, variant, progress)]
    draws = range(TRAINING_DRAWS[variant])
    return runs_of_models(
        variant, [estimator_of(animal, "paper", progress, draw=draw) for draw in draws]
    )


def runs_of_models(variant: str, models: Sequence[estimator.PoseEstimator]) -> list[Subject]:
    """The runs of a row of the paper's variant, from one estimator per training draw."""
    if variant == "paper":
        return list(models)
    if variant == "paper-no-metric":
        return [PlainMean(one) for one in models]
    return [
        estimator.PoseEstimator(one.model, 1, start_seed=START_DRAWS * k + draw)
        for k, one in enumerate(models)
        for draw in range(START_DRAWS)
    ]


@dataclass(frozen=True)
class CommonView:
    """Input common to all rows in the n frames of one recording.

    Attributes:
        size: the animal's spine over home size, as estimated by the default estimator.
        second: (n,) bool, the second of two components is measured.
        wrong: (n,) bool, the component that is measured is another object.
        wrong_alone: (n,) bool, the component chosen by area and volume is another object.
    """

    size: float
    second: NDArray[np.bool_]
    wrong: NDArray[np.bool_]
    wrong_alone: NDArray[np.bool_]


def common_view(
    recording: RenderedRecording, plan: Plan, chooser: estimator.PoseEstimator
) -> tuple[height_maps.Segmenter, NDArray[np.float32], CommonView]:
    """Process a recording as `liex run` would, up to the pose.

    Args:
        recording: a rendered recording with its truth.
        plan: thresholds of the foreground, and expected sizes.
        chooser: estimates the animal's size and chooses between two components.

    Returns:
        The fitted segmenter, all frames (n, H, W) mm, and the rows' common input.
    """
    scene, frames = build_scene(recording, plan, chooser.skeleton, len(recording))
    size = chooser.find_size(frames, scene)
    *_, second = chooser.detect(frames, scene, size)
    alone = second_is_likelier(frames, scene)
    wrong, wrong_alone = (
        is_other(*chosen(frames, scene, 1.0, choice, True), recording) for choice in (second, alone)
    )
    return scene, frames, CommonView(size, second, wrong, wrong_alone)


def is_other(
    crops: height_maps.HeightMaps, crop_cameras: Array, recording: RenderedRecording
) -> NDArray[np.bool_]:
    """Whether (n,) a component is another object than the animal, by its centroid."""
    T = height_maps.view_of(crop_cameras)
    joints = SE3(T.rotation[:, None], T.translation[:, None]) @ recording.joints_camera
    blob = crops.blobs
    centroid = np.stack(
        [blob.x, blob.y, blob.volume_mm3 / np.maximum(blob.area_mm2, 1e-9)], axis=-1
    )
    off = np.linalg.norm(centroid - joints.mean(axis=1), axis=-1)
    return np.asarray(crops.found & (off > 0.8 * recording.spine_mm))


def measured(
    subject: Subject,
    frames: NDArray[np.float32],
    scene: height_maps.Segmenter,
    view: CommonView,
    cut: dict[tuple[float, bool], tuple[height_maps.HeightMaps, Array]],
) -> tuple[Array, Array, Array]:
    """Joints, predicted errors and their interval of one subject on the common choice of object.

    Args:
        subject: an estimator or a baseline.
        frames: (n, H, W) float32 depth, mm, 0 where unread.
        scene: the fitted segmenter.
        view: the rows' common input.
        cut: cache of height maps by size and view, shared by subjects; filled.

    Returns:
        As `pose.unpacked`: joints (n, J, 3) mm, camera frame; predicted error (n,) mm; factors
        (2,).
    """
    answer: Callable[..., estimator.Estimates | Guesses]
    if isinstance(subject, estimator.PoseEstimator):
        method, answer = subject.model.method, subject.best_of
        sized, camera_view = method.session_size, method.camera_view
    else:
        sized, camera_view, answer = subject.takes_size, True, subject.guesses
    key = (view.size if sized else 1.0, camera_view)
    if key not in cut:
        cut[key] = chosen(frames, scene, key[0], view.second, camera_view)
    return unpacked(subject, answer(*cut[key], key[0]))


def measured_rows(
    animal: str,
    runs: Mapping[str, Sequence[Subject]],
    chooser: estimator.PoseEstimator,
    tests: Tests,
    progress: Progress,
) -> dict[str, dict[str, Any]]:
    """Measure each row; every recording is rendered and its scene learned once.

    Args:
        animal: a bundled animal's name, or the path of a skeleton's TOML.
        runs: estimators and baselines by variant, including `default`.
        chooser: the default estimator.
        tests: recordings with their truth.
        progress: called recording by recording.

    Returns:
        By row `splits` and `rate`, `examples` and, for the rows of Fig. 17, `failures`.
    """
    rows: dict[str, dict[str, Any]] = {
        name: {"splits": {}, "examples": [], "failures": []} for name in runs
    }
    plan, tip = plan_of(animal), chooser.skeleton.tip
    for split, recordings in tests.items():
        views: list[CommonView] = []
        errors: dict[str, list[list[PoseErrors]]] = {  # by row and run, a list over recordings
            name: [[] for _ in some] for name, some in runs.items()
        }
        first: dict[str, list[Array]] = {name: [] for name in runs}  # joints of the first run
        for k, recording in enumerate(recordings):
            progress(k, len(recordings), f"measuring {recording.name}")
            scene, frames, view = common_view(recording, plan, chooser)
            views.append(view)
            cut: dict[Any, Any] = {}
            for name, subjects in runs.items():
                for run, subject in enumerate(subjects):
                    joints, *predicted = measured(subject, frames, scene, view, cut)
                    errors[name][run].append(
                        PoseErrors.compare(joints, recording.joints_camera, tip, *predicted)
                    )
                    if not run:
                        first[name].append(joints)
        for name, row in rows.items():
            row["splits"][split] = numbers_of([PoseErrors.join(run) for run in errors[name]], views)
            places = example_frames(recordings)
            row["examples"] += [pose_at(split, k, i, first[name][k][i]) for k, i in places]
            if name in SWEPT:
                row["failures"] += failures_in(split, first[name], recordings)
    progress(0, None, "timing")
    timed = {name: some[0] for name, some in runs.items()}
    for name, rate in rates_of(animal, timed, next(iter(tests.values()))).items():
        rows[name]["rate"] = rate
    return rows


def numbers_of(runs: Sequence[PoseErrors], views: Sequence[CommonView]) -> dict[str, Any]:
    """The results of a row on one split.

    Returns:
        `median_mm`, `mean_mm`, `interval95` (of the median) and `mean_interval95` by bootstrap over
        recordings, `run_median_mm`, `wrong_object`, `wrong_object_alone`, `n_frames`,
        `n_recordings`, the values of `PoseErrors.summary` over all runs, error of each joint, and
        101 quantiles.
    """
    errors = PoseErrors.join(list(runs))
    recording = np.concatenate([np.full(len(one.wrong), k) for k, one in enumerate(views)])
    again = np.tile(recording, len(runs))
    posed = np.isfinite(errors.error_mm)
    found = errors.error_mm[posed]
    quantiles = np.quantile(found, np.linspace(0, 1, 101)) if len(found) else np.zeros(0)
    joint_mm = errors.joint_mm[posed].mean(axis=0) if len(found) else np.zeros(0)
    return {
        "median_mm": float(np.median(found)) if len(found) else None,
        "mean_mm": float(found.mean()) if len(found) else None,
        "interval95": plain(interval95(errors.error_mm, again, np.median)),
        "mean_interval95": plain(interval95(errors.error_mm, again, np.mean)),
        "run_median_mm": [plain(one.summary()["median_joint_error_mm"]) for one in runs],
        "wrong_object": float(np.concatenate([one.wrong for one in views]).mean()),
        "wrong_object_alone": float(np.concatenate([one.wrong_alone for one in views]).mean()),
        "n_frames": len(recording),
        "n_recordings": len(views),
        **plain(errors.summary()),
        "joint_mm": [round(float(x), 3) for x in joint_mm],
        "error_quantiles_mm": [round(float(x), 3) for x in quantiles],
    }


def rates_of(
    animal: str, subjects: Mapping[str, Subject], recordings: Sequence[RenderedRecording]
) -> dict[str, dict[str, Any]]:
    """Frames per second of each subject on at most two cores, foreground included.

    All are timed on the same 128 frames in memory, of the recording with the wider depth images of
    the split's first two, the best of 3 repeats.

    Returns:
        By variant `frames_per_s`, `ratio_to_default`, `cores` and `picture`.
    """
    footage = SpeedSample.of(animal, recordings[:2], next(iter(subjects.values())), _RATE_FRAMES)
    rates = {}
    with two_cores() as cores:
        for name, subject in subjects.items():
            rates[name] = replace(
                footage, size=subject.find_size(footage.sample, footage.scene)
            ).frames_per_s(subject, True, _RATE_REPEATS)
    return {
        name: {
            "frames_per_s": rate,
            "ratio_to_default": rate / rates["default"],
            "cores": cores,
            "picture": footage.pixels,
        }
        for name, rate in rates.items()
    }


def example_frames(recordings: Sequence[RenderedRecording]) -> list[tuple[int, int]]:
    """The example frames of a split: the middle of the first recording and of the one halfway.

    Returns:
        Pairs of recording and frame index.
    """
    return [(k, len(recordings[k]) // 2) for k in dict.fromkeys((0, len(recordings) // 2))]


def pose_at(split: str, recording: int, frame: int, joints: Array) -> dict[str, Any]:
    """A measured pose as stored in a row; `joints_mm` is None if nothing was found."""
    found = bool(np.isfinite(joints).all())
    return {
        "split": split,
        "recording": recording,
        "frame": frame,
        "joints_mm": np.round(joints, _DIGITS).tolist() if found else None,
    }


def failures_in(
    split: str, joints: Sequence[Array], recordings: Sequence[RenderedRecording]
) -> list[dict[str, Any]]:
    """The worst frames of one row on one split, of different recordings, worst first.

    Args:
        split: its name.
        joints: of each recording (n, J, 3) mm, camera frame.
        recordings: with their truth.

    Returns:
        As `pose_at`, with `error_mm`.
    """
    worst = []
    for k, (found, recording) in enumerate(zip(joints, recordings, strict=True)):
        error = np.linalg.norm(found - recording.joints_camera, axis=-1).mean(axis=1)
        if np.isfinite(error).any():
            worst.append((float(np.nanmax(error)), k, int(np.nanargmax(error))))
    worst.sort(reverse=True)
    return [
        {**pose_at(split, k, i, joints[k][i]), "error_mm": round(error, _DIGITS)}
        for error, k, i in worst[:2]
    ]


def shown_poses(
    places: Sequence[Mapping[str, Any]],
    rows: Mapping[str, Sequence[Mapping[str, Any]]],
    tests: Tests,
) -> dict[str, list[dict[str, Any]]]:
    """Depth images, truth and the poses of rows in some frames, for drawing.

    Args:
        places: frames, by `split`, `recording` and `frame`.
        rows: poses by variant, see `pose_at`.
        tests: recordings with their truth.

    Returns:
        By variant, for each frame `head`; `depth` (H, W) float32 mm, 0 where unread; `camera`;
        `edges`; `spine_mm`; `truth` (J, 3) mm, camera frame; and, if the row has one, `pose`
        (J, 3), which is None if nothing was found.
    """
    found: dict[str, list[dict[str, Any]]] = {name: [] for name in rows}
    for place in places:
        key = split, k, frame = (place["split"], place["recording"], int(place["frame"]))
        recording = tests[split][k]
        shown = {
            "head": split,
            "depth": recording.depths(frame, frame + 1)[0],
            "camera": recording.camera,
            "edges": recording.skeleton.edges,
            "spine_mm": recording.spine_mm,
            "truth": recording.joints_camera[frame],
        }
        for name, poses in rows.items():
            found[name].append(dict(shown))
            for one in poses:
                if (one["split"], one["recording"], one["frame"]) == key:
                    joints = one["joints_mm"]
                    found[name][-1]["pose"] = None if joints is None else np.array(joints)
    return found


# Data of Figures 7, 13 to 16 and 19 of Lie-X: sensitivity, ranked candidates, key frames.


SWEEP_PROTOCOL = (
    "Mean joint error in mm at home size on unseen rendered images, half of them "
    "degraded as in training. Every point but those of the initial poses is a model of its own, "
    "all on the same few images, so the errors are larger than those of the tables; only their "
    "course counts."
)
PROTOCOL = (
    "Unseen rendered images, cut out by the product's foreground. The one shown is "
    "that whose best ranked candidate has the median error of all, so it is neither the best nor "
    "the worst."
)
INITIAL_POSES = "initial poses"


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


_VARIED = {  # the five parameters, as attributes of a method or of a part of it
    INITIAL_POSES: ("n_candidates",),
    "rounds": ("rounds",),
    "trees": ("regressors", "n_trees"),
    "tree depth": ("regressors", "max_depth"),
    "metric trees": ("metric", "n_trees"),
}


def chosen_values(method: Method) -> dict[str, int]:
    """The method's own value of each of the five parameters."""
    return {name: attrgetter(".".join(path))(method) for name, path in _VARIED.items()}


def with_value(method: Method, number: str, value: int) -> Method:
    """The method with one of the five parameters changed."""
    *part, name = _VARIED[number]
    changed: dict[str, Any] = {name: value}
    if number == INITIAL_POSES:
        changed["top_k"] = min(value, method.top_k)
    for whole in part:
        changed = {whole: getattr(method, whole)._replace(**changed)}
    return replace(method, **changed)


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
    left_out = (
        {}
        if method.proposals is None
        else {
            INITIAL_POSES: "not varied: a forest proposes the initial poses of this variant, two "
            "for each of its trees"
        }
    )
    own = {name: n for name, n in chosen_values(method).items() if name not in left_out}
    points = [
        (number, value)
        for number, values in sweep.values
        if number in own
        for value in sorted({*values, own[number]})
    ]
    curves: dict[str, list[dict[str, float]]] = {number: [] for number, _ in points}
    base, candidates, base_metric = _train(data, skeleton, method, recipe.seed)
    for k, (number, value) in enumerate(points):
        progress(k, len(points), f"{skeleton.name}, {variant}: {number} {value}")
        changed = with_value(method, number, value)
        cascade, metric = base, base_metric
        if number == "metric trees" and changed != method:
            rng = np.random.default_rng(recipe.seed + 1)
            metric = training.train_metric(data, replace(base, method=changed), candidates, rng)
        elif number != INITIAL_POSES and changed != method:
            cascade, _, metric = _train(data, skeleton, changed, recipe.seed)
        model = Model(replace(cascade, method=changed), metric, None, {})
        run = training.run_on(model, test, np.random.default_rng(recipe.seed))
        error = run.joint_error.mean(axis=1)
        curves[number].append(
            {"value": value, "mean_mm": float(error.mean()), "median_mm": float(np.median(error))}
        )
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
    cascade, candidates = training.train_cascade(
        data, skeleton, method, rng, lambda share, what: None
    )
    return cascade, candidates, training.train_metric(data, cascade, candidates, rng)


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
        proposals = forest, np.zeros((forest.n_trees, n), np.bool_)  # no tree saw them
    method_k = replace(method, training_candidates=k)
    candidates = training.start_candidates(
        data, skeleton, method_k, np.random.default_rng(0), proposals
    )
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
    return data[np.flatnonzero(data.animal)[:n]]


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
        errors.append(training.joint_error(candidates, data.truth))
        positions.append(candidates.positions.copy())

    note("start")
    for joint, c in cascade.steps(data.images, candidates):
        left = [one for one in left if one != joint]
        note(f"{skeleton.names[joint]} {c + 1}")
    return names, errors, positions


def _pixels(positions: Array, data: TrainingSet, image: int) -> Array:
    """Columns and rows (m, J, 2) of joints (m, J, 3) of one image's view in its height map."""
    packed = data.images.crop_cameras[image]
    camera = _height_map_kernels.CropCamera(*packed)
    x, y, z = np.moveaxis(
        height_maps.in_camera_frame(positions, np.repeat(packed[None], len(positions), 0)), -1, 0
    )
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
    """Generate an action, and render it at evenly spaced key frames."""
    rng = np.random.default_rng([scenario.individual, scenario.seed])
    stage = staged(scenario, rng)
    motion, steps, pose, _, species, views, *_ = stage
    inside = np.flatnonzero(motion.word[steps] == scenario.word)
    # at most four key frames
    rows = np.linspace(0, len(inside) - 1, min(4, len(inside))).round().astype(int)
    (patches,) = rendered(rng, stage, inside[rows], 128)
    joints = pose[inside].joints(species.skeleton)
    middle = joints.mean(axis=1)
    side = scenario.word in ("surface", "dive")
    axes = np.eye(3)[:2]
    if side:
        axes = np.array([[*_direction(middle), 0.0], [0.0, 0.0, 1.0]])
    bodies = []
    for k, row in enumerate(rows):
        points = _visible_points(patches, k, views.T_arena_camera[0])
        off = np.linalg.norm(points[:, None] - joints[row], axis=-1).min(axis=1)
        # points farther from every joint are noise
        body = points[off < 0.25 * species.skeleton.length]
        # at most 1,500 points of a body
        bodies.append((body[:: max(1, -(-len(body) // 1_500))] - middle[0]) @ axes.T)
    return {
        "word": scenario.word,
        "side": side,
        "path_mm": (middle - middle[0]) @ axes.T,
        "bodies_mm": bodies,
        "skeletons_mm": (joints[rows] - middle[0]) @ axes.T,
        "edges": species.skeleton.edges,
        "seconds": (len(middle) - 1) / scenario.rate_hz,
    }


def _visible_points(patches: height_maps.Patches, k: int, T_arena_camera: SE3) -> Array:
    """Points of patch k above the ground, (m, 3) mm, arena frame."""
    depth = patches.depth[k].astype(float)
    # a pixel less than 4 mm above the empty ground is noise
    v, u = np.nonzero((depth > 0) & (patches.background[k] - depth > 4.0))
    fx, fy, cx, cy = patches.intrinsics[k]
    z = depth[v, u]
    x = (u + patches.origin[k, 0] - cx) / fx * z
    return np.asarray(
        T_arena_camera @ np.stack([x, (v + patches.origin[k, 1] - cy) / fy * z, z], axis=-1)
    )


def _direction(path: Array) -> Array:
    """The main horizontal direction (2,) of a path (n, 3), pointing from its start to its end."""
    axis = np.linalg.svd(path[:, :2] - path[:, :2].mean(axis=0), full_matrices=False)[2][0]
    return np.asarray(axis if (path[-1, :2] - path[0, :2]) @ axis >= 0 else -axis)
