"""The sessions of a study as the dashboard lists them, looked up on disk each time."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from liex_lab.errors import LiexError, StudyError
from liex_lab.plan.study import STUDY_FILE, Study
from liex_lab.sessions import Session
from liex_lab.sessions.folder import FAILED_FILE, read_failure
from liex_lab.sessions.verdict import WHO, Entry, verdict_in

from ..compare import find_sessions
from .status import SessionStatus, standings, to_look_at


def list_sessions(place: str | Path) -> tuple[str, Callable[[], Sequence[Entry]]]:
    """The name of a study, and a function that lists its sessions anew each time.

    Args:
        place: a study's .toml file, a folder with a study.toml, or a folder with sessions in it.

    Raises:
        StudyError: there is no such place.
        SessionError: the folder has no session in it.
    """
    path = Path(place)
    if path.is_file() or (path / STUDY_FILE).is_file():
        study = Study.load(path)
        return study.name, lambda: [_of_study(one) for one in standings(Study.load(study.path))]
    if not path.is_dir():
        raise StudyError(
            f"there is no study {path}; name a study's .toml file, or a folder with sessions in it"
        )
    find_sessions([path])  # says what is missing where there is none
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
    """Every session in a folder, and every one that failed; each by its name, or its place where
    names recur.
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
