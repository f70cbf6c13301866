"""Depth in ROS's messages, as MCAP, .bag and .db3: laid out by `rosbags`, which knows nothing of
our readers.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
from numpy.typing import NDArray
from rosbags import rosbag1, rosbag2
from rosbags.typesys import Stores, get_typestore

from liex_lab.optics.camera import Camera
from liex_lab.recordings.depth_kernels import pack_rvl
from tests.recordings.writers import SMALL, STEP_NS, even_times

INVERSE_A, INVERSE_B = 10100.0, 1.0 - 10100.0 / 10.0  # ROS's own values for depths up to 10 m


@dataclass(frozen=True)
class How:
    """What is written; `calibrated`: with a CameraInfo.

    kind: 16UC1, mono16, 32FC1, png, rvl, 32FC1 png, 32FC1 rvl, plain png, cloud or loose cloud.
    """

    kind: str = "16UC1"
    topics: tuple[str, ...] = ("/camera/depth/image_raw",)
    camera: Camera = SMALL
    calibrated: bool = True
    distortion: tuple[float, ...] = ()
    model: str = "plumb_bob"
    big_endian: bool = False
    padding: int = 0
    log_delay_ns: int = 0
    stamped: bool = True
    times_ns: Sequence[int] | None = None
    frame_id: str | None = None  # of the images; None: their topic
    log_ns: Sequence[int] | None = None  # times of logging in place of the delayed ones
    infos: Sequence[Info] | None = None  # calibrations in place of that of the camera


@dataclass(frozen=True)
class Info:
    """A CameraInfo; `camera` is what it states, and None zeroes.

    at: before which image it is logged.
    """

    camera: Camera | None
    topic: str = "/camera/depth/camera_info"
    frame_id: str = "/camera/depth/image_raw"
    at: int = 0
    binning: tuple[int, int] = (0, 0)
    roi: tuple[int, int, int, int] = (0, 0, 0, 0)  # x, y, width, height
    size: tuple[int, int] | None = None


@cache
def store(ros: int) -> Any:
    """The messages of ROS 1 or 2, and what packs them."""
    return get_typestore(Stores.ROS1_NOETIC if ros == 1 else Stores.ROS2_HUMBLE)


def ros_messages(ros: int, frames: NDArray[Any], how: How) -> Iterator[tuple[str, int, Any]]:
    """Topic, time of logging and message, in order of time."""
    times = even_times(len(frames)) if how.times_ns is None else how.times_ns
    logged = [t + how.log_delay_ns for t in times] if how.log_ns is None else how.log_ns
    for topic in how.topics:
        if how.calibrated and how.infos is None:
            where = topic.rpartition("/")[0] + "/camera_info"
            yield where, times[0] + how.log_delay_ns, _camera_info(ros, topic, times[0], how)
    for n, (time_ns, log_ns, frame) in enumerate(zip(times, logged, frames, strict=True)):
        for info in how.infos or ():
            if info.at == n:
                yield info.topic, log_ns, info_message(ros, time_ns, info, how)
        for topic in how.topics:
            stamp = time_ns if how.stamped else 0
            frame_id = topic if how.frame_id is None else how.frame_id
            yield topic, log_ns, depth_message(ros, frame, stamp, frame_id, how)


def depth_message(ros: int, frame: NDArray[Any], time_ns: int, frame_id: str, how: How) -> Any:
    """One depth image (mm, or metres where it is float) as a message."""
    types, header = store(ros).types, _header(ros, time_ns, frame_id)
    if "cloud" in how.kind:
        return _cloud(ros, frame, header, how)
    if how.kind in ("16UC1", "mono16", "32FC1"):
        ordered = np.ascontiguousarray(
            frame.astype(frame.dtype.newbyteorder(">" if how.big_endian else "<"))
        )
        rows = ordered.view(np.uint8).reshape(len(frame), -1)
        padded = np.pad(rows, ((0, 0), (0, how.padding)), constant_values=0xAB)
        height, width = frame.shape
        return types["sensor_msgs/msg/Image"](
            header, height, width, how.kind, int(how.big_endian), padded.shape[1], padded.ravel()
        )
    packing, data = _packed(frame, how.kind)
    return types["sensor_msgs/msg/CompressedImage"](header, packing, np.frombuffer(data, np.uint8))


def _packed(frame: NDArray[Any], kind: str) -> tuple[str, bytes]:
    if kind == "plain png":  # as compressed_image_transport packs a 16-bit image
        return "16UC1; png compressed ", cv2.imencode(".png", frame)[1].tobytes()
    head, encoding = struct.pack("<iff", 0, 0.0, 0.0), "16UC1"
    if kind.startswith("32FC1"):
        head, encoding = struct.pack("<iff", 1, INVERSE_A, INVERSE_B), "32FC1"
        with np.errstate(divide="ignore"):
            frame = np.where(frame > 0, INVERSE_A / frame + INVERSE_B + 0.5, 0).astype(np.uint16)
    if kind.endswith("rvl"):
        body = struct.pack("<II", frame.shape[1], frame.shape[0]) + pack_rvl(frame).tobytes()
        return f"{encoding}; compressedDepth rvl", head + body
    return f"{encoding}; compressedDepth png", head + cv2.imencode(".png", frame)[1].tobytes()


def points_of(frame: NDArray[Any], camera: Camera) -> NDArray[np.float32]:
    """The points (H, W, 3), m, that a depth image in mm stands for; NaN where it is unread."""
    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    points = camera.unproject(np.stack([u, v], axis=-1), frame.astype(float)) / 1000.0
    points[frame == 0] = np.nan
    return points.astype(np.float32)


def _cloud(ros: int, frame: NDArray[Any], header: Any, how: How) -> Any:
    types, points = store(ros).types, points_of(frame, how.camera)
    if how.kind == "loose cloud":  # in no order, and only those that were read
        points = points[~np.isnan(points[..., 2])][None]
        points = points[:, np.random.default_rng(5).permutation(points.shape[1])]
    height, width, _ = points.shape
    order = ">" if how.big_endian else "<"
    layout = np.dtype(
        [("rgb", "u4"), ("x", f"{order}f4"), ("y", f"{order}f4"), ("z", f"{order}f4")]
    )
    packed = np.zeros((height, width), layout)
    for k, name in enumerate("xyz"):
        packed[name] = points[..., k]
    assert layout.fields is not None
    fields = [
        types["sensor_msgs/msg/PointField"](
            name, int(layout.fields[name][1]), 6 if name == "rgb" else 7, 1
        )
        for name in ("x", "y", "z", "rgb")
    ]
    rows = np.pad(packed.view(np.uint8).reshape(height, -1), ((0, 0), (0, how.padding)))
    return types["sensor_msgs/msg/PointCloud2"](
        header,
        height,
        width,
        fields,
        how.big_endian,
        layout.itemsize,
        rows.shape[1],
        rows.ravel(),
        False,
    )


def _header(ros: int, time_ns: int, frame_id: str) -> Any:
    types = store(ros).types
    stamp = types["builtin_interfaces/msg/Time"](time_ns // 10**9, time_ns % 10**9)
    return types["std_msgs/msg/Header"](*([7] if ros == 1 else []), stamp, frame_id)


def _camera_info(ros: int, frame_id: str, time_ns: int, how: How) -> Any:
    return info_message(ros, time_ns, Info(how.camera, frame_id=frame_id), how)


def info_message(ros: int, time_ns: int, info: Info, how: How) -> Any:
    """A CameraInfo."""
    types, camera = store(ros).types, info.camera
    width, height = info.size or ((camera.width, camera.height) if camera else (0, 0))
    k = camera.matrix if camera else np.zeros((3, 3))
    p = np.hstack([k, np.zeros((3, 1))])
    x, y, across, down = info.roi
    region = types["sensor_msgs/msg/RegionOfInterest"](x, y, down, across, bool(across))
    return types["sensor_msgs/msg/CameraInfo"](
        _header(ros, time_ns, info.frame_id),
        height,
        width,
        how.model,
        np.array(how.distortion, float),
        k.ravel(),
        np.eye(3).ravel(),
        p.ravel(),
        *info.binning,
        region,
    )


def write_ros_mcap(
    path: Path,
    frames: NDArray[Any],
    ros: int = 2,
    how: How | None = None,
    *,
    compression: CompressionType = CompressionType.ZSTD,
    chunk_size: int = 16 * 1024,
    use_chunking: bool = True,
    sent_ns: Sequence[int] | None = None,
    pack_message: Callable[[bytes], bytes] = bytes,
    **changes: Any,
) -> Path:
    """ROS's messages in an MCAP file; `changes` are further facts of `How`.

    sent_ns: times of sending of the images; None: those of logging.
    """
    sent = None if sent_ns is None else iter(sent_ns)
    packing = {"chunk_size": chunk_size, "compression": compression, "use_chunking": use_chunking}
    return write_messages(
        path,
        (
            (
                topic,
                message.__msgtype__.replace("/msg/", "/") if ros == 1 else message.__msgtype__,
                "ros1" if ros == 1 else "cdr",
                log_ns,
                next(sent) if sent is not None and "Info" not in message.__msgtype__ else log_ns,
                pack_message(serialised(ros, message)),
            )
            for topic, log_ns, message in ros_messages(
                ros, frames, replace(how or How(), **changes)
            )
        ),
        **packing,
    )


def serialised(ros: int, message: Any) -> bytes:
    """The bytes of a message of ROS 1 or 2."""
    pack = store(ros).serialize_ros1 if ros == 1 else store(ros).serialize_cdr
    return bytes(pack(message, message.__msgtype__))


def write_messages(
    path: Path, messages: Iterable[tuple[str, str, str, int, int, bytes]], **how: Any
) -> Path:
    """An MCAP file of messages: topic, schema, encoding, times of logging and sending, bytes."""
    with path.open("wb") as file:
        writer = McapWriter(file, **how)
        writer.start()
        channels: dict[str, int] = {}
        for topic, kind, encoding, log_ns, sent_ns, data in messages:
            if topic not in channels:
                schema = writer.register_schema(kind, "text", b"")
                channels[topic] = writer.register_channel(topic, encoding, schema)
            writer.add_message(channels[topic], log_ns, data, sent_ns)
        writer.finish()
    return path


def write_bag(
    path: Path,
    frames: NDArray[Any],
    how: How | None = None,
    *,
    compression: str | None = "lz4",
    chunk_bytes: int = 16 * 1024,
    unit_m: float | None = None,
    **changes: Any,
) -> Path:
    """A ROS 1 bag; compression: lz4, bz2 or None; unit_m: a RealSense recording's metres a step."""
    path.unlink(missing_ok=True)
    writer = rosbag1.Writer(path)
    if compression:
        writer.set_compression(rosbag1.Writer.CompressionFormat[compression.upper()])
    writer.chunk_threshold = chunk_bytes
    with writer:
        connections: dict[str, Any] = {}

        def put(topic: str, log_ns: int, message: Any) -> None:
            kind = message.__msgtype__
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=store(1))
            writer.write(connections[topic], log_ns, store(1).serialize_ros1(message, kind))

        if unit_m is not None:
            unit = store(1).types["std_msgs/msg/Float32"](unit_m)
            put("/device_0/sensor_0/option/Depth Units/value", 1, unit)
        for topic, log_ns, message in ros_messages(1, frames, replace(how or How(), **changes)):
            put(topic, log_ns, message)
    return path


Messages = Iterator[tuple[str, int, Any]]


def realsense_messages(
    frames: NDArray[Any],
    camera: Camera,
    sensor_ns: Sequence[int],
    *,
    option_m: str | None = "0.000500",
    metadata_m: str | None = "0.000500",
    arrival_ns: Sequence[int] | None = None,
    without_metadata: Sequence[int] = (),
    began_ms: str = "1760000000123.456",
    kind: str = "mono16",
) -> Messages:
    """What the RealSense programs of 2026 record: camera, unit and metadata as text, stamps of
    arrival.
    """
    text = store(2).types["std_msgs/msg/String"]
    stream = "/device_0/sensor_0/Depth_0"
    yield "/file_version", 0, store(2).types["std_msgs/msg/UInt32"](4)
    yield f"{stream}/info", 0, text("encoding=Z16;fps=30")
    lens = f"fx={camera.fx};ppx={camera.cx};fy={camera.fy};ppy={camera.cy}"
    size = f"width={camera.width};height={camera.height}"
    bent = "model=Brown Conrady;coeffs=0.000000,0.000000,0.000000,0.000000,0.000000"
    yield f"{stream}/camera_info", 0, text(f"{size};{lens};{bent}")
    if option_m is not None:
        yield "/device_0/sensor_0/option/Depth_Units/value", 0, text(option_m)
        yield "/device_0/sensor_0/option/Depth_Units/description", 0, text("Metres of a step")
    arrived = [(k + 1) * STEP_NS for k in range(len(frames))] if arrival_ns is None else arrival_ns
    for n, (frame, now_ns, true_ns) in enumerate(zip(frames, arrived, sensor_ns, strict=True)):
        image = depth_message(2, frame, now_ns, "Depth_0", How(kind=kind))
        data = "data" if kind == "mono16" else "data/compressedDepth"
        yield f"{stream}/image/{data}", now_ns, image
        unit = "" if metadata_m is None else f"depth_units={metadata_m};"
        milliseconds = f"{true_ns // 10**6}.{true_ns % 10**6:06d}"
        facts = (
            f"Frame number={100 + n};timestamp_domain=Global Time;system_time={began_ms};"
            f"timestamp={milliseconds};{unit}Actual Exposure=8500;"
        )
        if n not in without_metadata:
            yield f"{stream}/image/metadata", now_ns, text(facts)


def write_db3(
    folder: Path,
    frames: NDArray[Any],
    how: How | None = None,
    *,
    messages: Messages | None = None,
    packed: bool = False,
    **changes: Any,
) -> Path:
    """A ROS 2 bag: a folder with metadata.yaml and a .db3 file; packed: every message by itself."""
    writer = rosbag2.Writer(folder, version=8, storage_plugin=rosbag2.StoragePlugin.SQLITE3)
    if packed:
        writer.set_compression(rosbag2.CompressionMode.MESSAGE, rosbag2.CompressionFormat.ZSTD)
    with writer:
        connections: dict[str, Any] = {}
        written = messages or ros_messages(2, frames, replace(how or How(), **changes))
        for topic, log_ns, message in written:
            kind = message.__msgtype__
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=store(2))
            writer.write(connections[topic], log_ns, store(2).serialize_cdr(message, kind))
    return folder
