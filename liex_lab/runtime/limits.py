"""What the system gives a process: memory, threads and open files, and which errors say that it
gives no more.

Libraries say so in ways of their own, and some end the process without a word: so the least that
is needed is asked for before the work begins.
"""

from __future__ import annotations

import errno

from liex_lab.errors import LiexError

# addresses that a run takes up, most of them never used: below that libraries end the process
_LEAST_GB = 4.5
_MEMORY = (
    "cannot allocate",
    "can't allocate",
    "failed to allocate",
    "failed to map segment",
    "not enough memory",
    "insufficient memory",
    "out of memory",
    "can't start new thread",
)
_NO_MEMORY = (
    "the memory was not enough; close other programs, use fewer workers, or let the process have "
    "more (ulimit -v unlimited), and run the same command again"
)
_NO_FILES = (
    "the system lets this process open no more files; allow more (ulimit -n 1024) and run the same "
    "command again"
)
_FILES = (errno.EMFILE, errno.ENFILE)


def why_short(error: BaseException | None) -> str:
    """What the system gives no more of, and what to do; empty where an error does not say so.

    Args:
        error: any error, with those that it was raised from; None for none.
    """
    asked: set[int] = set()
    while error is not None and id(error) not in asked:
        asked.add(id(error))
        if isinstance(error, OSError) and error.errno in _FILES:
            return _NO_FILES
        if isinstance(error, MemoryError) or getattr(error, "errno", None) == errno.ENOMEM:
            return _NO_MEMORY
        if not isinstance(error, LiexError) and any(said in str(error).lower() for said in _MEMORY):
            return _NO_MEMORY
        error = error.__cause__ or error.__context__
    return ""


def check_limits() -> None:
    """Refuse to begin where this process may take up too few addresses (`ulimit -v`).

    Raises:
        LiexError: it is so.
    """
    try:
        import resource
    except ImportError:  # Windows knows no such limit
        return
    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    if limit != resource.RLIM_INFINITY and limit < _LEAST_GB * 2**30:
        raise LiexError(
            f"this process may take up {limit / 2**30:.1f} GB of addresses and a run takes up "
            f"{_LEAST_GB:g}, most of it never used; allow more (ulimit -v unlimited)"
        )
