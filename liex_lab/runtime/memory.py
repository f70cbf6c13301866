"""Process memory: peak use, memory-mapped arrays on disk, checks of shapes and sizes, limits.

With arrays on disk, hours of recording take no more memory than minutes. Code that processes long
columns iterates with `blocks`, which releases the pages of all arrays on disk after each block.
"""

import errno
import math
import mmap
import os
import shutil
import sys
import tempfile
import threading
import weakref
import zipfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import IO, Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from liex_lab.errors import LiexError

_ZEROS = 1 << 20  # bytes written at once
_WINDOW = 1 << 16  # rows of a block
# memory maps of all arrays on disk in use, and their lock
_maps: weakref.WeakSet[mmap.mmap] = weakref.WeakSet()
_lock = threading.Lock()
Allocator = Callable[
    [tuple[int, ...], Any], NDArray[Any]
]  # shape and dtype -> an uninitialised array, as np.empty


def peak_memory_mb() -> float | None:
    """Peak memory of this process, MB; None if the system does not report it.

    VmHWM of /proc/self/status, else getrusage, which also counts the parent process.
    """
    status = Path("/proc/self/status")  # getrusage would also count the parent process
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


def release_memory() -> None:
    """Return unused memory to the system: pages of arrays on disk, and free heap.

    Otherwise glibc keeps the gaps between arrays in use, and Arrow keeps the memory of tables;
    after hours of recording this is a lot.
    """
    release_pages()
    if "pyarrow" in sys.modules:
        sys.modules["pyarrow"].default_memory_pool().release_unused()
    if sys.platform == "linux":
        import ctypes

        trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
        if trim is not None:
            trim(0)


def on_disk(folder: Path) -> Allocator:
    """Make an array allocator that uses unnamed temporary files, freed with their last reference.

    Arrays are in memory if files on that disk cannot be mapped, as on some network shares.
    Allocation raises OSError if the disk is full, so that filling an array cannot fail.

    Args:
        folder: a folder on the disk to use.

    Returns:
        A function of shape and dtype that returns an uninitialised array, as np.empty.
    """

    def allocate(shape: tuple[int, ...], dtype: Any) -> NDArray[Any]:
        """An array of this shape and dtype in an unnamed file; OSError if the disk is full."""
        size = int(np.prod(shape)) * np.dtype(dtype).itemsize
        if not size:
            return np.empty(shape, dtype)
        if size > shutil.disk_usage(folder).free:  # reserving would fill the disk before it fails
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(folder))
        try:
            with tempfile.TemporaryFile(dir=folder) as file:
                _reserve(file, size)
                return _registered(np.memmap(file, dtype, "r+", shape=shape))
        except OSError as error:
            if error.errno in (errno.ENOSPC, getattr(errno, "EDQUOT", errno.ENOSPC)):
                raise
            return np.empty(shape, dtype)

    return allocate


def mapped(path: Path, dtype: np.dtype[Any]) -> NDArray[Any]:
    """Memory-map the numbers in a file; pages are released like those of `on_disk`.

    Args:
        path: a non-empty file.
        dtype: dtype of its numbers.

    Returns:
        (n,) copy-on-write: changes are not written to the file.
    """
    return _registered(np.memmap(path, dtype, "c"))


def _registered(array: NDArray[Any]) -> NDArray[Any]:
    """A plain array of a memory map, registered for `release_pages`."""
    base: Any = array
    while not isinstance(base, mmap.mmap):
        base = base.base
    with _lock:
        _maps.add(base)
    return array.view(np.ndarray)


def release_pages() -> None:
    """Release the pages of all arrays on disk; they are read again on access."""
    if sys.platform != "linux":
        return
    with _lock:
        maps = list(_maps)
    for one in maps:
        one.madvise(mmap.MADV_DONTNEED)


def _reserve(file: IO[bytes], size: int) -> None:
    """Reserve disk space for a new file, bytes. Raises OSError if there is not enough."""
    if hasattr(os, "posix_fallocate"):
        os.posix_fallocate(file.fileno(), 0, size)
        return
    for start in range(0, size, _ZEROS):
        file.write(bytes(min(_ZEROS, size - start)))
    file.flush()


def blocks(n: int, size: int) -> Iterator[slice]:
    """Iterate over rows in consecutive blocks, as slices, releasing memory after each.

    After each block the pages of all arrays on disk are released (see `on_disk`, `mapped`), and
    after the last of several the heap is trimmed.

    Args:
        n: number of rows.
        size: rows per block; the last may have fewer.
    """
    for start in range(0, n, size):
        yield slice(start, min(start + size, n))
        release_pages()
    if n > size:
        release_memory()


def put(
    columns: dict[str, NDArray[Any]],
    rows: slice,
    values: Mapping[str, NDArray[Any]],
    n: int,
    allocate: Allocator,
) -> None:
    """Write values (m, ...) of some rows into their columns (n, ...), allocated on first use."""
    for name, some in values.items():
        if name not in columns:
            columns[name] = allocate((n, *some.shape[1:]), some.dtype)
        columns[name][rows] = some


def in_windows(
    n: int, margin: int, compute: Callable[[slice], NDArray[Any]], allocate: Allocator = np.empty
) -> NDArray[Any]:
    """Rows that depend on neighbouring ones, computed in blocks with a margin on either side.

    Args:
        n: number of rows.
        margin: rows on either side that a row depends on.
        compute: called with the window of a block; returns its rows (m, ...).
        allocate: allocator of the result.

    Returns:
        (n, ...) the rows of all blocks.
    """
    out = None
    for rows in blocks(n, _WINDOW):
        first = max(0, rows.start - margin)
        some = compute(slice(first, min(n, rows.stop + margin)))[rows.start - first :]
        if out is None:
            out = allocate((n, *some.shape[1:]), some.dtype)
        out[rows] = some[: rows.stop - rows.start]
    return compute(slice(0, 0)) if out is None else out


# Size limits of a NumPy archive (.npz) of unknown origin, checked before it is unpacked.


_HEADS = {
    (1, 0): np.lib.format.read_array_header_1_0,
    (2, 0): np.lib.format.read_array_header_2_0,
}


def check_npz(source: Path | IO[bytes], most_bytes: int) -> None:
    """Check that an .npz contains only arrays of plain numbers, within a size limit.

    Args:
        source: the file.
        most_bytes: largest total size of all arrays, bytes.

    Raises:
        ValueError: it is larger, an array's header claims more bytes than its entry has, or it is
            not an archive of arrays.
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
    """Raises ValueError if an array's header claims more bytes than its entry has."""
    version = np.lib.format.read_magic(file)
    if version not in _HEADS:
        raise ValueError(f"{entry.filename} has a header of an unknown kind")
    shape, _, dtype = _HEADS[version](file)
    if dtype.hasobject:
        raise ValueError(f"{entry.filename} does not hold plain numbers")
    if math.prod(shape) * dtype.itemsize > entry.file_size:
        raise ValueError(f"{entry.filename} claims {shape} numbers, more than there are")


# System resources of a process (memory, threads, open files) and the errors that report their
# exhaustion.


# address space of a run, most of it never used: with less, libraries abort the process
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
_FILES = (errno.EMFILE, errno.ENFILE)


def why_short(error: BaseException | None) -> str:
    """The resource that the system has run out of, with advice; "" if an error has another cause.

    Args:
        error: any error, inspected with its causes; None for none.
    """
    asked: set[int] = set()
    while error is not None and id(error) not in asked:
        asked.add(id(error))
        if isinstance(error, OSError) and error.errno in _FILES:
            return (
                "the system lets this process open no more files; allow more (ulimit -n 1024) and "
                "run the same command again"
            )
        if isinstance(error, MemoryError) or getattr(error, "errno", None) == errno.ENOMEM:
            return _NO_MEMORY
        if not isinstance(error, LiexError) and any(sign in str(error).lower() for sign in _MEMORY):
            return _NO_MEMORY
        error = error.__cause__ or error.__context__
    return ""


def check_limits() -> None:
    """Check that the address space limit (`ulimit -v`) is large enough for a run.

    Raises:
        LiexError: the limit is too small.
    """
    try:
        import resource
    except ImportError:  # Windows has no such limit
        return
    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    if limit != resource.RLIM_INFINITY and limit < _LEAST_GB * 2**30:
        raise LiexError(
            f"this process may take up {limit / 2**30:.1f} GB of addresses and a run takes up "
            f"{_LEAST_GB:g}, most of it never used; allow more (ulimit -v unlimited)"
        )


# Records of arrays with rows, and shape checks done once before compiled code reads them.


class Rows:
    """Base of dataclasses whose arrays all have one row per item (a frame, an animal, a sample).

    Fields that are neither arrays nor such records belong to all rows, as do those in `SHARED`.
    """

    SHARED: ClassVar[tuple[str, ...]] = ()

    def __getitem__(self, index: Any) -> Self:
        """Some rows, by mask, row numbers, slice or number; a tuple for multiple batch axes."""
        columns = {field.name: getattr(self, field.name) for field in fields(self)}  # type: ignore[arg-type]
        rows = {name: value[index] for name, value in columns.items() if self._has_rows(name)}
        return type(self)(**columns | rows)

    @classmethod
    def join(cls, parts: Sequence[Self]) -> Self:
        """Concatenate the rows of at least one part; all else is that of the first."""
        columns: dict[str, Any] = {}
        for field in fields(cls):  # type: ignore[arg-type]
            values = [getattr(part, field.name) for part in parts]
            if not parts[0]._has_rows(field.name):
                columns[field.name] = values[0]
            elif isinstance(values[0], Rows):
                columns[field.name] = type(values[0]).join(values)
            else:
                columns[field.name] = np.concatenate(values)
        return cls(**columns)

    def put(self, index: Any, other: Self) -> None:
        """Replace some rows, in place, by all rows of another record."""
        for field in fields(self):  # type: ignore[arg-type]
            own, new = getattr(self, field.name), getattr(other, field.name)
            if isinstance(own, Rows):
                own.put(index, new)
            elif self._has_rows(field.name):
                own[index] = new

    def _has_rows(self, name: str) -> bool:
        return name not in self.SHARED and isinstance(getattr(self, name), np.ndarray | Rows)


def check_shapes(whose: str, *wanted: tuple[str, NDArray, tuple[int | str, ...]]) -> None:
    """Raise if an array does not have the expected shape.

    Args:
        whose: the consumer of the arrays, for the error message.
        *wanted: name, array and shape of each; a number is an exact length, a letter any length
            that is the same wherever the letter occurs.

    Raises:
        ValueError: an array has other dimensions, or two lengths of one letter differ.
    """
    lengths: dict[int | str, int] = {}
    for name, array, shape in wanted:  # about forty arrays per live frame
        known = [lengths.get(n, n) for n in shape]
        fits = array.ndim == len(shape)
        for n, length in zip(known, array.shape, strict=False):
            if isinstance(n, str):
                lengths[n] = length
            else:
                fits &= n == length
        if not fits:
            raise ValueError(
                f"{name} of {whose} should have the shape ({', '.join(map(str, known))}), but has "
                f"({', '.join(map(str, array.shape))}); give arrays of the same frames and animal"
            )


def check_index(whose: str, index: NDArray, n: int) -> None:
    """Raise if row numbers are out of range.

    Args:
        whose: what the rows belong to, for the error message.
        index: row numbers, of any shape.
        n: number of rows.

    Raises:
        ValueError: a number is below 0 or not below n.
    """
    if index.size and not 0 <= int(index.min()) <= int(index.max()) < n:
        raise ValueError(
            f"row numbers of {whose} should be 0 to {n - 1}, but are {int(index.min())} to "
            f"{int(index.max())}; number the rows that were given"
        )
