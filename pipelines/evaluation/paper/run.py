"""Tables 1 to 3 of Lie-X (section 5.2) and the numbers behind its figures, on rendered data.

`liex evaluate tables` measures six rows on an animal's test splits (40 recordings each): our
default, the paper's variant of Lie-X, its ablations without multiple initial poses and without the
learned metric, and the baselines RF and CNN. All see the same frames and, in each, the same object
with the same size (`common_view`). Numbers: those of `rows`, 101 quantiles of the error (Fig 8),
frames/s on at most two cores, sensitivity to five parameters (Fig 7), candidates and convergence of
one image (Fig 13 to 16). Rows whose models take long to train come from kept results where these
are of today's code, training and test pictures, to the last digit or, of another processor's, in
numbers (`given`); a row of which they are not is left out, and the command that measures it anew
stands in its place.
"""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from liex_lab.errors import MissingPackageError
from liex_lab.evaluation.pose import plain
from liex_lab.runtime.progress import Progress, silent

from .budget import CURVES, Budget
from .results import ELSEWHERE, OTHER_MODEL, Results
from .rows import ROWS, SWEPT, TRAINING_DRAWS

if TYPE_CHECKING:
    from liex_lab.body.skeleton import Skeleton
    from liex_lab.estimation.estimator import PoseEstimator
    from liex_lab.simulation.recording import TrueRecording

    from .common_view import CommonView
    from .drawers import Drawers
    from .further import Further
    from .given import Given
    from .rows import Subject

_N_SESSIONS = 40


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
    """
    from .cached_results import keep_results
    from .further import check_parts, measure_further
    from .table_text import write_tables

    check_parts(without)
    budget = Budget.of(n_frames, quick, fresh, rows, sealed)
    command = _command(animals, n_frames, quick, fresh, rows, sealed)
    folder = Path(out)
    folder.mkdir(parents=True, exist_ok=True)
    all_results = [results_of(animal, budget, command, progress) for animal in animals]
    written = write_tables(folder, all_results, quick)
    for results in all_results:
        kept = _unmarked(results.rows), _unmarked(results.sensitivity)
        written.append(keep_results(folder / "kept", results.animal, *kept))
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


def _unmarked(rows: Mapping[str, dict[str, Any]]) -> dict[str, dict[str, Any]]:
    return {
        name: {
            key: value
            for key, value in row.items()
            if key not in ("origin", ELSEWHERE, OTHER_MODEL)
        }
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

    from ...training.pose_model import shared_pictures
    from .fingerprints import made_by
    from .illustrations import illustrate
    from .rows import measured_rows

    skeleton = Skeleton.load(animal)
    tests = _tests(skeleton, budget)
    results = Results(skeleton.name, list(skeleton.names), list(tests), sealed=budget.sealed)
    results.test_postures = world_of(skeleton).test_postures
    default = _subjects(animal, ["default"], budget, results, progress)
    chooser = cast("PoseEstimator", default["default"][0])
    wanted = [name for name in budget.fresh if name != "default"]
    with shared_pictures():
        runs = default | _subjects(animal, wanted, budget, results, progress)
    rows, views, given = measured_rows(animal, runs, chooser, tests, progress)
    kept = _kept(skeleton, budget, tests, views, given, results)
    for name, row in rows.items():
        made = {"quick": True} if budget.quick else made_from(name, skeleton)
        known = {} if budget.quick else hashes_of(animal, name)
        n_models = 1 if budget.quick else TRAINING_DRAWS.get(name, 1)
        results.rows[name] = {
            "origin": "measured",
            "made": {
                "from": made,
                "command": command,
                "seeds": list(range(n_models)),
                **known,
                **made_by(),
            },
            **row,
        }
    results.rows = {name: results.rows[name] for name in ROWS if name in results.rows}
    results.sensitivity = _sensitivities(skeleton, kept, budget, command, results, progress)
    progress(0, None, f"{skeleton.name}: candidates and convergence")
    results.illustration = illustrate(chooser.model, budget.n_illustrated)
    results.examples, results.failures = _poses(results, tests)
    return results


def _poses(
    results: Results, tests: Mapping[str, Sequence[TrueRecording]]
) -> tuple[list[dict[str, Any]], dict[str, list[dict[str, Any]]]]:
    """The poses that are drawn: of all rows in the examples, and where two rows err most."""
    from .examples import shown_poses

    examples = {name: row["examples"] for name, row in results.rows.items() if "examples" in row}
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


def _kept(
    skeleton: Skeleton,
    budget: Budget,
    tests: Mapping[str, Sequence[TrueRecording]],
    views: Mapping[str, Sequence[CommonView]],
    given: Mapping[str, Given],
    results: Results,
) -> Mapping[str, Any]:
    """Kept rows that fit go into the results, why another does not into `missing`; the curves."""
    from .cached_results import kept_results, taken, why_refused
    from .kept_examples import examples_of_kept, other_model

    if not budget.kept:
        for name in ROWS:
            if name not in budget.fresh:
                results.missing[name] = "it was not asked for"
        return {}
    kept = kept_results(skeleton.name)
    for name in ROWS:
        if name in budget.fresh:
            continue
        row = kept["rows"].get(name)
        why = "no row is kept"
        if row is not None:
            made, hashes = made_from(name, skeleton), hashes_of(skeleton.name, name)
            why = why_refused(row, made, hashes, views, given)
            if not why:
                other = other_model(skeleton.name, name, row, hashes["models"], tests, views)
                why = other.refused
        if row is None or why:
            results.missing[name] = f"{why}; {_anew(skeleton.name, name)} measures it"
        else:
            results.rows[name] = {**taken(row, hashes, views, given), "origin": "kept"}
            if other.told:
                results.rows[name][OTHER_MODEL] = other.told
            if found := examples_of_kept(skeleton.name, name, row, tests, views):
                results.rows[name]["examples"] = found
    return cast("Mapping[str, Any]", kept["sensitivity"])


def _anew(animal: str, row: str) -> str:
    """The command that measures one row anew."""
    return f"`{_command([animal], None, False, True, [row])} --out DIR`"


def _subjects(
    animal: str, names: Sequence[str], budget: Budget, results: Results, progress: Progress
) -> dict[str, list[Subject]]:
    """What has to be measured; why a row cannot be goes into `results.missing`."""
    from .quick import quick_runs
    from .rows import runs_of

    subjects = {}
    for name in names:
        try:
            subjects[name] = (quick_runs if budget.quick else runs_of)(animal, name, progress)
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


def hashes_of(animal: str, variant: str) -> dict[str, Any]:
    """What a row was made with today: hashes, see `fingerprints`, its pictures in numbers, and
    where test postures come from.

    Args:
        animal: the animal's name.
        variant: a name of `ROWS`.
    """
    from liex_lab.body.skeleton import Skeleton
    from liex_lab.simulation.simulator import world_of

    from .fingerprints import learning_code, training_given, training_pictures
    from .trained_by import model_digests

    postures = world_of(Skeleton.load(animal)).test_postures
    return {
        **({"test_postures": postures} if postures else {}),
        "learning_code": learning_code(variant),
        "training_pictures": training_pictures(variant, animal),
        "training_given": training_given(variant, animal),
        "models": model_digests(animal, variant, TRAINING_DRAWS.get(variant, 1), of_today=True),
    }


def _sensitivities(
    skeleton: Skeleton,
    kept: Mapping[str, Any],
    budget: Budget,
    command: str,
    results: Results,
    progress: Progress,
) -> dict[str, Any]:
    """Fig. 7 of the paper's variant and of ours, kept or measured now.

    A curve is measured where it is asked for and none is kept that fits; a kept one that is of
    another method, training or code is left out.
    """
    from liex_lab.estimation.method import method_of

    from .fingerprints import learning_code, made_by
    from .quick import QUICK_SWEEP
    from .sensitivity import Sweep, sensitivity, without_void

    curves = {}
    for variant in SWEPT[: 1 if budget.quick else None]:
        sweep = QUICK_SWEEP if budget.quick else Sweep()
        made = {**made_from(variant, skeleton), "sweep": plain(vars(sweep))}
        made["method"].pop("tells_facing", None)  # no model of a sweep does
        code = learning_code(variant)
        known = kept.get(variant)
        if known is not None and (
            known["made"]["from"] == made and known["made"].get("learning_code") == code
        ):
            kept_curve = without_void(known, method_of(variant, skeleton))
            curves[variant] = {**kept_curve, "origin": "kept"}
            continue
        if not budget.curves:
            results.missing[f"Fig. 7, {variant}"] = (
                f"no curve is kept of today's method and code; {_anew(skeleton.name, CURVES)} "
                "measures it"
            )
            continue
        curve = sensitivity(skeleton, variant, sweep, progress)
        curves[variant] = {
            **curve,
            "made": {"from": made, "command": command, "learning_code": code, **made_by()},
            "origin": "measured",
        }
    return curves
