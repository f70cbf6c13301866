"""Crash-safe writer of a session folder, published by one atomic rename.

The session is written to the folder NAME.part next to its final path. Depth is streamed directly
into the Rerun replay and the MCAP file; tables are written at the end. Every few seconds a
checkpoint is saved, from which an interrupted run resumes (see `liex_lab.sessions.checkpoint`).

Several processes may measure shards of one recording in parallel, each in a folder inside the
unfinished session, which appends them in order. If a worker dies, another one may write its shard a
second time: a shard is published by an atomic rename, and both versions are equal.
"""

import json
import os
import platform
import shutil
import time
from array import array
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import fields
from pathlib import Path
from types import TracebackType
from typing import Any, TypeVar

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from liex_lab.behaviour.interactions import Interactions
from liex_lab.errors import LiexError, SessionError
from liex_lab.recordings.frame import DepthFrame
from liex_lab.runtime import durable, memory, text_files
from liex_lab.sessions.checkpoint import LOGS, STRETCHES, Checkpoint, Columns
from liex_lab.sessions.corrections import FOLDER
from liex_lab.sessions.cutouts import FILE as CUTOUTS_FILE
from liex_lab.sessions.cutouts import Boxes, DepthKeeper, Thumbnails
from liex_lab.sessions.evidence import Results, write_evidence
from liex_lab.sessions.folder import (
    aside_folder,
    check_writable,
    corrections_for,
    file_facts,
    note_taken,
    part_folder,
    put_back_held,
    put_back_session,
)
from liex_lab.sessions.provenance import Provenance
from liex_lab.sessions.session import Session
from liex_lab.tables import schema
from liex_lab.tables.rows import Rows
from liex_lab.tracking.observations import Observations
from liex_lab.tracking.track import Crossing, Flip, Subject, Track, Tracked

INDEX = "frame_index"
TIMES = "frame_time_ns"
BOXES = "kept_box_px"
_BEHIND = 4  # batches of 16 frames that the logs may be behind, both together
Kept = TypeVar("Kept")

BlueprintMaker = Callable[[dict[str, Any]], Any]  # session.json so far -> a Rerun blueprint
ReportMaker = Callable[[Path], object]  # the session's folder -> report.html in it


class SessionWriter:
    """Writer of a session: receives depth and track in parts, and publishes the session with
    `close`.

    Depth is streamed to session.rrd and session.mcap, so memory use does not grow with it. Use it
    in a `with` block: an exception propagates, and leaves a folder NAME.part only if that has a
    checkpoint. The next writer of the same session then starts with `n_frames` frames that need not
    be added again.

    Attributes:
        path: final path of the session.
        origin: provenance known before the first frame.

    Args:
        path: final path of the session.
        origin: provenance known before the first frame.
        overwrite: replace an existing session.
        blueprint: creates the replay's layout from session.json's content so far; None for no
            layout.
        report: writes report.html into the folder; None for no report.

    Raises:
        SessionError: the path is taken, or another process is writing there.
    """

    def __init__(
        self,
        path: str | Path,
        origin: Provenance,
        *,
        overwrite: bool = False,
        blueprint: BlueprintMaker | None = None,
        report: ReportMaker | None = None,
    ) -> None:
        from liex_lab.sessions import mcap, rrd

        self.path = Path(path)
        put_back_session(self.path)
        check_writable(self.path, overwrite)
        self.origin = origin
        self._overwrite = overwrite
        self._report = report
        self._document = origin.document()
        self._started = time.perf_counter()
        self._seconds = 0.0
        self._track = Track.empty(origin.skeleton, np.zeros(0, np.int64))
        self._rows: Rows | None = None
        self.others: Sequence[NDArray[np.float64]] = ()  # see `Rows`
        self._flips: Sequence[Flip] = ()
        self._crossings: Sequence[Crossing] | None = None
        self._candidates: Observations | None = None
        self._together: Observations | None = None
        self._thumbnails = Thumbnails()
        self._keeper = DepthKeeper(origin)
        self._done = False
        self._folder = part_folder(self.path)
        self._checkpoint = open_unfinished(self.path, origin)
        before = self._checkpoint.columns.read()
        self._index, self._times_ns = (
            array("q", before.get(name, np.zeros(0, np.int64)).tobytes()) for name in (INDEX, TIMES)
        )
        self._logging: deque[Future[None]] = deque()
        self._loggers = {
            log: ThreadPoolExecutor(1) for log in LOGS
        }  # each writes in order, parallel to the other
        try:
            layout = blueprint(self._document) if blueprint else None
            messages = self._folder / LOGS[1]
            self._replay = rrd.ReplayWriter(self._checkpoint.replay, origin, layout)
            self._mcap = mcap.McapWriter(messages, origin, resume=messages.is_file())
            if self._times_ns:
                self._replay.resume(self._times_ns[0])
        except BaseException:
            self._stop_logging()
            self._checkpoint.leave(keep=True)
            raise

    def __enter__(self) -> "SessionWriter":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._done:
            return
        full = full_disk(self._folder, error)
        self._stop_logging()
        for log in (self._replay, self._mcap):
            with suppress(Exception):  # the error being handled is the one to report
                log.abandon()
        self._checkpoint.leave(keep=error is not None)
        if full is not None:
            kept = self._checkpoint.state.n_frames if self._checkpoint.is_saved else 0
            begins = (
                f"resumes after the {kept} frames in {self._folder}" if kept else "starts again"
            )
            raise SessionError(
                f"{full}; make room there and run the same command again, which {begins}"
            ) from error
        if error is None:
            raise SessionError(
                "a session left without close() is not kept; call close() at the end of the block"
            )

    @property
    def n_frames(self) -> int:
        """Frames that are in the session already; not 0 at the start of a resumed session."""
        return len(self._index)

    def resume(self, depth: Callable[[int], NDArray[np.float32]]) -> None:
        """Sample frames for the thumbnails again if some frames are in the session already.

        Args:
            depth: depth (H, W) float32 mm of a frame by its row.
        """
        self._thumbnails.resume(self.n_frames, depth)

    def add(
        self,
        frames: Sequence[DepthFrame],
        observations: Observations | Track | None = None,
    ) -> None:
        """Write consecutive frames.

        Args:
            frames: the next frames.
            observations: one row per frame, kept on disk until the session is complete so that an
                interrupted run can resume. The depth around the animal in them is kept.

        Raises:
            SessionError: a log could not be written.
        """
        if not frames:
            return
        began = time.perf_counter()
        times = [int(frame.time_ns) for frame in frames]
        index = [int(frame.index) for frame in frames]
        # of all frames at once: a call costs as much as a frame
        boxes = self._keeper.boxes(observations if isinstance(observations, Observations) else None)
        for start in range(0, len(frames), 16):  # limits the number of copies
            part = slice(start, start + 16)
            depth = [frame.depth for frame in frames[part]]
            cuts = None if boxes is None else boxes[part]
            kept = self._keeper.keep(depth, cuts)
            self._drain(_BEHIND)
            replay, messages = (self._loggers[log] for log in LOGS)
            self._logging.append(
                replay.submit(self._replay.add, index[part], times[part], kept, cuts)
            )
            self._logging.append(messages.submit(self._mcap.add, times[part], kept))
            for image in depth:
                self._thumbnails.add(image)
        self._index.extend(index)
        self._times_ns.extend(times)
        if observations is not None:
            self._checkpoint.columns.append(observation_rows(frames, observations, boxes))
            if self._checkpoint.due:
                self._save_checkpoint()
        self._seconds += time.perf_counter() - began

    def add_times(self, times_ns: NDArray[np.int64]) -> None:
        """Add consecutive frames without depth, such as those of imported points.

        Args:
            times_ns: (n,) their times, ns.
        """
        self._index.extend(range(self.n_frames, self.n_frames + len(times_ns)))
        self._times_ns.extend(times_ns.tolist())

    def observations(self, kind: Callable[..., Kept]) -> Kept:
        """The observations of all frames so far, as passed to `add`, from disk.

        Args:
            kind: called with the skeleton and the columns in order, such as `Observations`.
        """
        kept = self._checkpoint.columns.read()
        return kind(
            self.origin.skeleton,
            *(values for name, values in kept.items() if name not in (INDEX, TIMES, BOXES)),
        )

    def _drain(self, behind: int = 0) -> None:
        """Wait until the logs are at most `behind` batches behind; their errors are raised here."""
        while len(self._logging) > behind:
            self._logging.popleft().result()

    def _stop_logging(self) -> None:
        for logger in self._loggers.values():
            logger.shutdown(cancel_futures=True)

    def _save_checkpoint(self) -> None:
        """Save a checkpoint of everything so far. Only frames with observations can resume."""
        self._drain()
        sizes = self._replay.flushed(), self._mcap.flushed()
        seconds = round(self._checkpoint.seconds_before + self._elapsed, 3)
        self._checkpoint.save(len(self._index), seconds, *sizes)

    @property
    def allocate(self) -> memory.Allocator:
        """Allocator of arrays on the session's disk, for the track of a long recording."""
        return memory.on_disk(self._folder)

    @property
    def track(self) -> Track:
        """The track so far, one row per frame."""
        return self._track

    @track.setter
    def track(self, track: Track) -> None:
        """Replace the track by one that was smoothed over the whole recording.

        Args:
            track: one row for every frame written.

        Raises:
            SessionError: the track is of other frames.
        """
        _check_times(np.array(self._times_ns, np.int64), track)
        self._track = track
        self._rows = None

    def take(self, tracked: Tracked, observations: Observations, subject: Subject) -> None:
        """Accept the track of all frames so far, and write its observations to observations.npz.

        Args:
            tracked: the track, and possible exchanges of head and tail.
            observations: the observations of all frames.
            subject: animal and camera of the track.
        """
        self.track = tracked.track
        self._flips = tracked.flips
        self._crossings = tracked.crossings
        memory.release_memory()  # much memory after a long recording
        self._candidates = observations if self.origin.replay_candidates else None
        self._together = observations if subject.n_animals > subject.n_measured else None
        write_evidence(self._folder, observations, subject)

    @property
    def rows(self) -> Rows:
        """The track in the form of the tables; cached until frames or a track are added."""
        if self._rows is None:
            origin = self.origin
            frames = np.array(self._index, np.int64)
            about = origin.name, origin.individual, origin.gaps, origin.arena, origin.zones
            self._rows = Rows(self.track, frames, *about, self.allocate, self.others)
        return self._rows

    def note(self, **sections: Any) -> None:
        """Add sections to session.json.

        Args:
            **sections: section name to content; tables are merged, lists extended, other values
                replaced.
        """
        for name, value in sections.items():
            known = self._document.get(name)
            if isinstance(known, dict) and isinstance(value, Mapping):
                value = {**known, **value}
            elif isinstance(known, list) and isinstance(value, list | tuple):
                value = known + [item for item in value if item not in known]
            self._document[name] = value

    def close(
        self,
        *,
        results: Mapping[str, pd.DataFrame] | None = None,
        columns: Sequence[schema.Column] = (),
        actions: Mapping[str, str] | None = None,
        record: Mapping[str, Any] | None = None,
        timings_s: Mapping[str, float] | None = None,
        together: Interactions | None = None,
    ) -> Session:
        """Write everything else and publish the session; returns it opened.

        Corrections of the replaced session are copied; without one, those of an outdated copy (see
        `liex_lab.sessions.folder`), which session.json then names under `corrections_taken_from`.

        The report is written last; if it fails, the session is kept all the same.

        Args:
            results: tables by name (kinematics, bouts, summary and others).
            columns: descriptions of their columns; for bouts, of those beyond `tables.BOUTS`.
            actions: the ethogram's vocabulary, word to definition.
            record: further sections of session.json (see `note`).
            timings_s: time spent on each part of the work, s.
            together: the interactions with other animals of the arena, for the replays.

        Raises:
            SessionError: the recording has no frame, the track is of other frames, a column is not
                described, a log could not be written, or the disk had no room for the report.
        """
        if not self._index:
            raise SessionError(
                "the recording holds no frame, so there is no session to write; see `liex doctor`"
            )
        began = time.perf_counter()
        self._drain()
        if self._checkpoint.state.n_frames:  # a long run: the rest may be interrupted as well
            self._save_checkpoint()
        rows = self.rows
        _check_times(np.array(self._times_ns, np.int64), rows.track)
        if results is None:
            results = {
                "bouts": schema.empty_table(schema.BOUTS),
                "kinematics": rows.frames_table.iloc[:, :5],
            }
        bouts = results["bouts"]
        of_track = Results(self.origin, rows, self._flips, self._crossings)
        of_track.write_track(self._folder)
        of_track.write_measured(self._folder, results, columns)
        memory.release_memory()
        named = sorted({str(word) for word in bouts["action"]}.difference(actions or {}))
        actions = {**(actions or {}), **dict.fromkeys(named, "")}
        words = [*actions]
        problems = self._document["problems"]
        own = rows, results["kinematics"], bouts, words, problems
        self._replay.finish(*own, self._candidates, together)
        self._mcap.finish(rows, bouts, words, problems, together)
        self._checkpoint.join_replay()
        kept = self._checkpoint.columns.read()
        if BOXES in kept:
            np.savez_compressed(self._folder / CUTOUTS_FILE, boxes=kept[BOXES])
        self.note(actions=actions, **dict(record or {}))
        self._document["thumbnails"] = self._thumbnails.save(self._folder, rows, self.origin.camera)
        if self._together is not None:
            whole = self._thumbnails.save_whole(self._folder, rows, self._together)
            if whole is not None:
                self._document["whole_picture"] = whole
        (self._folder / "plan.toml").write_text(self.origin.plan_toml, encoding="utf-8")
        self._seconds += time.perf_counter() - began
        self._document["files"] = file_facts(self._folder)
        elapsed = self._checkpoint.seconds_before + self._elapsed
        written_s = {"write": round(self._seconds, 4), "total": round(elapsed, 4)}
        self._document |= {
            "frames": of_track.counts(),
            "depth_unit_mm": 1.0,
            "timings_s": {**(timings_s or {}), **written_s},
            "frames_per_s": round(self.n_frames / elapsed, 2),
            "peak_memory_mb": memory.peak_memory_mb(),
            "machine": {
                "name": platform.node(),
                "system": platform.platform(),
                "cores": os.cpu_count(),
            },
            "interruptions": self._checkpoint.n_interruptions,
        }
        made = corrections_for(self.path)
        if made is not None and made.parent != self.path:
            self.note(corrections_taken_from=made.parent.name)
        document = durable.storable_document(self._document)
        text = json.dumps(document, indent=2, default=str, allow_nan=False)
        (self._folder / "session.json").write_text(text + "\n", encoding="utf-8")
        del rows, of_track, own
        self._rows = None  # the report reads the folder
        memory.release_memory()
        self._publish_with_report()
        return Session.open(self.path)

    def _publish_with_report(self) -> None:
        """Publish the session, with or without its report.

        A report can be made again; hours of tracking must not be lost with it.

        Raises:
            SessionError: the disk had no room for the report.
        """
        try:
            if self._report is not None:
                self._report(self._folder)
        except BaseException as error:
            full = full_disk(self._folder, error)
            self._publish()
            if full is None:
                raise
            raise SessionError(
                f"{full}; the session {self.path} is whole but for its report: make room there, "
                f"then make it with liex report {self.path} (in Python report_session)"
            ) from error
        self._publish()

    @property
    def _elapsed(self) -> float:
        return time.perf_counter() - self._started

    def _publish(self) -> None:
        """Move the whole folder into place; an older session is removed only once this one is on
        disk.
        """
        put_back_held(self.path)
        check_writable(self.path, self._overwrite)
        durable.sync_tree(self._folder)  # can take long; until it is done the work can resume
        made = corrections_for(self.path)
        copy = self._folder / FOLDER
        shutil.rmtree(copy, ignore_errors=True)
        if made is not None:  # they apply again if the poses are the same
            shutil.copytree(durable.unlinked_tree(made), copy)
            durable.sync_tree(copy)
        durable.move_into_place(self._folder, self.path, aside_folder(self.path))
        self._done = True
        self._stop_logging()
        self._checkpoint.tidy(self.path)
        if made is not None:
            with suppress(OSError):  # they are then recognised as the same
                note_taken(made, self.path)


def full_disk(folder: Path, error: BaseException | None) -> str | None:
    """The message about a full disk, naming it, if it caused an error; else None.

    Libraries report a full disk by errors of their own, so the disk is probed.

    Args:
        folder: the folder that is written to.
        error: the current error; None if absent.
    """
    if error is None or isinstance(error, LiexError) or not isinstance(error, Exception):
        return None
    if isinstance(error, OSError) and error.errno is not None:
        found = error if durable.is_full(error) else None
    else:
        found = durable.probe_full(folder)
    return None if found is None else durable.why_full(found, folder.parent)


def observation_rows(
    frames: Sequence[DepthFrame], observations: Observations | Track, boxes: Boxes | None = None
) -> dict[str, NDArray[Any]]:
    """Columns of consecutive frames to keep on disk: observations, camera's frame count, time (ns).

    Args:
        frames: n consecutive frames.
        observations: their observations, n rows.
        boxes: (n, K, 4) boxes of the kept depth around the animal; None if whole images are kept.

    Returns:
        Arrays (n, ...) by name.
    """
    columns: dict[str, Any] = {
        one.name: getattr(observations, one.name) for one in fields(observations)
    }
    columns = {name: kept for name, kept in columns.items() if isinstance(kept, np.ndarray)}
    columns[INDEX] = np.array([frame.index for frame in frames], np.int64)
    columns[TIMES] = np.array([frame.time_ns for frame in frames], np.int64)
    return columns if boxes is None else {**columns, BOXES: boxes}


def open_unfinished(path: Path, origin: Provenance) -> Checkpoint:
    """Open the unfinished session of a path, new or resumed.

    Args:
        path: final path of the session.
        origin: provenance of the recording; only a session with the same provenance is resumed.

    Raises:
        SessionError: another process is writing it.
    """
    return Checkpoint(part_folder(path), {"n_frames": origin.n_frames, **origin.document()})


def _check_times(times_ns: NDArray[np.int64], track: Track) -> None:
    """Raises SessionError if a track does not have exactly the frames at times_ns (n,)."""
    if not np.array_equal(times_ns, track.times_ns):
        raise SessionError(
            f"a track has one row for every frame written, got {track.n_frames} rows for "
            f"{len(times_ns)} frames or other time stamps; pass the track of exactly these frames"
        )


# Shards of a recording, measured by several processes in parallel, each in its own folder.


_SIZES = "stretch.json"
_OBSERVED = "seen"


def shard_folder(unfinished: Path, start: int, stop: int) -> Path:
    """Path of a complete shard of an unfinished session.

    Args:
        unfinished: the folder of the unfinished session.
        start: first row of the shard.
        stop: the first row after it.
    """
    return unfinished / STRETCHES / f"{start:09d}-{stop:09d}"


def is_whole(folder: Path) -> bool:
    """Whether a shard exists with files of the recorded sizes.

    Args:
        folder: the shard's folder.
    """
    sizes = text_files.loose_json(folder / _SIZES)
    try:
        return all((folder / log).stat().st_size == sizes[log] for log in LOGS)
    except (OSError, KeyError):
        return False


def append_shard(held: Checkpoint, folder: Path, n_frames: int, seconds: float) -> None:
    """Append a complete shard to an unfinished session, and remove its folder.

    Args:
        held: the unfinished session, locked by this process.
        folder: the shard's folder.
        n_frames: frames of the session including the shard.
        seconds: time spent on them, s.
    """
    held.columns.append(Columns(folder / _OBSERVED).read())
    held.append(folder, n_frames, seconds)
    shutil.rmtree(folder, ignore_errors=True)


@contextmanager
def shard_writer(
    folder: Path, origin: Provenance, first_ns: int | None
) -> Iterator[Callable[[Sequence[DepthFrame], Observations], None]]:
    """Write a shard in a temporary folder next to its own; after an error it is absent.

    Args:
        folder: the shard's folder.
        origin: provenance of the recording.
        first_ns: time of the recording's first frame, ns; None if it is in this shard.

    Yields:
        A function that writes the next frames and their observations, one row per frame.
    """
    from liex_lab.sessions import mcap, rrd

    part = folder.with_name(f".{folder.name}.{os.getpid()}")
    shutil.rmtree(part, ignore_errors=True)
    (part / _OBSERVED).mkdir(parents=True)
    columns = Columns(part / _OBSERVED)
    replay = rrd.ReplayWriter(part / LOGS[0], origin)
    messages = mcap.McapWriter(part / LOGS[1], origin)
    keeper = DepthKeeper(origin)
    if first_ns is not None:
        replay.resume(first_ns)

    def add(frames: Sequence[DepthFrame], observations: Observations) -> None:
        boxes = keeper.boxes(observations)
        depth = keeper.keep([frame.depth for frame in frames], boxes)
        times = [int(frame.time_ns) for frame in frames]
        replay.add([int(frame.index) for frame in frames], times, depth, boxes)
        messages.add(times, depth)
        columns.append(observation_rows(frames, observations, boxes))

    try:
        try:
            yield add
            sizes = dict(zip(LOGS, (replay.flushed(), messages.flushed()), strict=True))
        finally:
            columns.close()
            replay.abandon()
            messages.abandon()
        for log, size in sizes.items():  # drop what closing added
            os.truncate(part / log, size)
        durable.write_whole(part / _SIZES, json.dumps(sizes))
        if not is_whole(folder):  # else another worker was faster
            shutil.rmtree(folder, ignore_errors=True)
            durable.sync_tree(part)
            part.rename(folder)
            durable.sync_folder(folder.parent)
    finally:
        shutil.rmtree(part, ignore_errors=True)
