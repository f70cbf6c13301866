"""Safe output paths, atomic, durable replacement of files and folders, locks, temporary folders.

A name that was read from a file (session id, joint, topic) is text and never a path. `inside` turns
it into a single file name that is valid on every file system and stays in its folder. The contents
of an output folder are not trusted: symbolic links are refused and never written through.

A written file is on disk only once it is synchronised (fsync), and a rename only once its parent
folder is. Systems may write the two in any order: a folder that was renamed may contain empty files
after a power cut. New content is therefore synchronised before the rename, and the old content is
removed only when the rename is on disk.
"""

import errno
import glob
import hashlib
import os
import shutil
import sys
import tempfile
import unicodedata
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from pathlib import Path, PurePath, PurePosixPath
from typing import IO, Any

from liex_lab.errors import LiexError, PlaceError, SessionError

_UNSEEN = {"Cc", "Cf", "Cs", "Co", "Cn", "Zl", "Zp"}  # Unicode categories: control, surrogate ...
_RESERVED = {"CON", "PRN", "AUX", "NUL", "CONIN$", "CONOUT$"}  # device names on Windows
_RESERVED |= {f"{port}{digit}" for port in ("COM", "LPT") for digit in "0123456789¹²³"}
_MOST_BYTES = 180  # of a name without its ending: file systems allow 255, some suffixes are added


def safe_name(text: str, ending: str = "") -> str:
    """A valid file name for any text.

    Args:
        text: any text, such as a session id or a recording's title.
        ending: suffix of the name, such as '.liex'; must be valid.

    Returns:
        The text and the ending if the text is valid as a name on Linux, macOS and Windows.
        Otherwise invalid characters are replaced by _, long text is cut, and eight hexadecimal
        digits of the text's SHA-256 are appended, so that two texts never share a name.
    """
    name = "".join(
        "_" if c in set('/\\:*?"<>|') or unicodedata.category(c) in _UNSEEN else c for c in text
    )
    name = name.strip(" ")
    if name[:1] in (".", "-"):  # hidden, or mistaken for an option
        name = f"_{name[1:]}"
    name = name.rstrip(". ")
    if name.partition(".")[0].rstrip(" ").upper() in _RESERVED:
        name = f"_{name}"
    room = _MOST_BYTES - len(ending.encode())
    if name == text and text and len(name.encode()) <= room:
        return f"{text}{ending}"
    mark = "-" + hashlib.sha256(text.encode("utf-8", "surrogatepass")).hexdigest()[:8]
    short = name.encode()[: room - len(mark)].decode(errors="ignore")
    return f"{short or 'unnamed'}{mark}{ending}"


def inside(folder: Path, text: str, ending: str = "") -> Path:
    """Path in a folder for a file that is named after foreign text.

    Args:
        folder: the folder that the user named.
        text: any text, see `safe_name`.
        ending: suffix of the name.

    Returns:
        A path directly in the folder.

    Raises:
        PlaceError: the path is a symbolic link.
    """
    return unlinked(folder / safe_name(text, ending))


def unlinked(path: Path) -> Path:
    """Check that a path to be written is not a symbolic link.

    Args:
        path: the path, which need not exist. Links among its parents, which the user named, are
            followed.

    Returns:
        The same path.

    Raises:
        PlaceError: the path is a symbolic link.
    """
    if path.is_symlink():
        raise PlaceError(
            f"{path} is a symbolic link, and nothing in an output folder is written through one; "
            "remove the link, or choose another place with --out"
        )
    return path


def unlinked_below(root: Path, path: Path) -> Path:
    """Check that no part of a path below a folder is a symbolic link.

    Args:
        root: the folder that the user named; may itself be a link.
        path: a path below it.

    Returns:
        The same path.

    Raises:
        PlaceError: a part is a symbolic link, or the path leaves the folder.
    """
    parts = Path(os.path.abspath(path)).parts
    above = Path(os.path.abspath(root)).parts
    if parts[: len(above)] != above:
        raise PlaceError(f"{path} leaves the folder {root}; name a place in it")
    place = Path(*above)
    for part in parts[len(above) :]:
        place /= part
        unlinked(place)
    return path


def unlinked_tree(folder: Path) -> Path:
    """Check that neither a folder nor anything in it is a symbolic link.

    Args:
        folder: the folder, which need not exist.

    Returns:
        The same folder.

    Raises:
        PlaceError: there is a symbolic link.
    """
    for within, folders, files in os.walk(unlinked(folder)):
        for name in (*folders, *files):
            unlinked(Path(within, name))
    return folder


def storable(text: str) -> str:
    """A text that can be written to files, such as a name that is not valid Unicode.

    Returns:
        The text, with NUL and lone surrogates replaced by U+FFFD.
    """
    raw = text.replace("\0", "\ufffd").encode("utf-16", "surrogatepass")
    return raw.decode("utf-16", "replace")


def storable_document(content: Any) -> Any:
    """A JSON document whose texts can be written to files.

    Args:
        content: nested mappings, lists and values.

    Returns:
        The same with `storable` texts, keys and paths; other values are unchanged.
    """
    if isinstance(content, str | PurePath):
        return storable(str(content))
    if isinstance(content, Mapping):
        return {storable_document(key): storable_document(one) for key, one in content.items()}
    if isinstance(content, list | tuple):
        return [storable_document(one) for one in content]
    return content


def named_beside(text: str) -> bool:
    """Whether a path in a file refers only to its own folder or below.

    Args:
        text: the path as written, with / or backslashes.
    """
    parts = PurePosixPath(text.replace("\\", "/")).parts
    outside = text.startswith(("/", "\\", "~")) or text[1:2] == ":" or ".." in parts
    return not outside and "\0" not in text


def named_files(text: str | Path) -> list[Path]:
    """The files and folders that a path or a pattern names.

    A pattern contains * or ?, or lists names in braces, as in day1/{a.mcap,b.mcap}.

    Args:
        text: a path or a pattern.

    Returns:
        What matches, in order of name; what is listed in braces, whether or not it exists; or the
        path itself.
    """
    path = Path(text)
    if path.name.startswith("{") and path.name.endswith("}"):
        return [path.parent / name for name in path.name[1:-1].split(",")]
    if path.exists() or not {"*", "?"} & set(str(path)):
        return [path]
    return sorted(map(Path, glob.glob(str(path).replace("[", "[[]"))))


def is_there(text: str | Path) -> bool:
    """Whether everything that a path or a pattern names exists, see `named_files`."""
    found = named_files(text)
    return bool(found) and all(path.exists() for path in found)


# Detecting full disks.


_WHY = {
    errno.ENOSPC: "is full",
    getattr(errno, "EDQUOT", errno.ENOSPC): "is full: it gives this account no more room",
    errno.EFBIG: "is full: it takes no file as large as this one",
}
_WHY[errno.ENOSPC] = "is full"  # overrides EDQUOT on systems without quotas


def is_full(error: BaseException | None) -> bool:
    """Whether an error reports a full disk; False for None."""
    return isinstance(error, OSError) and error.errno in _WHY


def probe_full(folder: Path) -> OSError | None:
    """Try to write 1 MB to a disk; returns the error if it is full, else None.

    Libraries that write files in their own threads do not report why they failed.

    Args:
        folder: a folder on the disk.
    """
    try:
        with tempfile.TemporaryFile(dir=folder, buffering=0) as file:
            # bytes; a disk with less free space counts as full
            rest = 1 << 20
            while rest:
                rest -= file.write(bytes(rest)) or 0
    except OSError as error:
        return OSError(error.errno, error.strerror, str(folder)) if is_full(error) else None
    return None


def why_full(error: OSError, folder: Path | None = None) -> str:
    """Part of an error message that names the full disk and the reason.

    Args:
        error: an error for which `is_full` is true.
        folder: a folder on the disk; None if the error itself names the file.
    """
    at = folder or (Path(os.fsdecode(error.filename)) if error.filename else None)
    which = f"the disk that holds {at}" if at else "the disk"
    return f"{which} {_WHY.get(error.errno or 0, 'is full')} ({error.strerror})"


def sync_tree(folder: Path) -> None:
    """Synchronise all regular files in a folder, then its subfolders and the folder itself.

    Several files are synchronised in parallel, which takes a tenth of the time. Links are not
    followed.

    Raises:
        OSError: the disk is full or broken; the content is not on disk.
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

    Raises:
        OSError: the disk is full or broken.
    """
    _sync(file, os.O_RDWR if sys.platform == "win32" else os.O_RDONLY)


def sync_folder(folder: Path) -> None:
    """Synchronise a folder's list of entries to disk.

    Does nothing on Windows, which cannot open folders.

    Raises:
        OSError: the disk is broken.
    """
    if sys.platform != "win32":
        _sync(folder, os.O_RDONLY)


@contextmanager
def replacing(path: Path, replace_folder: bool = False) -> Iterator[Path]:
    """Yield a temporary path to write to; it replaces `path` when the block ends without an error.

    The content is synchronised to disk before the rename: after a kill or a power cut, `path` has
    either its old or its complete new content. If the block fails, the temporary file or folder is
    removed.

    Args:
        path: the file or folder to replace. A symbolic link is refused and never followed.
        replace_folder: whether an existing folder may be replaced.

    Yields:
        The temporary path, which does not exist yet.

    Raises:
        PlaceError: `path` is a symbolic link.
        OSError: writing, synchronising or renaming failed.
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
            move_into_place(part, path, path.with_name(f".{path.name}.old"))
        else:
            part.replace(path)
            sync_folder(path.parent)
    except OSError as error:
        if error.filename is None:
            error.filename = str(path)  # errors of write calls do not name the file
        raise
    finally:
        _remove(part)


def write_whole(path: Path, text: str) -> None:
    """Write a text file (UTF-8) atomically; an existing file is replaced.

    The text is written to a temporary file, synchronised to disk and renamed. After a power cut the
    file has either its old or its new content.
    """
    with replacing(path) as part:
        part.write_text(text, encoding="utf-8")


def move_into_place(new: Path, place: Path, aside: Path) -> None:
    """Rename a folder to its final path; the old one is removed when the new one is safe on disk.

    All three paths are in the same parent folder. After a kill at any point, either `place` is
    complete, or it is missing and `aside` is complete, which `put_back` restores.

    Args:
        new: the new folder; synchronised here.
        place: the final path.
        aside: where the old folder is kept until then.

    Raises:
        OSError: the rename failed; the old folder was restored.
    """
    sync_tree(new)
    if place.exists():
        sync_folder(place.parent)  # the replacement of an older folder in `aside` is on disk
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
    """Restore the folder that an interrupted `move_into_place` moved aside.

    Args:
        place: the final path.
        aside: where the old folder may be.

    Returns:
        Whether it was restored; False if `place` exists.

    Raises:
        OSError: it cannot be renamed.
    """
    if place.exists() or not aside.is_dir():
        return False
    aside.rename(place)
    sync_folder(place.parent)
    return True


def discard(folder: Path) -> None:
    """Remove a folder, so that a half-removed one is never mistaken for a complete one.

    It is first renamed to NAME.gone. What cannot be removed stays under that name until the next
    call. A missing folder is no error.

    Raises:
        OSError: it cannot be renamed.
    """
    gone = folder.with_name(f"{folder.name}.gone")
    shutil.rmtree(gone, ignore_errors=True)
    if folder.is_dir():
        folder.rename(gone)
        shutil.rmtree(gone, ignore_errors=True)


def _remove(path: Path) -> None:
    """Remove a file, link or folder, if it exists."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)


def _side_by_side(sync: Callable[[Path], None], paths: Sequence[Path]) -> None:
    """Synchronise several files or folders in parallel; raises the first error without waiting."""
    pool = ThreadPoolExecutor(8)  # the disk handles them in one go
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
        # errors of network shares and file systems that do not support fsync
        if error.errno not in {errno.EINVAL, errno.ENOTSUP, errno.EOPNOTSUPP, errno.ENOSYS}:
            raise
    finally:
        os.close(opened)


# Exclusive advisory file lock (flock, or msvcrt.locking on Windows): one process at a time.


def take_lock(path: Path) -> IO[bytes] | None:
    """Lock a file, creating it if needed; None if another process holds the lock.

    Also None if its folder was renamed or removed in the meantime.

    Returns:
        The open file; closing it releases the lock.

    Raises:
        PlaceError: the path is a symbolic link.
        OSError: the file cannot be created.
    """
    opened = os.open(
        unlinked(path), os.O_WRONLY | os.O_CREAT | os.O_APPEND | getattr(os, "O_NOFOLLOW", 0), 0o666
    )
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
        held: the start of the error message, such as 'the study is being measured'.

    Raises:
        SessionError: another process holds the lock.
    """
    file = take_lock(path)
    if file is None:
        raise SessionError(f"{held}; wait until it is done, or end it")
    try:
        yield
    finally:
        if sys.platform != "win32":  # Windows cannot remove a file in use
            path.unlink(missing_ok=True)
        file.close()
        if sys.platform == "win32":
            with suppress(OSError):
                path.unlink()


def _lock(file: IO[bytes]) -> None:
    """Lock an open file without waiting. Raises OSError if another process holds the lock."""
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
    """A new temporary folder in TMPDIR; folders of dead processes are removed first."""

    def __init__(self) -> None:
        remove_stale()
        held: IO[bytes] | None = None
        while held is None:  # another process may remove it as stale
            self.folder = Path(tempfile.mkdtemp(prefix=_PREFIX))
            with suppress(FileNotFoundError):
                held = take_lock(self.folder / _LOCK)
        self._held = held

    def close(self) -> None:
        """Remove the folder and its contents."""
        self._held.close()
        shutil.rmtree(self.folder, ignore_errors=True)


def remove_stale() -> None:
    """Remove this account's temporary folders whose processes have ended.

    A process may be killed before it has locked its folder, or while it removes it.
    """
    for folder in Path(tempfile.gettempdir()).glob(f"{_PREFIX}*"):
        with suppress(OSError, LiexError):
            foreign = hasattr(os, "getuid") and folder.stat().st_uid != os.getuid()
            if folder.is_symlink() or foreign:
                continue
            held = take_lock(folder / _LOCK)
            if held is not None:
                held.close()
                shutil.rmtree(folder, ignore_errors=True)
