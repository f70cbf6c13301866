"""Occupancy of the floor: time per cell, spread by a Gaussian kernel (kernel density estimate).

    T(cell) = sum over frames of hold_i * K_sd(cell - place_i)

Every frame counts for as long as it holds (until the next one), and what the kernel carries over
the grid's edge is reflected, so the cells add up to the observed time.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from liex_lab.tables.rows import stop_times

Array = NDArray[np.float64]
CELL_MM = 5.0
SD_MM = 10.0  # of the kernel: about half a mouse's width
_MOST_CELLS = 400  # along a side; of larger floors the cells are larger


@dataclass(frozen=True)
class Occupancy:
    """Time spent in each cell of the floor.

    Attributes:
        time_s: (ny, nx) time in each cell, s; row 0 has the smallest y.
        x_mm: (nx + 1,) edges of the columns, mm, arena frame.
        y_mm: (ny + 1,) edges of the rows, mm, arena frame.
        n: number of frames with a place.
    """

    time_s: Array
    x_mm: Array
    y_mm: Array
    n: int

    @property
    def observed_s(self) -> float:
        """The time in all cells, s."""
        return float(self.time_s.sum())

    @property
    def per_cm2(self) -> Array:
        """(ny, nx) time per area, s/cm²."""
        area = np.outer(np.diff(self.y_mm), np.diff(self.x_mm)) / 100.0
        return np.asarray(self.time_s / area)


def hold_times(time_s: ArrayLike) -> Array:
    """(n,) how long each frame counts, s: until the next one, the last one as long as usual.

    Args:
        time_s: (n,) times of the frames, s.
    """
    time = np.asarray(time_s, float)
    return np.asarray(stop_times(time) - time)


def occupancy(
    xy_mm: ArrayLike, hold_s: ArrayLike, low_mm: ArrayLike, high_mm: ArrayLike, sd_mm: float = SD_MM
) -> Occupancy:
    """Time spent in each cell of a rectangle of the floor.

    Args:
        xy_mm: (n, 2) places, mm, arena frame; a row with NaN does not count.
        hold_s: (n,) how long each counts, s.
        low_mm: (2,) the rectangle's smallest x and y, mm; it is widened where a place lies outside.
        high_mm: (2,) its largest.
        sd_mm: standard deviation of the kernel, mm; 0 for plain counting.
    """
    from scipy.ndimage import gaussian_filter

    xy = np.asarray(xy_mm, float)
    known = np.isfinite(xy).all(axis=1)
    xy = xy[known]
    hold = np.asarray(hold_s, float)[known]
    low = np.min([np.asarray(low_mm, float), *([xy.min(axis=0)] if len(xy) else [])], axis=0)
    high = np.max([np.asarray(high_mm, float), *([xy.max(axis=0)] if len(xy) else [])], axis=0)
    cell = max(CELL_MM, float((high - low).max()) / _MOST_CELLS)
    edges = [
        a + cell * np.arange(max(int(np.ceil((b - a) / cell)), 1) + 1)
        for a, b in zip(low, high, strict=True)
    ]
    counted, _, _ = np.histogram2d(xy[:, 1], xy[:, 0], [edges[1], edges[0]], weights=hold)
    if sd_mm > 0:
        counted = gaussian_filter(counted, sd_mm / cell, mode="reflect")
    return Occupancy(np.asarray(counted, float), edges[0], edges[1], len(xy))
