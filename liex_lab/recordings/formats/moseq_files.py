"""Files of a MoSeq session: extraction from .tar or .tar.gz, metadata.json and time stamps.

The archive is decompressed in order (DEFLATE has no random access). A whole one is unpacked once,
by ISA-L on a separate thread, nearly three times as fast as zlib. A cut or damaged one is unpacked
again by zlib, whose state can be copied: smaller and smaller pieces are tried up to the last good
byte; the tar walk then reads zeros, and each file is written only up to its last real byte. Stamps
are in depth_ts.txt (ms) or timestamps.csv (s).
"""

from __future__ import annotations

import errno
import gzip
import json
import shutil
import tarfile
import zlib
from collections.abc import Generator, Iterator, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import IO, Any

from isal import igzip_threaded, isal_zlib

from liex_lab.errors import RecordingError
from liex_lab.recordings.camera_file import CameraFile
from liex_lab.recordings.timestamp_files import Stamps, read_stamps
from liex_lab.recordings.timestamps import start_of_day
from liex_lab.runtime.places import write_through
from liex_lab.runtime.progress import Progress
from liex_lab.runtime.text_files import read_text

_PACKED = 1 << 18  # packed bytes read at once
_UNPACKED = 1 << 17  # bytes unpacked at once: an empty image is a thousand times its packed size
_PIECE = 256  # packed bytes tried at once near damage
_ENOUGH_ZEROS = 1 << 22  # far more than the end of any tar; a longer walk skips missing data
_ALWAYS = 1 << 29  # bytes unpacked at any compression ratio
_MOST_TIMES = 200  # compression ratio beyond that: true images have noise
_MOST_HEADER = 1 << 20  # bytes of a member's name or notes
_MOST_NOTES = 1 << 28  # bytes of any file but the images: stamps of days
_GZIP_MAGIC = b"\x1f\x8b"
Pieces = Generator[bytes | memoryview, None, None]


class _Member(tarfile.TarInfo):
    """A member of an archive, with size limits: tarfile reads any name or note into memory."""

    _LONG = (
        tarfile.GNUTYPE_LONGNAME,
        tarfile.GNUTYPE_LONGLINK,
        tarfile.XHDTYPE,
        tarfile.XGLTYPE,
        tarfile.SOLARIS_XHDTYPE,
    )

    def _proc_member(self, tar: tarfile.TarFile) -> tarfile.TarInfo:
        if self.type == tarfile.GNUTYPE_SPARSE:
            raise RecordingError(
                "the archive has a file with holes in it (GNU sparse); pack the session's folder "
                "again, without --sparse"
            )
        if self.type in self._LONG and self.size > _MOST_HEADER:
            raise RecordingError(
                f"the archive has a name or note of {self.size} bytes, which no recording has; "
                "pack the session's folder again"
            )
        found: tarfile.TarInfo = super()._proc_member(tar)  # type: ignore[misc]
        return found


@dataclass(frozen=True)
class Unpacked:
    """Result of unpacking an archive.

    Attributes:
        files: paths of the wanted files, by their plain names.
        seen: plain names of all files in the archive.
        cut: True if the archive is cut or damaged.
    """

    files: dict[str, Path]
    seen: frozenset[str]
    cut: bool


class _Damaged(Exception):
    """ISA-L found damage; zlib then locates it."""


class _Patient:
    """The unpacked bytes of a tar, followed by endless zeros after the archive's last good byte.

    tarfile discards the block in which an archive ends too early. This stream never ends, and
    `n_true` counts the real bytes; a tar ends in zeros itself, so the walk over its members ends
    too. It can only be read forwards.

    Args:
        file: the open archive.
        size: its bytes.
        progress: reports how many MB were unpacked.
        fast: use ISA-L, which raises `_Damaged` on damage.
    """

    def __init__(self, file: IO[bytes], size: int, progress: Progress, fast: bool) -> None:
        self._file = file
        self._size = size
        self._progress = progress
        self.zipped = file.read(2) == _GZIP_MAGIC
        file.seek(0)
        self.whole = not self.zipped or fast  # complete
        self._coming = (
            _read(file) if not self.zipped else _by_isal(file) if fast else self._by_zlib()
        )
        self._piece = memoryview(b"")  # rest of the last one
        self._at = 0
        self.n_true = 0

    def tell(self) -> int:
        """Number of bytes read, including zeros."""
        return self._at

    def seek(self, to: int) -> None:
        """Skip to a later position."""
        for _ in self._parts(to - self._at):
            pass
        self._at = max(self._at, to)

    def read(self, n: int) -> bytes:
        """Exactly n bytes, padded with zeros after the archive's last good byte."""
        block = b"".join([bytes(part) for part in self._parts(n)])
        missing = n - len(block)
        self._at += missing
        if self._at - self.n_true > _ENOUGH_ZEROS:
            raise tarfile.ReadError("the archive ended long ago")
        return block + bytes(missing)

    def copy(self, n: int, to: IO[bytes]) -> int:
        """Write the next n bytes into a file, up to the last real one; returns their number."""
        return write_through(self._parts(n), to)

    def finish(self) -> None:
        """Read to the end.

        A tar ends before the gzip around it, and only gzip's end shows that it is whole.
        """
        while self._next(_UNPACKED):
            pass

    def close(self) -> None:
        """Stop unpacking."""
        self._coming.close()

    def _parts(self, n: int) -> Iterator[memoryview]:
        """The next real bytes, at most n; each part is valid until the next is requested."""
        while n > 0 and (part := self._next(n)):
            self._at += len(part)
            n -= len(part)
            yield part

    def _next(self, most: int) -> memoryview:
        """Some of the next real bytes, at most `most`; empty at their end.

        Raises:
            RecordingError: the compression ratio is implausible for a recording.
        """
        while not self._piece:
            piece = next(self._coming, None)
            self._progress(
                self._file.tell() >> 20, (self._size >> 20) + 1, "unpacking the recording (MB)"
            )
            if piece is None:
                return self._piece
            self._piece = memoryview(piece)
        part = self._piece[:most]
        self._piece = self._piece[most:]
        self.n_true += len(part)
        if self.n_true > _ALWAYS and self.n_true > _MOST_TIMES * max(self._file.tell(), 1):
            raise RecordingError(
                f"the archive unpacks to more than {_MOST_TIMES} times its size, which no "
                "recording does; pack the session's folder again"
            )
        return part

    def _by_zlib(self) -> Pieces:
        """The archive unpacked by zlib, up to the last good byte."""
        inflate = zlib.decompressobj(31)
        while packed := self._file.read(_PACKED):
            while packed:
                if inflate.eof:
                    # a gzip file may have several members; anything else after it is
                    # padding
                    if len(packed) < len(_GZIP_MAGIC):
                        packed += self._file.read(_PACKED)
                    if not packed.startswith(_GZIP_MAGIC):
                        return
                    inflate = zlib.decompressobj(31)
                spare = inflate.copy()
                try:
                    yield inflate.decompress(packed, _UNPACKED)
                except zlib.error:
                    self.whole = False
                    yield _salvaged(spare, packed)
                    return
                self.whole = inflate.eof
                packed = inflate.unused_data if inflate.eof else inflate.unconsumed_tail
        if not self.whole:
            yield inflate.flush()


def _read(file: IO[bytes]) -> Pieces:
    """The bytes of an uncompressed tar."""
    while piece := file.read(_PACKED):
        yield piece


def _by_isal(file: IO[bytes]) -> Pieces:
    """A whole archive unpacked by ISA-L; each piece is valid until the next is requested.

    It unpacks on a separate thread, in parallel to writing.
    """
    room = bytearray(_UNPACKED)
    try:
        with igzip_threaded.open(file, "rb", block_size=_UNPACKED) as unpacked:
            while n := unpacked.readinto(room):
                yield memoryview(room)[:n]
    except (EOFError, gzip.BadGzipFile, isal_zlib.error) as error:  # type: ignore[misc]
        raise _Damaged from error


def _salvaged(inflate: zlib._Decompress, packed: bytes) -> bytes:
    """The bytes before the damage: zlib withholds the whole piece in which it finds some."""
    found = bytearray()
    for size in (_PIECE, 1):
        with suppress(zlib.error):
            while packed:
                before = inflate.copy() if size > 1 else inflate
                found += inflate.decompress(packed[:size])
                packed = packed[size:]
        inflate = before
    return bytes(found)


def unpack(archive: Path, wanted: Sequence[str], folder: Path, progress: Progress) -> Unpacked:
    """Write the wanted members of a .tar or .tar.gz into a folder, by their plain names.

    Args:
        archive: the .tar, .tar.gz or .tgz file.
        wanted: plain names of the members to write.
        folder: the output folder.
        progress: reports how many MB were unpacked.

    Returns:
        The files written, all names, and whether the archive is cut.

    Raises:
        RecordingError: nothing can be unpacked, a wanted name occurs twice, or the disk is full.
    """
    with suppress(_Damaged):
        found = _unpack(archive, wanted, folder, progress, fast=True)
        if found is not None:
            return found
    found = _unpack(archive, wanted, folder, progress, fast=False)
    assert found is not None
    return found


def _unpack(
    archive: Path, wanted: Sequence[str], folder: Path, progress: Progress, fast: bool
) -> Unpacked | None:
    """`unpack` by ISA-L or by zlib; None if ISA-L found damage and zlib may recover more."""
    files: dict[str, Path] = {}
    seen: set[str] = set()
    cut = False
    with (
        archive.open("rb") as file,
        closing(_Patient(file, archive.stat().st_size, progress, fast)) as stream,
    ):
        try:
            with tarfile.open(fileobj=stream, mode="r:", tarinfo=_Member) as tar:  # type: ignore[call-overload]
                for member in tar:
                    name = PurePosixPath(member.name).name
                    if cut or not member.isfile() or name.startswith("._"):
                        continue
                    if name in wanted and name in seen:
                        raise RecordingError(
                            f"{archive} holds more than one {name}; unpack it and give the folder "
                            "of one session"
                        )
                    seen.add(name)
                    if name in wanted:
                        (folder / name).unlink(missing_ok=True)  # frees its disk space
                        _check_size(archive, member, folder)
                        files[name] = folder / name
                        cut = _copy(member, files[name], stream)
        except tarfile.TarError:
            if not seen and not (fast and stream.zipped):
                raise RecordingError(
                    f"{archive} should be a MoSeq session packed as .tar.gz, but nothing can be "
                    "unpacked from it; pack the session's folder again"
                ) from None
            cut = True
        stream.finish()
    cut = cut or not stream.whole
    if cut and fast and stream.zipped:
        return None
    return Unpacked(files, frozenset(seen), cut)


def _check_size(archive: Path, member: tarfile.TarInfo, folder: Path) -> None:
    """Raises RecordingError if a member is too large for its type, or for the disk."""
    name = PurePosixPath(member.name).name
    if member.issparse():
        raise RecordingError(
            f"{archive} has a file with holes in it, {name}; pack the session's folder again"
        )
    if PurePosixPath(name).suffix in (".json", ".txt", ".csv", ".toml"):
        if member.size > _MOST_NOTES:
            raise RecordingError(
                f"{archive} has a {name} of {member.size / 1e9:.1f} GB, which holds no stamps or "
                "notes; pack the session's folder again"
            )
        return
    room = shutil.disk_usage(folder).free
    if member.size > room:
        raise RecordingError(
            f"there is no room to unpack {member.size / 1e9:.1f} GB into {folder}, where "
            f"{room / 1e9:.1f} GB are free; free some, or set TMPDIR to a folder on a larger disk"
        )


def _copy(member: tarfile.TarInfo, to: Path, stream: _Patient) -> bool:
    """Write the next member up to its last real byte; True if bytes are missing."""
    stream.seek(member.offset_data)
    try:
        with to.open("wb") as out:
            written = stream.copy(member.size, out)
    except OSError as error:
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            raise RecordingError(
                f"there is no room to unpack {member.size / 1e9:.1f} GB into {to.parent}; free "
                "some, or set TMPDIR to a folder on a larger disk"
            ) from None
        raise
    return written < member.size


# Metadata of a MoSeq session: metadata.json, depth_ts.txt (ms) and timestamps.csv (s).


STAMPS = {"depth_ts.txt": 10**6, "timestamps.csv": 10**9}  # file: nanoseconds in its unit
METADATA = "metadata.json"
# kinds of cameras
AZURE = "Azure Kinect"
KINECT = "Kinect v2"
OTHER = "other"

_CAMERA_KEYS = (
    "camera",
    "cameratype",
    "cameramodel",
    "device",
    "devicename",
    "devicemodel",
    "sensor",
)
_CAMERA_WORDS = {  # word in a camera's name: its kind; the first match counts
    "azure": AZURE,
    "k4a": AZURE,
    "femto": AZURE,
    "kinectv2": KINECT,
    "kinect2": KINECT,
    "kinectone": KINECT,
    "kinectforwindowsv2": KINECT,
}


@dataclass(frozen=True)
class Metadata:
    """Contents of metadata.json.

    Attributes:
        size: (width, height), px; None if absent.
        dtype: of the stored depths, "<u2" or ">u2".
        camera: `AZURE`, `KINECT` or `OTHER`; None if absent.
        camera_name: the camera's name in the file; empty if absent.
        facts: for `Recording.metadata`.
        problems: sentences about ignored values.
    """

    size: tuple[int, int] | None
    dtype: str
    camera: str | None
    camera_name: str
    facts: dict[str, Any]
    problems: list[str]


def read_metadata(path: Path | None, cut: bool) -> Metadata:
    """Parse metadata.json, which is often missing.

    Args:
        path: the file; None for empty metadata.
        cut: True if its archive is cut; a broken file is then ignored instead of refused.

    Raises:
        RecordingError: the file is not a JSON object, or its DepthResolution is invalid.
    """
    nothing = Metadata(None, "<u2", None, "", {}, [])
    if path is None:
        return nothing
    try:
        document = json.loads(read_text(path))
        if not isinstance(document, dict):
            raise ValueError("it is not an object in braces")
    except (
        ValueError,
        RecursionError,
    ) as error:  # broken JSON and broken UTF-8 are both ValueErrors
        if cut:
            return replace(nothing, problems=[f"{METADATA} is cut short and was not used"])
        raise RecordingError(
            f"{METADATA} of the session is not JSON ({error}); correct or remove it"
        ) from None
    named = {
        "subject_id": document.get("SubjectName"),
        "session_name": document.get("SessionName"),
    }
    facts = {key: str(said).strip() for key, said in named.items() if type(said) in (str, int)}
    stated = document.get("StartTime")
    facts |= {"session_start_time": start_of_day(stated) or ""}
    facts = {key: said for key, said in facts.items() if said}
    problems = []
    if stated is not None and "session_start_time" not in facts:
        problems.append(
            f"StartTime {stated!r} in {METADATA} is not a time with a zone, so it was not used"
        )
    little = document.get("IsLittleEndian", True) is not False
    size = _stated_size(document.get("DepthResolution"))
    return Metadata(size, "<u2" if little else ">u2", *_stated_camera(document), facts, problems)


def _stated_size(value: Any) -> tuple[int, int] | None:
    if value is None:
        return None
    if (
        isinstance(value, list)
        and len(value) == 2
        and all(type(v) is int and 0 < v < 20_000 for v in value)
    ):
        return value[0], value[1]
    raise RecordingError(
        f"{METADATA} states DepthResolution = {value!r}; it is [width, height] in pixels"
    )


def _stated_camera(document: dict[str, Any]) -> tuple[str | None, str]:
    """Kind and stated name of the camera: programs for MoSeq have no common key for it."""
    entries = {
        key.lower().replace("_", "").replace(" ", ""): value for key, value in document.items()
    }
    stated = (entries[key].strip() for key in _CAMERA_KEYS if isinstance(entries.get(key), str))
    name = next(filter(None, stated), "")
    plain = "".join(letter for letter in name.lower() if letter.isalnum())
    known = (camera for word, camera in _CAMERA_WORDS.items() if word in plain)
    return next(known, OTHER if name else None), name


def read_session_stamps(
    files: dict[str, Path],
    cut: bool,
    camera_file: CameraFile,
    problems: list[str],
    doubts: list[str],
) -> Stamps | None:
    """Read the file of time stamps next to the depth.

    depth_ts.txt is in milliseconds and timestamps.csv in seconds, unless their first line names a
    column in another unit, or camera.toml does. In a cut archive, half a number at the end is
    dropped, also from the file.

    Args:
        files: the session's files by name.
        cut: True if their archive is cut.
        camera_file: may state the column of times and its unit.
        problems: sentences, appended to if there are no stamps.
        doubts: reasons why the times are unreliable, appended to.

    Returns:
        The stamps; None if absent.

    Raises:
        RecordingError: a line has no valid stamp.
    """
    name = next((name for name in STAMPS if name in files), None)
    if name is None:
        return None
    path = files[name]
    if cut:  # the archive may end inside this file: half a number is a wrong number
        text = path.read_bytes()
        path.write_bytes(text[: text.rfind(b"\n") + 1])
    stated = (camera_file.time_column, camera_file.time_unit, STAMPS[name])
    stamps = read_stamps(path, doubts, *stated)
    if not len(stamps):
        problems.append(f"{name} holds no time stamp")
        return None
    return stamps
