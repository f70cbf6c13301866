"""Kernel of the hand score: how unlike a hand a part of a surface is.

A weighted sum of the squared logarithm of its area over that of a home-sized hand, its share on the
picture's border, the width of what goes on behind the cut, and the logarithm of circumference^2 /
area, which fingers make large. Logistic regression chose the weights, on rendered hands against
elbows, chests and heads.

blocks and labels are those of `_geodesic_kernels`.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import njit

from liex_lab.foreground._blob_kernels import BLOCK
from liex_lab.foreground._geodesic_kernels import AROUND_MM, relabel

# what tells rendered hands from elbows, chests and heads by logistic regression, in units of the
# first: the logarithm of circumference^2 over area, which fingers make large
_AREA_LOG_MM2 = 9.55  # of a home-sized hand
_PER_AREA = 0.55  # what the square of the difference counts
_PER_BORDER = 0.6  # the share that lies along the border of the picture
# how wide it goes on behind the cut
_WRIST_MM = 50.0
_WIDE_MM = 100.0
_PER_WIDTH = 0.25
_MOST_WIDTHS = 4.0
_MARGIN = 2  # blocks
_ACROSS = ((-1, 0), (1, 0), (0, -1), (0, 1))


class HandFind(NamedTuple):
    """Where a hand is, camera frame.

    Attributes:
        middle: (3,) mm.
        fingers: (3,) direction of the fingers, 0 without an arm.
        cut: where along `fingers` the arm is cut, mm from the camera.
        area_mm2: area of what lies beyond the cut, mm^2.
    """

    middle: Any
    fingers: Any
    cut: Any
    area_mm2: Any


@njit(cache=True)
def unlikeness(blocks, labels, surface, mark, found, size, intrinsics):
    """Mean depth of the blocks labelled `mark`, and how unlike a hand they are.

    Args:
        blocks: (h, w) float32 mm.
        labels: (h, w) int32; the blocks get the label of their surface back.
        surface: the `Surface` that they are of.
        mark: the label of the blocks.
        found: `HandFind` of the hand.
        size: the hand's length over the skeleton's home length.
        intrinsics: (4,) fx, fy, cx, cy px.

    Returns:
        The mean depth, mm, and the score: the less, the more alike.
    """
    n_rows, n_columns = labels.shape
    focal = np.sqrt(intrinsics[0] * intrinsics[1])
    area = 0.0
    around = 0.0
    behind = 0.0
    on_border = 0
    n = 0
    depth = 0.0
    cells = surface.cells
    for k in range(len(cells)):
        i = cells[k, 0]
        j = cells[k, 1]
        side = _side(blocks[i, j], focal)
        if labels[i, j] != mark:
            behind += side * side * _behind_cut(surface.points[k], found, size)
            continue
        area += side * side
        depth += blocks[i, j]
        n += 1
        on_border += min(i, j, n_rows - 1 - i, n_columns - 1 - j) < _MARGIN
        for a, b in _ACROSS:
            r = i + a
            c = j + b
            inside = 0 <= r < n_rows and 0 <= c < n_columns
            if not inside or (labels[r, c] != mark and labels[r, c] != surface.slot):
                around += side
    relabel(labels, surface)
    area = max(area, 1.0)
    n = max(n, 1)
    width = min(behind / (_WRIST_MM * _WIDE_MM * size * size), _MOST_WIDTHS)
    unlike = _PER_AREA * (np.log(area / (size * size)) - _AREA_LOG_MM2) ** 2
    return depth / n, unlike + _PER_BORDER * on_border / n + _PER_WIDTH * width - np.log(
        max(around, 1.0) ** 2 / area
    )


@njit(cache=True)
def _side(depth, focal):
    """The side of a block, mm, at this depth."""
    return BLOCK * depth / focal


@njit(cache=True)
def _behind_cut(point, found, size):
    """Whether a point (3,) lies close behind the cut through the arm."""
    x = point[0]
    y = point[1]
    z = point[2]
    fingers = found.fingers
    middle = found.middle
    along = x * fingers[0] + y * fingers[1] + z * fingers[2] - found.cut
    off = (x - middle[0]) ** 2 + (y - middle[1]) ** 2 + (z - middle[2]) ** 2
    return -_WRIST_MM * size < along <= 0.0 and off < (1.4 * AROUND_MM * size) ** 2
