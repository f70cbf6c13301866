"""A session's poses as plain arrays, from which every other program's format is made."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from liex_lab.sessions import Session

Array = NDArray[np.float64]
_COLUMNS = [
    "frame_index",
    "time_s",
    "joint",
    "x_mm",
    "y_mm",
    "z_mm",
    "u_px",
    "v_px",
    "score",
    "sd_mm",
]


@dataclass(frozen=True)
class Poses:
    """Poses of one animal, one row for every recorded frame; NaN where there is no pose.

    Attributes:
        individual: the animal's name.
        joints: names of the J joints.
        bones: pairs of joint indices, parent and child.
        frame_index: (n,) int64, the camera's frame count.
        time_s: (n,) s since the first frame.
        xyz_mm: (n, J, 3) mm, arena frame.
        uv_px: (n, J, 2) px of the depth picture; (0, 0) is the centre of the top-left pixel.
        score: (n, J) probability that the joint lies within 10 % of the spine's length of the
            truth.
        sd_mm: (n, J) standard deviation of the joint along one axis, mm.
    """

    individual: str
    joints: tuple[str, ...]
    bones: tuple[tuple[int, int], ...]
    frame_index: NDArray[np.int64]
    time_s: Array
    xyz_mm: Array
    uv_px: Array
    score: Array
    sd_mm: Array

    @staticmethod
    def of(session: Session) -> Poses:
        """The poses of a session.

        Args:
            session: the session.
        """
        about = session.metadata
        joints = tuple(about["animal"]["joints"])
        table = session.table("poses", _COLUMNS)
        n = len(joints)
        shape = (-1, len(joints))

        def array(*names: str) -> Array:
            columns = [table[name].to_numpy(float).reshape(shape) for name in names]
            return np.stack(columns, axis=-1) if len(names) > 1 else columns[0]

        return Poses(
            about["individual"],
            joints,
            tuple((int(a), int(b)) for a, b in about["animal"]["bones"]),
            table["frame_index"].to_numpy()[::n],
            table["time_s"].to_numpy(float)[::n],
            array("x_mm", "y_mm", "z_mm"),
            array("u_px", "v_px"),
            array("score"),
            array("sd_mm"),
        )


def write_times(path: Path, poses: Poses) -> None:
    """Write a CSV with the true time of each row, for formats that do not hold times.

    Args:
        path: the CSV file to write: frame_index, time_s with nine decimals.
        poses: the session's poses.
    """
    lines = [
        f"{index},{time:.9f}" for index, time in zip(poses.frame_index, poses.time_s, strict=True)
    ]
    path.write_text("\n".join(["frame_index,time_s", *lines]) + "\n", encoding="utf-8")
