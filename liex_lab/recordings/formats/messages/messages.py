"""Files of messages on named topics, with packed chunks, and the messages in a common form.

This is shared by MCAP files and ROS bags. A file is walked once from beginning to end, which needs
no index and so also reads cut files; afterwards every message is read from its position.

Schemas: foxglove.RawImage, CompressedImage, PointCloud and CameraCalibration; sensor_msgs/Image,
CompressedImage, PointCloud2 and CameraInfo (`parsers`); std_msgs/String, std_msgs/Float32 and
diagnostic_msgs/KeyValue for statements of the RealSense programs (`Statements`).
"""

import bz2
import json
import re
from abc import ABC, abstractmethod
from bisect import bisect_right
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from decimal import Decimal
from pathlib import Path
from typing import IO, Annotated, Any, NamedTuple

import numpy as np
from isal import isal_zlib
from numpy.typing import NDArray
from pydantic import BaseModel, Field, ValidationError

from liex_lab.errors import RecordingError
from liex_lab.recordings.timestamps import FAULTS, LIMIT_NS, start_of_clock
from liex_lab.runtime.memory import why_short
from liex_lab.runtime.progress import Progress

IMAGE_SCHEMAS = (
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
class RawDepthImage:
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
class PackedDepthImage:
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


DepthMessage = RawDepthImage | PackedDepthImage | PointCloud
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


IsRelevant = Callable[[Channel], bool]  # whether the messages of a channel are relevant


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
    def walk(self, wanted: IsRelevant, progress: Progress) -> Iterator[Envelope | IndexedMessages]:
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
    try:
        data = _inflate(packed, chunk.packing, size)
    except DamagedChunk:
        raise
    except Exception as error:
        if why_short(error):  # not a fault of the file
            raise MemoryError(str(error)) from None
        raise DamagedChunk(str(error)) from None
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


# Statements of known programs about their recordings: RealSense's, and `liex pack`.


_OF_PROGRAM = re.compile(r"^/device_\d+/sensor_\d+/")
_LENS = ("width", "height", "fx", "ppx", "fy", "ppy")


def calibration_in(statement: Statement) -> Calibration | None:
    """The intrinsics of a stream in a statement; None if it states something else.

    Args:
        statement: the statement.

    Raises:
        ValueError: one of them is not a number.
    """
    if not set(_LENS) <= set(statement.facts):
        return None
    width, height, fx, cx, fy, cy = (float(statement.facts[name]) for name in _LENS)
    bent = tuple(float(c) for c in statement.facts.get("coeffs", "").split(",") if c)
    k = (fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0)
    return Calibration("", int(width), int(height), statement.facts.get("model", ""), bent, k, ())


@dataclass
class Statements:
    """Statements of a file about its sensors and streams, each named by the beginning of its
    topics.

    Attributes:
        units_mm: mm of a stored step, as a sensor's option or in the metadata of a stream's frames,
            with the number of times each was stated.
        times_ns: by message of a stream: time of logging and time of the sensor, ns.
        began_ns: the computer's clock at the first frame of a stream, ns.
    """

    units_mm: defaultdict[str, Counter[float]] = field(default_factory=lambda: defaultdict(Counter))
    times_ns: defaultdict[str, dict[MessagePlace, tuple[int, int]]] = field(
        default_factory=lambda: defaultdict(dict)
    )
    began_ns: dict[str, int] = field(default_factory=dict)

    def add(self, message: Envelope, statement: Statement) -> bool:
        """Record a statement.

        Args:
            message: its message.
            statement: the statement.

        Returns:
            False if further messages of the channel add nothing.

        Raises:
            ValueError: a value is not a number.
        """
        topic, facts = message.channel.topic, statement.facts
        of = STATES.sub("/", topic)
        unit_mm = (
            float(facts.get("value" if topic.endswith("/value") else "depth_units", 0)) * 1000.0
        )
        if 0.0 < unit_mm < np.inf:
            self.units_mm[of][float(f"{unit_mm:.9g}")] += 1
        if "system_time" in facts:
            self.began_ns.setdefault(of, _ms_as_ns(facts["system_time"]))
        if "timestamp" in facts:
            sensor_ns = _ms_as_ns(facts["timestamp"])
            self.times_ns[of][message.place] = (message.log_time_ns, sensor_ns)
        # a .bag has one message per fact and frame, and the times are in its headers
        return message.channel.schema.endswith("String") or of not in self.began_ns

    def step_mm(
        self, topic: str, settled: bool, problems: list[str], doubts: list[str]
    ) -> float | None:
        """Millimetres of a stored step on a topic.

        The unit in the frames' metadata (the longest matching topic prefix) overrides the
        sensor's option.

        Args:
            topic: name of the depth topic.
            settled: whether a camera.toml states the unit.
            problems: appended to if a recording of these programs states none.
            doubts: appended to if it states several.

        Returns:
            mm; None if the file does not state it, or states several and a camera.toml decides.
        """
        stated = {of: units for of, units in self.units_mm.items() if topic.startswith(of)}
        if not stated and _OF_PROGRAM.search(topic) and not settled:
            problems.append(
                "the recording states no depth unit, so 1 mm was assumed; state the true unit_mm "
                "in camera.toml if it differs"
            )
        every = sorted({unit for units in stated.values() for unit in units})
        # units are written with six decimals of a metre
        differ = bool(every) and every[-1] - every[0] > 1e-3
        if not every or (differ and settled):
            return None
        step_mm, _ = stated[max(stated, key=len)].most_common(1)[0]
        if differ:
            listed = " and ".join(f"{unit:g}" for unit in every[:4])
            doubts.append(
                f"the recording states depth units of {listed} mm; {step_mm:g} mm was used, and "
                "lengths are wrong by the ratio where another one is true: state unit_mm in "
                "camera.toml"
            )
        return step_mm

    def start(self, topic: str) -> str | None:
        """Start time of a topic, ISO 8601, by the computer's clock; None if absent.

        Args:
            topic: name of the depth topic.
        """
        began = [start_of_clock(ns) for of, ns in self.began_ns.items() if topic.startswith(of)]
        return began[0] if began else None

    def sensor_times(
        self,
        topic: str,
        logged_ns: NDArray[np.int64],
        arrived_ns: NDArray[np.int64],
        problems: list[str],
    ) -> NDArray[np.int64]:
        """The sensor's times of the depth images on a topic, from the metadata of their frames.

        An image and its metadata have the same time of logging, or else the same number.

        Args:
            topic: name of the depth topic.
            logged_ns: (n,) times of logging, ns, in order.
            arrived_ns: (n,) stamps in their headers, ns.
            problems: appended to if images have no metadata.

        Returns:
            (n,) ns; the stamps of the headers if the file has no metadata.
        """
        times = next((t for of, t in self.times_ns.items() if topic.startswith(of)), {})
        if not times:
            return arrived_ns
        by_log = dict(times.values())
        found = [by_log.get(ns) for ns in logged_ns.tolist()]
        if None in found and len(times) == len(found):
            found = [ns for _, ns in times.values()]
        if None in found:
            problems.append(
                f"{found.count(None)} of {len(found)} depth images have no metadata with the "
                "sensor's time; their times of arrival are used"
            )
        known = np.array([ns is not None for ns in found])
        sensor_ns = np.array([ns or 0 for ns in found])
        delay = int(np.median((sensor_ns - arrived_ns)[known])) if known.any() else 0
        return np.where(known, sensor_ns, arrived_ns + delay)


def _ms_as_ns(text: str) -> int:
    """Milliseconds as decimal text, in ns; a float64 would only be precise to 200 ns."""
    if not abs(float(text)) * 1e6 < LIMIT_NS:
        raise ValueError(f"a time in the metadata is {text}")
    return int((Decimal(text.strip()) * 1_000_000).to_integral_value())


# Facts in an archive of `liex pack` about its source recording.


SUFFIX = ".pack"  # before .mcap; not part of the recording's name
_FACTS = "packed"
_HASH = "depth_sha256"


class PackFacts(BaseModel):
    """Facts about the source of an archive; defaults for a file that is not an archive.

    Attributes:
        step_mm: mm of a stored step.
        problems: sentences about the recording.
        moved: frames whose stamps were moved, and why: index into `FAULTS` by row.
        source: name, format and SHA-256 of the recording.
        region_px: (u, v) corners of the polygon of kept pixels; empty for the whole image, or for a
            region that is not a polygon.
        n_px: number of kept pixels per image; 0 for all.
        doubts: reasons why its times are unreliable.
        depth_sha256: SHA-256 of times (int64 ns) and images (uint16 steps), little endian, in
            order; empty if unknown.
        packed: whether the file is an archive.
    """

    step_mm: Annotated[float, Field(gt=0, lt=1000)] = 1.0
    problems: list[str] = []
    moved: dict[int, Annotated[int, Field(gt=0, lt=len(FAULTS))]] = {}
    source: dict[str, str] = {}
    region_px: list[list[float]] = []
    n_px: int = 0
    doubts: list[str] = []
    depth_sha256: Annotated[str, Field(exclude=True)] = ""
    packed: Annotated[bool, Field(exclude=True)] = False

    @staticmethod
    def of(notes: Mapping[str, str]) -> "PackFacts":
        """The facts in a file's notes.

        Args:
            notes: texts by name.

        Raises:
            RecordingError: they were not written by `liex pack`, or are damaged.
        """
        if _FACTS not in notes:
            return PackFacts()
        with suppress(ValidationError):
            facts = PackFacts.model_validate_json(notes[_FACTS])
            if facts.model_fields_set >= {"step_mm", "problems", "moved", "source", "region_px"}:
                return facts.model_copy(
                    update={"depth_sha256": notes.get(_HASH, ""), "packed": True}
                )
        raise RecordingError(
            "the facts of this archive are damaged, so that its depth would have no unit; "
            "pack the recording again"
        )

    def to_notes(self) -> dict[str, str]:
        """The facts as texts for the file's notes, except for the hash, see `hash_note`."""
        return {_FACTS: json.dumps(self.model_dump(mode="json"))}

    @property
    def metadata(self) -> dict[str, Any]:
        """Metadata of the recording about its archive; empty for other files."""
        if not self.packed:
            return {}
        table = {"source": self.source, "step_mm": self.step_mm, "depth_sha256": self.depth_sha256}
        return {"packed": table}

    def faults(self, found: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Why the stamps of the recording's frames were moved.

        Args:
            found: (n,) faults of the archive's own stamps.

        Returns:
            (n,) index into `FAULTS`.
        """
        faults = found.copy()
        for row, why in self.moved.items():
            if 0 <= row < len(faults):
                faults[row] = why
        return faults


def hash_note(depth_sha256: str) -> dict[str, str]:
    """The note at the end of an archive.

    Args:
        depth_sha256: see `PackFacts`.
    """
    return {_HASH: depth_sha256}
