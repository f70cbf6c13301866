"""CSV files that a spreadsheet opens as they are: no cell or heading of them becomes a formula.

CSV injection: a spreadsheet runs text that begins with =, +, - or @, and where its list separator
is a semicolon (much of Europe) it splits at the semicolons of a cell, quoted or not. Names in the
tables come from recordings and sessions of others. The remedy is an apostrophe before every text
that could become a formula; it is taken away again when the file is read here.
"""

from __future__ import annotations

import csv
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

from liex_lab.runtime.text_files import read_text, split_cells, split_lines

if TYPE_CHECKING:
    import pandas as pd

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
