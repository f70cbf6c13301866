"""Reader of PrimeSense and OpenNI recordings (.oni): 16-bit depth, raw or in OpenNI's 16z codecs.

A file header is followed by records: magic, kind, node, size of header and fields, size of payload,
and an undo position; little endian. Before version 1.0.1.0, positions have 32 bits, then 64. All
records are scanned, which shows what is whole; the seek table is not used. After damage, reading
resumes at the next valid record magic. Source: OpenNI2's own player.

Intrinsics come from the caller, a camera.toml, a property that earlier versions of liex wrote, or
the stated field of view: f = (n / 2) / tan(fov / 2), with the optical axis at half the size, as in
OpenNI. Mirrored frames are flipped back, and cropped frames are padded to the full frame.
"""

from __future__ import annotations

import math
import struct
from array import array
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from threading import Lock
from typing import IO, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from liex_lab.errors import RecordingError
from liex_lab.optics.camera import Camera, Lens
from liex_lab.recordings.camera_file import CAMERA_FILE, CameraFile, rate
from liex_lab.recordings.depth_kernels import WORST_BYTES_A_PIXEL, unpack_16z
from liex_lab.recordings.frame import Depth, depth_mm, unread_where_damaged
from liex_lab.recordings.recording import Recording, closing_on_error
from liex_lab.recordings.timestamps import (
    Times,
    from_rate,
    in_order_of_sensor,
    start_of_clock,
)
from liex_lab.runtime.progress import Progress, silent

_FILE_HEADER = struct.Struct("<4sBBHIQI")  # magic, version (4 numbers), last time, highest node id
_NEWEST = (1, 0, 1, 0)  # before it, positions in the file have 32 bits

_RECORD_MAGIC = 0x0052494E  # "NIR" and a zero byte
_HEADER = struct.Struct("<IIIIIQ")
_OLD_HEADER = struct.Struct("<IIIIII")
_OLD_NODE = 0x02
_FRAME = 0x0A
_FRAME_FIELDS = struct.Struct("<QI")  # time in µs, number of the frame, counted from 1
_NODE_FIELDS = struct.Struct("<i4s")  # kind, codec
_UNKNOWN_COUNT = 0xFFFFFFFF

_USED = (
    "xnMapOutputMode",
    "xnCropping",
    "xnMirror",
    "oniPixelFormat",
    "xnFOV",
    "xnRealWorldTranslationData",
    "ZPD",
    "ZPPS",
    # fx, fy, cx, cy: written by earlier versions of liex, as the format has no optical axis
    "liexIntrinsics",
)


class Record(NamedTuple):
    """One record: its position and those of its payload and of the next record, bytes.

    Of its header's fields, up to 4096 bytes are read.
    """

    at: int
    kind: int
    node: int
    payload: int
    end: int
    fields: bytes


class OniFile:
    """An open .oni file.

    Attributes:
        size: its size, bytes.
        whole: True if it has its end record and no damage; valid after a walk.
    """

    def __init__(self, path: Path, file: IO[bytes]) -> None:
        """Check the header of an open file.

        Raises:
            RecordingError: it is not an .oni file, or its version cannot be read.
        """
        self._file = file
        self.size = path.stat().st_size
        self.whole = True
        head = self._file.read(_FILE_HEADER.size)
        version = _FILE_HEADER.unpack(head)[1:5] if len(head) == _FILE_HEADER.size else (0,)
        self._header = _OLD_HEADER if version < _NEWEST else _HEADER
        if version == (0,) or not head.startswith(b"NI10"):
            raise RecordingError(
                f"{path} is named like an .oni file but holds something else; give another file"
            )
        if not (1, 0, 0, 4) <= version <= _NEWEST:
            raise RecordingError(
                f"{path} states version {'.'.join(map(str, version))} of its format, "
                "and versions 1.0.0.4 to 1.0.1.0 can be read; record it again with OpenNI2, or "
                "copy it again if it is damaged"
            )

    def read(self, at: int, size: int) -> bytes:
        """At most `size` bytes at a position, fewer at the end of the file."""
        self._file.seek(at)
        return self._file.read(size)

    def walk(self, progress: Progress) -> Iterator[Record]:
        """Every record in file order, resumed after damage at the next valid record.

        A record is valid only if another one, or the end of the file, follows directly. The last
        one of a cut file is skipped.
        """
        record = self._search(_FILE_HEADER.size)
        ended = False
        reported = -1
        self.whole = record is not None and record.at == _FILE_HEADER.size
        while record is not None:
            ended = record.kind == 0x0B  # the record at the end
            following = self._record_at(record.end) if record.end < self.size else None
            if following is None and record.end != self.size:
                following = self._search(record.at + self._header.size)
                if following is None and (ended or record.end > self.size):
                    break  # bytes after the end, or a cut record
                self.whole = False
                # its size is damaged, not the next record
                if following is not None and following.at < record.end:
                    record = record._replace(end=max(record.payload, following.at))
            yield record
            if record.end >> 20 != reported:
                reported = record.end >> 20
                progress(reported, (self.size >> 20) + 1, "scanning the recording (MB)")
            record = following
        self.whole = self.whole and ended

    def _record_at(self, at: int) -> Record | None:
        header = self._header
        raw = self.read(at, header.size + 64)
        if len(raw) < header.size:
            return None
        magic, kind, node, size, payload_size, _ = header.unpack_from(raw)
        n_fields = size - header.size
        if magic != _RECORD_MAGIC or kind not in range(_OLD_NODE, 0x0F) or n_fields < 0:
            return None
        if kind == _FRAME and n_fields != _FRAME_FIELDS.size:
            return None
        if n_fields > len(raw) - header.size:
            # bytes read of names and numbers
            raw = self.read(at, header.size + min(n_fields, 4096))
        fields = raw[header.size : size]
        return Record(at, kind, node, at + size, at + size + payload_size, fields)

    def _search(self, start: int) -> Record | None:
        """The first record from a position that is within the file."""
        magic = _RECORD_MAGIC.to_bytes(4, "little")
        while start + self._header.size <= self.size:
            block = self.read(start, 1 << 20)
            found = block.find(magic)
            while found >= 0:
                record = self._record_at(start + found)
                if record is not None and record.end <= self.size:
                    return record
                found = block.find(magic, found + 1)
            start += max(1, len(block) - len(magic) + 1)
        return None


class FrameFormat(NamedTuple):
    """Format of some frames.

    Attributes:
        constant: width and height of the full frame, px, and OpenNI's number for the unit (100:
            1 mm, 101: 0.1 mm); the same in a whole recording.
        part: x, y, width, height of the recorded part, px.
        mirrored: True if left and right are exchanged.
        fps: stated, not measured, frame rate, Hz.
    """

    constant: tuple[int, int, int]
    part: tuple[int, int, int, int]
    mirrored: bool
    fps: int


@dataclass
class DepthNode:
    """A depth camera of the file, with one entry for each of its frames.

    Attributes:
        name: name of the node, such as "Depth".
        codec: four bytes, `NONE`, `16zT` or `16zP`.
        n_stated: number of frames by the node's own count; None if not stated.
        properties: the current property values by name.
        entries: (4 n,) for each frame its time, µs, position and size of its payload, bytes, and
            the number of its format in `formats`.
        formats: the frame formats with their numbers; None for frames without a stated size.
    """

    name: str
    codec: bytes
    n_stated: int | None
    properties: dict[str, bytes] = field(default_factory=dict)
    entries: array[int] = field(default_factory=lambda: array("Q"))
    formats: dict[FrameFormat | None, int] = field(default_factory=dict)
    format_now: int | None = None

    @property
    def frames(self) -> NDArray[np.uint64]:
        """The entries, (n, 4)."""
        return np.array(self.entries, np.uint64).reshape(-1, 4)

    def add(self, record: Record) -> None:
        """Add a frame."""
        if self.format_now is None:
            self.format_now = self.formats.setdefault(self._format(), len(self.formats))
        time_us, _ = _FRAME_FIELDS.unpack(record.fields)
        n_bytes = record.end - record.payload
        self.entries.extend((time_us, record.payload, n_bytes, self.format_now))

    def number(self, name: str) -> int | None:
        """Value of an integer property; None if absent."""
        value = self.properties.get(name)
        return int.from_bytes(value[:8], "little") if value else None

    def numbers(self, name: str, layout: str) -> tuple[Any, ...] | None:
        """Numbers of a property by their `struct` layout; None if absent or of another size."""
        value = self.properties.get(name, b"")
        return struct.unpack(layout, value) if len(value) == struct.calcsize(layout) else None

    def _format(self) -> FrameFormat | None:
        mode = self.numbers("xnMapOutputMode", "<III")
        if mode is None:
            return None
        width, height, fps = mode
        cropped, *crop = self.numbers("xnCropping", "<IHHHH") or (0,)
        part = (crop[0], crop[1], crop[2], crop[3]) if cropped else (0, 0, width, height)
        unit = self.number("oniPixelFormat")
        # the pixel format if none is stated
        constant = (width, height, 100 if unit is None else unit)
        return FrameFormat(constant, part, bool(self.number("xnMirror")), fps)


def index_file(file: OniFile, progress: Progress) -> tuple[list[DepthNode], set[str]]:
    """The depth nodes, and the names of at most 100 other nodes.

    Afterwards, the file's `whole` is False if anything was damaged.
    """
    depth: dict[int, DepthNode] = {}
    others: set[str] = set()
    sound = True
    for record in file.walk(progress):
        try:
            if record.kind in (_OLD_NODE, 0x0C, 0x0D):  # all three add a node
                name, rest = _text(record.fields)
                kind, codec = _NODE_FIELDS.unpack_from(rest)
                n_stated = _UNKNOWN_COUNT
                if record.kind != _OLD_NODE:
                    n_stated, *_ = struct.unpack_from("<IQQ", rest, _NODE_FIELDS.size)
                # 1 is the device, 3 colour, 4 infrared
                if kind == 2:
                    stated = None if n_stated == _UNKNOWN_COUNT else n_stated
                    depth.setdefault(record.node, DepthNode(name, codec, stated))
                elif len(others) < 100:
                    others.add(name)
            elif (node := depth.get(record.node)) is None:
                continue
            # integer, real, text, bytes
            elif record.kind in (0x03, 0x04, 0x05, 0x06):
                name, rest = _text(record.fields)
                (size,) = struct.unpack_from("<I", rest)
                # bytes; the used properties have at most 32
                if name in _USED and len(value := rest[4 : 4 + size]) <= 64:
                    node.properties[name] = value
                    node.format_now = None
            elif record.kind == _FRAME and record.end > record.payload:
                node.add(record)
        except struct.error:
            sound = False
    file.whole = file.whole and sound
    return list(depth.values()), others


def _text(fields: bytes) -> tuple[str, bytes]:
    """A string at the beginning of some fields, preceded by its length, and the rest."""
    (size,) = struct.unpack_from("<I", fields)
    return fields[4 : 4 + size].split(b"\0")[0].decode("latin-1"), fields[4 + size :]


RAW = b"NONE"
WITH_TABLE = b"16zT"
_UNIT_MM = {100: 1.0, 101: 0.1}  # OpenNI's pixel formats of depth
_LATEST_US = 2**62 // 1000

# of PrimeSense's reference design: 120 mm / (2 x 0.1052 mm)
_VGA_FOCAL = 570.342
_VGA_WIDTH = 640
_FIELDS_OF_VIEW = (math.radians(5.0), math.radians(170.0))


def _frame_reader(
    file: OniFile, node: DepthNode, form: FrameFormat, how: CameraFile
) -> Callable[[int], Depth | str]:
    """The function that reads depth of a frame by its number, or what is wrong with it.

    Args:
        file: the open file.
        node: the depth node with the positions of its frames.
        form: the format of the recording's frames.
        how: a camera.toml next to the file, for its unit_mm (a further factor) and unread.
    """
    columns, rows, unit = form.constant
    wrong = f" is damaged or not of {columns} x {rows} pixels"
    every_value = np.arange(1 << 16, dtype=np.uint16)
    meaning = depth_mm(every_value, _UNIT_MM[unit] * how.unit_mm, how.unread)
    frames = node.frames
    formats = list(node.formats)
    lock = Lock()

    def read(number: int) -> Depth | str:
        """Depth (H, W) float32 mm of one frame, 0 where unread."""
        _, at, size, k = frames[number].tolist()
        own = formats[k]
        if own is None or own.constant != form.constant:
            return wrong
        x, y, width, height = own.part
        n = width * height
        # the code, the longest table, and the counts before both
        most = WORST_BYTES_A_PIXEL * n + (1 << 17) + 4
        if not n or x + width > columns or y + height > rows or size > most:
            return wrong
        with lock:
            payload = np.frombuffer(file.read(at, size), np.uint8)
        if node.codec != RAW:
            part = unpack_16z(payload, meaning, n, node.codec == WITH_TABLE)
        else:
            part = meaning[payload.view("<u2")] if len(payload) == 2 * n else None
        if part is None:
            return wrong
        depth = part.reshape(height, width)
        if n != columns * rows:
            depth = np.zeros((rows, columns), np.float32)
            depth[y : y + height, x : x + width] = part.reshape(height, width)
        # undo the exchange of left and right
        return np.ascontiguousarray(depth[:, ::-1]) if own.mirrored else depth

    return read


def open_oni(
    path: Path, camera: Lens | None = None, fps: float | None = None, progress: Progress = silent
) -> Recording:
    """Open the depth of an .oni file as a recording.

    Args:
        path: the .oni file.
        camera: overrides the camera in the files.
        fps: frame rate, Hz; used only if all frames have the same time.
        progress: reports how many MB were indexed.

    Returns:
        The recording of the first depth node with frames.

    Raises:
        RecordingError: there are no depth frames, they cannot be decoded, or the camera is unknown.
    """
    # unbuffered: every read follows a seek, and a buffer would read 8 kB for each 40 bytes
    raw = path.open("rb", buffering=0)
    with closing_on_error(raw):
        file = OniFile(path, raw)
        nodes, others = index_file(file, progress)
        problems: list[str] = []
        node = _choose(path, file, nodes, others, problems)
        form = _format(path, node, problems)
        width, height, _ = form.constant
        n = len(node.frames)
        whole = file.whole and (node.n_stated is None or node.n_stated <= n)
        if node.n_stated not in (None, n):
            problems.append(
                f"{path.name} promises {node.n_stated} frames of {node.name}, and {n} are in it"
            )
        if not whole:
            problems.append(
                f"{path.name} is cut or damaged; {n} whole frame{'' if n == 1 else 's'} "
                "can be read from it"
            )
        camera_file = CameraFile.read(path.parent / CAMERA_FILE)
        problems += camera_file.problems
        the_camera = _camera(path, node, form, camera_file, camera, problems)
        monotone = in_order_of_sensor(_times(node, form, fps, problems))
        problems += [monotone.problem] if monotone.problem else []
        read = _frame_reader(file, node, form, camera_file)
        probed = np.linspace(0, n - 1, min(n, 5)).astype(int).tolist()
        if all(isinstance(read(i), str) for i in probed):
            raise RecordingError(
                f"{path} states images of {width} x {height} pixels, but its frames do not "
                "unpack to that; it is damaged, so copy it again"
            )
    start = start_of_clock(int(monotone.times_ns[0]))
    return Recording(
        name=path.resolve().stem,
        format="oni",
        camera=the_camera,
        times_ns=monotone.times_ns,
        read=unread_where_damaged(read, (height, width), problems),
        sources=[path],
        problems=problems,
        truncated=not whole,
        close=raw.close,
        faults=monotone.faults,
        stored=monotone.order,
        metadata=({"session_start_time": start} if start else {}) | camera_file.metadata,
    )


def _choose(
    path: Path, file: OniFile, depth: list[DepthNode], others: set[str], problems: list[str]
) -> DepthNode:
    """The first depth node with frames, chosen by kind: names are arbitrary."""
    nodes = [node for node in depth if node.entries]
    cut = "" if file.whole else "the file is cut or damaged, and "
    if not nodes:
        named = sorted({node.name for node in depth} | others)
        what = f"its nodes are {', '.join(named)}" if named else "it holds no node of any kind"
        raise RecordingError(
            f"{path} holds no depth frames: {cut}{what}; give a recording of the depth camera"
        )
    node = nodes[0]
    if len(nodes) > 1:
        problems.append(
            f"{path.name} holds frames of {len(nodes)} depth cameras; those of the first, "
            f"{node.name}, are read"
        )
    if node.codec not in (RAW, WITH_TABLE, b"16zP"):
        raise RecordingError(
            f"{path} holds its depth in the code {node.codec.decode('latin-1')!r}, and {cut}NONE, "
            "16zT and 16zP can be read; record it again without compression"
        )
    return node


def _format(path: Path, node: DepthNode, problems: list[str]) -> FrameFormat:
    """The format of most frames; frames of another size or unit become unread."""
    used = node.frames[:, 3].astype(np.int64)
    formats = list(node.formats)
    form = formats[int(np.bincount(used).argmax())]
    if form is None:
        raise RecordingError(
            f"{path} does not state the size of its images (xnMapOutputMode); copy it again"
        )
    width, height, unit = form.constant
    # limits the memory for a frame with a damaged header
    if not 0 < width * height <= (1 << 24):
        raise RecordingError(
            f"{path} states images of {width} x {height} pixels, which no depth camera "
            "has; it is damaged, so copy it again"
        )
    if unit not in _UNIT_MM:
        what = "the sensor's raw shifts" if unit in (102, 103) else f"the unit {unit}"
        raise RecordingError(
            f"{path} holds {what} (oniPixelFormat), and depth in steps of 1 mm or 0.1 mm can be "
            "read; record it again as depth"
        )
    differ = [one is None or one.constant != form.constant for one in formats]
    if others := int(np.array(differ)[used].sum()):
        problems.append(
            f"{others} of {len(used)} frames have another size or unit than {width} x "
            f"{height} pixels, and are taken as wholly unread"
        )
    if form.mirrored:
        problems.append(
            "the camera delivered mirror images (xnMirror); left and right were put back in their "
            "places"
        )
    x, y, columns, rows = form.part
    if (columns, rows) != (width, height):
        problems.append(
            f"the camera recorded only {columns} x {rows} pixels at ({x}, {y}) of its {width} "
            f"x {height}; the rest is unread"
        )
    return form


def _times(node: DepthNode, form: FrameFormat, fps: float | None, problems: list[str]) -> Times:
    """Microseconds as ns; a constant rate if the clock stood still."""
    stamps = node.frames[:, 0]
    n = len(stamps)
    if n > 1 and np.all(stamps == stamps[0]):
        stated = rate(fps, "the call")
        hz = stated or float(form.fps if 0 < form.fps <= 1000 else 30.0)
        origin = (
            "as stated"
            if stated
            else "which the file names as its rate; state fps if yours differs"
        )
        problems.append(
            f"all frames have the same time stamp, so a constant {hz:g} frames/s was assumed, "
            f"{origin}"
        )
        return from_rate(n, hz)
    order = np.arange(n)
    sane = np.maximum.accumulate(np.where(stamps <= _LATEST_US, order, 0))
    if n_wild := int((sane != order).sum()):
        problems.append(
            f"{n_wild} of {n} time stamps are damaged, for they are later than any clock; these "
            "frames were taken to follow the one before at once"
        )
    times_us = np.minimum(stamps[sane], np.uint64(_LATEST_US)).astype(np.int64)
    return times_us * 1000 + (order - sane)


def _camera(
    path: Path,
    node: DepthNode,
    form: FrameFormat,
    camera_file: CameraFile,
    stated: Lens | None,
    problems: list[str],
) -> Camera:
    """The camera given by the caller, or else in a camera.toml next to the file, or else in the
    file.
    """
    width, height, _ = form.constant
    # a camera.toml has priority: the file has the design values of the model, not a
    # calibration
    if stated is not None or camera_file.intrinsics:
        return camera_file.camera(width, height, stated)
    ours = node.numbers("liexIntrinsics", "<dddd")
    if ours is not None and np.isfinite(ours).all() and _can_be(ours[:2], (width, height)):
        source = "intrinsics in the .oni file (liexIntrinsics)"
        return Camera(ours[0], ours[1], ours[2], ours[3], width, height, source=source)
    focal, source = _stated_focal(node, (width, height), problems)
    if focal is None and (width, height) in (
        (160, 120),
        (320, 240),
        (640, 480),
        (1280, 960),
        (1280, 1024),
    ):
        focal = (_VGA_FOCAL * width / _VGA_WIDTH,) * 2
        source = "typical PrimeSense"
        problems.append(
            "the file states no field of view, so the intrinsics of a typical PrimeSense camera "
            "were taken; state your camera's own in a camera.toml beside the recording"
        )
    if focal is None:
        raise RecordingError(
            f"{path} states no field of view for its {width} x {height} pixels; write a "
            "camera.toml beside it with [camera], fx = ..., fy = ..., cx = ... and cy = ... in "
            "pixels"
        )
    # OpenNI's optical axis is at half the size, in our pixel coordinates
    cx = width / 2 if not form.mirrored else width - 1 - width / 2
    return Camera(*focal, cx, height / 2, width, height, source=source)


def _stated_focal(
    node: DepthNode, size: tuple[int, int], problems: list[str]
) -> tuple[tuple[float, float] | None, str]:
    """Focal lengths (fx, fy) px and their source; (None, "") without plausible ones in the file."""
    found: list[tuple[tuple[float, float], str]] = []
    view = node.numbers("xnFOV", "<dd")
    if view is not None and all(0 < angle < math.pi for angle in view):
        fx, fy = (n / 2 / math.tan(angle / 2) for n, angle in zip(size, view, strict=True))
        found.append(((fx, fy), "field of view in the .oni file (xnFOV)"))
    if (plane := node.numbers("xnRealWorldTranslationData", "<ddd")) is not None and plane[
        1
    ] * plane[2] > 0:
        focal = plane[0] / (plane[1] * plane[2])
        found.append(((focal, focal), "lens in the .oni file (xnRealWorldTranslationData)"))
    distance = node.number("ZPD")
    pixel = node.numbers("ZPPS", "<d")
    if distance is not None and pixel is not None and pixel[0] > 0:
        # columns of the sensor for which ZPPS states the pixel size
        focal = distance / pixel[0] * size[0] / 1280
        found.append(((focal, focal), "lens in the .oni file (ZPD and ZPPS)"))
    for focal_lengths, source in found:
        if _can_be(focal_lengths, size):
            return focal_lengths, source
        problems.append(
            f"the {source} cannot be: focal lengths of {focal_lengths[0]:g} and "
            f"{focal_lengths[1]:g} px"
        )
    return None, ""


def _can_be(focal: tuple[float, float], size: tuple[int, int]) -> bool:
    """Whether focal lengths are plausible for a lens, with roughly square pixels."""
    if not all(math.isfinite(f) and f > 0 for f in focal) or not 0.5 < focal[0] / focal[1] < 2.0:
        return False
    views = [2 * math.atan(n / 2 / f) for n, f in zip(size, focal, strict=True)]
    return all(_FIELDS_OF_VIEW[0] < view < _FIELDS_OF_VIEW[1] for view in views)
