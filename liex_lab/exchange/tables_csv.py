"""Every table of a session as CSV, for those who would rather not read Parquet.

Units are in the columns' names; columns.json describes every column.
"""

from __future__ import annotations

import shutil
from pathlib import Path

from liex_lab.runtime.places import inside
from liex_lab.runtime.spreadsheets import copy_harmless, write_csv
from liex_lab.sessions import Session
from liex_lab.sessions.reading import reading_from


def write(session: Session, path: Path) -> None:
    """Write a folder with one file per table, numbers in full precision, and columns.json.

    Args:
        session: the session.
        path: the folder to make.
    """
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
