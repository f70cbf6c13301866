"""What the CNN sees and says: 224 x 224 patches of depth, and joints relative to them. NumPy and
numba alone.

A patch is the square around the animal's bounding box, a tenth larger. Depth is scaled to 0-255 by
the same factor as the picture: 127.5 is the animal's mean depth, and half the square's side in mm
goes to 0 or 255, so the animal keeps its proportions (the paper says only "rescaled to be in the
range of 0 to 255"). Nearer is brighter; what is not the animal is 0. Joints are told in the same
unit: (right, down, nearer) from the square's centre at the animal's mean depth, in half sides of
the square.
"""

from __future__ import annotations

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

Array = NDArray[np.float64]

PATCH = 224
_MARGIN = 1.1
_MM = 16.0  # heights are sixteenths


def frames_of(heights: NDArray[np.int16], looks: Array) -> Array:
    """Where each animal (n) is: picture pixel (u, v) of its square's centre, half the side in
    pixels, the animal's mean depth mm, and half the side in mm there; (n, 5). heights (n, S, S)
    with at least one pixel, looks (n, 17).
    """
    frames = np.empty((len(looks), 5))
    _frames_all(heights, looks, frames)
    return frames


def patches_of(heights: NDArray[np.int16], looks: Array, frames: Array) -> NDArray[np.float32]:
    """The patches (n, PATCH, PATCH), 0 to 255."""
    patches = np.empty((len(looks), PATCH, PATCH), np.float32)
    _patches_all(heights, looks, frames, patches)
    return patches


def targets_of(joints_camera: Array, looks: Array, frames: Array) -> NDArray[np.float32]:
    """What the CNN should say (n, 3 J) of joints (n, J, 3) mm in the camera frame."""
    x, y, z = np.moveaxis(joints_camera, -1, 0)
    u0, v0, half_px, depth, half_mm = frames.T[:, :, None]
    fx, fy, cx, cy = looks.T[:4, :, None]
    right = (fx * x / z + cx - u0) / half_px
    down = (fy * y / z + cy - v0) / half_px
    told = np.stack([right, down, (depth - z) / half_mm], axis=-1)
    return told.reshape(len(looks), -1).astype(np.float32)


def joints_of(told: NDArray[np.float32], looks: Array, frames: Array) -> Array:
    """The inverse of `targets_of`."""
    right, down, nearer = np.moveaxis(told.astype(float).reshape(len(looks), -1, 3), -1, 0)
    u0, v0, half_px, depth, half_mm = frames.T[:, :, None]
    fx, fy, cx, cy = looks.T[:4, :, None]
    z = depth - nearer * half_mm
    return np.stack(
        [(u0 + right * half_px - cx) / fx * z, (v0 + down * half_px - cy) / fy * z, z], axis=-1
    )


@njit(cache=True, parallel=True)
def _frames_all(heights, looks, frames):
    for k in prange(len(looks)):
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
        frames[k, 0] = looks[k, 14] + looks[k, 16] * (low[0] + high[0]) / 2
        frames[k, 1] = looks[k, 15] + looks[k, 16] * (low[1] + high[1]) / 2
        frames[k, 2] = 0.5 * _MARGIN * side * looks[k, 16]
        frames[k, 3] = looks[k, 13] - total / max(n, 1) / _MM
        frames[k, 4] = frames[k, 2] * frames[k, 3] / np.sqrt(looks[k, 0] * looks[k, 1])


@njit(cache=True)
def _shade(heights, row, column, level, per_mm):
    """The brightness of one height map pixel; `level` is the animal's mean height, sixteenths of a
    mm.
    """
    if (
        not (0 <= row < heights.shape[0] and 0 <= column < heights.shape[1])
        or heights[row, column] <= 0
    ):
        return 0.0
    return min(max(127.5 * (1.0 + (heights[row, column] - level) / _MM * per_mm), 1.0), 255.0)


@njit(cache=True, parallel=True)
def _patches_all(heights, looks, frames, patches):
    for k in prange(len(looks)):
        scale = 2.0 * frames[k, 2] / looks[k, 16] / PATCH  # height map pixels a patch pixel
        left = (frames[k, 0] - frames[k, 2] - looks[k, 14]) / looks[k, 16]
        top = (frames[k, 1] - frames[k, 2] - looks[k, 15]) / looks[k, 16]
        level = (looks[k, 13] - frames[k, 3]) * _MM
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
