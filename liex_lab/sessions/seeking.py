"""Random access to the depth pictures of a session, by the index that session.mcap ends with.

`cutouts.open_pictures` walks over the whole file once, as it does with any recording, which takes a
minute for an hour of frames. A finished file says at its end which chunk holds which times, so one
picture needs one chunk. What such a file does not have (its end, or the picture) is left to the
walk.
"""

from __future__ import annotations

import struct
from pathlib import Path
from threading import Lock
from typing import IO, TYPE_CHECKING

import numpy as np
from mcap.opcode import Opcode
from numpy.typing import NDArray

from liex_lab.errors import RecordingError
from liex_lab.recordings.formats.messages.depth_images import decode
from liex_lab.recordings.formats.messages.mcap import MAGIC
from liex_lab.recordings.formats.messages.message_file import (
    Channel,
    Chunk,
    DamagedChunk,
    unpacked,
)
from liex_lab.recordings.formats.messages.messages import DepthMessage
from liex_lab.recordings.formats.messages.parsers import parser_of

if TYPE_CHECKING:
    from liex_lab.optics.camera import Camera

Depth = NDArray[np.uint16]

TOPIC = "/camera/depth"
_SCHEMA = "foxglove.RawImage"
_RECORD = struct.Struct("<BQ")  # opcode, length of what follows
_FOOTER = struct.Struct("<BQQQI")
_MESSAGE = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time
_CHUNK = struct.Struct("<QQQII")  # first and last time, unpacked size, its CRC, length of a name
_INDEX = struct.Struct("<QQQQ")  # first and last time, where the chunk's record is, its length
_LARGEST_SUMMARY = 1 << 28  # bytes
_DAMAGE = (struct.error, DamagedChunk, ValueError, TypeError, KeyError, OverflowError, OSError)


class SeekablePictures:
    """The depth pictures of a finished session.mcap, one at a time and in any order.

    It may be used from several threads at once.

    Args:
        path: the file.
        camera: the camera of the session.

    Raises:
        RecordingError: the file has no index; its pictures are had by `cutouts.open_pictures`.
    """

    def __init__(self, path: Path, camera: Camera) -> None:
        self._path = path
        self._camera = camera
        self._lock = Lock()
        self._last: tuple[int, bytes] = (-1, b"")
        parse = parser_of(Channel(TOPIC, _SCHEMA, "protobuf"))
        assert parse is not None
        self._parse = parse
        self._file = path.open("rb")
        try:
            self._channel, self._chunks = self._read_index(self._file)
        except (*_DAMAGE, RecordingError) as error:
            self._file.close()
            raise RecordingError(f"{path} has no index ({error})") from None

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def at(self, time_ns: int) -> Depth | None:
        """The picture of a time, or None where the index knows none.

        Args:
            time_ns: the frame's time, ns, as in the table `frames`.

        Returns:
            (H, W) uint16 mm, 0 where unread.
        """
        chunks = self._chunks
        with self._lock:
            for k in np.flatnonzero((chunks[:, 0] <= time_ns) & (time_ns <= chunks[:, 1])):
                try:
                    found = self._in_chunk(self._unpacked(int(chunks[k, 2])), time_ns)
                except _DAMAGE:
                    continue
                if found is not None:
                    return found
        return None

    def _read_index(self, file: IO[bytes]) -> tuple[int, NDArray[np.int64]]:
        """Number of the depth channel, and of each chunk its first and last time and its place."""
        size = self._path.stat().st_size
        ending = size - _FOOTER.size - len(MAGIC)
        if ending < len(MAGIC) or file.read(len(MAGIC)) != MAGIC:
            raise RecordingError("it is not whole")
        file.seek(ending)
        opcode, _, at, _, _ = _FOOTER.unpack(file.read(_FOOTER.size))
        if opcode != Opcode.FOOTER or not 0 < at < ending or ending - at > _LARGEST_SUMMARY:
            raise RecordingError("it was not finished")
        file.seek(at)
        summary = file.read(ending - at)
        channel = -1
        chunks = []
        at = 0
        while at + _RECORD.size <= len(summary):
            opcode, length = _RECORD.unpack_from(summary, at)
            at += _RECORD.size
            if opcode == Opcode.CHUNK_INDEX:
                chunks.append(_INDEX.unpack_from(summary, at)[:3])
            elif opcode == Opcode.CHANNEL:
                number, _, n_name = struct.unpack_from("<HHI", summary, at)
                if summary[at + 8 : at + 8 + n_name] == TOPIC.encode():
                    channel = number
            at += length
        if channel < 0 or not chunks:
            raise RecordingError(f"it has no chunks of {TOPIC}")
        return channel, np.array(chunks, np.int64)

    def _unpacked(self, start: int) -> bytes:
        """The messages of the chunk whose record begins at `start`; the last one is kept."""
        if self._last[0] != start:
            self._file.seek(start)
            opcode, length = _RECORD.unpack(self._file.read(_RECORD.size))
            if opcode != Opcode.CHUNK or length > self._path.stat().st_size:
                raise ValueError("there is no chunk")
            record = self._file.read(length)
            *_, size, crc, n_name = _CHUNK.unpack_from(record)
            packed = _CHUNK.size + n_name
            (n_packed,) = struct.unpack_from("<Q", record, packed)
            content = record[packed + 8 : packed + 8 + n_packed]
            packing = record[_CHUNK.size : packed].decode()
            chunk = Chunk(start + packed + 8, n_packed, packing, size, crc, False)
            self._last = (start, unpacked(content, chunk))
        return self._last[1]

    def _in_chunk(self, data: bytes, time_ns: int) -> Depth | None:
        at = 0
        while at + _RECORD.size <= len(data):
            opcode, length = _RECORD.unpack_from(data, at)
            at += _RECORD.size
            if opcode == Opcode.MESSAGE:
                channel, _, log_ns, _ = _MESSAGE.unpack_from(data, at)
                if channel == self._channel and log_ns == time_ns:
                    message = self._parse(memoryview(data)[at + _MESSAGE.size : at + length])
                    if not isinstance(message, DepthMessage):
                        return None
                    depth = decode(message, self._camera, 1.0, 1.0)
                    return None if depth is None else np.asarray(depth, np.uint16)
            at += length
        return None
