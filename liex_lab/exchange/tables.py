"""Every table of a session as CSV, for programs that do not read Parquet.

Column names contain their units; columns.json describes every column.
"""

from __future__ import annotations

import io
import math
import re
import shutil
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

from liex_lab.errors import SessionError
from liex_lab.runtime.places import inside
from liex_lab.runtime.text_files import copy_harmless, write_csv
from liex_lab.sessions import Session
from liex_lab.sessions.document import reading_from

if TYPE_CHECKING:
    import pandas as pd
    from openpyxl import Workbook


def write_csv_folder(session: Session, path: Path) -> None:
    """Write a new folder with one file per table, numbers in full precision, and columns.json."""
    path.mkdir()
    for name in sorted(
        {file.name for file in session.path.glob("*.parquet")} | set(session.log.files)
    ):
        if name.endswith(".parquet"):
            table = name.removesuffix(".parquet")
            write_csv(session.table(table), inside(path, table, ".csv"))
    if session.has("summary.csv"):
        with reading_from(session.file("summary.csv")) as summary:
            copy_harmless(summary, path / "summary.csv")
    shutil.copyfile(session.file("columns.json"), path / "columns.json")


# Every table of a session as one Excel workbook, one sheet per table, on request.


MAX_ROWS = 1_048_576  # of a sheet, its headings included
_MOST_CHARACTERS = 32_767  # of a cell
_UNWRITABLE = re.compile("[\\0-\\x08\\x0b\\x0c\\x0e-\\x1f\\ud800-\\udfff\\ufffe\\uffff]")  # in XML
_CELL_BYTES = 60  # of an uncompressed sheet, at most; 40 are typical
_OTHER_BYTES = 1 << 21  # independent of the recording's length
_EXACT = 10**15  # Excel has 15 digits; a longer integer, such as a time in ns, is text


def write_xlsx(session: Session, path: Path) -> None:
    """Write a workbook: the summary first, then every table, and the descriptions of the columns.

    Args:
        session: the session.
        path: the file to write.

    Raises:
        SessionError: a table is longer than a sheet can be, or there is not enough space for
            temporary files.
    """
    import pyarrow.parquet as pq
    from openpyxl import Workbook

    stored = {file.name for file in session.path.glob("*.parquet")} | set(session.log.files)
    names = sorted(name.removesuffix(".parquet") for name in stored if name.endswith(".parquet"))
    footers = [pq.read_metadata(session.file(f"{name}.parquet")) for name in names]
    for name, one in zip(names, footers, strict=True):  # before anything is written
        if one.num_rows >= MAX_ROWS:
            raise SessionError(
                f"a sheet of Excel has at most {MAX_ROWS:,} rows and the table {name} has "
                f"{one.num_rows + 1:,} with its headings; export it as csv"
            )
    _check_room(sum(one.num_rows * one.num_columns for one in footers))
    book = Workbook(write_only=True)
    if session.has("summary.csv"):
        _add(book, "summary", session.summary)
    for name in names:
        _add(book, name, session.table(name))
    _add(book, "columns", session.columns)
    # openpyxl crashes on a full disk, so the workbook is made in memory
    packed = io.BytesIO()
    book.save(packed)
    path.write_bytes(packed.getbuffer())


def _check_room(n_cells: int) -> None:
    """Refuse if the folder for temporary files has not enough space for the uncompressed sheets.

    openpyxl writes them there, and crashes if it becomes full.
    """
    folder = Path(tempfile.gettempdir())
    needed, free = n_cells * _CELL_BYTES + _OTHER_BYTES, shutil.disk_usage(folder).free
    if free < needed:
        raise SessionError(
            f"the workbook's sheets need {needed / 1e6:,.0f} MB in {folder} while they are "
            f"written, which has {free / 1e6:,.0f} MB left; make room there, name another "
            "folder in the variable TMPDIR, or export as csv"
        )


def _add(book: Workbook, name: str, table: pd.DataFrame) -> None:
    sheet = book.create_sheet(name)
    sheet.freeze_panes = "A2"
    sheet.append([_cell(sheet, str(column)) for column in table.columns])
    for row in table.itertuples(index=False, name=None):
        sheet.append([_cell(sheet, value) for value in row])


def _cell(sheet: Any, value: Any) -> Any:
    """A value for Excel: empty if missing, text if Excel has no type for it."""
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
