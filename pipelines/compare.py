"""Group comparison of a cohort, `liex compare`: tests between groups of sessions, as tables.

A permutation test or a mixed model tests each measure and pair of groups over the units that were
assigned to a group, with false discovery rates over the whole table (see `behaviour.cohort`). Every
session of a study is accounted for: it is compared, or the reason why not is given.
"""

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import pandas as pd
from liex_lab.dashboards.figures import sets

from liex_lab.behaviour.cohort import (
    ENGINES,
    STATS,
    SUBJECT,
    collect,
    compare,
    methods,
    result,
    unified,
    unit_of,
    usual_measures,
)
from liex_lab.errors import LiexError, SessionError, expecting
from liex_lab.plan.study import Study, same
from liex_lab.runtime import durable, text_files
from liex_lab.runtime.progress import Progress, silent
from liex_lab.sessions import Session, evidence
from liex_lab.sessions.corrections import read_verdict
from liex_lab.sessions.folder import FAILED_FILE, read_failure
from liex_lab.sessions.individuals import individuals_of
from liex_lab.sessions.verdict import NEEDS_REVIEW, OTHER_ANIMAL, Entry
from liex_lab.tables.schema import dictionary, from_pandas, write_table

from .study.status import misnamed

# copies of a session that were, or are about to be, replaced
_SET_ASIDE = re.compile(r"\.(?:outdated(?:-\d+)?|old|part)[/\\]")


def compare_groups(
    places: Sequence[str | Path],
    out: str | Path,
    measures: Sequence[str] = (),
    *,
    reference: str | None = None,
    animals: str | Path | None = None,
    engine: str = "auto",
    only_trusted: bool = False,
    figures: bool = True,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Compare groups of sessions; writes tables, a methods text, and figures.

    Args:
        places: study files, session folders, or folders that contain sessions at any depth.
        out: output folder; created if needed.
        measures: columns of the summary or of the rhythm; () uses the default ones, and the shares
            of every action and zone.
        reference: compare with this group only; None compares all pairs.
        animals: a CSV with `subject_id` and any of group, cage, sex, batch; it overrides the
            sessions' own facts.
        engine: `auto`, `permutation` or `mixed`.
        only_trusted: exclude sessions that need review.
        figures: whether to draw the figures, too.
        progress: receives progress by session and figure.

    Returns:
        `stats`: the table's rows; `folder`: the output folder; `figures`: their paths; `sessions`:
            a sentence that accounts for every session; `check`: warnings.

    Raises:
        SessionError: there are no two groups, or a folder, column, engine or CSV cannot be used.
    """
    if engine not in ENGINES:
        raise SessionError(f"the engine is one of {', '.join(ENGINES)}, got '{engine}'")
    entries, check = account(places)
    left = {one.key: one.state for one in entries if one.folder is None}  # and the reason
    if only_trusted:
        left |= {one.key: "left out, needs review" for one in entries if one.state == NEEDS_REVIEW}
    sessions: dict[str, Session] = {}
    kept = sorted((one.folder, one.key) for one in entries if one.folder and one.key not in left)
    for folder, key in kept:
        progress(len(sessions), len(kept), "reading sessions")
        sessions[key] = Session.open(folder)
    for key, other in find_copies(sessions).items():
        left[key] = f"same recording as {other}"
        check.append(f"{key} is the {left[key]}, and is not counted")
        del sessions[key]
    table = collect(sessions.values())
    table, notes = unified(table if animals is None else _overruled(table, Path(animals)))
    check += [*notes, *_counted_otherwise(sessions)]
    check += [f"{one.key}: {one.reason}" for one in entries if one.key in sessions and one.reason]
    grouped = set(table.loc[table["group"].fillna("") != "", "session_id"])
    left |= {key: "has no group" for key, one in sessions.items() if one.name not in grouped}
    accounted = _in_words(entries, left)
    wanted = list(measures) or usual_measures(table)
    if absent := [name for name in wanted if name not in table]:
        raise SessionError(
            f"no session's summary has the column '{absent[0]}'; see columns.json in a session's "
            "folder"
        )
    groups = sorted({str(group) for group in table["group"].fillna("")} - {""})
    spelled = {same(group): group for group in groups}
    reference = None if reference is None else spelled.get(same(reference), reference)
    if len(groups) < 2 or reference not in (None, *groups):
        raise SessionError(
            f"a comparison needs two groups{f', one of them {reference!r}' if reference else ''}, "
            f"and these {len(table)} sessions have {', '.join(groups) or 'none'}; state "
            "session.group, or name a CSV with --animals"
        )
    stats = compare(table, wanted, reference, engine=engine)
    target = Path(out)
    _write_tables(target, stats, table, sessions, reference, accounted, check)
    found = {"stats": stats, "folder": target, "sessions": accounted, "check": check}
    files: list[Path] = []
    if figures:
        drawn = comparison_figures(target)
        files, _ = sets.write_figures(drawn, target / sets.FOLDER, ("svg", "pdf"), progress)
    return found | {"figures": files}


def comparison_figures(folder: Path, only: Sequence[str] = ()) -> Iterator[sets.Drawn]:
    """The figures of a comparison, from its tables; those of other measures are removed."""
    table, stats, sessions = sets.read_comparison(folder)
    measures = [str(name) for name in dict.fromkeys(stats["measure"])]
    sets.check_names(only, ["effects", *measures, *sets.OF_STUDY])
    sets.remove_others(folder / sets.FOLDER, measures)
    return sets.comparison_figures(table, stats, sessions, only)


def _write_tables(
    target: Path,
    stats: pd.DataFrame,
    table: pd.DataFrame,
    sessions: Mapping[str, Session],
    reference: str | None,
    accounted: str,
    check: Sequence[str],
) -> None:
    """Write the files of a comparison, each as a whole."""
    target.mkdir(parents=True, exist_ok=True)
    with durable.replacing(target / "stats.parquet") as part:
        write_table(part, STATS, from_pandas(stats), {"table": "stats"})
    for name, written in (("stats", stats), ("sessions", table)):
        with durable.replacing(target / f"{name}.csv") as part:
            text_files.write_csv(written, part)
    columns = [entry for entry in dictionary(STATS) if entry["table"] == "stats"]
    places_of = [evidence.link_to(session.path, target)["path"] for session in sessions.values()]
    document = {
        "sessions": places_of,
        "reference": reference,
        "accounted": accounted,
        "check": check,
    }
    first = next(iter(sessions.values())).columns
    units = dict(zip(first["name"], first["unit"].fillna(""), strict=True))
    results = [result(row, unit_of(row["measure"], units)) for row in stats.to_dict("records")]
    warned = [f"Check this result: {one}." for one in check]
    texts = {
        "columns.json": json.dumps(columns, indent=1, ensure_ascii=False),
        "comparison.json": json.dumps(document, indent=1),
        "results.txt": "\n".join([*results, "", accounted, *warned]),
        "methods.txt": methods(stats, table, [accounted, *warned]),
    }
    for name, text in texts.items():
        durable.write_whole(target / name, f"{text}\n")


def _counted_otherwise(sessions: Mapping[str, Session]) -> list[str]:
    """A sentence on sessions of an earlier schema, with other shares; [] if none or all are."""
    # since this schema version shares are of the observed frames
    old = [k for k, one in sessions.items() if one.metadata["schema_version"] < 8]
    if len(old) in (0, len(sessions)):
        return []
    return [
        f"{', '.join(old)} are of an earlier version of liex_lab, which counted lost frames in the "
        "time of bouts: their shares of actions can be too high beside those of the others, so "
        "run `liex run` on their recordings again"
    ]


def _in_words(entries: Sequence[Entry], left: Mapping[str, str]) -> str:
    """How many sessions there are, how many are compared, and the state of each remaining one."""
    n = len(entries)
    states = (f"{one.key} {left.get(one.key, one.state)}" for one in entries)
    others = "; ".join(state for state in states if not state.endswith(" done"))
    counts = f"{n} session{'s' * (n != 1)} in the study, {n - len(left)} compared"
    return f"{counts}: {others}" if others else counts


def account(places: Sequence[str | Path]) -> tuple[list[Entry], list[str]]:
    """List every session in the folders with its state, including unmeasured sessions of a study.

    Args:
        places: study files, session folders, or folders with sessions at any depth.

    Returns:
        The sessions, with a folder if they can be compared; and possible errors in the study's
        animals.

    Raises:
        SessionError: a path is not a folder, or contains no session.
    """
    found: dict[Path, Entry] = {}
    check: list[str] = []
    for place in map(Path, places):
        study = _study_of(place)
        planned = study.sessions if study else ()
        check += misnamed(planned)
        place = study.results if study and place.is_file() else place
        here = place.resolve()
        for one in planned:
            folder = one.folder.resolve()
            if here in (folder, *folder.parents):
                several = sum(other.animal.id == one.animal.id for other in planned) > 1
                found[folder] = _state_of(folder, one.id if several else one.animal.id, one.exclude)
        failed = [file for file in place.rglob(FAILED_FILE) if not _SET_ASIDE.search(str(file))]
        for folder in [*find_sessions([place]), *(file.parent.resolve() for file in failed)]:
            short = folder.stem if folder.suffix == ".liex" else "/".join(folder.parts[-3:])
            taken = short in (one.key for one in found.values())
            if folder not in found:
                found[folder] = _state_of(folder, str(folder) if taken else short)
    return list(found.values()), check


def _state_of(folder: Path, key: str, exclude: str = "") -> Entry:
    """A session's state from the files in its folder."""
    if exclude or not (folder / "session.json").is_file():
        failed = "failed" if read_failure(folder) else "not measured"
        return Entry(key, "excluded" if exclude else failed)
    verdict = read_verdict(folder)
    doubts = [one for one in verdict["cautions"] if str(one).startswith(OTHER_ANIMAL)]
    doubts += [] if verdict["accepted"] else verdict["reasons"]
    state = "has cautions" if verdict["cautions"] else "done"
    state = NEEDS_REVIEW if verdict["look_at_it"] else state
    return Entry(key, state, "; ".join(map(str, doubts)), folder=folder)


def _study_of(place: Path) -> Study | None:
    """The study of a file, or of results in or around a folder; None if absent."""
    if place.is_file():
        return Study.load(place)
    here = place.resolve()
    for file in (file for one in (here, *here.parents) for file in sorted(one.glob("*.toml"))):
        with suppress(LiexError, OSError):
            study = Study.load(file)
            results = study.results.resolve()
            if study.sessions and (here in (results, *results.parents) or results in here.parents):
                return study
    return None


def find_copies(sessions: Mapping[str, Session]) -> dict[str, str]:
    """Sessions that duplicate another one, by input or by all measures, with the name of the other.

    Raises:
        SessionError: two sessions of one recording are of two animals.
    """
    known: dict[str, str] = {}
    animals: dict[str, str] = {}
    copies: dict[str, str] = {}
    for key, session in sessions.items():
        animals[key] = ", ".join(session.table("sessions")["subject_id"].astype(str))
        region = session.metadata.get("plan", {}).get("arena", {}).get("region")
        own = session.metadata["individual"] if len(individuals_of(session)) > 1 else ""
        numbers = session.summary.select_dtypes("number").to_numpy().tolist()
        marks = (f"{session.metadata['input']['sha256']} {region} {own}", str(numbers))
        twin = next((known[mark] for mark in marks if mark in known), key)
        if same(animals[twin]) != same(animals[key]):
            raise SessionError(
                f"{key} and {twin} are of the same recording, but of the animals {animals[key]} "
                f"and {animals[twin]}; remove one of them, or correct the animal of one with `liex "
                "describe SESSION subject_id=NAME`"
            )
        if twin != key:
            copies[key] = twin
        known |= dict.fromkeys(marks, twin)
    return copies


def find_sessions(places: Sequence[str | Path]) -> list[Path]:
    """Every session in session folders, or in folders at any depth, once and in order of path.

    Folders inside a session, such as its backups, are not sessions.

    Raises:
        SessionError: a path is not a folder, or contains no session.
    """
    found: set[Path] = set()
    for place in map(Path, places):
        if not place.is_dir():
            raise SessionError(
                f"{place} is not a folder; name session folders, or folders with sessions in them"
            )
        files = (p for p in place.rglob("session.json") if not _SET_ASIDE.search(str(p)))
        inside = {place} if (place / "session.json").is_file() else {p.parent for p in files}
        if not inside:
            raise SessionError(f"there is no session in {place}; `liex run` makes them")
        found |= {one.resolve() for one in inside if not inside & set(one.parents)}
    return sorted(found)


def _overruled(table: pd.DataFrame, path: Path) -> pd.DataFrame:
    """The table with group, cage, sex and batch overridden by a CSV of the animals."""
    with expecting(
        SessionError,
        f"{path} should be a CSV with the column subject_id",
        OSError,
        ValueError,
        advice="correct it",
    ):
        stated = text_files.read_texts(path)
    if (
        "subject_id" not in stated
        or not set(stated.columns) & set(SUBJECT[1:])
        or stated["subject_id"].duplicated().any()
    ):
        raise SessionError(
            f"{path} should have a column subject_id, each animal once, and any of "
            f"{', '.join(SUBJECT[1:])}; it has {', '.join(map(str, stated.columns))}"
        )
    known = stated.set_index("subject_id")
    if unknown := sorted(set(table["subject_id"].astype(str)) - set(known.index)):
        raise SessionError(
            f"{path} does not list the animal '{unknown[0]}' of the sessions; add a row for it"
        )
    return table.assign(
        **{name: table["subject_id"].map(known[name]) for name in SUBJECT[1:] if name in known}
    )
