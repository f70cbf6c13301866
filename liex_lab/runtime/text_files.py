"""Text files from people or other programs: encodings, TOML, and tables.

Editors on Windows begin UTF-8 with a byte order mark, and PowerShell 5 writes UTF-16. Spreadsheets
separate cells by semicolons or tabs in locales with a decimal comma.
"""

from __future__ import annotations

import csv
import json
import re
import tomllib
from collections.abc import Sequence
from contextlib import suppress
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import pandas as pd


_SEPARATORS = (";", "\t", ",")
_SAMPLE = 50  # lines used to detect the separator
_STATED = re.compile(r'"?sep=(.)"?\s*', re.IGNORECASE)  # first line as Excel writes and reads it
_BLANKS = re.compile(  # a line of numbers separated by blanks, whatever its commas mean
    r"^\s*[-+]?\d[\d.eE+-]*\s+[-+]?\d|[^,\s]\s+[-+]?\d+,\d+(\s|$)|^\s*[-+]?\d+,\d+\s+[^,\s]"
    r"|^[-+]?\d{1,3}(,\d{3}){2,}(\.\d+)?$"  # or thousands separators, which are refused
)
_DECIMAL_COMMA = re.compile(r"^([-+]?\d+),(\d+(?:[eE][-+]?\d+)?)$")
_CLOCK = re.compile(r"(?:(\d+):([0-5]?\d):([0-5]\d(?:[.,]\d+)?)|(\d+):([0-5]\d[.,]\d+))")


def decoded(raw: bytes) -> str:
    """Decode UTF-8, or UTF-16 if there is a byte order mark or the zero bytes show it.

    Returns:
        The text; line ends are kept.

    Raises:
        ValueError: it is not valid text; the message names the line and the bytes.
    """
    wide = raw.startswith((b"\xff\xfe", b"\xfe\xff"))
    encoding = "utf-16" if wide else "utf-8-sig" if raw.startswith(b"\xef\xbb\xbf") else "utf-8"
    even, odd = (raw[first:4096:2].count(0) for first in (0, 1))
    if encoding == "utf-8" and (even == 0) != (odd == 0) and 4 * (even + odd) > len(raw[:4096]):
        encoding = "utf-16-le" if odd else "utf-16-be"
    text = raw.decode(encoding, "surrogateescape")
    wrong = re.search("[\0\udc80-\udcff]", text)
    if wrong is None:
        return text
    line = text.count("\n", 0, wrong.start()) + 1
    raise ValueError(
        f"it is not text in UTF-8 or UTF-16 (line {line} holds "
        f"{text[max(0, wrong.start() - 10) : wrong.end() + 10]!a}); save it as UTF-8"
    )


def read_text(path: Path) -> str:
    """Read a text file; see `decoded`. Line ends become line feeds.

    Raises:
        OSError: the file cannot be read.
        ValueError: it is not valid text.
    """
    return decoded(path.read_bytes()).replace("\r\n", "\n").replace("\r", "\n")


def parse_toml(text: str) -> dict[str, Any]:
    """Parse TOML.

    Raises:
        ValueError: it is not valid TOML; the message quotes the line.
    """
    try:
        return tomllib.loads(text)
    except RecursionError:
        raise ValueError("its values are nested too deeply") from None
    except tomllib.TOMLDecodeError as error:
        lines = dict(enumerate(text.split("\n"), start=1))
        at = [lines.get(int(line), "") for line in re.findall(r"at line (\d+)", str(error))]
        raise ValueError(f"{error}{''.join(f': {line.strip()[:60]!r}' for line in at)}") from None


def read_toml(path: Path) -> dict[str, Any]:
    """Read a TOML file.

    Raises:
        OSError: the file cannot be read.
        ValueError: it is not valid text or TOML.
    """
    return parse_toml(read_text(path))


def loose_json(path: Path) -> dict[str, Any]:
    """The object in a JSON file; empty if the file is absent, damaged or not an object."""
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return {}
    return found if isinstance(found, dict) else {}


def split_lines(text: str) -> tuple[str, list[str]]:
    """Split a table into lines and find its cell separator.

    Args:
        text: the table. A first line such as `sep=;` sets the separator.

    Returns:
        The separator (" " for any white space) and the lines; a line that sets the separator is
        empty.

    Raises:
        ValueError: the lines cannot be split into cells.
    """
    lines = text.splitlines()
    stated = _STATED.fullmatch(lines[0]) if lines else None
    if stated is not None:
        return stated[1], ["", *lines[1:]]
    filled = [line for line in lines if line.strip()]
    sample = [line for line in filled if line[0] != "#"][:_SAMPLE] or filled[:1]
    rows = {separator: split_cells(sample, separator) for separator in _SEPARATORS}
    possible = _SEPARATORS[:2] if sample and _BLANKS.search(sample[-1]) else _SEPARATORS
    for first in (0, 1):  # a first line may name fewer columns
        for separator in possible:
            widths = {len(row) for row in rows[separator][first:]}
            if len(widths) == 1 and min(widths) > 1:
                return separator, lines
    return next((mark for mark in possible if sample and mark in sample[0]), " "), lines


def split_cells(lines: Sequence[str], separator: str) -> list[list[str]]:
    """Cells of each line without surrounding blanks; an empty line has no cells.

    Args:
        lines: lines of a table.
        separator: as found by `split_lines`.

    Raises:
        ValueError: a cell is too long.
    """
    if separator == " ":
        return [[cell.strip('",') for cell in line.split()] for line in lines]
    try:
        rows = list(csv.reader(lines, delimiter=separator, skipinitialspace=True))
    except csv.Error as error:
        raise ValueError(f"it is no table ({error})") from None
    return [[cell.strip().strip('"') for cell in row] for row in rows]


def number(text: str) -> Decimal:
    """Parse a number exactly; the decimal separator is a point or a comma.

    Raises:
        ValueError: it is not a finite number.
    """
    with suppress(InvalidOperation):
        found = Decimal(_DECIMAL_COMMA.sub(r"\1.\2", text) if "," in text else text)
        if found.is_finite():
            return found
    raise ValueError(f"{text!r} is no number")


def clock_s(text: str) -> Decimal:
    """Parse a time as hh:mm:ss, hh:mm:ss.fff or mm:ss.fff, exactly; returns seconds.

    Raises:
        ValueError: it has another format.
    """
    found = _CLOCK.fullmatch(text.strip())
    if found is None:
        raise ValueError(f"{text!r} is no time as hh:mm:ss")
    hours, minutes, seconds = found[1] or "0", found[2] or found[4], found[3] or found[5]
    return 3600 * int(hours) + 60 * int(minutes) + number(seconds)


# CSV files that are safe to open in a spreadsheet: no cell or heading becomes a formula.


_FORMULA = "=+\\-@\uff1d\uff0b\uff0d\uff20"  # full-width forms count in East Asian locales
# where a cell may begin: at the start of the text, and after any possible separator
_BEGINS = f"^ *(?='*[{_FORMULA}\t\r\n])|(?<=[;\t\r\n]) *(?='*[{_FORMULA}])"
_MARKED = f"(^ *)'(?='*[{_FORMULA}\t\r\n])|((?<=[;\t\r\n]) *)'(?='*[{_FORMULA}])"


def harmless(value: Any) -> Any:
    """Escape a cell so that no spreadsheet reads it as a formula, whatever the cell separator.

    Args:
        value: a cell of any type; only text is changed.

    Returns:
        The cell; an apostrophe precedes each part of a text that would be a formula.
    """
    return re.sub(_BEGINS, r"\g<0>'", value) if isinstance(value, str) else value


def as_it_was(value: Any) -> Any:
    """The inverse of `harmless`."""
    return re.sub(_MARKED, r"\1\2", value) if isinstance(value, str) else value


def harmless_table(table: pd.DataFrame) -> pd.DataFrame:
    """Escape all cells and headings of a table, see `harmless`.

    Args:
        table: any table; multi-level headings are kept.

    Returns:
        A copy with escaped text.
    """
    found = table.copy(deep=False)
    for k, kind in enumerate(table.dtypes):
        if kind.kind == "O":  # text, whatever its array type
            found.isetitem(k, table.iloc[:, k].map(harmless).array)
    return found.rename(columns=harmless)


def write_csv(table: pd.DataFrame, path: Path, *, index: bool = False) -> None:
    """Write a table as CSV: UTF-8, full precision, formulas escaped.

    Args:
        table: the table.
        path: the file to write.
        index: whether to write the row labels.
    """
    harmless_table(table).to_csv(path, index=index, lineterminator="\n")


def read_texts(path: Path) -> pd.DataFrame:
    """Read a hand-written table with every cell as text: 007 and NA are valid names.

    Args:
        path: a CSV file, or one with a spreadsheet's separators.

    Raises:
        OSError: the file cannot be read.
        ValueError: it is not a table with a name for every column.
    """
    import pandas as pd

    separator, lines = split_lines(read_text(path))
    rows = [(k, row) for k, row in enumerate(split_cells(lines, separator), start=1) if any(row)]
    names = rows[0][1] if rows else []
    for line, row in rows:
        if any(row[len(names) :]):
            raise ValueError(
                f"line {line} has {len(row)} cells and the first line names {len(names)} columns; "
                "where a comma is the decimal sign, separate cells by semicolons"
            )
    filled = [[*row, *[""] * len(names)][: len(names)] for _, row in rows[1:]]
    table = pd.DataFrame(filled, columns=pd.Index(names, dtype=str))
    return table.loc[:, ~table.columns.duplicated()]


def read_harmless(path: Path, texts: tuple[str, ...] = ()) -> pd.DataFrame:
    """Read a CSV file written by `write_csv`, with its escapes removed.

    Args:
        path: the file.
        texts: columns that are text even if they parse as numbers.
    """
    import pandas as pd

    table = pd.read_csv(path)
    names = [name for name in texts if name in table]
    if names:
        cells = pd.read_csv(path, usecols=names, dtype="str", keep_default_na=False)
        table = table.assign(**{name: cells[name] for name in names})
    return table.rename(columns=as_it_was).map(as_it_was)


def copy_harmless(source: Path, target: Path) -> None:
    """Copy a CSV file of unknown origin, escaping formulas; numbers are unchanged."""
    with (
        source.open(encoding="utf-8", newline="") as read,
        target.open("w", encoding="utf-8", newline="") as written,
    ):
        writer = csv.writer(written, lineterminator="\n")
        writer.writerows(
            [cell if _is_number(cell) else harmless(as_it_was(cell)) for cell in row]
            for row in csv.reader(read)
        )


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


def value_at(table: Any, path: Sequence[str]) -> Any:
    """The value at a path of keys in nested tables; None if absent."""
    for part in path:
        table = table.get(part) if isinstance(table, dict) else None
    return table
