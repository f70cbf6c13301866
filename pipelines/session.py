"""Measurement of a recording, `liex run`: a depth recording in, a session folder out.

The whole pipeline on one page: recording -> foreground -> candidate poses of single frames -> track
(association, smoothing) -> actions -> behaviour tables. Single frames are measured in chunks and
written immediately, so an interrupted run resumes where it stopped; the track and all later stages
use all frames at once.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Generator, Iterable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from liex_lab.errors import PlanError, RecordingError
from liex_lab.plan import Plan
from liex_lab.recordings.frame import FrameRooms
from liex_lab.recordings.timestamps import JUMPED, PULSES_UNKNOWN
from liex_lab.runtime.memory import Allocator, rest
from liex_lab.runtime.places import inside
from liex_lab.runtime.progress import Progress, silent
from liex_lab.runtime.threads import in_background, prefetch, serial_products

from .build import (
    build_estimator,
    build_recogniser,
    build_recording,
    build_rules,
    build_water,
    why_nameless,
)
from .choice import USUAL, Fitted, fit_plan
from .compiling import compile_ahead
from .origin import build_provenance, build_surroundings, session_bytes
from .regions import pinned
from .shards import CHUNK, LENGTH, MEASURING, Shard, measure_shards
from .workers import WorkerPool

if TYPE_CHECKING:
    import pandas as pd
    from numpy.typing import NDArray

    from liex_lab.actions.timeline import Recognised, TimelineModel
    from liex_lab.behaviour.summary import Behaviour
    from liex_lab.recordings.frame import DepthFrame
    from liex_lab.recordings.recording import Recording
    from liex_lab.sessions import Provenance, Session, SessionWriter
    from liex_lab.sessions.verdict import Verdict
    from liex_lab.sessions.writer import BlueprintMaker, ReportMaker
    from liex_lab.tables.rows import Rows
    from liex_lab.tracking.observations import Observations
    from liex_lab.tracking.tracker import FrameTracker


_AT_ONCE = 2
Observed = tuple["list[DepthFrame]", "Observations"]


def observed(
    tracker: FrameTracker, stretches: Iterable[list[DepthFrame]]
) -> Generator[Observed, None, None]:
    """Stretches of frames with their single-frame observations, in order.

    Args:
        tracker: prepared for their recording.
        stretches: consecutive frames; as many are read ahead as are measured concurrently.

    Yields:
        Each stretch with its observations; an error in one is raised in its turn.
    """
    import numba

    n_threads = numba.get_num_threads()
    if n_threads < _AT_ONCE or not _may_share():
        for frames in stretches:
            yield frames, tracker.observe(frames)
        return
    waiting: deque[tuple[list[DepthFrame], Future[Observations]]] = deque()
    # matrix products are serial meanwhile: the limit is per process, not per thread
    with (
        serial_products(),
        ThreadPoolExecutor(
            _AT_ONCE, initializer=numba.set_num_threads, initargs=(n_threads // _AT_ONCE,)
        ) as pool,
    ):
        try:
            for frames in stretches:
                waiting.append((frames, pool.submit(tracker.observe, frames)))
                if len(waiting) > _AT_ONCE:
                    yield _first(waiting)
            while waiting:
                yield _first(waiting)
        finally:
            for _, coming in waiting:
                coming.cancel()


def _first(waiting: deque[tuple[list[DepthFrame], Future[Observations]]]) -> Observed:
    """The oldest stretch, once it is measured."""
    frames, coming = waiting.popleft()
    return frames, coming.result()


def _may_share() -> bool:
    """Whether several threads may run parallel kernels at once.

    numba's own threading layer aborts a process in which they do. False if no parallel kernel has
    run yet.
    """
    import numba

    try:
        return numba.threading_layer() in ("omp", "tbb")
    except ValueError:
        return False


def measure_session(
    recording: str | Path | Recording,
    plan: Plan | None,
    out: str | Path,
    *,
    settings: Sequence[str] = (),
    folder: Path | None = None,
    overwrite: bool = False,
    notes: Mapping[str, Any] | None = None,
    blueprint: BlueprintMaker | None = None,
    report: ReportMaker | None = None,
    pool: WorkerPool | None = None,
    progress: Progress = silent,
) -> Path:
    """Measure every frame of a recording and write the session folder.

    An unfinished session of the same recording and plan is continued. A plan that the recording
    does not fit is refused before anything is measured; if none is named, the bundled one that fits
    is used. With a worker pool, shards of a long recording (more than two shards, and more frames
    than the pool's minimum) that is given by its path are measured in parallel; the tables are the
    same.

    Args:
        recording: a path or address, or an open recording.
        plan: everything that the run depends on; None uses the bundled plan that fits.
        out: folder of the session, which is named after the plan's session or the recording.
        settings: changes to the plan if none was named, as for `Plan.with_settings`.
        folder: the session folder itself, instead of `out/NAME.liex`.
        overwrite: replace an existing session, once the new one is complete.
        notes: additional contents of session.json, see `SessionWriter.note`.
        blueprint: makes the layout of the replay, see `SessionWriter`.
        report: makes the report in the folder, see `SessionWriter`.
        pool: workers for the shards of a long recording.
        progress: called frame by frame.

    Returns:
        The session folder.

    Raises:
        SessionError: a session exists already, or another process writes it.
        RecordingError: the recording cannot be opened or read.
        PlanError: the plan, or a file that it names, cannot be used.
        MisfitError: the recording does not show the plan's animal.
        EstimationError: no animal is found.
    """
    started = time.perf_counter()
    first = plan or Plan.load(USUAL).with_settings(settings)
    if first.arenas is not None:
        raise PlanError(
            "the plan lists several arenas, each of which becomes a session of its own; measure "
            "them with `liex run`, or in Python with run_arenas"
        )
    with (
        in_background(partial(build_estimator, first)) as estimator,
        build_recording(recording, first, progress) as opened,
    ):
        from liex_lab.recordings.timestamps import unwritable_times
        from liex_lab.sessions import SessionWriter

        folder = folder or inside(Path(out), first.session.name or opened.name, ".liex")
        if told := unwritable_times(opened.times_ns):
            raise RecordingError(f"of {opened.name} {told}")
        whose: list[str] = []
        if isinstance(recording, str | Path) and opened.sources:
            whose = _check_subject(opened, Path(recording), first)
        check_unused(folder, overwrite)
        unnamed = None if plan else settings
        compile_ahead(first.animal.skeleton, progress)
        progress(0, None, "learning the background, the floor and the animal's size")
        fitted = fit_plan(opened, first, estimator, settings=unnamed, progress=progress)
        fitted = replace(fitted, notes=(*fitted.notes, *whose))
        prepared = prepare(fitted, folder, started, progress)
        if pool is not None and isinstance(recording, str | Path):
            prepared.measure_by(pool, recording, progress)
        with SessionWriter(
            folder, prepared.origin, overwrite=overwrite, blueprint=blueprint, report=report
        ) as writer:
            writer.resume(lambda row: prepared.recording.frame(row).depth)
            with closing(read_ahead(prepared.recording, writer.n_frames)) as chunks:
                prepared.measure_all(chunks, writer, progress)
            session = prepared.finish(writer, recording, notes)
    return session.path


def _check_subject(opened: Recording, path: Path, plan: Plan) -> list[str]:
    """Compare the animal's name in the plan with that in metadata, folders or the file name.

    Without a name in the plan, the other one is noted in the metadata; a caution is returned if the
    plan's differs from the metadata's.
    """
    from liex_lab.plan.subject import animal_part, find_subject, letters, same
    from liex_lab.sessions.verdict import OTHER_ANIMAL

    told = str(opened.metadata.get("subject_id", ""))
    found = find_subject(path, told)
    in_metadata = found.origin == "metadata"
    stated = plan.session.subject_id
    if stated is None:
        named = animal_part(told) if in_metadata else found.id if found.origin else ""
        opened.metadata["subject_id"] = named
        return []
    differ = in_metadata and same(found.id) != same(letters(animal_part(stated)))
    # for several arenas the metadata name one animal at most
    alone = plan.arena.region is None
    return [f"{OTHER_ANIMAL}, {told} instead of {stated}"] if differ and alone else []


def check_unused(folder: Path, overwrite: bool) -> None:
    """Refuse to write a session that exists (unless `overwrite`) or that another process writes.

    Raises:
        SessionError: the session cannot be written there.
    """
    from liex_lab.sessions.checkpoint import check_free
    from liex_lab.sessions.folder import check_writable, part_folder, put_back_session

    put_back_session(folder)
    check_writable(folder, overwrite)
    check_free(part_folder(folder))


@dataclass
class Prepared:
    """A session whose scene is learned, ready to measure frames.

    Attributes:
        fitted: plan, recording and tracker.
        origin: provenance of the session.
        folder: the planned session folder.
        timings: seconds of `prepare` and `track`.
    """

    fitted: Fitted
    origin: Provenance
    folder: Path
    timings: dict[str, float]

    @property
    def recording(self) -> Recording:
        """The recording as it is measured."""
        return self.fitted.recording

    def measure(self, frames: list[DepthFrame], writer: SessionWriter) -> None:
        """Measure consecutive frames of this recording and pass them to the session's writer."""
        began = time.perf_counter()
        seen = self.fitted.tracker.observe(frames)
        self.timings["track"] += time.perf_counter() - began
        writer.add(frames, observations=seen)

    def measure_all(
        self, stretches: Iterable[list[DepthFrame]], writer: SessionWriter, progress: Progress
    ) -> None:
        """Measure consecutive stretches of frames, some concurrently, and write them."""
        with closing(observed(self.fitted.tracker, stretches)) as coming:
            began = time.perf_counter()
            for frames, seen in coming:
                self.timings["track"] += time.perf_counter() - began
                writer.add(frames, observations=seen)
                progress(frames[-1].index + 1, len(self.recording), MEASURING)
                began = time.perf_counter()

    def measure_by(self, pool: WorkerPool, recording: str | Path, progress: Progress) -> None:
        """Let workers measure the shards of a long recording (more than two shards).

        Args:
            pool: the workers.
            recording: path or address, which each of them opens; if an archive is unpacked here,
                workers on this machine open the unpacked files.
            progress: called shard by shard.
        """
        n = len(self.recording)
        if n <= max(2 * LENGTH, pool.fewest):
            return
        opened_as = pinned(self.fitted.plan, self.recording)
        place = str((pool.here and self.recording.unpacked) or recording)
        whole = Shard(place, opened_as, self.fitted.tracker, self.origin, self.folder, 0, n)
        measure_shards(pool, whole, self.folder, progress)

    def finish(
        self,
        writer: SessionWriter,
        source: str | Path | Recording,
        notes: Mapping[str, Any] | None = None,
    ) -> Session:
        """Make track, behaviour and tables, and move the session to its folder.

        Args:
            writer: has all frames.
            source: path or address of the recording, to which the session links; there is no link
                to an open recording.
            notes: additional contents of session.json.
        """
        from liex_lab.sessions.evidence import link_to

        began = time.perf_counter()
        verdict = make_track(writer, self.fitted)
        self.timings["track"] += time.perf_counter() - began
        if isinstance(source, str | Path):
            writer.note(input=link_to(source, self.folder))
        writer.note(problems=self.recording.problems, verdict=verdict.to_dict())
        writer.note(**dict(notes or {}))
        return conclude(writer, self.fitted.plan, self.timings)


def prepare(fitted: Fitted, folder: Path, started: float, progress: Progress) -> Prepared:
    """Prepare a session for measuring; raises early if the recogniser is unknown.

    Args:
        fitted: plan, recording and tracker.
        folder: the planned session folder.
        started: when its preparation began, by `time.perf_counter`.
        progress: called while the recording is hashed.

    Raises:
        ModelError: there is no such recogniser.
        PlanError: the recogniser was made for another skeleton.
        SessionError: there is not enough disk space.
    """
    from liex_lab.sessions.checkpoint import hash_once
    from liex_lab.sessions.folder import check_room, megabytes, part_folder

    build_recogniser(fitted.plan, fitted.tracker.estimator.skeleton)
    hash_once(fitted.recording, part_folder(folder), progress)
    origin = build_provenance(fitted.recording, fitted.plan, fitted.tracker, progress)
    needed = session_bytes(
        fitted.recording, fitted.plan, fitted.tracker.spine_mm, origin.floor_distance_mm
    )
    progress(0, None, f"the session takes about {megabytes(needed)} on disk")
    check_room(folder, needed)
    return Prepared(
        fitted, origin, folder, {"prepare": time.perf_counter() - started, "track": 0.0}
    )


def read_ahead(opened: Recording, first: int) -> Generator[list[DepthFrame], None, None]:
    """Chunks of frames from `first` on, the next read while one is measured.

    Rendered recordings are not read ahead, as rendering takes all cores.
    """
    if opened.format == "synthetic":
        yield from opened.chunks(CHUNK, first)
        return
    rooms = FrameRooms()
    frames = opened.frames(first)
    yield from prefetch(iter(lambda: rooms.filled(frames, CHUNK), []))


def make_track(writer: SessionWriter, fitted: Fitted) -> Verdict:
    """Make the track of a session whose frames have all been measured, and pass it to the writer.

    Returns:
        The verdict on the session.
    """
    from liex_lab.optics.camera import unusual_centre, unusual_lens
    from liex_lab.sessions.verdict import Verdict
    from liex_lab.tracking.curve import repeat_messages
    from liex_lab.tracking.observations import Observations
    from liex_lab.tracking.trust import why_too_fast

    tracker = fitted.tracker
    whole = writer.observations(Observations)
    tracked = tracker.track(whole, allocate=writer.allocate)
    subject = tracker.subject
    recording = fitted.recording
    fast = why_too_fast(tracked.track, subject.length_mm)
    frozen, copied = repeat_messages(whole.times_ns, whole.repeats, tracker.noisy)
    water = build_water(fitted.plan)
    # with water the ideal camera has another focal length
    lens = unusual_lens(recording.camera) if water is None else ""
    jumps = [gap.start_frame for gap in recording.gaps if gap.reason == JUMPED]
    centre, at_edge = unusual_centre(recording.camera)
    place = tracker.scene.floor.unusual(None if water is None else water.lift_mm)
    verdict = Verdict.of(
        tracked.track,
        whole,
        misfits=fitted.misfits,
        doubts=(
            *tracker.scene.doubts,
            *recording.doubts,
            *recording.clock_doubts,
            *filter(None, [fast, centre if at_edge else ""]),
            *frozen,
            *recording.files.rewritten(),
        ),
        n_animals=subject.n_animals,
        cautions=(
            *fitted.notes,
            *copied,
            *tracker.scene.remarks,
            *recording.files.grown(),
            *filter(None, [lens, "" if at_edge else centre]),
            *place,
            *(f"{PULSES_UNKNOWN}, first before frame {k}" for k in jumps[:1]),
        ),
        accepted=fitted.plan.estimation.accept_misfit,
    )
    writer.take(tracked, whole, subject)
    return verdict


def conclude(writer: SessionWriter, plan: Plan, timings: dict[str, float]) -> Session:
    """Measure the behaviour and move the session to its folder; returns the finished session."""
    behaviour, notes = measure_behaviour(writer.rows, plan, writer.origin, writer.allocate)
    writer.note(**notes, problems=_told_refused(notes))
    rest()
    return writer.close(timings_s=timings, **behaviour.for_session())


def measure_behaviour(
    rows: Rows,
    plan: Plan,
    origin: Provenance,
    allocate: Allocator = np.empty,
    seams: Sequence[int] = (),
) -> tuple[Behaviour, dict[str, Any]]:
    """The behaviour of a track by the plan's recogniser or rules, and notes for session.json.

    Args:
        rows: the track as table rows.
        plan: rules and action model.
        origin: skeleton, arena, zones and water.
        allocate: allocator of large arrays, such as one of files on disk.
        seams: rows across which nothing is measured, see `Surroundings`.
    """
    from liex_lab.behaviour.summary import measure_rows, moving_rows
    from liex_lab.tables.schema import BOUTS, empty_table

    recogniser = build_recogniser(plan, origin.skeleton)
    rules = build_rules(plan)
    around = replace(build_surroundings(origin), seams=seams)
    moved = moving_rows(rows, rules, around, allocate)
    named: dict[str, Any] = {}
    notes: dict[str, Any] = {}
    if recogniser is not None:
        named, notes = name_actions(recogniser, rows, moved, allocate)
    elif nameless := why_nameless(plan, origin.skeleton):
        named = {"bouts": empty_table(BOUTS), "actions": {}}
        notes = {"no_actions": nameless}
    rest()
    return measure_rows(rows, rules, around, moved=moved, allocate=allocate, **named), notes


def name_actions(
    recogniser: TimelineModel, rows: Rows, moved: pd.DataFrame, allocate: Allocator = np.empty
) -> tuple[dict[str, Any], dict[str, Any]]:
    """The ethogram of a track by a recogniser, and notes for session.json.

    Args:
        recogniser: assigns an action to each frame.
        rows: the track as table rows, with the distance of the animal from the nearest wall, mm.
        moved: the table `kinematics` of the track, for checking bouts.
        allocate: allocator of large arrays.

    Returns:
        `bouts` and the definitions of `actions`, as for `measure_rows`; and notes: the recogniser,
        the actions that cannot be resolved at the frame rate, and the bouts that were refused since
        they contradict their definition.
    """
    from liex_lab.actions.vocabulary import printed_meanings
    from liex_lab.behaviour.bouts import recognise
    from liex_lab.tables.rows import bout_rows

    found = recognise(recogniser, rows.track, rows.wall_distance_mm, moved, allocate)
    notes = {
        "action_model": {
            "skeleton": recogniser.skeleton,
            "clock_hz": recogniser.clock_hz,
            **recogniser.card,
        },
        "unresolved_actions": found.unresolved,
        "refused_bouts": {"bouts": _refusals(found, rows.track.times_ns)},
    }
    meanings = printed_meanings(recogniser.skeleton, recogniser.definitions)
    actions = {word: meanings.get(word, "") for word in recogniser.words if word}
    bouts = bout_rows(found.ethogram, rows.frames_table, str(recogniser.card.get("sha256", "")))
    return {"bouts": bouts, "actions": actions}, notes


def _told_refused(notes: dict[str, Any]) -> list[str]:
    """A sentence on refused bouts for the session's problems; [] if there are none."""
    n = len(notes.get("refused_bouts", {}).get("bouts", []))
    if not n:
        return []
    told = (
        "1 bout did not meet the definition of its label and was"
        if n == 1
        else f"{n} bouts did not meet the definitions of their labels and were"
    )
    return [f"{told} relabelled or left unlabelled (refused_bouts in session.json)."]


def _refusals(found: Recognised, times_ns: NDArray[np.int64]) -> list[dict[str, Any]]:
    """The refused bouts for session.json, in order of time; times are s since the first frame."""
    from liex_lab.actions.ethogram import frame_stops

    start_s = (times_ns - times_ns[:1]) * 1e-9
    stop_s = (frame_stops(times_ns) - times_ns[:1]) * 1e-9
    return [
        {
            "action": one.action,
            "start_s": round(float(start_s[one.rows.start]), 6),
            "stop_s": round(float(stop_s[one.rows.stop - 1]), 6),
            "named": one.named,
            "why": one.why,
        }
        for one in sorted(found.refused, key=lambda one: one.rows.start)
    ]
