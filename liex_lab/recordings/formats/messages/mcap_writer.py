"""Writer of depth as MCAP: zstd chunks, stamps in ns, the calibration along with the images.

Every image closes its chunk (128 KiB), so that reading one frame unpacks one frame. Messages are
Foxglove's in protobuf or ROS 2's in CDR, which is encoded here, little endian and aligned to the
size of each number, because only three messages are needed.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from mcap.writer import Writer

from liex_lab.errors import RecordingError
from liex_lab.optics.camera import KANNALA_BRANDT, Camera
from liex_lab.recordings.depth_kernels import rvl_message
from liex_lab.recordings.formats.messages.mcap import NOTES
from liex_lab.recordings.frame import DepthFrame, metres, whole_steps
from liex_lab.recordings.writer import RecordingWriter, png_of, steps_of

FRAME_ID = "camera"
_SECOND = 10**9


class Schema(NamedTuple):
    """Definition of a message in an MCAP file.

    Attributes:
        name: full name of the message's type.
        encoding: of the definition, "protobuf" or "ros2msg".
        data: the definition.
    """

    name: str
    encoding: str
    data: bytes


def _matrices(camera: Camera) -> tuple[list[float], list[float], list[float]]:
    """K (3, 3), R (3, 3) and P (3, 4), row by row."""
    k = camera.matrix
    p = np.hstack([k, np.zeros((3, 1))])
    return k.ravel().tolist(), np.eye(3).ravel().tolist(), p.ravel().tolist()


def _distortion(camera: Camera) -> tuple[str, list[float]]:
    """ROS's name of the distortion model, and its coefficients; Foxglove uses the same."""
    bent = camera.distortion
    if bent is None:
        return "plumb_bob", [0.0] * 5
    values = list(bent.coefficients)
    if bent.model == KANNALA_BRANDT:
        return "equidistant", values
    return ("rational_polynomial", values) if any(values[5:]) else ("plumb_bob", values[:5])


class FoxgloveMessages:
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
        """foxglove.RawImage of unpacked pixels, "16UC1" or "32FC1", row by row without padding."""
        width, height = size
        return _stamped(
            self._raw(
                width=width, height=height, encoding=encoding, step=len(data) // height, data=data
            ),
            time_ns,
        )

    def packed_picture(self, time_ns: int, png: bytes) -> bytes:
        """foxglove.CompressedImage of a 16-bit PNG."""
        return _stamped(self._packed(format="png", data=png), time_ns)

    def calibration(self, time_ns: int, camera: Camera) -> bytes:
        """foxglove.CameraCalibration, with the distortion in ROS's terms."""
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
    """The definition of a message with its dependencies."""
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


class RosMessages:
    """sensor_msgs/msg/Image, CompressedImage and CameraInfo of ROS 2, in CDR.

    Each raises a RecordingError if the time is beyond 2038.
    """

    profile = "ros2"
    encoding = "cdr"
    raw = _ros_schema("sensor_msgs/msg/Image", _IMAGE, _HEADER)
    packed = _ros_schema("sensor_msgs/msg/CompressedImage", _COMPRESSED, _HEADER)
    lens = _ros_schema(
        "sensor_msgs/msg/CameraInfo", _CAMERA_INFO, _HEADER, _REGION, "bool do_rectify\n"
    )

    def raw_picture(self, time_ns: int, size: tuple[int, int], encoding: str, data: bytes) -> bytes:
        """sensor_msgs/msg/Image of unpacked pixels, "16UC1" or "32FC1", rows without padding."""
        width, height = size
        out = _Cdr(time_ns)
        out.whole(height, width)
        out.text(encoding)
        out.small(0)  # little endian
        out.whole(len(data) // height, len(data))
        return bytes(out.content) + data

    def packed_picture(self, time_ns: int, png: bytes) -> bytes:
        """sensor_msgs/msg/CompressedImage of a 16-bit PNG."""
        return _compressed_image(time_ns, "16UC1; png compressed ", png)

    def rvl_picture(self, time_ns: int, rvl: bytes) -> bytes:
        """sensor_msgs/msg/CompressedImage of an `rvl_message`."""
        return _compressed_image(time_ns, "16UC1; compressedDepth rvl", rvl)

    def calibration(self, time_ns: int, camera: Camera) -> bytes:
        """sensor_msgs/msg/CameraInfo, with the distortion in ROS's terms."""
        out = _Cdr(time_ns)
        out.whole(camera.height, camera.width)
        model, d = _distortion(camera)
        out.text(model)
        out.whole(len(d))
        out.floats(d)
        for numbers in _matrices(camera):
            out.floats(numbers)
        out.whole(0, 0, 0, 0, 0, 0)  # not binned, the whole image
        out.small(0)
        return bytes(out.content)


def _compressed_image(time_ns: int, how: str, packed: bytes) -> bytes:
    """sensor_msgs/msg/CompressedImage of a packed image."""
    out = _Cdr(time_ns)
    out.text(how)
    out.whole(len(packed))
    return bytes(out.content) + packed


class _Cdr:
    """CDR, ROS 2's layout: little endian, each number at a multiple of its size.

    Positions count from after the first four bytes. It begins with a std_msgs/Header.
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
        """Append unsigned integers of 32 bits."""
        self._align(4)
        self.content += struct.pack(f"<{len(numbers)}I", *numbers)

    def small(self, number: int) -> None:
        """Append an unsigned integer of 8 bits."""
        self.content.append(number)

    def floats(self, numbers: Sequence[float]) -> None:
        """Append float64s."""
        self._align(8)
        self.content += struct.pack(f"<{len(numbers)}d", *numbers)

    def text(self, text: str) -> None:
        """Append a string, preceded by its length and followed by a zero."""
        raw = text.encode() + b"\x00"
        self.whole(len(raw))
        self.content += raw


DEPTH_TOPIC = "/camera/depth"
CALIBRATION_TOPICS = {"foxglove": "/camera/calibration", "ros": "/camera/camera_info"}
_CHUNK_BYTES = 128 * 1024  # an image closes its chunk, so that reading one frame unpacks one frame


class McapDepthWriter(RecordingWriter):
    """Writer of one depth topic and its calibration topic.

    Whole millimetres are 16UC1; from the first other frame on, depth is 32FC1 in metres. It uses
    the `mcap` library's writer: Foxglove's does not report a full disk.
    """

    def __init__(
        self,
        path: Path,
        camera: Camera,
        *,
        messages: Literal["foxglove", "ros"] = "foxglove",
        packing: Literal["raw", "png", "rvl"] = "raw",
        step_mm: float = 1.0,
        metadata: dict[str, Any] | None = None,
    ) -> None:
        """Open the file and register schemas and channels.

        Args:
            path: the .mcap file.
            camera: the camera of the frames.
            messages: "foxglove" for Foxglove's schemas in protobuf, "ros" for ROS 2's.
            packing: "raw", "png" or (ROS only) "rvl", of an image within its chunk.
            step_mm: mm of a stored step, for "png" and "rvl".
            metadata: facts of the recording, stored as text in a metadata record.
        """
        super().__init__(path, camera)
        self._packing = packing
        self._step_mm = step_mm
        self._float = False
        self._n_off = 0
        self._calibrated_ns: int | None = None
        self._ros = RosMessages() if messages == "ros" else None
        self._messages = self._ros or FoxgloveMessages()
        self._file = path.open("wb")
        self._writer = Writer(self._file, chunk_size=_CHUNK_BYTES)
        self._writer.start(self._messages.profile, "liex_lab")
        facts = {key: str(value) for key, value in (metadata or {}).items()}
        self._writer.add_metadata(NOTES, facts | {"camera_source": camera.source})
        self._lens = self._channel(CALIBRATION_TOPICS[messages], self._messages.lens)
        self._depth = self._channel(
            DEPTH_TOPIC, self._messages.raw if packing == "raw" else self._messages.packed
        )

    def _channel(self, topic: str, schema: Schema) -> int:
        number = self._writer.register_schema(schema.name, schema.encoding, schema.data)
        return self._writer.register_channel(topic, self._messages.encoding, number)

    def add(self, frame: DepthFrame) -> None:
        """Write an image, and about once a second the calibration.

        The calibration is repeated so that a viewer may start anywhere.

        Args:
            frame: the frame, depth (H, W) float32 mm.

        Raises:
            RecordingError: (png, rvl) its depth is not in whole steps of 16 bits, or (ros) its time
                is beyond 2038.
        """
        time_ns = frame.time_ns
        if self._calibrated_ns is None or time_ns - self._calibrated_ns >= _SECOND:
            self._calibrated_ns = time_ns
            self._log(self._lens, self._messages.calibration(time_ns, self.camera), time_ns)
        self._log(self._depth, self._picture(frame), time_ns)

    def _log(self, channel: int, message: bytes, time_ns: int) -> None:
        logged_ns = max(0, time_ns)  # the time of logging is unsigned; the stamp is authoritative
        self._writer.add_message(channel, logged_ns, message, logged_ns)

    def _picture(self, frame: DepthFrame) -> bytes:
        if self._packing != "raw":
            exact = steps_of(frame, self._step_mm, exact=True)
            if self._packing == "rvl" and self._ros is not None:
                return self._ros.rvl_picture(frame.time_ns, rvl_message(exact).tobytes())
            return self._messages.packed_picture(frame.time_ns, png_of(exact))
        steps = None if self._float else whole_steps(frame.depth, 1.0)
        if steps is not None:
            data = steps.astype("<u2", copy=False).tobytes()
            encoding = "16UC1"
        else:
            self._float = True
            scaled, n_off = metres(frame.depth)
            self._n_off += n_off
            data = scaled.astype("<f4", copy=False).tobytes()
            encoding = "32FC1"
        size = self.camera.width, self.camera.height
        return self._messages.raw_picture(frame.time_ns, size, encoding, data)

    def note(self, facts: Mapping[str, str]) -> None:
        """Write facts (texts by name) known only after all frames, as a metadata record."""
        self._writer.add_metadata(NOTES, dict(facts))

    def finish(self) -> None:
        """Write the index, and note the unit of the stored depth."""
        self._writer.finish()
        if self._float:
            self.notes.append("depth is not in whole millimetres and was written as 32-bit metres")
        if self._n_off:
            self.notes.append(
                f"{self._n_off} depths differ in the last of their 24 bits, which metres do not "
                "hold"
            )

    def release(self) -> None:
        """Close the file."""
        self._file.close()
