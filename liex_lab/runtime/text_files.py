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
from typing import Any

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
