"""Numba kernel of the head-tail classifier: resamples a height map along an animal's direction."""

from __future__ import annotations

import numpy as np
from numba import njit, prange

from liex_lab.foreground._crop_camera_kernels import crop_camera, to_pixel


@njit(cache=True, parallel=True)
def lay_along(heights, crop_cameras, rump, tip, middle, size, along, across, out):
    """Resample height maps on a grid that lies along the animals.

    Grid point (a, b) is middle + size (along[a] d + across[b] d_left), d being the unit direction
    from base to tip in the image plane; the nearest pixel is taken.

    Args:
        heights: (n, S, S) int16 height maps, 1/16 mm, 0 where there is no animal.
        crop_cameras: (n, 17) packed crop cameras of the height maps.
        rump: (n, 3) base joints, mm, view frame.
        tip: (n, 3) joints that the animals point at, mm, view frame.
        middle: (n, 3) centres of the grids, mm, view frame.
        size: (n,) the animals' size over home size.
        along: (A,) grid coordinates along the animal, mm at home size.
        across: (B,) grid coordinates to its left, mm at home size.
        out: (n, A, B) filled with heights, mm; 0 beside the animal.
    """
    last = heights.shape[1] - 1
    for i in prange(len(middle)):
        dx = tip[i, 0] - rump[i, 0]
        dy = tip[i, 1] - rump[i, 1]
        camera = crop_camera(crop_cameras[i])
        length = max(np.sqrt(dx * dx + dy * dy), 1e-9)
        dx = dx / length
        dy = dy / length
        for a in range(len(along)):
            for b in range(len(across)):
                x = middle[i, 0] + size[i] * (along[a] * dx - across[b] * dy)
                y = middle[i, 1] + size[i] * (along[a] * dy + across[b] * dx)
                u, v = to_pixel(camera, x, y, middle[i, 2])
                column = int(np.floor(u + 0.5))
                row = int(np.floor(v + 0.5))
                inside = 0 <= row <= last and 0 <= column <= last
                out[i, a, b] = heights[i, row, column] / 16.0 if inside else 0.0
