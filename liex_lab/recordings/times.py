"""Time stamps: read as written, exact to the nanosecond, and made to increase without hiding that they did not."""

from __future__ import annotations

import csv
from bisect import bisect_right
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from liex_lab.errors import RecordingError

Times = NDArray[np.int64]

GAP_FACTOR = 1.5  # a step longer than this many median steps means that frames are missing
CSV_COLUMNS = {"time_ns": 1, "time_ms": 10**6, "time_s": 10**9}  # column of timestamps.csv: nanoseconds per unit
_LIMIT_NS = 2**62  # the year 2116 on the usual clock; leaves room for sums in int64
_PLAUSIBLE_START_NS = 946_684_800 * 10**9  # the year 2000: earlier stamps count from something else than 1970


@dataclass(frozen=True)
class Gap:
    """Frames that the camera did not deliver.

    Half open, like every interval here: start_frame = stop_frame = the frame after the gap, for no frame lies inside;
    from start_ns, one median step after the last frame before, to stop_ns, the time of the frame after.
    """

    start_frame: int
    stop_frame: int
    start_ns: int
    stop_ns: int
    n_frames_missing: int
    reason: str = "camera_dropped"


def median_step(times_ns: Times) -> int:
    """The median time between neighbouring frames, ns; 0 for fewer than two frames."""
    return int(np.median(np.diff(times_ns))) if len(times_ns) > 1 else 0


def find_gaps(times_ns: Times, step_ns: int) -> list[Gap]:
    """The places where more than 1.5 steps of `step_ns` lie between two frames."""
    if step_ns <= 0:
        return []
    dt = np.diff(times_ns)
    return [
        Gap(
            start_frame=int(i) + 1,
            stop_frame=int(i) + 1,
            start_ns=int(times_ns[i]) + step_ns,
            stop_ns=int(times_ns[i + 1]),
            n_frames_missing=round(int(dt[i]) / step_ns) - 1,
        )
        for i in np.flatnonzero(dt > GAP_FACTOR * step_ns)
    ]


def from_rate(n_frames: int, fps: float) -> Times:
    """Evenly spaced stamps from 0, ns: the last resort, where a file holds no clock."""
    return np.round(np.arange(n_frames) * (1e9 / fps)).astype(np.int64)


def increasing(times_ns: Times) -> tuple[Times, str | None]:
    """The stamps made strictly increasing, frames in file order, and a sentence about what was moved, if anything.

    The most stamps that can stay do stay, exactly (the longest chain that increases), so that one wild stamp does not
    drag its neighbours along; each of the others moves to the nearest nanosecond that fits between those that stay.
    """
    if np.all(np.diff(times_ns) > 0):
        return times_ns, None
    # Integers that must increase by at least 1 are integers minus their rank that must not decrease.
    rank = np.arange(len(times_ns), dtype=np.int64)
    slack = times_ns - rank
    keep = _longest_nondecreasing(slack.tolist())
    settled, ceiling = slack.copy(), _next_kept(slack, keep)
    for i in np.flatnonzero(~np.isin(rank, keep)):
        floor = int(settled[i - 1]) if i else ceiling[0]
        settled[i] = min(max(int(slack[i]), floor), ceiling[i])
    moved = settled != slack
    largest_ms = float(np.abs(settled - slack).max()) / 1e6
    return settled + rank, (
        f"time stamps do not increase: {int(moved.sum())} of {len(times_ns)} are repeated or out of order; "
        f"frames were kept in file order and these stamps moved as little as possible, at most {largest_ms:.3f} ms"
    )


def _longest_nondecreasing(values: list[int]) -> NDArray[np.int64]:
    """Indices of a longest non-decreasing subsequence, by patience sorting."""
    tops: list[int] = []
    top_index: list[int] = []
    before = np.full(len(values), -1, np.int64)
    for i, value in enumerate(values):
        pile = bisect_right(tops, value)
        before[i] = top_index[pile - 1] if pile else -1
        if pile == len(tops):
            tops.append(value)
            top_index.append(i)
        else:
            tops[pile], top_index[pile] = value, i
    chain, i = [], top_index[-1]
    while i >= 0:
        chain.append(i)
        i = int(before[i])
    return np.array(chain[::-1], np.int64)


def _next_kept(slack: Times, keep: NDArray[np.int64]) -> list[int]:
    """For every index the value of the next kept stamp at or after it; the limit after the last."""
    position = np.searchsorted(keep, np.arange(len(slack)))
    values = np.append(slack[keep], _LIMIT_NS)
    return [int(v) for v in values[position]]


def to_ns(text: str, ns_per_unit: int) -> int:
    """A decimal number as integer nanoseconds, exactly: a float64 of seconds since 1970 is good to 200 ns only."""
    value = Decimal(text.strip()) * ns_per_unit
    if not value.is_finite() or abs(value) >= _LIMIT_NS:
        raise InvalidOperation(f"{text} is not a time")
    return int(value.to_integral_value())


def read_csv_times(path: Path) -> Times:
    """The stamps of a timestamps.csv with a header that names a column time_ns, time_ms or time_s."""
    lines = _lines(path)
    delimiter = next((d for d in ",;\t" if d in lines[0]), ",") if lines else ","
    rows = list(csv.reader(lines, delimiter=delimiter))
    header = [name.strip().strip('"') for name in rows[0]] if rows else []
    column = next((name for name in CSV_COLUMNS if name in header), None)
    if column is None:
        raise RecordingError(
            f"{path} should begin with a line that names a column time_ns or time_s, but its first line is "
            f"{_shorten(lines[0]) if lines else 'missing'!r}; add that header line"
        )
    place = header.index(column)
    cells = [(number, row[place] if place < len(row) else "") for number, row in enumerate(rows[1:], start=2) if row]
    return _parse(path, cells, CSV_COLUMNS[column])


def read_column_times(path: Path, ns_per_unit: int) -> Times:
    """The stamps in column 0 of a file of numbers parted by blanks or commas; a header line is passed over."""
    rows = [(number, line.replace(",", " ").split()) for number, line in enumerate(_lines(path), start=1)]
    cells = [(number, row[0]) for number, row in rows if row]
    if cells and not _is_number(cells[0][1]):
        cells = cells[1:]
    return _parse(path, cells, ns_per_unit)


def _lines(path: Path) -> list[str]:
    try:
        return path.read_text(encoding="utf-8-sig").splitlines()
    except UnicodeDecodeError:
        raise RecordingError(f"{path} should be a text file with one time stamp per line, but it is not text") from None


def _is_number(text: str) -> bool:
    try:
        return Decimal(text).is_finite()
    except InvalidOperation:
        return False


def _parse(path: Path, cells: list[tuple[int, str]], ns_per_unit: int) -> Times:
    times = np.empty(len(cells), np.int64)
    for i, (number, text) in enumerate(cells):
        try:
            times[i] = to_ns(text, ns_per_unit)
        except InvalidOperation:
            raise RecordingError(
                f"{path} holds {_shorten(text)!r} on line {number} where a time stamp was expected; "
                "correct or remove that line"
            ) from None
    return times


def _shorten(text: str) -> str:
    return text if len(text) <= 60 else text[:57] + "..."


def match_counts(n_frames: int, times_ns: Times, frames_from: str, times_from: str) -> tuple[int, str | None]:
    """How many frames have both a picture and a stamp, and a sentence with both numbers when they differ."""
    if n_frames == len(times_ns):
        return n_frames, None
    n = min(n_frames, len(times_ns))
    return n, (
        f"{frames_from} holds {n_frames} frames but {times_from} holds {len(times_ns)} time stamps; "
        f"the first {n} of both are used"
    )


def start_of_day(stated: str | datetime | None) -> str | None:
    """A stated start as ISO 8601 with zone; None where there is none or it has no zone, for then it says no moment."""
    if isinstance(stated, str):
        try:
            stated = datetime.fromisoformat(stated)
        except ValueError:
            return None
    return stated.isoformat() if isinstance(stated, datetime) and stated.tzinfo is not None else None


def start_of_clock(first_ns: int) -> str | None:
    """The moment of a stamp that counts from 1970 (UTC), ISO 8601; None where it plainly counts from something else."""
    if first_ns < _PLAUSIBLE_START_NS:
        return None
    return (
        datetime.fromtimestamp(first_ns // 10**9, UTC) + timedelta(microseconds=first_ns % 10**9 // 1000)
    ).isoformat()
