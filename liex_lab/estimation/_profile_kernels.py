"""Numba kernels of the ridge correction's features: height profile of the back along a chain.

They read how high the animal's back is over each joint of a finished pose, and where the animal
ends beyond the ends of the chain.
"""

from __future__ import annotations

import numpy as np
from numba import njit, prange

from liex_lab.foreground._crop_camera_kernels import crop_camera, to_pixel

_WINDOW = 2  # crop pixels to each side of a joint over which the back's height is averaged
_STEP = 0.5  # crop pixels
# of the chain's length: beyond its ends, and back from them, the animal's end is looked for
_END_SHARE = 0.15


@njit(cache=True)
def back_over(heights, packed_camera, position, most, out):
    """Height of the animal's back over a joint.

    It is the mean over a window of crop pixels of the readings within `most` of their median.

    Args:
        heights: (S, S) int16 height map, 1/16 mm, 0 where there is no animal.
        packed_camera: (17,) packed crop camera.
        position: (3,) the joint, mm, view frame.
        most: readings farther than this from the median are left out, mm.
        out: (2,) filled with the height above the joint, mm, 0 where nothing is read, and the share
            of the window that shows the animal.
    """
    last = heights.shape[0] - 1
    u, v = to_pixel(crop_camera(packed_camera), position[0], position[1], position[2])
    column = int(np.floor(u + 0.5))
    row = int(np.floor(v + 0.5))
    seen = np.empty((2 * _WINDOW + 1) ** 2)
    n = 0
    for r in range(max(row - _WINDOW, 0), min(row + _WINDOW, last) + 1):
        for c in range(max(column - _WINDOW, 0), min(column + _WINDOW, last) + 1):
            if heights[r, c] > 0:
                seen[n] = heights[r, c] / 16.0 - position[2]
                n += 1
    out[0] = 0.0
    out[1] = n / seen.size
    if n == 0:
        return
    middle = np.sort(seen[:n])[n // 2]
    total = 0.0
    many = 0
    for i in range(n):
        if abs(seen[i] - middle) <= most:
            total += seen[i]
            many += 1
    out[0] = total / many


@njit(cache=True)
def end_past(heights, packed_camera, end, before, reach):
    """How far the animal goes on past the end of a chain, straight on from the joint before it.

    Args:
        heights: (S, S) int16 height map, 1/16 mm, 0 where there is no animal.
        packed_camera: (17,) packed crop camera.
        end: (3,) the end joint, mm, view frame.
        before: (3,) the joint before it.
        reach: how far to look in either direction, mm.

    Returns:
        mm, at most `reach`; negative where the animal ends before the joint.
    """
    last = heights.shape[0] - 1
    camera = crop_camera(packed_camera)
    way = end - before
    length = np.sqrt(np.sum(way * way))
    way = way / max(length, 1e-9)
    first_u, first_v = to_pixel(camera, end[0], end[1], end[2])
    second_u, second_v = to_pixel(camera, before[0], before[1], before[2])
    per_px = length / max(np.hypot(first_u - second_u, first_v - second_v), 0.2)
    n = int(reach / per_px / _STEP)
    for k in range(-n, n + 1):
        past = k * _STEP * per_px
        u, v = to_pixel(
            camera, end[0] + past * way[0], end[1] + past * way[1], end[2] + past * way[2]
        )
        column = int(np.floor(u + 0.5))
        row = int(np.floor(v + 0.5))
        on = False
        for r in range(max(row - 1, 0), min(row + 1, last) + 1):
            for c in range(max(column - 1, 0), min(column + 1, last) + 1):
                on |= heights[r, c] > 0
        if not on:
            return past
    return reach


@njit(cache=True, parallel=True)
def look_along(heights, crop_cameras, positions, length, most_share, out):
    """Profile of each chain: the back's height over all joints, and the reach past both ends.

    Args:
        heights: (n, S, S) int16 height maps, 1/16 mm, 0 where there is no animal.
        crop_cameras: (n, 17) packed crop cameras of the height maps.
        positions: (n, J, 3) joints, mm, view frame.
        length: (n,) lengths of the animals, mm.
        most_share: of the length; see `most` of `back_over`.
        out: (n, 2 J + 2) filled with heights (J), shares seen (J), and `end_past` of the first and
            the last joint, mm.
    """
    m = positions.shape[1]
    for i in prange(positions.shape[0]):
        here = np.empty(2)
        for k in range(m):
            back_over(heights[i], crop_cameras[i], positions[i, k], most_share * length[i], here)
            out[i, k] = here[0]
            out[i, m + k] = here[1]
        for end in range(2):
            k, before = (m - 1, m - 2) if end else (0, 1)
            reach = _END_SHARE * length[i]
            out[i, 2 * m + end] = end_past(
                heights[i], crop_cameras[i], positions[i, k], positions[i, before], reach
            )
