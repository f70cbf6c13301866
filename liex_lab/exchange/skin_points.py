"""Points on the skin for programs that expect them: derived from the fitted body of a session.

Each point follows the session's own body in the pose of its frame, in the arena and in pixels.
Frames without a pose are NaN. `liex_lab.body.skin_points` gives the equations.
"""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa

from liex_lab.body.skin_points import SurfacePoints
from liex_lab.errors import SessionError
from liex_lab.runtime.memory import blocks
from liex_lab.runtime.text_files import write_csv
from liex_lab.sessions import Session
from liex_lab.sessions.evidence import provenance_of, skeleton_of, track_of
from liex_lab.sessions.rrd_scene import body_of
from liex_lab.sessions.session import PoseArrays
from liex_lab.tables.rows import NEAR, nearness
from liex_lab.tables.schema import POINTS, ROWS_PER_GROUP, Block, write_table
from liex_lab.tracking.residual import BodyResidual

_BLOCK = 2048  # frames whose meshes are in memory at once, about 30 MB


def derived_points(session: Session) -> PoseArrays:
    """The points on the skin as arrays by frame and point, in the form of the session's poses.

    Args:
        session: the session.

    Raises:
        LiexError: no points are stated for this animal, or the session was imported without depth.
    """
    if session.metadata.get("imported"):
        raise SessionError(
            f"points on the skin need a body fitted to depth, and the joints of {session.path} "
            "were imported without it; export the joints"
        )
    skeleton = skeleton_of(session)
    points = SurfacePoints.of(skeleton)
    track = track_of(session, skeleton)
    animal = session.metadata["animal"]
    spine_mm = animal.get("spine_mm")
    size = None if spine_mm is None else spine_mm / skeleton.length
    body = BodyResidual(*body_of(skeleton, animal), size=size)
    xyz, sd = np.full((2, track.n_frames, len(points.names), 3), np.nan)
    posed = np.flatnonzero(track.posed)
    for part in blocks(len(posed), _BLOCK):
        rows = posed[part]
        some = track[rows]
        girth = body.across(some.scale)
        xyz[rows], sd[rows] = points.placed(body.surface, some.pose, girth, some.sd_xyz_mm)
    return replace(
        session.pose_arrays(),
        joints=points.names,
        bones=(),
        xyz_mm=xyz,
        uv_px=session.camera.project(session.T_arena_camera.inverse() @ xyz),
        score=nearness(np.sqrt((sd**2).mean(axis=-1)), NEAR * track.spine_mm[:, None]),
        sd_mm=sd,
    )


def write_points(session: Session, path: Path) -> None:
    """Write a new folder: points.parquet, and mabe.csv in pixels in the form of MABe's tracking.

    Args:
        session: the session.
        path: the folder to write.

    Raises:
        LiexError: no points are stated for this animal.
    """
    skeleton = skeleton_of(session)
    poses = derived_points(session)
    path.mkdir()
    about = provenance_of(session, skeleton).table_metadata()
    about["joints"] = "none: points derived from the fitted body, on its skin"
    write_table(path / "points.parquet", POINTS, _rows(session.name, poses), about)
    n = len(poses.joints)
    tracking = pd.DataFrame(
        {
            "video_frame": np.repeat(poses.frame_index, n),
            "mouse_id": 1,
            "bodypart": np.tile(SurfacePoints.of(skeleton).mabe, len(poses.frame_index)),
            **{axis: poses.uv_px[..., k].ravel() for k, axis in enumerate("xy")},
        }
    )
    write_csv(tracking, path / "mabe.csv")


def _rows(name: str, poses: PoseArrays) -> Iterator[Block]:
    """The table `points`, one row per frame and point, in blocks of about 100 000 rows."""
    n = len(poses.joints)
    likelihood = poses.likelihood
    for part in blocks(len(poses.frame_index), ROWS_PER_GROUP // n):
        frames = poses.frame_index[part]
        yield {
            "session_id": name,
            "individual": poses.individual,
            "frame_index": np.repeat(frames, n),
            "time_s": np.repeat(poses.time_s[part], n),
            "point": pa.DictionaryArray.from_arrays(
                np.tile(np.arange(n), len(frames)), list(poses.joints)
            ),
            **{f"{a}_mm": poses.xyz_mm[part, :, k].ravel() for k, a in enumerate("xyz")},
            **{f"sd_{a}_mm": poses.sd_mm[part, :, k].ravel() for k, a in enumerate("xyz")},
            **{f"{a}_px": poses.uv_px[part, :, k].ravel() for k, a in enumerate("uv")},
            "likelihood": likelihood[part].ravel(),
            "derived": np.ones(n * len(frames), np.bool_),
        }
