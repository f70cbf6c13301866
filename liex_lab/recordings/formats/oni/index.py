"""Index of an .oni file: its depth nodes, the stated picture format, and where each frame lies.

A file of up to 1 GiB is indexed by walking over its records, which shows what is whole; a larger
one by its seek tables, where they can be believed, because a walk takes minutes on a slow disk.
"""

from __future__ import annotations

import struct
from array import array
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from liex_lab.recordings.formats.oni.records import (
    DEPTH_NODE,
    END,
    FRAME,
    FRAME_FIELDS,
    NODES,
    OLD_SEEK_ENTRY,
    PROPERTIES,
    SEEK_ENTRY,
    SEEK_TABLE,
    OniFile,
    Record,
    parse_node,
    parse_property,
)
from liex_lab.runtime.progress import Progress

MODE = "xnMapOutputMode"
CROPPING = "xnCropping"
MIRROR = "xnMirror"
UNIT = "oniPixelFormat"
FIELD_OF_VIEW = "xnFOV"
OLD_LENS = "xnRealWorldTranslationData"
PLANE_DISTANCE = "ZPD"
PLANE_PIXEL = "ZPPS"
INTRINSICS = "liexIntrinsics"  # ours: fx, fy, cx, cy, for the format itself knows no optical axis
_OF_LOOK = (MODE, CROPPING, MIRROR, UNIT)
_WANTED = (*_OF_LOOK, FIELD_OF_VIEW, OLD_LENS, PLANE_DISTANCE, PLANE_PIXEL, INTRINSICS)
_LARGEST_VALUE = 64  # bytes; those that are wanted have at most 32
_MANY = 100
_MILLIMETRES = 100  # the pixel format that holds where none is stated

# A file of an hour has several GB, and looking at each of its records takes minutes on a slow disk:
# there the seek table is believed where it can be. Everywhere else the records themselves say what
# is whole.
SCAN_UP_TO_BYTES = 1 << 30


@dataclass(frozen=True)
class Look:
    """Picture format of frames: full size, recorded part, mirroring and unit.

    Attributes:
        width: columns of the full picture, px.
        height: rows of the full picture, px.
        part: x, y, width, height of what was recorded of it, px.
        mirrored: True where left and right are exchanged.
        pixel_format: OpenNI's number for the unit (100: 1 mm, 101: 0.1 mm).
        fps: frame rate as stated, not as it was, Hz.
    """

    width: int
    height: int
    part: tuple[int, int, int, int]
    mirrored: bool
    pixel_format: int
    fps: int

    @property
    def picture(self) -> tuple[int, int, int]:
        """What may not change within a recording: width, height and unit."""
        return self.width, self.height, self.pixel_format


@dataclass
class DepthNode:
    """A depth camera of the file, with one entry for each of its frames.

    Attributes:
        name: name of the node, such as "Depth".
        codec: four bytes, `NONE`, `16zT` or `16zP`.
        n_stated: number of frames by the node's own count; None where not stated.
        seek_table: position of its seek table in the file; 0 for none.
        properties: the property values that hold now, by name.
        times_us: (n,) time of each frame, µs.
        places: (n,) position of each payload, or of the record where the size is -1, bytes.
        sizes: (n,) size of each payload, bytes; -1 while it is not known.
        look_of: (n,) number of each frame's picture format in `looks`.
        looks: the picture formats with their numbers; None is one whose size was never stated.
    """

    name: str
    codec: bytes
    n_stated: int | None
    seek_table: int
    properties: dict[str, bytes] = field(default_factory=dict)
    times_us: array[int] = field(default_factory=lambda: array("Q"))
    places: array[int] = field(default_factory=lambda: array("q"))
    sizes: array[int] = field(default_factory=lambda: array("q"))
    look_of: array[int] = field(default_factory=lambda: array("I"))
    looks: dict[Look | None, int] = field(default_factory=dict)
    _look_now: int | None = None

    def __len__(self) -> int:
        return len(self.places)

    def state(self, name: str, value: bytes) -> None:
        """Take a property, which holds from here on.

        Args:
            name: its name.
            value: its bytes.
        """
        self.properties[name] = value
        if name in _OF_LOOK:
            self._look_now = None

    def add(self, time_us: int, place: int, size: int) -> None:
        """Note a frame.

        Args:
            time_us: its time, µs.
            place: position of its payload, or of its record where size is -1, bytes.
            size: size of its payload, bytes; -1 where it is not known.
        """
        if self._look_now is None:
            self._look_now = self.looks.setdefault(self._look(), len(self.looks))
        self.times_us.append(time_us)
        self.places.append(place)
        self.sizes.append(size)
        self.look_of.append(self._look_now)

    def number(self, name: str) -> int | None:
        """An integer property.

        Args:
            name: its name.

        Returns:
            Its value; None where it is not stated.
        """
        value = self.properties.get(name)
        return int.from_bytes(value[:8], "little") if value else None

    def numbers(self, name: str, layout: str) -> tuple[Any, ...] | None:
        """A property of several numbers.

        Args:
            name: its name.
            layout: the numbers, as `struct` writes their layout.

        Returns:
            The numbers; None where it is not stated or has another size.
        """
        value = self.properties.get(name, b"")
        return struct.unpack(layout, value) if len(value) == struct.calcsize(layout) else None

    def _look(self) -> Look | None:
        mode = self.numbers(MODE, "<III")
        if mode is None:
            return None
        cropped, *crop = self.numbers(CROPPING, "<IHHHH") or (0,)
        part = (crop[0], crop[1], crop[2], crop[3]) if cropped else (0, 0, mode[0], mode[1])
        unit = self.number(UNIT)
        return Look(
            mode[0],
            mode[1],
            part,
            bool(self.number(MIRROR)),
            _MILLIMETRES if unit is None else unit,
            mode[2],
        )


@dataclass
class OniIndex:
    """The nodes of a file.

    Attributes:
        depth: the depth nodes by their number.
        others: names of what else is in the file (at most 100).
    """

    depth: dict[int, DepthNode] = field(default_factory=dict)
    others: set[str] = field(default_factory=set)

    def take(self, record: Record) -> bool:
        """Note what a record says.

        Args:
            record: a record of the file, in file order.

        Returns:
            False where it makes no sense.
        """
        try:
            if record.kind in NODES:
                name, kind, codec, n_frames, seek_table = parse_node(record)
                if kind == DEPTH_NODE:
                    self.depth.setdefault(record.node, DepthNode(name, codec, n_frames, seek_table))
                elif len(self.others) < _MANY:
                    self.others.add(name)
            elif record.node in self.depth and record.kind in PROPERTIES:
                name, value = parse_property(record)
                if name in _WANTED and len(value) <= _LARGEST_VALUE:
                    self.depth[record.node].state(name, value)
            elif record.node in self.depth and record.kind == FRAME and record.payload_size:
                time_us, _ = FRAME_FIELDS.unpack(record.fields)
                self.depth[record.node].add(time_us, record.payload, record.payload_size)
        except struct.error:
            return False
        return True


def index_file(file: OniFile, progress: Progress) -> OniIndex:
    """Index a file; its `whole` says afterwards whether anything was damaged.

    Args:
        file: the open file.
        progress: told how many MB were walked over.

    Returns:
        The depth nodes with the positions of their frames.
    """
    if file.size > SCAN_UP_TO_BYTES:
        index = _by_seek_tables(file, progress)
        if index is not None:
            file.whole = True
            return index
    index = OniIndex()
    sound = True
    for record in file.walk(progress):
        sound = index.take(record) and sound
    file.whole = file.whole and sound
    return index


def _by_seek_tables(file: OniFile, progress: Progress) -> OniIndex | None:
    """The index from the tables of a file that was closed properly; None where they cannot be
    believed.
    """
    end = file.record_at(file.end_at)
    index = OniIndex()
    if end is None or end.kind != END:
        return None
    for record in file.walk(progress):
        if record.kind == FRAME:
            break
        index.take(record)
    for number, node in index.depth.items():
        table = _seek_table(file, number, node)
        if table is None:
            return None
        for time_us, at in zip(table["time_us"].tolist(), table["at"].tolist(), strict=True):
            node.add(time_us, at, -1)
    return index


def _seek_table(file: OniFile, number: int, node: DepthNode) -> NDArray[np.void] | None:
    """Time and position of every frame of a node; None where there is no table, or one that makes
    no sense.
    """
    record = file.record_at(node.seek_table)
    layout = np.dtype(OLD_SEEK_ENTRY if file.old else SEEK_ENTRY)
    if record is None or record.kind != SEEK_TABLE or not node.n_stated:
        return None
    if record.payload_size != (node.n_stated + 1) * layout.itemsize:
        return None
    table = np.frombuffer(file.read(record.payload, record.payload_size), layout)[1:]
    # with another configuration came other properties, which stand between the frames
    if np.any(table["configuration"] != table["configuration"][0]):
        return None
    at = table["at"].astype(np.int64)
    if np.any(np.diff(at) <= 0) or at[0] < 0:
        return None
    for row in (0, len(table) // 2, len(table) - 1):
        frame = file.record_at(int(at[row]))
        if frame is None or frame.kind != FRAME or frame.node != number:
            return None
        if FRAME_FIELDS.unpack(frame.fields)[0] != int(table["time_us"][row]):
            return None
    return table
