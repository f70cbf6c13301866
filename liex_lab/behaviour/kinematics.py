"""What a body does from frame to frame: speed, heading, turning, heights, curvature. Pandas in,
pandas out.

Every derivative is taken over the frames' true times and never across a gap, and carries the
standard deviation that follows from the joints' own. Errors of the joints of one frame are taken as
one common error (the body is off as a whole), those of the two ends of a line as independent, and
an error as lasting for `ERROR_LASTS_S`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from liex_lab.behaviour.body import Body
from liex_lab.behaviour.columns import kinematics_columns
from liex_lab.behaviour.posture import Posture, Shape
from liex_lab.behaviour.tail import tail_beat
from liex_lab.runtime.memory import Room, blocks, let_go
from liex_lab.tables.rows import gap_follows, median_step, stop_times
from liex_lab.tables.schema import to_pandas
from liex_lab.tracking.track import Track

Array = NDArray[np.float64]
Rows = NDArray[np.int64]

HALF_WINDOW_S = (
    0.034  # speed at t uses neighbours this far away, as Live Mouse Tracker does at 30 fps
)
IMPOSSIBLE_MM_S = 3000.0  # faster than any mouse: a tracking error
# after which two errors agree by 1/e; on rendered recordings they last longer, smoothed or not
ERROR_LASTS_S = 0.3
_BLOCK = 16_384  # frames whose postures are in memory at a time
_MOVING = (
    "x_mm",
    "y_mm",
    "z_mm",
    "position_sd_mm",
    "speed_mm_s",
    "speed_sd_mm_s",
    "vertical_speed_mm_s",
    "step_mm",
    "acceleration_mm_s2",
    "acceleration_sd_mm_s2",
    "heading_rad",
    "heading_sd_rad",
    "yaw_rate_rad_s",
    "yaw_rate_sd_rad_s",
    "body_pitch_rad",
    "body_pitch_sd_rad",
)
_HEIGHTS = (
    "nose_height_mm",
    "nose_height_sd_mm",
    "back_height_mm",
    "nose_over_rump_mm",
    "reach_mm",
)
STEEP_RAD = np.radians(75.0)  # beyond it the body's axis has no reliable direction on the floor


@dataclass(frozen=True)
class Spans:
    """Which frames a derivative at each of some frames `rows` (m) is taken between, and the time
    from one to the other, s. What it is taken of are always the values of all frames (n).
    """

    before: Rows
    after: Rows
    span_s: Array
    rows: slice

    @staticmethod
    def of(time_s: Array, observed: NDArray[np.bool_], half_window_s: float) -> Spans:
        """The neighbours about `half_window_s` away; a frame that stands alone has an empty
        span.
        """
        before, after = neighbours(time_s, observed, half_window_s)
        span_s = np.where(after > before, time_s[after] - time_s[before], np.nan)
        return Spans(before, after, span_s, slice(None))

    def __getitem__(self, rows: slice) -> Spans:
        """Those of some of all frames."""
        return Spans(self.before[rows], self.after[rows], self.span_s[rows], rows)

    def rate(self, values: Array) -> Array:
        """Change per second of values (n,) or (n, k)."""
        span = self.span_s if values.ndim == 1 else self.span_s[:, None]
        return np.asarray((values[self.after] - values[self.before]) / span)

    def turning(self, angle: Array) -> Array:
        """(m,) rad/s, adding the smallest turns from `before` over the frame itself to `after`."""
        here = angle[self.rows]
        turn = smallest_turn(here - angle[self.before]) + smallest_turn(angle[self.after] - here)
        return np.asarray(turn / self.span_s)

    def sd(self, sd: Array) -> Array:
        """(m,) standard deviation of the rate of values with these (n,); the nearer two frames, the
        more they agree.
        """
        first = sd[self.before]
        second = sd[self.after]
        shared = np.exp(-self.span_s / ERROR_LASTS_S)
        return np.asarray(
            np.sqrt(first**2 + second**2 - 2.0 * shared * first * second) / self.span_s
        )


def kinematics(
    frames: pd.DataFrame,
    poses: pd.DataFrame | Joints,
    half_window_s: float = HALF_WINDOW_S,
    impossible_above_mm_s: float = IMPOSSIBLE_MM_S,
    surface_z_mm: float | None = None,
    room: Room = np.empty,
) -> pd.DataFrame:
    """The table `kinematics` from the tables `frames` and `poses` (or its joints) of one animal:
    one row per frame.

    surface_z_mm: height of the water's surface above the floor, for an animal that swims. room:
    where its columns are to lie.
    """
    joints = poses if isinstance(poses, Joints) else Joints.of_table(poses, len(frames))
    body = Body.of(joints.names)
    shape, heights = _frame_by_frame(body, joints, room)
    time_s = frames["time_s"].to_numpy(float)
    observed = np.isfinite(shape.centre[:, 0])
    spans = Spans.of(time_s, observed, half_window_s)
    block: dict[str, Any] = {
        name: _put_away(frames[name], room) for name in ("frame_index", "time_s", "dt_s")
    }
    block |= {name: str(frames[name].iloc[0]) for name in ("session_id", "individual")}
    block |= _moving(
        shape, body.swims, spans, stop_times(time_s) - time_s, impossible_above_mm_s, room
    )
    block |= {
        "length_mm": shape.length_mm,
        "straightness": shape.straightness,
        "bend_rad": shape.bend_rad,
        **heights,
    }
    if body.swims:
        block |= _swimming(shape, time_s, segments(time_s, observed), surface_z_mm)
    return to_pandas(kinematics_columns(body.swims), block, copy=False)


def _frame_by_frame(body: Body, joints: Joints, room: Room) -> tuple[Shape, dict[str, Array]]:
    """What each frame tells by itself, and of an animal that stands its heights; a block of frames
    is in memory.
    """
    shape = Shape.empty(joints.n_frames, room)
    heights = {} if body.swims else {name: room((joints.n_frames,), float) for name in _HEIGHTS}
    for rows in blocks(joints.n_frames, _BLOCK):
        xyz, sd = joints.at(rows)
        shape.put(rows, Posture.of(body, xyz, sd))
        if not body.swims:
            _put(heights, rows, _walking(body, xyz, sd))
        shape.rest()
        let_go(*heights.values())
    return shape, heights


def _put_away(column: pd.Series[Any], room: Room) -> NDArray[Any]:
    """A column (n,) in that room."""
    values = room((len(column),), column.dtype)
    values[:] = column.to_numpy()
    let_go(values)
    return values


def _put(columns: dict[str, Array], rows: slice, values: dict[str, Array]) -> None:
    """Values (m,) of some rows into their columns (n,)."""
    for name, some in values.items():
        columns[name][rows] = some


def _moving(
    shape: Shape, swims: bool, spans: Spans, hold_s: Array, impossible_above_mm_s: float, room: Room
) -> dict[str, Array]:
    """Place, speed and turning of the body as a whole; hold_s (n,): how long each frame counts."""
    columns = {name: room((len(hold_s),), float) for name in _MOVING}
    speed, speed_sd, heading, heading_sd = (
        columns[name] for name in ("speed_mm_s", "speed_sd_mm_s", "heading_rad", "heading_sd_rad")
    )
    for rows in blocks(len(hold_s), _BLOCK):
        centre = shape.centre[rows]
        velocity = spans[rows].rate(shape.centre)
        fast = np.linalg.norm(velocity if swims else velocity[:, :2], axis=1)
        speed[rows] = np.where(fast > impossible_above_mm_s, np.nan, fast)
        speed_sd[rows] = spans[rows].sd(shape.centre_sd)
        flat = np.abs(shape.pitch_rad[rows]) < STEEP_RAD
        heading[rows] = np.where(flat, shape.heading_rad[rows], np.nan)
        heading_sd[rows] = np.where(flat, shape.heading_sd_rad[rows], np.nan)
        _put(
            columns,
            rows,
            {
                "x_mm": centre[:, 0],
                "y_mm": centre[:, 1],
                "z_mm": centre[:, 2],
                "position_sd_mm": shape.centre_sd[rows],
                "vertical_speed_mm_s": velocity[:, 2],
                "step_mm": speed[rows] * hold_s[rows],
                "body_pitch_rad": shape.pitch_rad[rows],
                "body_pitch_sd_rad": shape.pitch_sd_rad[rows],
            },
        )
        shape.rest()
        let_go(*columns.values())
    for rows in blocks(len(hold_s), _BLOCK):  # now that those of the neighbours are known
        here = spans[rows]
        _put(
            columns,
            rows,
            {
                "acceleration_mm_s2": here.rate(speed),
                "acceleration_sd_mm_s2": here.sd(speed_sd),
                "yaw_rate_rad_s": here.turning(heading),
                "yaw_rate_sd_rad_s": here.sd(heading_sd),
            },
        )
        let_go(*columns.values())
    return columns


def _walking(body: Body, xyz: Array, sd: Array) -> dict[str, Array]:
    """Heights of an animal that stands on the floor."""
    nose = xyz[:, body.front]
    rump = xyz[:, body.rear]
    return {
        "nose_height_mm": nose[:, 2],
        "nose_height_sd_mm": sd[:, body.front],
        "back_height_mm": xyz[:, list(body.back), 2].max(axis=1),
        "nose_over_rump_mm": nose[:, 2] - rump[:, 2],
        "reach_mm": np.hypot(*(nose - rump)[:, :2].T),
    }


def _swimming(
    shape: Shape, time_s: Array, number: Rows, surface_z_mm: float | None
) -> dict[str, Array]:
    """Curvature along the body, the tail's beat, and the depth below the surface."""
    beat = tail_beat(shape, time_s, number, median_step(time_s))
    surface = np.nan if surface_z_mm is None else surface_z_mm
    front, middle, rear = shape.thirds_rad.T
    return {
        "bend_front_rad": front,
        "bend_middle_rad": middle,
        "bend_rear_rad": rear,
        "tail_angle_rad": shape.tail_angle_rad,
        "tail_mm": shape.tail_mm,
        "tail_extreme_rad": beat.extreme_rad,
        "tail_beat_hz": beat.frequency_hz,
        "tail_beat_mm": beat.amplitude_mm,
        "below_surface_mm": surface - shape.centre[:, 2],
    }


@dataclass(frozen=True)
class Joints:
    """The joints of n frames: their names; at: positions (m, J, 3) mm in the arena of some frames
    and the sd (m, J) mm along an axis, NaN where they are not known.
    """

    names: list[str]
    n_frames: int
    at: Callable[[slice], tuple[Array, Array]]

    @staticmethod
    def of_table(poses: pd.DataFrame, n: int) -> Joints:
        """Those of the table `poses` of n frames."""
        column = poses["joint"]
        names = (
            column.cat.categories
            if isinstance(column.dtype, pd.CategoricalDtype)
            else pd.unique(column)
        )
        shape = (n, len(names))
        xyz = [poses[name].to_numpy(float).reshape(shape) for name in ("x_mm", "y_mm", "z_mm")]
        sd = (
            poses["sd_mm"].to_numpy(float).reshape(shape)
            if "sd_mm" in poses
            else np.full(shape, np.nan)
        )
        return Joints(
            [str(name) for name in names],
            n,
            lambda rows: (_apart([one[rows] for one in xyz]), sd[rows]),
        )

    @staticmethod
    def of_track(track: Track) -> Joints:
        """Those of a track; what was bridged was not measured."""

        def at(rows: slice) -> tuple[Array, Array]:
            part = track[rows]
            xyz = np.where(part.bridged[:, None, None], np.nan, part.joints_mm)
            sd = part.sd_mm.copy()
            track.rest()
            return _apart(list(np.moveaxis(xyz, -1, 0))), sd

        return Joints(list(track.skeleton.names), track.n_frames, at)


def _apart(xyz: Sequence[Array]) -> Array:
    """Three coordinates (m, J) as (m, J, 3), each by itself in memory: sums over joints then have
    the same bits.
    """
    return np.moveaxis(np.stack(xyz), 0, -1)


def segments(time_s: Array, observed: NDArray[np.bool_]) -> Rows:
    """(n,) the number of the unbroken stretch each frame belongs to: no missing frame, no lost
    animal inside.
    """
    broken = np.append(True, gap_follows(time_s)[:-1] | (observed[1:] != observed[:-1]))[
        : len(time_s)
    ]
    return np.asarray(np.cumsum(broken) - 1)


def neighbours(
    time_s: Array, observed: NDArray[np.bool_], half_window_s: float = HALF_WINDOW_S
) -> tuple[Rows, Rows]:
    """(n,) rows to difference between: about `half_window_s` before and after, never outside the
    frame's own stretch.

    At the ends of a stretch the difference is one-sided; a stretch of one frame has none (before ==
    after).
    """
    n = len(time_s)
    rows = np.arange(len(time_s))
    reach = (
        0.75 * half_window_s
    )  # at the camera's own rate the next frame counts, jitter of its clock or not
    before = np.searchsorted(time_s, time_s - reach, side="right") - 1
    after = np.searchsorted(time_s, time_s + reach, side="left")
    number = segments(time_s, observed)
    first = np.searchsorted(number, number, side="left")
    last = np.searchsorted(number, number, side="right") - 1
    before = np.clip(np.minimum(before, np.maximum(rows - 1, 0)), first, last)
    after = np.clip(np.maximum(after, np.minimum(rows + 1, n - 1)), first, last)
    lost = ~observed
    return np.where(lost, rows, before), np.where(lost, rows, after)


def smallest_turn(angle: Array) -> Array:
    """Angles brought into (-pi, pi]."""
    return np.asarray(np.pi - (np.pi - angle) % (2.0 * np.pi))
