"""Parsers of messages with depth: Foxglove's schemas (protobuf, JSON) and ROS's `sensor_msgs`.

In JSON, bytes are base64. The pixels of ROS's messages are not copied. The definitions have never
changed, so they are fixed here; ROS 1 serialisation and ROS 2 CDR have the same order of fields and
differ in alignment, in the header and in the zero at a string's end.
"""

from __future__ import annotations

import base64
import binascii
import json
import struct
from collections.abc import Callable
from functools import partial
from typing import Any

from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud as PointCloudMessage
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from google.protobuf.message import DecodeError
from google.protobuf.timestamp_pb2 import Timestamp

from liex_lab.recordings.formats.messages.messages import (
    CALIBRATION_SCHEMAS,
    CLOUD_SCHEMAS,
    PICTURE_SCHEMAS,
    STATEMENT_SCHEMAS,
    STATES,
    Calibration,
    Channel,
    DamagedMessage,
    Message,
    PackedPicture,
    Parser,
    PointCloud,
    RawPicture,
    Statement,
    unpacked_message,
)


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
    if schema not in (
        *PICTURE_SCHEMAS,
        *CLOUD_SCHEMAS,
        *CALIBRATION_SCHEMAS,
        *STATEMENT_SCHEMAS,
    ):
        return None
    if schema.startswith("foxglove."):
        read = {"protobuf": _from_protobuf, "json": _from_json}.get(channel.encoding)
        return None if read is None else partial(read, schema)
    return ros_parser(schema, channel.encoding)


def stamp_reader(channel: Channel) -> Callable[[memoryview], int | None] | None:
    """The function that reads the sensor's stamp, ns, from the first bytes of a channel's messages.

    It returns the same stamp as the channel's parser, or None if these bytes do not contain it.

    Args:
        channel: topic, schema and encoding.

    Returns:
        The function; None for messages without depth, or if their beginning has no stamp.
    """
    schema = plain_schema(channel)
    if schema not in (*PICTURE_SCHEMAS, *CLOUD_SCHEMAS):
        return None
    if schema.startswith("foxglove."):
        return stamp_in if channel.encoding == "protobuf" else None
    layout = _LAYOUTS.get(channel.encoding)
    return None if layout is None else partial(_header_stamp, layout)


# Foxglove


# foxglove.PackedElementField's NumericType: NumPy's name of it
_FIELD_TYPES = {1: "<u1", 2: "<i1", 3: "<u2", 4: "<i2", 5: "<u4", 6: "<i4", 7: "<f4", 8: "<f8"}
_SECOND = 10**9
_STAMP = 1 << 3 | 2  # protobuf's key of field 1, the stamp, length-delimited
_ONE_BYTE = 127  # the largest length in one byte


def _raw_image(message: Any) -> RawPicture:
    m = message
    return RawPicture(
        _stamp(m), m.frame_id, int(m.width), int(m.height), m.encoding, int(m.step), False, m.data
    )


def _packed_image(message: Any) -> PackedPicture:
    return PackedPicture(_stamp(message), message.frame_id, message.format, message.data)


def _calibration(message: Any) -> Calibration:
    m = message
    size = int(m.width), int(m.height)
    return Calibration(m.frame_id, *size, m.distortion_model, tuple(m.D), tuple(m.K), tuple(m.P))


def _cloud(message: Any) -> PointCloud:
    columns = {
        f.name: (int(f.offset), _FIELD_TYPES[f.type])
        for f in message.fields
        if f.type in _FIELD_TYPES
    }
    step = int(message.point_stride)
    data = message.data
    n = len(data) // max(step, 1)
    at = message.pose.position
    turn = message.pose.orientation
    pose = (at.x, at.y, at.z, turn.x, turn.y, turn.z, turn.w)
    moved = any(pose[:6])
    return PointCloud(
        _stamp(message),
        message.frame_id,
        n,
        1,
        columns,
        step,
        n * step,
        data,
        pose if moved else None,
    )


def _stamp(message: Any) -> int:
    stamp = message.timestamp
    if isinstance(stamp, str):  # RFC 3339, as written by protobuf's MessageToJson
        stamp = Timestamp()
        stamp.FromJsonString(message.timestamp)
    return int(stamp.seconds) * _SECOND + int(stamp.nanos)


_JSON_NAMES = {"seconds": "sec", "nanos": "nsec"}  # protobuf's name: JSON's


class _Json:
    """A JSON object with its keys as attributes, as in protobuf's messages.

    Missing values are empty, or 0.
    """

    _TEXTS = ("frame_id", "encoding", "format", "distortion_model", "name")
    _LISTS = ("D", "K", "P")
    _OBJECTS = ("timestamp", "pose", "position", "orientation")

    def __init__(self, content: Any) -> None:
        if not isinstance(content, dict):
            raise DamagedMessage("a message is not a JSON object")
        self._content = content

    def __getattr__(self, name: str) -> Any:
        value = self._content.get(_JSON_NAMES.get(name, name))
        if name == "data":
            return base64.b64decode(value or b"", validate=True)
        if name in self._OBJECTS and not isinstance(value, str):
            return _Json(value or {})
        if name in (*self._TEXTS, *self._OBJECTS):
            return str(value or "")
        if name == "fields":
            return [_Json(item) for item in value or []]
        if name in self._LISTS:
            return [float(number) for number in value or []]
        number = float(value or 0)
        return int(number) if number.is_integer() else number


_READ: dict[str, Callable[[Any], Message]] = {
    "foxglove.RawImage": _raw_image,
    "foxglove.CompressedImage": _packed_image,
    "foxglove.CameraCalibration": _calibration,
    "foxglove.PointCloud": _cloud,
}
_PROTOBUF: dict[str, Any] = {
    "foxglove.RawImage": RawImage,
    "foxglove.CompressedImage": CompressedImage,
    "foxglove.CameraCalibration": CameraCalibration,
    "foxglove.PointCloud": PointCloudMessage,
}


def _from_protobuf(schema: str, data: memoryview) -> Message:
    try:
        return _READ[schema](_PROTOBUF[schema].FromString(data))
    except DecodeError as error:
        raise DamagedMessage(str(error)) from None


def _from_json(schema: str, data: memoryview) -> Message:
    try:
        return _READ[schema](_Json(json.loads(bytes(data))))
    except (ValueError, TypeError, OverflowError, RecursionError, binascii.Error) as error:
        raise DamagedMessage(str(error)) from None


def stamp_in(head: memoryview) -> int | None:
    """The stamp, ns, in the first bytes of an image or cloud in protobuf.

    It is the message's first field, and writers put it first.

    Args:
        head: the message's first bytes.

    Returns:
        The stamp; None if another field is first, as in a message without a stamp.
    """
    if len(head) < 2 or head[0] != _STAMP or head[1] > min(_ONE_BYTE, len(head) - 2):
        return None
    try:
        stamp = Timestamp.FromString(bytes(head[2 : 2 + head[1]]))
    except DecodeError:
        return None
    return int(stamp.seconds) * _SECOND + int(stamp.nanos)


# ROS


# sensor_msgs/PointField: number of a type, and NumPy's name of it without the byte order
_POINT_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
_MOST_FIELDS = 256
_SECOND_VERSION = 4  # largest alignment of its numbers, bytes
_PLAIN_CDR = (b"\0\0", b"\0\1", b"\0\6", b"\0\7")  # big and little endian, version 1 and 2


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
        if len(data) < 4 or kind not in _PLAIN_CDR:
            raise DamagedMessage(
                f"a message begins with {kind.hex(' ')}, which is no plain CDR (00 00, 00 01, 00 "
                "06 or 00 07)"
            )
        self.order = "<" if data[1] & 1 else ">"
        self.largest_step = _SECOND_VERSION if data[1] > 1 else 8

    def header(self) -> tuple[int, str]:
        """The stamp, ns, and the frame's name of a std_msgs/Header without the counter."""
        return self.whole("i") * 10**9 + self.whole(), self.text()  # signed seconds


def _image(fields: _Fields) -> RawPicture:
    stamp_ns, frame_id = fields.header()
    height, width = fields.numbers("I", 2)
    encoding = fields.text()
    big_endian = bool(fields.whole("B"))
    step = fields.whole()
    return RawPicture(stamp_ns, frame_id, width, height, encoding, step, big_endian, fields.blob())


def _compressed_image(fields: _Fields) -> PackedPicture:
    stamp_ns, frame_id = fields.header()
    return PackedPicture(stamp_ns, frame_id, fields.text(), fields.blob())


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
    if fields.largest_step == _SECOND_VERSION:  # the list's length in bytes
        fields.whole()
    n_fields = fields.whole()
    if n_fields > _MOST_FIELDS:
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


def _value(fields: _Fields) -> Statement:
    return Statement({"value": f"{fields.numbers('f')[0]:.6g}"})  # 0.001 instead of its float32


def _text(fields: _Fields) -> Statement:
    """Facts such as "fx=287.9;fy=287.9", or one bare value."""
    text = fields.text()
    pairs = dict(part.split("=", 1) for part in text.split(";") if "=" in part)
    return Statement(pairs or {"value": text})


def _key_value(fields: _Fields) -> Statement:
    return Statement({fields.text(): fields.text()})


_PARSERS: dict[str, Callable[[_Fields], Message]] = {
    "sensor_msgs/Image": _image,
    "sensor_msgs/CompressedImage": _compressed_image,
    "sensor_msgs/CameraInfo": _camera_info,
    "sensor_msgs/PointCloud2": _point_cloud2,
    "std_msgs/Float32": _value,
    "std_msgs/String": _text,
    "diagnostic_msgs/KeyValue": _key_value,
}
_LAYOUTS: dict[str, type[_Fields]] = {"ros1": _Fields, "cdr": _CdrFields}


def ros_parser(schema: str, encoding: str) -> Parser | None:
    """The function that parses messages of a schema.

    Args:
        schema: its name without "msg", such as "sensor_msgs/Image".
        encoding: "ros1" or "cdr".

    Returns:
        The parser, which raises `DamagedMessage`; None if unsupported.
    """
    layout = _LAYOUTS.get(encoding)
    if layout is None or schema not in _PARSERS:
        return None
    read = _PARSERS[schema]
    if encoding == "ros1":
        return lambda data: read(layout(data))
    return lambda data: _read_cdr(read, unpacked_message(data))


def _read_cdr(read: Callable[[_Fields], Message], data: memoryview) -> Message:
    """A message in CDR; one marked as the second version may have the layout of the first."""
    fields = _CdrFields(data)
    message = read(fields)
    if fields.largest_step == _SECOND_VERSION <= len(data) - fields.at:
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
