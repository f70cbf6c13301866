"""A session's tables as the track that they were made from."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from liex_lab.body.skeleton import Skeleton
from liex_lab.errors import SessionError
from liex_lab.geometry import so3
from liex_lab.sessions import Session
from liex_lab.tracking.track import Track

Array = NDArray[np.float64]


def track_of(session: Session) -> Track:
    """The track of a session, as far as its tables tell."""
    planned = session.metadata["plan"].get("animal")
    skeleton = Skeleton.load(planned["skeleton"] if isinstance(planned, dict) else session.metadata["animal"]["name"])
    frames, n, j = session.frames, len(session.frames), skeleton.n_joints
    poses, rotations = session.poses, session.rotations
    if len(poses) != n * j or len(rotations) != n * (j + 1):
        raise SessionError(f"{session.path} holds {len(poses)} rows of poses for {n} frames, {j} joints; run it again")
    track = Track.empty(skeleton, frames["time_ns"].to_numpy(np.int64))
    track.joints_mm[:] = poses[["x_mm", "y_mm", "z_mm"]].to_numpy(float).reshape(n, j, 3)
    track.sd_mm[:] = poses["sd_mm"].to_numpy(float).reshape(n, j)
    turns = rotations[["wx_rad", "wy_rad", "wz_rad"]].to_numpy(float).reshape(n, j + 1, 3)
    track.angles_rad[:] = turns[:, 1:]
    seen = np.isfinite(turns[:, 0]).all(axis=1)
    track.root_rotation[seen] = so3.exp(turns[seen, 0])
    track.root_mm[:] = rotations[["tx_mm", "ty_mm", "tz_mm"]].to_numpy(float).reshape(n, j + 1, 3)[:, 0]
    track.scale[:] = frames["scale"].to_numpy(float)
    track.predicted_error_mm[:] = frames["predicted_error_mm"].to_numpy(float)
    track.flag[:] = frames["flag"].to_numpy().astype(track.flag.dtype)
    return track


def wall_of(session: Session) -> Array:
    """(n,) distance from the nearest wall, mm; NaN where it is not known."""
    frames = session.frames
    return frames["wall_distance_mm"].to_numpy(float) if "wall_distance_mm" in frames else np.full(len(frames), np.nan)
