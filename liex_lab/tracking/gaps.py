"""Gaps between measured frames, in seconds, and runs of frames."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def short_gaps(
    seconds: Array, measured: NDArray[np.bool_], bridge_s: float, ahead: bool = False
) -> NDArray[np.bool_]:
    """Mask (n,) of the unmeasured frames that are bridged.

    A frame between two measured ones is bridged where the nearer of them is no farther than half of
    bridge_s, so a gap no longer than bridge_s is bridged whole.

    Args:
        seconds: (n,) s, increasing.
        measured: (n,) True where the pose was measured.
        bridge_s: the longest gap that is bridged whole, s.
        ahead: also bridge the frames within bridge_s after the last measured one.

    Returns:
        (n,) bool, False at measured frames.
    """
    rows = np.flatnonzero(measured)
    if not len(rows):
        return np.zeros(len(measured), np.bool_)
    t = np.arange(len(measured))
    after = np.searchsorted(rows, t)
    inside = (after > 0) & (after < len(rows))
    before = rows[np.maximum(after - 1, 0)]
    after = rows[np.minimum(after, len(rows) - 1)]
    away = np.minimum(seconds - seconds[before], seconds[after] - seconds)
    short = inside & (away <= 0.5 * bridge_s)
    if ahead:
        short[rows[-1] + 1 :] = seconds[rows[-1] + 1 :] - seconds[rows[-1]] <= bridge_s
    return short & ~measured


def whole_gaps(seconds: Array, measured: NDArray[np.bool_], bridge_s: float) -> NDArray[np.bool_]:
    """Mask (n,) of the unmeasured frames in gaps no longer than bridge_s.

    Args:
        seconds: (n,) s, increasing.
        measured: (n,) True where the pose was measured.
        bridge_s: the longest gap, s.

    Returns:
        (n,) bool, False at measured frames, and before the first and after the last of them.
    """
    rows = np.flatnonzero(measured)
    out = np.zeros(len(measured), np.bool_)
    for before, after in pairwise(rows):
        out[before + 1 : after] = seconds[after] - seconds[before] <= bridge_s
    return out


def spans(where: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """The runs of True in a mask, as (start, stop) with stop exclusive.

    Args:
        where: (n,) bool.

    Returns:
        One pair of indices for each run, in order.
    """
    edges = np.flatnonzero(np.diff(np.concatenate([[False], where, [False]]).astype(np.int8)))
    return [(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)]
