"""Text formats of time stamps: tables, and stamps or numbers in the names of depth images.

A stamp is parsed as a decimal number and becomes exact integer nanoseconds; a float64 of seconds
since 1970 is only precise to 200 ns. Stamps may also be dates (ISO 8601) or hh:mm:ss. Names contain
a date and time, seconds since 1970 with a fraction (as in the TUM RGB-D data sets), or 13, 16 or 19
digits of ms, µs or ns since 1970.
"""

import re
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from decimal import Decimal
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from liex_lab.errors import RecordingError, UnknownTimesError, expecting
from liex_lab.recordings.timestamps import (
    LIMIT_NS,
    PLAUSIBLE_HZ,
    PLAUSIBLE_NS,
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
)  # since 1970, as the TUM data sets name their images
_WHOLE = re.compile(r"(?<!\d)(\d{10})(\d{3}|\d{6}|\d{9})(?!\d)")  # the same in ms, us or ns
_CLOCKS = (  # nanoseconds per step, the step number of 1970, and the name
    (10**9, 0, "seconds since 1970"),
    (10**6, 0, "milliseconds since 1970"),
    (10**3, 0, "microseconds since 1970"),
    (100, 0, "steps of 100 ns since 1970"),
    (1, 0, "nanoseconds since 1970"),
    (100, 116_444_736 * 10**9, "steps of 100 ns since 1601, as Windows counts"),
    (100, 621_355_968 * 10**9, "steps of 100 ns since the year 1, as .NET counts"),
)
_HOUR_NS = 3600 * 10**9
_SURE = 12  # rows: with fewer, digits after commas may be fractions that increase by chance
_GROUPED = re.compile(r"^([-+]?[1-9]\d{0,2})[.,](\d{3})$")  # a number, or thousands


@dataclass(frozen=True)
class Stamps:
    """A table of time stamps: the column chosen for the times, and its other columns.

    Attributes:
        path: the file.
        k: number of the column, from 0.
        cells: line and text of its stamps.
        read: parser of these texts.
        values: (n,) plain numbers, or nanoseconds of dates and of hh:mm:ss.
        counts: (n,) frames from the first, if the numbers increase by one like a counter.
        rows: line and cells of the rows.
        ns_per_unit: nanoseconds in the unit of plain numbers.
        named: whether the table or camera.toml states that these are times.
    """

    path: Path
    k: int
    cells: list[tuple[int, str]]
    read: Callable[[str], Decimal]
    values: list[Decimal]
    counts: Times | None
    rows: list[tuple[int, list[str]]]
    ns_per_unit: int = 1
    named: bool = False

    @staticmethod
    def of(path: Path, rows: list[tuple[int, list[str]]], k: int) -> "Stamps":
        """The column k of a table.

        Args:
            path: the file.
            rows: lines and cells.
            k: number of the column, from 0.

        Raises:
            RecordingError: a cell is not a stamp of the same kind as the first one.
        """
        cells = [(line, row[k] if k < len(row) else "") for line, row in rows]
        read = (_reader(cells[0][1]) if cells else None) or number
        try:
            values = [read(text) for _, text in cells]
        except ValueError:
            raise _no_stamp(
                path, *next(cell for cell in cells if not _reads(read, cell[1]))
            ) from None
        whole = read is number and all(abs(v) < LIMIT_NS and v == int(v) for v in values)
        counts = frame_counts(np.array([int(v) for v in values], np.int64), 1) if whole else None
        return Stamps(path, k, cells, read, values, counts, rows)

    def __len__(self) -> int:
        """The number of rows."""
        return len(self.values)

    @property
    def zoned(self) -> bool:
        """Whether all dates have a time zone; True for stamps that are not dates."""
        return self.read is not _moment_ns or all(
            read_moment(text)[0].tzinfo is not None for _, text in self.cells
        )

    @property
    def steps(self) -> NDArray[np.float64]:
        """(n - 1,) from each value to the next."""
        return np.diff(np.array(self.values, np.float64))

    def times(
        self, hz: float | None, problems: list[str], doubts: list[str], usual_hz: float | None
    ) -> Times:
        """The stamps, or times computed from frame numbers if there are no stamps.

        Args:
            hz: a known frame rate, Hz.
            problems: sentences, appended to.
            doubts: reasons why the times are unreliable, appended to.
            usual_hz: rate to assume for frame numbers without a rate, Hz; None refuses them.

        Returns:
            (n,) int64 ns, in file order.

        Raises:
            UnknownTimesError: there are only frame numbers, and no rate is known.
            RecordingError: a number is not a time.
        """
        if self.counts is not None:
            counter = f"a column of {self.path.name} counts by one: a frame counter, not times"
            advice = (
                f"{counter}; state fps = 30.0 (your rate) in camera.toml, or name the column of "
                "times with time_column and time_unit"
            )
            if hz is None and usual_hz is None and not self.named:
                raise UnknownTimesError(advice)
            (problems if hz else doubts).append(
                f"{counter}; frames were placed by it at {hz:g} frames/s" if hz else advice
            )
            if hz or not self.named:
                return from_rate(self.counts, hz or usual_hz or 1.0)
        if self.read is number:
            return self._numbers(problems)
        times = np.array([int(value) for value in self.values], np.int64)
        if self.read is _clock_ns:  # continues after midnight
            back = np.diff(times, prepend=times[:1]) < -12 * _HOUR_NS
            return times + 24 * _HOUR_NS * np.cumsum(back)
        hours = np.abs(np.abs(np.diff(times)) - _HOUR_NS) < _HOUR_NS // 60
        if not self.zoned:
            without = f"the dates in {self.path.name} have no time zone"
            problems.append(f"{without}, so the start of the recording is not known from them")
            if hours.any():
                doubts.append(
                    f"{without} and jump by an hour at line "
                    f"{self.cells[int(hours.argmax()) + 1][0]}, as where summer time begins or "
                    "ends; write them with their zone"
                )
        return times

    def _numbers(self, problems: list[str]) -> Times:
        """Numbers as ns; an assumed unit is replaced if only another one is plausible."""
        grouped = [cell for cell in self.cells if _GROUPED.match(cell[1])]
        if grouped and (self.steps < 0).any():  # perhaps thousands separators
            flat = [number(_GROUPED.sub(r"\1\2", text)) for _, text in self.cells]
            if flat == sorted(flat):
                raise _no_stamp(self.path, *grouped[0])
        step = float(np.median(self.steps)) if len(self.steps) else 0.0
        clock = (self.ns_per_unit, 0, "")
        if not self.named and step > 0 and not _is_rate(step * self.ns_per_unit):
            possible = (
                clock
                for clock in _CLOCKS
                if _is_rate(step * clock[0])
                and PLAUSIBLE_NS[0] <= (self.values[0] - clock[1]) * clock[0] < PLAUSIBLE_NS[1]
            )
            clock = next(possible, clock)
            hz = 1e9 / (step * clock[0])
            problems.append(
                f"the numbers in {self.path.name} were taken as {clock[2]}, which alone gives a "
                f"date of our time and the rate of a camera ({hz:.4g} frames/s)"
                if clock[2]
                else f"the numbers in {self.path.name} were taken as "
                f"{'milli' if self.ns_per_unit == UNITS['ms'] else ''}seconds, as MoSeq writes "
                f"them, which makes {hz:.3g} frames/s; if they have another unit, write "
                f'time_column = {self.k} and time_unit = "us" (or "s", "ns") into camera.toml'
            )
        found = [int(((v - clock[1]) * clock[0]).to_integral_value()) for v in self.values]
        beyond = [cell for cell, t in zip(self.cells, found, strict=True) if abs(t) >= LIMIT_NS]
        if beyond:
            raise _no_stamp(self.path, *beyond[0])
        return np.array(found, np.int64)

    def rows_of(
        self,
        folder: str,
        names: Sequence[str],
        numbers: Times,
        problems: list[str],
        doubts: list[str],
    ) -> NDArray[np.int64]:
        """The row of each depth image: by the name next to the stamp, by its number, or in order.

        Args:
            folder: name of the images' folder, for messages.
            names: names of the image files, in order.
            numbers: (m,) the number of each image; all equal if they are not numbered.
            problems: sentences, appended to.
            doubts: reasons why the rows are unreliable, appended to.

        Returns:
            (m,) rows; -1 for an image without one.
        """
        n = len(numbers)
        in_order = n == len(self) and numbers[-1] - numbers[0] == n - 1  # perhaps renumbered
        found, best, sure = np.where(np.arange(n) < len(self), np.arange(n), -1), 0, False
        for cells in zip(*(row for _, row in self.rows), strict=False):
            tries = [(_places([_stem(name) for name in names], [_stem(c) for c in cells]), n // 2)]
            counts = name_numbers(cells)
            if counts is not None and frame_counts(counts) is not None:
                moved = numbers - numbers[0] + counts[0]  # one of them may begin at 1
                tries.append((_places(numbers, counts), n - 1 if in_order else 0))
                tries.append((_places(moved, counts), min(n, len(self)) - 1))
            for rows, least in tries:
                hits = int((rows >= 0).sum())
                if hits > max(best, least):
                    found, best, sure = rows, hits, least > 0 or hits in (n, len(self))
        if not best and n != len(self):
            problems += match_counts(n, len(self), folder, self.path.name)
            doubts.append(unpaired(folder, self.path.name))
        elif best and best < max(n, len(self)):
            (problems if sure else doubts).append(
                f"of {n} depth images and {len(self)} rows of {self.path.name}, {best} belong "
                "together by name or number; the others are left out"
            )
        return found


def read_stamps(
    path: Path,
    doubts: list[str],
    column: str | int | None = None,
    unit: str | None = None,
    usual_ns: int | None = None,
) -> Stamps:
    """Read a table of stamps, with or without a header.

    Lines that start with # are skipped, unless they name the columns. Stamps are numbers, dates
    (ISO 8601) or hh:mm:ss.

    Args:
        path: the table.
        doubts: reasons why the times are unreliable, appended to.
        column: name of the column of times, or its number from 0 in a table that may have no
            header. None for one of time_ns, time_us, time_ms and time_s, or else the first column
            of dates or, if usual_ns is given, the first plausible one.
        unit: ns, us, ms or s, if the column's name does not end in it.
        usual_ns: nanoseconds in the assumed unit of a column without a name; None refuses numbers
            without a unit.

    Raises:
        RecordingError: there is no such column, its unit is unknown, or a cell is not a stamp.
    """
    with expecting(
        RecordingError,
        f"{path} should be a text file with one time stamp per line",
        ValueError,
    ):
        # between date and time
        # with a decimal comma
        separator, lines = split_lines(
            re.compile(r"(\d\d:\d\d:\d\d),(?=\d{3})").sub(
                r"\1.", re.compile(r"(?<=\d{4}-\d\d-\d\d) +(?=\d\d:)").sub("T", read_text(path))
            )
        )
        cells = split_cells(lines, separator)
    wanted = tuple(CSV_COLUMNS) if column is None else (column,)
    names = [[cell.lstrip("# ") for cell in row if cell != "#"] for row in cells]
    at = next((at for at, row in enumerate(names) if set(wanted) & set(row)), -1)
    header = names[at] if at >= 0 else []
    data = [
        (line, row)
        for line, row in enumerate(cells, start=1)
        if line > at + 1 and any(row) and not row[0].startswith("#")
    ]
    if at < 0 and data:
        first = data[0][1]
        probe = first[column : column + 1] if isinstance(column, int) else first
        header = [] if any(map(_reader, probe)) else data.pop(0)[1]
    if separator == "," and len(header) < 2 and _are_decimals(data):
        data = [(line, [",".join(row)]) for line, row in data]
    name = next((name for name in wanted if name in header), None)
    if isinstance(column, int) or name in header:
        at = column if isinstance(column, int) else header.index(str(name))
        found: Stamps | None = Stamps.of(path, data, at)
    else:
        found = None if column else _can_be_times(path, data, usual_ns is not None)
    if found is None:
        raise RecordingError(
            f"{path} should begin with a line that names a column {column or 'time_ns or time_s'}, "
            f"but its first line is {_shorten(lines[0]) if lines else 'missing'!r}; "
            + ("correct time_column in camera.toml" if column else "add that header line")
        )
    wide = [row for _, row in data if not header or len(row) > len(header)]
    for k in range(max(found.k - 1, 0), found.k + 1):
        behind = [row[k + 1] for row in wide if len(row) > k + 1 and _are_digits(row[k : k + 2])]
        may_be = separator == "," and len(behind) == len(data) > 0
        if may_be and (len(data) < _SURE or not _is_column(behind, header)):
            doubts.append(
                f"line {data[0][0]} of {path.name} holds {','.join(data[0][1])!r}, where a comma "
                "may be a decimal sign; it was taken to separate columns: write a decimal point, "
                "or semicolons between columns"
            )
            break
    stated = name is not None or column is not None
    ns_per_unit = UNITS[unit] if unit else CSV_COLUMNS.get(str(name), usual_ns)
    if not ns_per_unit and found.read is number and stated and not isinstance(column, int):
        raise RecordingError(
            f'the unit of the column {name!r} in {path} is not known; write time_unit = "s", "ms", '
            '"us" or "ns" beside time_column in camera.toml'
        )
    return replace(found, ns_per_unit=ns_per_unit or 1, named=stated)


def _can_be_times(path: Path, rows: list[tuple[int, list[str]]], numbers: bool) -> Stamps | None:
    """The first increasing column that does not count frames; else one that does; else any of
    stamps.

    Args:
        path: the file.
        rows: lines and cells.
        numbers: whether plain numbers in a column without a name can be times.
    """
    found: list[Stamps] = []
    for k, cell in enumerate(rows[0][1] if rows else []):
        read = _reader(cell)
        timely = read is not None and (numbers or read is not number)
        try:
            column = Stamps.of(path, rows, k)
        except RecordingError:
            if timely and not found:
                raise
            continue
        rises = 4 * int((column.steps > 0).sum()) >= 3 * len(column.steps)
        if timely and rises and column.counts is None:
            return column
        if timely or column.counts is not None:
            found.append(column)
    first = Stamps.of(path, rows, 0) if numbers and not found else next(iter(found), None)
    return next((column for column in found if column.counts is not None), first)


def _reader(text: str) -> Callable[[str], Decimal] | None:
    """The parser for a stamp written like this one; None if it is not a stamp."""
    return next((read for read in (number, _moment_ns, _clock_ns) if _reads(read, text)), None)


def _reads(read: Callable[[str], Decimal], text: str) -> bool:
    with suppress(ValueError):
        read(text)
        return True
    return False


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


def _are_decimals(rows: list[tuple[int, list[str]]]) -> bool:
    """Whether the only comma in each line is a decimal sign."""
    behind = [row[1] for _, row in rows if len(row) == 2]
    digits = behind and all(len(row) <= 2 and _are_digits(row) for _, row in rows)
    even = len({len(text) for text in behind}) == 1 < len(behind[0]) if behind else False
    return bool(digits and (even or len(behind) < len(rows)) and not _is_column(behind))


def _are_digits(texts: list[str]) -> bool:
    return all(text.isascii() and text.isdigit() for text in texts)


def _is_column(digits: list[str], header: Sequence[str] = ()) -> bool:
    """Whether digits after commas are a column of their own: increasing, constant, or 0 and 1.

    Args:
        digits: one text per line.
        header: of a table that has more columns than it names.
    """
    values = np.array([int(text[-18:]) for text in digits], np.int64)
    padded = bool(header) or any(text[0] == "0" < text for text in digits)
    rises = np.all(np.diff(values) >= 0)
    return bool(not padded and (rises or values.max() < 2 or frame_counts(values, 1) is not None))


def name_numbers(names: Sequence[str]) -> Times | None:
    """The frame number in each name; None if the names differ in more than numbers.

    With several numbers per name, it is the first one that increases and counts frames, or else the
    last one that varies.

    Args:
        names: names of files, in order; folders and suffixes are ignored.

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
    rising = (
        group for group in differ if np.all(np.diff(group) > 0) and frame_counts(group) is not None
    )
    return next(rising, differ[-1] if differ else None)


def _places(wanted: Iterable[Any], keys: Iterable[Any]) -> NDArray[np.int64]:
    """Index of each wanted key among `keys`; -1 if absent, and for all if keys are not unique."""
    wanted, keys = list(wanted), list(keys)
    places = {key: k for k, key in enumerate(keys)}
    unique = len(places) == len(keys) and len(set(wanted)) == len(wanted)
    return np.array([places.get(key, -1) if unique else -1 for key in wanted], np.int64)


def _stem(name: str) -> str:
    """A name without folders and suffix, in lower case."""
    return re.sub(r"\.[a-z]+$", "", re.split(r"[/\\]", name)[-1].casefold())


def name_times(names: Sequence[str]) -> tuple[Times, bool] | None:
    """Parse stamps in the names of images; also whether they count from 1970 in UTC.

    Every name must contain exactly one, in one of these forms: a date and a time with a fraction of
    a second, as in 20121214T142255.814212 (its zone is unknown, so it gives steps only); seconds
    since 1970 with a fraction; or 13, 16 or 19 digits of milliseconds, microseconds or nanoseconds
    since 1970. Numbers outside the years 2000 to 2100 are not stamps.

    Args:
        names: names of the files, in order.

    Returns:
        (n,) int64 stamps, ns, and True if they are absolute; None if the names have no stamps.
    """
    for form in (_DATE, _SECONDS, _WHOLE):
        found = [form.findall(name) for name in names]
        if names and all(len(matches) == 1 for matches in found):
            with suppress(ValueError):
                times = [_name_ns(*parts) for (parts,) in found]
                if all(PLAUSIBLE_NS[0] <= t < PLAUSIBLE_NS[1] for t in times):
                    return np.array(times, np.int64), form is not _DATE
    return None


def _name_ns(*parts: str) -> int:
    """Date and time, or seconds since 1970, with their fraction, as ns since 1970."""
    *since_1970, fraction = parts
    if len(since_1970) > 1:
        moment = datetime.strptime("".join(since_1970), "%Y%m%d%H%M%S").replace(tzinfo=UTC)
        since_1970 = [f"{moment.timestamp():.0f}"]
    return int(since_1970[0]) * 10**9 + int(fraction.ljust(9, "0"))


def _shorten(text: str) -> str:
    return text if len(text) <= 60 else text[:57] + "..."
