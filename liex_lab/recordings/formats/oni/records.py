"""Record layer of PrimeSense's .oni container (OpenNI 2, versions 1.0.0.4 to 1.0.1.0).

A file header, then one record after the other: magic, kind, node, size of header and fields, size
of payload, and the position it undoes; little endian. Before 1.0.1.0, positions have 32 bits, then
64. A damaged file is read on from the next record magic that fits. Source: OpenNI2's own player.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Final, NamedTuple

from liex_lab.errors import RecordingError
from liex_lab.runtime.progress import Progress

FILE_MAGIC: Final = b"NI10"
FILE_HEADER: Final = struct.Struct(
    "<4sBBHIQI"
)  # magic, major, minor, maintenance, build, last time, highest node id
VERSION: Final = (1, 0, 1, 0)
# before 1.0.1.0, positions in the file have 32 bits
_OLDEST = (1, 0, 0, 4)
_FIRST_WIDE = (1, 0, 1, 0)

RECORD_MAGIC: Final = 0x0052494E  # "NIR" and a zero byte
HEADER: Final = struct.Struct(
    "<IIIIIQ"
)  # magic, kind, node, size of header and fields, of payload, position it undoes
_OLD_HEADER = struct.Struct("<IIIIII")
_OLD_NODE = 0x02
_NODE_5 = 0x0C
NODE = 0x0D
INTEGER = 0x03
REAL = 0x04
TEXT = 0x05
BYTES = 0x06
NODE_REMOVED = 0x07
DATA_BEGIN = 0x08
NODE_READY = 0x09
FRAME = 0x0A
END = 0x0B
SEEK_TABLE = 0x0E
NODES: Final = (_OLD_NODE, _NODE_5, NODE)
PROPERTIES: Final = (INTEGER, REAL, TEXT, BYTES)

DEPTH_NODE: Final = 2  # 1 is the device, 3 colour, 4 infrared
FRAME_FIELDS: Final = struct.Struct("<QI")  # time in µs, number of the frame, counted from 1
SEEK_ENTRY: Final = [
    ("time_us", "<u8"),
    ("configuration", "<u4"),
    ("at", "<u8"),
]  # of every frame, after an empty one
OLD_SEEK_ENTRY: Final = [("time_us", "<u8"), ("configuration", "<u4"), ("at", "<u4")]
_NODE_FIELDS = struct.Struct("<i4s")  # kind, codec
_NODE_COUNTS = struct.Struct("<IQQ")  # frames, first and last time
_KINDS = range(_OLD_NODE, SEEK_TABLE + 1)
_USUAL_FIELDS = 64
_MOST_FIELDS = 4096  # bytes that are looked at: names and numbers; whole tables are of no use here
_BLOCK = 1 << 20


class Record(NamedTuple):
    """One record of the file, whose end is where another begins.

    Attributes:
        kind: its kind, such as `FRAME` or `NODE`.
        node: number of the node it belongs to.
        fields: the bytes between its header and its payload (at most 4096 of them).
        payload: position of its payload in the file, bytes.
        payload_size: size of its payload, bytes.
    """

    kind: int
    node: int
    fields: bytes
    payload: int  # its position in the file
    payload_size: int


class _Head(NamedTuple):
    at: int
    kind: int
    node: int
    fields_size: int  # with the header
    payload_size: int
    fields: bytes

    @property
    def end(self) -> int:
        return self.at + self.fields_size + self.payload_size

    @property
    def record(self) -> Record:
        return Record(
            self.kind, self.node, self.fields, self.at + self.fields_size, self.payload_size
        )


@dataclass
class OniFile:
    """An open .oni file.

    Attributes:
        file: the file, without a buffer.
        size: its size, bytes.
        old: True where positions in it have 32 bits.
        whole: True where it ends as it should and nothing is damaged; known after a walk.
    """

    file: IO[bytes]
    size: int
    old: bool
    whole: bool = True

    @staticmethod
    def open(path: Path) -> OniFile:
        """Open a file that begins like .oni, of a version that is known.

        Args:
            path: the .oni file.

        Returns:
            The open file.

        Raises:
            RecordingError: it begins otherwise, or its version cannot be read.
        """
        # without a buffer: every read is a seek, and a buffer would fetch 8 kB for each 40 bytes
        file = path.open("rb", buffering=0)
        try:
            head = file.read(FILE_HEADER.size)
            if len(head) < FILE_HEADER.size or not head.startswith(FILE_MAGIC):
                raise RecordingError(
                    f"{path} is named like an .oni file but holds something else; give another file"
                )
            version = FILE_HEADER.unpack(head)[1:5]
            if not _OLDEST <= version <= VERSION:
                raise RecordingError(
                    f"{path} says that it is of version {'.'.join(map(str, version))} of its "
                    "format, and versions 1.0.0.4 to 1.0.1.0 can be read; record it again with "
                    "OpenNI2, or copy it again if it is damaged"
                )
        except BaseException:
            file.close()
            raise
        return OniFile(file, path.stat().st_size, old=version < _FIRST_WIDE)

    def read(self, at: int, size: int) -> bytes:
        """Bytes at a position, fewer where the file ends.

        Args:
            at: position in the file, bytes.
            size: how many bytes.

        Returns:
            At most `size` bytes.
        """
        self.file.seek(at)
        return self.file.read(size)

    def walk(self, progress: Progress) -> Iterator[Record]:
        """Every record, in file order; where one is damaged, from the next that can be found.

        A record counts only if another one, or the end of the file, begins where it ends. The last
        one of a cut file is left out.

        Args:
            progress: told how many MB were walked over.

        Yields:
            The records, first to last.
        """
        head = self._search(FILE_HEADER.size)
        ended = False
        told = -1
        self.whole = head is not None and head.at == FILE_HEADER.size
        while head is not None:
            ended = head.kind == END
            nearest = self._head(head.end) if head.end < self.size else None
            if nearest is None and head.end != self.size:
                nearest = self._search(head.at + self._header.size)
                if nearest is None and (ended or head.end > self.size):
                    break  # some bytes after the end, or the record that was cut
                self.whole = False
                if (
                    nearest is not None and nearest.at < head.end
                ):  # its own size is damaged, not its neighbour
                    head = head._replace(
                        payload_size=max(0, nearest.at - head.at - head.fields_size)
                    )
            yield head.record
            if head.end >> 20 != told:
                told = head.end >> 20
                progress(told, (self.size >> 20) + 1, "looking through the recording (MB)")
            head = nearest
        self.whole = self.whole and ended

    def record_at(self, at: int) -> Record | None:
        """The record that begins at a position.

        Args:
            at: position in the file, bytes.

        Returns:
            The record; None where none begins there, or it reaches past the end of the file.
        """
        head = self._head(at) if FILE_HEADER.size <= at < self.size else None
        return head.record if head is not None and head.end <= self.size else None

    @property
    def end_at(self) -> int:
        """Position at which the closing record of a whole file begins, bytes."""
        return self.size - self._header.size

    @property
    def _header(self) -> struct.Struct:
        return _OLD_HEADER if self.old else HEADER

    def _head(self, at: int) -> _Head | None:
        header = self._header
        raw = self.read(at, header.size + _USUAL_FIELDS)
        if len(raw) < header.size:
            return None
        magic, kind, node, fields_size, payload_size, _ = header.unpack_from(raw)
        size = fields_size - header.size
        if (
            magic != RECORD_MAGIC
            or kind not in _KINDS
            or size < 0
            or (kind == FRAME and size != FRAME_FIELDS.size)
        ):
            return None
        if size > len(raw) - header.size:
            raw = self.read(at, header.size + min(size, _MOST_FIELDS))
        return _Head(
            at, kind, node, fields_size, payload_size, raw[header.size : header.size + size]
        )

    def _search(self, start: int) -> _Head | None:
        """The first record from a position on that lies within the file."""
        magic = RECORD_MAGIC.to_bytes(4, "little")
        while start + self._header.size <= self.size:
            block = self.read(start, _BLOCK)
            found = block.find(magic)
            while found >= 0:
                head = self._head(start + found)
                if head is not None and head.end <= self.size:
                    return head
                found = block.find(magic, found + 1)
            start += max(1, len(block) - len(magic) + 1)
        return None

    def close(self) -> None:
        """Close the file."""
        self.file.close()


def parse_node(record: Record) -> tuple[str, int, bytes, int | None, int]:
    """Description of a node out of its record.

    Args:
        record: a record of one of the kinds `NODES`.

    Returns:
        Its name, its kind (2: depth), its codec, its number of frames (None where not stated), and
        the position of its seek table (0: none).
    """
    name, rest = take_text(record.fields)
    kind, codec = _NODE_FIELDS.unpack_from(rest)
    if record.kind == _OLD_NODE:
        return name, kind, codec, None, 0
    n_frames, *_ = _NODE_COUNTS.unpack_from(rest, _NODE_FIELDS.size)
    after = rest[_NODE_FIELDS.size + _NODE_COUNTS.size :]
    # the field has the width of the file's positions
    seek_table = int.from_bytes(after[:8], "little") if record.kind == NODE else 0
    return name, kind, codec, None if n_frames == 0xFFFFFFFF else n_frames, seek_table


def parse_property(record: Record) -> tuple[str, bytes]:
    """Name and value of a property.

    Args:
        record: a record of one of the kinds `PROPERTIES`.

    Returns:
        The name and the bytes of the value.
    """
    name, rest = take_text(record.fields)
    (size,) = struct.unpack_from("<I", rest)
    return name, rest[4 : 4 + size]


def text(name: str) -> bytes:
    """A string as the file holds it: its length with the closing zero, and then its bytes.

    Args:
        name: the string, ASCII.

    Returns:
        The bytes.
    """
    return struct.pack("<I", len(name) + 1) + name.encode("ascii") + b"\0"


def take_text(fields: bytes) -> tuple[str, bytes]:
    """A string at the beginning of some fields, and what follows it.

    Args:
        fields: bytes that begin with a string as `text` writes it.

    Returns:
        The string and the remaining bytes.
    """
    (size,) = struct.unpack_from("<I", fields)
    return fields[4 : 4 + size].split(b"\0")[0].decode("latin-1"), fields[4 + size :]
