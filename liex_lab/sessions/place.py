"""Rules for where a session may be written, and what is to be known of its files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from liex_lab.catalog import sha256
from liex_lab.errors import SessionError
from liex_lab.runtime.places import unlinked
from liex_lab.sessions.checkpoint import OWN
from liex_lab.sessions.failure import FAILED_FILE
from liex_lab.sessions.older import aside_folder, part_folder

_LOGS = {".rrd", ".mcap"}
_HASHED = {".parquet", ".csv", ".json", ".toml"}


def check_place(path: Path, overwrite: bool) -> None:
    """Refuse to write over what must not be lost, or where no folder can be.

    A folder with nothing in it but failed.json may be replaced.

    Args:
        path: the session folder to be.
        overwrite: whether a session that is there already may be replaced.

    Raises:
        SessionError: the session may not be written there.
        PlaceError: the session's place, or one beside it that is needed, is a symbolic link.
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
        return  # what failed before may be replaced
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
    """Bytes of every table, log and small file of a folder by its name, for `liex verify`.

    All but the logs have their SHA-256, too.
    """
    found: dict[str, Any] = {}
    for path in sorted(folder.iterdir()):
        if path.suffix in _LOGS and path.name not in OWN:
            found[path.name] = {"bytes": path.stat().st_size}
        elif path.suffix in _HASHED and path.name not in OWN:
            found[path.name] = {"bytes": path.stat().st_size, "sha256": sha256(path)}
    return found
