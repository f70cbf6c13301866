"""Every table of a session as one Excel workbook, a sheet for each, for those who ask for it.

Written row by row, so that a long session needs no more memory than its longest table. Texts stay
texts: one that begins with "=" is no formula. CSV and Parquet keep full precision and any length;
a sheet of Excel ends at 1,048,576 rows.
"""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

from liex_lab.errors import SessionError
from liex_lab.sessions import Session

if TYPE_CHECKING:
    import pandas as pd
    from openpyxl import Workbook

MAX_ROWS = 1_048_576  # of a sheet, its headings included
_MOST_CHARACTERS = 32_767  # of a cell
_UNWRITABLE = re.compile("[\\0-\\x08\\x0b\\x0c\\x0e-\\x1f\\ud800-\\udfff\\ufffe\\uffff]")  # in XML
_EXACT = 10**15  # Excel has 15 digits; a longer whole number, a time in ns, is a text


def write(session: Session, path: Path) -> None:
    """Write a workbook: the summary first, then every table, and what every column means.

    Args:
        session: the session.
        path: the file to write.

    Raises:
        SessionError: a table is longer than a sheet can be.
    """
    import pyarrow.parquet as pq
    from openpyxl import Workbook

    stored = {file.name for file in session.path.glob("*.parquet")} | set(session.log.files)
    names = sorted(name.removesuffix(".parquet") for name in stored if name.endswith(".parquet"))
    for name in names:  # before anything is written
        n_rows = pq.read_metadata(session.file(f"{name}.parquet")).num_rows
        if n_rows >= MAX_ROWS:
            raise SessionError(
                f"a sheet of Excel has at most {MAX_ROWS:,} rows and the table {name} has "
                f"{n_rows + 1:,} with its headings; export it as csv"
            )
    book = Workbook(write_only=True)
    if session.has("summary.csv"):
        _add(book, "summary", session.summary)
    for name in names:
        _add(book, name, session.table(name))
    _add(book, "columns", session.columns)
    book.save(path)


def _add(book: Workbook, name: str, table: pd.DataFrame) -> None:
    sheet = book.create_sheet(name)
    sheet.freeze_panes = "A2"
    sheet.append([_cell(sheet, str(column)) for column in table.columns])
    for row in table.itertuples(index=False, name=None):
        sheet.append([_cell(sheet, value) for value in row])


def _cell(sheet: Any, value: Any) -> Any:
    """A value as Excel has it: empty for what is missing, a text for what it has no kind for."""
    from openpyxl.cell import WriteOnlyCell

    if hasattr(value, "item"):
        value = value.item()
    if value is None or (isinstance(value, float) and not math.isfinite(value)):
        return None
    if isinstance(value, float) or (isinstance(value, int) and abs(value) < _EXACT):
        return value
    text = str(value)
    if text in ("NaT", "<NA>"):
        return None
    cell = WriteOnlyCell(sheet, value=_UNWRITABLE.sub("\ufffd", text)[:_MOST_CHARACTERS])
    cell.data_type = "s"
    return cell
