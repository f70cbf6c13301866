"""Intermediate results of a session, read back: observations, skeleton, track, provenance,
recording.

The file observations.npz contains the pose hypotheses of every frame, before association and
smoothing, and their animal and camera. After a correction, the track is recomputed from them.
"""

from __future__ import annotations

import json
import os
import zipfile
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from liex_lab.body.skeleton import Skeleton
from liex_lab.errors import SessionError
from liex_lab.geometry import so3
from liex_lab.recordings.timestamps import Gap
from liex_lab.runtime.memory import blocks, check_npz
from liex_lab.sessions.document import reading_from
from liex_lab.sessions.provenance import Provenance
from liex_lab.sessions.track_tables import spreads
from liex_lab.tables.rows import LOST
from liex_lab.tables.schema import ROOT_COVARIANCES
from liex_lab.tracking.observations import COLUMNS, Observations
from liex_lab.tracking.track import Flip, Subject, Track

if TYPE_CHECKING:
    import pandas as pd

    from liex_lab.sessions.session import Session

_SCALARS = ("scale", "predicted_error_mm", "residual_mm", "n_foreground_px", "p_flip", "bridged")

_ADDRESS = "synthetic:"

Array = NDArray[np.float64]

FILE = "observations.npz"
# columns that sessions of earlier versions lack
_LATER = ("covered", "beside", "behind", "part_mm", "repeats")
_BYTES_PER_JOINT = 1 << 10  # upper limit per frame, several times the true size
_SPARE_BYTES = 1 << 26  # for the skeleton and its mesh
_BLOCK = 16_384  # frames in memory at a time


def write_evidence(folder: Path, seen: Observations, subject: Subject) -> None:
    """Write observations.npz, a compressed NumPy archive without pickle.

    Frames are written in blocks, so that long recordings need little memory.

    Args:
        folder: the folder of the file.
        seen: the hypotheses of every frame.
        subject: their animal and camera.
    """
    facts = {
        "skeleton": subject.skeleton.table,
        "length_mm": subject.length_mm,
        "doubtful_mm": subject.doubtful_mm,
        "bridge_s": subject.bridge_s,
        "joint_share": list(subject.joint_share),
        "stretch_sd": subject.stretch_sd,
        "unseen": None if subject.unseen is None else list(subject.unseen),
        "n_animals": subject.n_animals,
    }
    told = np.frombuffer(json.dumps(facts).encode(), np.uint8)
    columns = {"subject": told, **{name: getattr(seen, name) for name in COLUMNS}}
    with zipfile.ZipFile(
        folder / FILE, "w", zipfile.ZIP_DEFLATED
    ) as kept:  # as np.savez_compressed, in parts
        for name, values in columns.items():
            with kept.open(f"{name}.npy", "w", force_zip64=True) as file:
                kind = np.lib.format.dtype_to_descr(values.dtype)
                head = {"descr": kind, "fortran_order": False, "shape": values.shape}
                np.lib.format.write_array_header_1_0(file, head)
                for rows in blocks(len(values), _BLOCK):
                    file.write(np.ascontiguousarray(values[rows]).tobytes())


def read_skeleton(session: Session) -> Skeleton | None:
    """The skeleton of a session's observations; None for a session without observations.

    Args:
        session: the session.

    Raises:
        SessionError: the file is damaged.
    """
    path = session.path / FILE
    if not path.is_file():
        return None
    with (
        reading_from(path),
        _opened(path, session) as file,
        np.load(file, allow_pickle=False) as kept,
    ):
        return Skeleton.from_table(json.loads(kept["subject"].tobytes())["skeleton"], str(path))


def read_evidence(session: Session) -> tuple[Observations, Subject]:
    """Read the file written by `write_evidence`.

    Args:
        session: the session.

    Returns:
        The hypotheses of every frame, and their animal and camera.

    Raises:
        SessionError: the session has no observations, as in earlier versions, or the file is
            damaged.
    """
    path = session.path / FILE
    if not path.is_file():
        raise SessionError(
            f"{session.path} does not hold what its single frames said ({FILE}), as sessions of "
            "earlier versions; run `liex run` on the recording again"
        )
    with (
        reading_from(path),
        _opened(path, session) as file,
        np.load(file, allow_pickle=False) as kept,
    ):
        facts = json.loads(kept["subject"].tobytes())
        skeleton = Skeleton.from_table(facts["skeleton"], str(path))
        none = Observations.empty(skeleton, np.zeros(len(session.frames), np.int64))
        seen = Observations(
            skeleton,
            *(
                getattr(none, name) if name in _LATER and name not in kept else kept[name]
                for name in COLUMNS
            ),
        )
        _check_shapes(seen, len(session.frames))
        # missing in sessions of earlier versions
        stretch = facts.get("stretch_sd")
        unseen = facts.get("unseen")
        subject = Subject(
            skeleton,
            session.camera,
            session.T_arena_camera,
            float(facts["length_mm"]),
            float(facts["doubtful_mm"]),
            float(facts["bridge_s"]),
            tuple(float(share) for share in facts["joint_share"]),
            None if stretch is None else float(stretch),
            None if unseen is None else (float(unseen[0]), float(unseen[1])),
            int(facts.get("n_animals", 1)),
        )
    return seen, subject


def read_things(session: Session) -> NDArray[np.float64] | None:
    """Positions of the two likeliest objects of every frame, without the rest of the observations.

    Args:
        session: the session.

    Returns:
        (n, 2, 3) centre of the best and of the second object of about the animal's size, arena
        frame, mm; NaN if absent. None for a session without observations.

    Raises:
        SessionError: the file is damaged.
    """
    path = session.path / FILE
    if not path.is_file():
        return None
    with (
        reading_from(path),
        _opened(path, session) as file,
        np.load(file, allow_pickle=False) as kept,
    ):
        centre = kept["centroid_mm"][:, ::2].astype(np.float64)  # h ^ 1 is the same object
        centre[~np.isfinite(kept["score"]).reshape(len(centre), -1, 2).any(axis=2)] = np.nan
        if centre.shape != (session.metadata["frames"]["n_frames"], 2, 3):
            raise ValueError(f"centres of things are {centre.shape}, not those of every frame")
    return centre


def _opened(path: Path, session: Session) -> IO[bytes]:
    """Open the file after checking its size against the numbers of frames and joints."""
    n_joints = len(session.metadata["animal"]["joints"])
    n_frames = session.metadata["frames"]["n_frames"]
    check_npz(path, _SPARE_BYTES + n_frames * (n_joints + 1) * _BYTES_PER_JOINT)
    return path.open("rb")


def _check_shapes(seen: Observations, n_frames: int) -> None:
    """Raises ValueError if the arrays do not match the number of frames."""
    wanted = Observations.empty(seen.skeleton, np.zeros(n_frames, np.int64))
    for name in COLUMNS:
        found = getattr(seen, name)
        expected = getattr(wanted, name)
        if (found.shape, found.dtype) != (expected.shape, expected.dtype):
            raise ValueError(
                f"{name} is {found.dtype} {found.shape}, not {expected.dtype} {expected.shape}"
            )


def read_flips(session: Session) -> list[Flip]:
    """The table `flips`, with frames counted by row.

    Args:
        session: the session.
    """
    index = session.frames["frame_index"].to_numpy()
    with reading_from(session.path / "flips.parquet"):
        return [
            Flip(
                int(np.searchsorted(index, row["start_frame"])),
                int(np.searchsorted(index, row["stop_frame"])),
                float(row["p_flip"]),
                bool(row["applied"]),
                str(row["source"]),
                str(row.get("undone_at", "")),
            )
            for row in _rows_of(session.flips)
        ]


def provenance_of(session: Session, skeleton: Skeleton) -> Provenance:
    """Provenance of a session, as stated when it was first written.

    Args:
        session: the session.
        skeleton: its skeleton.
    """
    about = session.metadata
    camera = session.metadata["camera"]
    source = about["input"]
    home = {"name", "joints", "bones", "home_length_mm"}
    return Provenance(
        name=session.name,
        skeleton=skeleton,
        camera=session.camera,
        T_arena_camera=session.T_arena_camera,
        floor_distance_mm=camera["floor_distance_mm"],
        input_sha256=source["sha256"],
        plan_toml=session.plan,
        format=source["format"],
        profile=source.get("profile", {}),
        individual=about["individual"],
        n_frames=len(session.frames),
        gaps=_camera_gaps(session),
        problems=about["problems"],
        truncated=source["truncated"],
        subject=about["subject"],
        session_start_time=about["session_start_time"] or "",
        model=about["model"],
        animal_size={k: v for k, v in about["animal"].items() if k not in home},
        optics=camera.get("optics", {}),
        arena=session.arena,
        zones=session.zones,
    )


def _camera_gaps(session: Session) -> list[Gap]:
    """Frames that the camera did not deliver and moved timestamps, from the table `gaps`."""
    times, index = (session.frames[name].to_numpy() for name in ("time_ns", "frame_index"))
    found = []
    for row in _rows_of(session.gaps[~session.gaps["reason"].isin(LOST)]):
        at = int(times[np.searchsorted(index, row["start_frame"])])
        missing = int(row["n_frames_missing"])
        first = at - round(1e9 * (row["stop_s"] - row["start_s"])) if missing else at
        found.append(
            Gap(
                int(row["start_frame"]),
                int(row["stop_frame"]),
                first,
                at,
                missing,
                str(row["reason"]),
            )
        )
    return found


def _rows_of(table: pd.DataFrame) -> list[dict[str, Any]]:
    """Rows of a short table as dicts."""
    return [{str(name): value for name, value in row.items()} for row in table.to_dict("records")]


def link_to(recording: str | Path, folder: Path) -> dict[str, Any]:
    """The link for the section `input` of session.json, next to the recording's hash.

    Args:
        recording: path of the recording, or address of a virtual one.
        folder: final path of the session.
    """
    if str(recording).startswith(_ADDRESS):
        return {"path": str(recording)}
    whole = Path(recording).resolve()
    try:
        return {"path": Path(os.path.relpath(whole, folder.resolve())).as_posix()}
    except ValueError:  # on another Windows drive
        return {"path": whole.as_posix()}


def linked_recording(session: Session) -> str | None:
    """Path or address of the recording, which may not exist; None if not stated, as in earlier
    versions.

    Args:
        session: the session.
    """
    stated = session.metadata["input"].get("path")
    if not isinstance(stated, str) or not stated:
        return None
    return stated if stated.startswith(_ADDRESS) else os.path.normpath(session.path / stated)


def skeleton_of(session: Session) -> Skeleton:
    """Skeleton of a session: the stored one or, for an older session, the current one.

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
    """The whole track of a session; values missing in older sessions are as in `Track.empty`.

    Args:
        session: the session.
        skeleton: its skeleton; None to read it.

    Raises:
        SessionError: the tables do not have the number of rows for the frames and joints.
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

    An older session only has the standard deviations; the rest is NaN.
    """
    out = np.zeros((len(sd), 6, 6))
    out[:, range(6), range(6)] = sd**2
    rows, columns = np.triu_indices(6, 1)
    out[:, rows, columns] = out[:, columns, rows] = _columns(roots, list(ROOT_COVARIANCES))
    return out


def wall_of(session: Session) -> Array:
    """(n,) distance of the animal from the nearest wall, mm; NaN if unknown.

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
    """Columns as one array, NaN if an older table lacks one."""
    lacking = np.full(len(table), np.nan)
    return np.column_stack(
        [table[name].to_numpy(float) if name in table else lacking for name in names]
    )
