"""Poses data set of the Python package movement: xarray in memory, netCDF on disk.

`movement.io` and xarray open it. movement's own loaders make times from one frame rate; here the
time coordinate holds the frames' true times.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from liex_lab.exchange.poses import Poses
from liex_lab.sessions import Session

if TYPE_CHECKING:
    import xarray


def to_movement(session: Session) -> xarray.Dataset:
    """The session as a movement poses data set.

    The dimensions are time (s since the first frame), space (x, y, z; mm, arena frame), keypoints
    and individuals; the variables position, confidence, sd_mm and action.

    Args:
        session: the session.
    """
    import xarray

    poses = Poses.of(session)
    dims = ("time", "space", "keypoints", "individuals")
    rate = session.metadata["frames"]["fps_median"]
    attrs: dict[str, Any] = {
        "source_software": "liex_lab",
        "ds_type": "poses",
        "time_unit": "seconds",
        "source_file": session.path.name,
        "space_unit": "mm",
        "axes": "arena: z up from the floor",
        **({"fps": float(rate)} if rate else {}),
    }
    return xarray.Dataset(
        data_vars={
            "position": (dims, np.moveaxis(poses.xyz_mm, 1, 2)[..., None]),
            "confidence": (("time", "keypoints", "individuals"), poses.score[..., None]),
            "sd_mm": (("time", "keypoints", "individuals"), poses.sd_mm[..., None]),
            "action": (("time", "individuals"), _actions(session, poses)[:, None]),
        },
        coords={
            "time": poses.time_s,
            "space": ["x", "y", "z"],
            "keypoints": list(poses.joints),
            "individuals": [poses.individual],
        },
        attrs=attrs,
    )


def _actions(session: Session, poses: Poses) -> np.ndarray[Any, Any]:
    """(n,) the action of every frame, empty where it has none."""
    out = np.full(len(poses.frame_index), "", dtype=object)
    bouts = session.bouts
    starts = np.searchsorted(poses.frame_index, bouts["start_frame"].to_numpy())
    stops = np.searchsorted(poses.frame_index, bouts["stop_frame"].to_numpy())
    for start, stop, action in zip(starts, stops, bouts["action"], strict=True):
        out[start:stop] = action
    return out.astype(str)


def write(session: Session, path: Path) -> None:
    """Write netCDF 4.

    Args:
        session: the session.
        path: the .nc file to write.
    """
    to_movement(session).to_netcdf(path, engine="h5netcdf")
