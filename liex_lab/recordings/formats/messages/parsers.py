"""Parsers of messages with depth: Foxglove's schemas (protobuf, JSON) and ROS's `sensor_msgs`.

In JSON, bytes are base64. The pixels of ROS's messages are not copied. The definitions have never
changed, so they are fixed here; ROS 1 serialisation and ROS 2 CDR have the same order of fields and
differ in alignment, in the header and in the zero at a string's end.
"""

import json
import struct
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud as PointCloudMessage
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from google.protobuf.json_format import Error as JsonError
from google.protobuf.json_format import ParseDict
from google.protobuf.message import DecodeError
from google.protobuf.timestamp_pb2 import Timestamp
from numpy.typing import NDArray

from liex_lab.errors import RecordingError
from liex_lab.optics.camera import Camera
from liex_lab.recordings.formats.images.files import Size, decode_png, png_size, render_points
from liex_lab.recordings.formats.messages.messages import (
    CLOUD_SCHEMAS,
    IMAGE_SCHEMAS,
    STATEMENT_SCHEMAS,
    STATES,
    Calibration,
    Channel,
    DamagedMessage,
    DepthMessage,
    Message,
    PackedDepthImage,
    Parser,
    PointCloud,
    RawDepthImage,
    Statement,
    unpacked_message,
)
from liex_lab.recordings.frame import Depth, depth_mm


def plain_schema(channel: Channel) -> str:
    """Name of a channel's schema without the 'msg' of ROS 2, such as "sensor_msgs/Image"."""
    return channel.schema.replace("/msg/", "/")


def parser_of(channel: Channel) -> Parser | None:
    """The function that parses a channel's messages.

    Args:
        channel: topic, schema and encoding.

    Returns:
        The parser; None for messages unrelated to depth.
    """
    schema = plain_schema(channel)
    if schema in STATEMENT_SCHEMAS and not STATES.search(channel.topic):
        return None
    if schema in _FOXGLOVE:
        read = {"protobuf": _from_protobuf, "json": _from_json}.get(channel.encoding)
        return None if read is None else partial(read, *_FOXGLOVE[schema])
    if schema not in _PARSERS or channel.encoding not in _LAYOUTS:
        return None
    if channel.encoding == "ros1":
        return lambda data: _PARSERS[schema](_Fields(data))
    return partial(_read_cdr, _PARSERS[schema])


def stamp_reader(channel: Channel) -> Callable[[memoryview], int | None] | None:
    """The function that reads the sensor's stamp, ns, from the first bytes of a channel's messages.

    It returns the same stamp as the channel's parser, or None if these bytes do not contain it.

    Args:
        channel: topic, schema and encoding.

    Returns:
        The function; None for messages without depth, or if their beginning has no stamp.
    """
    if plain_schema(channel) not in (*IMAGE_SCHEMAS, *CLOUD_SCHEMAS):
        return None
    if channel.schema.startswith("foxglove."):
        return stamp_in if channel.encoding == "protobuf" else None
    layout = _LAYOUTS.get(channel.encoding)
    return None if layout is None else partial(_header_stamp, layout)


# Foxglove


# foxglove.PackedElementField's NumericType: NumPy's name of it
_FIELD_TYPES = {1: "<u1", 2: "<i1", 3: "<u2", 4: "<i2", 5: "<u4", 6: "<i4", 7: "<f4", 8: "<f8"}
_SECOND = 10**9


def _cloud(m: Any) -> PointCloud:
    columns = {
        field.name: (field.offset, _FIELD_TYPES[field.type])
        for field in m.fields
        if field.type in _FIELD_TYPES
    }
    step = m.point_stride
    n = len(m.data) // max(step, 1)
    at, turn = m.pose.position, m.pose.orientation
    pose = (at.x, at.y, at.z, turn.x, turn.y, turn.z, turn.w)
    moved = pose if any(pose[:6]) else None
    return PointCloud(_stamp(m), m.frame_id, n, 1, columns, step, n * step, m.data, moved)


def _stamp(message: Any) -> int:
    return int(message.timestamp.seconds) * _SECOND + int(message.timestamp.nanos)


_FOXGLOVE: dict[str, tuple[Any, Callable[[Any], Message]]] = {
    "foxglove.RawImage": (
        RawImage,
        lambda m: RawDepthImage(
            _stamp(m), m.frame_id, m.width, m.height, m.encoding, m.step, False, m.data
        ),
    ),
    "foxglove.CompressedImage": (
        CompressedImage,
        lambda m: PackedDepthImage(_stamp(m), m.frame_id, m.format, m.data),
    ),
    "foxglove.CameraCalibration": (
        CameraCalibration,
        lambda m: Calibration(
            m.frame_id, m.width, m.height, m.distortion_model, tuple(m.D), tuple(m.K), tuple(m.P)
        ),
    ),
    "foxglove.PointCloud": (PointCloudMessage, _cloud),
}


def _from_protobuf(kind: Any, read: Callable[[Any], Message], data: memoryview) -> Message:
    try:
        return read(kind.FromString(data))
    except DecodeError as error:
        raise DamagedMessage(str(error)) from None


def _from_json(kind: Any, read: Callable[[Any], Message], data: memoryview) -> Message:
    """A message in JSON: bytes are base64, and a stamp is RFC 3339 (as in protobuf's JSON) or an
    object with sec and nsec.
    """
    try:
        content = json.loads(bytes(data))
        stamp = content.pop("timestamp", None) or {}
        if isinstance(stamp, dict):
            seconds, nanos = (int(stamp.get(key) or 0) for key in ("sec", "nsec"))
            stamp = Timestamp(seconds=seconds, nanos=nanos).ToJsonString()
        return read(ParseDict({**content, "timestamp": stamp}, kind(), ignore_unknown_fields=True))
    except (
        ValueError,
        TypeError,
        AttributeError,
        OverflowError,
        RecursionError,
        JsonError,
    ) as error:
        raise DamagedMessage(str(error)) from None


def stamp_in(head: memoryview) -> int | None:
    """The stamp, ns, in the first bytes of an image or cloud in protobuf.

    It is the message's first field, and writers put it first.

    Args:
        head: the message's first bytes.

    Returns:
        The stamp; None if another field is first, as in a message without a stamp.
    """
    # protobuf's key: field 1, the stamp, length-delimited; lengths up to 127 take one byte
    if len(head) < 2 or head[0] != (1 << 3 | 2) or head[1] > min(127, len(head) - 2):
        return None
    try:
        stamp = Timestamp.FromString(bytes(head[2 : 2 + head[1]]))
    except DecodeError:
        return None
    return int(stamp.seconds) * _SECOND + int(stamp.nanos)


# ROS


# sensor_msgs/PointField: number of a type, and NumPy's name of it without the byte order
_POINT_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
_XCDR2_ALIGNMENT = 4  # largest alignment of numbers in version 2 of CDR, bytes


class _Fields:
    """Reads consecutive fields: ROS 1, little endian, nothing aligned."""

    order = "<"
    origin = 0
    largest_step = 1  # largest alignment of numbers, bytes
    end_of_text = 0

    def __init__(self, data: memoryview) -> None:
        self.data = data
        self.at = self.origin

    def _next(self, n_bytes: int) -> memoryview:
        """The next bytes."""
        begin = self.at
        self.at = begin + n_bytes
        if self.at > len(self.data):
            raise DamagedMessage("a message ends too early")
        return self.data[begin : self.at]

    def numbers(self, kind: str, n: int = 1) -> tuple[Any, ...]:
        """`n` numbers of a type, named as in `struct`."""
        size = struct.calcsize(f"<{kind}")
        self.at += (self.origin - self.at) % min(size, self.largest_step)
        return struct.unpack(f"{self.order}{n}{kind}", self._next(n * size))

    def whole(self, kind: str = "I") -> int:
        """One integer."""
        return int(self.numbers(kind)[0])

    def floats(self) -> tuple[float, ...]:
        """Float64s, preceded by their number."""
        n = self.whole()
        if n > len(self.data) // 8:
            raise DamagedMessage("a message states more numbers than it has bytes")
        return self.numbers("d", n) if n else ()

    def blob(self) -> memoryview:
        """Bytes, preceded by their number."""
        return self._next(self.whole())

    def text(self) -> str:
        """A string."""
        raw = self.blob()
        return bytes(raw[: len(raw) - self.end_of_text]).decode("utf-8", "replace")

    def header(self) -> tuple[int, str]:
        """The stamp, ns, and the frame's name of a std_msgs/Header."""
        self.whole()  # a sequence number
        return self.whole() * 10**9 + self.whole(), self.text()


class _CdrFields(_Fields):
    """The same in ROS 2 (CDR): byte order in the first four bytes, numbers aligned to their size.

    Strings end in a zero, and headers have no counter. The second version (XCDR2) aligns to at most
    four bytes.
    """

    origin = 4
    end_of_text = 1

    def __init__(self, data: memoryview) -> None:
        super().__init__(data)
        kind = bytes(data[:2])
        # big and little endian, version 1 and 2
        if len(data) < 4 or kind not in (b"\0\0", b"\0\1", b"\0\6", b"\0\7"):
            raise DamagedMessage(
                f"a message begins with {kind.hex(' ')}, which is no plain CDR (00 00, 00 01, 00 "
                "06 or 00 07)"
            )
        self.order = "<" if data[1] & 1 else ">"
        self.largest_step = _XCDR2_ALIGNMENT if data[1] > 1 else 8

    def header(self) -> tuple[int, str]:
        """The stamp, ns, and the frame's name of a std_msgs/Header without the counter."""
        return self.whole("i") * 10**9 + self.whole(), self.text()  # signed seconds


def _image(fields: _Fields) -> RawDepthImage:
    stamp_ns, frame_id = fields.header()
    height, width = fields.numbers("I", 2)
    encoding = fields.text()
    big_endian = bool(fields.whole("B"))
    step = fields.whole()
    return RawDepthImage(
        stamp_ns, frame_id, width, height, encoding, step, big_endian, fields.blob()
    )


def _camera_info(fields: _Fields) -> Calibration:
    _, frame_id = fields.header()
    height, width = fields.numbers("I", 2)
    model = fields.text()
    d = fields.floats()
    kr = fields.numbers("d", 18)  # camera matrix, rotation
    p = fields.numbers("d", 12)
    across, down, x, y, rows, columns = fields.numbers("I", 6)
    part = (x, y, columns, rows)
    return Calibration(frame_id, width, height, model, d, kr[:9], p, (across, down), part)


def _point_cloud2(fields: _Fields) -> PointCloud:
    stamp_ns, frame_id = fields.header()
    height, width = fields.numbers("I", 2)
    if fields.largest_step == _XCDR2_ALIGNMENT:  # the list's length in bytes
        fields.whole()
    n_fields = fields.whole()
    if n_fields > 256:
        raise DamagedMessage(f"a cloud's points have {n_fields} fields")
    found = []
    for _ in range(n_fields):
        found.append((fields.text(), fields.whole(), fields.whole("B")))
        fields.whole()  # number of values per field: one
    order = ">" if fields.whole("B") else "<"
    columns = {
        name: (at, order + _POINT_TYPES[kind]) for name, at, kind in found if kind in _POINT_TYPES
    }
    point_step, row_step = fields.numbers("I", 2)
    data = fields.blob()
    return PointCloud(stamp_ns, frame_id, width, height, columns, point_step, row_step, data)


def _text(fields: _Fields) -> Statement:
    """Facts such as "fx=287.9;fy=287.9", or one bare value."""
    text = fields.text()
    pairs = dict(part.split("=", 1) for part in text.split(";") if "=" in part)
    return Statement(pairs or {"value": text})


_PARSERS: dict[str, Callable[[_Fields], Message]] = {
    "sensor_msgs/Image": _image,
    "sensor_msgs/CompressedImage": lambda fields: PackedDepthImage(
        *fields.header(), fields.text(), fields.blob()
    ),
    "sensor_msgs/CameraInfo": _camera_info,
    "sensor_msgs/PointCloud2": _point_cloud2,
    # six digits, so that the float32 nearest to 0.001 is printed as 0.001
    "std_msgs/Float32": lambda fields: Statement({"value": f"{fields.numbers('f')[0]:.6g}"}),
    "std_msgs/String": _text,
    "diagnostic_msgs/KeyValue": lambda fields: Statement({fields.text(): fields.text()}),
}
_LAYOUTS: dict[str, type[_Fields]] = {"ros1": _Fields, "cdr": _CdrFields}


def _read_cdr(read: Callable[[_Fields], Message], data: memoryview) -> Message:
    """A message in CDR; one marked as version 2 that leaves bytes over is read as version 1."""
    data = unpacked_message(data)
    fields = _CdrFields(data)
    message = read(fields)
    if fields.largest_step == _XCDR2_ALIGNMENT <= len(data) - fields.at:
        fields = _CdrFields(data)
        fields.largest_step = 8
        message = read(fields)
    return message


def _header_stamp(layout: type[_Fields], head: memoryview) -> int | None:
    """The stamp, ns, in a message's header; None if the header is longer than `head`."""
    try:
        return layout(head).header()[0]
    except DamagedMessage:
        return None


# Decoding images and point clouds in messages into depth, for MCAP files and ROS bags.


MOST_PIXELS = (
    1 << 24
)  # pixels; more than any depth camera: a damaged size would need all the memory
_METRE = 1000.0
_ENCODINGS = {
    "16UC1": ("u2", 1.0),
    "mono16": ("u2", 1.0),
    "32FC1": ("f4", _METRE),
}  # stored type, mm per step (1: the recording's own step counts)
_CONFIG = struct.Struct(
    "<iff"
)  # precedes a compressedDepth image: format, and a and b of quantised depth
_RVL_SIZE = struct.Struct("<II")


def image_size(message: DepthMessage) -> tuple[int, int] | None:
    """Size of a depth image, without decoding it.

    Args:
        message: an image or a point cloud.

    Returns:
        Width and height, px; (0, 0) for points without rows; None for an image of another kind, or
        of more than 2^24 pixels (clouds: 2^22 points).
    """
    if isinstance(message, PointCloud):
        n = message.width * message.height
        known = {"x", "y", "z"} <= message.columns.keys() and 0 < n <= (1 << 22)
        size = (message.width, message.height) if message.height > 1 else (0, 0)
        return size if known else None
    if isinstance(message, RawDepthImage):
        found: Size | None = (message.width, message.height)
        if message.encoding not in _ENCODINGS:
            return None
    else:
        is_rvl, body = _unwrapped(message)
        try:
            found = _RVL_SIZE.unpack_from(body) if is_rvl else png_size(bytes(body[:26]), "image")
        except (RecordingError, struct.error):
            return None  # a colour PNG is not depth
    fits = found is not None and min(found) > 0 and found[0] * found[1] <= MOST_PIXELS
    return found if fits else None


def stated_kind(message: DepthMessage) -> str:
    """Stated type of a message's content, for error messages."""
    if isinstance(message, PointCloud):
        return f"points of {', '.join(message.columns) or 'nothing'}"
    if isinstance(message, RawDepthImage):
        return (
            f"{message.encoding}, {message.width} x {message.height} pixels in rows of "
            f"{message.step} bytes, {len(message.data)} bytes in all"
        )
    return message.packing.strip()


def _unwrapped(message: PackedDepthImage) -> tuple[bool, memoryview]:
    """Whether an image is RVL, and its data after the configuration of ROS's compressedDepth."""
    data = memoryview(message.data)
    if "compressedDepth" not in message.packing:
        return False, data
    return "rvl" in message.packing.lower(), data[_CONFIG.size :]


def decode_message(
    message: DepthMessage,
    camera: Camera,
    step_mm: float,
    scale: float,
    unread: Sequence[float] = (0.0,),
) -> Depth | None:
    """Depth of a message.

    Args:
        message: an image or a point cloud.
        camera: the camera of the recording, whose size images must have; unordered points are
            projected by it.
        step_mm: mm per step of 16-bit depth.
        scale: factor on all depth, from a camera.toml.
        unread: stored values (for clouds: mm) that mean "no reading", from a camera.toml.

    Returns:
        (H, W) float32 mm of the camera's size; None if the message has no such image.
    """
    if image_size(message) not in ((camera.width, camera.height), (0, 0)):
        return None
    if isinstance(message, PointCloud):
        z_mm = _cloud_depth(message, camera)
        return None if z_mm is None else depth_mm(z_mm, scale, unread)
    if isinstance(message, RawDepthImage):
        stored = _raw_pixels(message)
        metric = _ENCODINGS[message.encoding][1]
    else:
        stored = _packed_pixels(message)
        metric = _METRE if stored is not None and stored.dtype.kind == "f" else 1.0
    if stored is None or stored.shape != (camera.height, camera.width):
        return None
    return depth_mm(stored, scale * (step_mm if metric == 1.0 else metric), unread)


def _raw_pixels(message: RawDepthImage) -> NDArray[Any] | None:
    order = ">" if message.big_endian else "<"
    dtype = np.dtype(order + _ENCODINGS[message.encoding][0])
    height, width = message.height, message.width
    row = width * dtype.itemsize
    step = message.step or row
    if step == width and len(message.data) == height * row:
        step = row  # some writers state pixels per row instead of bytes
    # some writers leave out the padding of the last row
    if step < row or step * (height - 1) + row > len(message.data):
        return None
    return np.ndarray((height, width), dtype, message.data, strides=(step, dtype.itemsize))


def _packed_pixels(message: PackedDepthImage) -> NDArray[Any] | None:
    is_rvl, body = _unwrapped(message)
    if is_rvl:
        from liex_lab.recordings.depth_kernels import unpack_rvl

        width, height = _RVL_SIZE.unpack_from(body)
        pixels: NDArray[Any] | None = unpack_rvl(body[_RVL_SIZE.size :], width, height)
    else:
        pixels = decode_png(np.frombuffer(body, np.uint8))
    metric = "compressedDepth" in message.packing and message.packing.startswith("32FC1")
    if pixels is None or not metric:
        return pixels
    # metres, quantised with steps that grow with distance like the sensor's own
    _, a, b = _CONFIG.unpack_from(message.data)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        metres = np.float32(a) / (pixels.astype(np.float32) - np.float32(b))
    metres[pixels == 0] = 0.0
    return metres


def _cloud_depth(cloud: PointCloud, camera: Camera) -> NDArray[np.float64] | None:
    """Depth (H, W) mm: z of points in rows, or the nearest point per pixel of others."""
    columns = [_column(cloud, name) for name in ("x", "y", "z")]
    if any(column is None for column in columns):
        return None
    p_camera = np.stack([one for one in columns if one is not None], axis=-1) * _METRE
    if cloud.pose is not None:
        from scipy.spatial.transform import Rotation

        rotation = Rotation.from_quat(cloud.pose[3:] if any(cloud.pose[3:]) else (0, 0, 0, 1))
        p_camera = p_camera @ rotation.as_matrix().T + np.multiply(cloud.pose[:3], _METRE)
    if cloud.height > 1:
        return p_camera[..., 2]
    if p_camera[..., 2].size == camera.width * camera.height:  # concatenated rows
        return p_camera[..., 2].reshape(camera.height, camera.width)
    return render_points(p_camera[0], camera)


def _column(cloud: PointCloud, name: str) -> NDArray[np.float64] | None:
    """One coordinate (height, width) of the points, m; None if the data are too short."""
    offset, kind = cloud.columns[name]
    dtype = np.dtype(kind)
    row_step = cloud.row_step if cloud.height > 1 else 0
    last = (
        (cloud.height - 1) * row_step
        + (cloud.width - 1) * cloud.point_step
        + offset
        + dtype.itemsize
    )
    if not cloud.width or offset + dtype.itemsize > cloud.point_step or last > len(cloud.data):
        return None
    shape = (cloud.height, cloud.width)
    strides = (row_step, cloud.point_step)
    return np.ndarray(shape, dtype, cloud.data, offset, strides).astype(np.float64)
