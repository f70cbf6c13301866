"""Selection of the depth topic in an MCAP file or ROS bag, with its calibration and its clock.

One walk over the file finds the topics whose first message is depth, and the first calibration of
every topic that has one. The calibration of the same frame_id is taken, nearest by topic name; a
rectified topic takes P instead of K. Stamps are the sensor's, or the times of logging where
pictures have none.
"""

from __future__ import annotations

import math
import struct
from array import array
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from threading import Lock

import numpy as np
from numpy.typing import NDArray

from liex_lab.errors import LiexError, RecordingError, UnknownCameraError
from liex_lab.optics.camera import Camera, Distortion, Lens
from liex_lab.recordings.camera_file import CAMERA_FILE, CameraFile, fitting
from liex_lab.recordings.formats.messages.depth_images import decode, picture_size
from liex_lab.recordings.formats.messages.message_file import (
    Channel,
    Envelope,
    Listed,
    MessageFile,
    Place,
    printable,
)
from liex_lab.recordings.formats.messages.messages import (
    CALIBRATION_SCHEMAS,
    CLOUD_SCHEMAS,
    UNIT_TOPIC,
    Calibration,
    DamagedMessage,
    DepthMessage,
    DepthUnit,
    Parser,
)
from liex_lab.recordings.formats.messages.pack_facts import PackFacts
from liex_lab.recordings.formats.messages.parsers import parser_of, plain_schema
from liex_lab.recordings.frame import Depth
from liex_lab.recordings.infrared import is_infrared
from liex_lab.recordings.recording import Recording
from liex_lab.recordings.timestamps import make_monotone, start_of_clock
from liex_lab.runtime.progress import Progress

# 16-bit pictures too, but of brightness: not chosen unless asked for
_EXPECTED = (
    "expected foxglove.RawImage or CompressedImage, or sensor_msgs Image or CompressedImage, with "
    "the encoding 16UC1, mono16 or 32FC1 or as 16-bit PNG, or a point cloud"
)
_LIMIT_NS = 2**62  # the year 2116
_DAMAGE = (ValueError, TypeError, KeyError, OverflowError, struct.error)
_FACTS = ("subject_id", "session_start_time")


@dataclass
class _Topic:
    """The depth messages of one topic, in file order, and what its first one says.

    Attributes:
        channel: topic, schema and encoding.
        parse: turns the bytes of a message into depth.
        frame_id: name of the camera's frame.
        size: width and height, px; (0, 0) for loose points.
        log_ns: (n,) times of logging, ns.
        stamp_ns: (n,) stamps of the sensor, ns.
        places: (3 n,) chunk, offset and length of each message.
    """

    channel: Channel
    parse: Parser
    frame_id: str
    size: tuple[int, int]
    log_ns: array[int] = field(default_factory=lambda: array("q"))
    stamp_ns: array[int] = field(default_factory=lambda: array("q"))
    places: array[int] = field(default_factory=lambda: array("q"))  # three to a message

    @property
    def name(self) -> str:
        """Name of the topic."""
        return self.channel.topic

    def add(self, message: Envelope, stamp_ns: int) -> None:
        """Note a message.

        Args:
            message: the message as it was met.
            stamp_ns: its stamp, ns.

        Raises:
            DamagedMessage: one of its times is beyond the year 2116.
        """
        if max(message.log_time_ns, abs(stamp_ns)) >= _LIMIT_NS:
            raise DamagedMessage("a message's time cannot be")
        self.log_ns.append(message.log_time_ns)
        self.stamp_ns.append(stamp_ns)
        self.places.extend(message.place)

    def add_all(self, listed: Listed) -> None:
        """Note messages that an index lists.

        Args:
            listed: the messages.

        Raises:
            DamagedMessage: a time is beyond the year 2116; the others are noted.
        """
        good = listed.log_time_ns < _LIMIT_NS
        stamps = listed.log_time_ns if listed.stamp_ns is None else listed.stamp_ns
        good &= (stamps < _LIMIT_NS) & (stamps > -_LIMIT_NS)
        self.log_ns.frombytes(listed.log_time_ns[good].astype(np.int64).tobytes())
        self.stamp_ns.frombytes(stamps[good].astype(np.int64).tobytes())
        self.places.frombytes(np.ascontiguousarray(listed.places[good], np.int64).tobytes())
        if not good.all():
            raise DamagedMessage("a message's time cannot be")

    def forget(self, chunk: int) -> None:
        """Forget the messages of a chunk and of those after it, for they will be met again.

        Args:
            chunk: number of the chunk; these messages are at the end.
        """
        while self.places and self.places[-3] >= chunk:
            del self.places[-3:], self.log_ns[-1], self.stamp_ns[-1]


@dataclass
class _Found:
    """What a file holds, as far as it was walked.

    Attributes:
        parsers: by channel; None of channels that are of no use.
        depths: the depth topics by channel.
        calibrations: the first calibration by topic.
        units: the unit of depth by topic.
    """

    parsers: dict[Channel, Parser | None] = field(default_factory=dict)
    depths: dict[Channel, _Topic] = field(default_factory=dict)
    calibrations: dict[str, Calibration] = field(default_factory=dict)
    units: dict[str, DepthUnit] = field(default_factory=dict)


class _Frames:
    """Pictures of one topic, fetched from the file one at a time."""

    def __init__(
        self,
        file: MessageFile,
        topic: _Topic,
        order: NDArray[np.int64],
        camera: Camera,
        step_mm: float,
        camera_file: CameraFile,
        problems: list[str],
    ) -> None:
        self._file = file
        self._topic = topic
        self._camera = camera
        self._step_mm = step_mm
        self._places = np.array(topic.places, np.int64).reshape(-1, 3)[order]
        self._scale = camera_file.unit_mm
        self._unread = camera_file.unread
        self._problems = problems
        self._bad = set[int]()
        self._lock = Lock()

    def read(self, number: int) -> Depth:
        """Depth of one picture; one that is damaged or of another size is wholly unread.

        Args:
            number: index of the picture, in order of logging.

        Returns:
            (H, W) float32 mm, 0 where unread.
        """
        with self._lock:
            data = self._file.read(Place(*self._places[number].tolist()))
        depth = self._decode(data)
        if depth is not None:
            return depth
        camera = self._camera
        if number not in self._bad:
            self._bad.add(number)
            self._problems.append(
                f"frame {number} of {printable(self._topic.name)} is damaged or not of "
                f"{camera.width} x {camera.height} pixels, and was taken as wholly unread"
            )
        return np.zeros((camera.height, camera.width), np.float32)

    def _decode(self, data: memoryview) -> Depth | None:
        try:
            message = self._topic.parse(data)
        except _DAMAGE as error:
            if self._file.parsed:
                return None
            raise RecordingError(
                f"{self._file.path} is damaged ({error}); copy it again, or go on with what is "
                "whole by adding --set recording.accept_truncated=true"
            ) from None
        assert isinstance(message, DepthMessage)
        try:
            return decode(message, self._camera, self._step_mm, self._scale, self._unread)
        except _DAMAGE:
            return None


def open_topic(
    file: MessageFile, kind: str, camera: Lens | None, topic: str | None, progress: Progress
) -> Recording:
    """Open one depth topic of a file of messages as a recording.

    The recording closes the file; it is closed, too, where opening fails.

    Args:
        file: the open MCAP file or ROS bag.
        kind: name of the format, for `Recording.format`.
        camera: comes before whatever the files state.
        topic: name of the depth topic; None for the only one.
        progress: told how far the walk over the file is.

    Returns:
        The recording; it can be read on where the file grows (MCAP).

    Raises:
        RecordingError: there is no depth topic, several to choose from, or the camera is not known.
    """
    try:
        return _open(file, kind, camera, topic, progress, _Found())
    except BaseException:
        file.close()
        raise


def _open(
    file: MessageFile,
    kind: str,
    camera: Lens | None,
    topic: str | None,
    progress: Progress,
    found: _Found,
) -> Recording:
    """`open_topic` of a file in which this much was found before."""
    path = file.path
    _walk(file, found, progress)

    def grow() -> Recording | None:
        n_chunks = file.go_on()
        if n_chunks is None:
            return None
        for depth in found.depths.values():
            depth.forget(n_chunks)
        return _open(file, kind, camera, topic, progress, found)

    chosen = _choose(file, found, topic)
    camera_file = CameraFile.read(path.parent / CAMERA_FILE)
    problems: list[str] = list(camera_file.problems)
    if not file.whole:
        problems.append(
            f"{path.name} is cut or damaged; {len(chosen.log_ns)} whole depth pictures can be read "
            "from it"
        )
    the_camera = _camera(
        path, chosen, found.calibrations, camera_file, camera, file.notes, problems
    )
    # A writer may flush its topics out of turn; the order of logging is the file's own order.
    order = np.argsort(np.array(chosen.log_ns, np.int64), kind="stable")
    monotone = make_monotone(_stamps(chosen, order, problems))
    problems += [monotone.problem] if monotone.problem else []
    packed = PackFacts.of(file.notes)
    problems += packed.problems
    start = start_of_clock(int(monotone.times_ns[0]))
    stated = {name: file.notes[name] for name in _FACTS if name in file.notes}
    metadata = ({"session_start_time": start} if start else {}) | stated | camera_file.metadata
    frames = _Frames(
        file,
        chosen,
        order,
        the_camera,
        _step_mm(chosen, found.units) * packed.step_mm,
        camera_file,
        problems,
    )
    return Recording(
        name=packed.name(path.resolve().stem),
        format=kind,
        camera=the_camera,
        times_ns=monotone.times_ns,
        read=frames.read,
        sources=[path],
        problems=problems,
        truncated=not file.whole,
        metadata=metadata | packed.metadata,
        close=file.close,
        faults=packed.faults(monotone.faults),
        doubts=packed.doubts,
        grow=grow,
    )


def _stamps(topic: _Topic, order: NDArray[np.int64], problems: list[str]) -> NDArray[np.int64]:
    """The sensor's stamps; the times of logging instead when pictures have none (zero), for two
    clocks do not mix.
    """
    stamps = np.array(topic.stamp_ns, np.int64)[order]
    logged = np.array(topic.log_ns, np.int64)[order]
    unstamped = int(((stamps == 0) & (logged != 0)).sum())
    if unstamped == 1 and len(stamps) > 1 and np.all(np.diff(stamps) > 0):
        unstamped = 0  # a clock that begins at zero with the first picture
    if unstamped:
        problems.append(
            f"{unstamped} of {len(stamps)} pictures have no stamp of the sensor, so the times of "
            "logging are used"
        )
    return logged if unstamped else stamps


def _walk(file: MessageFile, found: _Found, progress: Progress) -> None:
    """Find the depth topics, and the first calibration of every topic that has one."""
    parsers = found.parsers

    def wanted(channel: Channel) -> bool:
        if channel not in parsers:
            parsers[channel] = parser_of(channel)
        calibrated = (
            plain_schema(channel) in CALIBRATION_SCHEMAS and channel.topic in found.calibrations
        )
        return parsers[channel] is not None and not calibrated

    for message in file.walk(wanted, progress):
        parse = parsers[message.channel]
        assert parse is not None
        try:
            if not _note(found, message, parse):
                parsers[message.channel] = None  # its first picture is not depth
        except _DAMAGE:
            file.whole = False


def _note(found: _Found, envelope: Envelope | Listed, parse: Parser) -> bool:
    """Take note of a message; False where it is the first picture of a topic and not depth."""
    channel = envelope.channel
    if isinstance(envelope, Listed):
        if channel in found.depths:
            found.depths[channel].add_all(envelope)
        return True
    message = parse(envelope.data)
    if isinstance(message, Calibration):
        found.calibrations[channel.topic] = message
        return True
    if isinstance(message, DepthUnit):
        found.units[channel.topic] = message
        return True
    if channel not in found.depths:
        size = picture_size(message)
        if size is None:
            return False
        found.depths[channel] = _Topic(channel, parse, message.frame_id, size)
    found.depths[channel].add(envelope, message.stamp_ns)
    return True


def _choose(file: MessageFile, found: _Found, topic: str | None) -> _Topic:
    """The topic asked for, or the only one. Pictures come before point clouds, which are made of
    them.
    """
    depths = list(found.depths.values())
    path = file.path
    names = ", ".join(sorted(printable(depth.name) for depth in depths))
    if topic is not None:
        for depth in depths:
            if depth.name == topic:
                return depth
        offer = f"the depth topics are {names}" if names else "there is no depth topic in it"
        raise RecordingError(f"{path} has no depth pictures on the topic {topic!r}; {offer}")
    pictures = [depth for depth in depths if plain_schema(depth.channel) not in CLOUD_SCHEMAS]
    visible = [depth for depth in pictures if not is_infrared(depth.name)]
    for some in (visible, pictures, depths):
        if len(some) == 1:
            return some[0]
        if some:
            choice = sorted(printable(depth.name) for depth in some)
            raise RecordingError(
                f"{path} holds depth pictures on {len(some)} topics, {', '.join(choice)}; choose "
                f"one with --topic {choice[0]} (in Python topic=), or in a plan with "
                "recording.topic"
            )
    raise _no_depth(file)


def _no_depth(file: MessageFile) -> RecordingError:
    described = {
        f"{printable(c.topic)} ({printable(c.schema)}, {printable(c.encoding)})"
        for c in file.channels
    }
    listed = ", ".join(sorted(described)[:8]) + (", ..." if len(described) > 8 else "")
    cut = "the file is cut or damaged, and " if not file.whole else ""
    return RecordingError(
        f"{file.path} holds no depth pictures: {cut}its topics are {listed or 'none'}; {_EXPECTED}"
    )


def _step_mm(topic: _Topic, units: dict[str, DepthUnit]) -> float:
    """Millimetres in a step of 16-bit depth: 1, unless a RealSense recording says otherwise."""
    sensors = [name for name in units if topic.name.startswith(name.removesuffix(UNIT_TOPIC) + "/")]
    metres = units[sensors[0]].metres if sensors else 0.0
    # a float32 was written, and 0.001 was meant
    return float(f"{metres:.6g}") * 1000.0 if math.isfinite(metres) and metres > 0 else 1.0


def _camera(
    path: Path,
    topic: _Topic,
    calibrations: dict[str, Calibration],
    camera_file: CameraFile,
    stated: Lens | None,
    notes: dict[str, str],
    problems: list[str],
) -> Camera:
    """Stated by the caller, or else calibrated in the file, or else in a camera.toml beside it."""
    found = _calibration_of(topic, calibrations)
    if stated is None and found is not None:
        return _calibrated(topic, *found, notes, problems)
    if stated is None and not camera_file.intrinsics:
        several = (
            f", which has {len(calibrations)} calibrations, none of them for"
            if calibrations
            else " for"
        )
        raise UnknownCameraError(
            f"{path} holds no CameraCalibration or CameraInfo{several} {printable(topic.name)}; "
            "write a camera.toml beside it with [camera], fx = ..., fy = ..., cx = ... and cy = "
            "... in pixels"
        )
    known = (
        (stated.width, stated.height)
        if isinstance(stated, Camera)
        else (camera_file.width, camera_file.height)
    )
    size = _size(topic, (known[0] or 0, known[1] or 0))
    if not min(size):
        raise RecordingError(
            f"{path} holds points that lie in no picture on {printable(topic.name)}; write a "
            "camera.toml beside it with [camera], width = ... and height = ... in pixels, to say "
            "which picture they are seen in"
        )
    return camera_file.camera(*size, stated)


def _calibrated(
    topic: _Topic, where: str, calibration: Calibration, notes: dict[str, str], problems: list[str]
) -> Camera:
    """The camera of a calibration; without distortion where the picture was straightened, and for
    points.
    """
    is_cloud = plain_schema(topic.channel) in CLOUD_SCHEMAS
    straight = "rect" in topic.name.rpartition("/")[2] or is_cloud
    p = calibration.p
    k = (*p[0:3], *p[4:7]) if straight and len(p) == 12 and p[0] > 0 else calibration.k[:6]
    bent = None
    try:
        bent = None if straight else Distortion.of(calibration.model, calibration.d)
    except LiexError:
        problems.append(
            f"{printable(where)} states a lens distortion ({printable(calibration.model)}) that is "
            "not known and so not undone"
        )
    kind = "CameraInfo" if topic.channel.encoding in ("ros1", "cdr") else "CameraCalibration"
    source = notes.get(
        "camera_source", f"{kind} on {where}"
    )  # a converted file keeps where the numbers came from
    size = _size(topic, (calibration.width, calibration.height))
    camera = Camera(
        fx=k[0],
        fy=k[4],
        cx=k[2],
        cy=k[5],
        width=calibration.width or size[0],
        height=calibration.height or size[1],
        source=printable(source),
        distortion=bent,
    )
    return fitting(camera, *size, f"the {kind} on {printable(where)}")


def _size(topic: _Topic, of_camera: tuple[int, int]) -> tuple[int, int]:
    """Of the pictures; loose points are seen in a picture of the camera's size."""
    return topic.size if min(topic.size) else of_camera


def _calibration_of(
    topic: _Topic, calibrations: dict[str, Calibration]
) -> tuple[str, Calibration] | None:
    """The calibration of the same camera: of the same frame, and among those on the topic nearest
    by its name.
    """
    # K[0] = 0 means "not calibrated" in these messages
    usable = {
        name: c
        for name, c in calibrations.items()
        if len(c.k) == 9 and np.isfinite(c.k).all() and c.k[0] > 0
    }
    same_frame = {
        name: c for name, c in usable.items() if topic.frame_id and c.frame_id == topic.frame_id
    }
    for some in (same_frame, usable):
        near = {name: _shared(topic.name, name) for name in some}
        nearest = [name for name in some if near[name] == max(near.values())]
        if (
            nearest
            and (len(some) == 1 or near[nearest[0]] > 0)
            and _alike([some[name] for name in nearest])
        ):
            return nearest[0], some[nearest[0]]
    return None


def _shared(one: str, other: str) -> int:
    """How many words of two topics are the same from the beginning on."""
    pairs = list(
        zip(one.strip("/").split("/")[:-1], other.strip("/").split("/")[:-1], strict=False)
    )
    return next((n for n, (a, b) in enumerate(pairs) if a != b), len(pairs))


def _alike(calibrations: Sequence[Calibration]) -> bool:
    first = calibrations[0]
    return all(
        (c.k, c.d, c.width, c.height) == (first.k, first.d, first.width, first.height)
        for c in calibrations
    )
