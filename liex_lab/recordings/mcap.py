"""MCAP recordings with Foxglove's protobuf messages: RawImage (or 16-bit PNG) depth and CameraCalibration."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from google.protobuf.message import DecodeError
from mcap.records import Channel, Schema
from numpy.typing import NDArray

from liex_lab.camera import Camera, Lens
from liex_lab.errors import RecordingError
from liex_lab.progress import Progress, silent
from liex_lab.recordings._mcap_index import Envelope, McapIndex, Place
from liex_lab.recordings._png import decode_png, png_size
from liex_lab.recordings.camera_file import CAMERA_FILE, CameraFile, fitting
from liex_lab.recordings.frame import Depth, depth_mm
from liex_lab.recordings.recording import Recording
from liex_lab.recordings.times import settle, start_of_clock

_RAW, _COMPRESSED, _CALIBRATION = "foxglove.RawImage", "foxglove.CompressedImage", "foxglove.CameraCalibration"
_IMAGES: dict[str, Any] = {_RAW: RawImage, _COMPRESSED: CompressedImage}
_ENCODINGS = {"16UC1": ("<u2", 1.0), "mono16": ("<u2", 1.0), "32FC1": ("<f4", 1000.0)}  # stored type, mm per step


@dataclass
class _Topic:
    """The depth pictures of one topic, in file order, and what its first picture says."""

    name: str
    schema: str
    frame_id: str
    width: int
    height: int
    log_ns: list[int] = field(default_factory=list)
    stamp_ns: list[int] = field(default_factory=list)
    places: list[Place] = field(default_factory=list)


class McapFrames:
    """Pictures of one topic, fetched from the file one at a time."""

    def __init__(self, index: McapIndex, topic: _Topic, unread: CameraFile, problems: list[str]) -> None:
        self._index, self._topic, self._how, self._problems = index, topic, unread, problems
        self._bad: set[int] = set()
        self._lock = Lock()

    def read(self, number: int) -> Depth:
        """Depth (H, W) float32 mm of one picture; one that is damaged or of another size is wholly unread."""
        topic = self._topic
        with self._lock:
            data = self._index.read(topic.places[number])
        depth = _decode(topic.schema, data, self._how)
        if depth is not None and depth.shape == (topic.height, topic.width):
            return depth
        if number not in self._bad:
            self._bad.add(number)
            self._problems.append(
                f"frame {number} of {topic.name} is damaged or not of {topic.width} x {topic.height} pixels, and was "
                "taken as wholly unread"
            )
        return np.zeros((topic.height, topic.width), np.float32)


def open_mcap(
    path: Path,
    camera: Lens | None = None,
    fps: float | None = None,
    progress: Progress = silent,
    topic: str | None = None,
) -> Recording:
    """One depth topic of an MCAP file as a recording. `fps` is not needed: every message has its time."""
    index = McapIndex.open(path)
    try:
        return _open(path, index, camera, topic, progress)
    except BaseException:
        index.close()
        raise


def _open(path: Path, index: McapIndex, camera: Lens | None, topic: str | None, progress: Progress) -> Recording:
    depths, calibrations = _walk(index, progress)
    chosen = _choose(path, index, depths, topic)
    camera_file = CameraFile.read(path.parent / CAMERA_FILE)
    problems: list[str] = list(camera_file.problems)
    if not index.whole:
        problems.append(f"{path.name} is cut or damaged; {len(chosen.places)} whole depth pictures can be read from it")
    the_camera = _camera(path, chosen, calibrations, camera_file, camera, problems)
    # A writer may flush its topics out of turn; the order of logging is the file's own order.
    order = np.argsort(np.array(chosen.log_ns, np.int64), kind="stable")
    chosen.places = [chosen.places[i] for i in order]
    settled = settle(_stamps(chosen, order, problems))
    problems += [settled.problem] if settled.problem else []
    start = start_of_clock(int(settled.times_ns[0]))
    metadata = ({"session_start_time": start} if start else {}) | camera_file.metadata
    return Recording(
        name=path.resolve().stem, format="mcap", camera=the_camera, times_ns=settled.times_ns,
        read=McapFrames(index, chosen, camera_file, problems).read, sources=[path], problems=problems,
        truncated=not index.whole, metadata=metadata, close=index.close, faults=settled.faults,
    )  # fmt: skip


def _stamps(topic: _Topic, order: NDArray[np.int64], problems: list[str]) -> NDArray[np.int64]:
    """The sensor's stamps; the times of logging instead when pictures have none (zero), for two clocks do not mix."""
    stamps, logged = np.array(topic.stamp_ns, np.int64)[order], np.array(topic.log_ns, np.int64)[order]
    unstamped = int((stamps == 0).sum())
    if unstamped == 1 and len(stamps) > 1 and np.all(np.diff(stamps) > 0):
        unstamped = 0  # a clock that begins at zero with the first picture
    if unstamped:
        problems.append(
            f"{unstamped} of {len(stamps)} pictures have no stamp of the sensor, so the times of logging are used"
        )
    return logged if unstamped else stamps


def _walk(index: McapIndex, progress: Progress) -> tuple[dict[str, _Topic], dict[str, CameraCalibration]]:
    """The depth topics, and the first calibration of every topic that has one."""
    depths: dict[str, _Topic] = {}
    calibrations: dict[str, CameraCalibration] = {}
    others: set[str] = set()  # topics whose first picture is not depth

    def wanted(channel: Channel, schema: Schema | None) -> bool:
        if schema is None or channel.message_encoding != "protobuf" or channel.topic in others:
            return False
        return schema.name in _IMAGES or (schema.name == _CALIBRATION and channel.topic not in calibrations)

    for message in index.walk(wanted, progress):
        try:
            if message.schema is not None and message.schema.name == _CALIBRATION:
                calibrations[message.channel.topic] = CameraCalibration.FromString(message.data)
            elif not _add_picture(depths, message):
                others.add(message.channel.topic)
        except DecodeError:
            index.whole = False
    return depths, calibrations


def _add_picture(depths: dict[str, _Topic], message: Envelope) -> bool:
    """Note a depth picture; False where the first picture of a topic is of another kind."""
    assert message.schema is not None
    picture = _IMAGES[message.schema.name].FromString(message.data)
    name = message.channel.topic
    if name not in depths:
        size = _size(picture)
        if size is None:
            return False
        depths[name] = _Topic(name, message.schema.name, picture.frame_id, *size)
    topic = depths[name]
    topic.log_ns.append(message.log_time_ns)
    topic.stamp_ns.append(picture.timestamp.seconds * 10**9 + picture.timestamp.nanos)
    topic.places.append(message.place)
    return True


def _size(picture: Any) -> tuple[int, int] | None:
    """Width and height of a depth picture; None for another kind."""
    if isinstance(picture, RawImage):
        depth = picture.encoding in _ENCODINGS and picture.width and picture.height
        return (picture.width, picture.height) if depth else None
    try:
        return png_size(picture.data[:26], "picture") if picture.format.lower() == "png" else None
    except RecordingError:
        return None  # a colour PNG is a picture for people


def _decode(schema: str, data: bytes, how: CameraFile) -> Depth | None:
    """Depth (H, W) mm of one message; None where it holds no whole depth picture."""
    try:
        picture = _IMAGES[schema].FromString(data)
    except DecodeError:
        return None
    if schema == _COMPRESSED:
        stored = decode_png(np.frombuffer(picture.data, np.uint8)) if picture.data else None
        return None if stored is None else depth_mm(stored, how.unit_mm, how.unread)
    if picture.encoding not in _ENCODINGS:
        return None
    kind, unit_mm = _ENCODINGS[picture.encoding]
    dtype = np.dtype(kind)
    width, height = picture.width, picture.height
    step = picture.step or width * dtype.itemsize
    if step < width * dtype.itemsize or step * height > len(picture.data):
        return None
    rows = np.frombuffer(picture.data, np.uint8, step * height).reshape(height, step)[:, : width * dtype.itemsize]
    stored = np.ascontiguousarray(rows).view(dtype)
    return depth_mm(stored, unit_mm * how.unit_mm, how.unread)


def _choose(path: Path, index: McapIndex, depths: dict[str, _Topic], topic: str | None) -> _Topic:
    names = ", ".join(sorted(depths))
    if topic is not None and topic in depths:
        return depths[topic]
    if topic is not None:
        offer = f"the depth topics are {names}" if names else "there is no depth topic in it"
        raise RecordingError(f"{path} has no depth pictures on the topic {topic!r}; {offer}")
    if not depths:
        raise _no_depth(path, index)
    if len(depths) > 1:
        raise RecordingError(
            f"{path} holds depth pictures on {len(depths)} topics, {names}; choose one, for instance with "
            f"--set recording.topic={sorted(depths)[0]}"
        )
    return next(iter(depths.values()))


def _no_depth(path: Path, index: McapIndex) -> RecordingError:
    described = []
    for channel in index.channels.values():
        schema = index.schemas.get(channel.schema_id)
        described.append(f"{channel.topic} ({schema.name if schema else 'no schema'}, {channel.message_encoding})")
    listed = ", ".join(sorted(described)[:8]) + (", ..." if len(described) > 8 else "")
    cut = "the file is cut or damaged, and " if not index.whole else ""
    return RecordingError(
        f"{path} holds no depth pictures: {cut}its topics are {listed or 'none'}; expected foxglove.RawImage in "
        "protobuf with the encoding 16UC1, mono16 or 32FC1"
    )


def _camera(
    path: Path,
    topic: _Topic,
    calibrations: dict[str, CameraCalibration],
    camera_file: CameraFile,
    stated: Lens | None,
    problems: list[str],
) -> Camera:
    """Stated by the caller, or else calibrated in the file, or else in a camera.toml beside it."""
    found = _calibration_of(topic, calibrations)
    if stated is None and found is not None:
        where, message = found
        if any(message.D):
            problems.append(f"{where} states a lens distortion, which is not undone")
        k = list(message.K)
        source = f"CameraCalibration on {where}"
        size = (message.width or topic.width, message.height or topic.height)
        camera = Camera(fx=k[0], fy=k[4], cx=k[2], cy=k[5], width=size[0], height=size[1], source=source)
        return fitting(camera, topic.width, topic.height, f"the {source}")
    if stated is None and not camera_file.intrinsics:
        several = f", which has {len(calibrations)} calibrations, none of them for" if calibrations else " for"
        raise RecordingError(
            f"{path} holds no CameraCalibration{several} {topic.name}; write a camera.toml beside it with [camera], "
            "fx = ..., fy = ..., cx = ... and cy = ... in pixels"
        )
    return camera_file.camera(topic.width, topic.height, stated)


def _calibration_of(topic: _Topic, calibrations: dict[str, CameraCalibration]) -> tuple[str, CameraCalibration] | None:
    """The calibration of the same camera: of the same frame, else on a neighbouring topic, else the only one."""
    # K[0] = 0 means "not calibrated" in this schema
    usable = {name: c for name, c in calibrations.items() if len(c.K) == 9 and np.isfinite(c.K).all() and c.K[0] > 0}
    same_frame = {name: c for name, c in usable.items() if topic.frame_id and c.frame_id == topic.frame_id}
    parent = topic.name.rpartition("/")[0]
    beside = {name: c for name, c in usable.items() if name.rpartition("/")[0] == parent}
    both = {name: c for name, c in same_frame.items() if name in beside}
    for some in (both, same_frame, beside, usable):
        if len(some) == 1:
            return next(iter(some.items()))
    return None
