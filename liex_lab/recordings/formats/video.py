"""Random access to depth videos: FFV1 or raw 16-bit grey frames in AVI or Matroska.

PyAV reads the header (streams, tags, attachments). The frames are found by one walk over the chunks
of the file, which reads no frame data and needs no index, so cut files can be read as well. FFV1
frames depend on the previous ones back to the last key frame (one in twelve, usually): reading in
order decodes each once, random access decodes some more. AVI has a constant rate instead of times.
In Matroska a frame's time is (cluster time + block time) * timecode scale.
"""

from __future__ import annotations

import struct
from array import array
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import datetime
from fractions import Fraction
from pathlib import Path
from threading import Lock
from typing import IO, Any, NamedTuple

import av
import numpy as np
from numpy.typing import NDArray

from liex_lab.errors import RecordingError
from liex_lab.recordings.camera_file import is_infrared, refuse_infrared
from liex_lab.recordings.depth_kernels import crc_table, slices_agree
from liex_lab.recordings.formats.images.files import Stack, not_depth_error, too_large
from liex_lab.recordings.timestamps import LIMIT_NS
from liex_lab.runtime.progress import Progress

_FFV1 = "ffv1"
_RAW = {"gray16be": ">u2", "gray16le": "<u2"}  # FFmpeg's name of the pixels: NumPy's
# least start value of an FFV1 key frame: its first coded bit is 1
_KEY = 0x7F80
_N_PROBED = 3  # key frames, one of which must be depth: the first may be damaged

_CHUNK = struct.Struct("<4sI")  # name, length of what follows
_LISTS = (b"AVI ", b"AVIX", b"hdrl", b"strl", b"movi", b"rec ")  # traversed

_SEGMENT = 0x18538067
_CLUSTER = 0x1F43B675
_GROUP = 0xA0
_DESCENDED = (_SEGMENT, _CLUSTER, _GROUP)  # of unknown size in a live recording
_CLUSTER_TIME = 0xE7
_BLOCKS = (0xA3, 0xA1)
_OTHERS = (
    *(0x1A45DFA3, 0x114D9B74, 0x1C53BB6B, 0x1043A770, 0xEC, 0xBF),  # head, seek, cues, chapters ...
    *(0x1549A966, 0x1654AE6B, 0x1254C367, 0x1941A469),  # information, tracks, tags, attachments
    *(0xA7, 0xAB, 0x5854, 0x9B, 0xFB, 0xFA, 0xA4, 0x75A1, 0x75A2, 0x8E),  # in clusters and groups
)
_LACING = 0x06  # flags of a block with several frames, which depth recorders do not write
_MOST_TICKS = 2**60  # a clock beyond that is damage


@dataclass
class DepthTrack:
    """Header and frame index of the depth track of an AVI or a Matroska file.

    Attributes:
        width: columns of the frames, px.
        height: rows of the frames, px.
        dtype: type of raw numbers, ">u2" or "<u2"; "" for FFV1.
        private: the codec's own header.
        offsets: (n,) positions of the whole frames in the file, bytes.
        sizes: (n,) their sizes, bytes.
        times_ns: (n,) their times, ns.
        even: True if the times are steps of a constant rate, as the container has no others.
        whole: True if the file is complete and has the stated number of frames.
        tags: tags of the whole file and of the track.
        attachments: bytes of the attached files.
        session_start: ISO 8601 if the file states it.
    """

    width: int
    height: int
    dtype: str = ""
    private: bytes = b""
    offsets: array[int] = field(default_factory=lambda: array("q"))
    sizes: array[int] = field(default_factory=lambda: array("q"))
    times_ns: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    even: bool = False
    whole: bool = True
    tags: dict[str, str] = field(default_factory=dict)
    attachments: list[bytes] = field(default_factory=list)
    session_start: str | None = None


class _Span(NamedTuple):
    """Position of the payload of a chunk (AVI) or element (Matroska)."""

    id: Any
    start: int
    size: int


class _Walk:
    """The frames of one stream that were found so far."""

    def __init__(self, file: IO[bytes], size: int) -> None:
        self.file = file
        self.size = size
        self.whole = True
        self.offsets = array("q")
        self.sizes = array("q")
        self.ticks = array("q")
        self.n_slots = 0  # including dropped frames
        self._cluster_time = 0

    def avi(self, number: int) -> Iterator[_Span]:
        """Record the frames of one stream; yields every whole chunk of the file."""
        names = (b"%02ddc" % number, b"%02ddb" % number)
        for chunk in self._chunks():
            if chunk.id in names:
                if chunk.size:  # an empty chunk marks a dropped frame
                    self._add(chunk.start, chunk.size, self.n_slots)
                self.n_slots += 1
            yield chunk

    def mkv(self, number: int) -> Iterator[_Span]:
        """Record the frames of one track; yields every whole element of the file."""
        for element in self._elements():
            if element.id == _CLUSTER_TIME:
                self._cluster_time = int.from_bytes(self._read(element, 8), "big")
            elif element.id in _BLOCKS:
                head = self._read(element, 11)
                track, at = _vint(head, 0)
                if track < 0 or len(head) < at + 3:
                    self.whole = False
                    continue
                ticks, flags = struct.unpack_from(">hB", head, at)
                if flags & _LACING:
                    self.whole = False
                elif track == number and self._cluster_time < _MOST_TICKS:
                    at += 3
                    self._add(element.start + at, element.size - at, self._cluster_time + ticks)
            yield element

    def _add(self, offset: int, size: int, ticks: int) -> None:
        self.offsets.append(offset)
        self.sizes.append(size)
        self.ticks.append(ticks)

    def _read(self, span: _Span, at_most: int) -> bytes:
        self.file.seek(span.start)
        return self.file.read(min(span.size, at_most))

    def _chunks(self) -> Iterator[_Span]:
        at = 0
        while at + _CHUNK.size <= self.size:
            self.file.seek(at)
            name, length = _CHUNK.unpack(self.file.read(_CHUNK.size))
            start = at + _CHUNK.size
            if not all(32 <= byte < 127 for byte in name):  # later data may be noise
                self.whole = False
                return
            if name in (b"RIFF", b"LIST") and self.file.read(4) in _LISTS:
                # an interrupted program leaves the length of its lists at 0
                self.whole = self.whole and 4 <= length <= self.size - start
                at = start + 4
                continue
            if start + length > self.size:
                self.whole = False
                return
            yield _Span(name, start, length)
            at = start + length + length % 2

    def _elements(self) -> Iterator[_Span]:
        at = 0
        while at < self.size:
            self.file.seek(at)
            head = self.file.read(12)
            # the first set bit determines the length of an id and is part of it
            n = 9 - head[0].bit_length()
            id = int.from_bytes(head[:n], "big")
            length, start = _vint(head, n)
            start += at
            descended = id in _DESCENDED
            known = descended or id == _CLUSTER_TIME or id in _BLOCKS or id in _OTHERS
            if not known or (length < 0 and not descended):
                self.whole = False
                return
            self.whole = self.whole and start + length <= self.size
            if descended:
                at = start
                continue
            if start + length > self.size:
                return
            yield _Span(id, start, length)
            at = start + length


def _vint(data: bytes, at: int) -> tuple[int, int]:
    """The variable-length number at `at`, and its end; -1 if it is open or missing."""
    if at >= len(data) or not data[at]:
        return -1, at
    n = 9 - data[at].bit_length()
    value = int.from_bytes(data[at : at + n], "big") & ((1 << 7 * n) - 1)
    if at + n > len(data) or value == (1 << 7 * n) - 1:
        return -1, at + n
    return value, at + n


def _index(path: Path, progress: Progress) -> DepthTrack:
    """The depth track of a file and its frames.

    It is the stream titled or tagged DEPTH, else the first of 16-bit grey frames that is not titled
    as infrared, else the first grey one, else the first video.
    """
    is_mkv = path.suffix.lower() == ".mkv"
    try:
        # a fixed format: others can refer to further files, which would be opened
        with av.open(str(path), format="matroska" if is_mkv else "avi") as container:
            videos = list(container.streams.video)
            titled = [one for one in videos if _title(one).upper() == "DEPTH"]
            titled = titled or [one for one in videos if "K4A_DEPTH_TRACK" in one.metadata]
            grey = [one for one in videos if _dtype(one) is not None]
            visible = [one for one in grey if not is_infrared(_title(one))]
            if not videos:
                raise RecordingError(
                    f"{path} holds no video track, or is cut short before it is named; give a "
                    "recording with depth"
                )
            stream = next(some for some in (titled, visible, grey, videos) if some)[0]
            refuse_infrared(path, "DEPTH" if titled else _title(stream) or path.stem)
            dtype = _dtype(stream)
            if dtype is None:
                codec = stream.codec_context
                name = "unknown" if codec is None else codec.name if is_mkv else codec.codec_tag
                raise RecordingError(
                    f"expected 16-bit depth in FFV1 or uncompressed, but {path} is packed with "
                    f"{name!r}; give the video of the depth itself"
                )
            codec = stream.codec_context
            track = DepthTrack(codec.width, codec.height, dtype, codec.extradata or b"")
            track.tags = {**container.metadata, **stream.metadata}
            track.attachments = [one.data for one in container.streams.attachments]
            with suppress(KeyError, ValueError):
                began = datetime.fromisoformat(container.metadata["creation_time"])
                track.session_start = began.isoformat()
            number, n_stated, time_base = stream.index, stream.frames, stream.time_base
            first = next(container.demux(stream), None)
    except av.FFmpegError:
        raise RecordingError(
            f"{path} is named like {'a Matroska' if is_mkv else 'an AVI'} video but cannot be read "
            "as one; copy it again, or give another file"
        ) from None
    size = path.stat().st_size
    with path.open("rb", buffering=0) as file:
        walk = _Walk(file, size)
        if is_mkv and first is not None and first.pos is not None:
            file.seek(first.pos)
            number, _ = _vint(file.read(8), 0)
        for span in walk.mkv(number) if is_mkv else walk.avi(number):
            progress(span.start >> 20, (size >> 20) + 1, "looking through the video (MB)")
    n = len(walk.offsets)
    if dtype:  # a raw frame of another length is the first sign of damage
        good = np.frombuffer(walk.sizes, np.int64) == 2 * track.width * track.height
        n = n if good.all() else int(np.argmin(good))
    track.offsets, track.sizes = walk.offsets[:n], walk.sizes[:n]
    step = Fraction(time_base or 0) * 10**9
    times = [min(max(round(ticks * step), -LIMIT_NS), LIMIT_NS) for ticks in walk.ticks[:n]]
    track.times_ns = np.array(times, np.int64)
    track.even = not is_mkv
    track.whole = walk.whole and n == len(walk.offsets) and (is_mkv or walk.n_slots >= n_stated)
    return track


def _title(stream: Any) -> str:
    return str(stream.metadata.get("title", ""))


def _dtype(stream: Any) -> str | None:
    """Type of raw numbers, "" for FFV1, None for unsupported streams."""
    codec = stream.codec_context
    if codec is None or codec.name == _FFV1:
        return None if codec is None else ""
    return _RAW.get(codec.format.name) if codec.name == "rawvideo" and codec.format else None


class Ffv1:
    """Decoder (RFC 9043) of 16-bit grey frames, fed in order from a key frame.

    FFmpeg's decoder does not check the CRC-32 of slices, so damage would appear as depth.
    """

    def __init__(self, width: int, height: int, private: bytes) -> None:
        """Start the decoder; `private` is the codec's own header, empty if there is none."""
        self._size = (width, height)
        self._private = private
        self._table = crc_table()
        self._summed = False  # whether this stream has check sums, once detected
        self._codec = self.fresh()

    def fresh(self) -> Any:
        """A new decoder."""
        codec: Any = av.CodecContext.create(_FFV1, "r")
        codec.width, codec.height = self._size
        codec.extradata = self._private or None
        return codec

    def decode(self, data: bytes) -> NDArray[np.uint16] | None:
        """Stored values (H, W) of one frame; None if it is damaged or not 16-bit grey.

        After a damaged frame, the next must be a key frame.
        """
        agree = slices_agree(np.frombuffer(data, np.uint8), self._table)
        self._summed = self._summed or agree  # a chance match has a probability of 1 in 4e9
        if self._summed and not agree:
            return None
        try:
            frames = self._codec.decode(av.Packet(data))
        except av.FFmpegError:
            self._codec = self.fresh()
            return None
        if len(frames) != 1 or not frames[0].format.name.startswith("gray1"):
            return None
        depth: NDArray[Any] = frames[0].to_ndarray()
        return depth.astype(np.uint16, copy=False)


class DepthVideo(Stack):
    """Depth track of a video file as frames of one size."""

    def __init__(self, path: Path, track: DepthTrack) -> None:
        """Open the file, and find the key frames of FFV1.

        Raises:
            RecordingError: its frames are not 16-bit depth.
        """
        self.track = track
        self.width = track.width
        self.height = track.height
        self.problems = []
        self._path = path
        self._file = path.open("rb", buffering=0)
        self._lock = Lock()
        self._ffv1: Ffv1 | None = None
        self._keys = np.zeros(0, np.int64)
        self._next = -1
        if not track.dtype:
            try:
                self._ffv1 = Ffv1(track.width, track.height, track.private)
                self._find_keys(self._ffv1)
            except BaseException:
                self._file.close()
                raise

    def _find_keys(self, ffv1: Ffv1) -> None:
        """Find the key frames, and refuse a stream that does not decode to 16-bit grey."""
        keys = [k for k in range(len(self)) if int.from_bytes(self._bytes(k, 2), "big") >= _KEY]
        self._keys = np.array(keys, np.int64)
        for key in keys[:_N_PROBED]:
            try:
                frames = ffv1.fresh().decode(av.Packet(self._bytes(key)))
            except av.FFmpegError:
                continue
            for frame in frames:
                if frame.format.name.startswith("gray1"):
                    return
                found = f"{frame.format.components[0].bits}-bit {frame.format.name}"
                raise not_depth_error(str(self._path), found, frame.width, frame.height)
        raise RecordingError(
            f"none of the first frames of {self._path} can be decoded; copy it again"
        )

    def __len__(self) -> int:
        return len(self.track.offsets)

    @property
    def truncated(self) -> bool:
        """True if the file ends too early."""
        return not self.track.whole

    def read(self, index: int) -> NDArray[np.uint16] | None:
        """Stored values (H, W) of a frame; None if it, or one that it depends on, is damaged."""
        with self._lock:
            if self._ffv1 is None:
                data = self._bytes(index)
                if len(data) != 2 * self.width * self.height:
                    return None
                raw = np.frombuffer(data, self.track.dtype).reshape(self.height, self.width)
                return raw.astype(np.uint16)
            before = np.searchsorted(self._keys, index, side="right") - 1
            if before < 0:
                return None
            key = int(self._keys[before])
            start = self._next if key < self._next <= index else key
            self._next = -1  # until the frame is decoded
            depth = None
            for k in range(start, index + 1):
                depth = self._ffv1.decode(self._bytes(k))
                if depth is None or depth.shape != (self.height, self.width):
                    return None
            self._next = index + 1
            return depth

    def _bytes(self, index: int, at_most: int | None = None) -> bytes:
        self._file.seek(self.track.offsets[index])
        size = self.track.sizes[index]
        return self._file.read(size if at_most is None else min(size, at_most))

    def label(self, index: int) -> str:
        """Name of a frame, for a message."""
        return f"frame {index} of {self._path.name}"

    def close(self) -> None:
        """Close the file."""
        self._file.close()


def open_video(path: Path, progress: Progress) -> DepthVideo:
    """Find the depth frames of an AVI file, or of a Matroska file (.mkv).

    Raises:
        RecordingError: there is no whole frame of 16-bit depth in FFV1 or uncompressed.
    """
    track = _index(path, progress)
    size = (track.width, track.height)
    if not track.offsets or not all(size) or too_large(size):
        raise RecordingError(
            f"{path} is cut short or damaged and holds no whole frame; copy it again"
        )
    return DepthVideo(path, track)
