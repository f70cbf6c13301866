"""Numba kernels that hold a posed body against a height map: what it leaves unexplained, and where
it should not be.

The body is a heap of balls (`body.spheres.Balls`). METHOD lesson 4: such numbers, beside the
features of the learned metric, tell good candidates from bad ones.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import njit, prange

N_FIT = 8
# of the fit: see `explain`
BESIDE = 0
OUT_OF = 2
APART = 4
# thresholds are integers
SHARE_UNIT = 1000.0
MM_UNIT = 50.0
_MOST_MM = (
    30.0  # in tenths of the balls' usual radius, as the next two: farther off is simply wrong
)
_HIDDEN_MM = 12.0
_APART_MM = 8.0
_STRIDE = 6  # every so many crop pixels a reading is looked at


class Body(NamedTuple):
    """The body that poses are held against the picture with, see `body.spheres.Balls`; none: no
    balls.
    """

    unit_mm: float
    n_own: int
    joints: Any
    offsets: Any
    share: Any
    radius: Any


@njit(cache=True)
def place_balls(rotations, positions, scale, body, out):
    """Middles (B, 3) mm of the balls of one pose: rotations (J, 3, 3), positions (J, 3)."""
    for b in range(len(body.joints)):
        share = body.share[b]
        one = body.joints[b, 0]
        other = body.joints[b, 1]
        for i in range(3):
            first = positions[one, i]
            second = positions[other, i]
            for k in range(3):
                first += scale * rotations[one, i, k] * body.offsets[b, 0, k]
                second += scale * rotations[other, i, k] * body.offsets[b, 1, k]
            out[b, i] = first + share * (second - first)


@njit(cache=True, fastmath={"nnan", "nsz"})
def nearest_ball(x, y, z, balls, radius, gaps):
    """Signed distance mm of a point from the surface of the nearest of the balls (B, 3), and which
    that is.

    gaps (B,) is scratch: the distances of all, then their least, then which it is, for each of
    these three runs in vector registers, while one loop that keeps the least waits for a root with
    every ball.
    """
    for b in range(len(balls)):
        off2 = (x - balls[b, 0]) ** 2 + (y - balls[b, 1]) ** 2 + (z - balls[b, 2]) ** 2
        gaps[b] = np.sqrt(off2) - radius[b]
    best = gaps[0]
    for b in range(len(balls)):
        best = gaps[b] if gaps[b] < best else best
    which = 0
    last = len(balls) - 1
    while which < last and gaps[which] != best:
        which += 1
    return best, which


@njit(cache=True)
def explain(heights, look, balls, radius, n_own, size, unit_mm, out):
    """Fill `out` (N_FIT,) for balls (B, 3) mm of radius (B,) mm in the view frame of a height map,
    n_own of the body.

    size: of the animal over home size; unit_mm: as in `Balls`. Of the balls: share beside the
    animal, mean distance of their fronts from the readings, mean by which they stick out of them,
    share hidden behind them; of the readings: mean distance from the nearest ball, share far from
    any, mean of the distances within balls.
    """
    n = n_own
    per_mm = 1.0 / (size * unit_mm)
    beside = 0.0
    off = 0.0
    out_of = 0.0
    hidden = 0.0
    last = heights.shape[0] - 1
    for b in range(n):
        x0 = balls[b, 0]
        y0 = balls[b, 1]
        z0 = balls[b, 2] - look[13]
        x = look[4] * x0 + look[7] * y0 + look[10] * z0
        y = look[5] * x0 + look[8] * y0 + look[11] * z0
        z = max(look[6] * x0 + look[9] * y0 + look[12] * z0, 1.0)
        column = int((look[0] * x / z + look[2] - look[14]) / look[16] + 0.5)
        row = int((look[1] * y / z + look[3] - look[15]) / look[16] + 0.5)
        here = heights[min(max(row, 0), last), min(max(column, 0), last)]
        if here == 0:
            beside += 1.0
            continue
        above = (here / 16.0 - balls[b, 2] - radius[b]) * per_mm
        off += min(abs(above), _MOST_MM)
        out_of += min(max(-above, 0.0), _MOST_MM)
        hidden += above > _HIDDEN_MM
    seen = max(n - beside, 1.0)
    out[0] = SHARE_UNIT * beside / n
    out[1] = MM_UNIT * off / seen
    out[2] = MM_UNIT * out_of / seen
    out[3] = SHARE_UNIT * hidden / n
    n_read = 0
    far = 0.0
    apart = 0.0
    within = 0.0
    gaps = np.empty(len(balls))
    for r in range(_STRIDE // 2, last + 1, _STRIDE):
        for c in range(_STRIDE // 2, last + 1, _STRIDE):
            if heights[r, c] == 0:
                continue
            # the point of the view frame that this pixel shows
            dx = (look[14] + look[16] * c - look[2]) / look[0]
            dy = (look[15] + look[16] * r - look[3]) / look[1]
            z = (heights[r, c] / 16.0 - look[13]) / (look[10] * dx + look[11] * dy + look[12])
            px = z * (look[4] * dx + look[5] * dy + look[6])
            py = z * (look[7] * dx + look[8] * dy + look[9])
            pz = heights[r, c] / 16.0
            nearest, which = nearest_ball(px, py, pz, balls, radius, gaps)
            if which >= n_own:
                continue
            nearest *= per_mm
            n_read += 1
            far += nearest > _APART_MM
            apart += min(max(nearest, 0.0), _MOST_MM)
            within += min(max(-nearest, 0.0), _MOST_MM)
    many = max(n_read, 1)
    out[4] = MM_UNIT * apart / many
    out[5] = SHARE_UNIT * far / many
    out[6] = MM_UNIT * within / many


@njit(cache=True)
def explain_pose(heights, look, axis, rotations, positions, scale, size, body, out):
    """`explain` for one pose. axis rad: of the animal's long axis, against which the last number
    holds the base's x axis.
    """
    balls = np.empty((len(body.joints), 3))
    place_balls(rotations, positions, scale, body, balls)
    explain(heights, look, balls, body.radius * scale, body.n_own, size, body.unit_mm, out)
    out[7] = SHARE_UNIT * (np.cos(axis) * rotations[0, 0, 0] + np.sin(axis) * rotations[0, 1, 0])


@njit(cache=True, parallel=True)
def explain_all(heights, looks, moments, image, rotations, positions, scale, size, body, out):
    """`explain_pose` for a batch of n poses on some of the images (n,); out (n, N_FIT)."""
    for s in prange(len(image)):
        i = image[s]
        explain_pose(
            heights[i],
            looks[i],
            moments[i, 5],
            rotations[s],
            positions[s],
            scale[s],
            size[s],
            body,
            out[s],
        )
