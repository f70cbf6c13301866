"""Writing of files larger than memory, and whether a disk takes any more.

Which errors say that it does not, and a probe where none does.
"""

from __future__ import annotations

import errno
import os
import tempfile
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from typing import IO

_WHY = {
    errno.ENOSPC: "is full",
    getattr(errno, "EDQUOT", errno.ENOSPC): "is full: it gives this account no more room",
    errno.EFBIG: "is full: it takes no file as large as this one",
}
_WHY[errno.ENOSPC] = "is full"  # where there are no quotas
_PROBE = 1 << 20  # bytes: less room than that is none
STRETCH = 1 << 26  # bytes of a long file that are in memory at a time


def is_full(error: BaseException | None) -> bool:
    """Whether an error says that a disk takes no more.

    Args:
        error: any error; None for none.
    """
    return isinstance(error, OSError) and error.errno in _WHY


def probe_full(folder: Path) -> OSError | None:
    """Try to write 1 MB to a disk: the error where it takes no more, None where it does.

    Libraries that write files in threads of their own do not tell why they failed.

    Args:
        folder: a folder on the disk.
    """
    try:
        with tempfile.TemporaryFile(dir=folder, buffering=0) as file:
            rest = _PROBE
            while rest:
                rest -= file.write(bytes(rest)) or 0
    except OSError as error:
        return OSError(error.errno, error.strerror, str(folder)) if is_full(error) else None
    return None


def why_full(error: OSError, folder: Path | None = None) -> str:
    """The part of a sentence that says which disk is full, and in which way.

    Args:
        error: for which `is_full` holds.
        folder: on the disk; None where the error itself names the file.
    """
    at = folder or (Path(os.fsdecode(error.filename)) if error.filename else None)
    which = f"the disk that holds {at}" if at else "the disk"
    return f"{which} {_WHY.get(error.errno or 0, 'is full')} ({error.strerror})"


def let_go(file: IO[bytes], first: int, last: int) -> None:
    """Give up the memory in which a system keeps a part of a file; nothing where it cannot be told.

    What is not on the disk yet is sent there, and its memory is given up when it is told again.
    Gigabytes that are read or written once would otherwise take new memory to the end, which costs
    more than the disk, and drive out what others have there.

    Args:
        file: the open file, with nothing left in a buffer.
        first: where the part begins, bytes.
        last: where it ends.
    """
    if hasattr(os, "posix_fadvise"):  # Linux
        with suppress(OSError):  # it is an advice, which some file systems do not take
            os.posix_fadvise(file.fileno(), first, last - first, os.POSIX_FADV_DONTNEED)


def write_through(parts: Iterable[memoryview], to: IO[bytes]) -> int:
    """Write parts into a file, onto the disk as they come.

    A system that keeps what is written lets the writer wait once too much is owed to the disk.

    Args:
        parts: what is written.
        to: the open file, which holds nothing yet.

    Returns:
        How many bytes were written.
    """
    written = begun = 0
    for part in parts:
        written += to.write(part)
        if written - begun >= STRETCH:
            to.flush()
            let_go(to, max(0, begun - STRETCH), written)
            begun = written
    return written
