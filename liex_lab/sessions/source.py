"""Link from a session to the recording that it was measured from: a path, and the hash it had.

The path is stated from the session's folder on, so that both may be moved together.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from liex_lab.sessions.session import Session

_ADDRESS = "synthetic:"


def link_to(recording: str | Path, folder: Path) -> dict[str, Any]:
    """The link for the section `input` of session.json, beside the recording's hash.

    Args:
        recording: path of the recording, or address of a virtual one.
        folder: where the session will be.
    """
    if str(recording).startswith(_ADDRESS):
        return {"path": str(recording)}
    whole = Path(recording).resolve()
    try:
        return {"path": Path(os.path.relpath(whole, folder.resolve())).as_posix()}
    except ValueError:  # on another drive of Windows
        return {"path": whole.as_posix()}


def linked_recording(session: Session) -> str | None:
    """Path or address of the recording, whether it is there or not.

    Args:
        session: the session.

    Returns:
        None of a session that does not say, as those of earlier versions.
    """
    stated = session.metadata["input"].get("path")
    if not isinstance(stated, str) or not stated:
        return None
    return stated if stated.startswith(_ADDRESS) else os.path.normpath(session.path / stated)
