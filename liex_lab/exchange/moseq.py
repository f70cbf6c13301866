"""MoSeq's scalars of a session, by its definitions and in true millimetres; MoSeq's syllables.

Scalars are those of moseq2-extract; of a session of its results, those that the file held.

The height over the background in whole mm, within 10 to 100, is smoothed (median of 3 pixels,
opening by 9), and the largest outline gives centroid (x, y), direction of the long axis, and with
the eigenvalues l of its second moments the lengths 2 sqrt(2) sqrt(2 l), px. Area and mean height
are those of the pixels in a square of 80 px about it, turned until the animal lies level (which
costs about 3 % of the area). MoSeq takes the angle of view where its tangent belongs, and the
floor's distance D for every height:

    x_mm = D (x - 256) / 415.5,    y_mm = D (y - 212) / 404.9    (px from the corner of its crop),

and its area_mm is pixels times mm. In true mm, a pixel is Z / f wide, with the camera's focal
length f and the distance Z = D - height_ave_mm of the animal.

Syllables, a number per frame, are read from the results of keypoint-MoSeq (results.h5, its CSV
tables, its moseq_df) and of MoSeq (the moseq_df.csv of moseq2-viz).
"""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pandas as pd

from liex_lab.arrays import Array, NDArray
from liex_lab.errors import LiexError, expecting, needing
from liex_lab.recordings.formats.moseq_results import SHAPE
from liex_lab.runtime.text_files import write_csv
from liex_lab.sessions import Session
from liex_lab.sessions.cutouts import open_depth, still_scene

_LOW_MM, _HIGH_MM = 10, 100
_HALF_PX = 40
_CENTRE_PX = np.array([256.0, 212.0])  # MoSeq's, for every camera
_FOCAL_PX = np.array([512.0, 424.0]) / np.radians([70.6, 60.0])
_TAIL = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (9, 9))


def write_scalars(session: Session, path: Path) -> None:
    """Write `scalars_moseq` as CSV.

    Raises:
        SessionError: the session keeps no depth images.
    """
    write_csv(scalars_moseq(session), path)


def scalars_moseq(session: Session) -> pd.DataFrame:
    """MoSeq's eighteen scalars, one row per frame, NaN in frames without an animal.

    Their names are MoSeq's; names with `true_mm` are metric, those that end in `_s` per second
    (MoSeq's velocities are per frame, whatever time lies between). Of a session of MoSeq's results,
    its own columns are as the file held them, and metric ones are computed from those. Otherwise
    head and tail, which the angle needs, are those of the session.

    Raises:
        SessionError: the session keeps no depth images.
    """
    poses, frames, camera = session.pose_arrays(), session.frames, session.camera
    stated = session.metadata["input"].get("profile", {})
    corner = np.array(stated.get("moseq_corner_px", (0, 0)))
    kept = pd.DataFrame()
    if session.has("moseq.parquet"):
        kept = session.table("moseq").iloc[:, 3:].dropna(axis=1, how="all")
        px = kept[[*SHAPE]].to_numpy() + np.pad(corner, (0, 5))
    else:
        with open_depth(session) as depth:
            scene = still_scene(depth).astype(float)
            px = np.array([_shape(scene - frame.depth, frame.depth > 0) for frame in depth])
    centroid = px[:, :2]
    axis, length, width, area, height = px[:, 2:].T
    floor_mm = stated.get("moseq_floor_mm", float(session.T_arena_camera.translation[2]))
    ahead = (poses.uv_px[:, -1] - poses.uv_px[:, 0]) * (1, -1)
    behind = np.sum(ahead * np.stack([np.cos(axis), np.sin(axis)], axis=1), axis=1) < 0
    places = {
        "px": np.column_stack([centroid - corner, height]),
        "mm": np.column_stack([(centroid - corner - _CENTRE_PX) * floor_mm / _FOCAL_PX, height]),
        "true_mm": np.column_stack([camera.unproject(centroid, floor_mm - height)[:, :2], height]),
    }
    scales: dict[str, Array] = {
        "px": np.ones((1, 2)),
        "mm": floor_mm / _FOCAL_PX[None],
        "true_mm": (floor_mm - height)[:, None] / (camera.fx, camera.fy),
    }
    table: dict[str, Any] = {name: frames[name] for name in ("frame_index", "time_s")}
    dt_s = frames["dt_s"].to_numpy(float)
    for unit, at in places.items():
        step = np.diff(at, axis=0, prepend=at[:1])
        along, across = scales[unit].T
        table |= {f"centroid_{name}_{unit}": at[:, k] for k, name in enumerate("xy")}
        for n in (2, 3):
            speed = np.linalg.norm(step[:, :n], axis=1)
            table |= {f"velocity_{n}d_{unit}": speed, f"velocity_{n}d_{unit}_s": speed / dt_s}
        table |= {f"length_{unit}": length * along, f"width_{unit}": width * across}
    yx = places["mm"][:, 1::-1]
    table |= {
        "area_px": area,
        "area_mm": area * scales["mm"].mean(),
        "area_true_mm2": area * scales["true_mm"].prod(axis=1),
        "height_ave_mm": height,
        "angle": _unwrapped(axis + np.pi * behind),
        "velocity_theta": np.arctan2(*np.diff(yx, axis=0, prepend=yx[:1]).T),
        "dist_to_center_px": np.linalg.norm(centroid - _middle_px(session), axis=1),
    }
    return pd.DataFrame(table | {name: kept[name] for name in kept})


def _shape(height: Array, is_read: NDArray[np.bool_]) -> tuple[float, ...]:
    """Centroid u, v px, direction rad, length, width px, area px and height mm; NaN for none."""
    kept = is_read & (height >= _LOW_MM) & (height < _HIGH_MM + 1)  # whole mm, cut off below
    smooth = cv2.medianBlur(np.where(kept, height, 0).astype(np.uint8), 3)
    smooth = cv2.morphologyEx(smooth, cv2.MORPH_OPEN, _TAIL)
    mask = (smooth > _LOW_MM).astype(np.uint8)
    outlines, _ = cv2.findContours(mask, cv2.RETR_TREE, cv2.CHAIN_APPROX_SIMPLE)
    moments = cv2.moments(max(outlines, key=cv2.contourArea)) if outlines else {"m00": 0.0}
    if not moments["m00"]:
        return (np.nan,) * 7
    m, a, b, c = (moments[name] for name in ("m00", "mu20", "mu02", "mu11"))
    root = np.hypot(2 * c, a - b)
    long, short = (2 * np.sqrt(2 * max((a + b + sign * root) / m, 0)) for sign in (1, -1))
    u, v = moments["m10"] / m, moments["m01"] / m
    angle = -0.5 * np.arctan2(2 * c, a - b)
    turn = cv2.getRotationMatrix2D((_HALF_PX, _HALF_PX), -float(np.degrees(angle)), 1)
    turn[:, 2] -= turn[:, :2] @ np.trunc(np.array([u, v]) - _HALF_PX)
    own = cv2.warpAffine(smooth, turn, (2 * _HALF_PX, 2 * _HALF_PX))
    own = own[(own > _LOW_MM) & (own < _HIGH_MM)]
    return u, v, angle, long, short, len(own), own.mean() if len(own) else np.nan


def _unwrapped(angle: Array) -> Array:
    """Angles (n,) without jumps of a whole turn; NaN stays."""
    known = np.isfinite(angle)
    angle[known] = np.unwrap(angle[known])
    return angle


def _middle_px(session: Session) -> Array:
    """Pixel (2,) of the arena's centre on the floor; NaN where the arena's shape is not known."""
    if stated := session.metadata["input"].get("profile", {}).get("moseq_middle_px"):
        return np.array(stated)  # of the box about MoSeq's region
    if session.arena.centre_mm is None:
        return np.full(2, np.nan)
    into = session.T_arena_camera.inverse()
    return session.camera.project(into @ np.array([*session.arena.centre_mm, 0.0]))


# Syllables of MoSeq and keypoint-MoSeq, as labels of a session.


MOSEQ = "moseq"
_SYLLABLE = ("syllable", "labels (original)")  # columns of keypoint-MoSeq's and MoSeq's tables
_OF = ("name", "SessionName")  # columns that name the recording


def are_syllables(path: Path) -> bool:
    """Whether a file is of a kind that syllables come in: HDF5, or CSV with a column of them."""
    if path.suffix.lower() in (".h5", ".hdf5"):
        return True
    try:
        return path.suffix.lower() == ".csv" and bool({*_SYLLABLE} & {*pd.read_csv(path, nrows=0)})
    except (OSError, ValueError):
        return False


def syllable_labels(path: Path, session: Session) -> pd.DataFrame:
    """The syllables of a session as labels, named by their numbers: syllable_07.

    Negative numbers, with which MoSeq fills frames without one, name nothing.

    Args:
        path: a file of `are_syllables`.
        session: the session; a file of several recordings names it, as session.name.

    Returns:
        A table of action, start_s, stop_s (s since the first frame) and source.

    Raises:
        LiexError: the file cannot be read, or is not of this session, frame by frame.
    """
    with expecting(
        LiexError,
        f"{path} should be the results of keypoint-MoSeq (a syllable per frame of every "
        "recording) or a moseq_df.csv",
        OSError,
        ValueError,
        KeyError,
    ):
        found = _syllables_of(path)
    name = session.name if len(found) > 1 else next(iter(found), "")
    time_s = session.frames["time_s"].to_numpy()
    numbers = found.get(name, np.empty(0))
    if len(numbers) != len(time_s):
        raise LiexError(
            f"{path} holds {len(numbers)} frames of {name} and the session {session.name} "
            f"{len(time_s)}; syllables belong to frames, so give the results of what was exported "
            f"from it (recordings in the file: {', '.join(list(found)[:5])})"
        )
    edges = np.flatnonzero(np.diff(numbers, prepend=np.nan, append=np.nan))
    start, stop = edges[:-1], edges[1:]
    labels = pd.DataFrame(
        {
            "action": [f"syllable_{int(number):02d}" for number in numbers[start]],
            "start_s": time_s[start],
            "stop_s": np.append(time_s, np.inf)[stop],
            "source": MOSEQ,
        }
    )
    return labels[numbers[start] >= 0]


def _syllables_of(path: Path) -> dict[str, NDArray[np.int64]]:
    """The syllable of every frame, -1 for none, by the recording's name."""
    if path.suffix.lower() == ".csv":
        table = pd.read_csv(path)
        column = next(name for name in _SYLLABLE if name in table)
        of = next((name for name in _OF if name in table), None)
        parts = table.groupby(of, sort=False) if of else [(path.stem, table)]
        found = {str(name): part[column].to_numpy(float) for name, part in parts}
    else:
        with needing("exchange", f"reading {path}"):
            import h5py

        with h5py.File(path, "r") as file:
            found = {name: np.asarray(file[name]["syllable"][()], float) for name in file}
    return {name: np.nan_to_num(one, nan=-1).astype(np.int64) for name, one in found.items()}
