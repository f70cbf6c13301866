"""Crop cameras: how each height map was cut out of a camera's picture, packed row by row.

A batch is an array (n, 17), so that crops can be chosen, joined and stored like any other rows;
`crop_columns` gives its columns by name, and kernels unpack a row with `crop_camera`. The equations
of the projection stand in `_crop_camera_kernels`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from liex_lab.foreground._crop_camera_kernels import N_CROP_CAMERA, CropCamera
from liex_lab.geometry import SE3

__all__ = [
    "N_CROP_CAMERA",
    "CropCamera",
    "crop_columns",
    "in_camera_frame",
    "in_view_frame",
    "mm_per_px",
    "pack_crop_cameras",
    "view_of",
]

Array = NDArray[np.float64]
_ROTATION = slice(CropCamera._fields.index("r00"), CropCamera._fields.index("r22") + 1)


def pack_crop_cameras(
    intrinsics: Array,
    rotation: Array,
    distance: Array,
    origin: NDArray[np.int32],
    step: NDArray[np.int32],
) -> Array:
    """Pack the cameras of n crops.

    Args:
        intrinsics: (4,) or (n, 4) fx, fy, cx, cy of the whole picture, px.
        rotation: (3, 3) or (n, 3, 3) of T_view_camera.
        distance: (n,) z of the camera's centre in the view frame, mm.
        origin: (n, 2) column and row of the whole picture that are the crop's first.
        step: (n,) pixels of the whole picture from one crop pixel to the next.

    Returns:
        (n, 17) packed crop cameras.
    """
    packed = np.empty((len(step), N_CROP_CAMERA))
    packed[:, :4] = intrinsics
    packed[:, _ROTATION] = np.reshape(rotation, (*np.shape(rotation)[:-2], 9))
    packed[:, CropCamera._fields.index("distance")] = distance
    packed[:, CropCamera._fields.index("u0") : CropCamera._fields.index("step")] = origin
    packed[:, CropCamera._fields.index("step")] = step
    return packed


def crop_columns(crop_cameras: Array) -> CropCamera:
    """The columns of packed crop cameras by name.

    Args:
        crop_cameras: (n, 17) packed crop cameras.

    Returns:
        Views (n,) of the columns.
    """
    return CropCamera(*crop_cameras.T)


def _rotations(crop_cameras: Array) -> Array:
    """Rotations (n, 3, 3) of T_view_camera."""
    return crop_cameras[:, _ROTATION].reshape(-1, 3, 3)


def view_of(crop_cameras: Array) -> SE3:
    """Where the cameras stand in the view frames of their crops.

    Args:
        crop_cameras: (n, 17) packed crop cameras.

    Returns:
        T_view_camera (n), mm.
    """
    translation = np.zeros((len(crop_cameras), 3))
    translation[:, 2] = crop_columns(crop_cameras).distance
    return SE3(_rotations(crop_cameras), translation)


def mm_per_px(crop_cameras: Array) -> Array:
    """How many millimetres a crop pixel covers at the distance of the view frame's origin.

    Args:
        crop_cameras: (n, 17) packed crop cameras.

    Returns:
        (n,) mm per crop pixel.
    """
    columns = crop_columns(crop_cameras)
    return np.asarray(columns.step * columns.distance / columns.fx)


def in_camera_frame(points: Array, crop_cameras: Array) -> Array:
    """Points of the view frames of crops, in their cameras' frames.

    Args:
        points: (n, ..., 3) mm, view frames.
        crop_cameras: (n, 17) packed crop cameras.

    Returns:
        (n, ..., 3) mm, camera frames.
    """
    offset = points - _camera_centre(points, crop_cameras)
    return np.einsum("nji,n...j->n...i", _rotations(crop_cameras), offset)


def in_view_frame(points: Array, crop_cameras: Array) -> Array:
    """The inverse of `in_camera_frame`.

    Args:
        points: (n, ..., 3) mm, camera frames.
        crop_cameras: (n, 17) packed crop cameras.

    Returns:
        (n, ..., 3) mm, view frames.
    """
    turned = np.einsum("nij,n...j->n...i", _rotations(crop_cameras), points)
    return turned + _camera_centre(points, crop_cameras)


def _camera_centre(points: Array, crop_cameras: Array) -> Array:
    """The camera's centre (n, ..., 3) mm in the view frames, to be added to points (n, ..., 3)."""
    centre = np.zeros((len(crop_cameras), *(1,) * (points.ndim - 2), 3))
    distance = crop_columns(crop_cameras).distance
    centre[..., 2] = distance.reshape(-1, *(1,) * (points.ndim - 2))
    return centre
