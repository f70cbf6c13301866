"""Tables 1 to 3 of Lie-X (section 5.2) and the numbers behind its figures, on rendered data.

`liex evaluate tables` measures six rows on an animal's test splits (40 recordings each): our
default, Lie-X as the paper has it, its ablations without multiple initial poses and without the
learned metric, and the baselines RF and CNN. All see the same frames, cut out by the product's own
foreground. Numbers: the figures of `liex evaluate pose`, error of each joint and 101 quantiles of
the error distribution (Fig 8), mm; frames/s on at most two cores; sensitivity to five parameters
(Fig 7); candidates and convergence of one image (Fig 13 to 16). Rows whose models take long to
train may be taken from kept results, if they fit the same training and the same frames.
"""

from __future__ import annotations

import hashlib
import platform
import shlex
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from liex_lab.catalog import MODELS
from liex_lab.errors import MissingPackageError
from liex_lab.evaluation.pose import PoseErrors, plain
from liex_lab.runtime.progress import Progress, silent

from ...build import plan_of
from .results import Results

if TYPE_CHECKING:
    from liex_lab.baselines.baseline import Baseline
    from liex_lab.body.skeleton import Skeleton
    from liex_lab.estimation.estimator import PoseEstimator
    from liex_lab.simulation.recording import TrueRecording

ROWS = ("default", "paper", "paper-one-pose", "paper-no-metric", "rf", "cnn")
SWEPT = ("paper", "default")  # variants whose sensitivity is drawn
_RATE_FRAMES = 128
_RATE_REPEATS = 3
_N_SESSIONS = 40
_QUICK_FRAMES = 100
_QUANTILES = 101
Draw = Callable[[Mapping[str, Any], Path], list[Path]]


@dataclass(frozen=True)
class Budget:
    """How much is measured.

    Attributes:
        n_frames: frames of each split, rounded up to whole recordings; None takes all.
        kept: results that fit are taken from datasets/kept_results.
        quick: every row is trained on next to nothing, to see that everything runs.
        n_illustrated: images behind the figures of candidates and convergence.
    """

    n_frames: int | None = None
    kept: bool = True
    quick: bool = False
    n_illustrated: int = 128


def make_tables(
    out: str | Path,
    animals: Sequence[str],
    *,
    n_frames: int | None = None,
    quick: bool = False,
    fresh: bool = False,
    draw: Draw | None = None,
    progress: Progress = silent,
) -> list[Path]:
    """Write tables, figures and the form in which results are kept into a folder.

    Args:
        out: the folder; it is made where it is missing.
        animals: names of bundled animals.
        n_frames: frames of each split; None takes all.
        quick: few frames, every row trained on next to nothing; its numbers say only that
            everything runs.
        fresh: nothing kept is used.
        draw: makes the figures from what `results` holds, by animal, in the folder.
        progress: told how far the job is.

    Returns:
        The paths of all files that were written.
    """
    from .cached_results import keep_results
    from .table_text import write_tables

    budget = Budget(n_frames, kept=not fresh)
    if quick:
        budget = Budget(n_frames or _QUICK_FRAMES, kept=False, quick=True, n_illustrated=16)
    command = _command(animals, n_frames, quick, fresh)
    folder = Path(out)
    folder.mkdir(parents=True, exist_ok=True)
    all_results = [results_of(animal, budget, command, progress) for animal in animals]
    written = write_tables(folder, all_results, quick)
    for results in all_results:
        kept = _unmarked(results.rows), _unmarked(results.sensitivity)
        written.append(keep_results(folder / "kept", results.animal, *kept))
    if draw is not None:
        progress(0, None, "drawing")
        written += draw({r.animal: vars(r) for r in all_results}, folder)
    return written


def _command(animals: Sequence[str], n_frames: int | None, quick: bool, fresh: bool) -> str:
    """The command line that makes the same numbers."""
    words = ["liex", "evaluate", "tables", *(f"--animal={animal}" for animal in animals)]
    words += [f"--frames={n_frames}"] if n_frames else []
    return shlex.join([*words, *(["--quick"] if quick else []), *(["--fresh"] if fresh else [])])


def _unmarked(rows: Mapping[str, dict[str, Any]]) -> dict[str, dict[str, Any]]:
    return {
        name: {key: value for key, value in row.items() if key != "origin"}
        for name, row in rows.items()
    }


def results_of(animal: str, budget: Budget, command: str, progress: Progress) -> Results:
    """Every row, curve and illustration of one animal.

    Args:
        animal: a bundled animal's name, or the path of a skeleton's TOML.
        budget: how much is measured.
        command: the command line that makes the same numbers, noted beside them.
        progress: told how far the job is.
    """
    from liex_lab.body.skeleton import Skeleton
    from liex_lab.simulation.simulator import world_of

    from .cached_results import fits, kept_results
    from .illustrations import illustrate

    skeleton = Skeleton.load(animal)
    world = world_of(skeleton)
    n_sessions = _N_SESSIONS
    if budget.n_frames is not None:
        n_sessions = -(-budget.n_frames // len(world.test_split(world.splits[0], n_sessions=1)[0]))
    tests = {split: world.test_split(split, n_sessions=n_sessions) for split in world.splits}
    results = Results(skeleton.name, list(skeleton.names), list(world.splits))
    kept = kept_results(skeleton.name) if budget.kept else {"rows": {}, "sensitivity": {}}
    for name in ROWS[1:]:
        row = kept["rows"].get(name)
        if row is not None and fits(row, made_from(name, skeleton), tests):
            results.rows[name] = {**row, "origin": "kept"}
    subjects = _subjects(
        animal, [name for name in ROWS if name not in results.rows], budget, results, progress
    )
    for name, row in measured_rows(animal, subjects, tests, progress).items():
        made = {"quick": True} if budget.quick else made_from(name, skeleton)
        results.rows[name] = {
            "origin": "measured",
            "made": {"from": made, "command": command, **_made_by()},
            **row,
        }
    results.rows = {name: results.rows[name] for name in ROWS if name in results.rows}
    results.sensitivity = _sensitivities(skeleton, kept["sensitivity"], budget, command, progress)
    progress(0, None, f"{skeleton.name}: candidates and convergence")
    results.illustration = illustrate(
        cast("PoseEstimator", subjects["default"]).model, budget.n_illustrated
    )
    return results


def _subjects(
    animal: str, names: Sequence[str], budget: Budget, results: Results, progress: Progress
) -> dict[str, PoseEstimator | Baseline]:
    """What has to be measured; why a row cannot be goes into `results.missing`."""
    from ..pose import subject_of
    from .quick import quick_subject

    subjects = {}
    for name in names:
        try:
            subjects[name] = (quick_subject if budget.quick else subject_of)(animal, name, progress)
        except MissingPackageError as error:
            results.missing[name] = str(error)
    return subjects


def made_from(variant: str, skeleton: Skeleton) -> dict[str, Any]:
    """What decides a row's numbers: how its model is trained, and what is done with it.

    Args:
        variant: a name of `ROWS`.
        skeleton: the animal's skeleton.

    Returns:
        Plain values: recipe and method, or the training of a baseline.
    """
    from liex_lab.estimation.method import method_of

    from ...training.baselines import BASELINES, training_of
    from ...training.pose_model import recipe_of

    if variant in BASELINES:
        return training_of(variant, skeleton).to_dict()
    base = "default" if variant == "default" else "paper"
    return {
        "recipe": plain(vars(recipe_of(base, skeleton))),
        "method": plain(method_of(base, skeleton).to_dict()),
    }


def _made_by() -> dict[str, str]:
    """The program and the machine."""
    from liex_lab.sessions.provenance import package_version

    sources = hashlib.sha256()
    for path in sorted(MODELS.parent.rglob("*.py")):
        sources.update(path.read_bytes())
    machine = f"{platform.processor() or platform.machine()}, Python {platform.python_version()}"
    return {
        "version": package_version("liex_lab"),
        "code": sources.hexdigest()[:12],
        "machine": machine,
    }


def measured_rows(
    animal: str,
    subjects: Mapping[str, PoseEstimator | Baseline],
    tests: Mapping[str, Sequence[TrueRecording]],
    progress: Progress,
) -> dict[str, dict[str, Any]]:
    """The measured figures of each subject: `splits` and `rate`.

    Args:
        animal: a bundled animal's name, or the path of a skeleton's TOML.
        subjects: estimators and baselines by variant; `default` is among them.
        tests: recordings with their truth by split.
        progress: told recording by recording.
    """
    from ..pose import errors_of
    from .cached_results import first_joints

    rows: dict[str, dict[str, Any]] = {name: {"splits": {}} for name in subjects}
    for split, sessions in tests.items():
        for name, errors in errors_of(subjects, sessions, plan_of(animal), progress).items():
            rows[name]["splits"][split] = {
                **_numbers(errors),
                "first_joints_mm": first_joints(sessions),
            }
    progress(0, None, "timing")
    for name, rate in rates_of(animal, subjects, next(iter(tests.values()))).items():
        rows[name]["rate"] = rate
    return rows


def _numbers(errors: PoseErrors) -> dict[str, Any]:
    """What is kept of the errors of one split: the figures, the error of each joint, and the
    distribution.
    """
    seen = np.isfinite(errors.error_mm)
    quantiles = (
        np.quantile(errors.error_mm[seen], np.linspace(0, 1, _QUANTILES))
        if seen.any()
        else np.array([])
    )
    return {
        **plain(errors.summary()),
        "n_frames": len(errors.error_mm),
        "joint_mm": [round(float(x), 3) for x in errors.joint_mm[seen].mean(axis=0)],
        "error_quantiles_mm": [round(float(x), 3) for x in quantiles],
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


def _sensitivities(
    skeleton: Skeleton, kept: Mapping[str, Any], budget: Budget, command: str, progress: Progress
) -> dict[str, Any]:
    """Fig. 7 of the paper's variant and of ours, kept or measured now."""
    from liex_lab.estimation.method import method_of

    from .quick import QUICK_SWEEP
    from .sensitivity import Sweep, sensitivity, without_void

    curves = {}
    for variant in SWEPT[: 1 if budget.quick else None]:
        sweep = QUICK_SWEEP if budget.quick else Sweep()
        made = {**made_from(variant, skeleton), "sweep": plain(vars(sweep))}
        made["method"].pop("tells_facing", None)  # no model of a sweep does
        known = kept.get(variant)
        if known is not None and known["made"]["from"] == made:
            told = without_void(known, method_of(variant, skeleton))
            curves[variant] = {**told, "origin": "kept"}
            continue
        curve = sensitivity(skeleton, variant, sweep, progress)
        curves[variant] = {
            **curve,
            "made": {"from": made, "command": command, **_made_by()},
            "origin": "measured",
        }
    return curves
