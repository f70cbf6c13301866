"""A process that is killed at one of its system calls, played within this one: from then on it
neither renames, removes nor synchronises anything.
"""

import contextlib
import gc
import os
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

CALLS = ("rename", "replace", "fsync", "unlink", "rmdir")


class Killed(BaseException):
    """The process is no more."""


def killed_at(n: int, work: Callable[[], object]) -> bool:
    """Do some work, and be killed at its n-th system call from 0; False where it has fewer."""
    made = 0
    gc.freeze()  # what was there before need not be looked through for what the work leaves

    def stopping(call: Callable[..., Any]) -> Callable[..., Any]:
        def stopped(*args: Any, **more: Any) -> Any:
            nonlocal made
            made += 1
            if made > n:
                raise Killed
            return call(*args, **more)

        return stopped

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ResourceWarning)  # the system takes back its locks
        with pytest.MonkeyPatch.context() as patch:
            for name in CALLS:
                patch.setattr(os, name, stopping(getattr(os, name)))
            with contextlib.suppress(Killed):
                work()
            gone = made > n
        gc.collect()
    gc.unfreeze()
    return gone


@contextlib.contextmanager
def recorded() -> Iterator[list[tuple[str, Any]]]:
    """What is synchronised, renamed and removed within the block, in order.

    ("fsync", its identity), ("rename", (from, to, what was in it)) and ("unlink", its name).
    """
    calls: list[tuple[str, Any]] = []
    fsync, rename, unlink = os.fsync, os.rename, os.unlink

    def syncing(file: int) -> None:
        calls.append(("fsync", _identity(os.fstat(file))))
        fsync(file)

    def renaming(source: Any, target: Any, **more: Any) -> None:
        calls.append(("rename", (Path(source), Path(target), _all_in(Path(source)))))
        rename(source, target, **more)

    def unlinking(path: Any, **more: Any) -> None:
        calls.append(("unlink", os.path.basename(os.fspath(path))))
        unlink(path, **more)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", syncing)
        patch.setattr(os, "rename", renaming)
        patch.setattr(os, "unlink", unlinking)
        yield calls


def check_order(calls: list[tuple[str, Any]], place: Path) -> None:
    """What became `place` was synchronised as it is before its rename, and the folder around it
    between that rename and the next one, with which the older one goes.
    """
    parent = _identity(place.parent.stat())[:2]
    ((at, content),) = [
        (k, what[2])
        for k, (call, what) in enumerate(calls)
        if call == "rename" and what[1] == place
    ]
    synced = {what for call, what in calls[:at] if call == "fsync"}
    assert content
    assert not {name for name, identity in content.items() if identity not in synced}
    after = calls[at + 1 :]
    gone = [k for k, (call, _) in enumerate(after) if call in ("rename", "unlink")]
    around = [k for k, (call, what) in enumerate(after) if call == "fsync" and what[:2] == parent]
    assert around, "the rename itself is synchronised"
    assert not gone or around[0] < gone[0], "nothing goes before that"


def _identity(found: os.stat_result) -> tuple[int, int, int]:
    """A file, and when its content changed last."""
    return found.st_dev, found.st_ino, found.st_mtime_ns


def _all_in(folder: Path) -> dict[str, tuple[int, int, int]]:
    inside = [folder, *folder.rglob("*")] if folder.is_dir() else [folder]
    return {str(path): _identity(path.stat()) for path in inside}
