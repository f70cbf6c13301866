"""Decoders of images and point clouds in messages to depth, shared by MCAP files and ROS bags.

Raw 16UC1, mono16 and 32FC1 (m); PNG; ROS's compressedDepth as PNG or RVL, where quantised depth is
z = a / (q - b) m; point clouds, in rows or splatted with a z-buffer: u = fx x / z + cx.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from liex_lab.errors import RecordingError
from liex_lab.optics.camera import Camera
from liex_lab.recordings.formats.images.files import decode_png, png_size
from liex_lab.recordings.formats.messages.messages import (
    DamagedMessage,
    DepthMessage,
    PackedPicture,
    PointCloud,
    RawPicture,
)
from liex_lab.recordings.frame import Depth, depth_mm

LARGEST_PICTURE = (
    1 << 24
)  # pixels; more than any depth camera: a damaged size would need all the memory
_LARGEST_CLOUD = 1 << 22  # points
_METRE = 1000.0
_ENCODINGS = {
    "16UC1": ("u2", 1.0),
    "mono16": ("u2", 1.0),
    "32FC1": ("f4", _METRE),
}  # stored type, mm per step
_CONFIG = struct.Struct(
    "<iff"
)  # precedes a compressedDepth image: format, and a and b of quantised depth
_RVL_SIZE = struct.Struct("<II")
_PNG_HEAD = 26


def picture_size(message: DepthMessage) -> tuple[int, int] | None:
    """Size of a depth image, without decoding it.

    Args:
        message: an image or a point cloud.

    Returns:
        Width and height, px; (0, 0) for points without rows; None for an image of another kind, or
        of more than 2^24 pixels (clouds: 2^22 points).
    """
    if isinstance(message, PointCloud):
        known = {"x", "y", "z"} <= set(
            message.columns
        ) and 0 < message.width * message.height <= _LARGEST_CLOUD
        size = (message.width, message.height) if message.height > 1 else (0, 0)
        return size if known else None
    if isinstance(message, RawPicture):
        size = (message.width, message.height)
        return size if message.encoding in _ENCODINGS and min(size) > 0 and _fits(size) else None
    try:
        found = _packed_size(message)
    except (RecordingError, DamagedMessage, struct.error):
        return None  # a colour PNG is not depth
    return found if found is not None and min(found) > 0 and _fits(found) else None


def stated_kind(message: DepthMessage) -> str:
    """Stated type of a message's content, for error messages."""
    if isinstance(message, PointCloud):
        return f"points of {', '.join(message.columns) or 'nothing'}"
    if isinstance(message, RawPicture):
        return (
            f"{message.encoding}, {message.width} x {message.height} pixels in rows of "
            f"{message.step} bytes, {len(message.data)} bytes in all"
        )
    return message.packing.strip()


def _fits(size: tuple[int, int]) -> bool:
    return size[0] * size[1] <= LARGEST_PICTURE


def _packed_size(message: PackedPicture) -> tuple[int, int] | None:
    body = _body(message)
    if _is_rvl(message):
        width, height = _RVL_SIZE.unpack_from(body)
        return width, height
    return png_size(bytes(body[:_PNG_HEAD]), "picture")


def _is_rvl(message: PackedPicture) -> bool:
    return "compressedDepth" in message.packing and "rvl" in message.packing.lower()


def _body(message: PackedPicture) -> memoryview:
    """The data after the configuration at the start of ROS's compressedDepth."""
    data = memoryview(message.data)
    return data[_CONFIG.size :] if "compressedDepth" in message.packing else data


def decode(
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
    if picture_size(message) not in ((camera.width, camera.height), (0, 0)):
        return None
    if isinstance(message, PointCloud):
        z_mm = _cloud_depth(message, camera)
        return None if z_mm is None else depth_mm(z_mm, scale, unread)
    if isinstance(message, RawPicture):
        stored = _raw_pixels(message)
        metric = _ENCODINGS[message.encoding][1]
    else:
        stored = _packed_pixels(message)
        metric = _METRE if stored is not None and stored.dtype.kind == "f" else 1.0
    if stored is None or stored.shape != (camera.height, camera.width):
        return None
    return depth_mm(stored, scale * (step_mm if metric == 1.0 else metric), unread)


def _raw_pixels(message: RawPicture) -> NDArray[Any] | None:
    dtype = np.dtype(_ENCODINGS[message.encoding][0]).newbyteorder(
        ">" if message.big_endian else "<"
    )
    width = message.width
    height = message.height
    step = message.step or width * dtype.itemsize
    if step == width and len(message.data) == height * width * dtype.itemsize:
        step = width * dtype.itemsize  # some writers state pixels per row instead of bytes
    # some writers leave out the padding of the last row
    if step < width * dtype.itemsize or step * (height - 1) + width * dtype.itemsize > len(
        message.data
    ):
        return None
    return np.ndarray((height, width), dtype, message.data, strides=(step, dtype.itemsize))


def _packed_pixels(message: PackedPicture) -> NDArray[Any] | None:
    body = _body(message)
    pixels: NDArray[Any] | None
    if _is_rvl(message):
        from liex_lab.recordings.depth_kernels import unpack_rvl

        width, height = _RVL_SIZE.unpack_from(body)
        pixels = unpack_rvl(body[_RVL_SIZE.size :], width, height)
    else:
        pixels = decode_png(np.frombuffer(body, np.uint8))
    if (
        pixels is None
        or "compressedDepth" not in message.packing
        or not message.packing.startswith("32FC1")
    ):
        return pixels
    # metres, quantised with steps that grow with distance like the sensor's own
    _, a, b = _CONFIG.unpack_from(message.data)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        metres = np.float32(a) / (pixels.astype(np.float32) - np.float32(b))
    metres[pixels == 0] = 0.0
    return metres


def _cloud_depth(cloud: PointCloud, camera: Camera) -> NDArray[np.float64] | None:
    """Depth (H, W) mm: z of points in rows, or the nearest point per pixel of others."""
    points = {name: _column(cloud, name) for name in ("x", "y", "z")}
    x = points["x"]
    y = points["y"]
    z = points["z"]
    if x is None or y is None or z is None:
        return None
    if cloud.pose is not None:
        x, y, z = _moved(cloud.pose, x, y, z)
    if cloud.height > 1:
        return z * _METRE
    if x.size == camera.width * camera.height:  # concatenated rows
        return z.reshape(camera.height, camera.width) * _METRE
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        column = np.floor(camera.fx * x / z + camera.cx + 0.5)
        row = np.floor(camera.fy * y / z + camera.cy + 0.5)
        seen = (
            (z > 0) & (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
        )
    depth = np.full(camera.width * camera.height, np.inf)
    np.minimum.at(
        depth, (row[seen] * camera.width + column[seen]).astype(np.int64), z[seen] * _METRE
    )
    return depth.reshape(camera.height, camera.width)


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


def _moved(
    pose: tuple[float, ...], x: NDArray[np.float64], y: NDArray[np.float64], z: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """The points in the camera's frame: p + q v q*, expanded."""
    at = np.array(pose[:3])
    turn = np.array(pose[3:])
    norm = float(np.linalg.norm(turn))
    qx, qy, qz, qw = turn / norm if norm > 0 else (0.0, 0.0, 0.0, 1.0)
    q = np.array([qx, qy, qz])
    v = np.stack([x, y, z], axis=-1)
    t = 2.0 * np.cross(q, v)
    moved = v + qw * t + np.cross(q, t) + at
    return moved[..., 0], moved[..., 1], moved[..., 2]
