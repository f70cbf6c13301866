"""The sessions of a study for the dashboard, read from disk each time."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from liex_lab.errors import LiexError, StudyError
from liex_lab.plan.study import STUDY_FILE, PlannedSession, Study
from liex_lab.runtime.durable import replacing, write_whole
from liex_lab.runtime.places import unlinked_below
from liex_lab.runtime.text_files import harmless
from liex_lab.sessions import Session
from liex_lab.sessions.folder import FAILED_FILE, read_failure
from liex_lab.sessions.verdict import WHO, Entry, verdict_in
from liex_lab.tables.schema import dictionary, table_columns, write_table

from ..compare import find_sessions
from .status import SessionStatus, standings, to_look_at


def list_sessions(place: str | Path) -> tuple[str, Callable[[], Sequence[Entry]]]:
    """The name of a study, and a function that lists its sessions from disk at each call.

    `place` is a study's .toml file, a folder with a study.toml, or a folder with sessions in it.

    Raises:
        StudyError: there is no such file or folder.
        SessionError: the folder contains no session.
    """
    path = Path(place)
    if path.is_file() or (path / STUDY_FILE).is_file():
        study = Study.load(path)
        return study.name, lambda: [_of_study(one) for one in standings(Study.load(study.path))]
    if not path.is_dir():
        raise StudyError(
            f"there is no study {path}; name a study's .toml file, or a folder with sessions in it"
        )
    find_sessions([path])  # raises an error if there is none
    return path.resolve().name, lambda: _of_folder(path)


def _of_study(one: SessionStatus) -> Entry:
    animal = one.session.animal
    failure = one.failure or {}
    who = {"subject_id": animal.id, **{name: getattr(animal, name) for name in WHO[1:]}}
    there = (one.session.folder / "session.json").is_file()
    folder = one.session.folder if there else None
    reason = one.reason or one.session.remark
    return Entry(one.session.id, one.state, reason, str(failure.get("remedy", "")), folder, who)


def _of_folder(path: Path) -> list[Entry]:
    """Every session in a folder, measured or failed.

    Keys are session names, or relative paths where names recur.
    """
    entries = [_measured(folder) for folder in find_sessions([path])]
    for file in sorted(path.rglob(FAILED_FILE)):
        failure = read_failure(file.parent) or {}
        name = file.parent.relative_to(path).as_posix()
        entries.append(
            Entry(name, "failed", str(failure.get("reason", "")), str(failure.get("remedy", "")))
        )
    names = [entry.key for entry in entries]
    return [
        entry
        if names.count(entry.key) == 1 or entry.folder is None
        else Entry(
            entry.folder.relative_to(path.resolve()).as_posix(),
            entry.state,
            entry.reason,
            "",
            entry.folder,
            entry.who,
        )
        for entry in entries
    ]


def _measured(folder: Path) -> Entry:
    try:
        session = Session.open(folder)
        row = session.table("sessions").iloc[0]
        who = {name: str(row[name]) for name in WHO if isinstance(row.get(name), str) and row[name]}
        reason = to_look_at(verdict_in(session.metadata))
        return Entry(session.name, "done", reason, folder=folder, who=who)
    except LiexError as error:
        return Entry(folder.name, "failed", str(error))


# The study's table: every session with its status, as CSV for spreadsheets and Parquet for
# programs.


TABLE = "study"
STUDY_SESSIONS = table_columns(TABLE)


def write_study_table(study: Study, standings: Sequence[SessionStatus]) -> Path:
    """Write study.parquet, study.csv and study_columns.json; returns the path of the CSV."""
    import csv
    import io

    folder = study.cohort_folder
    unlinked_below(study.results, folder).mkdir(parents=True, exist_ok=True)
    rows = study_rows(study, standings)
    names = [column.name for column in STUDY_SESSIONS]
    block = {name: [row[name] for row in rows] for name in names}
    with replacing(folder / f"{TABLE}.parquet") as part:
        write_table(part, STUDY_SESSIONS, [block], {"study": study.name})
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(names)
    writer.writerows([harmless(row[name]) for name in names] for row in rows)
    write_whole(folder / f"{TABLE}.csv", text.getvalue())
    entries = [entry for entry in dictionary(STUDY_SESSIONS) if entry["table"] == TABLE]
    write_whole(
        folder / f"{TABLE}_columns.json", json.dumps(entries, indent=1, ensure_ascii=False) + "\n"
    )
    return folder / f"{TABLE}.csv"


def study_rows(study: Study, standings: Sequence[SessionStatus]) -> list[dict[str, Any]]:
    """One row per session with the columns of `STUDY_SESSIONS`; paths are relative to the study."""
    return [_row(study, one) for one in standings]


def _row(study: Study, one: SessionStatus) -> dict[str, Any]:
    session = one.session
    failure = one.failure or {}
    document = _document(session.folder) if one.state == "done" else {}
    counted = document.get("frames")
    frames = counted if isinstance(counted, dict) else {}
    return {
        "session_id": session.id,
        "subject_id": session.animal.id,
        **{name: getattr(session.animal, name) for name in ("group", "cage", "sex", "batch")},
        "state": one.state,
        "reason": one.reason,
        "shared": _shared(session),
        "remedy": str(failure.get("remedy", "")),
        "stage": str(failure.get("stage") or ""),
        "frame": _count(failure.get("frame"), -1),
        "n_frames": _count(frames.get("n_frames"), 0),
        "n_frames_observed": _count(frames.get("n_observed"), 0),
        "observed_s": _number(frames.get("observed_s")),
        "frames_per_s": _number(document.get("frames_per_s")),
        "peak_memory_mb": _number(document.get("peak_memory_mb")),
        "recording": _below(study, session.recording),
        "folder": _below(study, str(session.folder)),
    }


def _shared(session: PlannedSession) -> str:
    shared = session.plan.animal.shared
    if shared is None:
        return session.remark
    length = "" if shared.spine_mm is None else f"{shared.spine_mm:.1f} mm long, "
    shape = "the average shape" if shared.shape is None else "a shape of its own"
    return f"{length}{shape}, by {shared.by}"


def _document(folder: Path) -> dict[str, Any]:
    try:
        found = json.loads((folder / "session.json").read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return {}
    return found if isinstance(found, dict) else {}


def _below(study: Study, path: str) -> str:
    try:
        return Path(path).relative_to(study.folder).as_posix()
    except ValueError:
        return path


def _count(value: Any, otherwise: int) -> int:
    return value if isinstance(value, int) else otherwise


def _number(value: Any) -> float:
    return float(value) if isinstance(value, int | float) else float("nan")
