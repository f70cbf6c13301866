"""Egocentric kinematic features of a track on a fixed clock, in seconds and body lengths.

A track of any frame rate becomes channels of one rate, so that a recogniser gets the same features
from any camera: a faster camera is averaged over each tick, a slower one interpolated linearly.
Channels: velocity along and across the heading and upwards, speed, yaw rate, pitch of the trunk
(`climb`), straightness, length, bends and pitches of three parts of the chain and their rates,
speed of deformation (`twist`), height above the floor, nearness of a wall, predicted error. Rates
are central differences of values smoothed by the binomial filter (1/4, 1/2, 1/4).

Frames whose trunk points against those within 0.15 s to either side are left out (head and tail
were exchanged). Gaps up to 0.4 s are bridged; longer ones split the track into segments.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from liex_lab.actions.ethogram import LONGEST_GAP_S
from liex_lab.arrays import Array, NDArray
from liex_lab.body.skeleton import VIEWS, Skeleton
from liex_lab.runtime.memory import Allocator, blocks
from liex_lab.tracking.track import Track

_FLIP_S = 0.15  # to either side: a body that briefly points the other way is an error
_GROUPS = 3  # parts of the chain whose bends are summed
_PIECE = 4096  # ticks per block


@dataclass(frozen=True)
class Segment:
    """Channels on a fixed clock, from one unbroken segment of a track.

    Attributes:
        times_s: (m,) s since the track's first frame.
        values: (m, C) channels, see `channel_names`.
    """

    times_s: Array
    values: Array


def channel_names(skeleton: Skeleton) -> list[str]:
    """The names of the channels; those that end in ~ change sign under reflection.

    Pitches exist only for joints with a pitch axis, heights only for animals that stand on the
    floor.

    Returns:
        C names, the columns of `segments_of`'s values.
    """
    pitches = [f"pitch_{k}" for k in range(_GROUPS)] if skeleton.axes[1:, 1].any() else []
    floor = (
        ["tip_height", "middle_height", "base_height", "tip_over_base"] if _stands(skeleton) else []
    )
    return [
        "forward",
        "sideways~",
        "upward",
        "speed",
        "yaw_rate~",
        "climb",
        "climb_rate",
        "straightness",
        "length",
        *(f"bend_{k}~" for k in range(_GROUPS)),
        *(f"bend_rate_{k}~" for k in range(_GROUPS)),
        *pitches,
        *(f"{p}_rate" for p in pitches),
        "twist",
        *floor,
        "wall",
        "doubt",
    ]


def segments_of(
    track: Track, rate_hz: float, wall_mm: Array | None = None, allocate: Allocator = np.empty
) -> list[Segment]:
    """The channels of a track, as unbroken segments.

    Lengths are relative to the animal's median length in the track, predicted errors to their
    median: the size of errors depends on camera and animal and is unrelated to actions.

    Args:
        track: one animal's track.
        rate_hz: ticks per second.
        wall_mm: (n,) distance of the animal from the nearest wall, mm; None if unknown.
        allocate: allocator of the channels.

    Returns:
        The segments in order of time; empty if no pose was measured.
    """
    time_s = (track.times_ns - track.times_ns[:1]).astype(np.float64) * 1e-9
    good = np.flatnonzero(track.observed)
    if not len(good):
        return []
    good = good[~_reversed(track, good, time_s)]
    length_mm = float(np.median(track.scale[good])) * track.skeleton.length
    # errors are relative to the recording's median error, which depends on the camera, the
    # animal and the prediction of errors but not on actions
    usual_mm = float(np.median(np.nan_to_num(track.predicted_error_mm[good], nan=0.0))) or 1.0
    wall = np.full(len(time_s), np.nan) if wall_mm is None else wall_mm
    step = float(np.median(np.diff(time_s))) if len(time_s) > 1 else 0.0
    cuts = np.flatnonzero(np.diff(time_s[good]) > max(LONGEST_GAP_S, 2.5 * step)) + 1
    found = []
    for rows in np.split(good, cuts):
        ticks = int((time_s[rows[-1]] - time_s[rows[0]]) * rate_hz + 1e-6) + 1
        clock = time_s[rows[0]] + np.arange(max(2, ticks)) / rate_hz
        found.append(_stretch(track, rows, time_s, wall, (length_mm, usual_mm), clock, allocate))
    return found


def _stands(skeleton: Skeleton) -> bool:
    return skeleton.view.frame == VIEWS[0]


def _forward(skeleton: Skeleton) -> tuple[int, int]:
    """The joints (from, to) that define the forward direction of the trunk."""
    way = 1 if skeleton.offsets[1:, 0].sum() > 0 else -1
    # the trunk's share of the chain, for a base at the rear or front
    share = 0.75 if way > 0 else 0.4
    trunk_end = max(1, round(share * (skeleton.n_joints - 1)))
    return (0, trunk_end) if way > 0 else (trunk_end, 0)


def _reversed(track: Track, good: NDArray[np.int64], time_s: Array) -> NDArray[np.bool_]:
    """Mask of the good frames that point against those within 0.15 s: head and tail exchanged."""
    rear, front = _forward(track.skeleton)
    axis = np.empty((len(good), 3))
    total = np.zeros((len(good) + 1, 3))
    for some in blocks(len(good), _PIECE):
        axis[some] = track.joints_mm[good[some], front] - track.joints_mm[good[some], rear]
        axis[some] /= np.maximum(np.linalg.norm(axis[some], axis=1, keepdims=True), 1e-9)
    np.cumsum(axis, axis=0, out=total[1:])
    times = time_s[good]
    against = np.empty(len(good), np.bool_)
    for some in blocks(len(good), _PIECE):
        low = np.searchsorted(times, times[some] - _FLIP_S, "left")
        high = np.searchsorted(times, times[some] + _FLIP_S, "right")
        around = total[high] - total[low] - axis[some]
        against[some] = np.sum(axis[some] * around, axis=1) < -0.5 * (high - low - 1).clip(1)
    return against


class _OnClock:
    """Resamples joints, angles, wall distance and error of frames `rows` to a clock's times (m,) s.

    A faster camera is averaged over the frames of each tick, a slower one interpolated linearly;
    the ends are repeated.
    """

    def __init__(
        self, track: Track, rows: NDArray[np.int64], time_s: Array, wall: Array, clock: Array
    ) -> None:
        self._track = track
        self._rows = rows
        self._wall = wall
        times = time_s[rows]
        step = clock[1] - clock[0]
        n = len(rows)
        self._starts: NDArray[np.int64] | None = None  # first row of each tick
        if n > 2 and np.median(np.diff(times)) < 0.7 * step:
            tick = np.clip(np.round((times - clock[0]) / step).astype(int), 0, len(clock) - 1)
            starts = np.flatnonzero(np.append(True, np.diff(tick) > 0))
            self._starts = np.append(starts, n)
            times = np.add.reduceat(times, starts) / np.diff(self._starts)
        self._n = len(times)
        if self._n > 1:
            self._low = np.clip(np.searchsorted(times, clock, side="right") - 1, 0, self._n - 2)
            passed = (clock - times[self._low]) / (times[self._low + 1] - times[self._low])
            self._share = np.clip(passed, 0.0, 1.0)[:, None]

    def at(self, ticks: slice) -> tuple[Array, Array, Array, Array]:
        """The resampled measurements of some ticks.

        Args:
            ticks: consecutive ticks of the clock.

        Returns:
            Joints (m, J, 3) mm, joint angles (m, J, 3) rad, distance from a wall (m,) mm, 1e6 if
                unknown, and predicted error (m,) mm.
        """
        if self._n == 1:
            out = np.repeat(self._measured(0, 1), ticks.stop - ticks.start, axis=0)
        else:
            low = self._low[ticks]
            share = self._share[ticks]
            first = int(low[0])
            measured = self._measured(first, int(low[-1]) + 2)
            out = measured[low - first] * (1.0 - share) + measured[low - first + 1] * share
        j = self._track.skeleton.n_joints
        return (
            out[:, : 3 * j].reshape(-1, j, 3),
            out[:, 3 * j : 6 * j].reshape(-1, j, 3),
            out[:, -2],
            out[:, -1],
        )

    def _measured(self, first: int, stop: int) -> Array:
        """Columns (k, 6 J + 2) of measurements first to stop: single frames or averages over
        ticks.
        """
        starts = None if self._starts is None else self._starts[first : stop + 1]
        track = self._track
        rows = self._rows[first:stop] if starts is None else self._rows[starts[0] : starts[-1]]
        n = len(rows)
        columns = np.concatenate(
            [
                track.joints_mm[rows].reshape(n, -1),
                track.angles_rad[rows].reshape(n, -1),
                np.nan_to_num(self._wall[rows], nan=1e6)[:, None],
                np.nan_to_num(track.predicted_error_mm[rows], nan=0.0)[:, None],
            ],
            axis=1,
        )
        if starts is None:
            return columns
        return np.asarray(
            np.add.reduceat(columns, starts[:-1] - starts[0]) / np.diff(starts)[:, None]
        )


def _stretch(
    track: Track,
    rows: NDArray[np.int64],
    time_s: Array,
    wall: Array,
    units_mm: tuple[float, float],
    clock: Array,
    allocate: Allocator,
) -> Segment:
    """The channels of an unbroken segment, computed in blocks.

    units_mm: the animal's length and the median error.
    """
    resampled = _OnClock(track, rows, time_s, wall, clock)
    m = len(clock)
    heading = np.empty(m)
    steep = np.empty(m, np.bool_)
    for piece in blocks(m, _PIECE):
        heading[piece], steep[piece] = _direction(track.skeleton, resampled.at(piece)[0])
    heading = np.unwrap(heading)
    # an upright body has no heading: it keeps the last one, if there was one
    heading = heading[np.maximum.accumulate(np.where(steep, 0, np.arange(m)))]
    values = allocate((m, len(channel_names(track.skeleton))), np.float64)
    step = clock[1] - clock[0]
    for piece in blocks(m, _PIECE):
        # a channel depends on two ticks to either side
        around = slice(max(0, piece.start - 2), min(m, piece.stop + 2))
        channels = _channels(track.skeleton, units_mm, step, heading[around], *resampled.at(around))
        values[piece] = channels[piece.start - around.start : piece.stop - around.start]
    return Segment(clock, values)


def _direction(skeleton: Skeleton, joints: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Heading (m,) rad of the trunk of a body with joints (m, J, 3), and whether it is upright."""
    rear, front = _forward(skeleton)
    axis = joints[:, front] - joints[:, rear]
    upright = np.hypot(axis[:, 0], axis[:, 1]) < 0.25 * np.linalg.norm(axis, axis=1)
    return np.arctan2(axis[:, 1], axis[:, 0]), upright


def _channels(
    skeleton: Skeleton,
    units_mm: tuple[float, float],
    step: float,
    heading: Array,
    joints: Array,
    angles: Array,
    wall: Array,
    error: Array,
) -> Array:
    """Channels (m, C) on a clock whose ticks are `step` s apart.

    From headings (m,) rad, joints (m, J, 3) mm, angles (m, J, 3) rad, distances (m,) mm and
    predicted errors (m,) mm.
    """
    (rear, front), (length_mm, usual_mm) = _forward(skeleton), units_mm
    axis = joints[:, front] - joints[:, rear]
    climb = np.arctan2(axis[:, 2], np.hypot(axis[:, 0], axis[:, 1]))
    velocity = _rate(_softened(joints.mean(axis=1) / length_mm), step)
    ahead = np.cos(heading)
    aside = np.sin(heading)
    forward = velocity[:, 0] * ahead + velocity[:, 1] * aside
    sideways = velocity[:, 1] * ahead - velocity[:, 0] * aside
    bones = np.linalg.norm(np.diff(joints, axis=1), axis=2).sum(axis=1)
    straight = np.linalg.norm(joints[:, -1] - joints[:, 0], axis=1) / np.maximum(bones, 1e-9)
    groups = np.array_split(np.arange(1, skeleton.n_joints - 1), _GROUPS)
    bend = np.stack([angles[:, group, 2].sum(axis=1) for group in groups], axis=1)
    columns = [
        forward,
        sideways,
        velocity[:, 2],
        np.linalg.norm(velocity, axis=1),
        _rate(_softened(heading), step),
        climb,
        _rate(_softened(climb), step),
        straight,
        bones / length_mm - 1.0,
        bend,
        _rate(_softened(bend), step),
    ]
    if skeleton.axes[1:, 1].any():
        pitch = np.stack([angles[:, group, 1].sum(axis=1) for group in groups], axis=1)
        columns += [pitch, _rate(_softened(pitch), step)]
    own = (joints - joints.mean(axis=1, keepdims=True)) / length_mm
    twist = _rate(_softened(own.reshape(len(own), -1)), step)
    # root-mean-square speed of the joints relative to their centroid
    columns.append(np.sqrt((twist**2).mean(axis=1) * 3.0))
    if _stands(skeleton):
        z = joints[..., 2] / length_mm
        columns += [z[:, -1], z.mean(axis=1), z[:, 0], z[:, -1] - z[:, 0]]
    columns += [
        # a wall's influence decays over 0.6 body lengths
        np.exp(-np.maximum(wall, 0.0) / (0.6 * length_mm)),
        # 1.5 makes the logarithm of the median error of order one
        np.log1p(1.5 * error / usual_mm),
    ]
    return np.concatenate([c[:, None] if c.ndim == 1 else c for c in columns], axis=1)


def _softened(rows: Array) -> Array:
    """Binomial filter (1/4, 1/2, 1/4) over rows (m, ...), which removes jitter."""
    if len(rows) < 3:
        return rows
    inner = 0.25 * rows[:-2] + 0.5 * rows[1:-1] + 0.25 * rows[2:]
    return np.concatenate([rows[:1], inner, rows[-1:]])


def _rate(rows: Array, step: float) -> Array:
    """Change per second of rows (m, ...), by central differences."""
    return np.asarray(np.gradient(rows, step, axis=0))


# Window features of every tick: mean, spread and extreme of the channels over windows in seconds.


def window_features(segment: Segment, names: Sequence[str]) -> NDArray[np.float32]:
    """Features of every tick of a segment: its channels now, and statistics of windows around it.

    Mean and standard deviation in centred windows, mean and root mean square in windows before and
    after, and the largest absolute value nearby.

    For channels that change sign under reflection (their names end in ~), the absolute values of
    the means are used, and the signed means in the centred windows only.

    Args:
        segment: channels (m, C) of an unbroken segment, m at least 2.
        names: (C) names of the channels.

    Returns:
        (m, F) float32.
    """
    return next(feature_blocks(segment, names, len(segment.times_s)))


def feature_blocks(
    segment: Segment, names: Sequence[str], size: int
) -> Iterator[NDArray[np.float32]]:
    """Yield the `window_features` of a segment, `size` ticks at a time."""
    from scipy.ndimage import maximum_filter1d

    x = segment.values
    step = segment.times_s[1] - segment.times_s[0]
    signed = np.array([name.endswith("~") for name in names])
    start_at = np.zeros((1, x.shape[1]))
    sums, squares = (np.concatenate([start_at, np.cumsum(v, axis=0)]) for v in (x, x * x))
    width = 2 * max(1, round(0.25 / step)) + 1
    largest = maximum_filter1d(np.abs(x), width, axis=0, mode="nearest")
    for begin in range(0, len(x), size):
        rows = np.arange(begin, min(begin + size, len(x)))
        parts: list[NDArray[Any]] = [x[rows], np.abs(x[rows][:, signed])]
        for half in (0.06, 0.2, 0.6):
            mean, square = (_window_mean(one, rows, -half, half, step) for one in (sums, squares))
            spread = np.sqrt(np.maximum(square - mean * mean, 0.0))
            parts += [mean.astype(np.float32), np.abs(mean[:, signed]), spread.astype(np.float32)]
        for start, stop in ((-0.9, -0.35), (-0.35, -0.08), (0.08, 0.35), (0.35, 0.9)):
            mean, square = (_window_mean(one, rows, start, stop, step) for one in (sums, squares))
            level = np.where(signed, np.abs(mean), mean)
            parts += [level.astype(np.float32), np.sqrt(np.maximum(square, 0.0)).astype(np.float32)]
        yield np.concatenate([*parts, largest[rows]], axis=1, dtype=np.float32)


def _window_mean(
    total: Array, rows: NDArray[np.int64], start_s: float, stop_s: float, step: float
) -> Array:
    """Means (k, C) over [t + start_s, t + stop_s] of some rows from running sums (m + 1, C),
    clipped at the ends.
    """
    m = len(total) - 1
    low = np.clip(rows + round(start_s / step), 0, m - 1)
    high = np.clip(rows + round(stop_s / step), 0, m - 1) + 1
    return np.asarray((total[high] - total[low]) / (high - low)[:, None])
