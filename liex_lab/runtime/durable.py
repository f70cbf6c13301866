"""Folders put in place of older ones so that neither a kill nor a power cut loses both.

A file that was written is on disk only once it is synchronised (fsync), and a rename only once the
folder that it happened in is. Systems write the two in any order: a folder renamed into place may
have empty files in it after a power cut. So what is new is synchronised before it is renamed, and
what was there before goes only when the rename is on disk, too.
"""

from __future__ import annotations

import errno
import os
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO

from liex_lab.errors import LiexError, SessionError
from liex_lab.runtime.places import unlinked

# shares and file systems on which this cannot be asked for
_NOT_HERE = {errno.EINVAL, errno.ENOTSUP, errno.EOPNOTSUPP, errno.ENOSYS}
_AT_ONCE = 8  # files that wait for the disk together: it serves them in one go


def sync_tree(folder: Path) -> None:
    """Synchronise every regular file in a folder to disk, and then every folder in it and itself.

    Several wait for the disk side by side, which takes a tenth of the time. Links are not followed.

    Args:
        folder: the folder.

    Raises:
        OSError: the disk is full or broken, so that what was written is not on it.
    """
    files: list[Path] = []
    folders: list[Path] = []
    for inside, _, names in os.walk(folder, topdown=False):
        found = [Path(inside, name) for name in sorted(names)]
        files += [file for file in found if file.is_file() and not file.is_symlink()]
        folders.append(Path(inside))
    _side_by_side(sync_file, files)
    _side_by_side(sync_folder, folders)


def sync_file(file: Path) -> None:
    """Synchronise the content of a file to disk.

    Args:
        file: the file.

    Raises:
        OSError: the disk is full or broken.
    """
    _sync(file, os.O_RDWR if sys.platform == "win32" else os.O_RDONLY)


def sync_folder(folder: Path) -> None:
    """Synchronise the entries of a folder to disk: which names there are in it.

    Does nothing on Windows, which cannot open folders.

    Args:
        folder: the folder.

    Raises:
        OSError: the disk is broken.
    """
    if sys.platform != "win32":
        _sync(folder, os.O_RDONLY)


@contextmanager
def replacing(path: Path, replace_folder: bool = False) -> Iterator[Path]:
    """A name beside a place to write a file or folder under; it gets its place when it is whole.

    What was written is synchronised to disk before it is renamed: after a kill or a power cut the
    place holds what was there before, or all of the new. If the block fails, nothing stays.

    Args:
        path: the place. A symbolic link there is refused and never followed.
        replace_folder: whether a folder may be there, which goes for the new one.

    Yields:
        The name to write under; nothing is there.

    Raises:
        PlaceError: a symbolic link lies at the place.
        OSError: it cannot be written, synchronised or renamed.
    """
    part = unlinked(path).with_name(f".{os.getpid()}.{path.name}")
    _remove(part)
    try:
        yield part
        if part.is_dir():
            sync_tree(part)
        else:
            sync_file(part)
        if path.is_dir() and replace_folder:
            put_in_place(part, path, path.with_name(f".{path.name}.old"))
        else:
            part.replace(path)
            sync_folder(path.parent)
    except OSError as error:
        if error.filename is None:
            error.filename = str(path)  # writing does not tell what was written
        raise
    finally:
        _remove(part)


def write_whole(path: Path, text: str) -> None:
    """Write a text file atomically, so that nobody ever reads half of it.

    It is written under another name beside its place, synchronised to disk and renamed. After a
    power cut it is the old one or the new one.

    Args:
        path: the file; one that is there is replaced.
        text: its content, written as UTF-8.
    """
    with replacing(path) as part:
        part.write_text(text, encoding="utf-8")


def put_in_place(new: Path, place: Path, aside: Path) -> None:
    """Rename a folder into place; the one that was there goes when the new one is safe on disk.

    All three lie in the same folder. Killed at any point, either `place` is whole, or it is missing
    and `aside` is whole, which `put_back` mends.

    Args:
        new: the folder that was written; synchronised here.
        place: where it is to be.
        aside: where the folder that is there waits until then.

    Raises:
        OSError: it could not be done; what was there before is there again.
    """
    sync_tree(new)
    if place.exists():
        sync_folder(place.parent)  # a folder that waits there has its replacement in place
        discard(aside)
        place.rename(aside)
    try:
        new.rename(place)
    except OSError:
        put_back(place, aside)
        raise
    sync_folder(place.parent)
    discard(aside)


def put_back(place: Path, aside: Path) -> bool:
    """Rename back what `put_in_place` had put aside when it was killed.

    Args:
        place: where the folder was.
        aside: where it may wait.

    Returns:
        Whether it was renamed; not where something is in the place.

    Raises:
        OSError: it cannot be renamed.
    """
    if place.exists() or not aside.is_dir():
        return False
    aside.rename(place)
    sync_folder(place.parent)
    return True


def discard(folder: Path) -> None:
    """Remove a folder that nobody needs, so that no part of it is ever taken for the whole.

    It loses its name first. What cannot be removed stays under the other name, NAME.gone, and goes
    the next time.

    Args:
        folder: the folder; it need not be there.

    Raises:
        OSError: it cannot be renamed.
    """
    gone = folder.with_name(f"{folder.name}.gone")
    shutil.rmtree(gone, ignore_errors=True)
    if folder.is_dir():
        folder.rename(gone)
        shutil.rmtree(gone, ignore_errors=True)


def _remove(path: Path) -> None:
    """Remove a file, a link or a folder, where one is there."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)


def _side_by_side(sync: Callable[[Path], None], paths: Sequence[Path]) -> None:
    """Synchronise several files or folders; what goes wrong with one is raised, and the rest is not
    waited for.
    """
    pool = ThreadPoolExecutor(_AT_ONCE)
    try:
        for done in [pool.submit(sync, path) for path in paths]:
            done.result()
    finally:
        pool.shutdown(cancel_futures=True)


def _sync(path: Path, flags: int) -> None:
    """Synchronise a file or folder that can be opened with these flags."""
    opened = os.open(path, flags)
    try:
        os.fsync(opened)
    except OSError as error:
        if error.errno not in _NOT_HERE:
            raise
    finally:
        os.close(opened)


# Exclusive advisory file lock (flock, or msvcrt.locking on Windows): one process at a time.


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


# Temporary folders that do not outlive their process, however it ends.


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
