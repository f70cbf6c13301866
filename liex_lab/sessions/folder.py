"""Folder of a session: its name, write checks, failed.json, and free disk space."""

from __future__ import annotations

import json
import platform
import shutil
import traceback
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from liex_lab.catalog import sha256
from liex_lab.errors import LiexError, SessionError
from liex_lab.runtime.durable import write_whole
from liex_lab.runtime.memory import why_short
from liex_lab.runtime.places import is_full, storable_document, unlinked, why_full
from liex_lab.sessions.checkpoint import OWN
from liex_lab.sessions.provenance import versions

if TYPE_CHECKING:
    pass

FAILED_FILE = "failed.json"
_REPORT = "report it to the makers of liex_lab with the lines under traceback"


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
    short = "" if isinstance(error, LiexError) else why_short(error)
    ours = not short and not isinstance(error, LiexError | OSError)
    if isinstance(error, LiexError):
        reason, _, remedy = str(error).rpartition("; ")
        reason, remedy = (reason, remedy) if reason else (remedy, "see `liex doctor`")
    elif isinstance(error, OSError) and is_full(error):
        reason = why_full(error)
        remedy = "make room there and run it again"
    elif short:
        reason, _, remedy = short.partition("; ")
    elif isinstance(error, OSError):
        where = f" {error.filename}" if error.filename else ""
        reason = f"the system refused{where}: {error.strerror or error}"
        remedy = "make room, correct the permissions or mend the drive, and try again"
    else:
        reason = f"{type(error).__name__}: {error}"
        remedy = _REPORT
    told: dict[str, Any] = {
        "stage": stage,
        "frame": frame,
        "reason": reason,
        "remedy": remedy,
        "kind": type(error).__name__,
        "at": datetime.now(UTC).isoformat(timespec="seconds"),
        "machine": platform.node(),
        "versions": versions(),
    }
    return {**told, "traceback": traceback.format_exception(error)} if ours else told


def write_failure(folder: Path, failure: dict[str, Any]) -> None:
    """Write failed.json into a session's folder, whole or not at all.

    Args:
        folder: the session folder; created if needed.
        failure: the result of `describe_failure`.
    """
    unlinked(folder).mkdir(parents=True, exist_ok=True)
    told = storable_document(failure)
    write_whole(folder / FAILED_FILE, json.dumps(told, indent=2, default=str) + "\n")


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
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
        if isinstance(found, dict) and isinstance(found.get("reason"), str):
            return found
    except (ValueError, OSError, RecursionError):
        pass
    return {
        "reason": f"{path} cannot be read",
        "stage": "",
        "frame": None,
        "remedy": "try the session again",
    }


_LOGS = {".rrd", ".mcap"}
_HASHED = {".parquet", ".csv", ".json", ".toml"}


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
        unlinked(place)
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
    if not (path / "session.json").is_file():
        raise SessionError(
            f"{path} exists and is not a session, so it is left alone; choose another place "
            "(--out, in Python out=)"
        )
    if not overwrite:
        raise SessionError(
            f"the session {path} exists already; choose another place (--out, in Python out=), or "
            "say --overwrite (in Python overwrite=True)"
        )


def file_facts(folder: Path) -> dict[str, Any]:
    """Bytes of every table, log and small file of a folder by name, for `liex verify`.

    All but the logs also have their SHA-256.
    """
    found: dict[str, Any] = {}
    for path in sorted(folder.iterdir()):
        if path.suffix in _LOGS and path.name not in OWN:
            found[path.name] = {"bytes": path.stat().st_size}
        elif path.suffix in _HASHED and path.name not in OWN:
            found[path.name] = {"bytes": path.stat().st_size, "sha256": sha256(path)}
    return found


# Disk space of a session, estimated before its first frame.


_SURE = 0.5  # of the estimate: least free space to begin with


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
    begun = part_folder(folder)
    written = folder_bytes(begun)
    free = shutil.disk_usage(nearest).free
    if free < _SURE * (needed - written):
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
