"""Results of a session as tables, and its intermediate results read back for corrections.

`Results` writes the tables of a track. The file observations.npz contains the pose hypotheses of
every frame, before association and smoothing, with their animal and camera; after a correction, the
track is recomputed from them.
"""

import json
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from zipfile import ZIP_DEFLATED, ZipFile

import numpy as np
import pandas as pd

from liex_lab.arrays import Array, NDArray
from liex_lab.body.skeleton import Skeleton
from liex_lab.errors import SessionError
from liex_lab.geometry import so3
from liex_lab.recordings.timestamps import Gap
from liex_lab.runtime import memory, text_files
from liex_lab.sessions.provenance import Provenance, package_version, reading_from
from liex_lab.sessions.session import Session, spreads
from liex_lab.sessions.verdict import SUBJECT
from liex_lab.tables import schema as tables
from liex_lab.tables.rows import NOT_FROM_CAMERA, Rows, median_step, stop_times
from liex_lab.tracking.observations import COLUMNS, Observations
from liex_lab.tracking.track import Crossing, Flip, Subject, Track

FILE = "observations.npz"
_ROWS = 10_000  # written at once
_ADDRESS = "synthetic:"


@dataclass(frozen=True)
class Results:
    """A track as rows, with its provenance.

    Attributes:
        origin: provenance of the recording.
        rows: the track in the form of the tables.
        flips: intervals in which head and tail may be exchanged.
        crossings: those with other animals; None if it was measured alone.
    """

    origin: Provenance
    rows: Rows
    flips: Sequence[Flip] = ()
    crossings: Sequence[Crossing] | None = None

    def write_track(self, folder: Path) -> None:
        """Write the tables of the track itself: frames, poses, rotations, gaps, flips, sessions.

        Args:
            folder: the folder of the Parquet files.
        """
        rows = self.rows
        described = self.origin.table_metadata()
        own: dict[str, Any] = {
            "frames": rows.frames(),
            "poses": rows.poses(),
            "rotations": rows.rotations(),
            "gaps": [rows.gaps()],
            "flips": [rows.flips(self.flips)],
            "sessions": [self.session_row()],
        }
        for name, blocks in own.items():
            tables.write_table(folder / f"{name}.parquet", tables.TABLES[name], blocks, described)
        if self.crossings is not None:
            met = [rows.crossings(self.crossings)]
            tables.write_table(folder / "crossings.parquet", tables.CROSSINGS, met, described)

    def write_measured(
        self, folder: Path, results: Mapping[str, pd.DataFrame], columns: Sequence[tables.Column]
    ) -> None:
        """Write the tables of behaviour, summary.csv, and columns.json, which describes all tables.

        Args:
            folder: the folder of the files.
            results: tables by name; a table without any described column is left out.
            columns: descriptions of columns beyond those of `tables.TABLES`.

        Raises:
            SessionError: a table has a column that is not described.
        """
        described = self.origin.table_metadata()
        for name, result in results.items():
            schema = [*tables.TABLES.get(name, ()), *(c for c in columns if c.table == name)]
            if not schema:  # kinematics without any measure
                continue
            if name == "summary":
                tables.check_described(result.columns, schema, name)
                text_files.write_csv(result, folder / "summary.csv")
            else:
                tables.write_table(
                    folder / f"{name}.parquet", schema, tables.from_pandas(result), described
                )
        met = () if self.crossings is None else tables.CROSSINGS
        text = json.dumps(tables.dictionary(columns, met), indent=1, ensure_ascii=False)
        (folder / "columns.json").write_text(text + "\n", encoding="utf-8")

    def session_row(self) -> dict[str, Any]:
        """The row of the table `sessions`."""
        rows = self.rows
        origin = self.origin
        observed = rows.track.observed
        step = median_step(rows.time_s)
        return {
            "session_id": rows.session_id,
            "individual": rows.individual,
            **{name: origin.subject.get(name, "") for name in SUBJECT},
            "session_start_time": origin.session_start_time,
            "n_frames": rows.track.n_frames,
            "n_frames_observed": int(observed.sum()),
            "observed_s": float((stop_times(rows.time_s) - rows.time_s)[observed].sum()),
            "fps_median": 1.0 / step if step else float("nan"),
            "calibration_hash": origin.calibration_hash,
            "software_version": package_version("liex_lab"),
        }

    def counts(self) -> dict[str, Any]:
        """Counts of frames and of their flags: section `frames` of session.json."""
        counts = self.rows.frames_table["flag"].astype("category").value_counts()
        missing = self.rows.missing_before()
        row = self.session_row()
        return {
            "n_frames": row["n_frames"],
            "n_observed": row["n_frames_observed"],
            "flags": {flag or "good": int(n) for flag, n in sorted(counts.items())},
            "n_missing": int(missing.sum()),
            "n_gaps": int((missing > 0).sum()),
            "duration_s": float(stop_times(self.rows.time_s)[-1]),
            "observed_s": row["observed_s"],
            "fps_median": None if np.isnan(row["fps_median"]) else row["fps_median"],
        }


def write_evidence(folder: Path, observations: Observations, subject: Subject) -> None:
    """Write observations.npz, a compressed NumPy archive without pickle.

    Args:
        folder: the folder of the file.
        observations: the hypotheses of every frame.
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
        "n_measured": subject.n_measured,
    }
    columns = {name: getattr(observations, name) for name in COLUMNS}
    columns["subject"] = np.frombuffer(json.dumps(facts).encode(), np.uint8)
    with ZipFile(folder / FILE, "w", ZIP_DEFLATED) as archive:  # as NumPy does, but in blocks
        for name, values in columns.items():
            header = {"descr": values.dtype.str, "fortran_order": False, "shape": values.shape}
            with archive.open(f"{name}.npy", "w", force_zip64=True) as file:
                np.lib.format.write_array_header_1_0(file, header)
                for rows in memory.blocks(len(values), _ROWS):
                    file.write(np.ascontiguousarray(values[rows]).tobytes())


@contextmanager
def _opened(session: Session) -> Iterator[Any]:
    """The arrays of observations.npz by name; `subject` is JSON on their animal.

    The file's size is checked against the numbers of frames and joints.

    Raises:
        SessionError: the file is damaged.
    """
    n_joints = len(session.metadata["animal"]["joints"])
    n_frames = session.metadata["frames"]["n_frames"]
    with reading_from(session.path / FILE) as path:
        # several times the true size per frame, and 64 MiB for the skeleton and its mesh
        memory.check_npz(path, (1 << 26) + n_frames * (n_joints + 1) * (1 << 10))
        with path.open("rb") as file, np.load(file, allow_pickle=False) as arrays:
            yield arrays


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
    if not session.has(FILE):
        raise SessionError(
            f"{session.path} lacks the observations of single frames ({FILE}), "
            + (
                "since its poses are imported points; correct these points and import them again"
                if session.metadata.get("imported")
                else "as sessions of earlier versions do; run `liex run` on the recording again"
            )
        )
    with _opened(session) as arrays:
        facts = json.loads(arrays["subject"].tobytes())
        skeleton = Skeleton.from_table(facts["skeleton"], str(session.path / FILE))
        empty = Observations.empty(skeleton, np.zeros(len(session.frames), np.int64))
        columns = []
        for name in COLUMNS:
            expected = getattr(empty, name)
            later = name in ("covered", "beside", "behind", "part_mm", "repeats", "objects")
            found = expected if later and name not in arrays else arrays[name]
            if (found.shape, found.dtype) != (expected.shape, expected.dtype):
                raise ValueError(
                    f"{name} is {found.dtype} {found.shape}, not {expected.dtype} {expected.shape}"
                )
            columns.append(found)
        # the last three are missing in sessions of earlier versions
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
            int(facts.get("n_measured", 1)),
        )
    return Observations(skeleton, *columns), subject


def read_centres(session: Session) -> NDArray[np.float64] | None:
    """Positions of the two likeliest objects of every frame, without the rest of the observations.

    Args:
        session: the session.

    Returns:
        (n, 2, 3) centre of the best and of the second object of about the animal's size, arena
        frame, mm; NaN if absent. None for a session without observations.

    Raises:
        SessionError: the file is damaged.
    """
    if not session.has(FILE):
        return None
    with _opened(session) as arrays:
        centre = arrays["centroid_mm"][:, ::2].astype(np.float64)  # h ^ 1 is the same object
        found = np.isfinite(arrays["score"]).reshape(len(centre), -1, 2).any(axis=2)
        centre[~found] = np.nan
        if centre.shape != (session.metadata["frames"]["n_frames"], 2, 3):
            raise ValueError(f"centres of objects are {centre.shape}, not those of every frame")
    return centre


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
            for row in session.flips.to_dict("records")
        ]


def read_crossings(session: Session) -> tuple[Crossing, ...] | None:
    """The table `crossings`, with frames counted by row; None for an animal measured alone.

    Args:
        session: the session.
    """
    if not session.has("crossings.parquet"):
        return None
    index = session.frames["frame_index"].to_numpy()
    with reading_from(session.file("crossings.parquet")):
        return tuple(
            Crossing(
                int(np.searchsorted(index, row["start_frame"])),
                int(np.searchsorted(index, row["stop_frame"])),
                tuple(int(name.removeprefix("animal")) - 1 for name in row["animals"].split(";")),
                float(row["p_swap"]),
                str(row["decided_by"]),
                str(row.get("reviewed_by", "")),  # missing in earlier versions
                str(row.get("reviewed_at", "")),
            )
            for row in session.crossings.to_dict("records")
        )


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
    lost_by_camera = session.gaps[~session.gaps["reason"].isin(NOT_FROM_CAMERA)]
    found = []
    for row in lost_by_camera.to_dict("records"):
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
    if session.has(FILE):
        with _opened(session) as arrays:
            facts = json.loads(arrays["subject"].tobytes())
            return Skeleton.from_table(facts["skeleton"], str(session.path / FILE))
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
    poses = session.poses
    rotations = session.rotations
    n = len(frames)
    j = skeleton.n_joints
    if len(poses) != n * j or len(rotations) != n * (j + 1):
        raise SessionError(
            f"{session.path} holds {len(poses)} rows of poses for {n} frames, {j} joints; run it "
            "again"
        )

    def turned(name: str) -> Array:
        return _columns(rotations, [name.format(a) for a in "xyz"]).reshape(n, j + 1, 3)

    track = Track.empty(skeleton, frames["time_ns"].to_numpy(np.int64))
    track.joints_mm[:] = _columns(poses, [f"{a}_mm" for a in "xyz"]).reshape(n, j, 3)
    track.uv_px[:] = _columns(poses, ["u_px", "v_px"]).reshape(n, j, 2)
    track.sd_mm[:] = poses["sd_mm"].to_numpy(float).reshape(n, j)
    track.sd_xy_mm[:], _, track.sd_z_mm[:] = np.moveaxis(spreads(poses).reshape(n, j, 3), -1, 0)
    turns = turned("w{}_rad")
    spread = turned("sd_w{}_rad")
    track.angles_rad[:] = turns[:, 1:]
    track.sd_angles_rad[:] = spread[:, 1:]
    posed = np.isfinite(turns[:, 0]).all(axis=1)
    track.root_rotation[posed] = so3.exp(turns[posed, 0])
    track.root_mm[:] = turned("t{}_mm")[:, 0]
    sd = np.concatenate([spread[:, 0], turned("sd_t{}_mm")[:, 0]], axis=1)
    covariance = track.cov_root  # NaN off the diagonal for an older session
    covariance[:, range(6), range(6)] = sd**2
    rows, columns = np.triu_indices(6, 1)
    pairs = _columns(rotations.iloc[:: j + 1], list(tables.ROOT_COVARIANCES))
    covariance[:, rows, columns] = covariance[:, columns, rows] = pairs
    for name in (
        "scale",
        "predicted_error_mm",
        "residual_mm",
        "n_foreground_px",
        "p_flip",
        "bridged",
        "n_animals",
    ):
        if name in frames:
            getattr(track, name)[:] = frames[name].to_numpy()
    track.centroid_mm[:] = _columns(frames, [f"centroid_{a}_mm" for a in "xyz"])
    track.centroid_px[:] = _columns(frames, [f"centroid_{a}_px" for a in "uv"])
    track.flag[:] = frames["flag"].to_numpy().astype(track.flag.dtype)
    return track


def wall_of(session: Session) -> Array:
    """(n,) distance of the animal from the nearest wall, mm; NaN if unknown."""
    return _columns(session.frames, ["wall_distance_mm"])[:, 0]


def _columns(table: pd.DataFrame, names: list[str]) -> Array:
    """Columns as one array, NaN if an older table lacks one."""
    lacking = np.full(len(table), np.nan)
    return np.column_stack(
        [table[name].to_numpy(float) if name in table else lacking for name in names]
    )
