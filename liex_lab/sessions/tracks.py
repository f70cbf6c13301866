"""Track of a session, read back from its Parquet tables."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from liex_lab.body.skeleton import Skeleton
from liex_lab.errors import SessionError
from liex_lab.geometry import so3
from liex_lab.sessions.evidence import read_skeleton
from liex_lab.sessions.pose_arrays import spreads
from liex_lab.tables.schema import ROOT_COVARIANCES
from liex_lab.tracking.track import Track

if TYPE_CHECKING:
    import pandas as pd

    from liex_lab.sessions.session import Session

Array = NDArray[np.float64]

_SCALARS = ("scale", "predicted_error_mm", "residual_mm", "n_foreground_px", "p_flip", "bridged")


def skeleton_of(session: Session) -> Skeleton:
    """Skeleton of a session: as it was then or, for an older session, as it is now.

    Args:
        session: the session.
    """
    kept = read_skeleton(session)
    if kept is not None:
        return kept
    planned = session.metadata["plan"].get("animal")
    return Skeleton.load(
        planned["skeleton"] if isinstance(planned, dict) else session.metadata["animal"]["name"]
    )


def track_of(session: Session, skeleton: Skeleton | None = None) -> Track:
    """The whole track of a session; what an older session does not tell is as in `Track.empty`.

    Args:
        session: the session.
        skeleton: its skeleton; None reads it.

    Raises:
        SessionError: the tables have other numbers of rows than the frames and joints need.
    """
    skeleton = skeleton or skeleton_of(session)
    frames = session.frames
    n = len(session.frames)
    j = skeleton.n_joints
    poses = session.poses
    rotations = session.rotations
    if len(poses) != n * j or len(rotations) != n * (j + 1):
        raise SessionError(
            f"{session.path} holds {len(poses)} rows of poses for {n} frames, {j} joints; run it "
            "again"
        )
    track = Track.empty(skeleton, frames["time_ns"].to_numpy(np.int64))
    track.joints_mm[:] = _columns(poses, [f"{a}_mm" for a in "xyz"]).reshape(n, j, 3)
    track.uv_px[:] = _columns(poses, ["u_px", "v_px"]).reshape(n, j, 2)
    track.sd_mm[:] = poses["sd_mm"].to_numpy(float).reshape(n, j)
    track.sd_xy_mm[:], _, track.sd_z_mm[:] = np.moveaxis(spreads(poses).reshape(n, j, 3), -1, 0)
    turns = _columns(rotations, [f"w{a}_rad" for a in "xyz"]).reshape(n, j + 1, 3)
    spread = _columns(rotations, [f"sd_w{a}_rad" for a in "xyz"]).reshape(n, j + 1, 3)
    track.angles_rad[:] = turns[:, 1:]
    track.sd_angles_rad[:] = spread[:, 1:]
    seen = np.isfinite(turns[:, 0]).all(axis=1)
    track.root_rotation[seen] = so3.exp(turns[seen, 0])
    track.root_mm[:] = _columns(rotations, [f"t{a}_mm" for a in "xyz"]).reshape(n, j + 1, 3)[:, 0]
    shift = _columns(rotations, [f"sd_t{a}_mm" for a in "xyz"]).reshape(n, j + 1, 3)[:, 0]
    track.cov_root[:] = _covariance(
        rotations.iloc[:: j + 1], np.concatenate([spread[:, 0], shift], axis=1)
    )
    for name in _SCALARS:
        if name in frames:
            getattr(track, name)[:] = frames[name].to_numpy()
    track.centroid_mm[:] = _columns(frames, [f"centroid_{a}_mm" for a in "xyz"])
    track.centroid_px[:] = _columns(frames, [f"centroid_{a}_px" for a in "uv"])
    track.flag[:] = frames["flag"].to_numpy().astype(track.flag.dtype)
    return track


def _covariance(roots: pd.DataFrame, sd: Array) -> Array:
    """Covariances (n, 6, 6) of the root from its rows and its standard deviations (n, 6).

    Of an older session the standard deviations alone are known; the rest is NaN.
    """
    out = np.zeros((len(sd), 6, 6))
    out[:, range(6), range(6)] = sd**2
    rows, columns = np.triu_indices(6, 1)
    out[:, rows, columns] = out[:, columns, rows] = _columns(roots, list(ROOT_COVARIANCES))
    return out


def wall_of(session: Session) -> Array:
    """(n,) distance of the animal from the nearest wall, mm; NaN where it is not known.

    Args:
        session: the session.
    """
    frames = session.frames
    return (
        frames["wall_distance_mm"].to_numpy(float)
        if "wall_distance_mm" in frames
        else np.full(len(frames), np.nan)
    )


def _columns(table: pd.DataFrame, names: list[str]) -> Array:
    """Columns side by side, NaN where an older table lacks one."""
    lacking = np.full(len(table), np.nan)
    return np.column_stack(
        [table[name].to_numpy(float) if name in table else lacking for name in names]
    )
