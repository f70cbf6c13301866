"""Temporary folders that do not outlive their process, however it ends.

Each is locked as long as it is in use. One that nobody holds any more belonged to a process that
was killed, and goes when the next one is made.
"""

from __future__ import annotations

import os
import shutil
import tempfile
from contextlib import suppress
from pathlib import Path
from typing import IO

from liex_lab.errors import LiexError
from liex_lab.runtime.lock import take_lock

_PREFIX = "liex-scratch-"
_LOCK = ".lock"


class Scratch:
    """A new temporary folder, below TMPDIR; those of dead processes are removed before.

    Attributes:
        folder: the folder.
    """

    def __init__(self) -> None:
        remove_stale()
        held: IO[bytes] | None = None
        while held is None:  # somebody who removes stale ones may be faster
            self.folder = Path(tempfile.mkdtemp(prefix=_PREFIX))
            with suppress(FileNotFoundError):
                held = take_lock(self.folder / _LOCK)
        self._held = held

    def close(self) -> None:
        """Remove the folder with all that is in it."""
        self._held.close()
        shutil.rmtree(self.folder, ignore_errors=True)


def remove_stale() -> None:
    """Remove this account's temporary folders whose processes are no more.

    A process may be killed before it has locked its folder, or while it removes it.
    """
    for folder in Path(tempfile.gettempdir()).glob(f"{_PREFIX}*"):
        with suppress(OSError, LiexError):
            if folder.is_symlink() or not _own(folder):
                continue
            held = take_lock(folder / _LOCK)
            if held is not None:
                held.close()
                shutil.rmtree(folder, ignore_errors=True)


def _own(folder: Path) -> bool:
    """Whether a folder is this account's."""
    return not hasattr(os, "getuid") or folder.stat().st_uid == os.getuid()
