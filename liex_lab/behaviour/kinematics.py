"""Posture and kinematics per frame, with propagated standard deviations.

Posture: heading = atan2(dy, dx) and pitch = atan2(dz, hypot(dx, dy)) of the body's axis; the bend
is the sum of the signed turning angles at the inner joints (total curvature of the discrete
midline). It is measured in the animal's frontal plane, through its axis and the horizontal, as if
it did not roll. Positive bends are towards the animal's left. Definitions of body bend differ
between publications by a factor of two and more; here it is the whole turn from the direction of
the front bone to that of the rear one.

Rate of v at t: (v(t + h) - v(t - h)) / true time between the two frames, h about `HALF_WINDOW_S`.
It is never taken across a gap nor across the end of a person's exchange of head and tail, and is
one-sided at the ends of an unbroken stretch. This gives speed, acceleration and yaw rate. The
standard deviation is sqrt(s1^2 + s2^2 - 2 r s1 s2) / span with r = exp(-span / `ERROR_LASTS_S`),
the autocorrelation of an Ornstein-Uhlenbeck process: the errors of close frames are correlated. The
joint errors of one frame are treated as one common error (the whole body is displaced), those of
the two ends of a line as independent. Input and output are pandas tables.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from liex_lab.arrays import Array, NDArray
from liex_lab.behaviour.body import BRANCHES, STANDS, SWIMS, BodyAxis
from liex_lab.runtime.memory import Allocator, blocks, in_windows, put
from liex_lab.tables.rows import constant_runs, gap_follows, median_step, stop_times
from liex_lab.tables.schema import table_columns, to_pandas
from liex_lab.tracking.track import Track


def posture(body: BodyAxis, xyz: Array, sd: Array) -> dict[str, Array]:
    """Measures of n single frames; joint errors of one frame are treated as one common error.

    Args:
        body: the roles of the joints.
        xyz: (n, J, 3) joints in the arena frame, mm.
        sd: (n, J) their standard deviation along an axis, mm.

    Returns:
        Columns of the table `kinematics`, (n,); `centre` (n, 3) and `centre_sd` (n,) of the body,
            mm; for a swimming body also `rear_sd`, that of the chain's rear end, mm.
    """
    chain, trunk, (start, stop) = list(body.spine), list(body.trunk), body.axis
    spine = xyz[:, chain]
    axis = xyz[:, stop] - xyz[:, start]
    axis_sd = np.hypot(sd[:, start], sd[:, stop])
    reach = np.hypot(axis[:, 0], axis[:, 1])
    size = np.linalg.norm(axis, axis=1)
    length = np.linalg.norm(np.diff(spine, axis=1), axis=2).sum(axis=1)
    # the unit vectors ahead, to the animal's left (horizontal), and out of its back
    ahead = axis / _positive(size)[:, None]
    left = np.stack([-axis[:, 1], axis[:, 0], np.zeros(len(axis))], axis=1)
    left = left / _positive(reach)[:, None]
    turns = _turns(spine, np.cross(ahead, left))
    found = {
        "centre": xyz[:, trunk].mean(axis=1),
        "centre_sd": sd[:, trunk].mean(axis=1),
        "body_pitch_rad": np.arctan2(axis[:, 2], reach),
        "body_pitch_sd_rad": axis_sd / _positive(size),
        "heading_rad": np.arctan2(axis[:, 1], axis[:, 0]),
        # at most that of an unknown direction (uniform on the circle)
        "heading_sd_rad": np.minimum(axis_sd / _positive(reach), np.pi / np.sqrt(3.0)),
        "length_mm": length,
        "straightness": np.linalg.norm(spine[:, 0] - spine[:, -1], axis=1) / _positive(length),
        "bend_rad": turns.sum(axis=1) if len(chain) > 2 else np.full(len(spine), np.nan),
    }
    if body.kind == STANDS:
        nose, rump = xyz[:, body.front], xyz[:, body.rear]
        found |= {
            "nose_height_mm": nose[:, 2],
            "nose_height_sd_mm": sd[:, body.front],
            "back_height_mm": xyz[:, list(body.back), 2].max(axis=1),
            "nose_over_rump_mm": nose[:, 2] - rump[:, 2],
            "reach_mm": np.hypot(*(nose - rump)[:, :2].T),
        }
    elif body.kind == BRANCHES:
        found["opening"] = np.mean([_stretched(xyz[:, list(limb)]) for limb in body.limbs], axis=0)
    elif body.kind == SWIMS:
        to_rear = spine[:, -1] - spine[:, 0]
        aside = np.einsum("ni,ni->n", to_rear, left)
        third = 3 * np.arange(1, turns.shape[1] + 1) // (turns.shape[1] + 1)
        found |= {
            "tail_mm": aside,
            "tail_angle_rad": np.arctan2(aside, -np.einsum("ni,ni->n", to_rear, ahead)),
            "rear_sd": sd[:, chain[-1]],
        }
        for k, part in enumerate(("front", "middle", "rear")):
            found[f"bend_{part}_rad"] = turns[:, third == k].sum(axis=1)
    return found


def _turns(spine: Array, dorsal: Array) -> Array:
    """(n, K - 2) turn at each inner joint of chains (n, K, 3), front to rear, rad.

    Positive to the left, in the plane perpendicular to the vectors `dorsal` (n, 3) out of the back.
    """
    bones = np.diff(spine, axis=1)
    a, b = bones[:, :-1], bones[:, 1:]
    # the bones point backwards: a chain with its tail on the left turns clockwise to its rear
    across = -np.einsum("nki,ni->nk", np.cross(a, b), dorsal)
    return np.asarray(np.arctan2(across, np.einsum("nki,nki->nk", a, b)))


def _stretched(limb: Array) -> Array:
    """(n,) extension of limbs (n, K, 3): 1 is straight."""
    bones = np.linalg.norm(np.diff(limb, axis=1), axis=2).sum(axis=1)
    return np.asarray(np.linalg.norm(limb[:, -1] - limb[:, 0], axis=1) / bones)


def _positive(values: Array) -> Array:
    """Values to divide by; NaN instead of 0."""
    return np.where(values > 1e-9, values, np.nan)


# Tail-beat analysis of a swimming animal: turning points of the swing, frequency and amplitude.
# Turning points are those of a peak detector with hysteresis (a reversal of at least 5 % of the
# length and 2 sd); their times are refined by the parabola through three samples. Bends and beats
# are counted as in ZebraZoom (Mirat et al. 2013).

SLOWEST_HZ = 1.0  # a slower swing is a turn of the body
# of the frame rate: a faster beat may be an alias of another one
TRUSTED_SHARE = 0.25
_LEAST_SHARE = 0.05  # least swing, of the body's length
_LEAST_SD = 2.0  # least swing, in standard deviations


def tail_beat(
    shape: dict[str, Array], time_s: Array, number: NDArray[np.int64], step_s: float
) -> dict[str, Array]:
    """Bends, frequency and amplitude of the tail's beat within each unbroken stretch.

    A swing lasts from one turning point to the next; frequency = 1 / (2 x its time). A swing slower
    than `SLOWEST_HZ` is left empty, and so are one faster than a quarter of the frame rate
    (`TRUSTED_SHARE`) and its neighbours, because bends may be missing.

    Args:
        shape: the `posture` of n frames of a swimming body.
        time_s: (n,) times of the frames, s.
        number: (n,) unbroken stretch of each frame, see `segments`.
        step_s: the median time between frames, s; 0 gives an empty beat.

    Returns:
        The columns tail_extreme_rad, tail_beat_hz and tail_beat_mm, (n,).
    """
    swing, length = shape["tail_mm"], shape["length_mm"]
    extreme, hz, mm = (np.full(len(swing), np.nan) for _ in range(3))
    out = {"tail_extreme_rad": extreme, "tail_beat_hz": hz, "tail_beat_mm": mm}
    known = np.isfinite(swing)
    if step_s <= 0 or not known.any():
        return out
    noise = np.hypot(shape["rear_sd"], length * shape["heading_sd_rad"])[known]
    typical = float(np.nanmedian(noise)) if np.isfinite(noise).any() else 0.0
    least = max(_LEAST_SHARE * float(np.median(length[known])), _LEAST_SD * typical)
    for start, stop, key in constant_runs(np.where(known, number, -1)):
        if key < 0 or len(rows := start + turning_points(swing[start:stop], least)) < 2:
            continue
        gap = np.diff(time_s[rows])
        near = np.minimum(np.append(np.inf, gap), np.append(gap, np.inf)) < 0.5 / SLOWEST_HZ
        rows = rows[near]  # a lone turning point is in a rest between two bouts
        extreme[rows] = shape["tail_angle_rad"][rows]
        frequency = 0.5 / np.maximum(np.diff(vertex_times(time_s, swing, rows, start, stop)), 1e-9)
        fast = np.pad(frequency > TRUSTED_SHARE / step_s, 1)
        good = (frequency >= SLOWEST_HZ) & ~(fast[1:-1] | fast[:-2] | fast[2:])
        for k in np.flatnonzero(good):
            hz[rows[k] : rows[k + 1]] = frequency[k]
            mm[rows[k] : rows[k + 1]] = 0.5 * abs(swing[rows[k + 1]] - swing[rows[k]])
    return out


def turning_points(values: Array, least: float) -> NDArray[np.int64]:
    """Rows where a series reverses by `least` or more, after a change of at least that size.

    A peak detector with hysteresis: maxima and minima alternate. The first one counts only if the
    series changed by `least` before it.

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
    ):  # only the tail's position before its first swing
        found = found[1:]
    return np.array(found, np.int64)


def vertex_times(
    time_s: Array, values: Array, rows: NDArray[np.int64], start: int, stop: int
) -> Array:
    """Times of turning points, from the parabola through each and its two neighbours.

    Args:
        time_s: (n,) times of the frames, s.
        values: (n,) the series.
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


Rows = NDArray[np.int64]

# Rates.

# distance of the neighbours for the speed at t, as in Live Mouse Tracker at 30 fps
HALF_WINDOW_S = 0.034
IMPOSSIBLE_MM_S = 3000.0  # faster than any mouse: a tracking error
# correlation time of errors; on rendered recordings it is longer, smoothed or not
ERROR_LASTS_S = 0.3
_BLOCK = 16_384  # frames in memory at a time
_AROUND = 4096  # frames on either side that hold the half window at any camera's rate


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
    begins = np.isin(frames["frame_index"].to_numpy(), seams)
    limits = half_window_s, impossible_above_mm_s, surface_z_mm
    measured = measures(joints, frames["time_s"].to_numpy(float), *limits, begins, allocate)
    block: dict[str, Any] = {}
    for name in ("frame_index", "time_s", "dt_s"):
        block[name] = allocate((len(frames),), frames[name].dtype)
        block[name][:] = frames[name].to_numpy()
    block |= {name: str(frames[name].iloc[0]) for name in ("session_id", "individual")}
    kind = BodyAxis.of(joints.names, joints.parents).kind
    return to_pandas(table_columns("kinematics", kind), block | measured, copy=False)


def measures(
    joints: Joints,
    time_s: Array,
    half_window_s: float = HALF_WINDOW_S,
    impossible_above_mm_s: float = IMPOSSIBLE_MM_S,
    surface_z_mm: float | None = None,
    begins: NDArray[np.bool_] | None = None,
    allocate: Allocator = np.empty,
) -> dict[str, Array]:
    """The measured columns of `kinematics`, (n,), by name, and further ones of `posture`.

    Args:
        joints: of n frames.
        time_s: (n,) their times, s.
        half_window_s: as for `kinematics`.
        impossible_above_mm_s: as for `kinematics`.
        surface_z_mm: as for `kinematics`.
        begins: (n,) whether a frame begins a new stretch; None if none does.
        allocate: makes the arrays.
    """
    body = BodyAxis.of(joints.names, joints.parents)
    shape: dict[str, Array] = {}
    for rows in blocks(joints.n_frames, _BLOCK):
        put(shape, rows, posture(body, *joints.at(rows)), joints.n_frames, allocate)
    begins = np.zeros(len(time_s), np.bool_) if begins is None else begins
    observed = np.isfinite(shape["centre"][:, 0])
    before, after = neighbours(time_s, observed, half_window_s, begins, allocate)
    span_s = in_windows(
        len(time_s),
        0,
        lambda at: np.where(after[at] > before[at], time_s[after[at]] - time_s[before[at]], np.nan),
        allocate,
    )
    spans = Spans(before, after, span_s, slice(None))
    hold_s = stop_times(time_s) - time_s
    found = shape | _moving(shape, body.kind, spans, hold_s, impossible_above_mm_s, allocate)
    if body.kind == SWIMS:
        number = segments(time_s, observed, begins)
        surface = np.nan if surface_z_mm is None else surface_z_mm
        found |= tail_beat(shape, time_s, number, median_step(time_s))
        found["below_surface_mm"] = surface - shape["centre"][:, 2]
    return found


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
        # beyond it the body's axis has no reliable direction on the floor
        flat = np.abs(shape["body_pitch_rad"][rows]) < np.radians(75.0)
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
        put(columns, rows, values, len(hold_s), allocate)
    for rows in blocks(len(hold_s), _BLOCK):  # needs the neighbours' values
        here = spans[rows]
        values = {
            "acceleration_mm_s2": here.rate(columns["speed_mm_s"]),
            "acceleration_sd_mm_s2": here.sd(columns["speed_sd_mm_s"]),
            "yaw_rate_rad_s": here.turning(columns["heading_rad"]),
            "yaw_rate_sd_rad_s": here.sd(columns["heading_sd_rad"]),
        }
        put(columns, rows, values, len(hold_s), allocate)
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
            return _apart(list(np.moveaxis(xyz, -1, 0))), part.sd_mm.copy()

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
    allocate: Allocator = np.empty,
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
        allocate: allocator of the result.

    Returns:
        before and after, (n,) int64 rows each.
    """
    number = segments(time_s, observed, begins)
    # at the camera's own rate the next frame is used, despite jitter of its clock
    reach = 0.75 * half_window_s

    def near(window: slice) -> Rows:
        """The two rows (m, 2) of some frames."""
        time, stretch = time_s[window], number[window]
        rows = np.arange(len(time))
        before = np.searchsorted(time, time - reach, side="right") - 1
        after = np.searchsorted(time, time + reach, side="left")
        first = np.searchsorted(stretch, stretch, side="left")
        last = np.searchsorted(stretch, stretch, side="right") - 1
        before = np.clip(np.minimum(before, np.maximum(rows - 1, 0)), first, last)
        after = np.clip(np.maximum(after, np.minimum(rows + 1, len(rows) - 1)), first, last)
        found = np.where(observed[window], [before, after], rows)
        return np.asarray(window.start + found.T)

    before, after = in_windows(len(time_s), _AROUND, near, allocate).T
    return before, after


def smallest_turn(angle: Array) -> Array:
    """Angles of any shape, rad, wrapped into (-pi, pi]."""
    return np.asarray(np.pi - (np.pi - angle) % (2.0 * np.pi))
