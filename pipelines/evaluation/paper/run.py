"""Tables 1 to 3 of Lie-X (section 5.2) and the numbers behind its figures, on rendered data.

`liex evaluate tables` measures six rows on an animal's test splits (40 recordings each): our
default, the paper's variant of Lie-X, its ablations without multiple initial poses and without the
learned metric, and the baselines RF and CNN. Rows and curves whose models take long to train are
kept: `datasets/kept_results/ANIMAL.json` has their numbers and provenance (version, command, seeds,
day and machine). Nothing checks that today's code gives the same numbers; the tables mark each row
of another version, and these rows are measured again before a release.
"""

import json
import platform
import re
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import date
from functools import cache
from pathlib import Path
from typing import Any, cast

import numba
from liex_lab.dashboards.paper.page import write_paper

from liex_lab.actions.storage import load_action_model
from liex_lab.baselines.baseline import CnnPlan, require_torch
from liex_lab.body.skeleton import Skeleton
from liex_lab.catalog import bundled_models, kept_results_folder
from liex_lab.errors import LiexError, MissingPackageError, PlanError, expecting
from liex_lab.estimation.estimator import PoseEstimator
from liex_lab.estimation.method import method_of
from liex_lab.evaluation.scores import plain
from liex_lab.runtime.progress import Progress, silent
from liex_lab.sessions.provenance import package_version
from liex_lab.simulation.recording import SEALED
from liex_lab.simulation.simulator import world_of

from ...training.action_model import acted_tracks, cut_sequences
from ...training.pose_model import (
    BASELINES,
    estimator_of,
    fit,
    make_model,
    recipe_of,
    rendered_set,
    shared_images,
    training_of,
)
from ..actions import sequence_scores
from ..nyu import evaluate_nyu
from ..tracking import evaluate_tracking
from . import rows
from .rows import ROWS, SWEPT, TRAINING_DRAWS, Subject, Sweep, Tests

CURVES = "fig7"  # name of the curves among the names of rows
PARTS = ("tracking", "actions")
SCHEMA = 4
_N_SESSIONS = 40
_VERBS = {
    "tracking": "liex evaluate tracking --animal mouse --sequence easy --figure F.png",
    "actions": "liex evaluate actions --animal fish --out DIR",
    "nyu": "liex evaluate nyu --reference FOLDER",
}
# a quick run
_QUICK_ILLUSTRATED = 16
_QUICK_IMAGES = {"paper": 1_024, "rf": 2_048, "cnn": 2_048}
QUICK_SWEEP = Sweep(
    n_images=512,
    n_test=512,
    values=(
        ("initial poses", (1, 10)),
        ("rounds", (1,)),
        ("trees", (2,)),
        ("tree depth", (8,)),
        ("metric trees", (5,)),
    ),
)


@dataclass(frozen=True)
class Budget:
    """What is measured, and on how much data.

    Attributes:
        n_frames: frames of each split, rounded up to whole recordings; None means all.
        fresh: rows that are trained and measured now.
        curves: whether the curves of Fig. 7 are, too.
        kept: whether the other rows come from datasets/kept_results; otherwise they are missing.
        quick: train every row on very little data, to check that everything runs.
        sealed: measure the sealed split instead of the others.
    """

    n_frames: int | None
    fresh: tuple[str, ...]
    curves: bool
    kept: bool
    quick: bool
    sealed: bool

    @staticmethod
    def of(
        n_frames: int | None, quick: bool, fresh: bool, rows: Sequence[str], sealed: bool
    ) -> "Budget":
        """The budget for the options of the command line.

        Raises:
            PlanError: there is no such row.
        """
        known = (*ROWS, CURVES)
        if unknown := [row for row in rows if row not in known]:
            raise PlanError(f"there is no row '{unknown[0]}'; known are {', '.join(known)}")
        wanted = tuple(row for row in ROWS if not rows or row in rows or row == "default")
        if quick:
            return Budget(n_frames or 100, wanted, True, False, True, sealed)
        whole = n_frames is None and not sealed
        everything = fresh and not rows
        return Budget(
            n_frames,
            fresh=wanted if fresh or rows or not whole else ("default",),
            curves=whole and (everything or CURVES in rows),
            kept=whole and not everything,
            quick=False,
            sealed=sealed,
        )


def run_tables(
    out: str | Path,
    animals: Sequence[str] = (),
    *,
    n_frames: int | None = None,
    quick: bool = False,
    fresh: bool = False,
    rows: Sequence[str] = (),
    sealed: bool = False,
    without: Sequence[str] = (),
    nyu: Path | None = None,
    progress: Progress = silent,
) -> list[Path]:
    """Make every table and figure of the Lie-X paper on one page; returns the files written.

    Args:
        out: the output folder; it is created if missing. Results are in results.json, the rows to
            keep in kept/ANIMAL.json.
        animals: names of bundled animals; () means all that have a bundled model.
        n_frames: frames of each split, of which every row is then measured; None means all.
        quick: few frames, every row trained on very little data.
        fresh: train and measure rows now instead of using kept results.
        rows: measure only these rows and the default, or `fig7` for its curves; the others come
            from kept results. () measures as `fresh` states.
        sealed: measure the sealed split instead of the others, once per release.
        without: parts of other verbs to leave out, `tracking` or `actions`.
        nyu: folder of the NYU hand data, for Table 2; None leaves it out.
        progress: called with the progress of the job.

    Raises:
        PlanError: there is no such row, or part.
        LiexError: kept results are damaged.
    """
    if unknown := [name for name in without if name not in PARTS]:
        raise PlanError(
            f"there is no part '{unknown[0]}' to leave out; known are {', '.join(PARTS)}"
        )
    budget = Budget.of(n_frames, quick, fresh, rows, sealed)
    animals = animals or list(bundled_models())
    command = _command(animals, n_frames, quick, fresh, rows, sealed)
    folder = Path(out)
    folder.mkdir(parents=True, exist_ok=True)
    results = [results_of(animal, budget, command, progress) for animal in animals]
    written = [keep_results(folder / "kept", one) for one in results]
    # poses are kept with the rows; their drawings contain depth images
    numbers = {
        one["animal"]: {k: v for k, v in one.items() if k not in ("examples", "failures")}
        for one in results
    }
    path = folder / "results.json"
    path.write_text(json.dumps(plain(numbers), indent=1, allow_nan=False) + "\n", encoding="utf-8")
    further = measure_further(folder, without, nyu, quick, progress)
    progress(0, None, "drawing")
    return [*written, path, *write_paper(folder, results, further, quick)]


def _command(
    animals: Sequence[str],
    n_frames: int | None,
    quick: bool,
    fresh: bool,
    rows: Sequence[str] = (),
    sealed: bool = False,
) -> str:
    """The command line that reproduces the numbers."""
    flags = {f"--frames={n_frames}": n_frames, "--quick": quick, "--fresh": fresh}
    return shlex.join(
        [
            *("liex", "evaluate", "tables", *(f"--animal={animal}" for animal in animals)),
            *(name for name, given in {**flags, "--sealed": sealed}.items() if given),
            *(f"--row={row}" for row in rows),
        ]
    )


def kept_results(animal: str, folder: Path | None = None) -> dict[str, Any]:
    """Kept results of an animal: `rows` and `sensitivity` by variant, empty if there are none.

    Args:
        animal: name of the skeleton.
        folder: folder of kept results; None means datasets/kept_results.

    Raises:
        LiexError: the file is damaged, or of another schema.
    """
    path = (folder or kept_results_folder()) / f"{animal}.json"
    if not path.is_file():
        return {"rows": {}, "sensitivity": {}}
    with expecting(
        LiexError,
        f"{path} should contain kept results of schema {SCHEMA} as JSON",
        ValueError,
        TypeError,
        KeyError,
        advice="restore it from the repository, or measure every row with --fresh",
    ):
        content = json.loads(path.read_text(encoding="utf-8"))
        if content["schema"] != SCHEMA:
            raise ValueError(f"its schema is {content['schema']}")
        return {part: dict(content[part]) for part in ("rows", "sensitivity")}


def keep_results(folder: Path, results: Mapping[str, Any]) -> Path:
    """Write an animal's results as a file for datasets/kept_results.

    Numbers have six digits, and a list or a pose takes one line. `default` is measured in every run
    and is not written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{results['animal']}.json"
    kept, curves = (  # without the entries that hold for a single run
        {
            name: {k: v for k, v in entry.items() if k not in ("origin", "other_processor")}
            for name, entry in results[part].items()
        }
        for part in ("rows", "sensitivity")
    )
    content = {
        "schema": SCHEMA,
        "animal": results["animal"],
        "rows": {name: _rounded(row) for name, row in kept.items() if name != "default"},
        "sensitivity": curves,
    }
    # line breaks within a list or the numbers of a split
    path.write_text(
        re.sub(
            r"\n {5,}|\n {4}(?=[]}])",
            "",
            json.dumps(content, indent=1, sort_keys=True, allow_nan=False),
        )
        + "\n",
        encoding="utf-8",
    )
    return path


def _rounded(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _rounded(one) for key, one in value.items()}
    if isinstance(value, list):
        return [_rounded(one) for one in value]
    # significant digits of a kept number
    return float(f"{value:.6g}") if isinstance(value, float) else value


def processor() -> str:
    """LLVM's name of the processor that numba compiles for, such as `znver4`."""
    import llvmlite.binding as llvm

    return str(numba.config.CPU_NAME or llvm.get_host_cpu_name())


def _made_by(command: str) -> dict[str, Any]:
    """Provenance of a row or a curve of this run: command, version, day and machine."""
    machine = platform.processor() or platform.machine()
    return {
        "command": command,
        "version": package_version("liex_lab"),
        "date": date.today().isoformat(),
        "machine": f"{machine}, Python {platform.python_version()}",
        "processor": processor(),
    }


def results_of(
    animal: str, budget: Budget, command: str, progress: Progress = silent
) -> dict[str, Any]:
    """Every row, curve and illustration of one animal.

    Returns:
        `animal`, `joints`, `splits`; `rows` by variant, see `rows.measured_rows`, each with `made`,
        `origin` and `other_processor` (the row's, if it differs from this run's); `missing`, by
        variant or by figure and variant, why there is no row or curve; `sealed`; `test_postures`,
        source of the test splits' postures, '' if drawn from seeds; `sensitivity`, the curves by
        variant; `illustration` of the default; `examples` and `failures`, poses by variant, see
        `rows.shown_poses`.
    """
    skeleton = Skeleton.load(animal)
    kept = kept_results(skeleton.name) if budget.kept else {"rows": {}, "sensitivity": {}}
    tests = _tests(skeleton, budget)
    postures = world_of(skeleton).test_postures
    runs: dict[str, list[Subject]] = {}
    missing: dict[str, str] = {}
    with shared_images():
        for name in budget.fresh:
            try:
                runs[name] = (quick_runs if budget.quick else rows.runs_of)(animal, name, progress)
            except MissingPackageError as error:
                missing[name] = str(error)
    chooser = cast("PoseEstimator", runs["default"][0])
    measured = rows.measured_rows(animal, runs, chooser, tests, progress)
    found: dict[str, dict[str, Any]] = {}
    for name in ROWS:
        if name in measured:
            made = _made_by(command) | _training(name, skeleton, budget.quick)
            made["test_postures"] = postures
            found[name] = {"origin": "measured", "made": made, **measured[name]}
        elif name in kept["rows"]:
            found[name] = {**kept["rows"][name], "origin": "kept"}
        elif name not in missing:
            again = f"no row is kept; {_command_for(skeleton.name, name)} measures it"
            missing[name] = again if budget.kept else "it was not asked for"
    for row in found.values():
        made_on = row["made"].get("processor")
        row["other_processor"] = None if made_on == processor() else made_on
    curves = _sensitivities(skeleton, kept["sensitivity"], budget, command, missing, progress)
    progress(0, None, f"{skeleton.name}: candidates and convergence")
    # images behind the figures of candidates and convergence
    n_images = _QUICK_ILLUSTRATED if budget.quick else 128
    examples = {name: row["examples"] for name, row in found.items()}
    failures = {name: found[name].get("failures") for name in SWEPT[::-1] if name in found}
    return {
        "animal": skeleton.name,
        "joints": list(skeleton.names),
        "splits": list(tests),
        "rows": found,
        "missing": missing,
        "sealed": budget.sealed,
        "test_postures": postures,
        "sensitivity": curves,
        "illustration": rows.illustrate(chooser.model, n_images),
        "examples": rows.shown_poses(examples["default"], examples, tests),
        "failures": {
            name: rows.shown_poses(some, {name: some}, tests)[name]
            for name, some in failures.items()
            if some
        },
    }


def _tests(skeleton: Skeleton, budget: Budget) -> Tests:
    """The test recordings by split."""
    world, n = world_of(skeleton), _N_SESSIONS
    if budget.n_frames is not None:
        n = -(-budget.n_frames // len(world.test_split(next(iter(world.splits)), n_sessions=1)[0]))
    splits = (SEALED,) if budget.sealed else world.splits
    return {split: world.test_split(split, n_sessions=n) for split in splits}


def _command_for(animal: str, row: str) -> str:
    """The command that measures one row again."""
    return f"`{_command([animal], None, False, True, [row])} --out DIR`"


def _training(variant: str, skeleton: Skeleton, quick: bool) -> dict[str, Any]:
    """Seeds and amount of training of a row."""
    if variant in BASELINES:
        recipe = training_of(variant, skeleton).recipe
    else:
        recipe = recipe_of("default" if variant == "default" else "paper", skeleton)
    return {
        "seed": recipe.seed,
        "seeds": list(range(1 if quick else TRAINING_DRAWS.get(variant, 1))),
        "training_images": None if quick else recipe.n_images,
    }


def _sensitivities(
    skeleton: Skeleton,
    kept: Mapping[str, Any],
    budget: Budget,
    command: str,
    missing: dict[str, str],
    progress: Progress,
) -> dict[str, Any]:
    """Fig. 7 of the paper's variant and of ours, measured now if the budget states so, or kept."""
    curves = {}
    for variant in SWEPT[: 1 if budget.quick else None]:
        if budget.curves:
            curve = rows.sensitivity(
                skeleton, variant, QUICK_SWEEP if budget.quick else Sweep(), progress
            )
            curves[variant] = {**curve, "made": _made_by(command), "origin": "measured"}
        elif variant in kept:
            curves[variant] = {**kept[variant], "origin": "kept"}
        else:
            missing[f"Fig. 7, {variant}"] = (
                f"no curve is kept; {_command_for(skeleton.name, CURVES)} measures it"
            )
    return curves


def quick_runs(animal: str, variant: str, progress: Progress = silent) -> list[Subject]:
    """As `rows.runs_of`, trained within seconds to check that every row runs.

    Raises:
        MissingPackageError: the row is the CNN and torch is not installed.
    """
    if variant == "default":
        return [estimator_of(animal, "default")]
    if variant not in BASELINES:
        return rows.runs_of_models(variant, [_quick_paper(animal)])
    skeleton = Skeleton.load(animal)
    training = training_of(variant, skeleton)
    if isinstance(training.plan, CnnPlan):
        require_torch()
        training = replace(
            training, plan=replace(training.plan, width=0.25, connected=128, epochs=1)
        )
    data = rendered_set(
        skeleton,
        replace(method_of("paper", skeleton), session_size=False),
        training.recipe,
        0,
        _QUICK_IMAGES[variant],
        silent,
    )
    return [fit(training, data, skeleton, lambda share, what: None)]


@cache
def _quick_paper(animal: str) -> PoseEstimator:

    skeleton = Skeleton.load(animal)
    recipe = recipe_of("paper", skeleton)
    recipe = replace(recipe, n_images=_QUICK_IMAGES["paper"], n_calibration=0)
    return PoseEstimator(make_model(skeleton, method_of("paper", skeleton), recipe, silent))


def measure_further(
    folder: Path,
    without: Sequence[str] = (),
    nyu: Path | None = None,
    quick: bool = False,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Results of other verbs, as small fixed measurements for the same page.

    Returns:
        `tracking`: the first frames of the easy mouse sequence; `actions` (Figs. 19 and 20): the
        cut-out sequences of fish, with `key_frames`; `nyu` (Table 2); empty if left out; `missing`:
        by part, why it was left out and which command makes it; `figures`: Figs. 12 and 18 in the
        folder.
    """
    further: dict[str, Any] = {"tracking": {}, "actions": {}, "nyu": {}, "figures": []}
    further["missing"] = {name: f"it was left out; `{_VERBS[name]}` makes it" for name in without}
    if "tracking" not in without:
        further["tracking"] = evaluate_tracking(
            "mouse",
            "easy",
            n_frames=40 if quick else 160,
            figure=folder / "fig18_tracking.png",
            progress=progress,
        )
        further["figures"].append(folder / "fig18_tracking.png")
    if "actions" not in without:
        # a quick run uses every twelfth cut-out sequence
        further["actions"] = _actions("fish", 12 if quick else 1, progress)
        further["key_frames"] = rows.acted_key_frames("fish")
    if nyu is None:
        further["missing"]["nyu"] = (
            f"no folder was named with --nyu; with the data `{_VERBS['nyu']}` makes it"
        )
    else:
        further["figures"].append(folder / "fig12_nyu_hands.png")
        further["nyu"] = evaluate_nyu(nyu, figure=further["figures"][-1], progress=progress)
    return further


def _actions(animal: str, stride: int, progress: Progress) -> dict[str, Any]:

    estimator = estimator_of(animal, "default", progress)
    train, test = (
        acted_tracks(cut_sequences(animal, side)[::stride], estimator, progress)
        for side in (False, True)
    )
    progress(0, None, "naming actions")
    return {
        **sequence_scores(train, test, load_action_model(animal)),
        "n_train": len(train),
        "n_test": len(test),
    }
