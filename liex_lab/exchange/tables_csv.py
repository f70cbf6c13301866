"""Every table of a session as CSV, for those who would rather not read Parquet.

Units are in the columns' names; columns.json describes every column.
"""

from __future__ import annotations

import shutil
from pathlib import Path

from liex_lab.sessions import Session


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
            session.table(table).to_csv(path / f"{table}.csv", index=False, lineterminator="\n")
    for name in ("summary.csv", "columns.json"):
        if session.has(name):
            shutil.copyfile(session.file(name), path / name)
