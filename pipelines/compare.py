"""Group comparison of a cohort, `liex compare`: sessions in, tests between groups out as tables.

Each measure and pair of groups is tested by a permutation test or a mixed model over the units that
were assigned to a group, with false discovery rates over the whole table (see `behaviour.cohort`).
Every session of a study is accounted for: compared, or why it is not.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from liex_lab.errors import LiexError, SessionError
from liex_lab.plan.study import Study
from liex_lab.plan.subject import same
from liex_lab.runtime.durable import replacing, write_whole
from liex_lab.runtime.progress import Progress, silent
from liex_lab.runtime.spreadsheets import read_texts
from liex_lab.sessions.failure import FAILED_FILE, read_failure
from liex_lab.sessions.listed import Entry
from liex_lab.sessions.verdict import LOOK_AT_IT, OTHER_ANIMAL, read_verdict

from .study.status import misnamed

if TYPE_CHECKING:
    import pandas as pd

    from liex_lab.sessions import Session

# copies of a session that another one has taken the place of, or will take
_SET_ASIDE = re.compile(r"\.(?:outdated(?:-\d+)?|old|part)[/\\]")
_WHO = ("group", "cage", "sex", "batch")


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
    comparison.json, which says where the sessions are.

    Args:
        places: study files, session folders, or folders with sessions anywhere in them.
        out: folder of the tables; it is made where it is missing.
        measures: columns of the summary; () takes the usual ones and every action's share.
        reference: compare with this group only; None compares all pairs.
        animals: a CSV with `subject_id` and any of group, cage, sex, batch, which overrules what
            the sessions say.
        engine: `auto`, `permutation` or `mixed`.
        only_trusted: leave out sessions that someone has to look at.
        progress: told session by session.

    Returns:
        `stats`: the table's rows; `folder`: where the files are; `sessions`: a sentence that
        accounts for every session; `check`: sentences on what may be wrong.

    Raises:
        SessionError: there are no two groups, one recording counts for two animals, or a folder,
            column, engine or CSV cannot be used.
    """
    from liex_lab.behaviour.cohort import (
        ENGINES,
        STATS,
        collect,
        compare,
        methods,
        result,
        unified,
        usual_measures,
    )
    from liex_lab.runtime.spreadsheets import write_csv
    from liex_lab.sessions import Session
    from liex_lab.tables.schema import dictionary, from_pandas, write_table

    if engine not in ENGINES:
        raise SessionError(f"the engine is one of {', '.join(ENGINES)}, got '{engine}'")
    entries, check = account(places)
    left = {one.key: one.state for one in entries if one.folder is None}  # and why
    if only_trusted:
        left |= {one.key: "left out, look at it" for one in entries if one.state == LOOK_AT_IT}
    kept = sorted((one.folder, one.key) for one in entries if one.folder and one.key not in left)
    sessions: dict[str, Session] = {}
    for k, (folder, key) in enumerate(kept):
        progress(k, len(kept), "reading sessions")
        sessions[key] = Session.open(folder)
    copies = find_copies(sessions)
    left |= {one: f"same recording as {other}" for one, other in copies.items()}
    check += [f"{one} is the {left[one]}, and is not counted" for one in copies]
    sessions = {key: session for key, session in sessions.items() if key not in copies}
    table = collect(sessions.values())
    if animals is not None:
        table = _overruled(table, Path(animals))
    table, notes = unified(table)
    check += [
        *notes,
        *(f"{one.key}: {one.reason}" for one in entries if one.key in sessions and one.reason),
    ]
    grouped = set(table.loc[table["group"].fillna("") != "", "session_id"])
    left |= {key: "has no group" for key, one in sessions.items() if one.name not in grouped}
    told = _in_words(entries, left)
    wanted = list(measures) or usual_measures(table)
    absent = [name for name in wanted if name not in table]
    if absent:
        raise SessionError(
            f"no session's summary has the column '{absent[0]}'; see columns.json in a session's "
            "folder"
        )
    groups = sorted({str(group) for group in table["group"].fillna("")} - {""})
    if reference is not None:  # however it is spelled
        reference = next((group for group in groups if same(group) == same(reference)), reference)
    if len(groups) < 2 or (reference is not None and reference not in groups):
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
    write_whole(target / "columns.json", json.dumps(columns, indent=1, ensure_ascii=False) + "\n")
    places_of = [_seen_from(target, session.path) for session in sessions.values()]
    document = {"sessions": places_of, "reference": reference, "accounted": told, "check": check}
    write_whole(target / "comparison.json", json.dumps(document, indent=1) + "\n")
    first = next(iter(sessions.values())).columns
    units = dict(zip(first["name"], first["unit"].fillna(""), strict=True))
    texts = [result(row, units.get(row["measure"], "")) for row in stats.to_dict("records")]
    warned = [f"Check this result: {one}." for one in check]
    write_whole(target / "results.txt", "\n".join([*texts, "", told, *warned]) + "\n")
    write_whole(target / "methods.txt", methods(stats, table, [told, *warned]) + "\n")
    return {"stats": stats, "folder": target, "sessions": told, "check": check}


def _in_words(entries: Sequence[Entry], left: Mapping[str, str]) -> str:
    """How many sessions there are, how many are compared, and the state of each other one."""
    n = len(entries)
    states = [f"{one.key} {left.get(one.key, one.state)}" for one in entries]
    said = "; ".join(state for state in states if not state.endswith(" done"))
    counts = f"{n} session{'s' * (n != 1)} in the study, {n - len(left)} compared"
    return f"{counts}: {said}" if said else counts


def account(places: Sequence[str | Path]) -> tuple[list[Entry], list[str]]:
    """Every session in the folders, with its state; of a study those that were not measured, too.

    Args:
        places: study files, session folders, or folders with sessions anywhere in them.

    Returns:
        The sessions, those that can be compared with their folders; and what the study file says
        of its animals that may be wrong.

    Raises:
        SessionError: one is no folder, or has no session in it.
    """
    found: dict[Path, Entry] = {}
    check: list[str] = []
    folders = []
    for place in map(Path, places):
        study = _study_of(place)
        place = study.results if study and place.is_file() else place
        folders += find_sessions([place])
        here = place.resolve()
        planned = study.sessions if study else ()
        check += misnamed(planned)
        for one in planned:
            folder = one.folder.resolve()
            if here in (folder, *folder.parents):
                several = sum(other.animal.id == one.animal.id for other in planned) > 1
                found[folder] = _state_of(folder, one.id if several else one.animal.id, one.exclude)
        failed = [file for file in place.rglob(FAILED_FILE) if not _SET_ASIDE.search(str(file))]
        folders += [file.parent.resolve() for file in failed]
    for folder in folders:
        if folder not in found:
            short = folder.stem if folder.suffix == ".liex" else "/".join(folder.parts[-3:])
            taken = {one.key for one in found.values()}
            found[folder] = _state_of(folder, str(folder) if short in taken else short)
    return list(found.values()), check


def _state_of(folder: Path, key: str, exclude: str = "") -> Entry:
    """A session by what lies in its folder."""
    if exclude or not (folder / "session.json").is_file():
        failed = "failed" if read_failure(folder) else "not measured"
        return Entry(key, "excluded" if exclude else failed)
    verdict = read_verdict(folder)
    doubts = [one for one in verdict["cautions"] if str(one).startswith(OTHER_ANIMAL)]
    doubts += [] if verdict["accepted"] else verdict["reasons"]
    state = (
        LOOK_AT_IT if verdict["look_at_it"] else "has cautions" if verdict["cautions"] else "done"
    )
    return Entry(key, state, "; ".join(map(str, doubts)), folder=folder)


def _study_of(place: Path) -> Study | None:
    """The study that a file holds, or whose results lie in or around a folder; None for none."""
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
    """Sessions of a recording that has another one, by input or by all they measured, and which.

    Args:
        sessions: opened sessions by name.

    Raises:
        SessionError: two sessions of one recording are of two animals.
    """
    known: dict[tuple[str, str], str] = {}
    whose: dict[str, str] = {}
    copies: dict[str, str] = {}
    for key, session in sessions.items():
        whose[key] = ", ".join(session.table("sessions")["subject_id"].astype(str))
        region = session.metadata.get("plan", {}).get("arena", {}).get("region")
        numbers = session.summary.select_dtypes("number").to_numpy().tolist()
        marks = ((session.metadata["input"]["sha256"], repr(region)), ("measured", repr(numbers)))
        twin = next((known[mark] for mark in marks if mark in known), key)
        if same(whose[twin]) != same(whose[key]):
            raise SessionError(
                f"{key} and {twin} are of the same recording, but of the animals {whose[key]} and "
                f"{whose[twin]}; remove one of them, or correct the animal of one with `liex "
                "describe SESSION subject_id=NAME`"
            )
        copies |= {key: twin} if twin != key else {}
        known |= dict.fromkeys(marks, twin)
    return copies


def _seen_from(target: Path, folder: Path) -> str:
    """The path of a session as seen from the comparison's folder, so that both can be moved."""
    try:
        return Path(os.path.relpath(folder, target.resolve())).as_posix()
    except ValueError:  # on another drive
        return str(folder)


def find_sessions(places: Sequence[str | Path]) -> list[Path]:
    """Every session in the folders, each once, in order of their paths.

    Folders inside a session, such as its older tables, are no sessions.

    Args:
        places: session folders, or folders with sessions anywhere in them.

    Raises:
        SessionError: one is no folder, or has no session in it.
    """
    found: set[Path] = set()
    for place in map(Path, places):
        if not place.is_dir():
            raise SessionError(
                f"{place} is not a folder; name session folders, or folders with sessions in them"
            )
        inside = (
            {place}
            if (place / "session.json").is_file()
            else {p.parent for p in place.rglob("session.json") if not _SET_ASIDE.search(str(p))}
        )
        inside = {
            folder for folder in inside if not inside & set(folder.parents)
        }  # not a session's older tables
        if not inside:
            raise SessionError(f"there is no session in {place}; `liex run` makes them")
        found |= {folder.resolve() for folder in inside}
    return sorted(found)


def _overruled(table: pd.DataFrame, path: Path) -> pd.DataFrame:
    """The table with group, cage, sex and batch as a CSV of the animals states them."""
    try:
        stated = read_texts(path)
    except (OSError, ValueError) as error:
        raise SessionError(
            f"{path} should be a CSV with the column subject_id, but: {error}; correct it"
        ) from None
    if (
        "subject_id" not in stated
        or not set(stated.columns) & set(_WHO)
        or stated["subject_id"].duplicated().any()
    ):
        raise SessionError(
            f"{path} should have a column subject_id, each animal once, and any of "
            f"{', '.join(_WHO)}; it has {', '.join(map(str, stated.columns))}"
        )
    known = stated.set_index("subject_id")
    unknown = sorted(set(table["subject_id"].astype(str)) - set(known.index))
    if unknown:
        raise SessionError(
            f"{path} does not list the animal '{unknown[0]}' of the sessions; add a row for it"
        )
    return table.assign(
        **{name: table["subject_id"].map(known[name]) for name in _WHO if name in known}
    )
