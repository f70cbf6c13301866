"""Messages that hold depth or say something about it, in one form whatever they were packed as."""

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
UNIT_TOPIC = (
    "/option/Depth Units/value"  # where the RealSense program writes the metres of a stored step
)
UNIT_SCHEMA = "std_msgs/Float32"


class DamagedMessage(ValueError):
    """A message that is not what its schema says."""


@dataclass(frozen=True, slots=True)
class RawPicture:
    """Pixels as they are. encoding: 16UC1, mono16, 32FC1, ...; step: bytes from one row to the
    next.
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
    """A packed picture. packing: png, or as ROS writes it, '16UC1; compressedDepth rvl'."""

    stamp_ns: int
    frame_id: str
    packing: str
    data: bytes | memoryview


@dataclass(frozen=True, slots=True)
class PointCloud:
    """Points in metres. width, height: of the picture they lie in, row by row; height 1: they lie
    anyhow.

    columns: where within a point x, y and z lie, and NumPy's name of their type; pose: position (3)
    m and quaternion x, y, z, w of the cloud's own frame, None where the points are in the camera's.
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
    """A camera's lens. k: row-major 3 x 3; d: distortion; p: row-major 3 x 4, of the rectified
    picture; or empty.
    """

    frame_id: str
    width: int
    height: int
    model: str
    d: tuple[float, ...]
    k: tuple[float, ...]
    p: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class DepthUnit:
    """Metres in one stored step of the depth pictures."""

    metres: float


DepthMessage = RawPicture | PackedPicture | PointCloud
Message = DepthMessage | Calibration | DepthUnit
Parser = Callable[[memoryview], Message]
