"""Checks of a session's tables that somebody else may have written, before anything is computed.

The footer of a Parquet file tells columns, types and rows without reading them; it is checked when
a session is opened. The rows are checked when they are read.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from liex_lab.tables.schema import ROOT_COVARIANCES, TABLES

if TYPE_CHECKING:
    import pandas as pd

# columns that tables of schema 1 do not have; one that a later schema adds is listed here, too
_LATER = {
    "frames": {"wall_distance_mm", "zone", "p_flip", "bridged", "pulse_index"},
    "poses": {"sd_xy_mm", "sd_z_mm"},
    "rotations": set(ROOT_COVARIANCES),
    "gaps": {"x_mm", "y_mm"},
}
_ROWS_PER_BYTE = 8  # a frame's time stamp alone takes more
_FEW = 10_000
_SPANS = {"bouts", "gaps", "flips"}
# how Parquet stores our types, and what pandas calls them
_STORED = {"string": "BYTE_ARRAY", "float64": "DOUBLE", "int64": "INT64", "bool": "BOOLEAN"}
_KINDS = {"string": "O", "float64": "f", "int64": "i", "bool": "b"}


def check_footer(path: Path, name: str, n_frames: int, n_joints: int) -> None:
    """Check columns, types and number of rows of a table's file.

    Args:
        path: the Parquet file.
        name: the table's name.
        n_frames: frames of the session.
        n_joints: joints of the animal.

    Raises:
        ValueError: they are not those of a session with so many frames and joints.
    """
    import pyarrow.parquet as pq

    footer = pq.read_metadata(path)
    n_rows = footer.num_rows
    found = {
        leaf.name: leaf for leaf in (footer.schema.column(k) for k in range(footer.num_columns))
    }
    exact = {
        "frames": n_frames,
        "kinematics": n_frames,
        "poses": n_frames * n_joints,
        "rotations": n_frames * (n_joints + 1),
        "sessions": 1,
    }
    if name in exact and n_rows != exact[name]:
        raise ValueError(f"it has {n_rows} rows where the session has {exact[name]}")
    if n_rows > max(_FEW, _ROWS_PER_BYTE * (n_joints + 1) * path.stat().st_size):
        raise ValueError(f"it claims {n_rows} rows, which a file of its size does not hold")
    if name not in exact and n_rows > max(_FEW, 4 * n_frames):
        raise ValueError(f"it claims {n_rows} rows for {n_frames} frames")
    if len(found) != footer.num_columns:
        raise ValueError("it has two columns of one name")
    for column in TABLES.get(name, ()):
        leaf = found.get(column.name)
        if leaf is None:
            if column.name not in _LATER.get(name, ()):
                raise ValueError(f"it lacks the column {column.name}")
        elif leaf.physical_type != _STORED[column.dtype] or leaf.max_repetition_level:
            raise ValueError(f"its column {column.name} is not {column.dtype}")


def check_rows(name: str, table: pd.DataFrame, joints: Sequence[str]) -> None:
    """Check the rows of a table, as far as its columns were read.

    Args:
        name: the table's name.
        table: all its rows, or all rows of some frames.
        joints: names of the animal's joints.

    Raises:
        ValueError: a name is missing, frames are out of order, times are not finite, or rows are
            not those of the joints.
    """
    for column in TABLES.get(name, ()):
        if column.name not in table:
            continue
        values = table[column.name]
        if values.dtype.kind != _KINDS[column.dtype]:
            raise ValueError(f"its column {column.name} is not {column.dtype}")
        if column.dtype == "string" and values.hasnans:
            raise ValueError(f"its column {column.name} lacks a value")
    if "joint" in table and name in ("poses", "rotations"):
        own = [*joints] if name == "poses" else ["root", *joints]
        words = table["joint"]
        if len(words) % len(own) or not all(
            (words.iloc[k :: len(own)] == joint).all() for k, joint in enumerate(own)
        ):
            raise ValueError("its rows are not those of the session's joints in their order")
    if name == "frames":
        _check_frames(table)
    if name in _SPANS:
        for start, stop in (("start_frame", "stop_frame"), ("start_s", "stop_s")):
            if {start, stop} <= set(table) and not (table[start] <= table[stop]).all():
                raise ValueError(f"it has a {stop} before its {start}")


def _check_frames(table: pd.DataFrame) -> None:
    """Raises ValueError where frames or times do not go on."""
    for column in ("frame_index", "time_ns", "time_s"):
        if column in table:
            values = table[column].to_numpy()
            if not np.isfinite(values).all() or (values[1:] <= values[:-1]).any():
                raise ValueError(f"its {column} does not go on from row to row")
