"""Older copies of a session that lie beside it, and the corrections in them.

NAME.old is the session that a new one takes the place of; it is there for a moment only, but stays
where the writer is killed in that moment. NAME.outdated is the session that was there before a
study's run of it failed; one whose corrections no later session has taken over is never removed,
but gets a number: NAME.outdated-2, NAME.outdated-3 and so on.
"""

from __future__ import annotations

import json
from itertools import count
from pathlib import Path

from liex_lab.errors import SessionError
from liex_lab.runtime import durable
from liex_lab.sessions.checkpoint import hold
from liex_lab.sessions.corrections import FOLDER, LOG, corrected_folder, read_log
from liex_lab.sessions.folder import FAILED_FILE, aside_folder, part_folder

_TAKEN = "corrected.taken"  # in an outdated copy: corrections that a later session has, too


def put_back_session(path: Path) -> bool:
    """Put the session back that a killed writer had put aside, unless a writer is at work.

    Args:
        path: the session folder.

    Returns:
        Whether it was put back.

    Raises:
        OSError: it cannot be renamed.
    """
    if not _waits(path):
        return False
    part = part_folder(path)
    if not part.is_dir():
        return put_back_held(path)
    held = hold(part)
    if held is None:
        return False
    try:
        return put_back_held(path)
    finally:
        held.close()


def put_back_held(path: Path) -> bool:
    """Put a session back that was put aside; for who holds the lock of NAME.part.

    Where a failure was noted in its place since, it becomes an outdated copy.

    Args:
        path: the session folder.

    Returns:
        Whether it was put back.

    Raises:
        OSError: it cannot be renamed.
    """
    if not _waits(path):
        return False
    if (path / FAILED_FILE).is_file():
        aside_folder(path).rename(_free(path))
        durable.sync_folder(path.parent)
        return False
    return durable.put_back(path, aside_folder(path))


def set_outdated(path: Path) -> None:
    """Clear the place of a session that failed: what was measured before becomes NAME.outdated.

    The outdated copy before it goes, unless it holds corrections that are not in this one.

    Args:
        path: the session folder, with a session or a failed.json in it, or not there.

    Raises:
        OSError: it cannot be renamed.
    """
    put_back_session(path)
    if (path / "session.json").is_file():
        older = path.with_name(f"{path.name}.outdated")
        if older.is_dir():
            if _has_more(older, path):
                older.rename(_free(path))
            else:
                durable.discard(older)
        path.rename(older)
        durable.sync_folder(path.parent)
    else:
        (path / FAILED_FILE).unlink(missing_ok=True)


def corrections_for(path: Path) -> Path | None:
    """Folder of the corrections that a new session of a place takes over; None if absent.

    They are those of the session that is there; where it has none, those of its newest outdated
    copy that has some which can be read and were not taken over before.

    Args:
        path: the session folder.
    """
    own = corrected_folder(path)
    if (own / LOG).is_file():
        return own
    for copy in _outdated(path):
        try:
            if read_log(copy).entries:
                return corrected_folder(copy)
        except SessionError:  # it is damaged, and stays where it is
            continue
    return None


def note_taken(made: Path, path: Path) -> None:
    """Note in an outdated copy that its corrections are in the session now.

    Args:
        made: the folder that `corrections_for` returned.
        path: the session folder, in place with these corrections in it.

    Raises:
        OSError: it cannot be renamed.
    """
    if made.parent == path:
        return
    if made.name == FOLDER:
        durable.discard(made.with_name(f"{FOLDER}.old"))
    names = (made.with_name(_TAKEN if k == 1 else f"{_TAKEN}-{k}") for k in count(1))
    made.rename(next(name for name in names if not name.exists()))


def taken_from(path: Path) -> str:
    """Name of the outdated copy that a session took its corrections over from; "" for none.

    Args:
        path: the session folder.
    """
    try:
        document = json.loads((path / "session.json").read_text(encoding="utf-8"))
        return str(document.get("corrections_taken_from", ""))
    except (OSError, ValueError, AttributeError, RecursionError):
        return ""


def _waits(path: Path) -> bool:
    """Whether a session was put aside and none is in its place."""
    there = (path / "session.json").is_file()
    return not there and (aside_folder(path) / "session.json").is_file()


def _free(path: Path) -> Path:
    """A name NAME.outdated-2, NAME.outdated-3 ... that is not taken, after all that are."""
    taken = [_number(path, copy) for copy in _outdated(path)]
    return path.with_name(f"{path.name}.outdated-{max([1, *taken]) + 1}")


def _outdated(path: Path) -> list[Path]:
    """The outdated copies of a session, the newest first."""
    if not path.parent.is_dir():
        return []
    begin = f"{path.name}.outdated"
    numbered = [
        copy
        for copy in path.parent.iterdir()
        if copy.name.startswith(f"{begin}-") and _number(path, copy) and copy.is_dir()
    ]
    numbered.sort(key=lambda copy: _number(path, copy), reverse=True)
    last = path.with_name(begin)
    return [last, *numbered] if last.is_dir() else numbered


def _number(path: Path, copy: Path) -> int:
    """The number of an outdated copy; 0 where it has none."""
    number = copy.name[len(f"{path.name}.outdated-") :]
    return int(number) if number.isascii() and number.isdigit() else 0


def _has_more(older: Path, path: Path) -> bool:
    """Whether a copy may hold corrections that a session does not."""
    try:
        return not set(read_log(older).entries) <= set(read_log(path).entries)
    except SessionError:
        return True
