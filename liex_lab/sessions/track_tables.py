"""Track of a session, written as Parquet and CSV tables, and read back as arrays."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from liex_lab.errors import MissingPackageError, how_to_install
from liex_lab.runtime.text_files import write_csv
from liex_lab.sessions.provenance import Provenance, package_version
from liex_lab.tables import schema as tables
from liex_lab.tables.rows import Rows, median_step, stop_times
from liex_lab.tables.schema import Column
from liex_lab.tracking.track import CORRECTED, Flip

if TYPE_CHECKING:
    import pandas as pd
    import xarray


@dataclass(frozen=True)
class Results:
    """A track as rows, with its provenance.

    Attributes:
        origin: provenance of the recording.
        rows: the track in the form of the tables.
        flips: intervals in which head and tail may be exchanged.
    """

    origin: Provenance
    rows: Rows
    flips: Sequence[Flip] = ()

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

    def write_measured(
        self, folder: Path, results: Mapping[str, pd.DataFrame], columns: Sequence[Column]
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
                write_csv(result, folder / "summary.csv")
            else:
                tables.write_table(
                    folder / f"{name}.parquet", schema, tables.from_pandas(result), described
                )
        text = json.dumps(tables.dictionary(columns), indent=1, ensure_ascii=False)
        (folder / "columns.json").write_text(text + "\n", encoding="utf-8")

    def session_row(self) -> dict[str, Any]:
        """The row of the table `sessions`."""
        rows = self.rows
        track = self.rows.track
        subject = self.origin.subject
        step = median_step(rows.time_s)
        return {
            "session_id": rows.session_id,
            "individual": rows.individual,
            **{
                name: subject.get(name, "")
                for name in ("subject_id", "group", "cage", "sex", "batch")
            },
            "session_start_time": self.origin.session_start_time,
            "n_frames": track.n_frames,
            "n_frames_observed": int(track.observed.sum()),
            "observed_s": float((stop_times(rows.time_s) - rows.time_s)[track.observed].sum()),
            "fps_median": 1.0 / step if step else float("nan"),
            "calibration_hash": self.origin.calibration_hash,
            "software_version": package_version("liex_lab"),
        }

    def counts(self) -> dict[str, Any]:
        """Counts of frames and of their flags: section `frames` of session.json."""
        rows = self.rows
        track = self.rows.track
        row = self.session_row()
        flags = {flag or "good": int(np.sum(track.flag == flag)) for flag in np.unique(track.flag)}
        return {
            "n_frames": track.n_frames,
            "n_observed": int(track.observed.sum()),
            "flags": flags,
            "n_missing": int(rows.missing_before().sum()),
            "n_gaps": int((rows.missing_before() > 0).sum()),
            "duration_s": float(stop_times(rows.time_s)[-1]),
            "observed_s": row["observed_s"],
            "fps_median": None if np.isnan(row["fps_median"]) else row["fps_median"],
        }


# A session's poses as plain arrays, and as a labelled data set of xarray.


Array = NDArray[np.float64]


_KEPT = 0.6  # the usual threshold of likelihoods: least value in trusted frames
_UNSURE = 0.5  # the highest likelihood in other frames


@dataclass(frozen=True, repr=False)
class Poses:
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
        return np.where(sure, _KEPT + (1.0 - _KEPT) * self.score, _UNSURE * self.score)

    @staticmethod
    def of(about: Mapping[str, Any], table: pd.DataFrame, frames: pd.DataFrame) -> Poses:
        """The poses of a session, see `Session.pose_arrays`.

        Args:
            about: content of session.json.
            table: table `poses`.
            frames: table `frames`.
        """
        joints = tuple(about["animal"]["joints"])
        n = len(joints)
        shape = (-1, len(joints))
        measured = ~frames["bridged"].to_numpy(bool) if "bridged" in frames else True

        def array(*names: str) -> Array:
            columns = [table[name].to_numpy(float).reshape(shape) for name in names]
            return np.stack(columns, axis=-1) if len(names) > 1 else columns[0]

        return Poses(
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
    told = [poses[name if name in poses else "sd_mm"].to_numpy(float) for name in names]
    return np.stack(told, axis=-1)


def dataset_of(
    poses: Poses, bouts: pd.DataFrame, about: Mapping[str, Any], source: str
) -> xarray.Dataset:
    """A session as a poses data set of the Python package movement, see `Session.to_xarray`.

    The dimensions are time (s since the first frame), space (x, y, z; mm, arena frame), keypoints
    and individuals; the variables position, confidence (`Poses.likelihood`), score, sd_mm and
    action.

    Args:
        poses: its poses.
        bouts: its table `bouts`.
        about: content of session.json.
        source: name of its folder.

    Raises:
        MissingPackageError: xarray is not installed.
    """
    try:
        import xarray
    except ModuleNotFoundError:
        raise MissingPackageError(
            f"a labelled data set needs xarray; {how_to_install('exchange')}"
        ) from None

    dims = ("time", "space", "keypoints", "individuals")
    rate = about["frames"]["fps_median"]
    attrs: dict[str, Any] = {
        "source_software": "liex_lab",
        "ds_type": "poses",
        "time_unit": "seconds",
        "source_file": source,
        "space_unit": "mm",
        "axes": "arena: z up from the floor",
        **({"fps": float(rate)} if rate else {}),
    }
    return xarray.Dataset(
        data_vars={
            "position": (dims, np.moveaxis(poses.xyz_mm, 1, 2)[..., None]),
            "confidence": (("time", "keypoints", "individuals"), poses.likelihood[..., None]),
            "score": (("time", "keypoints", "individuals"), poses.score[..., None]),
            "sd_mm": (dims, np.moveaxis(poses.sd_mm, 1, 2)[..., None]),
            "action": (("time", "individuals"), _actions(poses, bouts)[:, None]),
        },
        coords={
            "time": poses.time_s,
            "space": ["x", "y", "z"],
            "keypoints": list(poses.joints),
            "individuals": [poses.individual],
            "pulse_index": ("time", poses.pulse_index),
        },
        attrs=attrs,
    )


def _actions(poses: Poses, bouts: pd.DataFrame) -> np.ndarray[Any, Any]:
    """(n,) the action of every frame; empty if it has none."""
    out = np.full(len(poses.frame_index), "", dtype=object)
    starts = np.searchsorted(poses.frame_index, bouts["start_frame"].to_numpy())
    stops = np.searchsorted(poses.frame_index, bouts["stop_frame"].to_numpy())
    for start, stop, action in zip(starts, stops, bouts["action"], strict=True):
        out[start:stop] = action
    return out.astype(str)
