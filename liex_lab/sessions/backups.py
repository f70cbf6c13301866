"""Older copies of a session next to it, and the corrections in them.

NAME.old is the session being replaced by a new one; it exists only for a moment, but remains if the
writer is killed in that moment. NAME.outdated is the session from before a study's run of it
failed. A copy with corrections that no later session contains is never removed, but numbered:
NAME.outdated-2, NAME.outdated-3 and so on.
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

_TAKEN = "corrected.taken"  # in an outdated copy: corrections inherited by a later session


def put_back_session(path: Path) -> bool:
    """Restore a session that a killed writer had moved aside, unless a writer is active.

    Args:
        path: the session folder.

    Returns:
        Whether it was restored.

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
    """Restore a session that was moved aside; the caller holds the lock of NAME.part.

    If a failure was recorded in its folder since, it becomes an outdated copy.

    Args:
        path: the session folder.

    Returns:
        Whether it was restored.

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
    """Clear the folder of a session that failed: an existing session becomes NAME.outdated.

    The previous outdated copy is removed, unless it has corrections that this one lacks.

    Args:
        path: the session folder, with a session or a failed.json in it, or absent.

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
    """Folder of the corrections that a new session inherits; None if absent.

    They are those of the existing session; without any, those of its newest outdated copy with
    readable corrections that were not inherited before.

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
        except SessionError:  # damaged: left unchanged
            continue
    return None


def note_taken(made: Path, path: Path) -> None:
    """Mark the corrections of an outdated copy as inherited by the session.

    Args:
        made: the folder that `corrections_for` returned.
        path: the session folder, complete with these corrections.

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
    """Name of the outdated copy from which a session inherited its corrections; "" if absent.

    Args:
        path: the session folder.
    """
    try:
        document = json.loads((path / "session.json").read_text(encoding="utf-8"))
        return str(document.get("corrections_taken_from", ""))
    except (OSError, ValueError, AttributeError, RecursionError):
        return ""


def _waits(path: Path) -> bool:
    """Whether a session was moved aside and not replaced."""
    there = (path / "session.json").is_file()
    return not there and (aside_folder(path) / "session.json").is_file()


def _free(path: Path) -> Path:
    """The next unused name NAME.outdated-2, NAME.outdated-3 ..."""
    taken = [_number(path, copy) for copy in _outdated(path)]
    return path.with_name(f"{path.name}.outdated-{max([1, *taken]) + 1}")


def _outdated(path: Path) -> list[Path]:
    """The outdated copies of a session, newest first."""
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
    """The number of an outdated copy; 0 if it has none."""
    number = copy.name[len(f"{path.name}.outdated-") :]
    return int(number) if number.isascii() and number.isdigit() else 0


def _has_more(older: Path, path: Path) -> bool:
    """Whether a copy may have corrections that a session lacks."""
    try:
        return not set(read_log(older).entries) <= set(read_log(path).entries)
    except SessionError:
        return True
