"""Status of a study's sessions: done, failed, or pending (again) and why; read from disk.

No state is kept: a session is done while versions, plan, model and input in its session.json are
current.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import pandas as pd

from liex_lab.behaviour.cohort import unified
from liex_lab.errors import LiexError
from liex_lab.plan import Plan
from liex_lab.plan.study import PlannedSession, Study, find_subject, same
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
        reason: why it is pending or was not measured, or why a session that is done needs review or
            caution.
        failure: of the last attempt, if it failed.
        described: description of the animal in the study that differs from the results; if not
            empty, nothing else changed and nothing needs to be measured again.
        input: hash of the recording if done; empty otherwise.
    """

    session: PlannedSession
    state: State
    reason: str = ""
    failure: dict[str, Any] | None = None
    described: dict[str, str] = field(default_factory=dict)
    input: str = ""

    @property
    def in_words(self) -> str:
        """The state for display; for a session that is done, also whether it needs review."""
        return "recording missing" if self.missing else state_in_words(self.state, self.reason)

    @property
    def missing(self) -> bool:
        """Whether its recording is missing, even if there are results."""
        return self.state not in ("failed", "excluded") and not self.session.recording_exists

    @property
    def to_do(self) -> bool:
        """Whether it is pending: new, begun or changed."""
        return self.state in ("new", "begun", "changed")


def standings(
    study: Study, *, retry: bool = False, only: Sequence[str] = (), again: bool = False
) -> list[SessionStatus]:
    """The status of every session of a study.

    Args:
        study: the study.
        retry: treat failed sessions as pending.
        only: ids of sessions, the others are left out; () means all.
        again: treat done and failed sessions as pending.

    Raises:
        LiexError: an id in `only` is not in the study.
    """
    known = [session.id for session in study.sessions]
    if absent := [id for id in only if id not in known]:
        raise LiexError(
            f"the study {study.name} has no session {absent[0]}; it has "
            f"{', '.join(known[:8]) or 'none'}"
        )
    found = [
        standing(session, waits_for)
        for session, waits_for in shared_sessions(study)
        if not only or session.id in only
    ]
    return [_asked_again(one, retry, again) for one in found]


def _asked_again(one: SessionStatus, retry: bool, again: bool) -> SessionStatus:
    if again and (one.state == "done" or one.described):
        return SessionStatus(one.session, "changed", "asked for with --again")
    if (retry or again) and one.state == "failed":
        return SessionStatus(one.session, "changed", "it failed, and is tried again", one.failure)
    return one


def standing(session: PlannedSession, waits_for: str = "") -> SessionStatus:
    """The status of one session, from the files in its folder.

    Args:
        session: the planned session, with the values it shares with others of its animal.
        waits_for: id of one of these that has not been inspected, so that the values are unknown.
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
        why = "" if ("input" not in failure or waits_for) else what_changed(session, failure)
        reason = f"{why}; before, it failed: {failure['reason']}" if why else str(failure["reason"])
        return SessionStatus(session, "changed" if why else "failed", reason, failure)
    if session.folder.with_name(f"{session.folder.name}.part").is_dir():
        return SessionStatus(session, "begun", "it was interrupted and goes on")
    return SessionStatus(session, "new", "new")


def _measured(session: PlannedSession, file: Path) -> SessionStatus:
    """The status of a session that has results: whether these are up to date."""
    described: dict[str, str] = {}
    try:
        document = json.loads(file.read_text(encoding="utf-8"))
        why = what_changed(session, document)
        described = {} if why else _described_anew(session, document)
    except (OSError, ValueError, LiexError, AttributeError, TypeError, KeyError, RecursionError):
        why = "its session.json cannot be read"
    if described:
        listed = ", ".join(f"{key} = {value or 'unknown'}" for key, value in described.items())
        why = f"described anew: {listed}; nothing is measured again"
    if why:
        return SessionStatus(session, "changed", why, described=described)
    input = str(document.get("input", {}).get("sha256", ""))
    return SessionStatus(session, "done", to_look_at(verdict_in(document)), input=input)


def to_check(found: Sequence[SessionStatus]) -> list[str]:
    """Possible errors in a study's animals: two names of one, or a recording listed twice."""
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
    """Sentences on sessions whose recordings are named after another animal of the study.

    Sessions with a region, as one of several arenas, are skipped.
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
    """Why a session that is done needs review, and cautions about it.

    Returns:
        The session's own wording; '' if there is nothing to report.
    """
    sentences = []
    if verdict["look_at_it"]:
        accepted = ", accepted" if verdict["accepted"] else ""
        sentences.append(f"{LOOK_AT_IT}{accepted}: {'; '.join(map(str, verdict['reasons']))}")
    if verdict["cautions"]:
        sentences.append(f"{CAUTION}: {'; '.join(map(str, verdict['cautions']))}")
    return ". ".join(sentences)


def _described_anew(session: PlannedSession, document: dict[str, Any]) -> dict[str, str]:
    """Descriptions in the plan that differ from those of the results; '' removes one."""
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
