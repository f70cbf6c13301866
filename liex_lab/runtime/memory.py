"""Memory of a process: its peak, and disk-backed arrays (memory maps) that rest while not in use.

Arrays that lie on disk let hours of recording take no more memory than minutes. Whoever works on
long columns goes through them by `blocks`: after each block the pages of all arrays on disk are
given back, so nobody else need think of memory.
"""

from __future__ import annotations

import errno
import gc
import math
import mmap
import os
import shutil
import sys
import tempfile
import threading
import weakref
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from liex_lab.errors import LiexError

_ZEROS = 1 << 20  # bytes written at once
_FULL = (errno.ENOSPC, getattr(errno, "EDQUOT", errno.ENOSPC))
# the maps of all arrays on disk that are in use, and what guards them
_maps: weakref.WeakSet[mmap.mmap] = weakref.WeakSet()
_lock = threading.Lock()
Allocator = Callable[
    [tuple[int, ...], Any], NDArray[Any]
]  # shape and dtype -> an array to be filled, as np.empty


def peak_memory_mb() -> float | None:
    """The most memory this process has held, MB; None where the system does not tell.

    VmHWM of /proc/self/status, else getrusage, which would also count the process that started this
    one.
    """
    status = Path(
        "/proc/self/status"
    )  # getrusage would also count the process that started this one
    if status.is_file():
        for line in status.read_text().splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) / 1024.0
    try:
        import resource
    except ImportError:  # Windows
        return None
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return float(peak) / (2**20 if sys.platform == "darwin" else 2**10)


def rest() -> None:
    """Hand memory that is not in use back to the system: pages of arrays on disk, and free heap.

    The heap would be kept for later otherwise: glibc keeps what lies between arrays still in use,
    and Arrow what tables took; after hours of recording it is much.
    """
    _release_pages()
    if "pyarrow" in sys.modules:
        sys.modules["pyarrow"].default_memory_pool().release_unused()
    if sys.platform == "linux":
        import ctypes

        trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
        if trim is not None:
            trim(0)


@contextmanager
def uncollected() -> Iterator[None]:
    """Within the block Python's collector of garbage is off, where it was on.

    For what makes many small objects at once, as imports and figures do: they would be gone
    through again and again meanwhile.
    """
    was_on = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_on:
            gc.enable()


def on_disk(folder: Path) -> Allocator:
    """An array allocator whose arrays lie in nameless files and go with their last user.

    In memory where files of that disk cannot be mapped, as on some shares. Making an array raises
    OSError where the disk is full, so that filling it cannot fail.

    Args:
        folder: on the disk that is to hold the arrays.

    Returns:
        A function of shape and dtype that gives an array to be filled, as np.empty.
    """

    def allocate(shape: tuple[int, ...], dtype: Any) -> NDArray[Any]:
        """An array of this shape and dtype in a nameless file; OSError where the disk is full."""
        size = int(np.prod(shape)) * np.dtype(dtype).itemsize
        if not size:
            return np.empty(shape, dtype)
        if (
            size > shutil.disk_usage(folder).free
        ):  # asking for the room would take all there is before it fails
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(folder))
        try:
            with tempfile.TemporaryFile(dir=folder) as file:
                _reserve(file, size)
                return _registered(np.memmap(file, dtype, "r+", shape=shape))
        except OSError as error:
            if error.errno in _FULL:
                raise
            return np.empty(shape, dtype)

    return allocate


def mapped(path: Path, dtype: np.dtype[Any]) -> NDArray[Any]:
    """The numbers in a file, read when they are looked at; they rest like arrays of `on_disk`.

    Args:
        path: the file, which is not empty.
        dtype: of its numbers.

    Returns:
        (n,) not to be written to: what is written would be lost.
    """
    return _registered(np.memmap(path, dtype, "c"))


def _registered(array: NDArray[Any]) -> NDArray[Any]:
    """A plain array of a map, whose pages are released from now on when others rest."""
    base: Any = array
    while not isinstance(base, mmap.mmap):
        base = base.base
    with _lock:
        _maps.add(base)
    return array.view(np.ndarray)


def _release_pages() -> None:
    """Release the pages of all arrays on disk; they are read again when wanted."""
    if sys.platform != "linux":
        return
    with _lock:
        maps = list(_maps)
    for one in maps:
        one.madvise(mmap.MADV_DONTNEED)


def _reserve(file: IO[bytes], size: int) -> None:
    """Take so many bytes of the disk for a new file. Raises OSError where it has not as many."""
    if hasattr(os, "posix_fallocate"):
        os.posix_fallocate(file.fileno(), 0, size)
        return
    for start in range(0, size, _ZEROS):
        file.write(bytes(min(_ZEROS, size - start)))
    file.flush()


def blocks(n: int, size: int) -> Iterator[slice]:
    """Consecutive blocks of the rows of something long, as slices; what lies on disk then rests.

    After each block the pages of all arrays on disk are released (see `on_disk`, `mapped`), and
    after several the heap is trimmed, too.

    Args:
        n: rows.
        size: rows of a block; the last has fewer.
    """
    for start in range(0, n, size):
        yield slice(start, min(start + size, n))
        _release_pages()
    if n > size:
        rest()


# Bounds of a NumPy archive (.npz) from somewhere else, checked before any of it is unpacked.


_HEADS = {
    (1, 0): np.lib.format.read_array_header_1_0,
    (2, 0): np.lib.format.read_array_header_2_0,
}


def check_npz(source: Path | IO[bytes], most_bytes: int) -> None:
    """Check that an .npz holds arrays of plain numbers, and no more of them than it may.

    Args:
        source: the file.
        most_bytes: bytes of all arrays together.

    Raises:
        ValueError: it holds more, an array is larger than its part of the file, or it is no
            archive of arrays.
    """
    try:
        with zipfile.ZipFile(source) as archive:
            entries = archive.infolist()
            total = sum(entry.file_size for entry in entries)
            if total > most_bytes:
                raise ValueError(
                    f"it unpacks to {total / 1e9:.1f} GB, and at most {most_bytes / 1e9:.1f} GB "
                    "are expected"
                )
            for entry in entries:
                with archive.open(entry) as file:
                    _check_array(file, entry)
    except (zipfile.BadZipFile, EOFError, NotImplementedError, OverflowError) as error:
        raise ValueError(f"it is no archive of arrays ({error})") from None
    if not isinstance(source, Path):
        source.seek(0)


def _check_array(file: IO[bytes], entry: zipfile.ZipInfo) -> None:
    """Raises ValueError where an array's header claims another size than its file has."""
    version = np.lib.format.read_magic(file)
    if version not in _HEADS:
        raise ValueError(f"{entry.filename} has a header of an unknown kind")
    shape, _, dtype = _HEADS[version](file)
    if dtype.hasobject:
        raise ValueError(f"{entry.filename} does not hold plain numbers")
    if math.prod(shape) * dtype.itemsize > entry.file_size:
        raise ValueError(f"{entry.filename} claims {shape} numbers, more than there are")


# What the system gives a process: memory, threads and open files, and which errors say that it
# gives no more.


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
