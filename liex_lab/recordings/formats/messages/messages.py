"""Common form of the messages that hold depth or describe it, whatever they were packed as.

Schemas: foxglove.RawImage, CompressedImage, PointCloud and CameraCalibration; sensor_msgs/Image,
CompressedImage, PointCloud2 and CameraInfo; std_msgs/String, std_msgs/Float32 and
diagnostic_msgs/KeyValue for what the RealSense programs state (see `realsense`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

PICTURE_SCHEMAS = (
    "foxglove.RawImage",
    "foxglove.CompressedImage",
    "sensor_msgs/Image",
    "sensor_msgs/CompressedImage",
)
CLOUD_SCHEMAS = ("foxglove.PointCloud", "sensor_msgs/PointCloud2")
CALIBRATION_SCHEMAS = ("foxglove.CameraCalibration", "sensor_msgs/CameraInfo")
STATEMENT_SCHEMAS = ("std_msgs/String", "std_msgs/Float32", "diagnostic_msgs/KeyValue")


class DamagedMessage(ValueError):
    """A message is not what its schema says."""


@dataclass(frozen=True, slots=True)
class RawPicture:
    """An unpacked picture.

    Attributes:
        stamp_ns: stamp of the sensor, ns.
        frame_id: name of the camera's frame.
        width: columns, px.
        height: rows, px.
        encoding: of the pixels, 16UC1, mono16, 32FC1, ...
        step: bytes from one row to the next; 0 for no padding.
        big_endian: True where the high byte comes first.
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
class PackedPicture:
    """A packed picture.

    Attributes:
        stamp_ns: stamp of the sensor, ns.
        frame_id: name of the camera's frame.
        packing: png, or as ROS writes it, '16UC1; compressedDepth rvl'.
        data: the packed bytes.
    """

    stamp_ns: int
    frame_id: str
    packing: str
    data: bytes | memoryview


@dataclass(frozen=True, slots=True)
class PointCloud:
    """Points in metres, in rows like a picture or loose.

    Attributes:
        stamp_ns: stamp of the sensor, ns.
        frame_id: name of the points' frame.
        width: columns of the picture that they lie in, row by row.
        height: its rows; 1 for loose points.
        columns: by name (x, y, z), the offset within a point, bytes, and NumPy's name of the type.
        point_step: bytes from one point to the next.
        row_step: bytes from one row to the next.
        data: the points.
        pose: position (3) m and quaternion x, y, z, w of the cloud's own frame; None where the
            points are in the camera frame.
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
    """Intrinsics of a camera, as ROS and Foxglove state them.

    Attributes:
        frame_id: name of the camera's frame.
        width: columns of its pictures, px.
        height: rows of its pictures, px.
        model: ROS's name of the distortion model.
        d: distortion coefficients.
        k: (9,) camera matrix 3 x 3, row by row.
        p: (12,) projection matrix 3 x 4 of the rectified picture, row by row; or empty.
        binning: pixels of the full picture, along columns and rows, that make one of these; 0 is 1.
        roi: column and row offset, width and height of the part of the full picture, px; width or
            height 0 for the whole.
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
    """Facts that a program states as text.

    Attributes:
        facts: text by name; a bare value has the name "value".
    """

    facts: dict[str, str]


DepthMessage = RawPicture | PackedPicture | PointCloud
Message = DepthMessage | Calibration | Statement
Parser = Callable[[memoryview], Message]
