"""Every table of a session as CSV, for those who would rather not read parquet. Units are in the columns' names."""

from __future__ import annotations

import shutil
from pathlib import Path

from liex_lab.sessions import Session


def write(session: Session, path: Path) -> None:
    """The folder `path` with one file per table, numbers in full precision, and columns.json."""
    path.mkdir()
    for table in sorted(session.path.glob("*.parquet")):
        session.table(table.stem).to_csv(path / f"{table.stem}.csv", index=False, lineterminator="\n")
    for name in ("summary.csv", "columns.json"):
        if (session.path / name).is_file():
            shutil.copyfile(session.path / name, path / name)
