"""Whether a disk takes any more: which errors say that it does not, and a probe where none does."""

from __future__ import annotations

import errno
import os
import tempfile
from pathlib import Path

_WHY = {
    errno.ENOSPC: "is full",
    getattr(errno, "EDQUOT", errno.ENOSPC): "is full: it gives this account no more room",
    errno.EFBIG: "is full: it takes no file as large as this one",
}
_WHY[errno.ENOSPC] = "is full"  # where there are no quotas
_PROBE = 1 << 20  # bytes: less room than that is none


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
