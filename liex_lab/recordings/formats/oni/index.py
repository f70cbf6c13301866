"""What is in an .oni file: its depth nodes, how each looked at the scene, and where its
frames lie.
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
# there the seek
# table is believed where it can be. Everywhere else the records themselves say what is whole.
SCAN_UP_TO_BYTES = 1 << 30


@dataclass(frozen=True)
class Look:
    """How frames were taken. width, height: of the full picture; part: x, y, width, height of what
    was recorded of it.

    pixel_format: OpenNI's number for the unit; fps: as stated, not as it was.
    """

    width: int
    height: int
    part: tuple[int, int, int, int]
    mirrored: bool
    pixel_format: int
    fps: int

    @property
    def picture(self) -> tuple[int, int, int]:
        """What may not change within a recording: size and unit."""
        return self.width, self.height, self.pixel_format


@dataclass
class DepthNode:
    """A depth camera of the file. One entry for each of its frames: time, place and size of its
    payload, its look.

    A size of -1 is not known yet: then the place is that of the record. looks: each with its number
    in `look_of`, None where a picture size was never stated; n_stated: frames by the node's own
    count.
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
        """Take a property, which holds from here on."""
        self.properties[name] = value
        if name in _OF_LOOK:
            self._look_now = None

    def add(self, time_us: int, place: int, size: int) -> None:
        """Note a frame."""
        if self._look_now is None:
            self._look_now = self.looks.setdefault(self._look(), len(self.looks))
        self.times_us.append(time_us)
        self.places.append(place)
        self.sizes.append(size)
        self.look_of.append(self._look_now)

    def number(self, name: str) -> int | None:
        """An integer property; None where it is not stated."""
        value = self.properties.get(name)
        return int.from_bytes(value[:8], "little") if value else None

    def numbers(self, name: str, layout: str) -> tuple[Any, ...] | None:
        """A property of several numbers; None where it is not stated or has another size."""
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
    """depth: the depth nodes by their number; others: what else is in the file, by name."""

    depth: dict[int, DepthNode] = field(default_factory=dict)
    others: set[str] = field(default_factory=set)

    def take(self, record: Record) -> bool:
        """Note what a record says; False where it makes no sense."""
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
    """The index of a file; `file.whole` says afterwards whether anything was damaged."""
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
