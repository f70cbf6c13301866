"""Posture of a chain of joints per frame: heading, pitch, length, bend and midline curvature.

Heading = atan2(dy, dx) and pitch = atan2(dz, hypot(dx, dy)) of the body's axis; the bend is the sum
of the signed turning angles at the inner joints (total curvature of the discrete midline). It is
measured in the animal's own frontal plane: the one through its axis and the horizontal, as if it
did not roll. Positive bends are towards the animal's left. What "the bend of a body" is differs
between publications by a factor of two and more; here it is the whole turn from the direction of
the front bone to that of the rear one.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from liex_lab.behaviour.body import SWIMS, BodyAxis
from liex_lab.runtime.memory import Allocator, blocks
from liex_lab.tables.rows import constant_runs

Array = NDArray[np.float64]

_BLOCK = 16_384  # frames that are filled at a time


@dataclass(frozen=True)
class Posture:
    """A body in n frames, by its K midline joints from front to rear; arena frame.

    Attributes:
        body: which joint plays which part.
        spine: (n, K, 3) joints from front to rear, mm.
        spine_sd: (n, K) their standard deviation along an axis, mm.
        centre: (n, 3) centre of the body, mm.
        centre_sd: (n,) its standard deviation along an axis, mm.
        axis: (n, 3) the vector whose direction is the heading, mm.
        axis_sd: (n,) standard deviation of the difference of the axis' two ends, mm.
    """

    body: BodyAxis
    spine: Array
    spine_sd: Array
    centre: Array
    centre_sd: Array
    axis: Array
    axis_sd: Array

    @staticmethod
    def of(body: BodyAxis, xyz: Array, sd: Array) -> Posture:
        """The posture from all joints; errors of the joints of one frame count as one common error.

        Args:
            body: which joint plays which part.
            xyz: (n, J, 3) joints in the arena frame, mm.
            sd: (n, J) their standard deviation along an axis, mm.
        """
        spine, trunk, (start, stop) = list(body.spine), list(body.trunk), body.axis
        return Posture(
            body,
            xyz[:, spine],
            sd[:, spine],
            xyz[:, trunk].mean(axis=1),
            sd[:, trunk].mean(axis=1),
            xyz[:, stop] - xyz[:, start],
            np.hypot(sd[:, start], sd[:, stop]),
        )

    @cached_property
    def pitch_rad(self) -> Array:
        """(n,) angle of the axis above the floor, rad; positive nose up."""
        return np.asarray(np.arctan2(self.axis[:, 2], self._reach))

    @cached_property
    def pitch_sd_rad(self) -> Array:
        """(n,) standard deviation of the pitch, rad."""
        return self.axis_sd / _positive(np.linalg.norm(self.axis, axis=1))

    @cached_property
    def heading_rad(self) -> Array:
        """(n,) direction of the axis on the floor, rad, counter-clockwise from x, from above."""
        return np.asarray(np.arctan2(self.axis[:, 1], self.axis[:, 0]))

    @cached_property
    def heading_sd_rad(self) -> Array:
        """(n,) standard deviation of the heading, rad, at most pi / sqrt(3).

        That is the standard deviation of a direction that is not known at all (uniform on the
        circle).
        """
        return np.asarray(np.minimum(self.axis_sd / _positive(self._reach), np.pi / np.sqrt(3.0)))

    @cached_property
    def length_mm(self) -> Array:
        """(n,) length of the chain, all bones added up, mm."""
        return np.asarray(self._bone_mm.sum(axis=1))

    @cached_property
    def straightness(self) -> Array:
        """(n,) distance of the chain's ends over its length: 1 is straight."""
        return np.linalg.norm(self.spine[:, 0] - self.spine[:, -1], axis=1) / _positive(
            self.length_mm
        )

    @cached_property
    def turns_rad(self) -> Array:
        """(n, K - 2) turn at each inner joint, front to rear, rad; positive to the left."""
        bones = np.diff(self.spine, axis=1)
        a = bones[:, :-1]
        b = bones[:, 1:]
        # the bones point backwards: a chain whose tail is on its left turns clockwise from front to
        # rear
        across = -np.einsum("nki,ni->nk", np.cross(a, b), self._dorsal)
        return np.asarray(np.arctan2(across, np.einsum("nki,nki->nk", a, b)))

    @cached_property
    def bend_rad(self) -> Array:
        """(n,) whole turn from the front bone to the rear one, rad; NaN of fewer than 3 joints."""
        return (
            np.asarray(self.turns_rad.sum(axis=1))
            if self.spine.shape[1] > 2
            else np.full(len(self.spine), np.nan)
        )

    @cached_property
    def rear_sd_mm(self) -> Array:
        """(n,) standard deviation of the chain's rear end along an axis, mm."""
        return self.spine_sd[:, -1]

    def thirds_rad(self) -> tuple[Array, Array, Array]:
        """(n,) each: turn of the chain's front, middle, rear third, rad; positive to the left."""
        inner = self.turns_rad.shape[1]
        third = 3 * np.arange(1, inner + 1) // (inner + 1)
        front, middle, rear = (self.turns_rad[:, third == k].sum(axis=1) for k in range(3))
        return front, middle, rear

    @cached_property
    def tail_mm(self) -> Array:
        """(n,) distance of the chain's rear end from the axis' line, mm; positive to the left."""
        return np.asarray(np.einsum("ni,ni->n", self.spine[:, -1] - self.spine[:, 0], self._left))

    @cached_property
    def tail_angle_rad(self) -> Array:
        """(n,) angle at the front between the backward axis and the line to the rear end, rad.

        Positive to the animal's left.
        """
        to_rear = self.spine[:, -1] - self.spine[:, 0]
        ahead = self.axis / _positive(np.linalg.norm(self.axis, axis=1))[:, None]
        return np.asarray(np.arctan2(self.tail_mm, -np.einsum("ni,ni->n", to_rear, ahead)))

    @cached_property
    def _reach(self) -> Array:
        return np.asarray(np.hypot(self.axis[:, 0], self.axis[:, 1]))

    @cached_property
    def _bone_mm(self) -> Array:
        return np.asarray(np.linalg.norm(np.diff(self.spine, axis=1), axis=2))

    @cached_property
    def _left(self) -> Array:
        """(n, 3) unit vector to the animal's left, horizontal; NaN for a vertical axis."""
        left = np.stack([-self.axis[:, 1], self.axis[:, 0], np.zeros(len(self.axis))], axis=1)
        return left / _positive(self._reach)[:, None]

    @cached_property
    def _dorsal(self) -> Array:
        """(n, 3) unit vector out of the animal's back, in the vertical plane through its axis."""
        ahead = self.axis / _positive(np.linalg.norm(self.axis, axis=1))[:, None]
        return np.asarray(np.cross(ahead, self._left))


@dataclass(frozen=True)
class Shape:
    """The measures of a posture in each of n frames, as columns; see `Posture` for their meaning.

    Of a body that does not swim the last four are empty (NaN).

    Attributes:
        centre: (n, 3) mm, arena frame.
        centre_sd: (n,) mm.
        pitch_rad: (n,) rad.
        pitch_sd_rad: (n,) rad.
        heading_rad: (n,) rad.
        heading_sd_rad: (n,) rad.
        length_mm: (n,) mm.
        straightness: (n,) from 0 to 1.
        bend_rad: (n,) rad.
        thirds_rad: (n, 3) turns of the front, middle and rear third, rad.
        tail_mm: (n,) mm.
        tail_angle_rad: (n,) rad.
        rear_sd_mm: (n,) standard deviation of the chain's rear end, mm.
    """

    centre: Array
    centre_sd: Array
    pitch_rad: Array
    pitch_sd_rad: Array
    heading_rad: Array
    heading_sd_rad: Array
    length_mm: Array
    straightness: Array
    bend_rad: Array
    thirds_rad: Array
    tail_mm: Array
    tail_angle_rad: Array
    rear_sd_mm: Array

    @staticmethod
    def empty(n: int, allocate: Allocator = np.empty) -> Shape:
        """Columns for n frames, filled with NaN.

        Args:
            n: number of frames.
            allocate: makes the arrays of the columns (an allocator, as `np.empty`).
        """
        more = {"centre": (n, 3), "thirds_rad": (n, 3)}
        shape = Shape(*(allocate(more.get(one.name, (n,)), float) for one in fields(Shape)))
        for rows in blocks(n, _BLOCK):
            for column in vars(shape).values():
                column[rows] = np.nan
        return shape

    def put(self, rows: slice, posture: Posture) -> None:
        """Write the measures of a posture into some frames.

        Args:
            rows: the m frames.
            posture: the posture of these m frames.
        """
        told = [one.name for one in fields(Shape)]
        for name in told[: None if posture.body.kind == SWIMS else -4]:
            if name == "thirds_rad":
                self.thirds_rad[rows] = np.stack(posture.thirds_rad(), axis=1)
            else:
                getattr(self, name)[rows] = getattr(posture, name)


def _positive(values: Array) -> Array:
    """Values to divide by; NaN instead of 0."""
    return np.where(values > 1e-9, values, np.nan)


# Tail-beat analysis of a swimming animal: turning points of the swing, frequency and amplitude.


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
