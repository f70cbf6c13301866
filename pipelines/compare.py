"""Group comparison of a cohort, `liex compare`: sessions in, tests between groups out as tables.

Each measure and pair of groups is tested by a permutation test or a mixed model over the units that
were assigned to a group, with false discovery rates over the whole table (see `behaviour.cohort`).
"""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from liex_lab.errors import SessionError
from liex_lab.runtime.durable import replacing, write_whole
from liex_lab.runtime.progress import Progress, silent
from liex_lab.runtime.spreadsheets import read_texts

if TYPE_CHECKING:
    import pandas as pd

_WHO = ("group", "cage", "sex", "batch")


def compare_sessions(
    places: Sequence[str | Path],
    out: str | Path,
    measures: Sequence[str] = (),
    *,
    reference: str | None = None,
    animals: str | Path | None = None,
    engine: str = "auto",
    progress: Progress = silent,
) -> dict[str, Any]:
    """Compare the groups of all sessions in the given folders and write the tables.

    Writes stats.parquet, stats.csv, sessions.csv, columns.json, methods.txt and comparison.json,
    which says where the sessions are.

    Args:
        places: session folders, or folders with sessions anywhere in them.
        out: folder of the tables; it is made where it is missing.
        measures: columns of the summary; () takes the usual ones and every action's share.
        reference: compare with this group only; None compares all pairs.
        animals: a CSV with `subject_id` and any of group, cage, sex, batch, which overrules what
            the sessions say.
        engine: `auto`, `permutation` or `mixed`.
        progress: told session by session.

    Returns:
        `stats`: the table's rows; `folder`: where the files are.

    Raises:
        SessionError: there are no two groups, or a folder, column, engine or CSV cannot be used.
    """
    from liex_lab.behaviour.cohort import ENGINES, STATS, collect, compare, methods, usual_measures
    from liex_lab.runtime.spreadsheets import write_csv
    from liex_lab.sessions import Session
    from liex_lab.tables.schema import dictionary, from_pandas, write_table

    if engine not in ENGINES:
        raise SessionError(f"the engine is one of {', '.join(ENGINES)}, got '{engine}'")
    folders = find_sessions(places)
    sessions = []
    for k, folder in enumerate(folders):
        progress(k, len(folders), "reading sessions")
        sessions.append(Session.open(folder))
    table = collect(sessions)
    if animals is not None:
        table = _overruled(table, Path(animals))
    wanted = list(measures) or usual_measures(table)
    absent = [name for name in wanted if name not in table]
    if absent:
        raise SessionError(
            f"no session's summary has the column '{absent[0]}'; see columns.json in a session's "
            "folder"
        )
    groups = sorted({str(group) for group in table["group"].fillna("")} - {""})
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
    entries = [entry for entry in dictionary(STATS) if entry["table"] == "stats"]
    write_whole(target / "columns.json", json.dumps(entries, indent=1, ensure_ascii=False) + "\n")
    where = {"sessions": [_seen_from(target, folder) for folder in folders]}
    write_whole(target / "comparison.json", json.dumps(where, indent=1) + "\n")
    write_whole(target / "methods.txt", methods(stats) + "\n")
    return {"stats": stats, "folder": target}


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
            else {p.parent for p in place.rglob("session.json")}
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
