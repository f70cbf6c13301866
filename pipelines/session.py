"""Measurement of a recording, `liex run`: a depth recording in, a session folder out.

The whole pipeline on one page: recording -> foreground -> candidate poses of single frames -> track
(association, smoothing) -> actions -> behaviour tables. Single frames are measured in chunks and
written immediately, so an interrupted run resumes where it stopped; the track and all later stages
use all frames at once.

Observations do not depend on neighbouring frames, so workers can measure a long recording in
shards, and the tables are those of one process. Shards begin at multiples of `LENGTH` frames and
have folders of their own until they are appended in order: an interruption costs only the shards in
progress.
"""

import time
from collections import deque
from collections.abc import Generator, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing, contextmanager
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from itertools import chain
from pathlib import Path
from typing import Any, Protocol, TypeVar

import numba
import numpy as np
import pandas as pd
from liex_lab.dashboards.replay.layouts import replay_blueprint
from liex_lab.dashboards.report.report import write_views
from numpy.typing import NDArray

from liex_lab.actions import ethogram, timeline, vocabulary
from liex_lab.behaviour import summary
from liex_lab.behaviour.bouts import recognise
from liex_lab.behaviour.days import Light
from liex_lab.catalog import DEMO, find_sample
from liex_lab.errors import PlanError, RecordingError
from liex_lab.optics.camera import unusual_centre, unusual_lens
from liex_lab.plan import Plan, study
from liex_lab.recordings import frame, timestamps
from liex_lab.recordings.recording import Recording
from liex_lab.runtime import durable, memory, processes
from liex_lab.runtime.processes import WorkerPool
from liex_lab.runtime.progress import Progress, reporting_compilation, silent
from liex_lab.sessions import (
    Provenance,
    Session,
    SessionWriter,
    checkpoint,
    evidence,
)
from liex_lab.sessions.folder import (
    check_room,
    check_writable,
    megabytes,
    part_folder,
    put_back_session,
)
from liex_lab.sessions.verdict import OTHER_ANIMAL, Verdict
from liex_lab.sessions.writer import (
    append_shard,
    is_whole,
    open_unfinished,
    shard_folder,
    shard_writer,
)
from liex_lab.tables.rows import Rows, bout_rows
from liex_lab.tables.schema import BOUTS, MOSEQ, empty_table, to_pandas
from liex_lab.tracking import curve, identity, observations, trust
from liex_lab.tracking.track import Crossing
from liex_lab.tracking.tracker import FrameTracker

from .build import (
    build_estimator,
    build_provenance,
    build_recogniser,
    build_recording,
    build_rules,
    build_surroundings,
    build_water,
    pinned,
    session_bytes,
    why_nameless,
)
from .choice import USUAL, Fitted, fit_plan
from .compiling import compile_ahead

LENGTH = 500  # frames per shard: some seconds of work, the cost of an interruption
CHUNK = 32  # frames in memory at a time
MEASURING = "measuring poses"


@dataclass(frozen=True)
class Shard:
    """A span of frames of a recording, with all that a remote worker needs to measure it.

    Attributes:
        recording: path or address of the recording.
        plan: how it is measured.
        tracker: the prepared tracker; a pickle omits its estimator, which is large.
        origin: provenance of the session.
        folder: folder of the result.
        start: first frame.
        stop: frame after the last one.
    """

    recording: str
    plan: Plan
    tracker: FrameTracker
    origin: Provenance
    folder: Path
    start: int
    stop: int

    def __getstate__(self) -> dict[str, Any]:
        """State without the large model: a worker loads it from the file and caches it."""
        return {**vars(self), "tracker": replace(self.tracker, estimator=None)}  # type: ignore[arg-type]

    def __setstate__(self, state: dict[str, Any]) -> None:
        tracker = replace(state["tracker"], estimator=build_estimator(state["plan"]))
        vars(self).update({**state, "tracker": tracker})


def measure_shard(shard: Shard) -> Shard:
    """Measure a shard and write it: the task of a worker. It may safely run twice.

    Returns:
        The same shard, once its folder is complete.
    """
    opened = _opened(shard.recording, shard.plan.to_toml(), shard.origin.input_sha256)
    first_ns = int(opened.times_ns[0]) if shard.start else None
    with shard_writer(shard.folder, shard.origin, first_ns) as add:
        for frames in opened.chunks(CHUNK, shard.start, shard.stop):
            add(frames, shard.tracker.observe(frames))
    return shard


@lru_cache(maxsize=1)
def _opened(recording: str, plan_toml: str, input_sha256: str) -> Recording:
    """The recording, kept open for this process's next shards; the hash distinguishes versions."""
    return build_recording(recording, Plan.from_toml(plan_toml))


def measure_shards(pool: WorkerPool, whole: Shard, path: Path, progress: Progress) -> None:
    """Measure all frames of a recording that its unfinished session lacks.

    Afterwards the session resumes as if interrupted after its last frame. Completed shards are
    kept, even after an error.

    Args:
        pool: the worker pool.
        whole: the recording as one shard; its folder is not used.
        path: the planned session folder; the unfinished session is next to it.
        progress: called shard by shard.

    Raises:
        SessionError: a worker died, or another process writes the session.
    """
    held = open_unfinished(path, whole.origin)
    try:
        held.begin_shards()
        began = time.monotonic()
        done = held.state.n_frames
        planned = [
            replace(whole, start=start, stop=stop, folder=shard_folder(held.folder, start, stop))
            for start, stop in _cuts(done, whole.stop)
        ]
        waiting = list(planned)
        n_left = whole.stop - done
        there = [shard for shard in planned if is_whole(shard.folder)]
        others = [shard for shard in planned if shard not in there]
        for shard in chain(there, pool.each(measure_shard, others)):
            n_left -= shard.stop - shard.start
            while waiting and is_whole(waiting[0].folder):
                one = waiting.pop(0)
                seconds = round(held.seconds_before + time.monotonic() - began, 3)
                append_shard(held, one.folder, one.stop, seconds)
            progress(whole.stop - n_left, whole.stop, MEASURING)
    finally:
        held.leave(keep=True)


def _cuts(first: int, stop: int) -> Iterator[tuple[int, int]]:
    """Frames first to stop cut at multiples of `LENGTH`, the same shards in every run."""
    while first < stop:
        last = min(stop, (first // LENGTH + 1) * LENGTH)
        yield first, last
        first = last


# Measurement of frames, and of a whole recording.


_AT_ONCE = 2
# imported while the first frames are measured: for the replay, `transitions` and the figures
HEAVY = ("rerun", "scipy.special", "matplotlib.figure", "matplotlib.backends.backend_pdf")
Seen = TypeVar("Seen", covariant=True)


class Further(Protocol):
    """Measures of a session beyond those of its animal's track."""

    def for_session(self, rows: Rows, measured: Mapping[str, pd.DataFrame]) -> dict[str, Any]:
        """Tables, descriptions of their columns and notes, as `SessionWriter.close` takes them."""


class Observer(Protocol[Seen]):
    """A tracker of one animal or of several."""

    def observe(self, frames: list[frame.DepthFrame]) -> Seen:
        """The observations of consecutive frames."""


def observed(
    tracker: Observer[Seen], stretches: Iterable[list[frame.DepthFrame]]
) -> Generator[tuple[list[frame.DepthFrame], Seen], None, None]:
    """Stretches of frames with their single-frame observations, in order.

    Args:
        tracker: prepared for their recording.
        stretches: consecutive frames; as many are read ahead as are measured concurrently.

    Yields:
        Each stretch with its observations; an error in one is raised in its turn.
    """
    n_threads = numba.get_num_threads()
    if n_threads < _AT_ONCE or not _may_share():
        for frames in stretches:
            yield frames, tracker.observe(frames)
        return
    waiting: deque[tuple[list[frame.DepthFrame], Future[Seen]]] = deque()
    # matrix products are serial meanwhile: the limit is per process, not per thread
    with (
        processes.serial_products(),
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


def _first(
    waiting: deque[tuple[list[frame.DepthFrame], Future[Seen]]],
) -> tuple[list[frame.DepthFrame], Seen]:
    """The oldest stretch, once it is measured."""
    frames, coming = waiting.popleft()
    return frames, coming.result()


def _may_share() -> bool:
    """Whether several threads may run parallel kernels at once.

    numba's own threading layer aborts a process in which they do. False if no parallel kernel has
    run yet.
    """
    try:
        return numba.threading_layer() in ("omp", "tbb")
    except ValueError:
        return False


def run_session(
    recording: str | Path | Recording,
    plan: Plan | None = None,
    out: str | Path = ".",
    *,
    settings: Sequence[str] = (),
    folder: Path | None = None,
    overwrite: bool = False,
    notes: Mapping[str, Any] | None = None,
    workers: int = 1,
    pool: processes.WorkerPool | None = None,
    report: bool = True,
    further: Further | None = None,
    progress: Progress = silent,
) -> Path:
    """Measure every frame of a depth recording and write a session folder; returns its path.

    The steps are background subtraction, single-frame pose estimation by the Lie-X method,
    association and smoothing over the whole recording, kinematics and ethogram. If the recording,
    the plan or the animal cannot be used, no partial output remains. An unfinished session of the
    same recording and plan is continued.

    Args:
        recording: path of a recording, address of a virtual one, or an open recording.
        plan: all settings of the run; None selects the bundled plan that fits, the mouse's if it
            does.
        out: parent of the session folder `<recording's name>.liex`.
        settings: overrides when no plan is given, texts like 'animal.spine_mm=65'.
        folder: the session folder, to use another name.
        overwrite: replace an existing session.
        notes: additional facts for session.json, see `SessionWriter.note`.
        workers: processes for parallel shards of a long recording; 0 uses one for every two cores,
            four at most, for more than 6,000 frames. The tables are the same for any number.
            Scripts that use more than one must guard their entry point with `if __name__ ==
            "__main__":`, as processes are spawned.
        pool: a worker pool to use instead of `workers` local processes.
        report: whether to write the report with its figures.
        further: measures to add, such as those of a live recording's triggers.
        progress: receives progress reports.

    Returns:
        The session folder.

    Raises:
        LiexError: the recording, the plan or the animal in it cannot be used; the message gives
            advice.
    """
    started = time.perf_counter()
    memory.check_limits()
    first = plan or Plan.load(USUAL).with_settings(settings)
    if first.arenas is not None:
        raise PlanError(
            "the plan lists several arenas, each of which becomes a session of its own; measure "
            "them with `liex run`, or in Python with run_arenas"
        )
    if first.animal.count != 1:
        raise PlanError(
            "the plan states several animals (animal.count), each of which becomes a session of "
            "its own; measure them with `liex run`, or in Python with run_arenas"
        )
    with (
        processes.imported_ahead(*HEAVY),
        reporting_compilation(progress) as progress,
        processes.in_background(partial(build_estimator, first)) as estimator,
        build_recording(recording, first, progress) as opened,
    ):
        folder = folder or durable.inside(Path(out), first.session.name or opened.name, ".liex")
        if problem := timestamps.unwritable_times(opened.times_ns):
            raise RecordingError(f"of {opened.name} {problem}")
        cautions: list[str] = []
        if isinstance(recording, str | Path) and opened.sources:
            cautions = _check_subject(opened, Path(recording), first)
        check_unused(folder, overwrite)
        unnamed = None if plan else settings
        compile_ahead(first.animal.skeleton, progress=progress)
        progress(0, None, "learning the background, the floor and the animal's size")
        fitted = fit_plan(opened, first, estimator, settings=unnamed, progress=progress)
        fitted = replace(fitted, notes=(*fitted.notes, *cautions))
        prepared = prepare(fitted, folder, started, progress)
        if (pool := pool or processes.processes_for(workers)) and isinstance(recording, str | Path):
            prepared.measure_by(pool, recording, progress)
        with prepared.writing(overwrite, report) as writer:
            with closing(read_ahead(prepared.recording, writer.n_frames)) as chunks:
                prepared.measure_all(chunks, writer, progress)
            return prepared.finish(writer, recording, notes, further).path


def run_demo(out: str | Path = ".", *, progress: Progress = silent) -> Path:
    """Measure the bundled sample recording; returns its session folder.

    An earlier demo session in the same folder is replaced.

    Args:
        out: parent of the session folder.
        progress: receives progress reports.
    """
    return run_session(
        find_sample(DEMO), Plan.load("mouse"), out, overwrite=True, progress=progress
    )


def _check_subject(opened: Recording, path: Path, plan: Plan) -> list[str]:
    """Compare the animal's name in the plan with that in metadata, folders or the file name.

    Without a name in the plan, the other one is noted in the metadata; a caution is returned if the
    plan's differs from the metadata's.
    """
    recorded = str(opened.metadata.get("subject_id", ""))
    several = len(durable.named_files(path)) > 1
    found = study.find_subject(path.with_name(opened.name) if several else path, recorded)
    in_metadata = found.origin == "metadata"
    stated = plan.session.subject_id
    if stated is None:
        named = study.animal_part(recorded) if in_metadata else found.id if found.origin else ""
        opened.metadata["subject_id"] = named
        return []
    differ = in_metadata and study.same(found.id) != study.same(
        study.letters(study.animal_part(stated))
    )
    # for several arenas the metadata name one animal at most
    alone = plan.arena.region is None
    return [f"{OTHER_ANIMAL}, {recorded} instead of {stated}"] if differ and alone else []


def check_unused(folder: Path, overwrite: bool) -> None:
    """Refuse to write a session that exists (unless `overwrite`) or that another process writes.

    Raises:
        SessionError: the session cannot be written there.
    """
    put_back_session(folder)
    check_writable(folder, overwrite)
    checkpoint.check_free(part_folder(folder))


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

    @contextmanager
    def writing(self, overwrite: bool, report: bool) -> Iterator[SessionWriter]:
        """The writer of the session's folder, which continues an unfinished one."""
        with SessionWriter(
            self.folder,
            self.origin,
            overwrite=overwrite,
            blueprint=replay_blueprint,
            report=write_views if report else None,
        ) as writer:
            writer.resume(lambda row: self.recording.frame(row).depth)
            yield writer

    def measure(self, frames: list[frame.DepthFrame], writer: SessionWriter) -> None:
        """Measure consecutive frames of this recording and pass them to the session's writer."""
        began = time.perf_counter()
        estimates = self.fitted.tracker.observe(frames)
        self.timings["track"] += time.perf_counter() - began
        writer.add(frames, observations=estimates)

    def measure_all(
        self, stretches: Iterable[list[frame.DepthFrame]], writer: SessionWriter, progress: Progress
    ) -> None:
        """Measure consecutive stretches of frames, some concurrently, and write them."""
        with closing(observed(self.fitted.tracker, stretches)) as coming:
            began = time.perf_counter()
            for frames, estimates in coming:
                self.timings["track"] += time.perf_counter() - began
                writer.add(frames, observations=estimates)
                progress(frames[-1].index + 1, len(self.recording), MEASURING)
                began = time.perf_counter()

    def measure_by(
        self, pool: processes.WorkerPool, recording: str | Path, progress: Progress
    ) -> None:
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
        further: Further | None = None,
    ) -> Session:
        """Make track, behaviour and tables, and move the session to its folder.

        Args:
            writer: has all frames.
            source: path or address of the recording, to which the session links; there is no link
                to an open recording.
            notes: additional contents of session.json.
            further: measures to add; None for none.
        """
        self.follow(writer)
        return self.conclude(writer, source, notes, further)

    def follow(
        self,
        writer: SessionWriter,
        observed: observations.Observations | None = None,
        crossings: Sequence[Crossing] = (),
        covering: NDArray[np.bool_] | None = None,
    ) -> None:
        """Make the track of the animal and the verdict on it, and pass them to the writer.

        Args:
            writer: has all frames.
            observed: the observations of this animal; None uses those that the writer has.
            crossings: in which it may have been exchanged with another one.
            covering: (n,) where it may lie over another one; None if it is alone.
        """
        began = time.perf_counter()
        verdict = make_track(writer, self.fitted, observed, crossings, covering)
        self.timings["track"] += time.perf_counter() - began
        writer.note(problems=self.recording.problems, verdict=verdict.to_dict())

    def mark(self, writer: SessionWriter, found: identity.Identity, animal: int) -> None:
        """Name the animal by its RFID tag, if it is known, and note how the readings fit.

        Args:
            writer: the session's writer.
            found: the identities of all animals of the arena.
            animal: number of this one.
        """
        fitted = self.fitted
        misfits, notes = (*fitted.misfits, *found.misfits), (*fitted.notes, *found.remarks)
        self.fitted = replace(fitted, misfits=misfits, notes=notes)
        if found.tags and found.tags[animal]:
            writer.origin.subject["subject_id"] = found.tags[animal]
            writer.note(subject={"subject_id": found.tags[animal]})

    def conclude(
        self,
        writer: SessionWriter,
        source: str | Path | Recording,
        notes: Mapping[str, Any] | None = None,
        *further: Further | None,
    ) -> Session:
        """Make behaviour and tables of a track, and move the session to its folder.

        Args:
            writer: has the track.
            source: as for `finish`.
            notes: additional contents of session.json.
            *further: measures to add, such as the interactions of all animals of the arena.
        """
        if isinstance(source, str | Path):
            writer.note(input=evidence.link_to(source, self.folder))
        writer.note(**dict(notes or {}))
        return conclude(writer, self.fitted.plan, self.timings, *further)


def prepare(fitted: Fitted, folder: Path, started: float, progress: Progress) -> Prepared:
    """Prepare a session for measuring; raises early if the recogniser is unknown.

    Args:
        fitted: plan, recording and tracker.
        folder: the planned session folder.
        started: when its preparation began, by `time.perf_counter`.
        progress: called while the recording is hashed.

    Raises:
        ModelError: there is no such recogniser.
        PlanError: the recogniser was made for another skeleton, [light] is stated and the time of
            day of the recording is unknown, or a period is not in the recording.
        SessionError: there is not enough disk space.
    """
    build_recogniser(fitted.plan, fitted.tracker.estimator.skeleton)

    origin = build_provenance(fitted.recording, fitted.plan, fitted.tracker, progress)
    Light.of(fitted.plan.light.model_dump(), origin.session_start_time)
    list(  # refuses periods that are not in the recording
        summary.frames_of_periods(
            fitted.plan.behaviour,
            (fitted.recording.times_ns - fitted.recording.times_ns[:1]) / 1e9,
        )
    )
    needed = session_bytes(
        fitted.recording, fitted.plan, fitted.tracker.spine_mm, origin.floor_distance_mm
    )
    progress(0, None, f"the session takes about {megabytes(needed)} on disk")
    check_room(folder, needed)
    return Prepared(
        fitted, origin, folder, {"prepare": time.perf_counter() - started, "track": 0.0}
    )


def read_ahead(opened: Recording, first: int) -> Generator[list[frame.DepthFrame], None, None]:
    """Chunks of frames from `first` on, the next read while one is measured.

    Rendered recordings are not read ahead, as rendering takes all cores.
    """
    chunks = opened.chunks(CHUNK, first)
    yield from chunks if opened.format == "synthetic" else processes.prefetch(chunks)


def make_track(
    writer: SessionWriter,
    fitted: Fitted,
    observed: observations.Observations | None,
    crossings: Sequence[Crossing],
    covering: NDArray[np.bool_] | None,
) -> Verdict:
    """Make the track of a session whose frames have all been measured, and pass it to the writer.

    Args:
        writer: has all frames.
        fitted: plan, recording and tracker.
        observed: the observations of the animal; None uses those that the writer has.
        crossings: in which it may have been exchanged with another one.
        covering: (n,) where it may lie over another one; None if it is alone.

    Returns:
        The verdict on the session.
    """
    tracker = fitted.tracker
    whole = observed or writer.observations(observations.Observations)
    tracked = tracker.track(whole, allocate=writer.allocate)
    if covering is not None:
        tracked = replace(tracked, crossings=tuple(crossings))
        identity.flag_unclear(tracked, covering)
    subject = tracker.subject
    recording = fitted.recording
    fast = trust.why_too_fast(tracked.track, subject.length_mm)
    frozen, copied = curve.repeat_messages(whole.times_ns, whole.repeats, tracker.noisy)
    water = build_water(fitted.plan)
    # with water the ideal camera has another focal length
    lens = unusual_lens(recording.camera) if water is None else ""
    jumps = [gap.start_frame for gap in recording.gaps if gap.reason == timestamps.JUMPED]
    centre, at_edge = unusual_centre(recording.camera)
    place = tracker.scene.floor.unusual(None if water is None else water.lift_mm)
    shape = "" if tracker.shape is None else tracker.shape.caution(tracker.spine_mm)
    verdict = Verdict.of(
        tracked,
        whole,
        misfits=fitted.misfits,
        doubts=(
            *tracker.scene.doubts,
            *recording.doubts,
            *recording.clock_doubts,
            *filter(None, [fast, centre if at_edge else "", identity.doubt(crossings or ())]),
            *frozen,
            *recording.files.rewritten(),
        ),
        n_measured=subject.n_measured,
        cautions=(
            *fitted.notes,
            *copied,
            *tracker.scene.remarks,
            *recording.files.grown(),
            *filter(None, [lens, "" if at_edge else centre, shape]),
            *place,
            *(f"{timestamps.PULSES_UNKNOWN}, first before frame {k}" for k in jumps[:1]),
        ),
        accepted=fitted.plan.estimation.accept_misfit,
    )
    writer.take(tracked, whole, replace(subject, n_animals=tracked.n_animals))
    return verdict


def conclude(
    writer: SessionWriter,
    plan: Plan,
    timings: dict[str, float],
    *further: Further | None,
) -> Session:
    """Measure the behaviour and move the session to its folder; returns the finished session.

    Args:
        writer: has all frames and their track.
        plan: rules and action model.
        timings: seconds of each part of the work so far.
        *further: measures to add, such as the interactions of all animals of the arena.
    """
    behaviour, notes = measure_behaviour(writer.rows, plan, writer.origin, writer.allocate)
    writer.note(**notes, problems=_refused_sentence(notes))
    memory.release_memory()
    closing = behaviour.for_session()
    if stated := writer.origin.measured:
        known: dict[str, Any] = {one.name: stated.get(one.name, np.nan) for one in MOSEQ}
        known |= dict(writer.rows.frames_table[["session_id", "individual", "frame_index"]])
        closing["results"]["moseq"] = to_pandas(MOSEQ, known)
        closing["columns"] += MOSEQ
    for one in filter(None, further):
        more = one.for_session(writer.rows, behaviour.tables)
        closing["results"] |= more["results"]
        closing["columns"] += more["columns"]
        closing["record"] |= more["record"]
        closing["together"] = more.get("together", closing.get("together"))
    return writer.close(timings_s=timings, **closing)


def measure_behaviour(
    rows: Rows,
    plan: Plan,
    origin: Provenance,
    allocate: memory.Allocator = np.empty,
    seams: Sequence[int] = (),
) -> tuple[summary.Behaviour, dict[str, Any]]:
    """The behaviour of a track by the plan's recogniser or rules, and notes for session.json.

    Args:
        rows: the track as table rows.
        plan: rules and action model.
        origin: skeleton, arena, zones and water.
        allocate: allocator of large arrays, such as one of files on disk.
        seams: rows across which nothing is measured, see `Surroundings`.
    """
    recogniser = build_recogniser(plan, origin.skeleton)
    rules = build_rules(plan)
    light = Light.of(plan.light.model_dump(), origin.session_start_time)
    around = replace(build_surroundings(origin), seams=seams, light=light)
    moved = summary.kinematics_of_rows(rows, rules, around, allocate)
    named: dict[str, Any] = {}
    notes: dict[str, Any] = {}
    if recogniser is not None:
        named, notes = name_actions(recogniser, rows, moved, allocate)
    elif nameless := why_nameless(plan, origin.skeleton):
        named = {"bouts": empty_table(BOUTS), "actions": {}}
        notes = {"no_actions": nameless}
    memory.release_memory()
    return summary.measure_rows(rows, rules, around, moved=moved, allocate=allocate, **named), notes


def name_actions(
    recogniser: timeline.TimelineModel,
    rows: Rows,
    moved: pd.DataFrame,
    allocate: memory.Allocator = np.empty,
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
    meanings = vocabulary.printed_meanings(recogniser.skeleton, recogniser.definitions)
    actions = {word: meanings.get(word, "") for word in recogniser.words if word}
    bouts = bout_rows(found.ethogram, rows.frames_table, str(recogniser.card.get("sha256", "")))
    return {"bouts": bouts, "actions": actions}, notes


def _refused_sentence(notes: dict[str, Any]) -> list[str]:
    """A sentence on refused bouts for the session's problems; [] if there are none."""
    n = len(notes.get("refused_bouts", {}).get("bouts", []))
    if not n:
        return []
    refused = (
        "1 bout did not meet the definition of its label and was"
        if n == 1
        else f"{n} bouts did not meet the definitions of their labels and were"
    )
    return [f"{refused} relabelled or left unlabelled (refused_bouts in session.json)."]


def _refusals(found: timeline.Recognised, times_ns: NDArray[np.int64]) -> list[dict[str, Any]]:
    """The refused bouts for session.json, in order of time; times are s since the first frame."""
    start_s = (times_ns - times_ns[:1]) * 1e-9
    stop_s = (ethogram.frame_stops(times_ns) - times_ns[:1]) * 1e-9
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
