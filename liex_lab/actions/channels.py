"""What a body does from moment to moment, in seconds and body lengths, on a steady clock of its own.

A track of any frame rate becomes channels of one rate, so that a recogniser sees the same movement whatever the camera.
A faster camera is averaged, a slower one interpolated; poses that cannot be true and short gaps are bridged, long gaps
part the track into stretches.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from liex_lab.body.skeleton import VIEWS, Skeleton
from liex_lab.tracking.track import Track

Array = NDArray[np.float64]

LONGEST_GAP_S = 0.4  # is bridged; within a longer one nobody knows what happened
_FLIP_S = 0.15  # to either side: a body that points the other way for a moment was measured wrongly
_WALL_BL = 0.6  # a wall this many lengths away hardly matters
_AXIS = {1: 0.75, -1: 0.4}  # of the chain is the trunk, for bases at the rear and at the front
_GROUPS = 3  # parts of the chain whose bends are added up


@dataclass(frozen=True)
class Stretch:
    """Channels (m, C) on a steady clock: times_s (m,) since the track's first frame, from one unbroken stretch."""

    times_s: Array
    values: Array


def channel_names(skeleton: Skeleton) -> list[str]:
    """What the columns of a stretch are, see `stretches_of`; those that end in ~ change sign in a mirror."""
    pitches = [f"pitch_{k}" for k in range(_GROUPS)] if skeleton.axes[1:, 1].any() else []
    floor = ["tip_height", "middle_height", "base_height", "tip_over_base"] if _stands(skeleton) else []
    return ["forward", "sideways~", "upward", "speed", "yaw_rate~", "climb", "climb_rate", "straightness", "length",
            *(f"bend_{k}~" for k in range(_GROUPS)), *(f"bend_rate_{k}~" for k in range(_GROUPS)), *pitches,
            *(f"{p}_rate" for p in pitches), "twist", *floor, "wall", "doubt"]  # fmt: skip


def stretches_of(track: Track, rate_hz: float, wall_mm: Array | None = None) -> list[Stretch]:
    """The channels of a track, one stretch after the other. wall_mm (n,): distance of the animal from a wall."""
    time_s = (track.times_ns - track.times_ns[:1]).astype(np.float64) * 1e-9
    good = np.flatnonzero(track.observed)
    if not len(good):
        return []
    good = good[~_reversed(track, good, time_s)]
    length_mm = float(np.median(track.scale[good])) * track.skeleton.length
    wall = np.full(len(time_s), np.nan) if wall_mm is None else wall_mm
    cuts = np.flatnonzero(np.diff(time_s[good]) > max(LONGEST_GAP_S, 2.5 * _usual_step(time_s))) + 1
    return [
        Stretch(clock, _channels(track.skeleton, length_mm, clock, *_on_clock(track, rows, time_s, wall, clock)))
        for rows in np.split(good, cuts)
        for clock in [_clock(time_s[rows], rate_hz)]
    ]


def _usual_step(time_s: Array) -> float:
    return float(np.median(np.diff(time_s))) if len(time_s) > 1 else 0.0


def _clock(time_s: Array, rate_hz: float) -> Array:
    """(m,) s from the first to the last of these times."""
    return time_s[0] + np.arange(max(2, int((time_s[-1] - time_s[0]) * rate_hz + 1e-6) + 1)) / rate_hz


def _stands(skeleton: Skeleton) -> bool:
    return skeleton.view.frame == VIEWS[0]


def _forward(skeleton: Skeleton) -> tuple[int, int]:
    """The joints from which and to which the trunk points forward."""
    way = 1 if skeleton.offsets[1:, 0].sum() > 0 else -1
    end = max(1, round(_AXIS[way] * (skeleton.n_joints - 1)))
    return (0, end) if way > 0 else (end, 0)


def _reversed(track: Track, good: NDArray[np.int64], time_s: Array) -> NDArray[np.bool_]:
    """Which of the good frames point against what lies around them: head and tail were exchanged."""
    rear, front = _forward(track.skeleton)
    axis = track.joints_mm[good, front] - track.joints_mm[good, rear]
    axis /= np.maximum(np.linalg.norm(axis, axis=1, keepdims=True), 1e-9)
    total = np.concatenate([np.zeros((1, 3)), np.cumsum(axis, axis=0)])
    times = time_s[good]
    low, high = np.searchsorted(times, times - _FLIP_S, "left"), np.searchsorted(times, times + _FLIP_S, "right")
    around = total[high] - total[low] - axis
    return np.asarray(np.sum(axis * around, axis=1) < -0.5 * (high - low - 1).clip(1))


def _on_clock(
    track: Track, rows: NDArray[np.int64], time_s: Array, wall: Array, clock: Array
) -> tuple[Array, Array, Array, Array]:
    """Joints (m, J, 3) mm, joint angles (m, J, 3) rad, distance from a wall (m,) mm and predicted error (m,) mm."""
    n = len(rows)
    distance, error = np.nan_to_num(wall[rows], nan=1e6), np.nan_to_num(track.predicted_error_mm[rows], nan=0.0)
    columns = np.concatenate(
        [track.joints_mm[rows].reshape(n, -1), track.angles_rad[rows].reshape(n, -1), distance[:, None],
         error[:, None]], axis=1,
    )  # fmt: skip
    times, step = time_s[rows], clock[1] - clock[0]
    if n > 2 and np.median(np.diff(times)) < 0.7 * step:  # a faster camera: the mean of what falls to each tick
        tick = np.clip(np.round((times - clock[0]) / step).astype(int), 0, len(clock) - 1)
        starts = np.flatnonzero(np.append(True, np.diff(tick) > 0))
        count = np.diff(np.append(starts, n))[:, None]
        columns, times = np.add.reduceat(columns, starts) / count, np.add.reduceat(times, starts) / count[:, 0]
    out = _interpolated(clock, times, columns)
    j = track.skeleton.n_joints
    return out[:, : 3 * j].reshape(-1, j, 3), out[:, 3 * j : 6 * j].reshape(-1, j, 3), out[:, -2], out[:, -1]


def _interpolated(clock: Array, times: Array, rows: Array) -> Array:
    """Rows (m, k) at the clock's times from rows (n, k) at other times, linear, ends held."""
    if len(times) == 1:
        return np.repeat(rows, len(clock), axis=0)
    low = np.clip(np.searchsorted(times, clock, side="right") - 1, 0, len(times) - 2)
    share = np.clip((clock - times[low]) / (times[low + 1] - times[low]), 0.0, 1.0)[:, None]
    return rows[low] * (1.0 - share) + rows[low + 1] * share


def _channels(
    skeleton: Skeleton, length_mm: float, clock: Array, joints: Array, angles: Array, wall: Array, error: Array
) -> Array:
    """Channels (m, C) of joints (m, J, 3) mm, angles (m, J, 3) rad, distances (m,) mm and predicted errors (m,) mm."""
    step = clock[1] - clock[0]
    rear, front = _forward(skeleton)
    axis = joints[:, front] - joints[:, rear]
    level = np.hypot(axis[:, 0], axis[:, 1])
    climb = np.arctan2(axis[:, 2], level)
    heading = np.unwrap(np.arctan2(axis[:, 1], axis[:, 0]))
    # a body that stands upright has no heading: it keeps the last one
    steep = level < 0.25 * np.linalg.norm(axis, axis=1)
    keep = np.maximum.accumulate(np.where(steep, 0, np.arange(len(clock))))
    heading = heading[keep]
    middle = joints.mean(axis=1) / length_mm
    velocity = _rate(_softened(middle), step)
    ahead, aside = np.cos(heading), np.sin(heading)
    forward = velocity[:, 0] * ahead + velocity[:, 1] * aside
    sideways = velocity[:, 1] * ahead - velocity[:, 0] * aside
    bones = np.linalg.norm(np.diff(joints, axis=1), axis=2).sum(axis=1)
    straight = np.linalg.norm(joints[:, -1] - joints[:, 0], axis=1) / np.maximum(bones, 1e-9)
    groups = np.array_split(np.arange(1, skeleton.n_joints - 1), _GROUPS)
    bend = np.stack([angles[:, group, 2].sum(axis=1) for group in groups], axis=1)
    columns = [forward, sideways, velocity[:, 2], np.linalg.norm(velocity, axis=1), _rate(_softened(heading), step),
               climb, _rate(_softened(climb), step), straight, bones / length_mm - 1.0, bend,
               _rate(_softened(bend), step)]  # fmt: skip
    if skeleton.axes[1:, 1].any():
        pitch = np.stack([angles[:, group, 1].sum(axis=1) for group in groups], axis=1)
        columns += [pitch, _rate(_softened(pitch), step)]
    columns.append(_twist(joints, length_mm, step))
    if _stands(skeleton):
        z = joints[..., 2] / length_mm
        columns += [z[:, -1], z.mean(axis=1), z[:, 0], z[:, -1] - z[:, 0]]
    columns += [np.exp(-np.maximum(wall, 0.0) / (_WALL_BL * length_mm)), np.log1p(30.0 * error / length_mm)]
    return np.concatenate([c[:, None] if c.ndim == 1 else c for c in columns], axis=1)


def _twist(joints: Array, length_mm: float, step: float) -> Array:
    """(m,) lengths a second: how fast the joints move against the body's middle, of whatever part."""
    own = (joints - joints.mean(axis=1, keepdims=True)) / length_mm
    return np.asarray(np.sqrt((_rate(_softened(own.reshape(len(own), -1)), step) ** 2).mean(axis=1) * 3.0))


def _softened(rows: Array) -> Array:
    """Rows (m, ...) with a quarter of each neighbour: jitter from frame to frame is not movement."""
    if len(rows) < 3:
        return rows
    inner = 0.25 * rows[:-2] + 0.5 * rows[1:-1] + 0.25 * rows[2:]
    return np.concatenate([rows[:1], inner, rows[-1:]])


def _rate(rows: Array, step: float) -> Array:
    """Change a second of rows (m, ...)."""
    return np.asarray(np.gradient(rows, step, axis=0))
