"""Text formats of time stamps: tables (CSV, blank separated) and stamps in the names of pictures.

A stamp is read as a decimal number and becomes integer nanoseconds exactly; a float64 of seconds
since 1970 is good to 200 ns only. Names hold a date and time, seconds since 1970 with a fraction
(as in the TUM RGB-D data sets), or 13, 16 or 19 digits of ms, µs or ns since 1970.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Sequence
from datetime import UTC, datetime
from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np

from liex_lab.errors import RecordingError
from liex_lab.recordings.timestamps import LIMIT_NS, Times

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


def to_ns(text: str, ns_per_unit: int) -> int:
    """A decimal number as integer nanoseconds, exactly.

    A float64 of seconds since 1970 is good to 200 ns only.

    Args:
        text: the number as it is written.
        ns_per_unit: nanoseconds in its unit.

    Returns:
        The time, ns, rounded to a whole one.

    Raises:
        InvalidOperation: the text is no finite number, or is beyond the year 2116.
    """
    value = Decimal(text.strip()) * ns_per_unit
    if not value.is_finite() or abs(value) >= LIMIT_NS:
        raise InvalidOperation(f"{text} is not a time")
    return int(value.to_integral_value())


def read_csv_times(path: Path, column: str | int | None = None, unit: str | None = None) -> Times:
    """Stamps of a table with a header, separated by commas, semicolons, tabs or blanks.

    Lines that begin with # are passed over, but for one that names the columns.

    Args:
        path: the table.
        column: name of the column of times, or its number from 0 in a table that may have no
            header; None for the first of time_ns, time_us, time_ms and time_s.
        unit: ns, us, ms or s, where the column's name does not end in it.

    Returns:
        (n,) int64 stamps, ns, in file order.

    Raises:
        RecordingError: there is no such column, its unit is not known, or a cell is no number.
    """
    lines = _lines(path)
    rows = [(number, row) for number, row in enumerate(_split(lines), start=1) if row]
    if isinstance(column, int):
        rows = (
            rows[1:]
            if rows and column < len(rows[0][1]) and not _is_number(rows[0][1][column])
            else rows
        )
        return _parse(path, rows, column, UNITS[unit or "ns"])
    named = [(number, [cell.lstrip("# ") for cell in row if cell != "#"]) for number, row in rows]
    wanted = (column,) if column else tuple(CSV_COLUMNS)
    at, header = next(
        ((at, row) for at, (_, row) in enumerate(named) if set(wanted) & set(row)), (-1, [])
    )
    if at < 0:
        raise RecordingError(
            f"{path} should begin with a line that names a column {column or 'time_ns or time_s'}, "
            f"but its first line is {_shorten(lines[0]) if lines else 'missing'!r}; "
            + ("correct time_column in camera.toml" if column else "add that header line")
        )
    name = next(name for name in wanted if name in header)
    ns_per_unit = UNITS[unit] if unit else CSV_COLUMNS.get(name)
    if ns_per_unit is None:
        raise RecordingError(
            f'the unit of the column {name!r} in {path} is not known; write time_unit = "s", "ms", '
            '"us" or "ns" beside time_column in camera.toml'
        )
    return _parse(path, rows[at + 1 :], header.index(name), ns_per_unit)


def read_column_times(path: Path, ns_per_unit: int) -> Times:
    """Stamps in the first column of a file of numbers; a header line is passed over.

    Args:
        path: the file, its columns separated by blanks or commas.
        ns_per_unit: nanoseconds in the unit of column 0.

    Returns:
        (n,) int64 stamps, ns, in file order.

    Raises:
        RecordingError: the file is no text, or a line has no number there.
    """
    rows = [
        (number, line.replace(",", " ").split())
        for number, line in enumerate(_lines(path), start=1)
    ]
    rows = [(number, row) for number, row in rows if row]
    if rows and not _is_number(rows[0][1][0]):
        rows = rows[1:]
    return _parse(path, rows, 0, ns_per_unit)


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


def _split(lines: list[str]) -> list[list[str]]:
    """Cells of every line, none for a line that is a comment without names or blank."""
    first = next((line for line in lines if line.strip()), "")
    delimiter = next((d for d in ",;\t" if d in first), None)
    rows = (
        [line.split() for line in lines]
        if delimiter is None
        else list(csv.reader(lines, delimiter=delimiter))
    )
    return [[cell.strip().strip('"') for cell in row] for row in rows]


def _lines(path: Path) -> list[str]:
    try:
        return path.read_text(encoding="utf-8-sig").splitlines()
    except UnicodeDecodeError:
        raise RecordingError(
            f"{path} should be a text file with one time stamp per line, but it is not text"
        ) from None


def _is_number(text: str) -> bool:
    try:
        return Decimal(text).is_finite()
    except InvalidOperation:
        return False


def _parse(path: Path, rows: list[tuple[int, list[str]]], column: int, ns_per_unit: int) -> Times:
    times = []
    for number, row in rows:
        if row[0].startswith("#"):
            continue
        text = row[column] if column < len(row) else ""
        try:
            times.append(to_ns(text, ns_per_unit))
        except InvalidOperation:
            raise RecordingError(
                f"{path} holds {_shorten(text)!r} on line {number} where a time stamp was "
                "expected; correct or remove that line"
            ) from None
    return np.array(times, np.int64)


def _shorten(text: str) -> str:
    return text if len(text) <= 60 else text[:57] + "..."
