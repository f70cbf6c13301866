"""Tables 1 to 3 of Lie-X (section 5.2) and the numbers behind its figures, on rendered data.

`liex evaluate tables` measures six rows on an animal's test splits (40 recordings each): our
default, the paper's variant of Lie-X, its ablations without multiple initial poses and without the
learned metric, and the baselines RF and CNN. All see the same frames and, in each, the same object
with the same size (`common_view`). Numbers: those of `rows`, 101 quantiles of the error (Fig 8),
frames/s on at most two cores, sensitivity to five parameters (Fig 7), candidates and convergence of
one image (Fig 13 to 16). Rows and curves whose models take long to train come from kept results
(`kept`) unless they are asked for.
"""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from liex_lab.errors import MissingPackageError, PlanError
from liex_lab.runtime.progress import Progress, silent

from .results import Results
from .rows import ROWS, SWEPT, TRAINING_DRAWS

if TYPE_CHECKING:
    from liex_lab.body.skeleton import Skeleton
    from liex_lab.estimation.estimator import PoseEstimator
    from liex_lab.simulation.recording import TrueRecording

    from .drawers import Drawers
    from .further import Further
    from .rows import Subject

CURVES = "fig7"  # stands for the curves among the names of rows
_N_SESSIONS = 40
_QUICK_FRAMES = 100
_ILLUSTRATED = 128  # images behind the figures of candidates and convergence
_QUICK_ILLUSTRATED = 16


@dataclass(frozen=True)
class Budget:
    """How much is measured, and of what.

    Attributes:
        n_frames: frames of each split, rounded up to whole recordings; None takes all.
        fresh: rows that are trained and measured now.
        curves: those of Fig. 7 are, too.
        kept: the others come from datasets/kept_results; else they are missing.
        quick: every row is trained on next to nothing, to see that everything runs.
        sealed: the sealed split is measured instead of the others.
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
    ) -> Budget:
        """What the options of the command line ask for.

        Args:
            n_frames: frames of each split; with any, nothing kept is used.
            quick: every row is trained on next to nothing.
            fresh: all rows and curves are trained and measured now.
            rows: names of rows that are, and `CURVES`; () names none.
            sealed: the sealed split; with it, nothing kept is used.

        Raises:
            PlanError: there is no such row.
        """
        known = (*ROWS, CURVES)
        if unknown := [row for row in rows if row not in known]:
            raise PlanError(f"there is no row '{unknown[0]}'; known are {', '.join(known)}")
        wanted = tuple(row for row in ROWS if not rows or row in rows or row == "default")
        if quick:
            return Budget(n_frames or _QUICK_FRAMES, wanted, True, False, True, sealed)
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


def make_tables(
    out: str | Path,
    animals: Sequence[str],
    *,
    n_frames: int | None = None,
    quick: bool = False,
    fresh: bool = False,
    rows: Sequence[str] = (),
    sealed: bool = False,
    without: Sequence[str] = (),
    nyu: Path | None = None,
    drawers: Drawers | None = None,
    progress: Progress = silent,
) -> list[Path]:
    """Write tables, figures, their page, and the form in which results are kept into a folder.

    Args:
        out: the folder; it is made where it is missing.
        animals: names of bundled animals.
        n_frames: frames of each split, of which every row is then measured; None takes all.
        quick: few frames, every row trained on next to nothing; its numbers say only that
            everything runs.
        fresh: rows are trained and measured now, not taken from kept results.
        rows: only these rows are, beside the default, or `fig7` for its curves; the others come
            from kept results. () names none.
        sealed: measure the sealed split instead of the others, as is done once when an issue ends.
        without: parts that belong to other verbs and are left out, `tracking` or `actions`.
        nyu: folder of the NYU hand data, for Table 2; None leaves it out.
        drawers: make the figures and the page, of which `tracking`, `actions` and `nyu` are parts;
            None makes neither.
        progress: told how far the job is.

    Returns:
        The paths of all files that were written.

    Raises:
        PlanError: there is no such row, or part.
        LiexError: kept results are damaged.
    """
    from .further import check_parts, measure_further
    from .kept import keep_results
    from .table_text import write_tables

    check_parts(without)
    budget = Budget.of(n_frames, quick, fresh, rows, sealed)
    command = _command(animals, n_frames, quick, fresh, rows, sealed)
    folder = Path(out)
    folder.mkdir(parents=True, exist_ok=True)
    all_results = [results_of(animal, budget, command, progress) for animal in animals]
    written = write_tables(folder, all_results, quick)
    for results in all_results:
        parts = [_without_origin(part) for part in (results.rows, results.sensitivity)]
        written.append(keep_results(folder / "kept", results.animal, *parts))
    if drawers is None:
        return written
    further = measure_further(
        folder, without=without, nyu=nyu, quick=quick, drawers=drawers, progress=progress
    )
    progress(0, None, "drawing")
    return written + _drawn(folder, all_results, further, quick, drawers)


def _drawn(
    folder: Path, results: Sequence[Results], further: Further, quick: bool, drawers: Drawers
) -> list[Path]:
    """All figures, and the page that holds them."""
    from .deviations import DEVIATIONS
    from .exhibits import exhibits
    from .table_text import HOW, QUICK, SEALED

    figures = drawers.figures({r.animal: vars(r) for r in results}, folder)
    figures += [folder / name for name in further.figures]
    about = {
        "title": "Tables and figures of Lie-X, on rendered test frames",
        "about": [HOW.replace("*", "")],
        "warnings": [
            *([QUICK.strip("*")] if quick else []),
            *([SEALED.replace("*", "")] if any(r.sealed for r in results) else []),
        ],
        "differences": DEVIATIONS,
    }
    shown = exhibits(results, further, figures, quick)
    return [*figures, drawers.page(about, shown, folder / "index.html")]


def _command(
    animals: Sequence[str],
    n_frames: int | None,
    quick: bool,
    fresh: bool,
    rows: Sequence[str] = (),
    sealed: bool = False,
) -> str:
    """The command line that makes the same numbers."""
    words = ["liex", "evaluate", "tables", *(f"--animal={animal}" for animal in animals)]
    words += [f"--frames={n_frames}"] if n_frames else []
    words += [
        name
        for name, given in (("--quick", quick), ("--fresh", fresh), ("--sealed", sealed))
        if given
    ]
    return shlex.join([*words, *(f"--row={row}" for row in rows)])


def _without_origin(entries: Mapping[str, dict[str, Any]]) -> dict[str, dict[str, Any]]:
    """Rows or curves without what is true of this run alone."""
    return {
        name: {key: value for key, value in entry.items() if key != "origin"}
        for name, entry in entries.items()
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

    from ...training.pose_model import shared_pictures
    from .illustrations import illustrate
    from .kept import kept_results
    from .rows import measured_rows

    skeleton = Skeleton.load(animal)
    kept = kept_results(skeleton.name) if budget.kept else {"rows": {}, "sensitivity": {}}
    tests = _tests(skeleton, budget)
    results = Results(skeleton.name, list(skeleton.names), list(tests), sealed=budget.sealed)
    results.test_postures = world_of(skeleton).test_postures
    with shared_pictures():
        runs = _runs(animal, budget, results, progress)
    chooser = cast("PoseEstimator", runs["default"][0])
    measured = measured_rows(animal, runs, chooser, tests, progress)
    for name in ROWS:
        if name in measured:
            made = _made(name, skeleton, budget, command, results.test_postures)
            results.rows[name] = {"origin": "measured", "made": made, **measured[name]}
        elif name in kept["rows"]:
            results.rows[name] = {**kept["rows"][name], "origin": "kept"}
        elif name not in results.missing:
            results.missing[name] = (
                f"no row is kept; {_anew(skeleton.name, name)} measures it"
                if budget.kept
                else "it was not asked for"
            )
    results.sensitivity = _sensitivities(
        skeleton, kept["sensitivity"], budget, command, results, progress
    )
    progress(0, None, f"{skeleton.name}: candidates and convergence")
    n_images = _QUICK_ILLUSTRATED if budget.quick else _ILLUSTRATED
    results.illustration = illustrate(chooser.model, n_images)
    results.examples, results.failures = _poses(results, tests)
    return results


def _poses(
    results: Results, tests: Mapping[str, Sequence[TrueRecording]]
) -> tuple[list[dict[str, Any]], dict[str, list[dict[str, Any]]]]:
    """The poses that are drawn: of all rows in the examples, and where two rows err most."""
    from .examples import shown_poses

    examples = {name: row["examples"] for name, row in results.rows.items()}
    failures = {
        name: shown_poses(some, {name: some}, tests)
        for name in SWEPT[::-1]
        if (some := results.rows.get(name, {}).get("failures"))
    }
    return shown_poses(examples["default"], examples, tests), failures


def _tests(skeleton: Skeleton, budget: Budget) -> dict[str, Sequence[TrueRecording]]:
    """The recordings by split."""
    from liex_lab.simulation.recording import SEALED
    from liex_lab.simulation.simulator import world_of

    world = world_of(skeleton)
    n_sessions = _N_SESSIONS
    if budget.n_frames is not None:
        n_sessions = -(-budget.n_frames // len(world.test_split(world.splits[0], n_sessions=1)[0]))
    splits = (SEALED,) if budget.sealed else world.splits
    return {split: world.test_split(split, n_sessions=n_sessions) for split in splits}


def _anew(animal: str, row: str) -> str:
    """The command that measures one row anew."""
    return f"`{_command([animal], None, False, True, [row])} --out DIR`"


def _runs(
    animal: str, budget: Budget, results: Results, progress: Progress
) -> dict[str, list[Subject]]:
    """What has to be measured; why a row cannot be goes into `results.missing`."""
    from .quick import quick_runs
    from .rows import runs_of

    runs = {}
    for name in budget.fresh:
        try:
            runs[name] = (quick_runs if budget.quick else runs_of)(animal, name, progress)
        except MissingPackageError as error:
            results.missing[name] = str(error)
    return runs


def _made(
    variant: str, skeleton: Skeleton, budget: Budget, command: str, test_postures: str
) -> dict[str, Any]:
    """How a row is made now."""
    from ...training.baselines import BASELINES, training_of
    from ...training.pose_model import recipe_of
    from .kept import made_by

    if variant in BASELINES:
        recipe = training_of(variant, skeleton).recipe
    else:
        recipe = recipe_of("default" if variant == "default" else "paper", skeleton)
    return {
        **made_by(command),
        "seed": recipe.seed,
        "seeds": list(range(1 if budget.quick else TRAINING_DRAWS.get(variant, 1))),
        "training_images": None if budget.quick else recipe.n_images,
        "test_postures": test_postures,
    }


def _sensitivities(
    skeleton: Skeleton,
    kept: Mapping[str, Any],
    budget: Budget,
    command: str,
    results: Results,
    progress: Progress,
) -> dict[str, Any]:
    """Fig. 7 of the paper's variant and of ours, measured now where it is asked for, or kept."""
    from .kept import made_by
    from .quick import QUICK_SWEEP
    from .sensitivity import Sweep, sensitivity

    curves = {}
    for variant in SWEPT[: 1 if budget.quick else None]:
        if budget.curves:
            sweep = QUICK_SWEEP if budget.quick else Sweep()
            curve = sensitivity(skeleton, variant, sweep, progress)
            curves[variant] = {**curve, "made": made_by(command), "origin": "measured"}
        elif variant in kept:
            curves[variant] = {**kept[variant], "origin": "kept"}
        else:
            results.missing[f"Fig. 7, {variant}"] = (
                f"no curve is kept; {_anew(skeleton.name, CURVES)} measures it"
            )
    return curves
