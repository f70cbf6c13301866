"""Exclusive advisory file lock (flock, or msvcrt.locking on Windows): one process at a time.

The system takes the lock back when its holder ends, however it ends.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO

from liex_lab.errors import SessionError
from liex_lab.runtime.places import unlinked

_NO_LINKS = getattr(os, "O_NOFOLLOW", 0)


def take_lock(path: Path) -> IO[bytes] | None:
    """Lock a file, which is made if needed; None where another process holds it.

    A folder that was renamed or removed in between is no longer the one that was asked for: None,
    too.

    Args:
        path: the lock file.

    Returns:
        The open file; closing it releases the lock.

    Raises:
        PlaceError: a symbolic link lies there.
        OSError: the file cannot be made.
    """
    opened = os.open(unlinked(path), os.O_WRONLY | os.O_CREAT | os.O_APPEND | _NO_LINKS, 0o666)
    file = os.fdopen(opened, "ab")
    try:
        _lock(file)
        same = os.path.samestat(os.fstat(file.fileno()), path.stat())
    except OSError:
        same = False
    if not same:
        file.close()
        return None
    return file


@contextmanager
def locked(path: Path, held: str) -> Iterator[None]:
    """Hold a lock within the block, and remove its file afterwards.

    Args:
        path: the lock file.
        held: half a sentence for the error, such as 'the study is being measured'.

    Raises:
        SessionError: another process holds it.
    """
    file = take_lock(path)
    if file is None:
        raise SessionError(f"{held}; wait until it is done, or end it")
    try:
        yield
    finally:
        if sys.platform != "win32":  # there, a file in use cannot go
            path.unlink(missing_ok=True)
        file.close()
        if sys.platform == "win32":
            with suppress(OSError):
                path.unlink()


def _lock(file: IO[bytes]) -> None:
    """Lock an open file without waiting. Raises OSError where another process holds it."""
    if sys.platform == "win32":
        import msvcrt

        file.seek(0)
        msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)
    else:
        import fcntl

        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
