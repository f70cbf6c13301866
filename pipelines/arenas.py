"""Measurement of several arenas, or several animals, in one recording: a session each, in one pass.

Each frame is decoded once; every arena's pipeline gets it with all pixels outside the arena's
region unread. The arenas are otherwise independent: each has its own background, floor, size,
track, checkpoint and folder, NAME-ARENA.liex, and its tables are byte-identical to those of a run
with that region alone. If one arena fails, the others continue.

Several animals in one arena (`animal.count`) share its background and floor, and every frame is
measured for all of them at once (`tracking.joint`). At the end their identities are decided over
the whole recording (`tracking.identity`), and each animal's session, NAME-animalK.liex, is finished
as that of a single animal is.
"""

import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from liex_lab.behaviour.interactions import Individual, find_interactions
from liex_lab.errors import LiexError, PlanError, RecordingError
from liex_lab.plan import Plan, sections
from liex_lab.plan.plan import toml_value
from liex_lab.recordings.frame import DepthFrame
from liex_lab.recordings.recording import Recording
from liex_lab.recordings.timestamps import unwritable_times
from liex_lab.runtime import durable, processes
from liex_lab.runtime.progress import Progress, reporting_compilation, silent
from liex_lab.scene.zones import masks_apart
from liex_lab.tracking.covered import covered_stretches, measure_covered
from liex_lab.tracking.identity import covers, identify, own_observations
from liex_lab.tracking.joint import JointTracker
from liex_lab.tracking.observations import Observations
from liex_lab.tracking.rfid import Readings, read_readings

from .build import arenas_of, build_arena, build_joint_tracker, build_recording, stated_corners
from .choice import USUAL, fit_plan
from .compiling import compile_ahead
from .session import (
    HEAVY,
    MEASURING,
    Further,
    Prepared,
    check_unused,
    observed,
    prepare,
    read_ahead,
    run_session,
)


@dataclass(frozen=True)
class ArenaOutcome:
    """Result of one arena, or of one of several animals.

    Attributes:
        name: of the arena or animal.
        session: its session folder; None if it could not be measured.
        error: why it could not be measured; None if it was.
    """

    name: str
    session: Path | None = None
    error: LiexError | None = None


def run_arenas(
    recording: str | Path | Recording,
    plan: Plan | None = None,
    out: str | Path = ".",
    *,
    settings: Sequence[str] = (),
    overwrite: bool = False,
    notes: Mapping[str, Any] | None = None,
    workers: int = 1,
    pool: processes.WorkerPool | None = None,
    report: bool = True,
    animals: Sequence[tuple[Path, sections.SessionFacts]] = (),
    further: Further | None = None,
    progress: Progress = silent,
) -> list[ArenaOutcome]:
    """Measure several arenas in one image, or several animals in one arena, a session each.

    Args:
        recording: path of a recording, address of a virtual one, or an open recording.
        plan: lists `[[arenas]]`, has `arenas = "auto"`, or states `animal.count`; None selects the
            bundled plan that fits each arena, with the arenas in `settings`.
        out: parent of the session folders `<recording's name>-<arena>.liex`.
        settings: overrides when no plan is given.
        overwrite: replace existing sessions.
        notes: additional facts for every session.json.
        workers: processes for parallel shards of a long recording, one arena at a time; 0 or 1
            measures all arenas in one pass.
        pool: a worker pool to use instead.
        report: whether to write each session's report with its figures.
        animals: folder and facts of each of several animals in one arena, the largest first, if
            they are known; () names them animal1 and so on.
        further: measures to add to those of several animals in one arena.
        progress: receives progress reports.

    Returns:
        For each arena its session folder, or the reason why it could not be measured.

    Raises:
        LiexError: the recording or the plan cannot be used, or arenas overlap.
    """
    first = plan or Plan.load(USUAL).with_settings(settings)
    if first.arenas is None:
        return _run_animals(
            recording,
            plan,
            first,
            Path(out),
            settings,
            overwrite,
            notes,
            report,
            animals,
            further,
            progress,
        )
    pool = pool or processes.processes_for(workers or 1)
    outcomes: dict[str, ArenaOutcome] = {}
    with (
        processes.imported_ahead(*HEAVY),
        reporting_compilation(progress) as progress,
        build_recording(recording, first, progress) as opened,
    ):
        if problem := unwritable_times(opened.times_ns):
            raise RecordingError(f"of {opened.name} {problem}")
        compile_ahead(first.animal.skeleton, progress=progress)
        # memory for frames that the arenas share to learn their scenes
        shared = opened.remembering(256 * 2**20)
        arenas = arenas_of(shared, first)
        corners = {one.name: stated_corners(shared, first, one.region) for one in arenas}
        within = masks_apart(corners, opened.width, opened.height)
        names = [f"{first.session.name or opened.name}-{one.name}" for one in arenas]
        folders = [durable.inside(Path(out), name, ".liex") for name in names]
        for folder in folders:
            check_unused(folder, overwrite)
        going: dict[str, Prepared] = {}
        for one, name, folder in zip(arenas, names, folders, strict=True):
            started = time.perf_counter()
            progress(0, None, f"learning the background and the animal's size in {one.name}")
            stated = arena_settings(one, name)
            chosen = [*settings, *stated]
            own = plan.with_settings(stated) if plan else Plan.load(USUAL).with_settings(chosen)
            try:
                view = shared.masked(corners[one.name], lent=True)
                fitted = fit_plan(view, own, settings=(None if plan else chosen), progress=progress)
                prepared = prepare(fitted, folder, started, progress)
                if pool is not None and isinstance(recording, str | Path):
                    prepared.measure_by(pool, recording, progress)
                going[one.name] = prepared
            except LiexError as error:
                outcomes[one.name] = ArenaOutcome(one.name, error=error)
        sessions = _measure(going, shared, within, recording, overwrite, notes, report, progress)
    outcomes |= {name: ArenaOutcome(name, session) for name, session in sessions.items()}
    return [outcomes[one.name] for one in arenas]


def _measure(
    going: Mapping[str, Prepared],
    shared: Recording,
    within: Mapping[str, NDArray[np.bool_]],
    recording: str | Path | Recording,
    overwrite: bool,
    notes: Mapping[str, Any] | None,
    report: bool,
    progress: Progress,
) -> dict[str, Path]:
    """Measure all frames from the end of the shortest session on, then finish the sessions."""
    if not going:
        return {}
    with ExitStack() as stack:
        writers = {
            name: stack.enter_context(prepared.writing(overwrite, report))
            for name, prepared in going.items()
        }
        done = {name: writer.n_frames for name, writer in writers.items()}
        with closing(read_ahead(shared, min(done.values()))) as chunks:
            for frames in chunks:
                for name, prepared in going.items():
                    left = [  # all pixels outside the arena's region unread
                        DepthFrame(
                            frame.index,
                            frame.time_ns,
                            np.where(within[name], frame.depth, np.float32(0)),
                        )
                        for frame in frames
                        if frame.index >= done[name]
                    ]
                    if left:
                        prepared.measure(left, writers[name])
                progress(frames[-1].index + 1, len(shared), MEASURING)
        return {
            name: prepared.finish(writers[name], recording, notes).path
            for name, prepared in going.items()
        }


def _run_animals(
    recording: str | Path | Recording,
    plan: Plan | None,
    first: Plan,
    out: Path,
    settings: Sequence[str],
    overwrite: bool,
    notes: Mapping[str, Any] | None,
    report: bool,
    named: Sequence[tuple[Path, sections.SessionFacts]],
    further: Further | None,
    progress: Progress,
) -> list[ArenaOutcome]:
    """Measure the animals of one arena, see `run_arenas`; `first` is the plan with its settings."""
    started = time.perf_counter()
    with (
        processes.imported_ahead(*HEAVY),
        reporting_compilation(progress) as progress,
        build_recording(recording, first, progress) as opened,
    ):
        if problem := unwritable_times(opened.times_ns):
            raise RecordingError(f"of {opened.name} {problem}")
        compile_ahead(first.animal.skeleton, progress=progress)
        progress(0, None, "learning the background, the floor and the animals' sizes")
        fitted = fit_plan(opened, first, settings=None if plan else settings, progress=progress)
        count = fitted.plan.animal.count
        count = fitted.tracker.scene.n_animals if count == "auto" else count
        going: dict[str, Prepared] = {}
        if count > 1:
            joint = build_joint_tracker(fitted.recording, fitted.plan, fitted.tracker, count)
            rfid, readings = fitted.plan.animal.rfid, None
            if rfid is not None:
                arena, _ = build_arena(fitted.tracker.scene, fitted.plan)
                last_s = 1e-9 * float(opened.times_ns[-1] - opened.times_ns[0])
                readings = read_readings(rfid, last_s, count, arena)
            if not named and fitted.plan.session.subject_id:
                raise PlanError(
                    f"session.subject_id is one animal's, and {count} are measured; name each "
                    "afterwards with `liex describe`, or in a study (docs/tutorials/study.md)"
                )
            name = fitted.plan.session.name or opened.name
            for k in range(1, count + 1 if not named else 0):
                stated = {"name": f"{name}-animal{k}", "individual": f"animal{k}"}
                facts = fitted.plan.session.model_copy(update=stated)
                named = [*named, (durable.inside(out, stated["name"], ".liex"), facts)]
            for folder, _ in named:
                check_unused(folder, overwrite)
            for tracker, (folder, facts) in zip(joint.trackers, named, strict=True):
                plan = fitted.plan.model_copy(update={"session": facts})
                own = replace(fitted, plan=plan, tracker=tracker)
                going[facts.individual] = prepare(own, folder, started, progress)
            sessions = _measure_animals(
                going, joint, readings, recording, overwrite, notes, report, further, progress
            )
            return [ArenaOutcome(name, session) for name, session in sessions.items()]
    alone = ["animal.rfid=", "animal.count=1"]
    session = run_session(
        recording,
        plan and plan.with_settings(alone),
        out,
        settings=[*settings, *alone],
        overwrite=overwrite,
        notes=notes,
        report=report,
        further=further,
        progress=progress,
    )
    return [ArenaOutcome("animal1", session)]


def _measure_animals(
    going: Mapping[str, Prepared],
    joint: JointTracker,
    readings: Readings | None,
    recording: str | Path | Recording,
    overwrite: bool,
    notes: Mapping[str, Any] | None,
    report: bool,
    further: Further | None,
    progress: Progress,
) -> dict[str, Path]:
    """Measure all frames for all animals, decide their identities, and finish the sessions."""
    with ExitStack() as stack:
        writers = [
            stack.enter_context(prepared.writing(overwrite, report)) for prepared in going.values()
        ]
        shared = next(iter(going.values())).recording
        chunks = read_ahead(shared, min(writer.n_frames for writer in writers))
        with closing(chunks), closing(observed(joint, chunks)) as coming:
            for frames, every in coming:
                for writer, own in zip(writers, every, strict=True):
                    left = slice(max(0, writer.n_frames - frames[0].index), None)
                    writer.add(frames[left], observations=own[left])
                progress(frames[-1].index + 1, len(shared), MEASURING)
        whole = [writer.observations(Observations) for writer in writers]
        subjects = [prepared.fitted.tracker.subject for prepared in going.values()]
        identity = identify(whole, subjects, readings)
        stretches = covered_stretches(whole, subjects[0].length_mm)
        if stretches and not joint.camera_view:
            progress(0, None, "explaining frames in which animals cover each other")
            whole = [one.copied(to.allocate) for one, to in zip(whole, writers, strict=True)]
            for rows, near in stretches:
                frames = [shared.frame(int(row)) for row in rows]
                measure_covered(joint, frames, rows, near, whole, identity.slots)
            identity = identify(whole, subjects, readings)
        alone = [own_observations(one, identity.slots[:, k]) for k, one in enumerate(whole)]
        covering = covers(alone, subjects[0].length_mm)
        for k, (prepared, writer) in enumerate(zip(going.values(), writers, strict=True)):
            if readings is not None:
                prepared.mark(writer, identity, k)
            crossings = [one for one in identity.crossings if k in one.animals]
            prepared.follow(writer, alone[k], crossings, covering[k])
        for writer in writers:
            writer.others = [one.track.centroid_mm for one in writers if one is not writer]
        together = None
        if subjects[0].skeleton.is_chain:
            progress(0, None, "finding the interactions")
            tracks = [
                Individual.of_track(name, writer.track)
                for name, writer in zip(going, writers, strict=True)
            ]
            limits = next(iter(going.values())).fitted.plan.interactions
            index = writers[0].rows.frame_index
            together = find_interactions(whole[0].seconds, tracks, limits, index, whole[0].objects)
        return {
            name: prepared.conclude(writer, recording, notes, together, further).path
            for (name, prepared), writer in zip(going.items(), writers, strict=True)
        }


def arena_settings(arena: sections.SeveralArenas, name: str) -> tuple[str, ...]:
    """The settings that turn a plan of several arenas into that of one arena's session, `name`."""
    facts = ("individual", "subject_id", "group", "cage", "sex", "batch", "species", "age")
    stated = {
        "arena.region": arena.region,
        "session.name": name,
        **{f"session.{fact}": getattr(arena, fact) for fact in facts},
        "arena.zones": arena.zones,
        "animal.spine_mm": arena.spine_mm,
    }
    known = ((key, value) for key, value in stated.items() if value is not None)
    return ("arenas=", *(f"{key}={toml_value(value)}" for key, value in known))
