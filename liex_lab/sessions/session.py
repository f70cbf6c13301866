"""Reader of a session folder: Parquet tables, JSON metadata, Rerun and MCAP logs of one recording.

Tables are read on demand. In a corrected session, the corrected tables replace the measured ones
(see `liex_lab.sessions.corrections`).
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
import pyarrow.parquet as pq

from liex_lab.arrays import Array, NDArray
from liex_lab.errors import SessionError, needing
from liex_lab.geometry import SE3
from liex_lab.optics.camera import Camera
from liex_lab.runtime import durable, memory, text_files
from liex_lab.scene.scene import Arena
from liex_lab.scene.zones import Zone
from liex_lab.sessions.corrections import (
    Log,
    applies,
    corrected_folder,
    read_log,
    with_description,
)
from liex_lab.sessions.folder import put_back_session
from liex_lab.sessions.provenance import read_document, reading_from
from liex_lab.tables.schema import FRAMES, check_footer, check_rows
from liex_lab.tracking.track import CORRECTED

if TYPE_CHECKING:
    import xarray

FILES = {  # of a session, and whether every version writes it
    "session.json": True,
    "plan.toml": True,
    "frames.parquet": True,
    "poses.parquet": True,
    "rotations.parquet": True,
    "kinematics.parquet": False,
    "bouts.parquet": True,
    "gaps.parquet": True,
    "flips.parquet": True,
    "crossings.parquet": False,
    "sessions.parquet": True,
    "summary.csv": False,
    "transitions.parquet": False,
    "activity.parquet": False,
    "hours.parquet": False,
    "rhythm.parquet": False,
    "periods.parquet": False,
    "zones.parquet": False,
    "interactions.parquet": False,
    "interaction_totals.parquet": False,
    "triggers.parquet": False,
    "moseq.parquet": False,
    "columns.json": True,
    "session.rrd": True,
    "session.mcap": True,
    "observations.npz": False,
    "cutouts.npz": False,
    "replay.rbl": False,
    "foxglove.json": False,
}
_LONG = 1_000_000  # rows of a table that is kept on the disk instead of in memory
PULSE = next(column for column in FRAMES if column.name == "pulse_index")


def _table(name: str, what: str) -> cached_property[pd.DataFrame]:
    """A table of a session as a property, read when it is first used."""

    def read(session: Session) -> pd.DataFrame:
        return session.table(name)

    read.__doc__ = what
    return cached_property(read)


class Session:
    """The results of one recording, read from its folder on demand.

    Tables are pandas data frames. Create one with `Session.open`.

    Attributes:
        path: the session folder.
        metadata: the content of session.json, with corrections applied.
        log: the corrections that apply; an empty log if there are none, if they were made on
            another measurement, or if the session was opened raw.

    Args:
        path: the session folder.
        metadata: the content of session.json.
        log: the corrections that apply; None if absent.
        described: facts about the animal added since, see `Log.described`; None if absent.
    """

    def __init__(
        self,
        path: Path,
        metadata: dict[str, Any],
        log: Log | None = None,
        described: Mapping[str, str] | None = None,
    ) -> None:
        self.path = path
        self.log = log or Log("")  # corrections; empty if they do not apply
        self.described = dict(described or {})
        self.metadata = with_description({**metadata, **self.log.facts}, self.described)

    @staticmethod
    def open(path: str | Path, *, raw: bool = False) -> Session:
        """Open the session in a folder; its version and files are checked.

        A session that a killed writer had moved aside is restored first.

        Args:
            path: the session folder.
            raw: ignore corrections (see `liex_lab.sessions.corrections`).

        Raises:
            SessionError: the folder is not a session, is damaged, lacks a file, or was written by a
                newer version.
        """
        folder = Path(path)
        document = folder / "session.json"
        with suppress(OSError):  # on a read-only medium
            put_back_session(folder)
        if not document.is_file():
            what = "is not a folder" if not folder.is_dir() else "holds no session.json"
            raise SessionError(
                f"a session is a folder that `liex run` wrote, but {folder} {what}; check the path"
            )
        metadata = read_document(document)
        for name in FILES:
            if FILES[name] and not (folder / name).is_file():
                raise SessionError(
                    f"the session {folder} lacks {name}; run `liex run` on the recording again"
                )
        log = Log("") if raw else read_log(folder)
        fitting = log if applies(log, folder, metadata) else None
        # absolute, so that tables are found after the process changes its folder
        session = Session(folder.absolute(), metadata, fitting, log.described)
        counts = metadata["frames"]["n_frames"], len(metadata["animal"]["joints"])
        for path in sorted(session.path.glob("*.parquet")):
            with reading_from(session.file(path.name)) as own:
                check_footer(own, path.stem, *counts)
        return session

    def __repr__(self) -> str:
        frames = self.metadata.get("frames", {}).get("n_frames", "unknown")
        corrected = ", corrected" if self.log.files else ""
        tables = ", ".join(sorted(path.stem for path in self.path.glob("*.parquet")))
        return (
            f"<Session {self.metadata.get('session_id', self.path.stem)}: "
            f"{self.metadata.get('animal', {}).get('name', 'animal')}, {frames} frames"
            f"{corrected}; tables {tables}, summary>"
        )

    @property
    def name(self) -> str:
        """The session's id."""
        return str(self.metadata["session_id"])

    def file(self, name: str) -> Path:
        """Path of a file of the session: the corrected one if it exists, else the original.

        Args:
            name: the file's name, such as 'poses.parquet'.
        """
        return corrected_folder(self.path) / name if name in self.log.files else self.path / name

    def has(self, name: str) -> bool:
        """Whether the session has a file.

        Args:
            name: the file's name, such as 'summary.csv'.
        """
        return self.file(name).is_file()

    frames = _table(
        "frames", "Table `frames`, one row per recorded frame: time, gap, predicted error, flag."
    )

    poses = _table(
        "poses",
        "Table `poses`, one row per recorded frame and joint: position (mm), pixel, sd (mm).",
    )

    rotations = _table(
        "rotations",
        """Table `rotations`, one row per recorded frame and joint, and one for the root.

    The root's row is its rigid transform and includes a translation. Rotations are rotation
    vectors, rad; translations mm.
    """,
    )

    kinematics = _table(
        "kinematics",
        "Table `kinematics`, one row per recorded frame: speed (mm/s), heading, heights (mm).",
    )

    bouts = _table("bouts", "The ethogram: table `bouts`, one row per bout.")

    gaps = _table(
        "gaps", "Table `gaps`, one row per interval of frames that are missing or without a pose."
    )

    flips = _table(
        "flips", "Table `flips`, one row per interval in which head and tail may be exchanged."
    )

    crossings = _table(
        "crossings",
        "Table `crossings` of one of several animals, one row per meeting with another one.",
    )

    transitions = _table(
        "transitions",
        "Table `transitions`, one row per pair of actions: how often one followed the other.",
    )

    activity = _table(
        "activity",
        "Table `activity`, one row per time bin: distance (mm) and share of each action.",
    )

    hours = _table(
        "hours",
        "Table `hours`, one row per hour of the clock: light, distance (mm), sleep by immobility.",
    )

    rhythm = _table("rhythm", "Table `rhythm`, one row: light and dark, and circadian measures.")

    interactions = _table(
        "interactions",
        """Table `interactions`, one row per event of any two animals of the arena.

    Only sessions of several animals in one arena have it.
    """,
    )

    interaction_totals = _table(
        "interaction_totals",
        "Table `interaction_totals`, one row per ordered pair of animals and action: share, count.",
    )

    zone_visits = _table(
        "zones",
        """Table `zones` (zones.parquet), one row per zone: time in it (s), visits, latency (s).

    `zones` are the shapes of the zones; `table("zones")` is the same table.
    """,
    )

    @cached_property
    def summary(self) -> pd.DataFrame:
        """The behaviour summary, one row per animal.

        Raises:
            SessionError: the session was written without behaviour measures.
        """
        path = self.file("summary.csv")
        if not path.is_file():
            raise SessionError(
                f"the session {self.path} has no summary.csv; it was written without behaviour "
                "measures"
            )
        with reading_from(path):
            return text_files.read_harmless(path, ("session_id", "individual"))

    @cached_property
    def columns(self) -> pd.DataFrame:
        """The column dictionary: one row per column of every table."""
        with reading_from(self.file("columns.json")) as path:
            found = pd.DataFrame(json.loads(path.read_text(encoding="utf-8")))
            if not {"table", "name", "unit", "meaning"} <= set(found.columns):
                raise ValueError("it does not describe columns")
            if PULSE.name not in set(found["name"]):
                found = pd.concat([found, pd.DataFrame([asdict(PULSE)])], ignore_index=True)
            return found

    @cached_property
    def camera(self) -> Camera:
        """The depth camera, an ideal pinhole camera in air; px.

        `metadata["camera"]["optics"]` lists the corrections of lens and water.
        """
        return Camera.from_dict(self.metadata["camera"])

    @cached_property
    def T_arena_camera(self) -> SE3:
        """Rigid transform from the camera frame (mm) to the arena frame."""
        return SE3.from_matrix(np.array(self.metadata["camera"]["T_arena_camera"], float))

    @cached_property
    def arena(self) -> Arena:
        """The shape of the floor; open if unknown."""
        return Arena.from_dict(self.metadata.get("arena") or {"kind": "open"})

    @cached_property
    def zones(self) -> list[Zone]:
        """The zones drawn on the floor; their table is `zone_visits`."""
        return [Zone.from_dict(zone) for zone in self.metadata.get("zones", [])]

    @property
    def plan(self) -> str:
        """The plan with all settings as resolved for this run, TOML text."""
        with reading_from(self.path / "plan.toml") as path:
            return path.read_text(encoding="utf-8")

    def narrowed(self, **wanted: Sequence[str]) -> Session:
        """The same session, with only some columns of the named tables in memory.

        All columns of a long recording need much memory; those of a very long one are on its disk.
        Columns that a table does not have are ignored.

        Args:
            **wanted: table name to column names, as in `frames=["time_s", "flag"]`.
        """
        other = Session(self.path, self.metadata, self.log, self.described)
        for name, columns in wanted.items():
            path = self.file(f"{name}.parquet")
            if not path.is_file():
                continue
            # with little else of a long table in memory
            with reading_from(path), pq.ParquetFile(path, pre_buffer=False) as file:
                known = [column for column in columns if column in file.schema_arrow.names]
                n = file.metadata.num_rows
                allocate = memory.on_disk(path.parent) if n > _LONG else np.empty
                made: dict[str, NDArray[Any]] = {}
                begin = 0
                for k in range(file.num_row_groups):
                    read = file.read_row_group(k, known, use_threads=False)
                    values = {column: read[column].to_numpy() for column in known}
                    rows = slice(begin, begin := begin + read.num_rows)
                    memory.put(made, rows, values, n, allocate)
                    del read, values
                    memory.release_memory()
                table = pd.DataFrame(made, columns=known, copy=False)
                check_rows(name, table, self.metadata["animal"]["joints"])
                other.__dict__[name] = table
        return other

    def table(
        self, name: str, columns: list[str] | None = None, frame_index: list[int] | None = None
    ) -> pd.DataFrame:
        """Read a table by its name, or part of it.

        Args:
            name: the table's name, such as 'poses'.
            columns: only these columns; None for all.
            frame_index: only the rows of these frames, by number, with at most one row group of the
                file in memory at a time. None for all rows.

        Raises:
            SessionError: there is no such table, or it is damaged.
        """
        path = self.file(f"{name}.parquet")
        if not path.is_file():
            known = ", ".join(sorted(p.stem for p in self.path.glob("*.parquet")))
            raise SessionError(f"the session {self.path} has no table '{name}'; it holds {known}")
        with reading_from(path):
            found = (
                pd.read_parquet(path, columns=columns)
                if frame_index is None
                else _rows_of(path, columns, frame_index)
            )
            check_rows(name, found, self.metadata["animal"]["joints"])
            if name == "frames" and columns is None and PULSE.name not in found:  # before schema 8
                before = pd.read_parquet(path, columns=["frame_index", "gap_before"])
                pulse = np.arange(len(before)) + before["gap_before"].cumsum()
                chosen = before["frame_index"].isin(found["frame_index"])
                found[PULSE.name] = pulse[chosen].to_numpy()
            facts = self.described if name == "sessions" else {}
            return found.assign(**{key: facts[key] for key in facts if key in found})

    def to_xarray(self, points: PoseArrays | None = None) -> xarray.Dataset:
        """The poses as a labelled data set, in the format of the Python package movement.

        The dimensions are time (s since the first frame), space (x, y, z; mm, arena frame),
        keypoints and individuals; the variables position, confidence, score, sd_mm and action;
        pulse_index is a coordinate along time. See `PoseArrays.likelihood` on the confidence.

        Args:
            points: keypoints in place of the joints, as from `liex_lab.exchange.skin_points`.

        Raises:
            MissingPackageError: xarray is not installed.
        """
        with needing("exchange", "a labelled data set"):
            import xarray

        poses = points or self.pose_arrays()
        bouts = self.bouts
        actions = np.full(len(poses.frame_index), "", dtype=object)
        starts, stops = (
            np.searchsorted(poses.frame_index, bouts[name].to_numpy())
            for name in ("start_frame", "stop_frame")
        )
        for start, stop, action in zip(starts, stops, bouts["action"], strict=True):
            actions[start:stop] = action
        rate = self.metadata["frames"]["fps_median"]
        in_space = ("time", "space", "keypoints", "individuals")
        of_joints = ("time", "keypoints", "individuals")
        return xarray.Dataset(
            data_vars={
                "position": (in_space, np.moveaxis(poses.xyz_mm, 1, 2)[..., None]),
                "confidence": (of_joints, poses.likelihood[..., None]),
                "score": (of_joints, poses.score[..., None]),
                "sd_mm": (in_space, np.moveaxis(poses.sd_mm, 1, 2)[..., None]),
                "action": (("time", "individuals"), actions.astype(str)[:, None]),
            },
            coords={
                "time": poses.time_s,
                "space": ["x", "y", "z"],
                "keypoints": list(poses.joints),
                "individuals": [poses.individual],
                "pulse_index": ("time", poses.pulse_index),
            },
            attrs={
                "source_software": "liex_lab",
                "ds_type": "poses",
                "time_unit": "seconds",
                "source_file": self.path.name,
                "space_unit": "mm",
                "axes": "arena: z up from the floor",
                **({"fps": float(rate)} if rate else {}),
                **({"keypoints": "derived, on the skin"} if points else {}),
            },
        )

    def pose_arrays(self) -> PoseArrays:
        """The poses as arrays by frame and joint, NaN where there is no pose.

        `session.pose_arrays().xyz_mm[10]` are the joints (J, 3) of row 10 of the recording, mm.
        """
        return PoseArrays.of(self.metadata, self.table("poses"), self.table("frames"))


def _rows_of(path: Path, columns: list[str] | None, frame_index: list[int]) -> pd.DataFrame:
    """The rows of some frames of a long table, with at most one row group in memory."""
    wanted = columns and [*dict.fromkeys([*columns, "frame_index"])]
    found = []
    with pq.ParquetFile(path, pre_buffer=False) as file:
        for k in range(file.num_row_groups):
            group = file.read_row_group(k, wanted, use_threads=False).to_pandas()
            found.append(group[group["frame_index"].isin(frame_index)])
    memory.release_memory()
    rows = pd.concat(found, ignore_index=True)
    return rows if columns is None else rows[columns]


def video_path(folder: Path, name: str, what: str = "") -> Path:
    """Path of a video of a session or study.

    Args:
        folder: its folder.
        name: of the session or study.
        what: its subject, such as an action; "" for the whole session.
    """
    tail = "".join(c if c.isalnum() or c in "-_.+" else "_" for c in what)
    return folder / durable.safe_name(f"{name}_{tail}" if tail else name, ".mp4")


def stretch(start_s: float | None, stop_s: float | None) -> str:
    """Part of a video's file name that states its time span.

    Args:
        start_s: start, s; None for the beginning.
        stop_s: stop, s; None for the end.
    """
    start = f"from_{start_s or 0.0:.2f}s"
    return start if stop_s is None else f"{start}_to_{stop_s:.2f}s"


def found_video(session: Session, what: str = "") -> Path | None:
    """The video in a session's folder; None if absent.

    Args:
        session: the opened session.
        what: its subject; "" for the whole session.
    """
    path = video_path(session.path, session.name, what)
    return path if path.is_file() else None


# A session's poses as plain arrays.


_KEPT = 0.6  # the usual threshold of likelihoods: least value in trusted frames


@dataclass(frozen=True, repr=False)
class PoseArrays:
    """Poses of one animal, one row for every recorded frame; NaN where there is no pose.

    Attributes:
        individual: the animal's name.
        joints: names of the J joints.
        bones: pairs of joint indices, parent and child.
        frame_index: (n,) int64, number of the frame in the recording.
        pulse_index: (n,) int64, number of the camera's pulse, see the column of `frames`.
        time_s: (n,) s since the first frame.
        xyz_mm: (n, J, 3) mm, arena frame.
        uv_px: (n, J, 2) px of the depth image; (0, 0) is the centre of the top-left pixel.
        score: (n, J) probability that the joint is within 10 % of the spine's length of the truth.
        trusted: (n,) bool, whether the pose was measured and nothing contradicts it, or a person
            corrected it.
        sd_mm: (n, J, 3) standard deviation of x, y and z, mm; see the columns sd_xy_mm and sd_z_mm.
    """

    individual: str
    joints: tuple[str, ...]
    bones: tuple[tuple[int, int], ...]
    frame_index: NDArray[np.int64]
    pulse_index: NDArray[np.int64]
    time_s: Array
    xyz_mm: Array
    uv_px: Array
    score: Array
    trusted: NDArray[np.bool_]
    sd_mm: Array

    def __repr__(self) -> str:
        n, posed = len(self.time_s), int(np.isfinite(self.xyz_mm).all(axis=(1, 2)).sum())
        return (
            f"<Poses {self.individual}: {n} frames, {posed} with a pose; {', '.join(self.joints)}>"
        )

    @property
    def likelihood(self) -> Array:
        """(n, J) likelihood or confidence for exports; NaN where there is no pose.

        It is 0.6 + 0.4 x score in a trusted frame and 0.5 x score in any other, so that the field's
        usual threshold of 0.6 keeps trusted frames.
        """
        sure = self.trusted[:, None]
        # the highest likelihood in other frames
        return np.where(sure, _KEPT + (1.0 - _KEPT) * self.score, 0.5 * self.score)

    @staticmethod
    def of(about: Mapping[str, Any], table: pd.DataFrame, frames: pd.DataFrame) -> PoseArrays:
        """The poses of a session, see `Session.pose_arrays`.

        Args:
            about: content of session.json.
            table: table `poses`.
            frames: table `frames`.
        """
        joints = tuple(about["animal"]["joints"])
        n = len(joints)
        shape = (-1, n)
        measured = ~frames["bridged"].to_numpy(bool) if "bridged" in frames else True

        def array(*names: str) -> Array:
            columns = [table[name].to_numpy(float).reshape(shape) for name in names]
            return np.stack(columns, axis=-1) if len(names) > 1 else columns[0]

        return PoseArrays(
            about["individual"],
            joints,
            tuple((int(a), int(b)) for a, b in about["animal"]["bones"]),
            table["frame_index"].to_numpy()[::n],
            frames["pulse_index"].to_numpy(),
            table["time_s"].to_numpy(float)[::n],
            array("x_mm", "y_mm", "z_mm"),
            array("u_px", "v_px"),
            array("score"),
            np.asarray(frames["flag"].isin(["", CORRECTED]) & measured, np.bool_),
            spreads(table).reshape(*shape, 3),
        )


def spreads(poses: pd.DataFrame) -> Array:
    """Standard deviations (m, 3) of x, y and z, mm; `sd_mm` for each in older tables.

    Args:
        poses: all columns of the table `poses`, m rows.
    """
    names = [f"sd_{axes}_mm" for axes in ("xy", "xy", "z")]
    columns = [poses[name if name in poses else "sd_mm"].to_numpy(float) for name in names]
    return np.stack(columns, axis=-1)
