"""Report of a session that could not be measured (failed.json): the reason and what to do."""

from __future__ import annotations

import json
import platform
import traceback
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from liex_lab.errors import LiexError
from liex_lab.runtime.durable import write_whole
from liex_lab.runtime.memory import why_short
from liex_lab.runtime.places import is_full, storable_document, unlinked, why_full
from liex_lab.sessions.provenance import versions

FAILED_FILE = "failed.json"
_REPORT = "report it to the makers of liex_lab with the lines under traceback"


def describe_failure(error: BaseException, stage: str, frame: int | None) -> dict[str, Any]:
    """Table of what is to be said about an error, the content of failed.json.

    Errors that are not of a user's making carry their traceback.

    Args:
        error: the error.
        stage: what was being done.
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
        folder: the session folder; made if needed.
        failure: what `describe_failure` returned.
    """
    unlinked(folder).mkdir(parents=True, exist_ok=True)
    told = storable_document(failure)
    write_whole(folder / FAILED_FILE, json.dumps(told, indent=2, default=str) + "\n")


def read_failure(folder: Path) -> dict[str, Any] | None:
    """The failed.json in a folder; None where there is none.

    Args:
        folder: the session folder.

    Returns:
        What `describe_failure` returned; of a damaged file a table that says so as its reason.
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
