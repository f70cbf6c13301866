"""Record layer and index of PrimeSense's .oni container (OpenNI 2, versions 1.0.0.4 to 1.0.1.0).

A file header, then one record after the other: magic, kind, node, size of header and fields, size
of payload, and the position it undoes; little endian. Before 1.0.1.0, positions have 32 bits, then
64. The index comes from a scan of all records, which shows what is whole; the seek table is not
used. A damaged file is read on from the next record magic that fits. Source: OpenNI2's own player.
"""

from __future__ import annotations

import struct
from array import array
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any, NamedTuple

from liex_lab.errors import RecordingError
from liex_lab.runtime.progress import Progress

_FILE_MAGIC = b"NI10"
_FILE_HEADER = struct.Struct("<4sBBHIQI")  # magic, version (4 numbers), last time, highest node id
_OLDEST = (1, 0, 0, 4)
_NEWEST = (1, 0, 1, 0)  # before it, positions in the file have 32 bits

_RECORD_MAGIC = 0x0052494E  # "NIR" and a zero byte
_HEADER = struct.Struct("<IIIIIQ")
_OLD_HEADER = struct.Struct("<IIIIII")
_OLD_NODE = 0x02
_NODES = (_OLD_NODE, 0x0C, 0x0D)
_PROPERTIES = (0x03, 0x04, 0x05, 0x06)  # integer, real, text, bytes
_FRAME = 0x0A
_END = 0x0B
_KINDS = range(_OLD_NODE, 0x0F)
_DEPTH_NODE = 2  # 1 is the device, 3 colour, 4 infrared
_FRAME_FIELDS = struct.Struct("<QI")  # time in µs, number of the frame, counted from 1
_NODE_FIELDS = struct.Struct("<i4s")  # kind, codec
_UNKNOWN_COUNT = 0xFFFFFFFF
_USUAL_FIELDS = 64
_MOST_FIELDS = 4096  # bytes that are read of names and numbers
_BLOCK = 1 << 20

MODE = "xnMapOutputMode"
CROPPING = "xnCropping"
MIRROR = "xnMirror"
UNIT = "oniPixelFormat"
FIELD_OF_VIEW = "xnFOV"
OLD_LENS = "xnRealWorldTranslationData"
PLANE_DISTANCE = "ZPD"
PLANE_PIXEL = "ZPPS"
# fx, fy, cx, cy: the format itself knows no optical axis, and earlier versions of liex wrote it
INTRINSICS = "liexIntrinsics"
_OF_FORMAT = (MODE, CROPPING, MIRROR, UNIT)
_USED = (*_OF_FORMAT, FIELD_OF_VIEW, OLD_LENS, PLANE_DISTANCE, PLANE_PIXEL, INTRINSICS)
_LARGEST_VALUE = 64  # bytes; the properties that are used have at most 32
_MANY = 100
_MILLIMETRES = 100  # the pixel format if none is stated


class Record(NamedTuple):
    """One record; `size` is that of its header and fields, of which 4096 bytes are read."""

    at: int
    kind: int
    node: int
    size: int
    payload_size: int
    fields: bytes

    @property
    def payload(self) -> int:
        """Position of its payload in the file, bytes."""
        return self.at + self.size

    @property
    def end(self) -> int:
        """Position at which the next record begins, bytes."""
        return self.payload + self.payload_size


class OniFile:
    """An open .oni file.

    Attributes:
        size: its size, bytes.
        whole: True if it ends as it should and nothing is damaged; known after a walk.
    """

    def __init__(self, path: Path) -> None:
        """Open a file.

        Raises:
            RecordingError: it is not an .oni file, or its version cannot be read.
        """
        # without a buffer: every read is a seek, and a buffer would fetch 8 kB for each 40 bytes
        self._file: IO[bytes] = path.open("rb", buffering=0)
        self.size = path.stat().st_size
        self.whole = True
        head = self._file.read(_FILE_HEADER.size)
        version = _FILE_HEADER.unpack(head)[1:5] if len(head) == _FILE_HEADER.size else (0,)
        self._header = _OLD_HEADER if version < _NEWEST else _HEADER
        if version == (0,) or not head.startswith(_FILE_MAGIC):
            self.close()
            raise RecordingError(
                f"{path} is named like an .oni file but holds something else; give another file"
            )
        if not _OLDEST <= version <= _NEWEST:
            self.close()
            raise RecordingError(
                f"{path} says that it is of version {'.'.join(map(str, version))} of its format, "
                "and versions 1.0.0.4 to 1.0.1.0 can be read; record it again with OpenNI2, or "
                "copy it again if it is damaged"
            )

    def read(self, at: int, size: int) -> bytes:
        """At most `size` bytes at a position, fewer at the end of the file."""
        self._file.seek(at)
        return self._file.read(size)

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def walk(self, progress: Progress) -> Iterator[Record]:
        """Every record in file order, continued after damage at the next record that can be found.

        A record counts only if another one, or the end of the file, begins where it ends. The last
        one of a cut file is left out.
        """
        record = self._search(_FILE_HEADER.size)
        ended = False
        reported = -1
        self.whole = record is not None and record.at == _FILE_HEADER.size
        while record is not None:
            ended = record.kind == _END
            following = self._record_at(record.end) if record.end < self.size else None
            if following is None and record.end != self.size:
                following = self._search(record.at + self._header.size)
                if following is None and (ended or record.end > self.size):
                    break  # some bytes after the end, or the record that was cut
                self.whole = False
                # its own size is damaged, not its neighbour
                if following is not None and following.at < record.end:
                    size = max(0, following.at - record.payload)
                    record = record._replace(payload_size=size)
            yield record
            if record.end >> 20 != reported:
                reported = record.end >> 20
                progress(reported, (self.size >> 20) + 1, "looking through the recording (MB)")
            record = following
        self.whole = self.whole and ended

    def _record_at(self, at: int) -> Record | None:
        header = self._header
        raw = self.read(at, header.size + _USUAL_FIELDS)
        if len(raw) < header.size:
            return None
        magic, kind, node, size, payload_size, _ = header.unpack_from(raw)
        n_fields = size - header.size
        if magic != _RECORD_MAGIC or kind not in _KINDS or n_fields < 0:
            return None
        if kind == _FRAME and n_fields != _FRAME_FIELDS.size:
            return None
        if n_fields > len(raw) - header.size:
            raw = self.read(at, header.size + min(n_fields, _MOST_FIELDS))
        return Record(at, kind, node, size, payload_size, raw[header.size : size])

    def _search(self, start: int) -> Record | None:
        """The first record from a position on that lies within the file."""
        magic = _RECORD_MAGIC.to_bytes(4, "little")
        while start + self._header.size <= self.size:
            block = self.read(start, _BLOCK)
            found = block.find(magic)
            while found >= 0:
                record = self._record_at(start + found)
                if record is not None and record.end <= self.size:
                    return record
                found = block.find(magic, found + 1)
            start += max(1, len(block) - len(magic) + 1)
        return None


@dataclass(frozen=True)
class FrameFormat:
    """Format of some frames.

    Attributes:
        width: columns of the full frame, px.
        height: rows of the full frame, px.
        part: x, y, width, height of what was recorded of it, px.
        mirrored: True if left and right are exchanged.
        pixel_format: OpenNI's number for the unit (100: 1 mm, 101: 0.1 mm).
        fps: stated, not measured, frame rate, Hz.
    """

    width: int
    height: int
    part: tuple[int, int, int, int]
    mirrored: bool
    pixel_format: int
    fps: int

    @property
    def constant(self) -> tuple[int, int, int]:
        """What may not change within a recording: width, height and unit."""
        return self.width, self.height, self.pixel_format


@dataclass
class DepthNode:
    """A depth camera of the file, with one entry for each of its frames.

    Attributes:
        name: name of the node, such as "Depth".
        codec: four bytes, `NONE`, `16zT` or `16zP`.
        n_stated: number of frames by the node's own count; None if not stated.
        properties: the property values that hold now, by name.
        times_us: (n,) time of each frame, µs.
        positions: (n,) position of each payload, bytes.
        sizes: (n,) size of each payload, bytes.
        format_of: (n,) number of each frame's format in `formats`.
        formats: the frame formats with their numbers; None is one whose size was never stated.
    """

    name: str
    codec: bytes
    n_stated: int | None
    properties: dict[str, bytes] = field(default_factory=dict)
    times_us: array[int] = field(default_factory=lambda: array("Q"))
    positions: array[int] = field(default_factory=lambda: array("q"))
    sizes: array[int] = field(default_factory=lambda: array("q"))
    format_of: array[int] = field(default_factory=lambda: array("I"))
    formats: dict[FrameFormat | None, int] = field(default_factory=dict)
    _format_now: int | None = None

    def __len__(self) -> int:
        return len(self.positions)

    def set_property(self, name: str, value: bytes) -> None:
        """Note a property, which holds from here on."""
        self.properties[name] = value
        if name in _OF_FORMAT:
            self._format_now = None

    def add(self, record: Record) -> None:
        """Note a frame."""
        if self._format_now is None:
            self._format_now = self.formats.setdefault(self._format(), len(self.formats))
        self.times_us.append(_FRAME_FIELDS.unpack(record.fields)[0])
        self.positions.append(record.payload)
        self.sizes.append(record.payload_size)
        self.format_of.append(self._format_now)

    def number(self, name: str) -> int | None:
        """Value of an integer property; None if it is not stated."""
        value = self.properties.get(name)
        return int.from_bytes(value[:8], "little") if value else None

    def numbers(self, name: str, layout: str) -> tuple[Any, ...] | None:
        """Numbers of a property by their `struct` layout; None if absent or of another size."""
        value = self.properties.get(name, b"")
        return struct.unpack(layout, value) if len(value) == struct.calcsize(layout) else None

    def _format(self) -> FrameFormat | None:
        mode = self.numbers(MODE, "<III")
        if mode is None:
            return None
        width, height, fps = mode
        cropped, *crop = self.numbers(CROPPING, "<IHHHH") or (0,)
        part = (crop[0], crop[1], crop[2], crop[3]) if cropped else (0, 0, width, height)
        unit = self.number(UNIT)
        pixel_format = _MILLIMETRES if unit is None else unit
        return FrameFormat(width, height, part, bool(self.number(MIRROR)), pixel_format, fps)


def index_file(file: OniFile, progress: Progress) -> tuple[list[DepthNode], set[str]]:
    """The depth nodes, and the names of at most 100 other nodes.

    The file's `whole` says afterwards whether anything was damaged.
    """
    depth: dict[int, DepthNode] = {}
    others: set[str] = set()
    sound = True
    for record in file.walk(progress):
        try:
            if record.kind in _NODES:
                name, rest = _text(record.fields)
                kind, codec = _NODE_FIELDS.unpack_from(rest)
                n_stated = _UNKNOWN_COUNT
                if record.kind != _OLD_NODE:
                    n_stated, *_ = struct.unpack_from("<IQQ", rest, _NODE_FIELDS.size)
                if kind == _DEPTH_NODE:
                    stated = None if n_stated == _UNKNOWN_COUNT else n_stated
                    depth.setdefault(record.node, DepthNode(name, codec, stated))
                elif len(others) < _MANY:
                    others.add(name)
            elif (node := depth.get(record.node)) is None:
                continue
            elif record.kind in _PROPERTIES:
                name, rest = _text(record.fields)
                (size,) = struct.unpack_from("<I", rest)
                if name in _USED and len(value := rest[4 : 4 + size]) <= _LARGEST_VALUE:
                    node.set_property(name, value)
            elif record.kind == _FRAME and record.payload_size:
                node.add(record)
        except struct.error:
            sound = False
    file.whole = file.whole and sound
    return list(depth.values()), others


def _text(fields: bytes) -> tuple[str, bytes]:
    """A string at the beginning of some fields, with its length before it, and what follows it."""
    (size,) = struct.unpack_from("<I", fields)
    return fields[4 : 4 + size].split(b"\0")[0].decode("latin-1"), fields[4 + size :]
