"""Numba kernels of rectification: table lookup, forward splatting with a z-buffer, hole closing.

Serial, and without the interpreter's lock: what is written is spread over the picture, and two
threads that spread together cost more than they save (`look_up` of 1024 x 1024 pixels takes about 2
ms, `lift` and `close` 6 ms).
"""

from __future__ import annotations

import numpy as np
from numba import njit

UNREAD = np.float32(1e30)  # stands where a pixel without reading belongs, and yields to any reading
_ONE = np.float32(1.0)
_HALF = np.float32(0.5)
_FOUR = np.float32(4.0)
# a picture's depths are finite; without infinities and signed zeros the compiler may treat eight
# pixels at once
_FAST = {"nnan", "ninf", "nsz", "arcp", "contract", "afn", "reassoc"}


@njit(cache=True, nogil=True)
def look_up(depth, source, out):
    """Copy, for every pixel of the ideal picture, the depth of one pixel of the real one.

    Args:
        depth: (h, w) float32 mm.
        source: (H, W) int32, row * w + column in `depth`; -1 where there is none.
        out: (H, W) float32 mm, written; 0 where source is -1.
    """
    stored = depth.ravel()
    for row in range(out.shape[0]):
        for column in range(out.shape[1]):
            k = source[row, column]
            out[row, column] = stored[k] if k >= 0 else np.float32(0.0)


@njit(cache=True, nogil=True, fastmath=_FAST, error_model="numpy")
def lift_row(depth, law, u, v, deep):
    """New pixels and depths of the readings of one row, moved to where they truly are under water.

    Where k z > 1 the ray meets the surface, and the depth d below it solves

        a d^2 + (b - c z) d = k z - 1,

    in the form of the quadratic formula that does not cancel.

    Args:
        depth: (W,) float32 mm, as the camera reported it.
        law: (13, W) float32, see `rectify.pixel_laws`.
        u: (W,) int32, written: new column, px.
        v: (W,) int32, written: new row, px.
        deep: (W,) float32, written: new depth, mm.
    """
    for column in range(depth.size):
        along = law[3, column] * depth[column]  # 1 where the ray meets the water
        wet = max(along - _ONE, np.float32(0.0))
        b = law[1, column] - law[2, column] * depth[column]
        below = (wet + wet) / (b + np.sqrt(b * b + _FOUR * law[0, column] * wet))
        dry = min(along, _ONE)
        z = law[12, column] + dry * law[6, column] + below * law[9, column]
        deep[column] = z
        u[column] = int(
            np.floor((law[10, column] + dry * law[4, column] + below * law[7, column]) / z + _HALF)
        )
        v[column] = int(
            np.floor((law[11, column] + dry * law[5, column] + below * law[8, column]) / z + _HALF)
        )


@njit(cache=True, nogil=True)
def lift(depth, laws, out):
    """Splat every pixel of a depth picture to its true position, the nearest on top.

    A pixel without reading moves like the reading before it in its row, and leaves `UNREAD`.

    Args:
        depth: (H, W) float32 mm, 0 where unread.
        laws: (H, 13, W) float32, see `rectify.pixel_laws`.
        out: (H, W) float32 mm, written; infinite where nothing went.
    """
    n_rows, n_columns = depth.shape
    u = np.empty(n_columns, np.int32)
    v = np.empty(n_columns, np.int32)
    deep = np.empty(n_columns, np.float32)
    out[:] = np.inf
    for row in range(n_rows):
        lift_row(depth[row], laws[row], u, v, deep)
        right = 0
        down = 0
        for column in range(n_columns):
            z = deep[column]
            if depth[row, column] > 0:
                right = u[column] - column
                down = v[column] - row
            else:
                z = UNREAD
            i = row + down
            j = column + right
            if 0 <= i < n_rows and 0 <= j < n_columns and z < out[i, j]:
                out[i, j] = z


@njit(cache=True, nogil=True)
def close(lifted, out):
    """Fill what lies between two readings with the farther one.

    The two lie side by side or one above the other.

    Only where nothing went: a pixel that was unread stays so. The farther, so that no outline
    grows.

    Args:
        lifted: (H, W) float32 mm, `UNREAD` where unread, infinite where nothing went.
        out: (H, W) float32 mm, written; 0 where unread.
    """
    n_rows, n_columns = lifted.shape
    for row in range(n_rows):
        for column in range(n_columns):
            z = lifted[row, column]
            if z >= UNREAD:
                nothing_went = z > UNREAD
                z = np.float32(0.0)
                if nothing_went and 0 < column < n_columns - 1:
                    z = _between(lifted[row, column - 1], lifted[row, column + 1])
                if nothing_went and z == 0 and 0 < row < n_rows - 1:
                    z = _between(lifted[row - 1, column], lifted[row + 1, column])
            out[row, column] = z


@njit(cache=True, nogil=True)
def _between(one, other):
    """The farther of two readings, mm; 0 unless both are readings."""
    return max(one, other) if one < UNREAD and other < UNREAD else np.float32(0.0)
