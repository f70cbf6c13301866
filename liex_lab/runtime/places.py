"""Safe output paths: file names from foreign text, symbolic links, full disks, long writes.

A name that was read from a file (session id, joint, topic) is text and never a path. `inside` turns
it into a single file name that is valid on every file system and stays in its folder. The contents
of an output folder are not trusted: symbolic links are refused and never written through.
"""

import errno
import hashlib
import os
import tempfile
import unicodedata
from collections.abc import Iterable, Mapping
from contextlib import suppress
from pathlib import Path, PurePath, PurePosixPath
from typing import IO, Any

from liex_lab.errors import PlaceError

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


# Writing files larger than memory, and detecting full disks.


_WHY = {
    errno.ENOSPC: "is full",
    getattr(errno, "EDQUOT", errno.ENOSPC): "is full: it gives this account no more room",
    errno.EFBIG: "is full: it takes no file as large as this one",
}
_WHY[errno.ENOSPC] = "is full"  # overrides EDQUOT on systems without quotas
STRETCH = 1 << 26  # bytes of a long file that are in memory at once


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


def let_go(file: IO[bytes], first: int, last: int) -> None:
    """Drop part of a file from the page cache; does nothing on systems without `posix_fadvise`.

    Pages that are not on disk yet are queued for writing, and dropped by the next call. Otherwise
    gigabytes that are read or written once would fill the cache, which costs more than the disk
    access and evicts the pages of other programs.

    Args:
        file: the open file, with empty buffers.
        first: start of the part, bytes.
        last: end of the part, bytes.
    """
    if hasattr(os, "posix_fadvise"):  # Linux
        with suppress(OSError):  # advisory; some file systems do not support it
            os.posix_fadvise(file.fileno(), first, last - first, os.POSIX_FADV_DONTNEED)


def write_through(parts: Iterable[memoryview], to: IO[bytes]) -> int:
    """Write parts to a file, forcing them to disk as they come.

    A system that caches writes blocks the writer once too many pages are dirty.

    Args:
        parts: the content.
        to: the open, empty file.

    Returns:
        Number of bytes written.
    """
    written = begun = 0
    for part in parts:
        written += to.write(part)
        if written - begun >= STRETCH:
            to.flush()
            let_go(to, max(0, begun - STRETCH), written)
            begun = written
    return written
