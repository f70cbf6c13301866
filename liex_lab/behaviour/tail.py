"""The tail's beat: where the tail turns back, how often in a second, and how far it swings."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from liex_lab.behaviour.posture import Shape
from liex_lab.tables.rows import stretches

Array = NDArray[np.float64]

SLOWEST_HZ = 1.0  # a slower swing to and fro is a turn of the body and no beat
TRUSTED_SHARE = (
    0.25  # of the frame rate: a faster beat may be another one seen through the camera's shutter
)
_LEAST_SHARE = 0.05  # of the body's length: a smaller swing is none
_LEAST_SD = 2.0  # nor is one of fewer standard deviations


@dataclass(frozen=True)
class TailBeat:
    """Per frame (n,): the tail's angle where it turns back, else NaN; frequency and amplitude of
    the swing it is in.

    amplitude_mm is half the way of the rear end from one side to the other.
    """

    extreme_rad: Array
    frequency_hz: Array
    amplitude_mm: Array


def tail_beat(shape: Shape, time_s: Array, number: NDArray[np.int64], step_s: float) -> TailBeat:
    """The beat within each unbroken stretch `number` (n,); step_s: the usual time from frame to
    frame.

    A swing lasts from one turning point to the next; frequency = 1 / (2 x its time). Slower than
    `SLOWEST_HZ` it is left empty, and so are one faster than a quarter of the frame rate and its
    neighbours, for bends may be missing.
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
    for start, stop, key in stretches(np.where(known, number, -1)):
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
    """Places where values (n,) turn back by `least` or more, after having come by as much."""
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
    """Times of turning points `rows`, from the parabola through each and its two neighbours in
    [start, stop).
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
