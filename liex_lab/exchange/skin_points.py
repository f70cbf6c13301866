"""Points on the skin for programs that expect them: derived from the fitted body of a session.

Each point follows the session's own body in the pose of its frame, in the arena and in pixels.
Frames without a pose are NaN. `liex_lab.body.skin_points` gives the equations.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from liex_lab.body.skin_points import place_points, points_of
from liex_lab.errors import SessionError
from liex_lab.exchange.tail import TAIL, find_tail
from liex_lab.runtime.memory import blocks
from liex_lab.runtime.text_files import write_csv
from liex_lab.sessions import Session
from liex_lab.sessions.evidence import provenance_of, skeleton_of, track_of
from liex_lab.sessions.individuals import individuals_of
from liex_lab.sessions.rrd_scene import body_of
from liex_lab.sessions.session import PoseArrays
from liex_lab.tables.rows import NEAR, columns_of, nearness, repeated
from liex_lab.tables.schema import POINTS, write_table
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
    points = points_of(skeleton)
    track = track_of(session, skeleton)
    animal = session.metadata["animal"]
    spine_mm = animal.get("spine_mm")
    size = None if spine_mm is None else spine_mm / skeleton.length
    body = BodyResidual(*body_of(skeleton, animal), size=size)
    xyz, sd = np.full((2, track.n_frames, len(points), 3), np.nan)
    posed = np.flatnonzero(track.posed)
    for part in blocks(len(posed), _BLOCK):
        rows = posed[part]
        some = track[rows]
        girth = body.across(some.scale)
        xyz[rows], sd[rows] = place_points(points, body.surface, some.pose, girth, some.sd_xyz_mm)
    return replace(
        session.pose_arrays(),
        joints=tuple(one.name for one in points),
        bones=(),
        xyz_mm=xyz,
        uv_px=session.camera.project(session.T_arena_camera.inverse() @ xyz),
        score=nearness(np.sqrt((sd**2).mean(axis=-1)), NEAR * track.spine_mm[:, None]),
        sd_mm=sd,
    )


def write_points(sessions: Sequence[Session], path: Path) -> None:
    """Write a new folder: points.parquet, and mabe.csv in pixels in the form of MABe's tracking.

    Args:
        sessions: of the animals of one arena.
        path: the folder to write.

    Raises:
        LiexError: no points are stated for this animal.
    """
    tables, tracks = zip(*map(_points_of, sessions), strict=True)
    about = provenance_of(sessions[0], skeleton_of(sessions[0])).table_metadata() | {
        "joints": "none: points derived from the fitted body, on its skin"
    }
    path.mkdir()
    write_table(path / "points.parquet", POINTS, tables, about)
    write_csv(pd.concat(tracks), path / "mabe.csv")


def _points_of(session: Session) -> tuple[dict[str, Any], pd.DataFrame]:
    """The columns of the table `points` of one animal, and its rows of MABe's tracking."""
    skeleton, poses = skeleton_of(session), derived_points(session)
    names, n_frames = [*poses.joints], len(poses.time_s)
    xyz, sd, likelihood = poses.xyz_mm, poses.sd_mm, poses.likelihood
    angles = np.full((2, *likelihood.shape), np.nan)
    if "tail_base" in names and "tail_mm" in skeleton.surface:
        base = names.index("tail_base")
        heading = track_of(session, skeleton).root_rotation[:, :2, 0]
        tail = find_tail(session, xyz[:, base], sd[:, base], heading)
        xyz, sd = np.insert([xyz, sd], len(names), tail[:2], axis=2)
        likelihood = np.column_stack([likelihood, tail.probability])
        angles = np.insert(angles, len(names), tail[3:], axis=2)
        names.append(TAIL)
    columns = {
        "session_id": session.name,
        "individual": poses.individual,
        "frame_index": np.repeat(poses.frame_index, len(names)),
        "time_s": np.repeat(poses.time_s, len(names)),
        "point": repeated(names, n_frames),
        **columns_of(xyz, session.camera.project(session.T_arena_camera.inverse() @ xyz)),
        **{f"sd_{axis}_mm": sd[..., k].ravel() for k, axis in enumerate("xyz")},
        "turn_rad": angles[0].ravel(),
        "lift_rad": angles[1].ravel(),
        "likelihood": likelihood.ravel(),
        "derived": np.tile(np.array(names) != TAIL, n_frames),
    }
    mabe = [one.mabe or one.name for one in points_of(skeleton)]
    tracking = {
        "video_frame": np.repeat(poses.frame_index, len(mabe)),
        "mouse_id": individuals_of(session).index(poses.individual) + 1,
        "bodypart": np.tile(mabe, n_frames),
        **{axis: poses.uv_px[..., k].ravel() for k, axis in enumerate("xy")},
    }
    return columns, pd.DataFrame(tracking)
