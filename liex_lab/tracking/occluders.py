"""What stands before an animal: how much of its outline ends at something nearer.

An outline ends for one of two reasons: the animal does, and what lies behind it is seen; or
something before it begins, and the animal goes on behind that. The second shows as a step in depth
towards the camera (an occluding contour). Such an outline is not the animal's own, and a pose that
was fitted to it is not, either. The animal itself hides nothing of itself: a mouse that rears is
unread along its steep flank, and its head is nearer than the feet beyond by far.
"""

from __future__ import annotations

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from liex_lab.foreground.height_maps import HeightMaps
from liex_lab.runtime.shapes import check_shapes

Array = NDArray[np.float64]

_NEARER_MM = 25.0  # what is nearer than the animal's edge by so much stands before it
_REACH_PX = 3  # picture pixels beside the edge, which a sensor often cannot read


def behind_something(crops: HeightMaps, depths: NDArray[np.float32]) -> Array:
    """The share of each animal's outline that ends at something nearer, or at the picture's edge.

    Args:
        crops: n height maps.
        depths: (n, H, W) float32 mm, the pictures that they were cut from, 0 where unread.

    Returns:
        (n,) 0 to 1; 0 where nothing was found.
    """
    n = len(crops.n_px)
    check_shapes("frames", ("depths", depths, (n, "H", "W")))
    out = np.zeros(n)
    _share_behind(crops.heights, crops.origin, crops.step, depths, _NEARER_MM, _REACH_PX, out)
    return out


@njit(cache=True, parallel=True, nogil=True)
def _share_behind(heights, origin, step, depths, nearer_mm, reach_px, out):
    """Fill out (n,) with the share of the edges of each height map (n, S, S) behind something."""
    for i in prange(heights.shape[0]):
        size = heights.shape[1]
        n_edges = 0
        n_behind = 0
        for r in range(1, size - 1):
            v = origin[i, 1] + step[i] * r
            for c in range(1, size - 1):
                u = origin[i, 0] + step[i] * c
                if heights[i, r, c] <= 0 or not (
                    0 <= v < depths.shape[1] and 0 <= u < depths.shape[2]
                ):
                    continue
                z = depths[i, v, u]
                for dr, dc in ((1, 0), (-1, 0), (0, 1), (0, -1)):
                    if heights[i, r + dr, c + dc] > 0:
                        continue
                    n_edges += 1
                    n_behind += z > 0 and _is_behind_another(
                        heights[i], step[i], r, c, depths[i], v, u, dr, dc, z - nearer_mm, reach_px
                    )
        out[i] = n_behind / max(n_edges, 1)


@njit(cache=True)
def _is_behind_another(height, step, r, c, depth, v, u, dr, dc, nearer, reach_px):
    """The same as `is_behind` for the cell (r, c), without readings of the animal's own cells."""
    size = height.shape[0]
    for k in range(1, reach_px + 1):
        cells = (k + step - 1) // step
        row, column = r + cells * dr, c + cells * dc
        own = 0 <= row < size and 0 <= column < size and height[row, column] > 0
        if not own and is_behind(depth, v + (k - 1) * dr, u + (k - 1) * dc, dr, dc, nearer, 1):
            return True
    return False


@njit(cache=True)
def is_behind(depth, v, u, dv, du, nearer, reach_px):
    """Whether, in one direction, a reading nearer than `nearer` or the picture's edge is near."""
    for k in range(1, reach_px + 1):
        row = v + k * dv
        column = u + k * du
        if not (0 <= row < depth.shape[0] and 0 <= column < depth.shape[1]):
            return True
        if 0 < depth[row, column] < nearer:
            return True
    return False
