"""Input and output of the CNN baseline: 224 x 224 depth patches, and joints relative to them.

Lie-X section 5.2 crops the bounding box, scales depth to 0-255 and resizes to 224 x 224. Here a
patch is the square around the animal's bounding box, a tenth larger. Depth is scaled by the same
factor as the picture: 127.5 is the animal's mean depth, and half the square's side in mm goes to 0
or 255, so the animal keeps its proportions (the paper says only "rescaled to be in the range of 0
to 255"). Nearer is brighter; what is not the animal is 0. Joints are stated in the same unit:
(right, down, nearer) from the square's centre at the animal's mean depth, in half sides of the
square. NumPy and numba alone.
"""

from __future__ import annotations

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from liex_lab.runtime.shapes import check_shapes
from liex_lab.scene._height_map_kernels import N_CROP_CAMERA, crop_camera

Array = NDArray[np.float64]

PATCH = 224
N_FRAME = 5  # numbers of a square, see `frames_of`
_MARGIN = 1.1
_MM = 16.0  # heights are sixteenths


def frames_of(heights: NDArray[np.int16], crop_cameras: Array) -> Array:
    """Squares around the animals, from which patches are resampled.

    Args:
        heights: (n, S, S) int16 height maps, 1/16 mm, each with at least one pixel of the animal.
        crop_cameras: (n, 17) packed crop cameras of the height maps.

    Returns:
        (n, 5): picture pixel (u, v) of the square's centre, half the side in picture pixels, the
        animal's mean depth, mm, and half the side in mm at that depth.
    """
    n = len(crop_cameras)
    _check(heights, crop_cameras)
    frames = np.empty((n, N_FRAME))
    _frames_all(heights, crop_cameras, frames)
    return frames


def patches_of(
    heights: NDArray[np.int16], crop_cameras: Array, frames: Array
) -> NDArray[np.float32]:
    """Resample patches from height maps, bilinearly.

    Args:
        heights: (n, S, S) int16 height maps, 1/16 mm.
        crop_cameras: (n, 17) packed crop cameras of the height maps.
        frames: (n, 5) squares from `frames_of`.

    Returns:
        (n, PATCH, PATCH) float32 brightness, 0 to 255; 0 beside the animal.
    """
    n = len(crop_cameras)
    _check(heights, crop_cameras)
    check_shapes("patches", ("frames", frames, (n, N_FRAME)))
    patches = np.empty((n, PATCH, PATCH), np.float32)
    _patches_all(heights, crop_cameras, frames, patches)
    return patches


def _check(heights: NDArray[np.int16], crop_cameras: Array) -> None:
    check_shapes(
        "patches",
        ("heights", heights, ("n", "S", "S")),
        ("crop_cameras", crop_cameras, ("n", N_CROP_CAMERA)),
    )


def targets_of(joints_camera: Array, crop_cameras: Array, frames: Array) -> NDArray[np.float32]:
    """Training targets of the CNN from true joints.

    Args:
        joints_camera: (n, J, 3) joints, mm, camera frame.
        crop_cameras: (n, 17) packed crop cameras of the height maps.
        frames: (n, 5) squares from `frames_of`.

    Returns:
        (n, 3 J) float32 (right, down, nearer) of each joint, in half sides of its square.
    """
    x, y, z = np.moveaxis(joints_camera, -1, 0)
    u0, v0, half_px, depth, half_mm = frames.T[:, :, None]
    fx, fy, cx, cy = crop_cameras.T[:4, :, None]
    right = (fx * x / z + cx - u0) / half_px
    down = (fy * y / z + cy - v0) / half_px
    coordinates = np.stack([right, down, (depth - z) / half_mm], axis=-1)
    return coordinates.reshape(len(crop_cameras), -1).astype(np.float32)


def joints_of(coordinates: NDArray[np.float32], crop_cameras: Array, frames: Array) -> Array:
    """Joints from outputs of the CNN; the inverse of `targets_of`.

    Args:
        coordinates: (n, 3 J) float32 outputs.
        crop_cameras: (n, 17) packed crop cameras of the height maps.
        frames: (n, 5) squares from `frames_of`.

    Returns:
        (n, J, 3) joints, mm, camera frame.
    """
    right, down, nearer = np.moveaxis(
        coordinates.astype(float).reshape(len(crop_cameras), -1, 3), -1, 0
    )
    u0, v0, half_px, depth, half_mm = frames.T[:, :, None]
    fx, fy, cx, cy = crop_cameras.T[:4, :, None]
    z = depth - nearer * half_mm
    return np.stack(
        [(u0 + right * half_px - cx) / fx * z, (v0 + down * half_px - cy) / fy * z, z], axis=-1
    )


@njit(cache=True, parallel=True)
def _frames_all(heights, crop_cameras, frames):
    for k in prange(len(crop_cameras)):
        camera = crop_camera(crop_cameras[k])
        low = np.full(2, 1 << 30)
        high = np.full(2, -1)
        total = 0.0
        n = 0
        for row in range(heights.shape[1]):
            for column in range(heights.shape[2]):
                h = heights[k, row, column]
                if h > 0:
                    low[0], low[1] = min(low[0], column), min(low[1], row)
                    high[0], high[1] = max(high[0], column), max(high[1], row)
                    total = total + h
                    n = n + 1
        side = max(high[0] - low[0], high[1] - low[1]) + 1
        frames[k, 0] = camera.u0 + camera.step * (low[0] + high[0]) / 2
        frames[k, 1] = camera.v0 + camera.step * (low[1] + high[1]) / 2
        frames[k, 2] = 0.5 * _MARGIN * side * camera.step
        frames[k, 3] = camera.distance - total / max(n, 1) / _MM
        frames[k, 4] = frames[k, 2] * frames[k, 3] / np.sqrt(camera.fx * camera.fy)


@njit(cache=True)
def _shade(heights, row, column, level, per_mm):
    """Brightness of one pixel of a height map; `level` is the animal's mean height, 1/16 mm."""
    if (
        not (0 <= row < heights.shape[0] and 0 <= column < heights.shape[1])
        or heights[row, column] <= 0
    ):
        return 0.0
    return min(max(127.5 * (1.0 + (heights[row, column] - level) / _MM * per_mm), 1.0), 255.0)


@njit(cache=True, parallel=True)
def _patches_all(heights, crop_cameras, frames, patches):
    for k in prange(len(crop_cameras)):
        camera = crop_camera(crop_cameras[k])
        scale = 2.0 * frames[k, 2] / camera.step / PATCH  # height map pixels a patch pixel
        left = (frames[k, 0] - frames[k, 2] - camera.u0) / camera.step
        top = (frames[k, 1] - frames[k, 2] - camera.v0) / camera.step
        level = (camera.distance - frames[k, 3]) * _MM
        per_mm = 1.0 / frames[k, 4]
        for i in range(PATCH):
            y = top + (i + 0.5) * scale
            row = int(np.floor(y))
            for j in range(PATCH):
                x = left + (j + 0.5) * scale
                column = int(np.floor(x))
                a = x - column
                b = y - row
                above = (1 - a) * _shade(heights[k], row, column, level, per_mm)
                above += a * _shade(heights[k], row, column + 1, level, per_mm)
                below = (1 - a) * _shade(heights[k], row + 1, column, level, per_mm)
                below += a * _shade(heights[k], row + 1, column + 1, level, per_mm)
                patches[k, i, j] = (1 - b) * above + b * below
