"""Parsers of Foxglove's schemas that hold depth, in protobuf and in JSON.

RawImage, CompressedImage, PointCloud and CameraCalibration; in JSON, bytes are base64.
"""

from __future__ import annotations

import base64
import binascii
import json
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
    Calibration,
    DamagedMessage,
    Message,
    PackedPicture,
    Parser,
    PointCloud,
    RawPicture,
)

# foxglove.PackedElementField's NumericType: NumPy's name of it
_FIELD_TYPES = {1: "<u1", 2: "<i1", 3: "<u2", 4: "<i2", 5: "<u4", 6: "<i4", 7: "<f4", 8: "<f8"}
_SECOND = 10**9
_STAMP = 1 << 3 | 2  # protobuf's key of field 1, the stamp, which has a length
_ONE_BYTE = 127  # the largest length that is told in one byte


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
    if isinstance(stamp, str):  # RFC 3339, as protobuf's MessageToJson writes it
        stamp = Timestamp()
        stamp.FromJsonString(message.timestamp)
    return int(stamp.seconds) * _SECOND + int(stamp.nanos)


_JSON_NAMES = {"seconds": "sec", "nanos": "nsec"}  # protobuf's name: JSON's


class _Json:
    """A JSON object whose keys are attributes, as protobuf's messages have them.

    What is missing is empty, or 0.
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


def parser(schema: str, encoding: str) -> Parser | None:
    """The function that reads messages of a schema.

    Args:
        schema: its name, such as "foxglove.RawImage".
        encoding: "protobuf" or "json".

    Returns:
        The parser, which raises `DamagedMessage`; None where there is none.
    """
    if schema in _READ and encoding == "protobuf":
        return partial(_from_protobuf, schema)
    if schema in _READ and encoding == "json":
        return partial(_from_json, schema)
    return None


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
    """The stamp, ns, in the first bytes of a picture or cloud in protobuf.

    It is the message's first field, and writers put it first.

    Args:
        head: the message's first bytes.

    Returns:
        The stamp; None where another field comes first, as in a message without a stamp.
    """
    if len(head) < 2 or head[0] != _STAMP or head[1] > min(_ONE_BYTE, len(head) - 2):
        return None
    try:
        stamp = Timestamp.FromString(bytes(head[2 : 2 + head[1]]))
    except DecodeError:
        return None
    return int(stamp.seconds) * _SECOND + int(stamp.nanos)
