"""Group comparison of a cohort, `liex compare`: tests between groups of sessions, as tables.

A permutation test or a mixed model tests each measure and pair of groups over the units that were
assigned to a group, with false discovery rates over the whole table (see `behaviour.cohort`). Every
session of a study is accounted for: it is compared, or the reason why not is given.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import pandas as pd

from liex_lab.behaviour.cohort import (
    ENGINES,
    STATS,
    WHO,
    collect,
    compare,
    methods,
    result,
    unified,
    usual_measures,
)
from liex_lab.errors import LiexError, SessionError
from liex_lab.plan.study import Study
from liex_lab.plan.subject import same
from liex_lab.runtime.durable import replacing, write_whole
from liex_lab.runtime.progress import Progress, silent
from liex_lab.runtime.text_files import read_texts, write_csv
from liex_lab.sessions import Session
from liex_lab.sessions.evidence import link_to
from liex_lab.sessions.folder import FAILED_FILE, read_failure
from liex_lab.sessions.verdict import LOOK_AT_IT, OTHER_ANIMAL, Entry, read_verdict
from liex_lab.tables.schema import dictionary, from_pandas, write_table

from .study.status import misnamed

# copies of a session that were, or are about to be, replaced
_SET_ASIDE = re.compile(r"\.(?:outdated(?:-\d+)?|old|part)[/\\]")
_OBSERVED_SHARES = 8  # since this schema version shares are of the observed frames


def compare_sessions(
    places: Sequence[str | Path],
    out: str | Path,
    measures: Sequence[str] = (),
    *,
    reference: str | None = None,
    animals: str | Path | None = None,
    engine: str = "auto",
    only_trusted: bool = False,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Compare the groups of all sessions in the given folders and write the tables.

    Writes stats.parquet, stats.csv, sessions.csv, columns.json, results.txt, methods.txt and
    comparison.json, which lists the sessions' folders.

    Args:
        places: study files, session folders, or folders with sessions at any depth.
        out: folder of the tables; it is created if missing.
        measures: columns of the summary; () uses the default ones and every action's share.
        reference: compare with this group only; None compares all pairs.
        animals: a CSV with `subject_id` and any of group, cage, sex, batch, which overrides the
            sessions' values.
        engine: `auto`, `permutation` or `mixed`.
        only_trusted: leave out sessions that need review.
        progress: called session by session.

    Returns:
        `stats`: the table's rows; `folder`: of the files; `sessions`: a sentence that accounts for
            every session; `check`: sentences on possible errors.

    Raises:
        SessionError: there are no two groups, two sessions of one recording state different
            animals, or a folder, column, engine or CSV cannot be used.
    """
    if engine not in ENGINES:
        raise SessionError(f"the engine is one of {', '.join(ENGINES)}, got '{engine}'")
    entries, check = account(places)
    left = {one.key: one.state for one in entries if one.folder is None}  # and the reason
    if only_trusted:
        left |= {one.key: "left out, look at it" for one in entries if one.state == LOOK_AT_IT}
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
    target.mkdir(parents=True, exist_ok=True)
    with replacing(target / "stats.parquet") as part:
        write_table(part, STATS, from_pandas(stats), {"table": "stats"})
    for name, written in (("stats", stats), ("sessions", table)):
        with replacing(target / f"{name}.csv") as part:
            write_csv(written, part)
    columns = [entry for entry in dictionary(STATS) if entry["table"] == "stats"]
    places_of = [link_to(session.path, target)["path"] for session in sessions.values()]
    document = {
        "sessions": places_of,
        "reference": reference,
        "accounted": accounted,
        "check": check,
    }
    first = next(iter(sessions.values())).columns
    units = dict(zip(first["name"], first["unit"].fillna(""), strict=True))
    results = [result(row, units.get(row["measure"], "")) for row in stats.to_dict("records")]
    warned = [f"Check this result: {one}." for one in check]
    texts = {
        "columns.json": json.dumps(columns, indent=1, ensure_ascii=False),
        "comparison.json": json.dumps(document, indent=1),
        "results.txt": "\n".join([*results, "", accounted, *warned]),
        "methods.txt": methods(stats, table, [accounted, *warned]),
    }
    for name, text in texts.items():
        write_whole(target / name, f"{text}\n")
    return {"stats": stats, "folder": target, "sessions": accounted, "check": check}


def _counted_otherwise(sessions: Mapping[str, Session]) -> list[str]:
    """A sentence on sessions of an earlier schema, with other shares; [] if none or all are."""
    old = [k for k, one in sessions.items() if one.metadata["schema_version"] < _OBSERVED_SHARES]
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
    state = LOOK_AT_IT if verdict["look_at_it"] else state
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
    whose: dict[str, str] = {}
    copies: dict[str, str] = {}
    for key, session in sessions.items():
        whose[key] = ", ".join(session.table("sessions")["subject_id"].astype(str))
        region = session.metadata.get("plan", {}).get("arena", {}).get("region")
        numbers = session.summary.select_dtypes("number").to_numpy().tolist()
        marks = (f"{session.metadata['input']['sha256']} {region}", str(numbers))
        twin = next((known[mark] for mark in marks if mark in known), key)
        if same(whose[twin]) != same(whose[key]):
            raise SessionError(
                f"{key} and {twin} are of the same recording, but of the animals {whose[key]} and "
                f"{whose[twin]}; remove one of them, or correct the animal of one with `liex "
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
    try:
        stated = read_texts(path)
    except (OSError, ValueError) as error:
        raise SessionError(
            f"{path} should be a CSV with the column subject_id, but: {error}; correct it"
        ) from None
    if (
        "subject_id" not in stated
        or not set(stated.columns) & set(WHO[1:])
        or stated["subject_id"].duplicated().any()
    ):
        raise SessionError(
            f"{path} should have a column subject_id, each animal once, and any of "
            f"{', '.join(WHO[1:])}; it has {', '.join(map(str, stated.columns))}"
        )
    known = stated.set_index("subject_id")
    if unknown := sorted(set(table["subject_id"].astype(str)) - set(known.index)):
        raise SessionError(
            f"{path} does not list the animal '{unknown[0]}' of the sessions; add a row for it"
        )
    return table.assign(
        **{name: table["subject_id"].map(known[name]) for name in WHO[1:] if name in known}
    )
