"""Numba kernels that look along a finished pose: how high the animal's back is over its chain, and
where it ends.
"""

from __future__ import annotations

import numpy as np
from numba import njit, prange

_WINDOW = 2  # crop pixels to each side of a joint over which the back's height is averaged
_STEP = 0.5  # crop pixels
# of the chain's length: beyond its ends, and back from them, the animal's end is looked for
_END_SHARE = 0.15


@njit(cache=True)
def to_pixel(look, x0, y0, z0, out):
    """Crop pixel (column, row) of a point mm of the view frame into out (2,)."""
    z0 -= look[13]
    x = look[4] * x0 + look[7] * y0 + look[10] * z0
    y = look[5] * x0 + look[8] * y0 + look[11] * z0
    z = max(look[6] * x0 + look[9] * y0 + look[12] * z0, 1.0)
    out[0] = (look[0] * x / z + look[2] - look[14]) / look[16]
    out[1] = (look[1] * y / z + look[3] - look[15]) / look[16]


@njit(cache=True)
def back_over(heights, look, position, most, out):
    """Mean height mm of the animal over a joint (3,), less the joint's own, of readings within
    `most` mm of their median, and the share of a window that shows the animal, into out (2,).
    """
    last = heights.shape[0] - 1
    at = np.empty(2)
    to_pixel(look, position[0], position[1], position[2], at)
    column = int(np.floor(at[0] + 0.5))
    row = int(np.floor(at[1] + 0.5))
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
def end_past(heights, look, end, before, reach):
    """How far (mm, at most `reach`) the animal goes on past a chain's end (3,), straight on from
    the joint before it; negative where it ends before.
    """
    last = heights.shape[0] - 1
    at = np.empty(2)
    way = end - before
    length = np.sqrt(np.sum(way * way))
    way = way / max(length, 1e-9)
    first = np.empty(2)
    second = np.empty(2)
    to_pixel(look, end[0], end[1], end[2], first)
    to_pixel(look, before[0], before[1], before[2], second)
    per_px = length / max(np.hypot(first[0] - second[0], first[1] - second[1]), 0.2)
    n = int(reach / per_px / _STEP)
    for k in range(-n, n + 1):
        past = k * _STEP * per_px
        to_pixel(look, end[0] + past * way[0], end[1] + past * way[1], end[2] + past * way[2], at)
        column = int(np.floor(at[0] + 0.5))
        row = int(np.floor(at[1] + 0.5))
        on = False
        for r in range(max(row - 1, 0), min(row + 1, last) + 1):
            for c in range(max(column - 1, 0), min(column + 1, last) + 1):
                on |= heights[r, c] > 0
        if not on:
            return past
    return reach


@njit(cache=True, parallel=True)
def look_along(heights, looks, positions, length, most_share, out):
    """Fill `out` (n, 2 J + 2) for chains (n, J, 3) mm of animals `length` (n,) mm long: `back_over`
    of joints, first heights, and `end_past` of the first and the last of them. most_share of the
    length: see `back_over`.
    """
    m = positions.shape[1]
    for i in prange(positions.shape[0]):
        here = np.empty(2)
        for k in range(m):
            back_over(heights[i], looks[i], positions[i, k], most_share * length[i], here)
            out[i, k] = here[0]
            out[i, m + k] = here[1]
        for end in range(2):
            k, before = (m - 1, m - 2) if end else (0, 1)
            reach = _END_SHARE * length[i]
            out[i, 2 * m + end] = end_past(
                heights[i], looks[i], positions[i, k], positions[i, before], reach
            )
