"""Kinematics per frame: central differences over true times, with propagated standard deviations.

Rate of v at t: (v(t + h) - v(t - h)) / true time between the two frames, h about `HALF_WINDOW_S`.
It is never taken across a gap nor across the end of a person's exchange of head and tail, and is
one-sided at the ends of an unbroken stretch. This gives speed, acceleration and yaw rate. The
standard deviation is sqrt(s1^2 + s2^2 - 2 r s1 s2) / span with r = exp(-span / `ERROR_LASTS_S`),
the autocorrelation of an Ornstein-Uhlenbeck process: the errors of close frames are correlated. The
joint errors of one frame are treated as one common error (the whole body is displaced), those of
the two ends of a line as independent. Heading, pitch, length, bend, heights and the tail's beat
come from `posture`. Input and output are pandas tables.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from liex_lab.behaviour.body import STANDS, SWIMS, BodyAxis
from liex_lab.behaviour.posture import posture, tail_beat
from liex_lab.runtime.memory import Allocator, blocks
from liex_lab.tables.rows import gap_follows, median_step, stop_times
from liex_lab.tables.schema import table_columns, to_pandas
from liex_lab.tracking.track import Track

Array = NDArray[np.float64]
Rows = NDArray[np.int64]

# distance of the neighbours for the speed at t, as in Live Mouse Tracker at 30 fps
HALF_WINDOW_S = 0.034
IMPOSSIBLE_MM_S = 3000.0  # faster than any mouse: a tracking error
# correlation time of errors; on rendered recordings it is longer, smoothed or not
ERROR_LASTS_S = 0.3
_BLOCK = 16_384  # frames in memory at a time
STEEP_RAD = np.radians(75.0)  # beyond it the body's axis has no reliable direction on the floor


@dataclass(frozen=True)
class Spans:
    """The two frames for the derivative at each of m frames.

    The derivative's input is always the values of all n frames.

    Attributes:
        before: (m,) int64 row of the earlier frame.
        after: (m,) int64 row of the later frame.
        span_s: (m,) time between them, s; NaN for an isolated frame.
        rows: the m frames among all n.
    """

    before: Rows
    after: Rows
    span_s: Array
    rows: slice

    @staticmethod
    def of(
        time_s: Array,
        observed: NDArray[np.bool_],
        half_window_s: float,
        begins: NDArray[np.bool_] | bool = False,
    ) -> Spans:
        """The neighbours about `half_window_s` away; an isolated frame has the span NaN.

        Args:
            time_s: (n,) times of the frames, s.
            observed: (n,) bool, whether the frame has a pose.
            half_window_s: distance of the neighbours before and after the frame, s.
            begins: (n,) bool, see `segments`.
        """
        before, after = neighbours(time_s, observed, half_window_s, begins)
        span_s = np.where(after > before, time_s[after] - time_s[before], np.nan)
        return Spans(before, after, span_s, slice(None))

    def __getitem__(self, rows: slice) -> Spans:
        """The spans of a slice of frames; `rows` is a slice of a `Spans` of all n frames."""
        return Spans(self.before[rows], self.after[rows], self.span_s[rows], rows)

    def rate(self, values: Array) -> Array:
        """(m,) or (m, k) change per second; NaN for an isolated frame.

        Args:
            values: (n,) or (n, k), of all frames.
        """
        span = self.span_s if values.ndim == 1 else self.span_s[:, None]
        return np.asarray((values[self.after] - values[self.before]) / span)

    def turning(self, angle: Array) -> Array:
        """(m,) rad/s, the sum of the smallest turns from `before` to the frame and on to `after`.

        Args:
            angle: (n,) rad, of all frames.
        """
        here = angle[self.rows]
        turn = smallest_turn(here - angle[self.before]) + smallest_turn(angle[self.after] - here)
        return np.asarray(turn / self.span_s)

    def sd(self, sd: Array) -> Array:
        """(m,) standard deviation of the rate; the errors of close frames are correlated.

        Args:
            sd: (n,) standard deviation of the values of all frames, in their unit.
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
    seams: Sequence[int] = (),
    allocate: Allocator = np.empty,
) -> pd.DataFrame:
    """The table `kinematics` of one animal: one row per frame, rates with standard deviations.

    Args:
        frames: the table `frames` of n frames.
        poses: the table `poses` of these frames, or its joints.
        half_window_s: derivatives use neighbours this far before and after, s.
        impossible_above_mm_s: a faster speed is a tracking error and left empty, mm/s.
        surface_z_mm: height of the water's surface above the floor, mm, for a swimming animal; None
            if unknown.
        seams: values of `frame_index` that begin a new stretch, see `Surroundings`.
        allocate: makes the arrays of the columns (an allocator, as `np.empty`).

    Returns:
        The table: mm, s and rad in the arena frame, NaN if unknown.
    """
    joints = poses if isinstance(poses, Joints) else Joints.of_table(poses, len(frames))
    body = BodyAxis.of(joints.names, joints.parents)
    shape: dict[str, Array] = {}
    for rows in blocks(joints.n_frames, _BLOCK):
        _put(shape, rows, posture(body, *joints.at(rows)), joints.n_frames, allocate)
    time_s = frames["time_s"].to_numpy(float)
    observed = np.isfinite(shape["centre"][:, 0])
    begins = np.isin(frames["frame_index"].to_numpy(), seams)
    spans = Spans.of(time_s, observed, half_window_s, begins)
    block: dict[str, Any] = {
        name: _put_away(frames[name], allocate) for name in ("frame_index", "time_s", "dt_s")
    }
    block |= {name: str(frames[name].iloc[0]) for name in ("session_id", "individual")}
    hold_s = stop_times(time_s) - time_s
    block |= shape | _moving(shape, body.kind, spans, hold_s, impossible_above_mm_s, allocate)
    if body.kind == SWIMS:
        number = segments(time_s, observed, begins)
        surface = np.nan if surface_z_mm is None else surface_z_mm
        block |= tail_beat(shape, time_s, number, median_step(time_s))
        block["below_surface_mm"] = surface - shape["centre"][:, 2]
    return to_pandas(table_columns("kinematics", body.kind), block, copy=False)


def _put_away(column: pd.Series[Any], allocate: Allocator) -> NDArray[Any]:
    """A copy (n,) of a column in an array of the allocator."""
    values = allocate((len(column),), column.dtype)
    values[:] = column.to_numpy()
    return values


def _put(
    columns: dict[str, Array],
    rows: slice,
    values: dict[str, Array],
    n: int,
    allocate: Allocator,
) -> None:
    """Write values (m, ...) of some rows into their columns (n, ...), allocated on first use."""
    for name, some in values.items():
        if name not in columns:
            columns[name] = allocate((n, *some.shape[1:]), float)
        columns[name][rows] = some


def _moving(
    shape: dict[str, Array],
    kind: str,
    spans: Spans,
    hold_s: Array,
    impossible_above_mm_s: float,
    allocate: Allocator,
) -> dict[str, Array]:
    """Position, speed and turning of the whole body; hold_s (n,) is each frame's duration, s."""
    columns: dict[str, Array] = {}
    for rows in blocks(len(hold_s), _BLOCK):
        centre = shape["centre"][rows]
        velocity = spans[rows].rate(shape["centre"])
        fast = np.linalg.norm(velocity[:, :2] if kind == STANDS else velocity, axis=1)
        speed = np.where(fast > impossible_above_mm_s, np.nan, fast)
        flat = np.abs(shape["body_pitch_rad"][rows]) < STEEP_RAD
        values = {
            "x_mm": centre[:, 0],
            "y_mm": centre[:, 1],
            "z_mm": centre[:, 2],
            "position_sd_mm": shape["centre_sd"][rows],
            "speed_mm_s": speed,
            "speed_sd_mm_s": spans[rows].sd(shape["centre_sd"]),
            "vertical_speed_mm_s": velocity[:, 2],
            "step_mm": speed * hold_s[rows],
            "heading_rad": np.where(flat, shape["heading_rad"][rows], np.nan),
            "heading_sd_rad": np.where(flat, shape["heading_sd_rad"][rows], np.nan),
        }
        _put(columns, rows, values, len(hold_s), allocate)
    for rows in blocks(len(hold_s), _BLOCK):  # needs the neighbours' values
        here = spans[rows]
        values = {
            "acceleration_mm_s2": here.rate(columns["speed_mm_s"]),
            "acceleration_sd_mm_s2": here.sd(columns["speed_sd_mm_s"]),
            "yaw_rate_rad_s": here.turning(columns["heading_rad"]),
            "yaw_rate_sd_rad_s": here.sd(columns["heading_sd_rad"]),
        }
        _put(columns, rows, values, len(hold_s), allocate)
    return columns


@dataclass(frozen=True)
class Joints:
    """The J joints of n frames, read in blocks of frames.

    Attributes:
        names: names of the joints.
        n_frames: number of frames.
        at: from a slice of m frames to positions (m, J, 3) mm in the arena frame and their standard
            deviation (m, J) mm along an axis, NaN if unknown.
        parents: joint before each of them, -1 at the base; None means one chain.
    """

    names: list[str]
    n_frames: int
    at: Callable[[slice], tuple[Array, Array]]
    parents: tuple[int, ...] | None = None

    @staticmethod
    def of_table(poses: pd.DataFrame, n: int, parents: tuple[int, ...] | None = None) -> Joints:
        """The joints of the table `poses`.

        Args:
            poses: the table `poses`, J rows per frame; without sd_mm all standard deviations are
                NaN.
            n: number of frames.
            parents: joint before each joint, -1 at the base; None means one chain.
        """
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
            parents,
        )

    @staticmethod
    def of_track(track: Track) -> Joints:
        """The joints of a track, read in blocks, arena frame, mm; bridged frames are NaN."""

        def at(rows: slice) -> tuple[Array, Array]:
            """Positions (m, J, 3) mm and standard deviations (m, J) mm of the frames `rows`."""
            part = track[rows]
            xyz = np.where(part.bridged[:, None, None], np.nan, part.joints_mm)
            sd = part.sd_mm.copy()
            return _apart(list(np.moveaxis(xyz, -1, 0))), sd

        parents = tuple(int(joint) for joint in track.skeleton.parents)
        return Joints(list(track.skeleton.names), track.n_frames, at, parents)


def _apart(xyz: Sequence[Array]) -> Array:
    """Three coordinates (m, J) as (m, J, 3), each contiguous in memory.

    This makes sums over joints bitwise equal, whatever the source of the joints.
    """
    return np.moveaxis(np.stack(xyz), 0, -1)


def segments(
    time_s: Array, observed: NDArray[np.bool_], begins: NDArray[np.bool_] | bool = False
) -> Rows:
    """(n,) int64 number of each frame's unbroken stretch, from 0 upwards.

    A stretch has no missing frame and no frame without a pose.

    Args:
        time_s: (n,) times of the frames, s.
        observed: (n,) bool, whether the frame has a pose.
        begins: (n,) bool, whether the frame begins a stretch for another reason.
    """
    broken = np.append(True, gap_follows(time_s)[:-1] | (observed[1:] != observed[:-1]))[
        : len(time_s)
    ]
    return np.asarray(np.cumsum(broken | begins) - 1)


def neighbours(
    time_s: Array,
    observed: NDArray[np.bool_],
    half_window_s: float = HALF_WINDOW_S,
    begins: NDArray[np.bool_] | bool = False,
) -> tuple[Rows, Rows]:
    """Rows to difference between: about `half_window_s` before and after, within the same stretch.

    At the ends of a stretch the difference is one-sided. A stretch of one frame and a frame without
    a pose have none (before == after).

    Args:
        time_s: (n,) times of the frames, s.
        observed: (n,) bool, whether the frame has a pose.
        half_window_s: distance of the neighbours before and after the frame, s; at the camera's own
            rate the next frame is used, despite jitter of the clock.
        begins: (n,) bool, see `segments`.

    Returns:
        before and after, (n,) int64 rows each.
    """
    n = len(time_s)
    rows = np.arange(len(time_s))
    reach = (
        0.75 * half_window_s
    )  # at the camera's own rate the next frame is used, despite jitter of its clock
    before = np.searchsorted(time_s, time_s - reach, side="right") - 1
    after = np.searchsorted(time_s, time_s + reach, side="left")
    number = segments(time_s, observed, begins)
    first = np.searchsorted(number, number, side="left")
    last = np.searchsorted(number, number, side="right") - 1
    before = np.clip(np.minimum(before, np.maximum(rows - 1, 0)), first, last)
    after = np.clip(np.maximum(after, np.minimum(rows + 1, n - 1)), first, last)
    lost = ~observed
    return np.where(lost, rows, before), np.where(lost, rows, after)


def smallest_turn(angle: Array) -> Array:
    """Angles of any shape, rad, wrapped into (-pi, pi]."""
    return np.asarray(np.pi - (np.pi - angle) % (2.0 * np.pi))
