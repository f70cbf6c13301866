"""Registry of export formats and the one function that writes them."""

import difflib
import io
import math
import re
import shutil
import tempfile
from importlib import import_module
from pathlib import Path
from typing import Any

import pandas as pd
import pyarrow.parquet as pq

from liex_lab.errors import SessionError, how_to_install
from liex_lab.runtime import durable, places, text_files
from liex_lab.sessions import Session
from liex_lab.sessions.provenance import reading_from

# format -> (module and function of its writer, suffix of the name, description)
TARGETS: dict[str, tuple[str, str, str]] = {
    "nwb": (
        "nwb.write_nwb",
        ".nwb",
        "Neurodata Without Borders: poses (ndx-pose), rotations, actions (ndx-ethogram)",
    ),
    "boris": ("boris.write_boris", ".boris", "a BORIS project with the ethogram"),
    "dlc": (
        "pose_files.write_dlc",
        "_dlc",
        "a folder with DeepLabCut's CSV tables, in millimetres and in pixels",
    ),
    "movement": (
        "pose_files.write_movement",
        ".nc",
        "netCDF in movement's format of poses, with true times",
    ),
    "sleap": (
        "pose_files.write_sleap",
        ".analysis.h5",
        "SLEAP's analysis file, in pixels of the depth image",
    ),
    "csv": (
        "export.write_csv_folder",
        "_csv",
        "a folder with every table as CSV, and columns.json",
    ),
    "xlsx": (
        "export.write_xlsx",
        ".xlsx",
        "an Excel workbook with every table as a sheet, and the description of every column",
    ),
}
ALIASES = {"deeplabcut": "dlc"}


def export(
    session: Session, to: str, out: str | Path | None = None, *, overwrite: bool = False
) -> Path:
    """Write a session in another program's format; returns the file or folder.

    It is written under another name and renamed, so it is never incomplete.

    Args:
        session: the session.
        to: the format, a word of `TARGETS` or `ALIASES`.
        out: the output folder, created if missing; None uses the session's own.
        overwrite: replace an existing file.

    Raises:
        SessionError: the format is unknown, the file exists, or packages are missing.
    """
    to = ALIASES.get(to, to)
    if to not in TARGETS:
        if to == "video":
            raise SessionError(
                "`liex_lab.api.export_video` writes a video (on the command line `liex export --to "
                "video`)"
            )
        near = difflib.get_close_matches(to, [*TARGETS, *ALIASES, "video"], 1)
        hint = f"did you mean '{near[0]}'? " if near else ""
        raise SessionError(
            f"there is no format '{to}' to export to: {hint}known are {', '.join(TARGETS)}, "
            f"{', '.join(ALIASES)} (the same as dlc) and video"
        )
    home, function = TARGETS[to][0].split(".")
    ending = TARGETS[to][1]
    folder = session.path if out is None else Path(out)
    if folder.exists() and not folder.is_dir():
        raise SessionError(
            f"{folder} is a file, and exports go into a folder; name another one (--out, in "
            "Python out=)"
        )
    folder.mkdir(parents=True, exist_ok=True)
    path = places.inside(folder, session.name, ending)
    if path.exists() and not overwrite:
        raise SessionError(
            f"{path} exists already; name another place (--out, in Python out=), or say "
            "--overwrite (in Python overwrite=True)"
        )
    try:
        write = getattr(import_module(f"liex_lab.exchange.{home}"), function)
        with durable.replacing(path, replace_folder=True) as part:
            write(session, part)
    except ImportError as error:
        raise SessionError(
            f"to write {to}, {error.name} is missing; {how_to_install('exchange')}"
        ) from None
    return path


# Every table of a session as CSV, for programs that do not read Parquet.


def _tables_of(session: Session) -> list[str]:
    """Names of the Parquet tables of a session, corrected ones included."""
    files = {file.name for file in session.path.glob("*.parquet")} | set(session.log.files)
    return sorted(name.removesuffix(".parquet") for name in files if name.endswith(".parquet"))


def write_csv_folder(session: Session, path: Path) -> None:
    """Write a new folder with one file per table, numbers in full precision, and columns.json."""
    path.mkdir()
    for table in _tables_of(session):
        text_files.write_csv(session.table(table), places.inside(path, table, ".csv"))
    if session.has("summary.csv"):
        with reading_from(session.file("summary.csv")) as summary:
            text_files.copy_harmless(summary, path / "summary.csv")
    shutil.copyfile(session.file("columns.json"), path / "columns.json")


# Every table of a session as one Excel workbook, one sheet per table, on request.


MAX_ROWS = 1_048_576  # of a sheet, its headings included
_UNWRITABLE = re.compile("[\\0-\\x08\\x0b\\x0c\\x0e-\\x1f\\ud800-\\udfff\\ufffe\\uffff]")  # in XML


def write_xlsx(session: Session, path: Path) -> None:
    """Write a workbook: the summary first, then every table, and the descriptions of the columns.

    Args:
        session: the session.
        path: the file to write.

    Raises:
        SessionError: a table is longer than a sheet can be, or there is not enough space for
            temporary files.
    """
    from openpyxl import Workbook

    names = _tables_of(session)
    footers = [pq.read_metadata(session.file(f"{name}.parquet")) for name in names]
    for name, one in zip(names, footers, strict=True):  # before anything is written
        if one.num_rows >= MAX_ROWS:
            raise SessionError(
                f"a sheet of Excel has at most {MAX_ROWS:,} rows and the table {name} has "
                f"{one.num_rows + 1:,} with its headings; export it as csv"
            )
    # openpyxl writes uncompressed sheets into the folder for temporary files, and crashes if it
    # becomes full
    folder = Path(tempfile.gettempdir())
    # at most 60 bytes per cell of an uncompressed sheet (40 are typical), and 2 MB for the rest
    needed = sum(one.num_rows * one.num_columns for one in footers) * 60 + (1 << 21)
    free = shutil.disk_usage(folder).free
    if free < needed:
        raise SessionError(
            f"the workbook's sheets need {needed / 1e6:,.0f} MB in {folder} while they are "
            f"written, which has {free / 1e6:,.0f} MB left; make room there, name another "
            "folder in the variable TMPDIR, or export as csv"
        )
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


def _add(book: Any, name: str, table: pd.DataFrame) -> None:
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
    # Excel has 15 digits; a longer integer, such as a time in ns, is text
    if isinstance(value, float) or (isinstance(value, int) and abs(value) < 10**15):
        return value
    text = str(value)
    if text in ("NaT", "<NA>"):
        return None
    # a cell has at most 32,767 characters
    cell = WriteOnlyCell(sheet, value=_UNWRITABLE.sub("\ufffd", text)[:32_767])
    cell.data_type = "s"
    return cell
