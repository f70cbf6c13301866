"""Numba kernel of the mean cross-sections: a height map read across the mid-axis of a chain."""

from __future__ import annotations

import numpy as np
from numba import njit, prange

from liex_lab.foreground._crop_camera_kernels import crop_camera, to_pixel


@njit(cache=True, parallel=True)
def read_across(heights, crop_cameras, points, sideways, lateral, seen, height):
    """Read height maps at distances to the left and right of points on the mid-axis.

    Args:
        heights: (n, H, W) int16 height maps, 1/16 mm, 0 where there is no animal.
        crop_cameras: (n, 17) packed crop cameras of the height maps.
        points: (n, S, 3) on the mid-axis, mm, view frame.
        sideways: (n, S, 2) unit vectors across the axis, view frame.
        lateral: (T,) distances from the axis, mm.
        seen: (n, S, T) filled with how many of the two sides show the animal, over 2.
        height: (n, S, T) filled with the mean height of those over the axis, mm, 0 where none does.
    """
    for i in prange(points.shape[0]):
        camera = crop_camera(crop_cameras[i])
        for s in range(points.shape[1]):
            for t in range(lateral.shape[0]):
                n = 0
                total = 0.0
                for side in (-1.0, 1.0):
                    u, v = to_pixel(
                        camera,
                        points[i, s, 0] + side * lateral[t] * sideways[i, s, 0],
                        points[i, s, 1] + side * lateral[t] * sideways[i, s, 1],
                        points[i, s, 2],
                    )
                    column = int(np.floor(u + 0.5))
                    row = int(np.floor(v + 0.5))
                    inside = 0 <= row < heights.shape[1] and 0 <= column < heights.shape[2]
                    if inside and heights[i, row, column] > 0:
                        n += 1
                        total += heights[i, row, column] / 16.0 - points[i, s, 2]
                seen[i, s, t] = 0.5 * n
                height[i, s, t] = total / n if n > 0 else 0.0
