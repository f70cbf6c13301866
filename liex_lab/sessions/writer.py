"""Writing a session: a temporary folder beside the final place, renamed when whole, gone when anything fails."""

from __future__ import annotations

import json
import os
import shutil
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from liex_lab.errors import SessionError
from liex_lab.memory import peak_memory_mb
from liex_lab.sessions import tables
from liex_lab.sessions.provenance import Provenance, package_version
from liex_lab.sessions.rows import Rows, median_step, stop_times
from liex_lab.sessions.tables import Column
from liex_lab.sessions.thumbnails import Keepsakes
from liex_lab.tracking.track import Track

if TYPE_CHECKING:
    import pandas as pd

    from liex_lab.body.skeleton import Skeleton
    from liex_lab.recordings.frame import DepthFrame
    from liex_lab.sessions.session import Session

BlueprintMaker = Callable[[dict[str, Any]], Any]  # session.json as known so far -> a Rerun blueprint
ReportMaker = Callable[[Path], object]  # the session's folder -> report.html in it


class SessionWriter:
    """Takes depth and track part by part; `close` writes the tables and puts the session in its place.

    Depth goes straight to session.rrd and session.mcap, so memory does not grow with it; of the track one row per
    frame is held. Use it in a `with` block: an exception leaves nothing behind and goes on.
    """

    def __init__(
        self,
        path: Path,
        origin: Provenance,
        *,
        overwrite: bool = False,
        blueprint: BlueprintMaker | None = None,
        report: ReportMaker | None = None,
    ) -> None:
        check_place(path, overwrite)
        self.path, self.origin = path, origin
        self._overwrite, self._report = overwrite, report
        self._document = origin.document()
        self._started, self._seconds = time.perf_counter(), 0.0
        self._index: list[int] = []
        self._times_ns: list[int] = []
        self._held = TrackBuffer(origin.skeleton, origin.n_frames or 1024)
        self._keepsakes = Keepsakes()
        self._done = False
        self._folder = path.with_name(f"{path.name}.part-{os.getpid()}")
        self._folder.parent.mkdir(parents=True, exist_ok=True)
        shutil.rmtree(self._folder, ignore_errors=True)
        self._folder.mkdir()
        try:
            self._open_logs(blueprint)
        except BaseException:
            shutil.rmtree(self._folder, ignore_errors=True)
            raise

    def _open_logs(self, blueprint: BlueprintMaker | None) -> None:
        from liex_lab.sessions.mcap import McapWriter
        from liex_lab.sessions.rrd import ReplayWriter

        made = blueprint(self._document) if blueprint else None
        self._replay = ReplayWriter(self._folder / "session.rrd", self.origin, made)
        self._mcap = McapWriter(self._folder / "session.mcap", self.origin)

    def __enter__(self) -> SessionWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._done:
            return
        self._abandon()
        if error is None:
            raise SessionError("a session left without close() is not kept; call close() at the end of the block")

    def add(self, frames: Sequence[DepthFrame], track_part: Track | None = None) -> None:
        """Consecutive frames and, unless `close` gets the whole track, their part of it."""
        from liex_lab.recordings.rvl import to_millimetres

        if not frames:
            return
        began = time.perf_counter()
        times = [int(frame.time_ns) for frame in frames]
        if track_part is not None:
            _check_times(np.array(times, np.int64), track_part)
            self._held.append(track_part)
        for start in range(0, len(frames), 16):  # bounds the copies, however many frames come at once
            part = slice(start, start + 16)
            depth = [to_millimetres(frame.depth) for frame in frames[part]]
            self._replay.add([frame.index for frame in frames[part]], times[part], depth)
            self._mcap.add(times[part], depth)
            for image in depth:
                self._keepsakes.add(image)
        self._index += [int(frame.index) for frame in frames]
        self._times_ns += times
        self._seconds += time.perf_counter() - began

    @property
    def track(self) -> Track:
        """The track so far."""
        return self._held.track

    @track.setter
    def track(self, track: Track) -> None:
        """Replace the track, for one that was smoothed over the whole recording."""
        _check_times(np.array(self._times_ns, np.int64), track)
        self._held = TrackBuffer(self.origin.skeleton, 0)
        self._held.append(track)

    @property
    def rows(self) -> Rows:
        """The track as the tables see it."""
        origin = self.origin
        index = np.array(self._index, np.int64)
        return Rows(self.track, index, origin.name, origin.individual, origin.gaps, origin.arena, origin.zones)

    @property
    def frames(self) -> pd.DataFrame:
        """The table `frames` of the track so far."""
        return tables.to_pandas(tables.FRAMES, self.rows.frames())

    @property
    def poses(self) -> pd.DataFrame:
        """What measures of behaviour need of the table `poses`: frame, joint and its place; one row per joint."""
        import pandas as pd

        n_frames, n_joints = len(self._index), self.origin.skeleton.n_joints
        codes = np.tile(np.arange(n_joints, dtype=np.int8), n_frames)
        place = self.track.joints_mm.reshape(-1, 3)
        return pd.DataFrame({
            "frame_index": np.repeat(np.array(self._index, np.int64), n_joints),
            "joint": pd.Categorical.from_codes(codes, pd.Index(self.origin.skeleton.names)),
            "x_mm": place[:, 0], "y_mm": place[:, 1], "z_mm": place[:, 2], "sd_mm": self.track.sd_mm.ravel(),
        })  # fmt: skip

    @property
    def gaps(self) -> pd.DataFrame:
        """The table `gaps` of the track so far."""
        return tables.to_pandas(tables.GAPS, self.rows.gaps())

    def note(self, **sections: Any) -> None:
        """Add facts found on the way to session.json: tables are merged, lists extended, the rest replaced."""
        for name, value in sections.items():
            known = self._document.get(name)
            if isinstance(known, dict) and isinstance(value, Mapping):
                self._document[name] = {**known, **value}
            elif isinstance(known, list) and isinstance(value, Sequence) and not isinstance(value, str):
                self._document[name] = known + [item for item in value if item not in known]
            else:
                self._document[name] = value

    def close(
        self,
        *,
        results: Mapping[str, pd.DataFrame] | None = None,
        columns: Sequence[Column] = (),
        actions: Mapping[str, str] | None = None,
        record: Mapping[str, Any] | None = None,
        timings_s: Mapping[str, float] | None = None,
    ) -> Session:
        """Write everything else and put the session in its place.

        results: tables by name (kinematics, bouts, summary and others); columns: describe theirs, of bouts those beyond
        `tables.BOUTS`; actions: the ethogram's vocabulary, word -> definition; record: what else session.json should
        hold (see `note`).
        """
        from liex_lab.sessions.session import Session

        if not self._index:
            raise SessionError("the recording holds no frame, so there is no session to write; see `liex doctor`")
        began = time.perf_counter()
        rows = self.rows
        _check_times(np.array(self._times_ns, np.int64), rows.track)
        results = dict(results or {})
        if "bouts" not in results:
            results["bouts"] = tables.empty_table([*tables.BOUTS, *(c for c in columns if c.table == "bouts")])
        bouts, kinematics = results["bouts"], results.setdefault("kinematics", rows_only(rows))
        self._write_tables(rows, results, columns)
        words = [*(actions or {}), *sorted({str(word) for word in bouts["action"]} - set(actions or {}))]
        problems = self._document["problems"]
        self._replay.finish(rows, kinematics, bouts, words, problems)
        self._mcap.finish(rows, bouts, words, problems)
        self.note(actions={word: (actions or {}).get(word, "") for word in words}, **dict(record or {}))
        self._document["thumbnails"] = self._keepsakes.save(self._folder, rows, self.origin.camera)
        (self._folder / "plan.toml").write_text(self.origin.plan_toml, encoding="utf-8")
        self._seconds += time.perf_counter() - began
        self._document.update(self._account(rows, dict(timings_s or {})))
        text = json.dumps(self._document, indent=2, default=str, allow_nan=False)
        (self._folder / "session.json").write_text(text + "\n", encoding="utf-8")
        try:
            if self._report is not None:
                self._report(self._folder)
        finally:  # a report can be made again; hours of tracking should not go with it
            self._publish()
        return Session.open(self.path)

    def _write_tables(self, rows: Rows, results: Mapping[str, pd.DataFrame], columns: Sequence[Column]) -> None:
        """All parquet files, summary.csv and columns.json."""
        described = self.origin.table_metadata()
        own: dict[str, Any] = {
            "frames": [rows.frames()], "poses": rows.poses(), "rotations": rows.rotations(), "gaps": [rows.gaps()],
            "flips": [tables.from_pandas(tables.FLIPS, tables.empty_table(tables.FLIPS))],
            "sessions": [self._session_row(rows)],
        }  # fmt: skip
        for name, blocks in own.items():
            tables.write_table(self._folder / f"{name}.parquet", tables.TABLES[name], blocks, described)
        for name, result in results.items():
            schema = [*tables.TABLES.get(name, ()), *(c for c in columns if c.table == name)]
            if not schema:  # kinematics without any measure
                continue
            block = tables.from_pandas(schema, result)
            if name == "summary":
                tables.check_described(block, schema, name)
                result.to_csv(self._folder / "summary.csv", index=False, lineterminator="\n")
            else:
                tables.write_table(self._folder / f"{name}.parquet", schema, [block], described)
        text = json.dumps(tables.dictionary(columns), indent=1, ensure_ascii=False)
        (self._folder / "columns.json").write_text(text + "\n", encoding="utf-8")

    def _session_row(self, rows: Rows) -> dict[str, Any]:
        track, subject = rows.track, self.origin.subject
        step = median_step(rows.time_s)
        return {
            "session_id": rows.session_id, "individual": rows.individual,
            **{name: subject.get(name, "") for name in ("subject_id", "group", "cage", "sex", "batch")},
            "session_start_time": self.origin.session_start_time,
            "n_frames": track.n_frames, "n_frames_observed": int(track.observed.sum()),
            "observed_s": float((stop_times(rows.time_s) - rows.time_s)[track.observed].sum()),
            "fps_median": 1.0 / step if step else float("nan"),
            "calibration_hash": self.origin.calibration_hash, "software_version": package_version("liex_lab"),
        }  # fmt: skip

    def _account(self, rows: Rows, timings_s: dict[str, float]) -> dict[str, Any]:
        """Counts of the frames, and what the run cost."""
        track, elapsed = rows.track, time.perf_counter() - self._started
        time_s = rows.time_s
        row = self._session_row(rows)
        flags = {flag or "good": int(np.sum(track.flag == flag)) for flag in np.unique(track.flag)}
        return {
            "frames": {
                "n_frames": track.n_frames, "n_observed": int(track.observed.sum()), "flags": flags,
                "n_missing": int(rows.missing_before().sum()), "n_gaps": int((rows.missing_before() > 0).sum()),
                "duration_s": float(stop_times(time_s)[-1]), "observed_s": row["observed_s"],
                "fps_median": None if np.isnan(row["fps_median"]) else row["fps_median"],
            },
            "depth_unit_mm": 1.0,
            "timings_s": {**timings_s, "write": round(self._seconds, 4), "total": round(elapsed, 4)},
            "frames_per_s": round(track.n_frames / elapsed, 2),
            "peak_memory_mb": peak_memory_mb(),
        }  # fmt: skip

    def _publish(self) -> None:
        """Rename the whole folder into place; an older session goes only after that."""
        old = self.path.with_name(f"{self.path.name}.old-{os.getpid()}")
        check_place(self.path, self._overwrite)
        if self.path.exists():
            self.path.rename(old)
        try:
            self._folder.rename(self.path)
        except OSError:
            if old.exists():
                old.rename(self.path)
            raise
        self._done = True
        shutil.rmtree(old, ignore_errors=True)

    def _abandon(self) -> None:
        """Close what is open and remove the temporary folder."""
        for log in (self._replay, self._mcap):
            try:
                log.abandon()
            except Exception:  # an error is under way already; it is the one to tell
                continue
        shutil.rmtree(self._folder, ignore_errors=True)


class TrackBuffer:
    """A track that grows by parts, in arrays made for the expected number of frames, so that nothing is held twice."""

    def __init__(self, skeleton: Skeleton, n_expected: int) -> None:
        self._room = Track.empty(skeleton, np.zeros(n_expected, np.int64))
        self._n = 0

    def append(self, part: Track) -> None:
        """Take the next rows."""
        needed = self._n + part.n_frames
        if needed > self._room.n_frames:
            more = max(needed - self._room.n_frames, self._room.n_frames // 2)
            self._room = Track.join([self._room, Track.empty(part.skeleton, np.zeros(more, np.int64))])
        for column in fields(Track):
            if column.name != "skeleton":
                getattr(self._room, column.name)[self._n : needed] = getattr(part, column.name)
        self._n = needed

    @property
    def track(self) -> Track:
        """The rows so far, not copied."""
        columns = [column.name for column in fields(Track) if column.name != "skeleton"]
        return Track(self._room.skeleton, *(getattr(self._room, name)[: self._n] for name in columns))


def check_place(path: Path, overwrite: bool) -> None:
    """Refuse to write over what must not be lost, or where no folder can be."""
    nearest = next((folder for folder in path.parents if folder.exists()), None)
    if nearest is not None and not nearest.is_dir():
        raise SessionError(f"{nearest} is a file, and a session needs a folder; choose another place with --out")
    if not path.exists():
        return
    if not (path / "session.json").is_file():
        raise SessionError(f"{path} exists and is not a session, so it is left alone; choose another place with --out")
    if not overwrite:
        raise SessionError(f"the session {path} exists already; choose another place with --out, or say --overwrite")


def rows_only(rows: Rows) -> pd.DataFrame:
    """A kinematics table without any measure."""
    return tables.to_pandas(tables.FRAMES[:5], {k: v for k, v in rows.frames().items() if k in _ROW_NAMES})


_ROW_NAMES = {column.name for column in tables.FRAMES[:5]}


def _check_times(times_ns: NDArray[np.int64], track: Track) -> None:
    if not np.array_equal(times_ns, track.times_ns):
        raise SessionError(
            f"a track has one row for every frame written, got {track.n_frames} rows for {len(times_ns)} frames or "
            "other time stamps; pass the track of exactly these frames"
        )
