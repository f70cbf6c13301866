"""Polygons that people draw: whether the sides of one cross."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def crossing_sides(corners: Array) -> tuple[int, int] | None:
    """The first two sides of a polygon that cross inside both, counted from 0.

    Two lines cross where the ends of each lie on two sides of the other.

    Args:
        corners: (n, 2), in order; side k goes from corner k to the next.

    Returns:
        Their numbers, the smaller first; None where no sides cross.
    """
    ends = np.roll(corners, -1, axis=0)
    n = len(corners)
    for i in range(n - 2):
        others = slice(i + 2, n - (i == 0))
        a, b, c, d = corners[i], ends[i], corners[others], ends[others]
        crossing = (_side(a, b, c) * _side(a, b, d) < 0) & (_side(c, d, a) * _side(c, d, b) < 0)
        if crossing.any():
            return i, i + 2 + int(np.argmax(crossing))
    return None


def _side(p: Array, q: Array, r: Array) -> Array:
    """Twice the signed area of triangles p, q, r, any of them (..., 2)."""
    return np.asarray(
        (q[..., 0] - p[..., 0]) * (r[..., 1] - p[..., 1])
        - (q[..., 1] - p[..., 1]) * (r[..., 0] - p[..., 0])
    )
