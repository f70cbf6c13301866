"""Streaming extraction of a session from .tar or .tar.gz that keeps every byte a cut archive holds.

The archive is decompressed in order (DEFLATE has no random access): once and by ISA-L, nearly three
times as fast as zlib, where it is whole. One that is cut or damaged is unpacked once more by zlib,
whose state can be copied: smaller and smaller pieces are tried until the last good byte has come
out; the tar walk is then fed zeros, and each file is written only as far as its bytes are real.
"""

from __future__ import annotations

import errno
import shutil
import tarfile
import zlib
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import IO

from isal import isal_zlib

from liex_lab.errors import RecordingError
from liex_lab.runtime.progress import Progress

_BLOCK = 1 << 16
_PACKED = 1 << 16  # bytes read at once
_UNPACKED = 1 << 20  # and unpacked at once: an empty picture is a thousand times its packed size
_PIECE = 256  # packed bytes tried at once where there is damage
_ENOUGH_ZEROS = (
    1 << 22
)  # far more than the end of any tar; a walk that asks for more skips over what is missing
_ALWAYS = 1 << 29  # bytes that are unpacked whatever they were packed to
_MOST_TIMES = 200  # what more than that unpacks to: true pictures have noise
_MOST_HEADER = 1 << 20  # bytes of a member's name and notes
_MOST_NOTES = 1 << 28  # bytes of any file but the pictures: stamps of days
_GZIP_MAGIC = b"\x1f\x8b"


class _Member(tarfile.TarInfo):
    """A member of an archive; tarfile reads long names and notes into memory, of any size."""

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
    """What came out of an archive.

    Attributes:
        files: where the wanted files were written, by their plain names.
        seen: plain names of all files in the archive.
        cut: True where the archive is cut or damaged.
    """

    files: dict[str, Path]
    seen: frozenset[str]
    cut: bool


class _Damaged(Exception):
    """ISA-L has found damage; zlib is to say where."""


class _Patient:
    """The unpacked bytes of a tar, followed by zeros without end once the archive breaks off.

    tarfile throws away the block in which an archive ends too early. Here it never ends, and
    `n_true` says how many of the bytes were real; a tar ends in zeros by itself, so the walk over
    its members ends too.

    Args:
        file: the open archive.
        size: its bytes.
        progress: told how many MB were unpacked.
        fast: by ISA-L, which raises `_Damaged` where there is damage.
    """

    def __init__(self, file: IO[bytes], size: int, progress: Progress, fast: bool) -> None:
        self._file = file
        self._size = size
        self._progress = progress
        self.zipped = file.read(2) == _GZIP_MAGIC
        file.seek(0)
        self._fast = fast
        self._inflate = self._inflater()
        self._buffer = bytearray()
        self._pending = b""
        self.n_true = 0
        self._n_zeros = 0
        self.ended = False  # nothing more will come
        self.whole = not self.zipped  # it ended where it should

    def _inflater(self) -> zlib._Decompress:
        """What unpacks a gzip file from its beginning."""
        if self._fast:
            return isal_zlib.decompressobj(31)  # type: ignore[return-value]
        return zlib.decompressobj(31)

    def read(self, n: int) -> bytes:
        """Exactly n bytes, zeros where the archive has broken off."""
        while len(self._buffer) < n and not self.ended:
            self._fill()
        with memoryview(self._buffer) as view:
            block = bytes(view[:n])
        del self._buffer[:n]
        self.n_true += len(block)
        self._bound()
        self._n_zeros += n - len(block)
        if self._n_zeros > _ENOUGH_ZEROS:
            raise tarfile.ReadError("the archive ended long ago")
        return block + bytes(n - len(block)) if len(block) < n else block

    def _bound(self, n_more: int = 0) -> None:
        """Raises RecordingError where more comes out than of any recording, of what is packed."""
        n = self.n_true + n_more
        if n > _ALWAYS and n > _MOST_TIMES * max(self._file.tell(), 1):
            raise RecordingError(
                f"the archive unpacks to more than {_MOST_TIMES} times its size, which no "
                "recording does; pack the session's folder again"
            )

    def finish(self) -> None:
        """Read to the end.

        A tar is over before the gzip around it is, and only gzip's end tells that it is whole.
        """
        n_more = 0
        while not self.ended:
            n_more += len(self._buffer)
            self._bound(n_more)
            self._buffer.clear()
            self._fill()

    def _fill(self) -> None:
        """Some more bytes into the buffer, or the end."""
        if not self._pending:
            self._pending = self._file.read(_PACKED)
            self._progress(
                self._file.tell() >> 20, (self._size >> 20) + 1, "unpacking the recording (MB)"
            )
        if not self._pending:
            self.ended = True
            self._buffer += b"" if self.whole else self._inflate.flush()
        elif self.zipped:
            self._unzip()
        else:
            self._buffer += self._pending
            self._pending = b""

    def _unzip(self) -> None:
        if (
            self._inflate.eof
        ):  # a gzip file may be several, one after the other; anything else behind it is padding
            if len(self._pending) < len(_GZIP_MAGIC):
                self._pending += self._file.read(_PACKED)
            if not self._pending.startswith(_GZIP_MAGIC):
                self.ended = True
                return
            self._inflate = self._inflater()
        spare = None if self._fast else self._inflate.copy()
        try:
            self._buffer += self._inflate.decompress(self._pending, _UNPACKED)
            self._pending = (
                self._inflate.unused_data if self._inflate.eof else self._inflate.unconsumed_tail
            )
            self.whole = self._inflate.eof
        except isal_zlib.error as error:  # type: ignore[misc]  # stated to be an instance
            raise _Damaged from error
        except zlib.error:
            assert spare is not None
            self._salvage(spare)
            self.ended = True
            self.whole = False

    def _salvage(self, inflate: zlib._Decompress) -> None:
        """What comes out before the damage: zlib keeps back all of a piece in which it
        finds some.
        """
        for size in (_PIECE, 1):
            with suppress(zlib.error):
                while self._pending:
                    before = inflate.copy() if size > 1 else inflate
                    self._buffer += inflate.decompress(self._pending[:size])
                    self._pending = self._pending[size:]
            inflate = before


def unpack(archive: Path, wanted: Sequence[str], folder: Path, progress: Progress) -> Unpacked:
    """Write the wanted members of a .tar or .tar.gz into a folder, by their plain names.

    Args:
        archive: the .tar, .tar.gz or .tgz file.
        wanted: plain names of the members to write.
        folder: where they are written.
        progress: told how many MB were unpacked.

    Returns:
        The files written, all names met, and whether the archive is cut.

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
    """The same by ISA-L or by zlib; None where ISA-L came to no end, and zlib may tell more."""
    files: dict[str, Path] = {}
    seen: set[str] = set()
    cut = False
    with archive.open("rb") as file:
        stream = _Patient(file, archive.stat().st_size, progress, fast)
        try:
            with tarfile.open(fileobj=stream, mode="r|", bufsize=_BLOCK, tarinfo=_Member) as tar:  # type: ignore[call-overload]
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
                        (folder / name).unlink(missing_ok=True)  # it needs its room
                        _check_size(archive, member, folder)
                        files[name] = folder / name
                        cut = _copy(tar, member, files[name], stream)
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
    """Raises RecordingError where a member is too large for what it is, or for the disk."""
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


def _copy(tar: tarfile.TarFile, member: tarfile.TarInfo, to: Path, stream: _Patient) -> bool:
    """Write one member as far as its bytes are real; True where some are missing."""
    source = tar.extractfile(member)
    assert source is not None
    written = 0
    coming: Future[int] | None = None  # the write under way: the next block is unpacked meanwhile
    try:
        with to.open("wb") as out, ThreadPoolExecutor(1) as writer:
            while written < member.size:
                block = source.read(min(_BLOCK, member.size - written))
                # tarfile reads ahead by whole blocks, never behind: what lies beyond n_true is
                # padding
                real = min(len(block), max(0, stream.n_true - member.offset_data - written))
                if coming is not None:
                    coming.result()
                coming = writer.submit(out.write, memoryview(block)[:real])
                written += real
                if real < len(block):
                    break
            if coming is not None:
                coming.result()
    except OSError as error:
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            raise RecordingError(
                f"there is no room to unpack {member.size / 1e9:.1f} GB into {to.parent}; free "
                "some, or set TMPDIR to a folder on a larger disk"
            ) from None
        raise
    return written < member.size
