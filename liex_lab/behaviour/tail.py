"""Tail-beat analysis of a swimming animal: turning points of the swing, frequency and amplitude.

Turning points are those of a peak detector with hysteresis (a reversal of at least 5 % of the
length and 2 sd); their times are refined by the parabola through three samples. A swing lasts from
one turning point to the next: frequency = 1 / (2 x its time), amplitude = half the distance between
the two extremes. Bends and beats are counted as in ZebraZoom (Mirat et al. 2013).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from liex_lab.behaviour.posture import Shape
from liex_lab.tables.rows import constant_runs

Array = NDArray[np.float64]

SLOWEST_HZ = 1.0  # a slower swing to and fro is a turn of the body and no beat
# of the frame rate: a faster beat may be another one seen through the camera's shutter
TRUSTED_SHARE = 0.25
_LEAST_SHARE = 0.05  # of the body's length: a smaller swing is none
_LEAST_SD = 2.0  # nor is one of fewer standard deviations


@dataclass(frozen=True)
class TailBeat:
    """The tail's beat in each of n frames.

    Attributes:
        extreme_rad: (n,) the tail's angle where it turns back, rad; NaN in all other frames.
        frequency_hz: (n,) frequency of the swing that the frame is in, Hz; NaN at rest.
        amplitude_mm: (n,) half the path of the rear end from one side to the other, mm; NaN at
            rest.
    """

    extreme_rad: Array
    frequency_hz: Array
    amplitude_mm: Array


def tail_beat(shape: Shape, time_s: Array, number: NDArray[np.int64], step_s: float) -> TailBeat:
    """Frequency and amplitude of the tail's beat within each unbroken stretch.

    A swing lasts from one turning point to the next; frequency = 1 / (2 x its time). A swing slower
    than `SLOWEST_HZ` is left empty, and so are one faster than a quarter of the frame rate
    (`TRUSTED_SHARE`) and its neighbours, for bends may be missing.

    Args:
        shape: the posture of n frames of a body that swims.
        time_s: (n,) times of the frames, s.
        number: (n,) unbroken stretch of each frame, see `segments`.
        step_s: the usual time from frame to frame, s; 0 gives an empty beat.
    """
    swing = shape.tail_mm
    angle = shape.tail_angle_rad
    out = TailBeat(*(np.full(len(swing), np.nan) for _ in range(3)))
    known = np.isfinite(swing)
    if step_s <= 0 or not known.any():
        return out
    noise = np.hypot(shape.rear_sd_mm, shape.length_mm * shape.heading_sd_rad)[known]
    typical = float(np.nanmedian(noise)) if np.isfinite(noise).any() else 0.0
    least = max(_LEAST_SHARE * float(np.median(shape.length_mm[known])), _LEAST_SD * typical)
    slowest_s = 0.5 / SLOWEST_HZ
    for start, stop, key in constant_runs(np.where(known, number, -1)):
        if key < 0:
            continue
        rows = start + turning_points(swing[start:stop], least)
        if len(rows) < 2:
            continue
        gap = np.diff(time_s[rows])
        near = np.minimum(np.append(np.inf, gap), np.append(gap, np.inf)) < slowest_s
        rows = rows[near]  # a lone turning point lies in the rest between two bouts of swimming
        out.extreme_rad[rows] = angle[rows]
        at = vertex_times(time_s, swing, rows, start, stop)
        frequency = 0.5 / np.maximum(np.diff(at), 1e-9)
        fast = np.pad(frequency > TRUSTED_SHARE / step_s, 1)
        good = (frequency >= SLOWEST_HZ) & ~(fast[1:-1] | fast[:-2] | fast[2:])
        for k in np.flatnonzero(good):
            out.frequency_hz[rows[k] : rows[k + 1]] = frequency[k]
            out.amplitude_mm[rows[k] : rows[k + 1]] = 0.5 * abs(swing[rows[k + 1]] - swing[rows[k]])
    return out


def turning_points(values: Array, least: float) -> NDArray[np.int64]:
    """Rows where a series turns back by `least` or more, after having come by as much.

    A peak detector with hysteresis: highs and lows alternate. The first one counts only if the
    series came by `least` before it.

    Args:
        values: (n,) the series, without NaN.
        least: smallest reversal that counts, in the unit of `values`.

    Returns:
        (k,) int64 rows, in order.
    """
    found: list[int] = []
    low = high = 0
    rising: bool | None = None
    for k, value in enumerate(values.tolist()):
        high = k if value > values[high] else high
        low = k if value < values[low] else low
        if rising is not False and values[high] - value >= least:
            found.append(high)
            rising = False
            low = k
        elif rising is not True and value - values[low] >= least:
            found.append(low)
            rising = True
            high = k
    if (
        found and np.ptp(values[: found[0] + 1]) < least
    ):  # only where the tail lay before it began to swing
        found = found[1:]
    return np.array(found, np.int64)


def vertex_times(
    time_s: Array, values: Array, rows: NDArray[np.int64], start: int, stop: int
) -> Array:
    """Times of turning points, from the parabola through each and its two neighbours.

    Args:
        time_s: (n,) times of the frames, s.
        values: (n,) the series that turns.
        rows: (k,) int64 rows of the turning points.
        start: first row of the stretch.
        stop: row after the last of the stretch; a point at either end keeps its frame's time.

    Returns:
        (k,) s, each between the times of its point's neighbours.
    """
    inner = rows[(rows > start) & (rows < stop - 1)]
    at = time_s[rows].copy()
    t0 = time_s[inner - 1]
    t1 = time_s[inner]
    t2 = time_s[inner + 1]
    left = (values[inner] - values[inner - 1]) / (t1 - t0)
    right = (values[inner + 1] - values[inner]) / (t2 - t1)
    with np.errstate(divide="ignore", invalid="ignore"):
        vertex = (t0 + t1) / 2.0 - left * (t2 - t0) / (2.0 * (right - left))
    at[np.isin(rows, inner)] = np.where(np.isfinite(vertex), np.clip(vertex, t0, t2), t1)
    return at
