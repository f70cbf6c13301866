"""Monotone time stamps with the fewest changes, by a longest increasing subsequence.

Stamps are int64 ns. The stamps that stay unchanged form a longest increasing subsequence (patience
sorting, O(n log n)); the others are spread evenly between their unchanged neighbours. For integers,
strict increase of t[i] is the same as t[i] - i not decreasing, so the longest non-decreasing
subsequence of t[i] - i is used. Lasting backward jumps of the clock are removed first. A gap is a
step of more than 1.5 median steps. Every moved stamp is reported.
"""

import re
from bisect import bisect_right
from contextlib import suppress
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime, timedelta

import numpy as np
from numpy.typing import NDArray

from liex_lab.runtime.memory import in_windows

Times = NDArray[np.int64]

GAP_FACTOR = 1.5  # a step longer than this many median steps means that frames are missing
# stamps are rounded if their unit exceeds this share of the usual step, or if this share of the
# steps differs from a multiple of it by this much
_OFTEN = 0.05
_LEAST = 0.8  # least share of the mean step for a real clock; less comes from stamps without one
_LONGER = (3, 16, 64, 256)  # frames missing in gaps, short ones first, as they define the step
_FAR = 3  # steps; the clock's phase may change across more of them
CLOCK_JUMP_NS = (
    60 * 10**9
)  # no camera drops frames for a minute: it was stopped, or its clock was set
# frames on either side that distinguish a lasting jump from a few stamps out of order
_SURE = 5
LIMIT_NS = 2**62  # the year 2116 on the usual clock; leaves room for sums in int64
# the years 2000 to 2100: other stamps do not count from 1970
PLAUSIBLE_NS = (946_684_800 * 10**9, 4_102_444_800 * 10**9)
_NEAR = 8  # frames on either side within which frames are sorted
_CLOSEST = 0.6  # steps between two of them
_MOST_LOST = 8

DROPPED = "camera_dropped"
JUMPED = "clock_jumped"
PULSES_UNKNOWN = (
    "the camera was stopped or its clock set: how many pulses are missing there is unknown, and "
    "pulse_index is a guess from there on"
)


@dataclass(frozen=True)
class Gap:
    """An interval in which the time stamps are not those of a steady camera.

    Intervals are half open. For frames that the camera did not deliver, start_frame = stop_frame =
    the frame after the gap, as no frame is inside; the time runs from one median step after the
    last frame before the gap to the frame after it. For a moved stamp, the interval contains its
    one frame, and n_frames_missing = 0.

    Attributes:
        start_frame: row of the first frame of the interval.
        stop_frame: row after its last frame.
        start_ns: beginning of the interval, ns.
        stop_ns: its end, ns.
        n_frames_missing: number of dropped frames, estimated from the mean step.
        reason: `DROPPED`, or one of `FAULTS`.
    """

    start_frame: int
    stop_frame: int
    start_ns: int
    stop_ns: int
    n_frames_missing: int
    reason: str = DROPPED


PLAUSIBLE_HZ = (0.5, 2000.0)  # of a depth camera that watches an animal
FAULTS = ("", "stamp_repeated", "stamp_out_of_order", JUMPED)  # indexed by `MonotoneTimes.faults`
# their indices
_REPEATED, _OUT_OF_ORDER, _JUMPED = range(1, len(FAULTS))


@dataclass(frozen=True)
class MonotoneTimes:
    """Time stamps made strictly increasing.

    Attributes:
        times_ns: (n,) int64 ns, strictly increasing.
        faults: (n,) uint8 index into `FAULTS`: why this frame's stamp was moved; 0 if it was not.
        problem: a sentence about the moved stamps; None if none was moved.
        order: (n,) number, in file order, of the frame of each row; empty for 0 ... n - 1.
    """

    times_ns: Times
    faults: NDArray[np.uint8]
    problem: str | None
    order: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))


def median_step(times_ns: Times) -> int:
    """Usual time between neighbouring frames: the median step, or the mean for rounded stamps.

    Args:
        times_ns: (n,) int64 stamps, ns.

    Returns:
        The step, ns; 0 for fewer than two frames.
    """
    if len(times_ns) < 2:
        return 0
    return rounded_step(times_ns) or int(np.median(np.diff(times_ns)))


def rounded_step(times_ns: Times) -> int:
    """Step of a steady clock whose stamps are rounded or jitter, such as 33, 33, 34 ms.

    No single step is then the camera's. The step is the total time divided by the number of steps,
    with steps across a gap counted by `frames_apart`.

    Args:
        times_ns: (n,) int64 stamps, ns.

    Returns:
        The step, ns; 0 if the stamps are as exact as their median step, or no step is found.
    """
    dt = np.diff(times_ns)
    usual = int(np.median(dt)) if len(dt) else 0
    if usual <= 0:
        return 0
    unit = int(np.gcd.reduce(dt))
    if unit > 1e-3 * usual:
        # lost frames with exact stamps also give multiples of the step
        # of coarse clocks, near a camera's step
        rounded = unit <= usual / 2 or unit in (1_000_000, 15_625_000)
    else:
        off = in_windows(
            len(dt), 0, lambda at: np.abs(dt[at] / usual - np.rint(dt[at] / usual)) > 0.1
        )
        rounded = bool(off.mean() > _OFTEN)
    if not rounded:
        return 0
    # at most one frame is missing in such a step
    step = first = float(dt[dt <= 2.25 * usual].mean())
    for window in (2, 4, 8, 16):
        apart = _in_phase(times_ns, step, window)
        near = apart <= _FAR
        step = float(dt[near].sum() / apart[near].sum())
    for longest in _LONGER:
        step = _slope(dt, _in_phase(times_ns, step, 16), longest, step)
    return round(step) if step > _LEAST * first else 0


def _slope(dt: Times, apart: Times, longest: int, otherwise: float) -> float:
    """Time per frame, ns: the slope of a line fitted to the stretches without a longer gap.

    Args:
        dt: (n,) steps, ns.
        apart: (n,) number of frames per step.
        longest: a step of more frames starts a new stretch.
        otherwise: the result if the slope differs much from it, as without two frames in a stretch.
    """
    stretch = np.append(0, np.cumsum(apart > longest))
    count, time = (
        values - (np.bincount(stretch, values) / np.bincount(stretch))[stretch]
        for values in (np.cumsum(np.append(0.0, apart)), np.cumsum(np.append(0.0, dt)))
    )
    found = float(count @ time) / max(float(count @ count), 1e-9)
    return found if abs(found - otherwise) < 0.1 * otherwise else otherwise


def _in_phase(times_ns: Times, step_ns: float, window: int) -> Times:
    """Number of clock steps (n - 1,), at least 1, between neighbouring stamps (n,) ns.

    A stamp is off by up to half its rounding unit. The clock's phase, the circular mean over
    `window` frames before and after a step, is not, and corrects for the rounding.
    """
    return in_windows(
        len(times_ns) - 1,
        window + 1,
        lambda steps: _in_phase_within(times_ns[steps.start : steps.stop + 1], step_ns, window),
    )


def _in_phase_within(times_ns: Times, step_ns: float, window: int) -> Times:
    """`_in_phase` of few stamps."""
    phase = (times_ns - times_ns[0]) / step_ns
    apart = np.diff(phase)
    stretch = np.append(0, np.cumsum(apart > _FAR))
    first, stop = (np.searchsorted(stretch, stretch, side) for side in ("left", "right"))
    total = np.append(0.0, np.cumsum(np.exp(2j * np.pi * phase)))
    row = np.arange(1, len(phase))
    before = total[row] - total[np.maximum(row - window, first[:-1])]
    after = total[np.minimum(row + window, stop[1:])] - total[row]
    off = [
        np.angle(np.exp(2j * np.pi * at) * mean.conj()) / (2.0 * np.pi)
        for at, mean in ((phase[:-1], before), (phase[1:], after))
    ]
    return np.maximum(1, np.rint(apart + off[0] - off[1])).astype(np.int64)


def frames_apart(times_ns: Times, step_ns: int) -> Times:
    """Number of frames (n - 1,) from each stamp to the next: more than 1 across a gap.

    Args:
        times_ns: (n,) int64 stamps, ns, increasing.
        step_ns: the usual step, ns, above 0.
    """
    if rounded_step(times_ns):
        return _in_phase(times_ns, step_ns, 16)
    dt = np.diff(times_ns)
    # the median of jittering steps is off by 1 %, which is refined with longer and longer gaps
    period = float(step_ns)
    long = dt > GAP_FACTOR * step_ns
    apart = np.ones(len(dt), np.int64)
    for longest in (1, *_LONGER) if long.any() else ():
        apart[long] = np.maximum(2, np.rint(dt[long] / period))
        period = _slope(dt, apart, longest, period)
    return apart


def clock_doubts(step_ns: int, faults: NDArray[np.uint8]) -> tuple[str, ...]:
    """Reasons why the times of a recording are unreliable.

    Args:
        step_ns: the median step, ns; 0 if absent.
        faults: (n,) uint8 index into `FAULTS`, as in `MonotoneTimes.faults`.

    Returns:
        Sentences; empty for a plausible camera clock.
    """
    found = []
    hz = 1e9 / max(step_ns, 1)
    if step_ns > 0 and not PLAUSIBLE_HZ[0] <= hz <= PLAUSIBLE_HZ[1]:
        found.append(
            f"by its time stamps the camera made {hz:,.{0 if hz > 10 else 3}f} frames/s: they are "
            "in another unit than stated, and speeds and durations are wrong by that"
        )
    n_moved = int(np.isin(faults, (_REPEATED, _OUT_OF_ORDER)).sum())
    # most stamps repeated or out of order, as on a busy computer
    if n_moved > 0.25 * len(faults):
        found.append(
            f"{n_moved} of {len(faults)} time stamps are repeated or out of order: times are "
            "guesses, and speeds with them"
        )
    return tuple(found)


def find_gaps(times_ns: Times, step_ns: int) -> list[Gap]:
    """Intervals in which frames are missing: steps of more than 1.5 median steps.

    A step of more than a minute means that the camera was stopped or its clock set. The number of
    missing frames is then unknown, and counted as one.

    Args:
        times_ns: (n,) int64 stamps, ns, increasing.
        step_ns: the median step, ns; 0 finds nothing.

    Returns:
        The gaps in order of time, with the reason `DROPPED` or `JUMPED`.
    """
    if step_ns <= 0:
        return []
    apart = frames_apart(times_ns, step_ns)
    jumped = np.diff(times_ns) > CLOCK_JUMP_NS
    return [
        Gap(
            start_frame=i + 1,
            stop_frame=i + 1,
            start_ns=int(times_ns[i]) + step_ns,
            stop_ns=int(times_ns[i + 1]),
            n_frames_missing=1 if jumped[i] else int(apart[i]) - 1,
            reason=JUMPED if jumped[i] else DROPPED,
        )
        for i in np.flatnonzero(apart > 1).tolist()
    ]


def find_faults(times_ns: Times, step_ns: int, faults: NDArray[np.uint8]) -> list[Gap]:
    """The frames whose stamps were moved, each as an interval of its own.

    Args:
        times_ns: (n,) int64 stamps, ns, made strictly increasing.
        step_ns: the median step, ns, for the end of the last frame.
        faults: (n,) uint8 index into `FAULTS`, as in `MonotoneTimes.faults`.

    Returns:
        One interval per frame with a fault, in order.
    """
    stops = np.append(times_ns[1:], times_ns[-1:] + max(step_ns, 1))
    return [
        Gap(int(i), int(i) + 1, int(times_ns[i]), int(stops[i]), 0, FAULTS[faults[i]])
        for i in np.flatnonzero(faults)
    ]


def from_rate(n_frames: int | Times, fps: float) -> Times:
    """Evenly spaced stamps from 0, for files without a clock.

    Args:
        n_frames: number of stamps, or (n,) the index of each frame among those that the camera
            recorded, see `frame_counts`.
        fps: frame rate, Hz.

    Returns:
        (n,) int64 ns.
    """
    places = np.arange(n_frames) if isinstance(n_frames, int) else n_frames
    return np.round(places * (1e9 / fps)).astype(np.int64)


def frame_counts(numbers: Times, step: int | None = None) -> Times | None:
    """Number of frames from the first to each one, if the numbers count frames.

    They do if almost all steps are equal and the others are multiples of it. A counter of 8, 16 or
    32 bits may wrap around. Any other restart loses an unknown number of frames, counted as none.

    Args:
        numbers: (n,) int64.
        step: the required step; None for any.

    Returns:
        (n,) int64 from 0; None if the numbers do not count frames.
    """
    steps = np.diff(numbers)
    sizes, often = np.unique(steps, return_counts=True)
    # least share of equal steps in a counter
    if len(steps) < 2 or often.max() < 0.75 * len(steps):
        return None
    usual = int(sizes[often.argmax()])
    if usual <= 0 or step not in (None, usual):
        return None
    wrap = next(size for size in (1 << 8, 1 << 16, 1 << 32, 1 << 62) if numbers.max() < size)
    wrapped = (steps < 0) & (steps + wrap <= max(wrap >> 5, usual))
    lost = (steps < 0) | (steps > usual << 24)
    steps = np.where(wrapped, steps + wrap, np.where(lost, usual, steps))
    return None if (steps % usual).any() else np.append(0, np.cumsum(steps // usual))


def in_order_of_sensor(times_ns: Times, settled: NDArray[np.int64] | None = None) -> MonotoneTimes:
    """Make stamps strictly increasing, after sorting frames recorded in the wrong order.

    Frames are sorted only where that is safe: a few neighbours whose sorted stamps are spaced like
    a camera's, no two closer than `_CLOSEST` steps and none farther than `_MOST_LOST`. Repeated and
    wild stamps, and those after a clock was set back, are left to `make_monotone`.

    Args:
        times_ns: (n,) int64 stamps, ns, in file order.
        settled: (m,) order of the first frames that have been read already; None if absent.

    Returns:
        The stamps in the order of the rows, that order, and a sentence about what was sorted.
    """
    joined, _ = _join_clocks(times_ns)
    rows = np.arange(len(times_ns))
    order = rows.copy() if settled is None else np.r_[settled, rows[len(settled) :]]
    n_settled = 0 if settled is None else len(settled)
    step = median_step(np.sort(joined))
    for at in (n_settled + np.flatnonzero(np.diff(joined[n_settled:]) < 0)).tolist():
        low, high = max(n_settled, at - _NEAR), min(len(rows), at + _NEAR + 2)
        new = order[low:high][np.argsort(joined[order[low:high]], kind="stable")]
        steps = np.diff(joined[new])
        inside = low == n_settled or new[0] == order[low]
        inside &= high == len(rows) or new[-1] == order[high - 1]
        if inside and _CLOSEST * step <= steps.min() and steps.max() <= _MOST_LOST * step:
            order[low:high] = new
    found = make_monotone(times_ns[order])
    if not (n := int((order != rows).sum())):
        return replace(found, order=order)
    n_pairs = int(((order[:-1] == rows[1:]) & (order[1:] == rows[:-1])).sum())
    sentence = f"{n_pairs} pair{'s' * (n > 2)}" if n == 2 * n_pairs else f"{n} frames"
    sentence += " were recorded in the wrong order, and were sorted by the sensor's time stamps"
    problem = sentence if found.problem is None else f"{sentence}; {found.problem}"
    return replace(found, order=order, problem=problem)


def make_monotone(times_ns: Times) -> MonotoneTimes:
    """Make stamps strictly increasing by moving as few as possible; frames stay in file order.

    If a clock was set back, or wrapped around, while frames continued, time continues as if one
    frame were missing there; the true length of the jump is unknown. Of the rest, as many stamps as
    possible stay exact (a longest increasing subsequence), so that one wild stamp does not move its
    neighbours. The others are spread evenly between those, as from a camera at a constant rate.

    Args:
        times_ns: (n,) int64 stamps, ns, in file order.

    Returns:
        The stamps, which of them were moved and why, and a sentence about it.
    """
    if np.all(np.diff(times_ns) > 0):
        return MonotoneTimes(times_ns, np.zeros(len(times_ns), np.uint8), None)
    joined, jumps = _join_clocks(times_ns)
    times = _fewest_moved(joined)
    moved = times != joined
    faults = np.where(
        moved, np.where(np.abs(times - joined) > CLOCK_JUMP_NS, _JUMPED, _OUT_OF_ORDER), 0
    )
    same = times_ns[1:] == times_ns[:-1]
    faults[moved & (np.append(same, False) | np.append(False, same))] = _REPEATED
    faults[jumps] = _JUMPED
    sentences = []
    if len(jumps):
        first = int(jumps[0])
        back_s = float(times_ns[first - 1] - times_ns[first]) / 1e9
        sentences.append(
            f"the clock jumps back in {len(jumps)} places, the first by {back_s:.3f} s at frame "
            f"{first}; time was taken to go on there as after one missing frame"
        )
    if moved.any():
        largest_ms = float(np.abs(times - joined).max()) / 1e6
        sentences.append(
            f"time stamps do not increase: {int(moved.sum())} of {len(times)} are repeated or out "
            "of order; frames were kept in file order and these stamps spread between their "
            f"neighbours, moved by {largest_ms:.3f} ms at most"
        )
    return MonotoneTimes(times, faults.astype(np.uint8), "; ".join(sentences))


def _join_clocks(times_ns: Times) -> tuple[Times, NDArray[np.int64]]:
    """Remove every lasting backward jump from the stamps.

    A jump is lasting if `_SURE` stamps before it increase, and `_SURE` from it on increase without
    reaching the one before it. Shorter jumps are frames out of order, or one wild stamp.

    Args:
        times_ns: (n,) int64 stamps, ns.

    Returns:
        The joined stamps (n,), ns, and the frames (k,) at which the clock jumps.
    """
    dt = np.diff(times_ns)
    back = np.flatnonzero(dt <= 0) + 1
    rising = np.concatenate([[0], np.cumsum(dt > 0)])  # number of increasing steps up to a frame
    jumps = [
        int(i)
        for i in back
        if i >= _SURE
        and i + _SURE <= len(times_ns)
        and rising[i - 1] - rising[i - _SURE] == _SURE - 1
        and rising[i + _SURE - 1] - rising[i] == _SURE - 1
        and times_ns[i + _SURE - 1] < times_ns[i - 1]
    ]
    step = max(1, int(np.median(dt[dt > 0]))) if jumps else 1
    shifts = [int(times_ns[i - 1]) - int(times_ns[i]) + 2 * step for i in jumps]
    if sum(shifts) + int(np.abs(times_ns).max()) >= LIMIT_NS:  # noise, not clocks
        return times_ns, np.array([], np.int64)
    steps = np.zeros(len(times_ns), np.int64)
    steps[jumps] = shifts
    return times_ns + np.cumsum(steps), np.array(jumps, np.int64)


def unwritable_times(times_ns: Times) -> str:
    """Why stamps (n,) ns cannot be written into a session; "" if they can."""
    # until the year 2106, the limit of the replay's messages
    if not len(times_ns) or (times_ns.min() >= 0 and times_ns.max() < 2**32 * 10**9):
        return ""
    return (
        f"the time stamps go from {times_ns.min() * 1e-9:.6g} s to {times_ns.max() * 1e-9:.6g} s, "
        "and a session takes those from 0 s (the year 1970) to 4294967295 s (2106); shift them, so "
        "that the first one is 0 or a date"
    )


def _fewest_moved(times_ns: Times) -> Times:
    """Make stamps strictly increasing by moving as few as possible.

    The moved stamps are spread evenly between the others.
    """
    # Integers increase strictly if and only if integers minus their rank do not
    # decrease.
    slack = times_ns - np.arange(len(times_ns), dtype=np.int64)
    keep = _first_of_equal(times_ns, slack, _longest_nondecreasing(slack.tolist()))
    monotone = times_ns.copy()
    kept = times_ns[keep]
    step = min(median_step(kept) or 1, (10**9))
    monotone[: keep[0]] = int(kept[0]) - step * np.arange(int(keep[0]), 0, -1)
    monotone[keep[-1] + 1 :] = int(kept[-1]) + step * np.arange(1, len(times_ns) - int(keep[-1]))
    for n in np.flatnonzero(np.diff(keep) > 1):
        i, j = keep[n : n + 2].tolist()
        start, stop = kept[n : n + 2].tolist()
        monotone[i:j] = [start + (stop - start) * k // (j - i) for k in range(j - i)]
    return monotone


def _first_of_equal(times_ns: Times, slack: Times, keep: NDArray[np.int64]) -> NDArray[np.int64]:
    """Keep the first of equal stamps instead of a later one, as repeats are stale."""
    chosen = keep.copy()
    starts = np.append(True, np.diff(times_ns) != 0)
    run = np.maximum.accumulate(np.where(starts, np.arange(len(times_ns)), 0))
    for n, k in enumerate(keep.tolist()):
        first = max(run[k], chosen[n - 1] + 1 if n else 0)
        if n + 1 == len(keep) or slack[keep[n + 1]] >= slack[first]:
            chosen[n] = first
    return chosen


def _longest_nondecreasing(values: list[int]) -> NDArray[np.int64]:
    """Indices of a longest non-decreasing subsequence, by patience sorting."""
    tops: list[int] = []
    top_index: list[int] = []
    before = []
    for i, value in enumerate(values):
        pile = bisect_right(tops, value)
        before.append(top_index[pile - 1] if pile else -1)
        tops[pile : pile + 1] = [value]  # a new top, or a new pile after the last
        top_index[pile : pile + 1] = [i]
    chain = top_index[-1:]
    while before[chain[-1]] >= 0:
        chain.append(before[chain[-1]])
    return np.array(chain[::-1], np.int64)


def match_counts(n_frames: int, n_stamps: int, frames_from: str, times_from: str) -> list[str]:
    """The sentence about unequal numbers of frames and stamps; empty if they are equal.

    Args:
        n_frames: number of images.
        n_stamps: number of stamps.
        frames_from: name of the file or folder of the images.
        times_from: name of the file of the stamps.
    """
    if n_frames == n_stamps:
        return []
    more = n_stamps - n_frames
    cause = (
        f"; recorders that wait for the infrared image, such as orbbec-acquire, drop the depth "
        f"image without one and keep its stamp, so times may be early by up to {more} frames: "
        "record depth alone, or with `liex record`"
        if more > 0
        else ""
    )
    return [
        f"{frames_from} holds {n_frames} frames but {times_from} holds {n_stamps} time "
        f"stamps; the first {min(n_frames, n_stamps)} of both are used{cause}"
    ]


def unpaired(frames_from: str, times_from: str) -> str:
    """The doubt about frames and stamps that were paired in order although their numbers differ.

    Args:
        frames_from: name of the file or folder of the depth images.
        times_from: name of the file of the stamps.
    """
    return (
        f"{frames_from} and {times_from} do not hold equally many frames, and the missing "
        "ones are unknown: times may be wrong by these"
    )


def start_of_day(stated: object) -> str | None:
    """A stated start of the recording as ISO 8601 with zone.

    Args:
        stated: ISO 8601 text or a datetime; anything else is ignored.

    Returns:
        The start; None if absent or without a time zone.
    """
    with suppress(ValueError):
        moment = stated if isinstance(stated, datetime) else read_moment(str(stated))[0]
        return moment.isoformat() if moment.tzinfo is not None else None
    return None


def read_moment(text: str) -> tuple[datetime, int]:
    """Parse an ISO 8601 date and time of day, with or without a zone.

    Args:
        text: such as 2024-10-27T02:59:59.1234567+02:00.

    Returns:
        The date and time, to the microsecond, and exactly as ns since 1970; UTC is assumed without
        a zone.

    Raises:
        ValueError: it is not a date and time.
    """
    if len(text.strip()) <= len("2024-10-27"):
        raise ValueError(f"{text!r} has no time of day")
    moment = datetime.fromisoformat(re.sub(" (?=[z+-])", "", text.strip(), flags=re.I).upper())
    fraction = re.search(r"[.,](\d+)", text)  # datetime keeps six digits
    ns = int(fraction[1][:9].ljust(9, "0")) if fraction else 0
    since_1970 = moment.replace(tzinfo=moment.tzinfo or UTC) - datetime(1970, 1, 1, tzinfo=UTC)
    return moment, since_1970 // timedelta(seconds=1) * 10**9 + ns


def start_of_clock(first_ns: int) -> str | None:
    """A stamp in ns since 1970 (UTC) as ISO 8601, to the microsecond; None if it is before 2000.

    An earlier stamp counts from something other than 1970.
    """
    if first_ns < PLAUSIBLE_NS[0]:
        return None
    return (
        datetime.fromtimestamp(first_ns // 10**9, UTC)
        + timedelta(microseconds=first_ns % 10**9 // 1000)
    ).isoformat()
