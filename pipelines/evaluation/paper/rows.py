"""Measuring the rows of Tables 1 to 3: the figures of each method on each split, and its speed.

A row is one method with one or several runs: three training draws of the paper's variant, each with
five initial poses where it has only one. All rows measure the object that one chooser picked, with
the size that it found (`common_view`). Numbers, mm: median and mean over all runs and frames, the
median of each run, 95 % intervals of median and mean by bootstrap over recordings, share of frames
in which another object was measured, and the figures of `liex evaluate pose`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from liex_lab.errors import PlanError
from liex_lab.evaluation.bootstrap import interval95
from liex_lab.evaluation.pose import PoseErrors, plain
from liex_lab.runtime.progress import Progress, silent

from ...build import plan_of
from .common_view import CommonView, common_view, measured
from .examples import examples_in, failures_in

if TYPE_CHECKING:
    from liex_lab.baselines.baseline import Baseline
    from liex_lab.estimation.estimator import PoseEstimator
    from liex_lab.simulation.recording import TrueRecording

    Subject = PoseEstimator | Baseline

Array = NDArray[np.float64]

ROWS = ("default", "paper", "paper-one-pose", "paper-no-metric", "rf", "cnn")
SWEPT = ("paper", "default")  # whose curves (Fig. 7) and failures (Fig. 17) are drawn
# trainings that a row is pooled over, where there are several
TRAINING_DRAWS = {"paper": 3, "paper-one-pose": 3, "paper-no-metric": 3}
START_DRAWS = 5  # of the only initial pose of each of them
_RATE_FRAMES = 128
_RATE_REPEATS = 3
_QUANTILES = 101


def runs_of(animal: str, variant: str, progress: Progress = silent) -> list[Subject]:
    """The runs of a row: its models, each with its draws of the initial poses.

    Models come from the cache where this version of the program trained them, else are trained now.

    Args:
        animal: a bundled animal's name, or the path of a skeleton's TOML.
        variant: a name of `ROWS`.
        progress: told how far the training is, where there is one.

    Raises:
        MissingPackageError: the CNN is asked for and torch is not installed.
    """
    from ..pose import estimator_of, subject_of

    if variant not in TRAINING_DRAWS:
        return [subject_of(animal, variant, progress)]
    draws = range(TRAINING_DRAWS[variant])
    models = [estimator_of(animal, "paper", progress, draw=draw) for draw in draws]
    return runs_of_models(variant, models)


def runs_of_models(variant: str, models: Sequence[PoseEstimator]) -> list[Subject]:
    """The runs of a row of the paper's variant, from its models.

    Args:
        variant: `paper`, `paper-one-pose` or `paper-no-metric`.
        models: the paper's variant, one estimator a training draw.

    Raises:
        PlanError: it is no such row.
    """
    from liex_lab.baselines.ablations import PlainMean
    from liex_lab.estimation.estimator import PoseEstimator

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


def measured_rows(
    animal: str,
    runs: Mapping[str, Sequence[Subject]],
    chooser: PoseEstimator,
    tests: Mapping[str, Sequence[TrueRecording]],
    progress: Progress,
) -> dict[str, dict[str, Any]]:
    """What is measured of each row.

    Every recording is rendered and its scene learned once.

    Args:
        animal: a bundled animal's name, or the path of a skeleton's TOML.
        runs: estimators and baselines by variant; `default` is among them.
        chooser: the default estimator.
        tests: recordings with their truth by split.
        progress: told recording by recording.

    Returns:
        By row `splits` and `rate`, `examples` and, of those that Fig. 17 draws, `failures`.
    """
    rows: dict[str, dict[str, Any]] = {
        name: {"splits": {}, "examples": [], "failures": []} for name in runs
    }
    for split, sessions in tests.items():
        measured_ones = []
        for k, recording in enumerate(sessions):
            progress(k, len(sessions), f"measuring {recording.name}")
            measured_ones.append(_measure(recording, animal, runs, chooser))
        views = [one.view for one in measured_ones]
        for name in runs:
            errors = [
                PoseErrors.join(list(of_run))
                for of_run in zip(*(one.errors[name] for one in measured_ones), strict=True)
            ]
            first = [one.first[name] for one in measured_ones]
            rows[name]["splits"][split] = numbers_of(errors, views)
            rows[name]["examples"] += examples_in(split, first, sessions)
            if name in SWEPT:
                rows[name]["failures"] += failures_in(split, first, sessions)
    progress(0, None, "timing")
    timed = {name: some[0] for name, some in runs.items()}
    for name, rate in rates_of(animal, timed, next(iter(tests.values()))).items():
        rows[name]["rate"] = rate
    return rows


class _Measured(NamedTuple):
    """One recording: what every row is given; by row the errors of its runs, and the joints
    (n, J, 3) mm that the first of them finds.
    """

    view: CommonView
    errors: dict[str, list[PoseErrors]]
    first: dict[str, Array]


def _measure(
    recording: TrueRecording,
    animal: str,
    runs: Mapping[str, Sequence[Subject]],
    chooser: PoseEstimator,
) -> _Measured:
    scene, frames, view = common_view(recording, plan_of(animal), chooser)
    out = _Measured(view, {name: [] for name in runs}, {})
    cut: dict[Any, Any] = {}
    tip = chooser.skeleton.tip
    for name, subjects in runs.items():
        for subject in subjects:
            joints, predicted_mm, quantiles = measured(subject, frames, scene, view, cut)
            out.first.setdefault(name, joints)
            out.errors[name].append(
                PoseErrors.compare(joints, recording.joints_camera, tip, predicted_mm, quantiles)
            )
    return out


def numbers_of(runs: Sequence[PoseErrors], views: Sequence[CommonView]) -> dict[str, Any]:
    """What is kept of a row on one split.

    Args:
        runs: errors of the n frames of each run.
        views: what the row was given in each recording.

    Returns:
        `median_mm`, `mean_mm`, `interval95` (of the median) and `mean_interval95`, `run_median_mm`,
        `wrong_object`, `wrong_object_alone`, `n_frames`, `n_recordings`, the figures of
        `PoseErrors.summary` over all runs, error of each joint, and quantiles.
    """
    errors = PoseErrors.join(list(runs))
    recording = np.concatenate([np.full(len(one.wrong), k) for k, one in enumerate(views)])
    again = np.tile(recording, len(runs))
    seen = np.isfinite(errors.error_mm)
    found = errors.error_mm[seen]
    spread = np.linspace(0, 1, _QUANTILES)
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
        "joint_mm": [round(float(x), 3) for x in errors.joint_mm[seen].mean(axis=0)]
        if len(found)
        else [],
        "error_quantiles_mm": [round(float(x), 3) for x in np.quantile(found, spread)]
        if len(found)
        else [],
    }


def rates_of(
    animal: str, subjects: Mapping[str, PoseEstimator | Baseline], sessions: Sequence[TrueRecording]
) -> dict[str, dict[str, Any]]:
    """Frames per second of each subject on at most two cores, foreground included.

    All are timed on the same 128 frames in memory, of the recording with the wider pictures of the
    split's first two, the best of 3 repeats.

    Args:
        animal: a bundled animal's name, or the path of a skeleton's TOML.
        subjects: estimators and baselines by variant; `default` is among them.
        sessions: recordings of a split.

    Returns:
        By variant `frames_per_s`, `ratio_to_default`, `cores` and `picture`.
    """
    import numba

    from ...build import build_scene
    from ..speed import best_seconds

    recording = max(sessions[:2], key=lambda session: session.width)
    plan = plan_of(animal)
    scene, sample = build_scene(recording, plan, next(iter(subjects.values())).skeleton, 96)
    frames = recording.depths(0, min(len(recording), _RATE_FRAMES))
    frames = frames[np.arange(_RATE_FRAMES) % len(frames)]
    cores = min(2, numba.config.NUMBA_NUM_THREADS)
    before = numba.get_num_threads()
    numba.set_num_threads(cores)
    rates = {}
    try:
        for name, subject in subjects.items():
            size = subject.find_size(sample, scene)
            rates[name] = _RATE_FRAMES / best_seconds(
                partial(subject.estimate, frames, scene, size), _RATE_REPEATS
            )
    finally:
        numba.set_num_threads(before)
    picture = f"{recording.width} x {recording.height}"
    return {
        name: {
            "frames_per_s": rate,
            "ratio_to_default": rate / rates["default"],
            "cores": cores,
            "picture": picture,
        }
        for name, rate in rates.items()
    }
