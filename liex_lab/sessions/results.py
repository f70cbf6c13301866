"""Tables of a session, written into a folder as Parquet, CSV and a column dictionary.

They are made from a track and from what was measured of it; the same code writes a session's own
tables and those of its corrections.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from liex_lab.runtime.text_files import write_csv
from liex_lab.sessions.provenance import Provenance, package_version
from liex_lab.tables import schema as tables
from liex_lab.tables.rows import Rows, median_step, stop_times
from liex_lab.tables.schema import Column
from liex_lab.tracking.track import Flip

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True)
class Results:
    """A track as rows, and where it comes from.

    Attributes:
        origin: what is known about the recording.
        rows: the track as the tables see it.
        flips: where head and tail may have been exchanged.
    """

    origin: Provenance
    rows: Rows
    flips: Sequence[Flip] = ()

    def write_track(self, folder: Path) -> None:
        """Write the tables of the track itself: frames, poses, rotations, gaps, flips, sessions.

        Args:
            folder: the folder that the Parquet files go into.
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
            folder: the folder that the files go into.
            results: tables by name; a table without any column described is left out.
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
        """Counts of frames and of how they were measured: section `frames` of session.json."""
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
