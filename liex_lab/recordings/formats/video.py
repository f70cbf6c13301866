"""Random access to depth videos: FFV1 or raw 16-bit grey frames in AVI or Matroska.

PyAV reads the header (streams, tags, attachments). The frames are found by one walk over the chunks
of the file, which reads no frame data and needs no index, so cut files can be read as well. FFV1
frames depend on the previous ones back to the last key frame (one in twelve, usually): reading in
order decodes each once, random access decodes some more. AVI has a constant rate instead of times.
In Matroska a frame's time is (cluster time + block time) * timecode scale.
"""

import struct
from array import array
from contextlib import suppress
from datetime import datetime
from fractions import Fraction
from pathlib import Path
from threading import Lock
from typing import IO, Any

import av
import numpy as np
from isal import isal_zlib
from numpy.typing import NDArray

from liex_lab.errors import RecordingError
from liex_lab.recordings.camera_file import is_infrared, refuse_infrared
from liex_lab.recordings.formats.images.files import Stack, not_depth_error, too_large
from liex_lab.recordings.recording import closing_on_error
from liex_lab.recordings.timestamps import LIMIT_NS
from liex_lab.runtime.progress import Progress

_FFV1 = "ffv1"
_RAW = {"gray16be": ">u2", "gray16le": "<u2"}  # FFmpeg's name of the pixels: NumPy's

_CHUNK = struct.Struct("<4sI")  # name, length of what follows

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


class _Walk:
    """The frames of one stream of a file, found by its chunks (AVI) or elements (Matroska).

    Attributes:
        whole: False once the file is cut or damaged.
        frames: (3 n,) for each frame the position and size of its data, bytes, and its time, ticks.
        n_slots: number of frames, including dropped ones (AVI).
    """

    def __init__(self, file: IO[bytes], size: int, progress: Progress) -> None:
        self._file = file
        self._size = size
        self._progress = progress
        self.whole = True
        self.frames = array("q")
        self.n_slots = 0

    def read(self, at: int, n: int) -> bytes:
        """Some bytes of the file; fewer at its end."""
        self._progress(at >> 20, (self._size >> 20) + 1, "scanning the video (MB)")
        self._file.seek(at)
        return self._file.read(n)

    def avi(self, number: int) -> None:
        """Find the frames of an AVI file's stream."""
        names = (b"%02ddc" % number, b"%02ddb" % number)
        at = 0
        while at + _CHUNK.size <= self._size:
            name, length = _CHUNK.unpack(self.read(at, _CHUNK.size))
            start = at + _CHUNK.size
            # traversed
            if name in (b"RIFF", b"LIST") and self.read(start, 4) in (
                b"AVI ",
                b"AVIX",
                b"hdrl",
                b"strl",
                b"movi",
                b"rec ",
            ):
                # an interrupted program leaves the length of its lists at 0
                self.whole = self.whole and 4 <= length <= self._size - start
                at = start + 4
                continue
            is_name = all(32 <= byte < 127 for byte in name)  # later data may be noise
            if not is_name or start + length > self._size:
                self.whole = False
                return
            if name in names:
                if length:  # an empty chunk marks a dropped frame
                    self.frames.extend((start, length, self.n_slots))
                self.n_slots += 1
            at = start + length + length % 2

    def mkv(self, number: int) -> None:
        """Find the frames of a Matroska file's track."""
        at = cluster_time = 0
        while at < self._size:
            head = self.read(at, 12)
            # the first set bit determines the length of an id and is part of it
            n = 9 - head[0].bit_length()
            id = int.from_bytes(head[:n], "big")
            length, start = vint(head, n)
            start += at
            descended = id in _DESCENDED
            known = descended or id == _CLUSTER_TIME or id in _BLOCKS or id in _OTHERS
            if not known or (length < 0 and not descended):
                self.whole = False
                return
            self.whole = self.whole and start + length <= self._size
            at = start if descended else start + length
            if at > self._size:
                return
            if id == _CLUSTER_TIME:
                cluster_time = int.from_bytes(self.read(start, min(length, 8)), "big")
            elif id in _BLOCKS:
                block = self.read(start, min(length, 11))
                track, begin = vint(block, 0)
                has_head = track >= 0 and len(block) >= begin + 3
                ticks, flags = struct.unpack_from(">hB", block, begin) if has_head else (0, _LACING)
                if flags & _LACING:
                    self.whole = False
                # a clock beyond that is damage
                elif track == number and cluster_time < 2**60:
                    begin += 3
                    self.frames.extend((start + begin, length - begin, cluster_time + ticks))


def vint(data: bytes, at: int) -> tuple[int, int]:
    """Matroska's variable-length number at `at`, and its end; -1 if it is open or missing."""
    if at >= len(data) or not data[at]:
        return -1, at
    n = 9 - data[at].bit_length()
    value = int.from_bytes(data[at : at + n], "big") & ((1 << 7 * n) - 1)
    if at + n > len(data) or value == (1 << 7 * n) - 1:
        return -1, at + n
    return value, at + n


# every byte with its bits in reverse order
_MIRRORED = bytes(int(f"{byte:08b}"[::-1], 2) for byte in range(256))
_NOTHING_LEFT = 0xFFFFFFFF  # zlib's value of a register of zeros


def slices_agree(data: bytes) -> bool:
    """Whether the slices of an FFV1 image, found from its last byte backwards, match their CRC-32.

    Each slice ends in its length (3 bytes), an error flag (1) and a check sum (4) that makes the
    whole slice's CRC 0. FFV1 counts the high bit of a byte first, and zlib the low one.
    """
    mirrored = memoryview(data.translate(_MIRRORED))
    end = len(data)
    while end > 8:
        start = end - 8 - int.from_bytes(data[end - 8 : end - 5], "big")
        if start < 0 or isal_zlib.crc32(mirrored[start:end], _NOTHING_LEFT) != _NOTHING_LEFT:
            return False
        end = start
    return end == 0


def _depth_stream(container: Any, path: Path) -> Any:
    """The stream titled or tagged DEPTH, else the first of 16-bit grey frames that is not titled as
    infrared, else the first grey one, else the first video.

    Raises:
        RecordingError: there is no video, or it is infrared or not 16-bit depth.
    """
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
    if _dtype(stream) is None:
        codec = stream.codec_context
        is_mkv = container.format.name.startswith("matroska")
        name = "unknown" if codec is None else codec.name if is_mkv else codec.codec_tag
        raise RecordingError(
            f"expected 16-bit depth in FFV1 or uncompressed, but {path} is packed with "
            f"{name!r}; give the video of the depth itself"
        )
    return stream


def _title(stream: Any) -> str:
    return str(stream.metadata.get("title", ""))


def _dtype(stream: Any) -> str | None:
    """Type of raw numbers, "" for FFV1, None for unsupported streams."""
    codec = stream.codec_context
    if codec is None or codec.name == _FFV1:
        return None if codec is None else ""
    return _RAW.get(codec.format.name) if codec.name == "rawvideo" and codec.format else None


class DepthVideo(Stack):
    """Depth track of an AVI file, or of a Matroska file (.mkv), as frames of one size.

    FFmpeg's FFV1 decoder (RFC 9043) does not check the CRC-32 of slices, so damage would appear as
    depth; it is checked here.

    Attributes:
        frames: (n, 2) int64 position and size of each frame's data, bytes.
        times_ns: (n,) int64 time of each frame, ns.
        even: True for times of a constant rate, as the container has no others.
        tags: tags of the whole file and of the track.
        attachments: bytes of the attached files.
        session_start: ISO 8601 if the file states it.
    """

    def __init__(self, path: Path, progress: Progress) -> None:
        """Read the header, find the frames, and find the key frames of FFV1.

        Raises:
            RecordingError: there is no whole frame of 16-bit depth in FFV1 or uncompressed.
        """
        is_mkv = path.suffix.lower() == ".mkv"
        self._path = path
        self._lock = Lock()
        self.even = not is_mkv
        self.session_start: str | None = None
        try:
            # a fixed format: others can refer to further files, which would be opened
            with av.open(str(path), format="matroska" if is_mkv else "avi") as container:
                stream = _depth_stream(container, path)
                codec = stream.codec_context
                self._size = (codec.width, codec.height)
                self._dtype = _dtype(stream)
                self._private = codec.extradata
                self.tags: dict[str, str] = {**container.metadata, **stream.metadata}
                self.attachments = [one.data for one in container.streams.attachments]
                with suppress(KeyError, ValueError):
                    began = datetime.fromisoformat(container.metadata["creation_time"])
                    self.session_start = began.isoformat()
                number, n_stated, time_base = stream.index, stream.frames, stream.time_base
                first = next(container.demux(stream), None)
        except av.FFmpegError:
            raise RecordingError(
                f"{path} is named like {'a Matroska' if is_mkv else 'an AVI'} video but cannot be "
                "read as one; copy it again, or give another file"
            ) from None
        self._file = path.open("rb", buffering=0)
        with closing_on_error(self._file):
            walk = _Walk(self._file, path.stat().st_size, progress)
            if not is_mkv:
                walk.avi(number)
            else:
                pos = None if first is None else first.pos
                walk.mkv(number if pos is None else vint(walk.read(pos, 8), 0)[0])
            found = np.array(walk.frames, np.int64).reshape(-1, 3)
            n = len(found)
            if self._dtype:  # a raw frame of another length is the first sign of damage
                good = found[:, 1] == 2 * codec.width * codec.height
                n = n if good.all() else int(np.argmin(good))
            whole = walk.whole and n == len(found) and (is_mkv or walk.n_slots >= n_stated)
            super().__init__(self._size, [True] * n, truncated=not whole)
            if not n or not all(self._size) or too_large(self._size):
                raise RecordingError(
                    f"{path} is cut short or damaged and holds no whole frame; copy it again"
                )
            self.frames = found[:n, :2]
            step = Fraction(time_base or 0) * 10**9
            times = [min(max(round(t * step), -LIMIT_NS), LIMIT_NS) for t in found[:n, 2].tolist()]
            self.times_ns = np.array(times, np.int64)
            if not self._dtype:
                self._start_decoder()

    def _start_decoder(self) -> None:
        """Find the key frames, and refuse a stream that does not decode to 16-bit grey."""
        self._summed = False  # whether this stream has check sums, once detected
        self._next = -1
        starts = [int.from_bytes(self._bytes(k, 2), "big") for k in range(len(self))]
        # least start value of an FFV1 key frame: its first coded bit is 1
        self._keys = np.flatnonzero(np.array(starts) >= 0x7F80)
        # key frames, one of which must be depth: the first may be damaged
        for key in self._keys[:3].tolist():
            self._codec = self._fresh_codec()
            with suppress(av.FFmpegError):
                for frame in self._codec.decode(av.Packet(self._bytes(key))):
                    if frame.format.name.startswith("gray1"):
                        return
                    found = f"{frame.format.components[0].bits}-bit {frame.format.name}"
                    raise not_depth_error(str(self._path), found, frame.width, frame.height)
        raise RecordingError(
            f"none of the first frames of {self._path} can be decoded; copy it again"
        )

    def _fresh_codec(self) -> Any:
        codec: Any = av.CodecContext.create(_FFV1, "r")
        codec.width, codec.height = self._size
        codec.extradata = self._private or None
        return codec

    def read(self, index: int) -> NDArray[np.uint16] | None:
        """Stored values (H, W) of a frame; None if it, or one that it depends on, is damaged."""
        with self._lock:
            if self._dtype:
                data = self._bytes(index)
                if len(data) != 2 * self.width * self.height:
                    return None
                raw = np.frombuffer(data, self._dtype).reshape(self.height, self.width)
                return raw.astype(np.uint16)
            before = np.searchsorted(self._keys, index, side="right") - 1
            if before < 0:
                return None
            key = int(self._keys[before])
            start = self._next if key < self._next <= index else key
            self._next = -1  # until the frame is decoded
            depth = None
            for k in range(start, index + 1):
                depth = self._decode(self._bytes(k))
                if depth is None:
                    return None
            self._next = index + 1
            return depth

    def _decode(self, data: bytes) -> NDArray[np.uint16] | None:
        """Stored values (H, W) of one frame of FFV1, given in order from a key frame; None if it is
        damaged or not 16-bit grey, and the next must be a key frame.
        """
        agree = slices_agree(data)
        self._summed = self._summed or agree  # a chance match has a probability of 1 in 4e9
        if self._summed and not agree:
            return None
        try:
            frames = self._codec.decode(av.Packet(data))
        except av.FFmpegError:
            self._codec = self._fresh_codec()
            return None
        if len(frames) != 1 or not frames[0].format.name.startswith("gray1"):
            return None
        depth: NDArray[Any] = frames[0].to_ndarray()
        fits = depth.shape == (self.height, self.width)
        return depth.astype(np.uint16, copy=False) if fits else None

    def _bytes(self, index: int, at_most: int = -1) -> bytes:
        at, size = self.frames[index].tolist()
        self._file.seek(at)
        return self._file.read(size if at_most < 0 else min(size, at_most))

    def label(self, index: int) -> str:
        """Name of a frame, for a message."""
        return f"frame {index} of {self._path.name}"

    def close(self) -> None:
        """Close the file."""
        self._file.close()
