"""Measurement of the rows of Tables 1 to 3: each method's results on each split, and its speed.

A row is one method with one or several runs: three training draws of the paper's variant, each with
five initial poses if it has only one. Lie-X assumes one object in the depth image and a skeleton of
"proper scaling" (sections 3 and 4), so the choice of object and its size must not distinguish the
methods: our default estimator chooses for all. `wrong` marks frames in which the chosen component
is another object, `wrong_alone` those in which the choice by area and volume, which the paper's
variant and the baselines would make, is. A component is another object if its centroid is farther
from the middle of the true joints than 0.8 spines. All numbers are mm.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from liex_lab.baselines.baseline import Baseline, PlainMean, chosen, second_is_likelier
from liex_lab.errors import PlanError
from liex_lab.estimation.estimator import PoseEstimator
from liex_lab.evaluation.scores import PoseErrors, interval95, plain
from liex_lab.geometry import SE3
from liex_lab.plan import Plan
from liex_lab.runtime.progress import Progress, silent
from liex_lab.scene.height_maps import HeightMaps, Segmenter, view_of
from liex_lab.simulation.recording import TrueRecording

from ...build import build_scene, plan_of
from ...training.pose_model import estimator_of
from ..pose import subject_of, told_by
from ..speed import Footage, two_cores

Array = NDArray[np.float64]
Subject = PoseEstimator | Baseline
Tests = Mapping[str, Sequence[TrueRecording]]  # by split

ROWS = ("default", "paper", "paper-one-pose", "paper-no-metric", "rf", "cnn")
SWEPT = ("paper", "default")  # whose curves (Fig. 7) and failures (Fig. 17) are drawn
# number of trainings that a row is pooled over, if several
TRAINING_DRAWS = {"paper": 3, "paper-one-pose": 3, "paper-no-metric": 3}
START_DRAWS = 5  # draws of the only initial pose, for each training
_RATE_FRAMES = 128
_RATE_REPEATS = 3
_QUANTILES = 101
_OTHER = 0.8  # of the spine
_FAILURES = 2  # of each split
_MARGIN = 0.35  # of the longest side of the true joints' rectangle
_LEAST_PX = 12
_DIGITS = 2  # of a joint's position, mm


def runs_of(animal: str, variant: str, progress: Progress = silent) -> list[Subject]:
    """The runs of a row: its models, from the cache or trained now, with their initial poses.

    Raises:
        MissingPackageError: the row is the CNN and torch is not installed.
    """
    if variant not in TRAINING_DRAWS:
        return [subject_of(animal, variant, progress)]
    draws = range(TRAINING_DRAWS[variant])
    models = [estimator_of(animal, "paper", progress, draw=draw) for draw in draws]
    return runs_of_models(variant, models)


def runs_of_models(variant: str, models: Sequence[PoseEstimator]) -> list[Subject]:
    """The runs of a row of the paper's variant, from one estimator per training draw.

    Raises:
        PlanError: there is no such row.
    """
    if variant == "paper":
        return list(models)
    if variant == "paper-no-metric":
        return [PlainMean(one) for one in models]
    if variant != "paper-one-pose":
        raise PlanError(f"'{variant}' is no row of the paper's variant")
    return [
        PoseEstimator(one.model, 1, start_seed=START_DRAWS * k + draw)
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
    recording: TrueRecording, plan: Plan, chooser: PoseEstimator
) -> tuple[Segmenter, NDArray[np.float32], CommonView]:
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
    second = chooser.second_is_animal(frames, scene, size)
    alone = second_is_likelier(frames, scene)
    wrong, wrong_alone = (
        is_other(*chosen(frames, scene, 1.0, choice, True), recording) for choice in (second, alone)
    )
    return scene, frames, CommonView(size, second, wrong, wrong_alone)


def is_other(crops: HeightMaps, crop_cameras: Array, recording: TrueRecording) -> NDArray[np.bool_]:
    """Whether (n,) a component is another object than the animal, by its centroid."""
    T = view_of(crop_cameras)
    joints = SE3(T.rotation[:, None], T.translation[:, None]) @ recording.joints_camera
    blob = crops.blobs
    height = blob.volume_mm3 / np.maximum(blob.area_mm2, 1e-9)
    centroid = np.stack([blob.x, blob.y, height], axis=-1)
    off = np.linalg.norm(centroid - joints.mean(axis=1), axis=-1)
    return np.asarray(crops.found & (off > _OTHER * recording.spine_mm))


def measured(
    subject: Subject,
    frames: NDArray[np.float32],
    scene: Segmenter,
    view: CommonView,
    cut: dict[tuple[float, bool], tuple[HeightMaps, Array]],
) -> tuple[Array, Array, Array]:
    """Joints, predicted errors and their interval of one subject on the common choice of object.

    Args:
        subject: an estimator or a baseline.
        frames: (n, H, W) float32 depth, mm, 0 where unread.
        scene: the fitted segmenter.
        view: the rows' common input.
        cut: cache of height maps by size and view, shared by subjects; filled.

    Returns:
        As `pose.measure`: joints (n, J, 3) mm, camera frame; predicted error (n,) mm; factors (2,).
    """
    sized, camera_view = (
        (subject.model.method.session_size, subject.model.method.camera_view)
        if isinstance(subject, PoseEstimator)
        else (subject.takes_size, True)
    )
    key = (view.size if sized else 1.0, camera_view)
    if key not in cut:
        cut[key] = chosen(frames, scene, key[0], view.second, camera_view)
    if isinstance(subject, PoseEstimator):
        return told_by(subject, subject.best_of(*cut[key], key[0]))
    return told_by(subject, subject.guesses(*cut[key], key[0]))


def measured_rows(
    animal: str,
    runs: Mapping[str, Sequence[Subject]],
    chooser: PoseEstimator,
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
                    error = PoseErrors.compare(joints, recording.joints_camera, tip, *predicted)
                    errors[name][run].append(error)
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
    quantiles = np.quantile(found, np.linspace(0, 1, _QUANTILES)) if len(found) else np.zeros(0)
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
    animal: str, subjects: Mapping[str, Subject], recordings: Sequence[TrueRecording]
) -> dict[str, dict[str, Any]]:
    """Frames per second of each subject on at most two cores, foreground included.

    All are timed on the same 128 frames in memory, of the recording with the wider depth images of
    the split's first two, the best of 3 repeats.

    Returns:
        By variant `frames_per_s`, `ratio_to_default`, `cores` and `picture`.
    """
    footage = Footage.of(animal, recordings[:2], next(iter(subjects.values())), _RATE_FRAMES)
    rates = {}
    with two_cores() as cores:
        for name, subject in subjects.items():
            own = replace(footage, size=subject.find_size(footage.sample, footage.scene))
            rates[name] = own.frames_per_s(subject, True, _RATE_REPEATS)
    return {
        name: {
            "frames_per_s": rate,
            "ratio_to_default": rate / rates["default"],
            "cores": cores,
            "picture": footage.pixels,
        }
        for name, rate in rates.items()
    }


def example_frames(recordings: Sequence[TrueRecording]) -> list[tuple[int, int]]:
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
    split: str, joints: Sequence[Array], recordings: Sequence[TrueRecording]
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
        for error, k, i in worst[:_FAILURES]
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
        By variant, for each frame `head`; `depth` (h, w) float32 mm around the animal, 0 where
        unread; `camera` of that part; `edges`; `spine_mm`; `truth` (J, 3) mm, camera frame; and, if
        the row has one, `pose` (J, 3), which is None if nothing was found.
    """
    found: dict[str, list[dict[str, Any]]] = {name: [] for name in rows}
    for place in places:
        key = (place["split"], place["recording"], int(place["frame"]))
        shown = _around(tests[key[0]][key[1]], key[2]) | {"head": key[0]}
        for name, poses in rows.items():
            found[name].append(dict(shown))
            for one in poses:
                if (one["split"], one["recording"], one["frame"]) == key:
                    joints = one["joints_mm"]
                    found[name][-1]["pose"] = None if joints is None else np.array(joints)
    return found


def _around(recording: TrueRecording, frame: int) -> dict[str, Any]:
    """The truth of a frame, with the part of its depth image around it and that part's camera."""
    camera, truth = recording.camera, recording.joints_camera[frame]
    true_px = camera.project(truth)
    reach = 0.5 * np.ptp(true_px, axis=0).max()
    half = int(np.ceil(max((1.0 + 2.0 * _MARGIN) * reach, _LEAST_PX)))
    low = np.floor(0.5 * (true_px.min(axis=0) + true_px.max(axis=0))).astype(int) - half
    side = 2 * half + 1
    whole = recording.depths(frame, frame + 1)[0]
    rows, columns = (np.arange(start, start + side) for start in (low[1], low[0]))
    depth = np.zeros((side, side), np.float32)
    in_rows, in_columns = (
        (at >= 0) & (at < n) for at, n in zip((rows, columns), whole.shape, strict=True)
    )
    depth[np.ix_(in_rows, in_columns)] = whole[np.ix_(rows[in_rows], columns[in_columns])]
    shift: dict[str, Any] = {"cx": camera.cx - float(low[0]), "cy": camera.cy - float(low[1])}
    return {
        "depth": depth,
        "camera": replace(camera, **shift, width=side, height=side),
        "edges": recording.skeleton.edges,
        "spine_mm": recording.spine_mm,
        "truth": truth,
    }
