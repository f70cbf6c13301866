"""The one door for places that are written to: a folder that the user named, and a name made safe.

A name that was read from a file (the id of a session, a joint, a topic) is text and never a path.
`inside` makes one file name of it that every file system takes, and that stays in its folder. What
lies in an output folder may be somebody else's doing: a symbolic link there is refused and never
written through, nor is a file behind it changed.
"""

from __future__ import annotations

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

_NOT_IN_NAMES = set('/\\:*?"<>|')
_UNSEEN = {"Cc", "Cf", "Cs", "Co", "Cn", "Zl", "Zp"}  # Unicode's classes: control, surrogate ...
_RESERVED = {"CON", "PRN", "AUX", "NUL", "CONIN$", "CONOUT$"}  # names of devices on Windows
_RESERVED |= {f"{port}{digit}" for port in ("COM", "LPT") for digit in "0123456789¹²³"}
_MOST_BYTES = 180  # of a name without its ending: file systems take 255, parts of files add some


def safe_name(text: str, ending: str = "") -> str:
    """One file name made of a text, whatever it holds.

    Args:
        text: any text, such as the id of a session or what a recording calls itself.
        ending: what the name ends with, such as '.liex'; of the program's own making.

    Returns:
        The text and the ending, where the text can be a name on Linux, macOS and Windows. Else
        what cannot stand in a name is replaced by _, what is too long is cut, and eight
        hexadecimal digits of the text's SHA-256 follow, so that two texts never share a name.
    """
    name = "".join(
        "_" if c in _NOT_IN_NAMES or unicodedata.category(c) in _UNSEEN else c for c in text
    )
    name = name.strip(" ")
    if name[:1] in (".", "-"):  # hidden, or taken for an option
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
    """Where something with a name of foreign text is written in a folder.

    Args:
        folder: the folder that the user named.
        text: any text, see `safe_name`.
        ending: what the name ends with.

    Returns:
        A path right in the folder.

    Raises:
        PlaceError: a symbolic link lies there.
    """
    return unlinked(folder / safe_name(text, ending))


def unlinked(path: Path) -> Path:
    """The path of a file or folder that is written, where it is no symbolic link.

    Args:
        path: the path; nothing need be there. Links above it, which the user named, are followed.

    Returns:
        The same path.

    Raises:
        PlaceError: a symbolic link lies there.
    """
    if path.is_symlink():
        raise PlaceError(
            f"{path} is a symbolic link, and nothing in an output folder is written through one; "
            "remove the link, or choose another place with --out"
        )
    return path


def unlinked_below(root: Path, path: Path) -> Path:
    """The path of something below a folder, where nothing on the way to it is a symbolic link.

    Args:
        root: the folder that the user named; it may be a link itself.
        path: a path below it.

    Returns:
        The same path.

    Raises:
        PlaceError: a symbolic link lies on the way, or the path leaves the folder.
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
    """A folder that is written into again, where neither it nor anything in it is a symbolic link.

    Args:
        folder: the folder; it need not be there.

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
    """A text as files can hold it, such as a name that the system does not give as Unicode.

    Args:
        text: any text.

    Returns:
        The text; NUL and halves of characters are the replacement character.
    """
    raw = text.replace("\0", "\ufffd").encode("utf-16", "surrogatepass")
    return raw.decode("utf-16", "replace")


def storable_document(content: Any) -> Any:
    """A document as files can hold it.

    Args:
        content: what becomes JSON: tables, lists and values in each other.

    Returns:
        The same with `storable` texts, keys and paths; numbers and the like are untouched.
    """
    if isinstance(content, str | PurePath):
        return storable(str(content))
    if isinstance(content, Mapping):
        return {storable_document(key): storable_document(one) for key, one in content.items()}
    if isinstance(content, list | tuple):
        return [storable_document(one) for one in content]
    return content


def named_beside(text: str) -> bool:
    """Whether a file may name another one so: in its own folder or below, nowhere else.

    Args:
        text: the path as it is written, with / or backslashes.
    """
    parts = PurePosixPath(text.replace("\\", "/")).parts
    outside = text.startswith(("/", "\\", "~")) or text[1:2] == ":" or ".." in parts
    return not outside and "\0" not in text


# Writing of files larger than memory, and whether a disk takes any more.


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
