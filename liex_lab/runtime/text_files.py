"""Text files that a person or another program wrote: encodings, TOML, and the cells of tables.

Editors on Windows begin UTF-8 with a byte order mark, and PowerShell 5 writes UTF-16. Spreadsheets
separate cells by semicolons or tabs where the decimal sign is a comma.
"""

from __future__ import annotations

import csv
import re
import tomllib
from collections.abc import Sequence
from contextlib import suppress
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import pandas as pd


_MARKS = {b"\xef\xbb\xbf": "utf-8-sig", b"\xff\xfe": "utf-16", b"\xfe\xff": "utf-16"}
_SEPARATORS = (";", "\t", ",")
_SAMPLE = 50  # lines that a separator is chosen by
_STATED = re.compile(r'"?sep=(.)"?\s*', re.IGNORECASE)  # a first line that Excel writes and reads
_BLANKS = re.compile(  # in a line of numbers that blanks separate, whatever its commas are
    r"^\s*[-+]?\d[\d.eE+-]*\s+[-+]?\d|[^,\s]\s+[-+]?\d+,\d+(\s|$)|^\s*[-+]?\d+,\d+\s+[^,\s]"
    r"|^[-+]?\d{1,3}(,\d{3}){2,}(\.\d+)?$"  # or in a number, which is refused
)
_DECIMAL_COMMA = re.compile(r"^([-+]?\d+),(\d+(?:[eE][-+]?\d+)?)$")
_CLOCK = re.compile(r"(?:(\d+):([0-5]?\d):([0-5]\d(?:[.,]\d+)?)|(\d+):([0-5]\d[.,]\d+))")


def decoded(raw: bytes) -> str:
    """The text in the bytes of a file: UTF-8, or UTF-16 by its mark or where it is evident.

    Args:
        raw: the file's content.

    Returns:
        The text; line ends stay as they are.

    Raises:
        ValueError: it is no such text; the message names the line and the bytes.
    """
    encoding = next((name for mark, name in _MARKS.items() if raw.startswith(mark)), "utf-8")
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
    """The text of a file; see `decoded`. Lines end in a line feed.

    Raises:
        OSError: the file cannot be read.
        ValueError: it is no text.
    """
    return decoded(path.read_bytes()).replace("\r\n", "\n").replace("\r", "\n")


def parse_toml(text: str) -> dict[str, Any]:
    """The tables of a TOML text.

    Raises:
        ValueError: it is no TOML; the message quotes the line.
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
    """The tables of a TOML file.

    Raises:
        OSError: the file cannot be read.
        ValueError: it is no text, or no TOML.
    """
    return parse_toml(read_text(path))


def split_lines(text: str) -> tuple[str, list[str]]:
    """The lines of a table, and what separates their cells.

    Args:
        text: the table. A first line such as `sep=;` states the separator.

    Returns:
        The separator, which is " " for any blanks, and the lines; one that states the separator is
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
    """The cells of each line, without blanks around them; no cell for an empty line.

    Args:
        lines: lines of a table.
        separator: what `split_lines` found.

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
    """A number, exactly; its decimal sign is a point or a comma.

    Raises:
        ValueError: it is no finite number.
    """
    with suppress(InvalidOperation):
        found = Decimal(_DECIMAL_COMMA.sub(r"\1.\2", text) if "," in text else text)
        if found.is_finite():
            return found
    raise ValueError(f"{text!r} is no number")


def clock_s(text: str) -> Decimal:
    """Seconds of a time as hh:mm:ss, hh:mm:ss.fff or mm:ss.fff, exactly.

    Raises:
        ValueError: it is no such time.
    """
    found = _CLOCK.fullmatch(text.strip())
    if found is None:
        raise ValueError(f"{text!r} is no time as hh:mm:ss")
    hours, minutes, seconds = found[1] or "0", found[2] or found[4], found[3] or found[5]
    return 3600 * int(hours) + 60 * int(minutes) + number(seconds)


# CSV files that a spreadsheet opens as they are: no cell or heading of them becomes a formula.


_FORMULA = "=+\\-@\uff1d\uff0b\uff0d\uff20"  # the wide ones are taken for the others in East Asia
# where a cell begins, or could: at the text's beginning, and behind what may split it
_BEGINS = f"^ *(?='*[{_FORMULA}\t\r\n])|(?<=[;\t\r\n]) *(?='*[{_FORMULA}])"
_MARKED = f"(^ *)'(?='*[{_FORMULA}\t\r\n])|((?<=[;\t\r\n]) *)'(?='*[{_FORMULA}])"


def harmless(value: Any) -> Any:
    """A cell that no spreadsheet takes for a formula, whatever separates its cells.

    Args:
        value: a cell of any kind; only text is changed.

    Returns:
        The cell; text with an apostrophe before each part of it that would be a formula.
    """
    return re.sub(_BEGINS, r"\g<0>'", value) if isinstance(value, str) else value


def as_it_was(value: Any) -> Any:
    """The inverse of `harmless`.

    Args:
        value: a cell of any kind.

    Returns:
        What `harmless` was given.
    """
    return re.sub(_MARKED, r"\1\2", value) if isinstance(value, str) else value


def harmless_table(table: pd.DataFrame) -> pd.DataFrame:
    """A table of which neither cells nor headings are taken for formulas.

    Args:
        table: any table; headings of several rows are kept.

    Returns:
        A copy where text was changed.
    """
    found = table.copy(deep=False)
    for k, kind in enumerate(table.dtypes):
        if kind.kind == "O":  # text, whatever holds it
            found.isetitem(k, table.iloc[:, k].map(harmless).array)
    return found.rename(columns=harmless)


def write_csv(table: pd.DataFrame, path: Path, *, index: bool = False) -> None:
    """Write a table as CSV, UTF-8, numbers in full precision, no cell a formula.

    Args:
        table: the table.
        path: the file to write.
        index: whether the rows' labels are written, too.
    """
    harmless_table(table).to_csv(path, index=index, lineterminator="\n")


def read_texts(path: Path) -> pd.DataFrame:
    """Read a table that a person made, every cell as it is written: 007 and NA are names, too.

    Args:
        path: the file, as CSV or as a spreadsheet separates its cells.

    Raises:
        OSError: the file cannot be read.
        ValueError: it is no table with a name for every column.
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
    """Read a CSV file that `write_csv` wrote, cells and headings as they were before.

    Args:
        path: the file.
        texts: columns that are text even where they look like numbers.
    """
    import pandas as pd

    table = pd.read_csv(path)
    names = [name for name in texts if name in table]
    if names:
        said = pd.read_csv(path, usecols=names, dtype="str", keep_default_na=False)
        table = table.assign(**{name: said[name] for name in names})
    return table.rename(columns=as_it_was).map(as_it_was)


def copy_harmless(source: Path, target: Path) -> None:
    """Copy a CSV file that somebody else may have written; cells that are numbers stay as they are.

    Args:
        source: the file.
        target: the file to write.
    """
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
