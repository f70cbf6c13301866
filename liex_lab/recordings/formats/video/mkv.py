"""Index of a Matroska (EBML) file: one walk over its elements.

No cues are needed, so cut files can be read, too.

A picture's time is (cluster time + block time) * timecode scale. Laced blocks, which no recorder of
depth makes, count as damage.
"""

from __future__ import annotations

import struct
from array import array
from collections.abc import Iterator
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import IO, NamedTuple

import numpy as np

from liex_lab.errors import RecordingError
from liex_lab.recordings.formats.video.index import FFV1, RAW, DepthTrack
from liex_lab.recordings.infrared import is_infrared
from liex_lab.recordings.timestamps import LIMIT_NS
from liex_lab.runtime.progress import Progress

_MAGIC = b"\x1aE\xdf\xa3"
_SEGMENT = 0x18538067
_CLUSTER = 0x1F43B675
_GROUP = 0xA0
_STEPPED_INTO = (
    _SEGMENT,
    _CLUSTER,
    _GROUP,
)  # a live recording leaves their sizes open, so none is relied on
_INFO = 0x1549A966
_TRACKS = 0x1654AE6B
_TAGS = 0x1254C367
_ATTACHMENTS = 0x1941A469
_CLUSTER_TIME = 0xE7
_SIMPLE_BLOCK = 0xA3
_BLOCK = 0xA1
_PASSED_OVER = (
    0x1A45DFA3,
    0x114D9B74,
    0x1C53BB6B,
    0x1043A770,
    0xEC,
    0xBF,  # file head, seek head, cues, chapters, void, CRC
    0xA7,
    0xAB,
    0x5854,
    0x9B,
    0xFB,
    0xFA,
    0xA4,
    0x75A1,
    0x75A2,
    0x8E,  # within clusters and block groups
)
_NUMBER = 0xD7
_UID = 0x73C5
_TYPE = 0x83
_NAME = 0x536E
_CODEC = 0x86
_PRIVATE = 0x63A2
_VIDEO = 0xE0
_ENCODINGS = 0x6D80
_WIDTH = 0xB0
_HEIGHT = 0xBA
_COLOUR_SPACE = 0x2EB524
_HEADER_BYTES = 1 << 22
_LACING = 0x06  # flags of a block that holds several pictures, which no recorder of depth makes
_MOST_TICKS = 2**60  # a clock beyond that is damage
_DAY_ONE = datetime(2001, 1, 1, tzinfo=UTC)  # from which Matroska counts


class _Element(NamedTuple):
    id: int
    start: int
    size: int  # -1: open


@dataclass
class _Track:
    """One entry of the tracks."""

    number: int
    uid: int
    is_video: bool
    name: str
    depth: DepthTrack = field(default_factory=DepthTrack)


def index_mkv(path: Path, progress: Progress) -> DepthTrack:
    """Find the depth track of a Matroska file and its pictures.

    It is the track titled or tagged DEPTH, else the first of 16-bit grey pictures.

    Args:
        path: the .mkv file.
        progress: told how many MB were walked over.

    Returns:
        Where its pictures lie and when they were taken.

    Raises:
        RecordingError: the file is no Matroska file, or holds no video track.
    """
    size = path.stat().st_size
    found = _Walk()
    with path.open("rb", buffering=0) as file:
        if file.read(4) != _MAGIC:
            raise RecordingError(
                f"{path} is named like a Matroska video but holds something else; give another file"
            )
        for element in _elements(file, 0, size, found):
            found.take(file, element)
            progress(element.start >> 20, (size >> 20) + 1, "looking through the video (MB)")
    track = found.depth_track(path)
    depth = track.depth
    pictures = np.array(found.pictures.get(track.number, []), np.int64).reshape(-1, 3)
    if depth.codec in RAW:  # a picture of another length is the first sign of damage
        good = pictures[:, 1] == 2 * depth.width * depth.height
        pictures = pictures[: len(good) if good.all() else int(np.argmin(good))]
        found.whole = found.whole and bool(good.all())
    depth.offsets = pictures[:, 0].tolist()
    depth.sizes = pictures[:, 1].tolist()
    limit = LIMIT_NS // found.scale_ns
    depth.times_ns = np.clip(pictures[:, 2], -limit, limit) * found.scale_ns
    depth.tags = {name: value for (uid, name), value in found.tags.items() if uid in (0, track.uid)}
    depth.attachments = found.attachments
    depth.whole = found.whole
    depth.session_start = found.start
    return depth


class _Walk:
    """What has been met so far.

    Attributes:
        tracks: the entries of the tracks.
        pictures: offset, size, time in ticks, offset, ... by track number.
        tags: by (track uid or 0, name).
        attachments: bytes of attached files by name.
        scale_ns: ns in a tick.
        whole: True while nothing was found cut or damaged.
        start: ISO 8601 of the recording's date, where stated.
    """

    def __init__(self) -> None:
        self.tracks: list[_Track] = []
        self.pictures: dict[int, array[int]] = {}
        self.tags: dict[tuple[int, str], str] = {}
        self.attachments: dict[str, bytes] = {}
        self.scale_ns = 10**6
        self.whole = True
        self.start: str | None = None
        self._cluster_time = 0

    def take(self, file: IO[bytes], element: _Element) -> None:
        """Note one element.

        Args:
            file: the open file.
            element: its id, position and size.
        """
        if element.id in (_SIMPLE_BLOCK, _BLOCK):
            self._take_block(file, element)
        elif element.id in (_CLUSTER_TIME, _INFO, _TRACKS, _TAGS, _ATTACHMENTS):
            if element.size > _HEADER_BYTES:
                self.whole = False
                return
            file.seek(element.start)
            data = file.read(element.size)
            if element.id == _CLUSTER_TIME:
                self._cluster_time = int.from_bytes(data[-8:], "big")
            elif element.id == _INFO:
                self._take_info(_table(data))
            elif element.id == _TRACKS:
                self.tracks = [_read_track(entry) for entry in _table(data).get(0xAE, [])]
            elif element.id == _TAGS:
                self._take_tags(data)
            else:
                for attached in _table(data).get(0x61A7, []):
                    table = _table(attached)
                    self.attachments[_text(table, 0x466E)] = table.get(0x465C, [b""])[0]

    def _take_block(self, file: IO[bytes], element: _Element) -> None:
        file.seek(element.start)
        head = file.read(min(11, element.size))
        number, at = _vint(head, 0)
        if number < 0 or len(head) < at + 3:
            self.whole = False
            return
        ticks, flags = struct.unpack_from(">hB", head, at)
        if flags & _LACING:
            self.whole = False
            return
        if self._cluster_time < _MOST_TICKS:
            picture = (element.start + at + 3, element.size - at - 3, self._cluster_time + ticks)
            self.pictures.setdefault(number, array("q")).extend(picture)

    def _take_info(self, info: dict[int, list[bytes]]) -> None:
        self.scale_ns = _number(info, 0x2AD7B1) or 10**6
        if len(date := info.get(0x4461, [b""])[0]) == 8:
            elapsed_us = int.from_bytes(date, "big", signed=True) // 1000
            if 0 < elapsed_us < 10**15:
                self.start = (_DAY_ONE + timedelta(microseconds=elapsed_us)).isoformat()

    def _take_tags(self, data: bytes) -> None:
        for tag in _table(data).get(0x7373, []):
            inner = _table(tag)
            uid = _number(_table(inner.get(0x63C0, [b""])[0]), 0x63C5)
            for simple in inner.get(0x67C8, []):
                table = _table(simple)
                self.tags[uid, _text(table, 0x45A3)] = _text(table, 0x4487)

    def depth_track(self, path: Path) -> _Track:
        """The track that holds the depth.

        Args:
            path: the file, for the sentence.

        Returns:
            The track titled or tagged DEPTH, else the first of 16-bit grey pictures that is not
            titled as infrared, else the first of them or the first video.

        Raises:
            RecordingError: there is no video track.
        """
        videos = [track for track in self.tracks if track.is_video]
        tagged = {uid for uid, name in self.tags if name == "K4A_DEPTH_TRACK"}
        titled = [track for track in videos if track.name.upper() == "DEPTH" or track.uid in tagged]
        grey = [track for track in videos if track.depth.codec == FFV1 or track.depth.codec in RAW]
        visible = [track for track in grey if not is_infrared(track.name)]
        for some in (titled, visible, grey, videos):
            if some:
                some[0].depth.title = "DEPTH" if titled else some[0].name
                return some[0]
        raise RecordingError(
            f"{path} holds no video track, or is cut short before it is named; give a recording "
            "with depth"
        )


def _elements(file: IO[bytes], at: int, size: int, found: _Walk) -> Iterator[_Element]:
    """Every element that lies whole in the file, in order; says where the file breaks off or makes
    no sense.
    """
    while at < size:
        file.seek(at)
        head = file.read(12)
        id, after = _id(head)
        length, start = _vint(head, after)
        element = _Element(id, at + start, length)
        known = id in _STEPPED_INTO or id in _PASSED_OVER
        known = known or id in (
            _CLUSTER_TIME,
            _SIMPLE_BLOCK,
            _BLOCK,
            _INFO,
            _TRACKS,
            _TAGS,
            _ATTACHMENTS,
        )
        if not known or (length < 0 and id not in _STEPPED_INTO):
            found.whole = False
            return
        if id in _STEPPED_INTO:
            found.whole = found.whole and element.start + length <= size
            at = element.start
            continue
        if element.start + length > size:
            found.whole = False
            return
        yield element
        at = element.start + length


def _id(data: bytes) -> tuple[int, int]:
    """The id that data begin with, and where it ends; 0 where there is none."""
    n = 9 - data[0].bit_length() if data and data[0] else 9
    return (int.from_bytes(data[:n], "big"), n) if n <= 4 and len(data) >= n else (0, 0)


def _vint(data: bytes, at: int) -> tuple[int, int]:
    """The number of variable length at `at`, and where it ends; -1 where it is open or missing."""
    if at >= len(data) or not data[at]:
        return -1, at
    n = 9 - data[at].bit_length()
    value = int.from_bytes(data[at : at + n], "big") & ((1 << 7 * n) - 1)
    if at + n > len(data) or value == (1 << 7 * n) - 1:
        return -1, at + n
    return value, at + n


def _table(data: bytes) -> dict[int, list[bytes]]:
    """The children of an element by id, as far as they make sense."""
    table: dict[int, list[bytes]] = {}
    at = 0
    while at < len(data):
        id, after = _id(data[at : at + 4])
        length, start = _vint(data, at + after)
        if not id or length < 0 or start + length > len(data):
            break
        table.setdefault(id, []).append(data[start : start + length])
        at = start + length
    return table


def _number(table: dict[int, list[bytes]], id: int) -> int:
    return int.from_bytes(table.get(id, [b""])[0][-8:], "big")


def _text(table: dict[int, list[bytes]], id: int) -> str:
    return table.get(id, [b""])[0].decode("utf-8", "replace").rstrip("\0")


def _read_track(entry: bytes) -> _Track:
    table = _table(entry)
    track = _Track(
        _number(table, _NUMBER),
        _number(table, _UID),
        _number(table, _TYPE) == 1,
        _text(table, _NAME),
    )
    depth = track.depth
    codec = _text(table, _CODEC)
    private = table.get(_PRIVATE, [b""])[0]
    if codec == "V_MS/VFW/FOURCC":
        depth.take_bitmap_header(private)
    video = _table(table.get(_VIDEO, [b""])[0])
    depth.width = _number(video, _WIDTH)
    depth.height = _number(video, _HEIGHT)
    if codec == "V_FFV1":
        depth.codec = FFV1
        depth.private = private
    elif codec == "V_UNCOMPRESSED":
        depth.codec = _text(video, _COLOUR_SPACE)
    elif not depth.codec:
        depth.codec = codec
    if _ENCODINGS in table:
        depth.codec = f"{codec} with a further packing"
    return track
