"""Status of a study's sessions: done, failed, or to be done (again) and why; looked up on disk.

Nothing is remembered: a session is done while versions, plan, model and input in its session.json
are those of today.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from liex_lab.errors import LiexError
from liex_lab.plan import Plan
from liex_lab.plan.study import PlannedSession, Study
from liex_lab.plan.subject import find_subject, same
from liex_lab.sessions.corrections import DESCRIBED, START, read_log, with_description
from liex_lab.sessions.folder import read_failure
from liex_lab.sessions.verdict import CAUTION, LOOK_AT_IT, state_in_words, verdict_in

from .sharing import shared_sessions, what_changed

State = Literal["done", "failed", "new", "begun", "changed", "excluded"]


@dataclass(frozen=True)
class SessionStatus:
    """The status of a session.

    Attributes:
        session: the planned session.
        state: done, failed, new, begun, changed or excluded.
        reason: why it is to be done, was not, or what there is to look at or to distrust although
            it is done.
        failure: of the last attempt, if it failed.
        described: what the study says otherwise of the animal than its results; then nothing else
            changed, and nothing is measured anew.
        input: hash of the recording of one that is done; empty for others.
    """

    session: PlannedSession
    state: State
    reason: str = ""
    failure: dict[str, Any] | None = None
    described: dict[str, str] = field(default_factory=dict)
    input: str = ""

    @property
    def in_words(self) -> str:
        """The state as a person is told it: of one that is done, whether all is well with it."""
        return "recording missing" if self.missing else state_in_words(self.state, self.reason)

    @property
    def missing(self) -> bool:
        """Whether its recording is not there, although its results may be."""
        return self.state not in ("failed", "excluded") and not self.session.recording_exists

    @property
    def to_do(self) -> bool:
        """Whether a run of the study has to do with it: it is new, begun or changed."""
        return self.state in ("new", "begun", "changed")


def standings(
    study: Study, *, retry: bool = False, only: Sequence[str] = (), again: bool = False
) -> list[SessionStatus]:
    """The status of every session of a study.

    Args:
        study: the study.
        retry: failed sessions are to be done.
        only: ids of sessions, the others are left out; () takes all.
        again: done and failed sessions are to be done.

    Raises:
        LiexError: an id in `only` is none of the study's.
    """
    known = [session.id for session in study.sessions]
    if absent := [id for id in only if id not in known]:
        raise LiexError(
            f"the study {study.name} has no session {absent[0]}; it has "
            f"{', '.join(known[:8]) or 'none'}"
        )
    found = [
        standing(one.session, one.waits_for)
        for one in shared_sessions(study)
        if not only or one.session.id in only
    ]
    return [_asked_again(one, retry, again) for one in found]


def _asked_again(one: SessionStatus, retry: bool, again: bool) -> SessionStatus:
    if again and (one.state == "done" or one.described):
        return SessionStatus(one.session, "changed", "asked for with --again")
    if (retry or again) and one.state == "failed":
        return SessionStatus(one.session, "changed", "it failed, and is tried again", one.failure)
    return one


def standing(session: PlannedSession, waits_for: str = "") -> SessionStatus:
    """The status of one session, by what lies in its folder.

    Args:
        session: the planned session, with what it shares with others of its animal.
        waits_for: id of one of these that nobody has looked at, so that this is not known yet.
    """
    if session.exclude:
        return SessionStatus(session, "excluded", session.exclude)
    file = session.folder / "session.json"
    if waits_for and file.is_file():
        why = f"it shares size and shape with {waits_for}, which is to be looked at first"
        return SessionStatus(session, "changed", why)
    if file.is_file():
        return _measured(session, file)
    failure = read_failure(session.folder)
    if failure is not None:
        unsure = "input" not in failure or waits_for
        why = "" if unsure else what_changed(session, failure)
        reason = f"{why}; before, it failed: {failure['reason']}" if why else str(failure["reason"])
        return SessionStatus(session, "changed" if why else "failed", reason, failure)
    if session.folder.with_name(f"{session.folder.name}.part").is_dir():
        return SessionStatus(session, "begun", "it was interrupted and goes on")
    return SessionStatus(session, "new", "new")


def _measured(session: PlannedSession, file: Path) -> SessionStatus:
    """The status of a session that has results: whether they are those of today's study."""
    said: dict[str, str] = {}
    try:
        document = json.loads(file.read_text(encoding="utf-8"))
        why = what_changed(session, document)
        said = {} if why else _described_anew(session, document)
    except (OSError, ValueError, LiexError, AttributeError, TypeError, KeyError, RecursionError):
        why = "its session.json cannot be read"
    if said:
        told = ", ".join(f"{key} = {value or 'unknown'}" for key, value in said.items())
        why = f"described anew: {told}; nothing is measured again"
    if why:
        return SessionStatus(session, "changed", why, described=said)
    input = str(document.get("input", {}).get("sha256", ""))
    return SessionStatus(session, "done", to_look_at(verdict_in(document)), input=input)


def to_check(found: Sequence[SessionStatus]) -> list[str]:
    """What may be wrong with the animals of a study: two names of one, or a recording listed twice.

    Args:
        found: the status of its sessions.
    """
    import pandas as pd

    from liex_lab.behaviour.cohort import unified

    sessions = [one.session for one in found if one.state != "excluded"]
    animals = {one.animal.id: one.animal.model_dump(exclude={"set"}) for one in sessions}
    table = pd.DataFrame(animals.values()).rename(columns={"id": "subject_id"})
    notes = [*misnamed(sessions), *unified(table)[1]]
    known: dict[str, str] = {}
    for one in (one for one in found if one.input):
        first = known.setdefault(f"{one.input} {one.session.plan.arena.region}", one.session.id)
        if first != one.session.id:
            notes.append(f"{one.session.id} is of the same recording as {first}")
    return notes


def misnamed(sessions: Sequence[PlannedSession]) -> list[str]:
    """Sessions whose recordings are named after another animal of the study, in sentences.

    Args:
        sessions: those of the study; ones in one of several arenas are not judged.
    """
    known = {same(one.animal.id): one.animal.id for one in sessions}
    notes = []
    for one in (one for one in sessions if one.plan.arena.region is None):
        found = find_subject(Path(one.recording))
        other = known.get(same(found.id)) if found.origin else None
        if other not in (None, one.animal.id):
            notes.append(
                f"{one.id}: the study names the animal {one.animal.id}, and the recording's "
                f"{found.origin} {other}"
            )
    return notes


def to_look_at(verdict: Mapping[str, Any]) -> str:
    """Why someone has to look at a session that is done, and what to distrust in it.

    Args:
        verdict: as `sessions.verdict.read_verdict` gives it.

    Returns:
        As the session itself says it; '' where there is nothing to say.
    """
    said = []
    if verdict["look_at_it"]:
        accepted = ", accepted" if verdict["accepted"] else ""
        said.append(f"{LOOK_AT_IT}{accepted}: {'; '.join(map(str, verdict['reasons']))}")
    if verdict["cautions"]:
        said.append(f"{CAUTION}: {'; '.join(map(str, verdict['cautions']))}")
    return ". ".join(said)


def _described_anew(session: PlannedSession, document: dict[str, Any]) -> dict[str, str]:
    """What the plan says otherwise of animal and session than the results; '' takes it back."""
    stated = session.plan.session.model_dump()
    then = Plan.from_table(document.get("plan", {})).session.model_dump()
    described = read_log(session.folder).described
    now = with_description(document, described)
    known = {**then, **now.get("subject", {}), **described}
    known[START] = now.get(START) or known[START]
    wanted = {
        key: str(stated[key] or "")
        for key in DESCRIBED
        if stated[key] is not None or then[key] is not None
    }
    return {key: value for key, value in wanted.items() if value != str(known.get(key) or "")}
