"""Text formats of time stamps: tables, and stamps or numbers in the names of depth images.

A stamp is read as a decimal number and becomes integer nanoseconds exactly; a float64 of seconds
since 1970 is good to 200 ns only. Stamps may also be dates (ISO 8601) or hh:mm:ss. Names hold a
date and time, seconds since 1970 with a fraction (as in the TUM RGB-D data sets), or 13, 16 or 19
digits of ms, µs or ns since 1970.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from decimal import Decimal
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from liex_lab.errors import RecordingError, UnknownTimesError
from liex_lab.recordings.timestamps import (
    LIMIT_NS,
    PLAUSIBLE_HZ,
    Times,
    frame_counts,
    from_rate,
    match_counts,
    read_moment,
    unpaired,
)
from liex_lab.runtime.text_files import clock_s, number, read_text, split_cells, split_lines

UNITS = {"ns": 1, "us": 10**3, "ms": 10**6, "s": 10**9}  # nanoseconds in each
CSV_COLUMNS = {f"time_{unit}": ns for unit, ns in UNITS.items()}  # columns that name their unit

_DATE = re.compile(
    r"(?<!\d)(20\d\d)-?(\d\d)-?(\d\d)[T_-](\d\d)[-:]?(\d\d)[-:]?(\d\d)[._](\d{3,9})(?!\d)"
)
_SECONDS = re.compile(
    r"(?<!\d)(\d{9,10})\.(\d{3,9})(?!\d)"
)  # since 1970, as the TUM data sets name their pictures
_WHOLE = re.compile(
    r"(?<!\d)(\d{13}|\d{16}|\d{19})(?!\d)"
)  # ms, us or ns since 1970, told apart by their length
_PLAUSIBLE_NS = (946_684_800 * 10**9, 4_102_444_800 * 10**9)  # the years 2000 to 2100
_CLOCKS = (  # nanoseconds in a step, the step of 1970, and what that is called
    (10**9, 0, "seconds since 1970"),
    (10**6, 0, "milliseconds since 1970"),
    (10**3, 0, "microseconds since 1970"),
    (100, 0, "steps of 100 ns since 1970"),
    (1, 0, "nanoseconds since 1970"),
    (100, 116_444_736 * 10**9, "steps of 100 ns since 1601, as Windows counts"),
    (100, 621_355_968 * 10**9, "steps of 100 ns since the year 1, as .NET counts"),
)
_HOUR_NS = 3600 * 10**9
_BLANK = re.compile(r"(\d{4}-\d\d-\d\d) +(?=\d\d:)")  # between date and time
_WHOLE_PART = re.compile(r"[-+]?\d+|.*\d\d:\d\d:\d\d")
_FRACTION = re.compile(r"(\d+)(Z|[+-]\d\d:?\d\d)?")
_GROUPED = re.compile(r"([-+]?[1-9]\d{0,2})[.,](\d{3})")  # a number, or thousands


@dataclass(frozen=True)
class Stamps:
    """A table of time stamps.

    Attributes:
        path: the file.
        times_ns: (n,) int64 stamps, ns, in file order; None where the table states no time.
        counts: (n,) frames behind the first, where the column chosen for the times counts frames.
        columns: cells of the other columns, (n,) each.
        zoned: False where stamps are dates without a time zone.
    """

    path: Path
    times_ns: Times | None
    counts: Times | None
    columns: tuple[list[str], ...] = ()
    zoned: bool = True

    def __len__(self) -> int:
        """The number of rows."""
        known = self.counts if self.times_ns is None else self.times_ns
        return 0 if known is None else len(known)

    def rows_of(
        self,
        folder: str,
        names: Sequence[str],
        numbers: Times | None,
        problems: list[str],
        doubts: list[str],
    ) -> NDArray[np.int64]:
        """The row of each depth image: by the name beside the stamp, or by its number, or in order.

        Args:
            folder: name of the images' folder, for sentences.
            names: of the images' files, in order.
            numbers: (m,) the number of each image; None where they are not numbered.
            problems: sentences, appended to.
            doubts: reasons not to rely on the rows, appended to.

        Returns:
            (m,) rows; -1 for an image without one.
        """
        n = len(numbers) if numbers is not None else len(names)
        stems = [_stem(name) for name in names]
        found, sure, best = np.where(np.arange(n) < len(self), np.arange(n), -1), False, -1
        for cells in self.columns:
            rows = _places(stems, [_stem(cell) for cell in cells])
            if (hits := int((rows >= 0).sum())) > max(best, len(rows) // 2):
                found, sure, best = rows, True, hits
            counts = name_numbers(cells)
            if numbers is None or counts is None or frame_counts(counts) is None:
                continue
            rows = _places(numbers.tolist(), counts.tolist())
            if (rows < 0).any():  # one of the two may begin at 1
                moved = _places((numbers - numbers[0] + counts[0]).tolist(), counts.tolist())
                rows = rows if (moved < 0).any() else moved
            hits = int((rows >= 0).sum())
            renumbered = n == len(self) and numbers[-1] - numbers[0] == n - 1
            if hits > best and (hits == n or not renumbered):
                found, sure, best = rows, hits in (n, len(self)), hits
        if best < 0 and n != len(self):
            problems.append(match_counts(n, np.arange(len(self)), folder, self.path.name)[1] or "")
            doubts.append(unpaired(folder, self.path.name))
        elif best >= 0 and best < max(n, len(self)):
            (problems if sure else doubts).append(
                f"{n - best} of {n} depth images have no row in {self.path.name} and are left out, "
                f"and {len(self) - best} of its {len(self)} rows have no image"
            )
        return found

    def times(
        self, hz: float | None, problems: list[str], doubts: list[str], usual_hz: float | None
    ) -> Times:
        """The stamps, or the times of the frame numbers that stand in their place.

        Args:
            hz: a rate that is known, Hz.
            problems: sentences, appended to.
            doubts: reasons not to rely on the times, appended to.
            usual_hz: what to assume for frame numbers without a rate, Hz; None refuses them.

        Raises:
            UnknownTimesError: there are only frame numbers, and no rate is known.
        """
        if self.counts is None:
            return np.array([], np.int64) if self.times_ns is None else self.times_ns
        counter = f"a column of {self.path.name} counts by one: a frame counter, not times"
        advice = "state fps = 30.0 (your rate) in camera.toml, or name the column of times with"
        if hz is not None:
            problems.append(f"{counter}; it was taken to count frames at {hz:g} frames/s")
        elif self.times_ns is None and usual_hz is None:
            raise UnknownTimesError(f"{counter}; {advice} time_column and time_unit")
        else:
            doubts.append(f"{counter}; {advice} time_column and time_unit")
        if hz is None and self.times_ns is not None:
            return self.times_ns
        return from_rate(self.counts, hz or usual_hz or 1.0)


def read_stamps(
    path: Path,
    problems: list[str],
    doubts: list[str],
    column: str | int | None = None,
    unit: str | None = None,
    usual_ns: int | None = None,
) -> Stamps:
    """Read a table of stamps, with or without a header.

    Lines that begin with # are passed over, but for one that names the columns. Stamps are numbers,
    or dates (ISO 8601), or hh:mm:ss, which continue past midnight.

    Args:
        path: the table.
        problems: sentences, appended to.
        doubts: reasons not to rely on the times, appended to.
        column: name of the column of times, or its number from 0 in a table that may have no
            header; None for one of time_ns, time_us, time_ms and time_s, or else the first column
            of dates or, where usual_ns is given, the first that can be times.
        unit: ns, us, ms or s, where the column's name does not end in it.
        usual_ns: nanoseconds in the unit of numbers whose column has no name; None where numbers
            need one.

    Raises:
        RecordingError: there is no such column, its unit is not known, or a cell is no stamp.
    """
    try:
        separator, lines = split_lines(_BLANK.sub(r"\1T", read_text(path)))
        cells = split_cells(lines, separator)
    except ValueError as error:
        raise RecordingError(
            f"{path} should be a text file with one time stamp per line, but {error}"
        ) from None
    rows = [(line, row) for line, row in enumerate(cells, start=1) if any(row)]
    wanted = tuple(CSV_COLUMNS) if column is None else (column,)
    named = [[cell.lstrip("# ") for cell in row if cell != "#"] for _, row in rows]
    plain = [at for at, (_, row) in enumerate(rows) if not row[0].startswith("#")]
    at = next((at for at, row in enumerate(named) if set(wanted) & set(row)), -1)
    if at < 0 and plain:
        first = rows[plain[0]][1]
        probe = first[column : column + 1] if isinstance(column, int) else first
        at = -1 if any(map(_reader, probe)) else plain[0]
    header = named[at] if at >= 0 else []
    data = [rows[k] for k in plain if k > at]
    if separator == ",":
        data = _with_decimals(path, data, len(header), doubts)
    name = next((name for name in wanted if name in header), None)
    if isinstance(column, int) or (usual_ns and not data):
        chosen = _Column.of(path, data, column if isinstance(column, int) else 0)
    elif name is not None:
        chosen = _Column.of(path, data, header.index(name))
    elif column is None and (found := _can_be_times(path, data, usual_ns is not None)):
        chosen = found
    else:
        raise RecordingError(
            f"{path} should begin with a line that names a column {column or 'time_ns or time_s'}, "
            f"but its first line is {_shorten(lines[0]) if lines else 'missing'!r}; "
            + ("correct time_column in camera.toml" if column else "add that header line")
        )
    others = tuple(
        [row[k] if k < len(row) else "" for _, row in data]
        for k in range(len(data[0][1]) if data else 0)
        if k != chosen.k or chosen.counts is not None
    )
    if chosen.read is not number:
        times, zoned = chosen.moments(path, problems, doubts)
        return Stamps(path, times, None, others, zoned)
    if name is None and column is None and chosen.counts is not None:
        return Stamps(path, None, chosen.counts, others)
    usual = usual_ns or (1 if isinstance(column, int) else None)
    ns_per_unit = UNITS[unit] if unit else CSV_COLUMNS.get(str(name), usual)
    if ns_per_unit is None:
        raise RecordingError(
            f'the unit of the column {name!r} in {path} is not known; write time_unit = "s", "ms", '
            '"us" or "ns" beside time_column in camera.toml'
        )
    unnamed = name is None and column is None
    return Stamps(path, chosen.times(path, ns_per_unit, unnamed, problems), chosen.counts, others)


@dataclass(frozen=True)
class _Column:
    """A column of stamps of one kind: its place, lines and cells, and what they say.

    Values are plain numbers, or nanoseconds of dates and of hh:mm:ss; counts as in `Stamps`.
    """

    k: int
    read: Callable[[str], Decimal]
    cells: list[tuple[int, str]]
    values: list[Decimal]
    counts: Times | None

    @staticmethod
    def of(path: Path, rows: list[tuple[int, list[str]]], k: int) -> _Column:
        """The column k of a table, if every cell of it is of the first one's kind."""
        cells = [(line, row[k] if k < len(row) else "") for line, row in rows]
        read = (_reader(cells[0][1]) if cells else None) or number
        values = []
        for line, text in cells:
            try:
                values.append(read(text))
            except ValueError:
                raise _no_stamp(path, line, text) from None
        whole = read is number and all(abs(v) < LIMIT_NS and v == int(v) for v in values)
        counts = frame_counts(np.array([int(v) for v in values], np.int64), 1) if whole else None
        return _Column(k, read, cells, values, counts)

    @property
    def steps(self) -> NDArray[np.float64]:
        """(n - 1,) from each value to the next."""
        return np.diff(np.array(self.values, np.float64))

    def times(self, path: Path, ns_per_unit: int, usual: bool, problems: list[str]) -> Times:
        """Numbers as ns.

        A unit that is only the usual one gives way to another that alone is possible.
        """
        flat = [number(_GROUPED.sub(r"\1\2", text)) for _, text in self.cells]
        if (self.steps < 0).any() and not (np.diff(np.array(flat, np.float64)) < 0).any():
            raise _no_stamp(path, *next(c for c in self.cells if _GROUPED.match(c[1])))
        step = float(np.median(self.steps)) if len(self.steps) else 0.0
        origin = 0
        if usual and step > 0 and not _is_rate(step * ns_per_unit):
            first = self.values[0]
            possible = (
                clock
                for clock in _CLOCKS
                if _is_rate(step * clock[0])
                and _PLAUSIBLE_NS[0] <= (first - clock[1]) * clock[0] < _PLAUSIBLE_NS[1]
            )
            clock = next(possible, None)
            if clock is None:
                problems.append(
                    f"the numbers in {path.name} were taken as "
                    f"{'milli' if ns_per_unit == UNITS['ms'] else ''}seconds, as MoSeq writes "
                    f"them, which makes {1e9 / (step * ns_per_unit):.3g} frames/s; if they have "
                    f'another unit, write time_column = {self.k} and time_unit = "us" (or "s", '
                    '"ns") into camera.toml'
                )
            else:
                ns_per_unit, origin, words = clock
                problems.append(
                    f"the numbers in {path.name} were taken as {words}, which alone gives a date "
                    f"of today and a camera's rate ({1e9 / (step * ns_per_unit):.4g} frames/s)"
                )
        found = [int(((v - origin) * ns_per_unit).to_integral_value()) for v in self.values]
        for (line, text), t in zip(self.cells, found, strict=True):
            if abs(t) >= LIMIT_NS:
                raise _no_stamp(path, line, text)
        return np.array(found, np.int64)

    def moments(self, path: Path, problems: list[str], doubts: list[str]) -> tuple[Times, bool]:
        """Dates and times of day as ns, and whether they have a zone; a time of day continues past
        midnight.
        """
        times = np.array([int(v) for v in self.values], np.int64)
        if self.read is _clock_ns:
            back = np.diff(times, prepend=times[:1]) < -12 * _HOUR_NS
            return times + 24 * _HOUR_NS * np.cumsum(back), False
        zoned = [read_moment(text)[0].tzinfo is not None for _, text in self.cells]
        if any(zoned) and not all(zoned):
            raise _no_stamp(path, *self.cells[zoned.index(not zoned[0])])
        if not any(zoned):
            problems.append(
                f"the dates in {path.name} have no time zone, so the start of the recording is "
                "not known from them"
            )
            hours = np.abs(np.abs(np.diff(times)) - _HOUR_NS) < _HOUR_NS // 60
            if hours.any():
                doubts.append(
                    f"the dates in {path.name} have no time zone and jump by an hour at line "
                    f"{self.cells[int(hours.argmax()) + 1][0]}, as where summer time begins or "
                    "ends; write them with their zone"
                )
        return times, all(zoned)


def _can_be_times(path: Path, rows: list[tuple[int, list[str]]], numbers: bool) -> _Column | None:
    """The first column that rises and does not count frames; or else one that counts; or else the
    first of stamps.

    Args:
        path: the file.
        rows: lines and cells.
        numbers: whether numbers whose column has no name can be times.
    """
    found: list[_Column] = []
    for k, cell in enumerate(rows[0][1] if rows else []):
        read = _reader(cell)
        timely = read is not None and (numbers or read is not number)
        try:
            column = _Column.of(path, rows, k)
        except RecordingError:
            if timely and not found:
                raise
            continue
        rises = 4 * int((column.steps > 0).sum()) >= 3 * len(column.steps)
        if timely and rises and column.counts is None:
            return column
        if timely or column.counts is not None:
            found.append(column)
    return next((column for column in found if column.counts is not None), next(iter(found), None))


def _reader(text: str) -> Callable[[str], Decimal] | None:
    """What reads a stamp that is written like this one; None where it is no stamp."""
    for read in (number, _moment_ns, _clock_ns):
        with suppress(ValueError):
            read(text)
            return read
    return None


def _moment_ns(text: str) -> Decimal:
    return Decimal(read_moment(text)[1])


def _clock_ns(text: str) -> Decimal:
    return clock_s(text) * UNITS["s"]


def _is_rate(step_ns: float) -> bool:
    return PLAUSIBLE_HZ[0] <= 1e9 / step_ns <= PLAUSIBLE_HZ[1]


def _no_stamp(path: Path, line: int, text: str) -> RecordingError:
    return RecordingError(
        f"{path} holds {_shorten(text)!r} on line {line} where a time stamp was expected, such as "
        "1234.5 (without separators of thousands), 2024-05-01T10:00:00.5Z or 10:00:00.5; correct "
        "or remove that line"
    )


def _with_decimals(
    path: Path, rows: list[tuple[int, list[str]]], n_named: int, doubts: list[str]
) -> list[tuple[int, list[str]]]:
    """Rows split at commas, with those commas undone that are decimal signs.

    A comma is one where the digits behind it do not rise as a column would, and are equally many or
    more than the header names. Where that is not certain, `doubts` says so.
    """
    k = 0
    while rows and k + 1 < (width := max(len(row) for _, row in rows)):
        ends = [_FRACTION.fullmatch(row[k + 1] if k + 1 < len(row) else "0") for _, row in rows]
        digits = [end[1] for end in ends if end is not None]
        k += 1
        if (
            0 < n_named >= width
            or len(digits) < len(rows)
            or not all(_WHOLE_PART.fullmatch(row[k - 1]) for _, row in rows)
        ):
            continue
        values = np.array([int(end[-18:]) for end in digits], np.int64)
        is_column = (
            bool(np.all(np.diff(values) >= 0))
            or values.max() < 2
            or frame_counts(values, 1) is not None
        )
        is_fraction = (
            0 < n_named < width
            or any(len(row) <= k for _, row in rows)
            or any(end[0] == "0" < end for end in digits)
            or (len({len(end) for end in digits}) == 1 < len(digits[0]) and not is_column)
        )
        if is_fraction and not is_column:
            rows = [
                (line, [*row[: k - 1], ".".join(row[k - 1 : k + 1]), *row[k + 1 :]])
                for line, row in rows
            ]
        elif values.any() and (is_fraction or not is_column):
            doubts.append(
                f"line {rows[0][0]} of {path.name} holds {','.join(rows[0][1][k - 1 : k + 1])!r}, "
                "and the comma may be a decimal sign; it was taken to separate columns: write a "
                "decimal point, or semicolons between columns"
            )
    return rows


def name_numbers(names: Sequence[str]) -> Times | None:
    """The number that counts in each name; None where the names differ in more than numbers.

    Of several numbers it is the first that rises with every name and counts, or else the last that
    differs.

    Args:
        names: names of files, in order; folders and endings do not matter.

    Returns:
        (n,) int64.
    """
    parts = [re.split(r"(\d+)", _stem(name)) for name in names]
    if len({tuple(part[::2]) for part in parts}) != 1:
        return None
    groups = [
        np.array([int(digits[-18:]) for digits in group], np.int64)
        for group in list(zip(*parts, strict=True))[1::2]
    ]
    differ = [group for group in groups if (group != group[0]).any()]
    rising = [
        group for group in differ if np.all(np.diff(group) > 0) and frame_counts(group) is not None
    ]
    return next(iter([*rising, *differ[::-1]]), None)


def _places(wanted: Sequence[str | int], keys: Sequence[str | int]) -> NDArray[np.int64]:
    """Where each of some keys is; -1 where it is not, and everywhere if keys are not unique."""
    places = {key: k for k, key in enumerate(keys)}
    unique = len(places) == len(keys) and len(set(wanted)) == len(wanted)
    return np.array([places.get(key, -1) if unique else -1 for key in wanted], np.int64)


def _stem(name: str) -> str:
    """A name without folders and ending, in small letters."""
    return re.sub(r"\.[a-z]+$", "", re.split(r"[/\\]", name)[-1].casefold())


def name_times(names: Sequence[str]) -> tuple[Times, bool] | None:
    """Stamps in the names of pictures, and whether they count from 1970 in UTC.

    They must stand once in every name, in one of these forms: a date and a time with a fraction of
    a second, as in 20121214T142255.814212 (its zone is not known, so it tells steps and no moment);
    seconds since 1970 with a fraction; or 13, 16 or 19 digits of milliseconds, microseconds or
    nanoseconds since 1970. Stamps outside the years 2000 to 2100 are taken for something else.

    Args:
        names: names of the files, in order.

    Returns:
        (n,) int64 stamps, ns, and True where they tell a moment; None where the names hold none.
    """
    for form, read in ((_DATE, _date_ns), (_SECONDS, _seconds_ns), (_WHOLE, _whole_ns)):
        found = [form.findall(name) for name in names]
        if names and all(len(matches) == 1 for matches in found):
            times = [read(matches[0]) for matches in found]
            if all(t is not None and _PLAUSIBLE_NS[0] <= t < _PLAUSIBLE_NS[1] for t in times):
                return np.array(times, np.int64), form is not _DATE
    return None


def _date_ns(parts: tuple[str, ...]) -> int | None:
    try:
        moment = datetime.strptime("".join(parts[:6]), "%Y%m%d%H%M%S").replace(tzinfo=UTC)
    except ValueError:
        return None
    return int(moment.timestamp()) * 10**9 + int(parts[6].ljust(9, "0"))


def _seconds_ns(parts: tuple[str, str]) -> int:
    return int(parts[0]) * 10**9 + int(parts[1].ljust(9, "0"))


def _whole_ns(digits: str) -> int:
    return int(digits) * 10 ** (19 - len(digits))


def _shorten(text: str) -> str:
    return text if len(text) <= 60 else text[:57] + "..."
