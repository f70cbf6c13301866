"""Files of messages on named topics, with packed chunks, and the messages in a common form.

This is shared by MCAP files and ROS bags. A file is walked once from beginning to end, which needs
no index and so also reads cut files; afterwards every message is read from its position.

Schemas: foxglove.RawImage, CompressedImage, PointCloud and CameraCalibration; sensor_msgs/Image,
CompressedImage, PointCloud2 and CameraInfo (`parsers`); std_msgs/String, std_msgs/Float32 and
diagnostic_msgs/KeyValue for statements of the RealSense programs (`statements`).
"""

import bz2
import re
from abc import ABC, abstractmethod
from bisect import bisect_right
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, NamedTuple

import numpy as np
from isal import isal_zlib
from numpy.typing import NDArray

from liex_lab.errors import RecordingError
from liex_lab.runtime.memory import why_short
from liex_lab.runtime.progress import Progress

PICTURE_SCHEMAS = (
    "foxglove.RawImage",
    "foxglove.CompressedImage",
    "sensor_msgs/Image",
    "sensor_msgs/CompressedImage",
)
CLOUD_SCHEMAS = ("foxglove.PointCloud", "sensor_msgs/PointCloud2")
CALIBRATION_SCHEMAS = ("foxglove.CameraCalibration", "sensor_msgs/CameraInfo")
STATEMENT_SCHEMAS = ("std_msgs/String", "std_msgs/Float32", "diagnostic_msgs/KeyValue")
# topics with facts from the RealSense programs
STATES = re.compile(r"(/option/Depth[ _]Units/value|/image/metadata|/camera_info)$")


class DamagedMessage(ValueError):
    """A message does not match its schema."""


@dataclass(frozen=True, slots=True)
class RawPicture:
    """An unpacked image.

    Attributes:
        stamp_ns: stamp of the sensor, ns.
        frame_id: name of the camera's frame.
        width: columns, px.
        height: rows, px.
        encoding: of the pixels, 16UC1, mono16, 32FC1, ...
        step: bytes from one row to the next; 0 for no padding.
        big_endian: True if the high byte comes first.
        data: the pixels, row by row.
    """

    stamp_ns: int
    frame_id: str
    width: int
    height: int
    encoding: str
    step: int
    big_endian: bool
    data: bytes | memoryview


@dataclass(frozen=True, slots=True)
class PackedPicture:
    """A packed image.

    Attributes:
        stamp_ns: stamp of the sensor, ns.
        frame_id: name of the camera's frame.
        packing: png, or as written by ROS, '16UC1; compressedDepth rvl'.
        data: the packed bytes.
    """

    stamp_ns: int
    frame_id: str
    packing: str
    data: bytes | memoryview


@dataclass(frozen=True, slots=True)
class PointCloud:
    """Points in metres, in rows like an image or unordered.

    Attributes:
        stamp_ns: stamp of the sensor, ns.
        frame_id: name of the points' frame.
        width: columns of the image, row by row.
        height: its rows; 1 for unordered points.
        columns: by name (x, y, z), the offset within a point, bytes, and NumPy's name of the type.
        point_step: bytes from one point to the next.
        row_step: bytes from one row to the next.
        data: the points.
        pose: position (3) m and quaternion x, y, z, w of the cloud's own frame; None if the points
            are in the camera frame.
    """

    stamp_ns: int
    frame_id: str
    width: int
    height: int
    columns: dict[str, tuple[int, str]]
    point_step: int
    row_step: int
    data: bytes | memoryview
    pose: tuple[float, ...] | None = None


@dataclass(frozen=True, slots=True)
class Calibration:
    """Intrinsics of a camera, as stated by ROS and Foxglove.

    Attributes:
        frame_id: name of the camera's frame.
        width: columns of its images, px.
        height: rows of its images, px.
        model: ROS's name of the distortion model.
        d: distortion coefficients.
        k: (9,) camera matrix 3 x 3, row by row.
        p: (12,) projection matrix 3 x 4 of the rectified image, row by row; or empty.
        binning: pixels of the full image per pixel, along columns and rows; 0 is 1.
        roi: column and row offset, width and height of the part of the full image, px; width or
            height 0 for the whole image.
    """

    frame_id: str
    width: int
    height: int
    model: str
    d: tuple[float, ...]
    k: tuple[float, ...]
    p: tuple[float, ...]
    binning: tuple[int, int] = (1, 1)
    roi: tuple[int, int, int, int] = (0, 0, 0, 0)


@dataclass(frozen=True, slots=True)
class Statement:
    """Facts stated as text by the recording program.

    Attributes:
        facts: text by name; a bare value has the name "value".
    """

    facts: dict[str, str]


DepthMessage = RawPicture | PackedPicture | PointCloud
Message = DepthMessage | Calibration | Statement
Parser = Callable[[memoryview], Message]


# A chunk has some megabytes. A damaged one may state any size, and a few bytes can unpack to
# any number of zeros.
_LARGEST_CHUNK = 1 << 27


class MessagePlace(NamedTuple):
    """Position of a message's data.

    Attributes:
        chunk: number of the chunk; -1 for the file itself.
        offset: position in the unpacked chunk or the file, bytes.
        length: its length, bytes.
    """

    chunk: int
    offset: int
    length: int


class Channel(NamedTuple):
    """A topic and its message type.

    Attributes:
        topic: name of the topic.
        schema: type of its messages, as in sensor_msgs/Image.
        encoding: protobuf, json, ros1 or cdr.
    """

    topic: str
    schema: str
    encoding: str


class Envelope(NamedTuple):
    """A message from the walk.

    Attributes:
        channel: topic, schema and encoding.
        log_time_ns: time of logging, ns.
        place: position of its data, to read it again.
        data: its bytes.
        publish_time_ns: time of sending, ns; 0 if absent.
    """

    channel: Channel
    log_time_ns: int
    place: MessagePlace
    data: memoryview
    publish_time_ns: int = 0


class IndexedMessages(NamedTuple):
    """Messages listed by an index, and read on demand.

    Attributes:
        channel: topic, schema and encoding.
        log_time_ns: (n,) uint64 times of logging, ns.
        places: (n, 3) int64 chunk, offset and length of each, as a `MessagePlace`.
        stamp_ns: (n,) int64 stamps of the sensor, ns; None for the times of logging.
        publish_time_ns: (n,) times of sending, ns; None if not read.
    """

    channel: Channel
    log_time_ns: NDArray[np.uint64]
    places: NDArray[np.int64]
    stamp_ns: NDArray[np.int64] | None = None
    publish_time_ns: NDArray[np.uint64] | None = None


class Chunk(NamedTuple):
    """Messages packed together.

    Attributes:
        offset: position of the packed bytes in the file.
        length: number of packed bytes.
        packing: their compression: none, zstd, lz4 or bz2.
        size: unpacked size, bytes.
        crc: CRC-32 of the unpacked bytes; 0 for none.
        cut: True if the file ends before the chunk does.
    """

    offset: int
    length: int
    packing: str
    size: int
    crc: int
    cut: bool


class DamagedChunk(Exception):
    """A chunk cannot be unpacked to its original bytes."""


class MessageFile(ABC):
    """An open file of messages.

    Attributes:
        path: path of the file.
        file: the open file.
        size: its size, bytes.
        whole: True while it has its end record and no damage was found.
        parsed: False if an index lists the messages, and only some of them were parsed.
        channels: all channels found, each once, in order; as keys, because a file may have
            thousands.
        notes: facts that the file states about itself.
        chunks: all chunks found, in file order.
        starts: positions of the chunks' records by the file's own index, in order.
    """

    def __init__(self, path: Path, file: IO[bytes]) -> None:
        """Keep an open file; nothing is read."""
        self.path = path
        self.file = file
        self.size = path.stat().st_size
        self.whole = True
        self.parsed = True
        self.channels: dict[Channel, None] = {}
        self.notes: dict[str, str] = {}
        self.chunks: list[Chunk] = []
        self.starts: list[int] = []
        self._last_chunk: tuple[int, memoryview] = (-1, memoryview(b""))

    @abstractmethod
    def walk(
        self, wanted: Callable[[Channel], bool], progress: Progress
    ) -> Iterator[Envelope | IndexedMessages]:
        """Every whole message of the wanted channels, in file order.

        Args:
            wanted: whether the messages of a channel are relevant.
            progress: reports the progress of the walk.

        Yields:
            The messages.
        """

    def go_on(self) -> int | None:
        """Prepare a walk over what was written since, after the last whole record.

        Returns:
            Number of valid chunks of earlier walks; None if the file has to be opened again.
        """
        return None

    def resume(self, at: int) -> int:
        """Position at which to resume after a damaged record: the next known chunk, or the end.

        `whole` becomes False.

        Args:
            at: position of the record, bytes.

        Returns:
            Position at which to resume, bytes.
        """
        self.whole = False
        n = bisect_right(self.starts, at)
        return self.starts[n] if n < len(self.starts) else self.size

    def read(self, place: MessagePlace) -> memoryview:
        """The data of one message.

        Args:
            place: its position.

        Raises:
            RecordingError: its chunk can no longer be unpacked.
        """
        if place.chunk >= 0:
            try:
                return self.unpack(place.chunk)[place.offset : place.offset + place.length]
            except DamagedChunk as error:
                raise RecordingError(
                    f"{self.path} changed while it was read ({error}); copy it again"
                ) from None
        self.file.seek(place.offset)
        return memoryview(self.file.read(place.length))

    def unpack(self, number: int) -> memoryview:
        """The unpacked bytes of a chunk; the last one is cached for neighbouring frames.

        Args:
            number: index into `chunks`.

        Raises:
            DamagedChunk: its stated size is invalid, or it cannot be unpacked to its original
                bytes.
        """
        if self._last_chunk[0] != number:
            chunk = self.believable(number)
            self.file.seek(chunk.offset)
            self._last_chunk = (-1, memoryview(b""))  # never two at once
            self._last_chunk = (number, memoryview(unpacked(self.file.read(chunk.length), chunk)))
        return self._last_chunk[1]

    def believable(self, number: int) -> Chunk:
        """A chunk, checked for a plausible size.

        Args:
            number: index into `chunks`.

        Raises:
            DamagedChunk: its stated size is invalid.
        """
        chunk = self.chunks[number]
        if chunk.size > max(_LARGEST_CHUNK, 2 * self.size):
            raise DamagedChunk(f"it states that it unpacks to {chunk.size} bytes")
        return chunk

    def close(self) -> None:
        """Close the file and release the last chunk."""
        self.file.close()
        self._last_chunk = (-1, memoryview(b""))


def unpacked(packed: bytes, chunk: Chunk, first: int | None = None) -> bytes:
    """Unpack a chunk, checked against its size and CRC-32.

    For a cut chunk, the bytes before the cut.

    Args:
        packed: its packed bytes.
        chunk: its description in the file.
        first: number of bytes to unpack from its beginning, unchecked; None for all.

    Raises:
        DamagedChunk: it cannot be unpacked to its original bytes, or its compression is unknown.
    """
    size = chunk.size if first is None else first
    with _codec_errors():
        data = _inflate(packed, chunk.packing, size)
    if chunk.cut:
        return data
    if len(data) != size:
        raise DamagedChunk(f"{len(data)} bytes came out of it and {size} were expected")
    if first is None and chunk.crc and isal_zlib.crc32(data) != chunk.crc:
        raise DamagedChunk("its checksum is wrong")
    return data


def unpacked_message(data: memoryview) -> memoryview:
    """The bytes of a message, unpacked if a recorder packed every message separately.

    Args:
        data: the message; packed ones are recognised by their first bytes.

    Raises:
        DamagedChunk: it cannot be unpacked.
    """
    # by their first bytes
    packing = {b"\x28\xb5\x2f\xfd": "zstd", b"\x04\x22\x4d\x18": "lz4"}.get(bytes(data[:4]))
    if packing is None:
        return data
    whole = Chunk(0, len(data), packing, _LARGEST_CHUNK, 0, cut=True)  # its size is not stated
    return memoryview(unpacked(bytes(data), whole))


@contextmanager
def _codec_errors() -> Iterator[None]:
    """Convert the exceptions of the codecs to ours."""
    try:
        yield
    except DamagedChunk:
        raise
    except Exception as error:
        if why_short(error):  # not a fault of the file
            raise MemoryError(str(error)) from None
        raise DamagedChunk(str(error)) from None


def _inflate(packed: bytes, packing: str, size: int) -> bytes:
    """At most `size` bytes, in pieces, so that a cut chunk yields its remaining bytes."""
    if packing in ("", "none"):
        return packed[:size]
    if packing == "zstd":
        import zstandard

        unpacker = zstandard.ZstdDecompressor()
        if zstandard.frame_content_size(packed) == size:  # in one step, and no more than that
            try:
                return unpacker.decompress(packed)
            except zstandard.ZstdError:
                pass  # a cut chunk
        with unpacker.stream_reader(packed) as reader:
            return reader.read(size)
    if packing == "lz4":
        import lz4.frame

        unpacked: bytes = lz4.frame.LZ4FrameDecompressor().decompress(packed, max_length=size)
        return unpacked
    if packing == "bz2":
        return bz2.BZ2Decompressor().decompress(packed, max_length=size)
    raise DamagedChunk(f"its packing {packing[:20]!r} is not known")


def printable(text: str, length: int = 80) -> str:
    """A name from a file, safe for a message: a damaged one may contain anything.

    Args:
        text: the name.
        length: number of characters to keep.

    Returns:
        The name with ? for characters that are not printable, and ... if it was longer.
    """
    return "".join(c if c.isprintable() else "?" for c in text[:length]) + (
        "..." if len(text) > length else ""
    )
