"""Numba kernel that lays a height map along an animal: what it looks like to one who looks the way
that it points.
"""

from __future__ import annotations

import numpy as np
from numba import njit, prange

from liex_lab.estimation._profile_kernels import to_pixel


@njit(cache=True, parallel=True)
def lay_along(heights, looks, rump, tip, middle, size, along, across, out):
    """Fill `out` (n, A, B) with heights mm, 0 beside the animal, about the middles (n, 3) of
    animals that point from their rump (n, 3) to their tip (n, 3), at places along (A,) their way
    and across (B,) it to the left, mm at home size; size (n,) over it.
    """
    last = heights.shape[1] - 1
    for i in prange(len(middle)):
        dx = tip[i, 0] - rump[i, 0]
        dy = tip[i, 1] - rump[i, 1]
        at = np.empty(2)
        length = max(np.sqrt(dx * dx + dy * dy), 1e-9)
        dx = dx / length
        dy = dy / length
        for a in range(len(along)):
            for b in range(len(across)):
                x = middle[i, 0] + size[i] * (along[a] * dx - across[b] * dy)
                y = middle[i, 1] + size[i] * (along[a] * dy + across[b] * dx)
                to_pixel(looks[i], x, y, middle[i, 2], at)
                column = int(np.floor(at[0] + 0.5))
                row = int(np.floor(at[1] + 0.5))
                inside = 0 <= row <= last and 0 <= column <= last
                out[i, a, b] = heights[i, row, column] / 16.0 if inside else 0.0
