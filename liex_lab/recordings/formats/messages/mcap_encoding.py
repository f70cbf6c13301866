"""Serialisation of depth pictures and calibrations: Foxglove schemas in protobuf, ROS 2 in CDR.

CDR is written by hand, little endian and aligned to the size of each number, because only three
messages are needed (sensor_msgs/msg/Image, CompressedImage, CameraInfo).
"""

from __future__ import annotations

import struct
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from liex_lab.errors import RecordingError
from liex_lab.optics.camera import KANNALA_BRANDT, Camera

FRAME_ID = "camera"
_SECOND = 10**9


class Schema(NamedTuple):
    """Definition of a message, as an MCAP file holds it.

    Attributes:
        name: full name of the message's type.
        encoding: of the definition, "protobuf" or "ros2msg".
        data: the definition.
    """

    name: str
    encoding: str
    data: bytes


class Messages(ABC):
    """Interface of a family of message types for depth.

    Attributes:
        profile: MCAP's name of the profile; empty for none.
        encoding: MCAP's name of the messages' encoding.
        raw: schema of an unpacked picture.
        packed: schema of a packed picture.
        lens: schema of a calibration.
    """

    profile: str
    encoding: str
    raw: Schema
    packed: Schema
    lens: Schema

    @abstractmethod
    def raw_picture(self, time_ns: int, size: tuple[int, int], encoding: str, data: bytes) -> bytes:
        """Message of an unpacked picture.

        Args:
            time_ns: its stamp, ns.
            size: (width, height), px.
            encoding: of its pixels, "16UC1" or "32FC1".
            data: the pixels, little endian, row by row without padding.

        Returns:
            The bytes of the message.
        """

    @abstractmethod
    def packed_picture(self, time_ns: int, png: bytes) -> bytes:
        """Message of a PNG picture.

        Args:
            time_ns: its stamp, ns.
            png: a 16-bit PNG file.

        Returns:
            The bytes of the message.
        """

    @abstractmethod
    def calibration(self, time_ns: int, camera: Camera) -> bytes:
        """Message of the camera of the pictures.

        Args:
            time_ns: its stamp, ns.
            camera: the camera; its distortion is stated in ROS's terms.

        Returns:
            The bytes of the message.
        """


def _matrices(camera: Camera) -> tuple[list[float], list[float], list[float]]:
    """K (3, 3), R (3, 3) and P (3, 4), row by row."""
    k = camera.matrix
    p = np.hstack([k, np.zeros((3, 1))])
    return k.ravel().tolist(), np.eye(3).ravel().tolist(), p.ravel().tolist()


def _distortion(camera: Camera) -> tuple[str, list[float]]:
    """ROS's name of the lens's model, and its coefficients; Foxglove takes the same."""
    bent = camera.distortion
    if bent is None:
        return "plumb_bob", [0.0] * 5
    values = list(bent.coefficients)
    if bent.model == KANNALA_BRANDT:
        return "equidistant", values
    return ("rational_polynomial", values) if any(values[5:]) else ("plumb_bob", values[:5])


class FoxgloveMessages(Messages):
    """foxglove.RawImage, CompressedImage and CameraCalibration, in protobuf."""

    profile = ""
    encoding = "protobuf"

    def __init__(self) -> None:
        from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
        from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
        from foxglove_schemas_protobuf.RawImage_pb2 import RawImage

        self._raw = RawImage
        self._packed = CompressedImage
        self._lens = CameraCalibration
        self.raw, self.packed, self.lens = map(
            _protobuf_schema, (RawImage, CompressedImage, CameraCalibration)
        )

    def raw_picture(self, time_ns: int, size: tuple[int, int], encoding: str, data: bytes) -> bytes:
        """foxglove.RawImage of an unpacked picture.

        Args:
            time_ns: its stamp, ns.
            size: (width, height), px.
            encoding: of its pixels, "16UC1" or "32FC1".
            data: the pixels, little endian, row by row without padding.

        Returns:
            The bytes of the message.
        """
        width, height = size
        return _stamped(
            self._raw(
                width=width, height=height, encoding=encoding, step=len(data) // height, data=data
            ),
            time_ns,
        )

    def packed_picture(self, time_ns: int, png: bytes) -> bytes:
        """foxglove.CompressedImage of a PNG picture.

        Args:
            time_ns: its stamp, ns.
            png: a 16-bit PNG file.

        Returns:
            The bytes of the message.
        """
        return _stamped(self._packed(format="png", data=png), time_ns)

    def calibration(self, time_ns: int, camera: Camera) -> bytes:
        """foxglove.CameraCalibration of the camera of the pictures.

        Args:
            time_ns: its stamp, ns.
            camera: the camera; its distortion is stated in ROS's terms.

        Returns:
            The bytes of the message.
        """
        k, r, p = _matrices(camera)
        model, d = _distortion(camera)
        lens = self._lens(
            width=camera.width, height=camera.height, distortion_model=model, D=d, K=k, R=r, P=p
        )
        return _stamped(lens, time_ns)


def _stamped(message: Any, time_ns: int) -> bytes:
    message.timestamp.seconds, message.timestamp.nanos = divmod(time_ns, _SECOND)
    message.frame_id = FRAME_ID
    return bytes(message.SerializeToString())


def _protobuf_schema(message: Any) -> Schema:
    """The definition of a message with those that it is made of."""
    from google.protobuf.descriptor_pb2 import FileDescriptorSet

    files: dict[str, Any] = {}

    def gather(file: Any) -> None:
        for needed in file.dependencies:
            if needed.name not in files:
                gather(needed)
        files[file.name] = file

    gather(message.DESCRIPTOR.file)
    whole = FileDescriptorSet()
    for file in files.values():
        file.CopyToProto(whole.file.add())
    return Schema(message.DESCRIPTOR.full_name, "protobuf", bytes(whole.SerializeToString()))


_PART = "=" * 80 + "\nMSG: "
_HEADER = (
    f"{_PART}std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n"
    f"{_PART}builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"
)
_IMAGE = """\
std_msgs/Header header
uint32 height
uint32 width
string encoding
uint8 is_bigendian
uint32 step
uint8[] data
"""
_COMPRESSED = "std_msgs/Header header\nstring format\nuint8[] data\n"
_CAMERA_INFO = """\
std_msgs/Header header
uint32 height
uint32 width
string distortion_model
float64[] d
float64[9] k
float64[9] r
float64[12] p
uint32 binning_x
uint32 binning_y
sensor_msgs/RegionOfInterest roi
"""
_REGION = (
    f"{_PART}sensor_msgs/RegionOfInterest\nuint32 x_offset\nuint32 y_offset\nuint32 height\nuint32 "
    "width\n"
)


def _ros_schema(name: str, *parts: str) -> Schema:
    return Schema(name, "ros2msg", "".join(parts).encode())


class RosMessages(Messages):
    """sensor_msgs/msg/Image, CompressedImage and CameraInfo of ROS 2, in CDR."""

    profile = "ros2"
    encoding = "cdr"
    raw = _ros_schema("sensor_msgs/msg/Image", _IMAGE, _HEADER)
    packed = _ros_schema("sensor_msgs/msg/CompressedImage", _COMPRESSED, _HEADER)
    lens = _ros_schema(
        "sensor_msgs/msg/CameraInfo", _CAMERA_INFO, _HEADER, _REGION, "bool do_rectify\n"
    )

    def raw_picture(self, time_ns: int, size: tuple[int, int], encoding: str, data: bytes) -> bytes:
        """sensor_msgs/msg/Image of an unpacked picture.

        Args:
            time_ns: its stamp, ns; its seconds fit into 32 bits.
            size: (width, height), px.
            encoding: of its pixels, "16UC1" or "32FC1".
            data: the pixels, little endian, row by row without padding.

        Returns:
            The bytes of the message.

        Raises:
            RecordingError: the time is beyond 2038.
        """
        width, height = size
        out = _Cdr(time_ns)
        out.whole(height, width)
        out.text(encoding)
        out.small(0)  # little endian
        out.whole(len(data) // height, len(data))
        return bytes(out.content) + data

    def packed_picture(self, time_ns: int, png: bytes) -> bytes:
        """sensor_msgs/msg/CompressedImage of a PNG picture.

        Args:
            time_ns: its stamp, ns; its seconds fit into 32 bits.
            png: a 16-bit PNG file.

        Returns:
            The bytes of the message.

        Raises:
            RecordingError: the time is beyond 2038.
        """
        return _compressed_image(time_ns, "16UC1; png compressed ", png)

    def rvl_picture(self, time_ns: int, rvl: bytes) -> bytes:
        """sensor_msgs/msg/CompressedImage of an RVL picture, as compressed_depth_image_transport.

        Args:
            time_ns: its stamp, ns; its seconds fit into 32 bits.
            rvl: the payload, see `recordings.rvl.rvl_message`.

        Returns:
            The bytes of the message.

        Raises:
            RecordingError: the time is beyond 2038.
        """
        return _compressed_image(time_ns, "16UC1; compressedDepth rvl", rvl)

    def calibration(self, time_ns: int, camera: Camera) -> bytes:
        """sensor_msgs/msg/CameraInfo of the camera of the pictures.

        Args:
            time_ns: its stamp, ns; its seconds fit into 32 bits.
            camera: the camera; its distortion is stated in ROS's terms.

        Returns:
            The bytes of the message.

        Raises:
            RecordingError: the time is beyond 2038.
        """
        out = _Cdr(time_ns)
        out.whole(camera.height, camera.width)
        model, d = _distortion(camera)
        out.text(model)
        out.whole(len(d))
        out.floats(d)
        for numbers in _matrices(camera):
            out.floats(numbers)
        out.whole(0, 0, 0, 0, 0, 0)  # not binned, the whole picture
        out.small(0)
        return bytes(out.content)


def _compressed_image(time_ns: int, how: str, packed: bytes) -> bytes:
    """sensor_msgs/msg/CompressedImage of a picture that is packed in some way."""
    out = _Cdr(time_ns)
    out.text(how)
    out.whole(len(packed))
    return bytes(out.content) + packed


class _Cdr:
    """CDR, ROS 2's layout: little endian, each number at a multiple of its size.

    Positions count from behind the first four bytes. It begins with a std_msgs/Header.
    """

    def __init__(self, time_ns: int) -> None:
        self.content = bytearray(b"\x00\x01\x00\x00")
        seconds, nanoseconds = divmod(time_ns, _SECOND)
        if not -(2**31) <= seconds < 2**31:
            raise RecordingError(
                f"a time of {seconds} s does not fit into ROS's messages, which end in 2038; write "
                "it without --ros"
            )
        self.content += struct.pack("<iI", seconds, nanoseconds)
        self.text(FRAME_ID)

    def _align(self, size: int) -> None:
        self.content += bytes((4 - len(self.content)) % size)

    def whole(self, *numbers: int) -> None:
        """Unsigned integers of 32 bits."""
        self._align(4)
        self.content += struct.pack(f"<{len(numbers)}I", *numbers)

    def small(self, number: int) -> None:
        """One of 8 bits."""
        self.content.append(number)

    def floats(self, numbers: Sequence[float]) -> None:
        """Float64s."""
        self._align(8)
        self.content += struct.pack(f"<{len(numbers)}d", *numbers)

    def text(self, text: str) -> None:
        """A string, with its length before it and a zero behind it."""
        raw = text.encode() + b"\x00"
        self.whole(len(raw))
        self.content += raw
