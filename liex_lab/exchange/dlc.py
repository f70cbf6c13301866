"""DeepLabCut's CSV tables: three header rows (scorer, bodyparts, coords), then one row per frame.

poses_3d.csv has x, y, z in millimetres of the arena frame, without likelihood, as DeepLabCut's own
3D tables; poses_2d.csv has x, y in pixels of the depth picture and a likelihood
(`Poses.likelihood`). The format has no times: they are in times.csv, row by row; the actions are in
bouts.csv.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd

from liex_lab.runtime.spreadsheets import write_csv
from liex_lab.sessions import Session
from liex_lab.sessions.pose_arrays import Array, Poses

SCORER = "liex_lab"


def write(session: Session, path: Path) -> None:
    """Write a folder with both tables, the times and the bouts.

    Args:
        session: the session.
        path: the folder to make.
    """
    poses = session.pose_arrays()
    path.mkdir()
    write_csv(table(poses, poses.xyz_mm, "xyz"), path / "poses_3d.csv", index=True)
    flat = np.concatenate([poses.uv_px, poses.likelihood[..., None]], axis=-1)
    write_csv(table(poses, flat, ("x", "y", "likelihood")), path / "poses_2d.csv", index=True)
    _write_times(path / "times.csv", poses)
    write_csv(session.bouts, path / "bouts.csv")


def table(poses: Poses, values: Array, coords: str | tuple[str, ...]) -> pd.DataFrame:
    """Data frame with DeepLabCut's columns: scorer, bodyparts, coords.

    Args:
        poses: the session's poses, for joints and frame index.
        values: (n, J, k) values.
        coords: names of the k coordinates; a str is one letter each.

    Returns:
        (n, J k) table, indexed by the number of the frame in the recording.
    """
    columns = pd.MultiIndex.from_product(
        [[SCORER], list(poses.joints), list(coords)], names=["scorer", "bodyparts", "coords"]
    )
    return pd.DataFrame(values.reshape(len(values), -1), index=poses.frame_index, columns=columns)


def _write_times(path: Path, poses: Poses) -> None:
    """Write a CSV with the true time of each row, for formats that do not hold times.

    Args:
        path: the CSV file to write: frame_index, time_s with nine decimals, pulse_index.
        poses: the session's poses.
    """
    rows = zip(poses.frame_index, poses.time_s, poses.pulse_index, strict=True)
    lines = [f"{index},{time:.9f},{pulse}" for index, time, pulse in rows]
    path.write_text("\n".join(["frame_index,time_s,pulse_index", *lines]) + "\n", encoding="utf-8")
