"""Corrections of a session by people, `liex correct`: kept in a log beside it, every table follows.

What was measured is never written again. The folder `corrected` holds an append-only log of
flips, moved joints and edited bouts, and the tables that follow from those that stand; it is
replaced as a whole by a rename, and the one before goes only when the new one is on disk.
"""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from liex_lab.errors import SessionError
from liex_lab.plan import Plan
from liex_lab.runtime.durable import put_back, put_in_place
from liex_lab.runtime.places import unlinked, unlinked_tree
from liex_lab.runtime.progress import Progress, silent
from liex_lab.sessions.corrections import (
    FOLDER,
    LOG,
    REPLAY,
    BoutEdit,
    Correction,
    Log,
    basis,
    read_log,
)

from .session import measure_behaviour

if TYPE_CHECKING:
    from liex_lab.behaviour.summary import Behaviour
    from liex_lab.sessions import Session
    from liex_lab.sessions.applying import CorrectedTrack
    from liex_lab.sessions.track_tables import Results
    from liex_lab.sessions.writer import BlueprintMaker, ReportMaker

_BUSY = ".correcting"
_AS_BEFORE = ("kinematics", "zones")  # tables that edits of bouts do not change


def correct_session(
    session: str | Path,
    what: Sequence[Correction] = (),
    *,
    undo: Sequence[int] = (),
    author: str = "",
    blueprint: BlueprintMaker | None = None,
    report: ReportMaker | None = None,
    progress: Progress = silent,
) -> Path:
    """Add corrections to a session and take others back; with neither, make everything again.

    All at once or not at all. Corrections that were made on an earlier measurement of the recording
    apply to this one from then on.

    Args:
        session: the session folder.
        what: corrections to add.
        undo: numbers of corrections to take back, or of the undo to take back (`Log.redoable`).
        author: who corrects.
        blueprint: makes the layout of the corrected replay, see `SessionWriter`.
        report: makes the report again, see `SessionWriter`; None leaves it.
        progress: told the stage.

    Returns:
        The session folder.

    Raises:
        SessionError: a correction cannot be applied, there is none, those of the log were made on
            another measurement, or another program corrects the session.
    """
    from liex_lab.runtime.durable import locked
    from liex_lab.sessions import Session

    raw = Session.open(session, raw=True)
    with locked(raw.path / _BUSY, f"{raw.path} is being corrected by another program"):
        folder = unlinked_tree(raw.path / FOLDER)
        aside = unlinked(raw.path / f"{FOLDER}.old")
        put_back(folder, aside)  # somebody was killed here
        made_of = basis(raw.path, raw.metadata)
        log = read_log(raw.path)
        if log.touched and log.made_of != made_of and (what or undo):
            raise SessionError(
                f"the corrections of {raw.path} were made on another measurement of this "
                "recording; look at them with `liex correct list`, then apply them with `liex "
                f"correct apply`, or remove the folder {FOLDER}"
            )
        log = replace(log.added(what, undo, author), made_of=made_of, files={}, facts={})
        if not log.entries:
            raise SessionError(
                f"{raw.path} has no corrections to apply; `liex correct --help` says how to make "
                "one"
            )
        part = unlinked(raw.path / f"{FOLDER}.part")
        shutil.rmtree(part, ignore_errors=True)
        part.mkdir()
        try:
            if log.touched:
                progress(0, None, "measuring what was corrected")
                log = _apply(raw, log, part, blueprint)
            if log.described:
                log = _describe(raw, log, part)
            (part / LOG).write_text(log.to_json(), encoding="utf-8")
            put_in_place(part, folder, aside)
        finally:
            shutil.rmtree(part, ignore_errors=True)
    if report is not None:
        progress(0, None, "writing the report")
        report(raw.path)
    return raw.path


def _apply(raw: Session, log: Log, folder: Path, blueprint: BlueprintMaker | None) -> Log:
    """Write the tables that differ from the session's own, and a replay to be shown with its own.

    Returns the log that lists them.
    """
    from liex_lab.sessions.applying import corrected_track
    from liex_lab.sessions.evidence import provenance_of, skeleton_of
    from liex_lab.sessions.folder import file_facts
    from liex_lab.sessions.rrd import ReplayWriter
    from liex_lab.sessions.track_tables import Results
    from liex_lab.tables.rows import Rows

    skeleton = skeleton_of(raw)
    origin = provenance_of(raw, skeleton)
    found = corrected_track(raw, log, skeleton)
    index = raw.frames["frame_index"].to_numpy()
    rows = Rows(
        found.track, index, origin.name, origin.individual, origin.gaps, origin.arena, origin.zones
    )
    results = Results(origin, rows, found.flips)
    behaviour, facts = _behaviour(raw, log, found, results)
    written = behaviour.tables
    if found.changed:
        results.write_track(folder)
        facts["frames"] = results.counts()
    else:
        written = {name: table for name, table in written.items() if name not in _AS_BEFORE}
    results.write_measured(folder, written, behaviour.vocabulary.columns)
    facts |= {"corrections": _told(log), "actions": dict(behaviour.actions)}
    replay = folder / REPLAY
    made = blueprint({**raw.metadata, **facts}) if blueprint is not None else None
    ReplayWriter(replay, origin, made, corrected=True).finish(
        rows, behaviour.kinematics, behaviour.bouts, list(behaviour.actions), ()
    )
    return replace(log, files=file_facts(folder), facts=facts)


def _describe(raw: Session, log: Log, folder: Path) -> Log:
    """Write the table `sessions` with what people said of the animal; returns the log with it."""
    import pandas as pd

    from liex_lab.sessions.evidence import provenance_of, skeleton_of
    from liex_lab.sessions.folder import file_facts
    from liex_lab.tables import schema

    path = folder / "sessions.parquet"
    table = pd.read_parquet(path) if path.is_file() else raw.table("sessions")
    said = {key: value for key, value in log.described.items() if key in table}
    metadata = provenance_of(raw, skeleton_of(raw)).table_metadata()
    schema.write_table(path, schema.SESSIONS, schema.from_pandas(table.assign(**said)), metadata)
    kept = {name: facts for name, facts in log.files.items() if name != path.name}
    return replace(log, files={**kept, path.name: file_facts(folder)[path.name]})


def _told(log: Log) -> dict[str, Any]:
    """The standing corrections in short for session.json: numbers by kind, authors, last time."""
    made = [(entry.what, entry.author) for entry in log.touched if entry.what is not None]
    kinds = {kind: sum(what.kind == kind for what, _ in made) for kind in ("flip", "joint", "bout")}
    return {
        "n": len(made),
        **kinds,
        "authors": sorted({author for _, author in made}),
        "last": log.touched[-1].made_at,
    }


def _behaviour(
    raw: Session, log: Log, found: CorrectedTrack, results: Results
) -> tuple[Behaviour, dict[str, Any]]:
    """The behaviour of the corrected track, and facts of it for session.json.

    The ethogram is the session's own; where head and tail were exchanged it is named again; then
    come the edits.
    """
    from liex_lab.behaviour.summary import measure_rows, stated_by
    from liex_lab.sessions.applying import edited_bouts, spliced_bouts
    from liex_lab.tables.rows import frame_count

    rules, around = stated_by(raw)
    count = frame_count(results.rows.frame_index)
    around = replace(around, seams=[int(count[row]) for row in found.seams])
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
    bouts = edited_bouts(bouts, log.corrections(BoutEdit), frames)
    return measure_rows(results.rows, rules, around, bouts=bouts, actions=actions), facts
