"""Manual corrections of a session, `liex correct`: a log, and the tables derived from it.

The original measurements are never overwritten. The folder `corrected` contains an append-only log
of flips, moved joints and edited bouts, and the tables derived from the active ones; a rename
replaces the folder as a whole, and its predecessor is removed only once the new one is on disk.
"""

import json
import shutil
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack
from copy import deepcopy
from dataclasses import asdict, dataclass, fields, replace
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from liex_lab.dashboards.replay.layouts import replay_blueprint
from liex_lab.dashboards.report.report import write_views
from numpy.typing import NDArray

from liex_lab.actions.labels import HUMAN
from liex_lab.behaviour.interactions import TABLES as INTERACTION_TABLES
from liex_lab.behaviour.interactions import Individual, Interactions, find_interactions
from liex_lab.behaviour.summary import Behaviour, measure_rows, stated_by
from liex_lab.body.pose import Pose, fit_poses
from liex_lab.body.skeleton import Skeleton
from liex_lab.errors import SessionError
from liex_lab.geometry import SE3
from liex_lab.optics.camera import Camera
from liex_lab.plan import Plan
from liex_lab.runtime import durable
from liex_lab.runtime.progress import Progress, silent
from liex_lab.sessions import Session, correcting, corrections, evidence, identities, rrd
from liex_lab.sessions.clock import fingerprint
from liex_lab.sessions.folder import file_facts
from liex_lab.sessions.provenance import reading_from
from liex_lab.sessions.verdict import Verdict
from liex_lab.tables import schema
from liex_lab.tables.rows import Rows, frame_count
from liex_lab.tracking import curve, identity, observations, smoother
from liex_lab.tracking.track import CORRECTED, Crossing, Flip, Subject, Track, ends_of

from .session import measure_behaviour

_BEFORE = "The tables of interactions are those of the poses before their correction."
_PART = f"{corrections.FOLDER}.part"

Numbers = NDArray[np.int64]  # of rows


def correct_session(
    session: str | Path,
    what: Sequence[corrections.Correction] = (),
    *,
    undo: Sequence[int] = (),
    author: str = "",
    report: bool = True,
    progress: Progress = silent,
) -> Path:
    """Add corrections to a session, or undo some by number; updates tables and report.

    The measured data are unchanged; see `liex_lab.sessions.corrections`. Without `what` and `undo`,
    everything derived from the corrections is regenerated.

    Args:
        session: the session folder.
        what: corrections made by the functions of `liex_lab.sessions.correcting`.
        undo: numbers of corrections to undo.
        author: author of the corrections; "" uses the current account.
        report: whether to regenerate report and figures; for a series of corrections, the last call
            is enough.
        progress: receives progress reports.

    Returns:
        The session folder.

    Raises:
        SessionError: a correction cannot be applied, or another program is correcting the session.
    """
    raw = Session.open(session, raw=True)
    with ExitStack() as held:
        log = _noted(raw, what, undo, author, held)
        if not log.entries:
            raise SessionError(
                f"{raw.path} has no corrections to apply; `liex correct --help` explains how to "
                "make one"
            )
        before = corrections.read_log(raw.path)
        members = identities.arena_sessions(raw) if log.shared or before.shared else {}
        logs = {raw.metadata["individual"]: log}
        if log.shared != before.shared or not (what or undo):
            logs = {
                name: logs.get(name) or _noted_like(log, other, author, held)
                for name, other in members.items()
            } or logs
        sessions = {name: members.get(name, raw) for name in logs}
        try:
            _write(sessions, logs, members, progress)
        finally:
            for one in sessions.values():
                shutil.rmtree(one.path / _PART, ignore_errors=True)
    for one in sessions.values():
        if report or one.path != raw.path:  # the own one waits for the last correction
            progress(0, None, "writing the report")
            write_views(one.path)
    return raw.path


def _noted(
    raw: Session,
    what: Sequence[corrections.Correction],
    undo: Sequence[int],
    author: str,
    held: ExitStack,
) -> corrections.Log:
    """The log of a session with further entries; the session is locked until `held` closes."""
    held.enter_context(
        durable.locked(
            raw.path / ".correcting", f"{raw.path} is being corrected by another program"
        )
    )
    folder = durable.unlinked_tree(raw.path / corrections.FOLDER)
    aside = durable.unlinked(raw.path / f"{corrections.FOLDER}.old")
    new = durable.unlinked(raw.path / corrections.NEW)
    if corrections.corrected_folder(raw.path) == new:  # a process was killed after the commit
        durable.move_into_place(new, folder, aside)
    durable.discard(new)
    durable.put_back(folder, aside)  # a process may have been killed here
    made_of = corrections.basis(raw.path, raw.metadata)
    log = corrections.read_log(raw.path)
    if log.touched and log.made_of != made_of and (what or undo):
        raise SessionError(
            f"the corrections of {raw.path} were made on another measurement of this "
            "recording; list them with `liex correct list`, then apply them with `liex "
            f"correct apply`, or remove the folder {corrections.FOLDER}"
        )
    return replace(log.added(what, undo, author), made_of=made_of, files={}, facts={})


def _noted_like(
    log: corrections.Log, other: Session, author: str, held: ExitStack
) -> corrections.Log:
    """The log of another animal with the same corrections of identity; it is locked as well."""
    wanted = [entry.what for entry in log.shared]
    theirs = corrections.read_log(other.path).shared
    known = [entry.what for entry in theirs]
    missing = [one for one in wanted if one is not None and one not in known]
    undo = [entry.number for entry in theirs if entry.what not in wanted]
    return _noted(other, missing, undo, author, held)


def _write(
    sessions: Mapping[str, Session],
    logs: Mapping[str, corrections.Log],
    members: Mapping[str, Session],
    progress: Progress,
) -> None:
    """Write the corrected folders of one session, or of all animals of an arena at once.

    Args:
        sessions: those whose folders are written, opened raw, by the animals' names.
        logs: their logs.
        members: all animals of the arena; empty if no identity was ever corrected.
        progress: receives progress reports.
    """
    found: dict[str, CorrectedTrack] = {}
    for name, log in logs.items():
        if members:
            _refuse_moved(sessions[name], log, [*members])
        if log.touched:
            progress(0, None, "measuring what was corrected")
            skeleton = evidence.skeleton_of(sessions[name])
            found[name] = corrected_track(sessions[name], log, skeleton, members)
    shared = len(found) > 1 or any(log.shared for log in logs.values())
    together = _together(members, found, logs) if found and shared else None
    for name, log in logs.items():
        one = sessions[name]
        part = durable.unlinked(one.path / _PART)
        shutil.rmtree(part, ignore_errors=True)
        part.mkdir()
        if log.touched:
            log = _apply(one, log, part, found[name], together, len(logs) > 1)
        if log.described:
            _describe(one, log, part)
        if log.clock:
            log = _synchronise(one, log, part)
        log = replace(log, files=file_facts(part))
        (part / corrections.LOG).write_text(log.to_json(), encoding="utf-8")
        durable.sync_tree(part)
    for one in sessions.values():  # valid when all of them are renamed
        (one.path / _PART).rename(one.path / corrections.NEW)
        durable.sync_folder(one.path)
    for one in sessions.values():
        folder = one.path / corrections.FOLDER
        aside = one.path / f"{corrections.FOLDER}.old"
        durable.move_into_place(one.path / corrections.NEW, folder, aside)


def _refuse_moved(session: Session, log: corrections.Log, names: Sequence[str]) -> None:
    """Refuse to give frames to another animal of which something else was corrected before.

    Raises:
        SessionError: there are such corrections; the message names their numbers.
    """
    before = corrections.read_log(session.path)
    index, times = (session.frames[name].to_numpy() for name in ("frame_index", "time_ns"))
    own = names.index(session.metadata["individual"])
    was, now = (identities.shown(one.shared, names, index)[:, own] for one in (before, log))

    moved = was != now
    last = max((entry.number for entry in log.shared), default=0)
    rows: dict[type, Callable[[Any], NDArray[np.bool_]]] = {
        corrections.FlipSpan: lambda one: (one.start_frame <= index) & (index < one.stop_frame),
        corrections.JointMove: lambda one: index == one.frame,
        corrections.BoutEdit: lambda one: (one.start_ns <= times) & (times < one.stop_ns),
    }
    numbers = [
        str(entry.number)
        for entry in log.standing
        if (entry in before.standing or entry.number < last)
        and (touched := rows.get(type(entry.what)))
        and (moved & touched(entry.what)).any()
    ]
    if numbers:
        raise SessionError(
            f"in frames that another animal gets, {session.path} has corrections of the present "
            f"one ({', '.join(numbers)} in `liex correct list`); undo these, and make them again "
            "where they belong afterwards"
        )


def _together(
    members: Mapping[str, Session],
    found: Mapping[str, "CorrectedTrack"],
    logs: Mapping[str, corrections.Log],
) -> Interactions | None:
    """The interactions of the corrected tracks; None without a table of them.

    An animal without a new track has the measured one, or that of its session if its log stays.
    """
    raw = next(iter(members.values()))
    if not raw.has("interactions.parquet"):
        return None
    return find_interactions(
        raw.frames["time_s"].to_numpy(float),
        [
            Individual.of_track(
                name,
                found[name].track
                if name in found
                else evidence.track_of(one if name in logs else Session.open(one.path)),
            )
            for name, one in members.items()
        ],
        Plan.from_toml(raw.plan, "plan.toml").interactions,
        raw.frames["frame_index"].to_numpy(np.int64),
        evidence.read_evidence(raw)[0].objects if raw.has(evidence.FILE) else None,
    )


def describe_session(
    session: str | Path,
    facts: Mapping[str, str],
    *,
    author: str = "",
    progress: Progress = silent,
) -> Path:
    """Set facts about the animal of a session; updates table `sessions` and the report.

    Nothing is measured again. The facts are part of the log of corrections and can be undone.

    Args:
        session: the session folder.
        facts: any of subject_id, group, cage, sex, batch, species (Latin), age (12 weeks, or P12W)
            and session_start_time (ISO 8601 with a time zone); an empty text means unknown.
        author: author of the change; "" uses the current account.
        progress: receives progress reports.

    Returns:
        The session folder.

    Raises:
        SessionError: there is no such fact, or another program is correcting the session.
        PlanError: a value is invalid.
    """
    return correct_session(
        session, correcting.descriptions(facts), author=author, progress=progress
    )


def _apply(
    raw: Session,
    log: corrections.Log,
    folder: Path,
    found: "CorrectedTrack",
    together: Interactions | None,
    renewed: bool,
) -> corrections.Log:
    """Write the tables that differ from the session's, and a replay to overlay on the session's.

    Interactions are `renewed` only if the sessions of all animals are written. Returns the log that
    lists the files.
    """
    origin = evidence.provenance_of(raw, found.track.skeleton)
    index = raw.frames["frame_index"].to_numpy()
    rows = Rows(
        found.track,
        index,
        origin.name,
        origin.individual,
        origin.gaps,
        origin.arena,
        origin.zones,
        others=[
            one.joints_mm.mean(axis=1)
            for one in (together.animals if together is not None else ())
            if one.name != origin.individual
        ],
    )
    results = evidence.Results(origin, rows, found.flips, found.crossings)
    behaviour, facts = _behaviour(raw, log, found, results)
    written = behaviour.tables
    problems = [*raw.metadata["problems"], *found.remarks]
    if together is not None and renewed:
        written = {**written, **together.for_session(rows, behaviour.tables)["results"]}
    elif together is not None:  # as they were when identities were corrected last
        for name in INTERACTION_TABLES:
            shutil.copy2(Session.open(raw.path).file(f"{name}.parquet"), folder)
    if log.shared or len(found.turned) or len(found.moved):
        results.write_track(folder)
        facts["frames"] = results.counts()
        measured = (corrections.FlipSpan, corrections.JointMove)
        has_before = not renewed and raw.has("interactions.parquet")
        if has_before and any(isinstance(one.what, measured) for one in log.standing):
            problems.append(_BEFORE)
    else:
        # tables that bout edits do not change
        written = {
            name: table for name, table in written.items() if name not in ("kinematics", "zones")
        }
    described = {"interactions": schema.INTERACTIONS}
    described |= {"triggers": schema.TRIGGERS, "moseq": schema.MOSEQ}
    more = [each for name, each in described.items() if raw.has(f"{name}.parquet")]
    results.write_measured(folder, written, (*behaviour.columns, *chain(*more)))
    facts |= {"corrections": _summary(log), "actions": dict(behaviour.actions)}
    if problems != raw.metadata["problems"]:
        facts["problems"] = problems
    if log.shared and "verdict" in raw.metadata:
        facts["verdict"] = _verdict(raw, found)
    layout = replay_blueprint({**raw.metadata, **facts})
    rrd.ReplayWriter(folder / corrections.REPLAY, origin, layout, corrected=True).finish(
        rows,
        behaviour.kinematics,
        behaviour.bouts,
        list(behaviour.actions),
        (),
        together=together,
    )
    return replace(log, facts=facts)


def _verdict(raw: Session, found: "CorrectedTrack") -> dict[str, Any]:
    """The verdict on a session whose identities were corrected, for session.json."""
    stated, track = raw.metadata["verdict"], found.track
    doubts = [identity.doubt(one or ()) for one in (evidence.read_crossings(raw), found.crossings)]
    errors = track.predicted_error_mm[track.observed]
    names = {one.name for one in fields(Verdict)}
    return replace(
        Verdict(**{name: value for name, value in stated.items() if name in names}),
        n_posed=int(track.observed.sum()),
        n_trusted=int((track.observed & (track.flag == "")).sum()),
        expected_error_mm=float(np.median(errors)) if len(errors) else None,
        reasons=(
            *(one for one in stated["reasons"] if one != doubts[0]),
            *filter(None, doubts[1:]),
        ),
    ).to_dict()


def _describe(raw: Session, log: corrections.Log, folder: Path) -> None:
    """Write the table `sessions` with the corrected description."""
    path = folder / "sessions.parquet"
    table = pd.read_parquet(path) if path.is_file() else raw.table("sessions")
    described = {key: value for key, value in log.described.items() if key in table}
    metadata = evidence.provenance_of(raw, evidence.skeleton_of(raw)).table_metadata()
    schema.write_table(
        path, schema.SESSIONS, schema.from_pandas(table.assign(**described)), metadata
    )


def _synchronise(raw: Session, log: corrections.Log, folder: Path) -> corrections.Log:
    """Add the columns of the other clock to frames, bouts and columns.json; returns the log."""
    clock = log.clock
    assert clock is not None
    stamps = raw.table("frames", ["time_ns"])["time_ns"]
    first_ns = int(stamps.iloc[0])
    if fingerprint(stamps) != clock.stamps:
        raise SessionError(
            f"the clock of {clock.name} was aligned with other time stamps of this recording; undo "
            "that (`liex correct undo`) and run `liex sync` again"
        )

    def on_frames(block: schema.Block) -> dict[str, Any]:
        times, sd = clock.times_s(block["time_ns"])
        return {"sync_s": times, "sync_sd_ms": 1e3 * sd}

    def on_bouts(block: schema.Block) -> dict[str, Any]:
        since_ns = (np.rint(1e9 * block[name]).astype(np.int64) for name in ("start_s", "stop_s"))
        starts, stops = (clock.times_s(first_ns + one)[0] for one in since_ns)
        return {"sync_start_s": starts, "sync_stop_s": stops}

    def latest(name: str) -> Path:
        """A file with the corrections made so far."""
        return folder / name if (folder / name).is_file() else raw.path / name

    for name, compute in (("frames.parquet", on_frames), ("bouts.parquet", on_bouts)):
        part = folder / f"{name}.part"
        with reading_from(latest(name)) as path:
            schema.append_columns(path, part, schema.SYNCED[Path(name).stem], compute)
        part.replace(folder / name)
    more = [column for added in schema.SYNCED.values() for column in added]
    if clock.events:
        names, times = zip(*sorted(clock.events, key=lambda one: one[1]), strict=True)
        rows = {
            "session_id": raw.name,
            "individual": raw.metadata["individual"],
            "event": np.array(names, object),
            "time_s": clock.since(first_ns, times),
            "sync_s": np.array(times),
        }
        schema.write_table(folder / "events.parquet", schema.EVENTS, [rows], {})
        more += schema.EVENTS
    with reading_from(latest("columns.json")) as path:
        columns = [*json.loads(path.read_text(encoding="utf-8")), *map(asdict, more)]
    text = json.dumps(columns, indent=1, ensure_ascii=False)
    (folder / "columns.json").write_text(text + "\n", encoding="utf-8")
    return replace(log, facts={**log.facts, "sync": clock.facts()})


def _summary(log: corrections.Log) -> dict[str, Any]:
    """Summary of the active corrections for session.json: numbers by kind, authors, last time."""
    made = [(entry.what, entry.author) for entry in log.touched if entry.what is not None]

    return {
        "n": len(made),
        **{kind: sum(what.kind == kind for what, _ in made) for kind in ("flip", "joint", "bout")},
        **({"swap": len(log.shared)} if log.shared else {}),
        "authors": sorted({author for _, author in made}),
        "last": log.touched[-1].made_at,
    }


def _behaviour(
    raw: Session, log: corrections.Log, found: "CorrectedTrack", results: evidence.Results
) -> tuple[Behaviour, dict[str, Any]]:
    """The behaviour of the corrected track, and facts about it for session.json.

    The ethogram is the session's own, recognised again where head and tail were exchanged, then
    edited.
    """
    rules, around = stated_by(raw)
    count = frame_count(results.rows.frame_index)
    # where a manual exchange of head and tail begins or ends
    seams = ends_of((flip.start, flip.stop) for flip in found.flips if flip.source == HUMAN)
    around = replace(around, seams=[int(count[row]) for row in seams])
    frames = results.rows.frames_table
    bouts = raw.bouts
    actions = dict(raw.metadata.get("actions") or {})
    facts: dict[str, Any] = {}
    if len(found.turned):
        again, facts = measure_behaviour(
            results.rows,
            Plan.from_toml(raw.plan, "plan.toml"),
            results.origin,
            seams=around.seams,
        )
        bouts = spliced_bouts(bouts, again.bouts, found.turned, frames)
        actions = {**again.actions, **actions}
    bouts = edited_bouts(bouts, log.corrections(corrections.BoutEdit), frames)
    return measure_rows(results.rows, rules, around, bouts=bouts, actions=actions), facts


@dataclass(frozen=True)
class CorrectedTrack:
    """A track with its flips and joints corrected.

    Attributes:
        track: the corrected track.
        turned: (k,) rows whose pose may have changed by exchanging head and tail, or animals.
        moved: (m,) rows with manually placed joints.
        flips: the rows of the table `flips`, frames counted by row.
        crossings: those with other animals; None if it was measured alone.
        remarks: further sentences for the session's problems.
    """

    track: Track
    turned: Numbers
    moved: Numbers
    flips: tuple[Flip, ...]
    crossings: tuple[Crossing, ...] | None = None
    remarks: tuple[str, ...] = ()


def corrected_track(
    session: Session,
    log: corrections.Log,
    skeleton: Skeleton,
    members: Mapping[str, Session] | None = None,
) -> CorrectedTrack:
    """Track of a session with the active corrections of its log.

    Args:
        session: the session, opened raw.
        log: its corrections; bout edits are ignored here.
        skeleton: the skeleton that the session was made with.
        members: the sessions of all animals of its arena, if identities were corrected.

    Raises:
        SessionError: the session has no observations to rebuild the track from, or a joint was
            moved in a frame that has no pose.
    """
    track = evidence.track_of(session, skeleton)
    index = session.frames["frame_index"].to_numpy(np.int64)
    flips = tuple(evidence.read_flips(session))
    turned = np.zeros(0, np.int64)
    crossings = evidence.read_crossings(session)
    spans: list[corrections.FlipSpan] = log.corrections(corrections.FlipSpan)
    remarks: list[str] = []
    if log.shared:
        was = track
        observed, subject, tracked, remarks = identities.exchanged(
            session, members or {}, log.shared
        )
        track, flips, crossings = tracked.track, tracked.flips, tracked.crossings
        same = (was.joints_mm == track.joints_mm) | np.isnan(was.joints_mm + track.joints_mm)
        turned = np.flatnonzero(~same.all(axis=(1, 2)) | (was.flag != track.flag))
    elif spans:
        observed, subject = evidence.read_evidence(session)
    if spans:
        track, flips, rows = _turned_round(session, track, index, spans, observed, subject)
        turned = np.union1d(turned, rows)
    moves = _moves_of(log, skeleton)
    unmoved = deepcopy(track.pose)
    moved = place_joints(track, index, moves, session.camera, session.T_arena_camera)
    if len(moved):
        followed = smoother.let_follow(track, unmoved, moved)
        track.uv_px[followed] = session.camera.project(
            session.T_arena_camera.inverse() @ track.joints_mm[followed]
        )
    return CorrectedTrack(track, turned, moved, flips, crossings, tuple(remarks))


def _moves_of(log: corrections.Log, skeleton: Skeleton) -> list[corrections.JointMove]:
    """The active moves; a later exchange of head and tail in their frame mirrors the joint."""
    names = list(skeleton.names)
    moves: list[corrections.JointMove] = []
    for one in (entry.what for entry in log.standing):
        if isinstance(one, corrections.JointMove):
            moves.append(one)
        elif isinstance(one, corrections.FlipSpan):
            moves = [
                replace(move, joint=names[-1 - names.index(move.joint)])
                if one.start_frame <= move.frame < one.stop_frame
                else move
                for move in moves
            ]
    return moves


def _turned_round(
    session: Session,
    track: Track,
    index: Numbers,
    spans: Sequence[corrections.FlipSpan],
    observed: observations.Observations,
    subject: Subject,
) -> tuple[Track, tuple[Flip, ...], Numbers]:
    """Rebuild the track from the observations with head and tail exchanged in the spans.

    Rows outside the spans keep their values, except within `MARGIN` of an end at which the exchange
    agrees with its neighbour: there the smoothed curve was bent by the half turn that is gone. No
    row loses its pose or its trust.
    """
    rows_of_spans = (np.searchsorted(index, (one.start_frame, one.stop_frame)) for one in spans)
    wanted = [Flip(int(start), int(stop), 1.0, True, HUMAN) for start, stop in rows_of_spans]
    # from versions that wrote into the table
    earlier = [flip for flip in evidence.read_flips(session) if flip.source == HUMAN]
    again = curve.track_whole(subject, observed, [*earlier, *wanted])
    ends = ends_of((flip.start, flip.stop) for flip in wanted)
    exchanged = np.cumsum(np.bincount(ends, minlength=len(index) + 1))[:-1] % 2 == 1
    near = exchanged.copy()
    parts = [0, *again.cuts, len(index)]
    for end in set(ends) - set(parts):
        k = int(np.searchsorted(parts, end))
        near[max(parts[k - 1], end - curve.MARGIN) : min(parts[k], end + curve.MARGIN)] = True
    was, now = (
        one.joints_mm[:, one.skeleton.tip] - one.joints_mm[:, 0] for one in (track, again.track)
    )
    lost = near & (
        (track.posed & ~again.track.posed)
        | (track.observed & ~again.track.observed)
        | (exchanged & (np.einsum("nd,nd->n", was, now) > 0.0))  # ignored: bridged as before
    )
    trusted = near & (track.flag == "")
    for column in fields(track)[2:]:  # all but skeleton and times
        getattr(track, column.name)[near & ~lost] = getattr(again.track, column.name)[near & ~lost]
    track.flag[trusted] = ""
    rows = np.flatnonzero(lost & exchanged)
    turned = observations.reversed_pose(track.skeleton, track.pose[rows])
    _put(track, rows, turned, session.camera, session.T_arena_camera)
    return track, again.flips, np.flatnonzero(near)


def _put(track: Track, rows: Numbers, pose: Pose, camera: Camera, T_arena_camera: SE3) -> None:
    """Write poses into some rows of a track, in place."""
    track.put_pose(rows, pose)
    track.uv_px[rows] = camera.project(T_arena_camera.inverse() @ track.joints_mm[rows])


def place_joints(
    track: Track,
    index: Numbers,
    moves: Sequence[corrections.JointMove],
    camera: Camera,
    T_arena_camera: SE3,
) -> Numbers:
    """Move joints to manually chosen positions, in place, and let the others follow.

    Least-squares fit of the kinematic tree (inverse kinematics by Levenberg-Marquardt): bones keep
    their lengths and joints their limits. The residual of a manually placed joint counts 20 times
    that of the others, which stay as near as possible to their former positions. The rows get the
    flag `corrected`.

    Args:
        track: the track, n rows, changed in place.
        index: (n,) the camera's frame count of each row, ascending.
        moves: the placed joints, arena frame, mm.
        camera: the depth camera, for the pixels of the joints.
        T_arena_camera: maps the camera frame to the arena frame.

    Returns:
        (k,) rows that were changed.

    Raises:
        SessionError: a joint was moved in a frame that has no pose.
    """
    if not moves:
        return np.zeros(0, np.int64)
    skeleton = track.skeleton
    names = list(track.skeleton.names)
    rows = np.unique(np.searchsorted(index, [move.frame for move in moves]))
    weight = np.ones((len(rows), skeleton.n_joints))
    points = track.joints_mm[rows].copy()
    for move in moves:
        k = int(np.searchsorted(rows, np.searchsorted(index, move.frame)))
        j = names.index(move.joint)
        points[k, j] = (move.x_mm, move.y_mm, move.z_mm)
        # weight of a manually placed joint relative to one that may follow
        weight[k, j] = 20.0
    if not np.isfinite(points).all():
        raise SessionError(
            "a joint was moved in a frame that has no pose; take that correction back"
        )
    limits = skeleton.limits
    start = Pose(
        SE3(track.root_rotation[rows], track.root_mm[rows]),
        np.clip(track.angles_rad[rows], limits[..., 0], limits[..., 1]),
        track.scale[rows],
    )
    for k in range(len(rows)):
        pull = np.diag(weight[k])
        fit = fit_poses(skeleton, (pull @ points[k])[None], pull, start[k : k + 1], keep_scale=True)
        _put(track, rows[k : k + 1], fit.pose, camera, T_arena_camera)
    track.bridged[rows] = False
    track.flag[rows] = CORRECTED
    return rows


def edited_bouts(
    bouts: pd.DataFrame, edits: Iterable[corrections.BoutEdit], frames: pd.DataFrame
) -> pd.DataFrame:
    """Ethogram with manual edits applied in order.

    Each edit clears the bout that it edits, then its own span: a bout that overlaps the span keeps
    the part outside. Edited bouts have the score 1 and no model.

    Args:
        bouts: the table `bouts` of the session.
        edits: the edits, in the order in which they were made.
        frames: the table `frames`, for the times of the rows.

    Returns:
        A table with the columns of `tables.BOUTS`.
    """
    rows = _spans(bouts, frames)
    for edit in edits:
        rows = _cleared(
            _cleared(rows, edit.was_start_ns, edit.was_stop_ns), edit.start_ns, edit.stop_ns
        )
        if edit.action:
            edited = {"action": edit.action, "score": 1.0, "source": edit.source, "model_hash": ""}
            rows.append({**edited, "start_ns": edit.start_ns, "stop_ns": edit.stop_ns})
    return _table(rows, frames)


def spliced_bouts(
    bouts: pd.DataFrame, other: pd.DataFrame, rows: Numbers, frames: pd.DataFrame
) -> pd.DataFrame:
    """Ethogram with some rows of the recording taken from another ethogram.

    The same action on both sides of a seam is one bout.

    Args:
        bouts: the table `bouts` for all other rows.
        other: the table `bouts` for `rows`.
        rows: (k,) rows of the recording, ascending, at least one.
        frames: the table `frames`, for the times of the rows.

    Returns:
        A table with the columns of `tables.BOUTS`.
    """
    times = frames["time_ns"].to_numpy(np.int64)
    inside = _spans(other, frames)
    mixed = _spans(bouts, frames)
    end = max([int(times[-1]) + 1, *(row["stop_ns"] for row in [*inside, *mixed])])
    for part in np.split(rows, np.flatnonzero(np.diff(rows) > 1) + 1):
        start = int(times[part[0]])
        stop = int(times[part[-1] + 1]) if part[-1] + 1 < len(times) else end
        mixed = _cleared(mixed, start, stop) + _cleared(_cleared(inside, 0, start), stop, end)
    joined: list[dict[str, Any]] = []
    for row in sorted(mixed, key=lambda row: row["start_ns"]):
        last = joined[-1] if joined else None
        if last and last["stop_ns"] == row["start_ns"] and last["action"] == row["action"]:
            joined[-1] = {**last, "stop_ns": row["stop_ns"]}
        else:
            joined.append(row)
    return _table(joined, frames)


def _spans(bouts: pd.DataFrame, frames: pd.DataFrame) -> list[dict[str, Any]]:
    """Bouts as dicts with start and stop on the recording's clock, ns.

    A time within 1 ns of a frame's is set to the frame's.
    """
    times = frames["time_ns"].to_numpy(np.int64)
    rows: list[dict[str, Any]] = []
    for row in bouts[["action", "start_s", "stop_s", "score", "source", "model_hash"]].to_dict(
        "records"
    ):
        ends = [int(times[0]) + round(1e9 * row[name]) for name in ("start_s", "stop_s")]
        nearest = [int(times[min(np.searchsorted(times, end - 1), len(times) - 1)]) for end in ends]
        start, stop = (b if abs(a - b) <= 1 else a for a, b in zip(ends, nearest, strict=True))
        rows.append({**{str(k): v for k, v in row.items()}, "start_ns": start, "stop_ns": stop})
    return rows


def _cleared(rows: list[dict[str, Any]], start_ns: int, stop_ns: int) -> list[dict[str, Any]]:
    """Bouts with a span removed; a bout around the span becomes two."""
    if stop_ns <= start_ns:
        return rows
    kept: list[dict[str, Any]] = []
    for row in rows:
        if row["stop_ns"] <= start_ns or row["start_ns"] >= stop_ns:
            kept.append(row)
            continue
        kept += [{**row, "stop_ns": start_ns}] if row["start_ns"] < start_ns else []
        kept += [{**row, "start_ns": stop_ns}] if row["stop_ns"] > stop_ns else []
    return kept


def _table(rows: Sequence[dict[str, Any]], frames: pd.DataFrame) -> pd.DataFrame:
    """Bouts in order of time as the table `bouts`; pieces without a frame are dropped."""
    times = frames["time_ns"].to_numpy(np.int64)
    count = frame_count(frames["frame_index"].to_numpy(np.int64))
    first = int(times[0])
    made = []
    for row in sorted(rows, key=lambda row: row["start_ns"]):
        a, b = np.searchsorted(times, [row["start_ns"], row["stop_ns"]])
        if a == b:
            continue
        start_s, stop_s = ((row[name] - first) * 1e-9 for name in ("start_ns", "stop_ns"))
        made.append(
            {
                "session_id": frames["session_id"].iloc[0],
                "individual": frames["individual"].iloc[0],
                **{name: row[name] for name in ("action", "score", "source", "model_hash")},
                "start_s": start_s,
                "stop_s": stop_s,
                "duration_s": stop_s - start_s,
                "start_frame": int(count[a]),
                "stop_frame": int(count[b]),
            }
        )
    return schema.to_pandas(
        schema.BOUTS, {one.name: [row[one.name] for row in made] for one in schema.BOUTS}
    )
