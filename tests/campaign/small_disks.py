"""Disks of a campaign's own, mounted for a while."""

import os
import subprocess
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from pathlib import Path
from threading import Timer


@contextmanager
def mounted(place: Path, *what: str) -> Iterator[Path | None]:
    """What `mount` finds under these words, at a place; None where the system mounts nothing.

    Args:
        place: the folder; made if needed.
        *what: the words of `mount` before the place.
    """
    place.mkdir(parents=True, exist_ok=True)
    if subprocess.run(["mount", *what, str(place)], capture_output=True, check=False).returncode:
        yield None
        return
    try:
        yield place
    finally:
        subprocess.run(["umount", "-l", str(place)], check=True)


def in_memory(place: Path, n_mb: int) -> AbstractContextManager[Path | None]:
    """A disk in memory, see `mounted`.

    Args:
        place: the folder; made if needed.
        n_mb: its size, MB.
    """
    return mounted(place, "-t", "tmpfs", "-o", f"size={n_mb}m", "tmpfs")


def used(disk: Path) -> int:
    """Bytes that are in use on a disk."""
    told = os.statvfs(disk)
    return (told.f_blocks - told.f_bfree) * told.f_frsize


def resize(disk: Path, n_bytes: int) -> None:
    """Give a disk in memory another size."""
    command = ["mount", "-o", f"remount,size={n_bytes}", str(disk)]
    subprocess.run(command, check=True, capture_output=True)


def read_only(disk: Path) -> None:
    """Let nobody write to a disk any more."""
    subprocess.run(["mount", "-o", "remount,ro", str(disk)], check=True, capture_output=True)


@contextmanager
def filled_after(seconds: float, disk: Path, n_bytes: int) -> Iterator[None]:
    """A disk in memory that gets smaller within the block: as small as asked, or full.

    Args:
        seconds: after the block has begun.
        disk: the disk.
        n_bytes: its new size, if no more is in use by then.
    """

    def fill() -> None:
        for _ in range(20):  # it grows meanwhile
            with suppress(subprocess.CalledProcessError):
                return resize(disk, max(n_bytes, used(disk)))

    timer = Timer(seconds, fill)
    timer.start()
    try:
        yield
    finally:
        timer.cancel()
        timer.join()
