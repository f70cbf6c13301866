"""Folder of a session: its name, write checks, failed.json, free disk space, and older copies.

NAME.part is an unfinished session. NAME.old is the session being replaced by a new one; it exists
only for a moment, but remains if the writer is killed in that moment. NAME.outdated is the session
from before a study's run of it failed. A copy with corrections that no later session contains is
never removed, but numbered: NAME.outdated-2, NAME.outdated-3 and so on.
"""

import json
import platform
import re
import shutil
import traceback
from datetime import UTC, datetime
from itertools import count
from pathlib import Path
from typing import Any

from liex_lab.catalog import sha256
from liex_lab.errors import LiexError, SessionError, refuse
from liex_lab.runtime import durable, memory, text_files
from liex_lab.sessions.checkpoint import OWN, hold
from liex_lab.sessions.corrections import FOLDER, LOG, corrected_folder, read_log
from liex_lab.sessions.provenance import versions

FAILED_FILE = "failed.json"
_TAKEN = "corrected.taken"  # in an outdated copy: corrections inherited by a later session


def describe_failure(error: BaseException, stage: str, frame: int | None) -> dict[str, Any]:
    """Description of an error, the content of failed.json.

    Errors that the user did not cause include their traceback.

    Args:
        error: the error.
        stage: the current stage of the work.
        frame: the last frame that was measured; None if none was.

    Returns:
        stage, frame, reason, remedy, kind, at (ISO 8601, UTC), machine, versions, and perhaps
        traceback.
    """
    short = "" if isinstance(error, LiexError) else memory.why_short(error)
    ours = not short and not isinstance(error, LiexError | OSError)
    if isinstance(error, LiexError):
        reason, _, remedy = str(error).rpartition("; ")
        reason, remedy = (reason, remedy) if reason else (remedy, "see `liex doctor`")
    elif isinstance(error, OSError) and durable.is_full(error):
        reason = durable.why_full(error)
        remedy = "make room there and run it again"
    elif short:
        reason, _, remedy = short.partition("; ")
    elif isinstance(error, OSError):
        where = f" {error.filename}" if error.filename else ""
        reason = f"the system refused{where}: {error.strerror or error}"
        remedy = "make room, correct the permissions or mend the drive, and try again"
    else:
        reason = f"{type(error).__name__}: {error}"
        remedy = "report it to the makers of liex_lab with the lines under traceback"
    failure: dict[str, Any] = {
        "stage": stage,
        "frame": frame,
        "reason": reason,
        "remedy": remedy,
        "kind": type(error).__name__,
        "at": datetime.now(UTC).isoformat(timespec="seconds"),
        "machine": platform.node(),
        "versions": versions(),
    }
    return {**failure, "traceback": traceback.format_exception(error)} if ours else failure


def write_failure(folder: Path, failure: dict[str, Any]) -> None:
    """Write failed.json into a session's folder, whole or not at all.

    Args:
        folder: the session folder; created if needed.
        failure: the result of `describe_failure`.
    """
    durable.unlinked(folder).mkdir(parents=True, exist_ok=True)
    text = json.dumps(durable.storable_document(failure), indent=2, default=str)
    durable.write_whole(folder / FAILED_FILE, text + "\n")


def read_failure(folder: Path) -> dict[str, Any] | None:
    """The failed.json in a folder; None if absent.

    A damaged file is reported as the failure's reason.

    Args:
        folder: the session folder.

    Returns:
        The result of `describe_failure`.
    """
    path = folder / FAILED_FILE
    if not path.is_file():
        return None
    found = text_files.loose_json(path)
    damaged = {"reason": f"{path} cannot be read", "remedy": "try the session again"}
    known = isinstance(found.get("reason"), str)
    return found if known else {**damaged, "stage": "", "frame": None}


def part_folder(path: Path) -> Path:
    """Folder NAME.part of a session until it is complete.

    Args:
        path: final path of the session.
    """
    return _named(path).with_name(f"{_named(path).name}.part")


def aside_folder(path: Path) -> Path:
    """Folder NAME.old of a session while a new one replaces it.

    Args:
        path: the session folder.
    """
    return _named(path).with_name(f"{_named(path).name}.old")


def _named(path: Path) -> Path:
    """The folder with an explicit name, unlike "." and ".."."""
    return path if path.name not in ("", "..") else path.resolve()


def check_writable(path: Path, overwrite: bool) -> None:
    """Refuse to overwrite what must not be lost, or to write where no folder can be created.

    A folder that contains only failed.json may be replaced.

    Args:
        path: final path of the session.
        overwrite: whether an existing session may be replaced.

    Raises:
        SessionError: the session may not be written there.
        PlaceError: the session's path, or NAME.part or NAME.old, is a symbolic link.
    """
    for place in (path, part_folder(path), aside_folder(path)):
        durable.unlinked(place)
    nearest = next((folder for folder in path.parents if folder.exists()), None)
    if nearest is not None and not nearest.is_dir():
        raise SessionError(
            f"{nearest} is a file, and a session needs a folder; choose another place (--out, "
            "in Python out=)"
        )
    if not path.exists() or (
        path.is_dir() and {entry.name for entry in path.iterdir()} <= {FAILED_FILE}
    ):
        return  # a failed session may be replaced
    refuse(
        SessionError,
        (
            not (path / "session.json").is_file(),
            f"{path} exists and is not a session, so it is left alone; choose another place "
            "(--out, in Python out=)",
        ),
        (
            not overwrite,
            f"the session {path} exists already; choose another place (--out, in Python out=), or "
            "use --overwrite (in Python overwrite=True)",
        ),
    )


def file_facts(folder: Path) -> dict[str, Any]:
    """Bytes of every table, log and small file of a folder by name, for `liex verify`.

    All but the logs also have their SHA-256.
    """
    found: dict[str, Any] = {}
    for path in sorted(folder.iterdir()):
        if path.suffix in {".rrd", ".mcap"} and path.name not in OWN:
            found[path.name] = {"bytes": path.stat().st_size}
        elif path.suffix in {".parquet", ".csv", ".json", ".toml"} and path.name not in OWN:
            found[path.name] = {"bytes": path.stat().st_size, "sha256": sha256(path)}
    return found


def check_room(folder: Path, needed: int) -> None:
    """Refuse to begin a session for which the disk does not have enough space.

    Bytes already written by an unfinished session of the same path count as available. Between half
    and all of the estimate is accepted, because it is only an estimate.

    Args:
        folder: final path of the session.
        needed: estimated size, bytes.

    Raises:
        SessionError: the disk has less than half of that.
    """
    nearest = next(place for place in folder.absolute().parents if place.is_dir())
    written = folder_bytes(part_folder(folder))
    free = shutil.disk_usage(nearest).free
    # of the estimated size: least free space to begin with
    if free < 0.5 * (needed - written):
        raise SessionError(
            f"the session takes about {megabytes(needed - written)} and the disk that holds "
            f"{nearest} has {megabytes(free)} free; make room there, choose another place (--out, "
            "in Python out=), or keep less depth (--set replay.depth=animal or none)"
        )


def folder_bytes(folder: Path) -> int:
    """Bytes of all files of a folder; 0 if it does not exist."""
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())


def megabytes(size: float) -> str:
    """A size in bytes as text, in MB or GB."""
    return f"{size / 1e9:.1f} GB" if size >= 1e9 else f"{size / 1e6:.1f} MB"


# Older copies of a session next to it, and the corrections in them.


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
    with held:
        return put_back_held(path)


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
    if not (path / "session.json").is_file():
        (path / FAILED_FILE).unlink(missing_ok=True)
        return
    older = path.with_name(f"{path.name}.outdated")
    if older.is_dir():
        try:
            has_more = not set(read_log(older).entries) <= set(read_log(path).entries)
        except SessionError:  # it may have more
            has_more = True
        if has_more:
            older.rename(_free(path))
        else:
            durable.discard(older)
    path.rename(older)
    durable.sync_folder(path.parent)


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
    for copy in _outdated(path).values():
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
    return str(text_files.loose_json(path / "session.json").get("corrections_taken_from", ""))


def _waits(path: Path) -> bool:
    """Whether a session was moved aside and not replaced."""
    return not (path / "session.json").is_file() and (aside_folder(path) / "session.json").is_file()


def _outdated(path: Path) -> dict[int, Path]:
    """Outdated copies by number: the last one, which has none, as 0, then the latest first."""
    name = re.compile(rf"{re.escape(path.name)}\.outdated(?:-0*([1-9]\d*))?", re.ASCII)
    beside = [*path.parent.iterdir()] if path.parent.is_dir() else []
    found = [(name.fullmatch(copy.name), copy) for copy in beside if copy.is_dir()]
    numbered = {int(match[1] or 0): copy for match, copy in found if match}
    return dict(sorted(numbered.items(), key=lambda one: (one[0] > 0, -one[0])))


def _free(path: Path) -> Path:
    """An unused name of an outdated copy."""
    return path.with_name(f"{path.name}.outdated-{max([1, *_outdated(path)]) + 1}")
