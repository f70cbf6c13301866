"""Status of a study's sessions: done, failed, or to be done (again) and why; looked up on disk.

Nothing is remembered: a session is done while versions, plan, model and input in its session.json
are those of today. Inputs are compared by names, sizes and times, and where these differ by hash.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from liex_lab.errors import LiexError
from liex_lab.plan import Plan
from liex_lab.plan.study import VIRTUAL, PlannedSession, Study
from liex_lab.sessions.corrections import DESCRIBED, START, read_log, with_description
from liex_lab.sessions.failure import read_failure
from liex_lab.sessions.provenance import SCHEMA_VERSION, package_version
from liex_lab.sessions.verdict import LOOK_AT_IT, verdict_in

_SAYS = {
    ".toml",
    ".txt",
    ".csv",
    ".json",
    ".yaml",
    ".yml",
}  # files beside a recording that say what is in it
State = Literal["done", "failed", "new", "begun", "changed", "excluded"]


@dataclass(frozen=True)
class SessionStatus:
    """The status of a session.

    Attributes:
        session: the planned session.
        state: done, failed, new, begun, changed or excluded.
        reason: why it is to be done, was not, or is to be looked at although it is done.
        failure: of the last attempt, if it failed.
        described: what the study says otherwise of the animal than its results; then nothing else
            changed, and nothing is measured anew.
    """

    session: PlannedSession
    state: State
    reason: str = ""
    failure: dict[str, Any] | None = None
    described: dict[str, str] = field(default_factory=dict)

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
    for id in only:
        if id not in known:
            raise LiexError(
                f"the study {study.name} has no session {id}; it has "
                f"{', '.join(known[:8]) or 'none'}"
            )
    found = [standing(session) for session in study.sessions if not only or session.id in only]
    return [_asked_again(one, retry, again) for one in found]


def _asked_again(one: SessionStatus, retry: bool, again: bool) -> SessionStatus:
    if again and (one.state == "done" or one.described):
        return SessionStatus(one.session, "changed", "asked for with --again")
    if (retry or again) and one.state == "failed":
        return SessionStatus(one.session, "changed", "it failed, and is tried again", one.failure)
    return one


def standing(session: PlannedSession) -> SessionStatus:
    """The status of one session, by what lies in its folder.

    Args:
        session: the planned session.
    """
    if session.exclude:
        return SessionStatus(session, "excluded", session.exclude)
    if (session.folder / "session.json").is_file():
        said: dict[str, str] = {}
        try:
            document = json.loads((session.folder / "session.json").read_text(encoding="utf-8"))
            why = next(filter(None, (check() for check in _checks(session, document))), "")
            if not why:
                said = _described_anew(session, document)
        except (
            OSError,
            ValueError,
            LiexError,
            AttributeError,
            TypeError,
            KeyError,
            RecursionError,
        ):
            document = {}
            why = "its session.json cannot be read"
        if said:
            told = ", ".join(f"{key} = {value or 'unknown'}" for key, value in said.items())
            why = f"described anew: {told}; nothing is measured again"
        if why:
            return SessionStatus(session, "changed", why, described=said)
        return SessionStatus(session, "done", to_look_at(verdict_in(document)))
    failure = read_failure(session.folder)
    if failure is not None:
        why = (
            ""
            if "input" not in failure
            else next(filter(None, (check() for check in _checks(session, failure))), "")
        )
        return SessionStatus(
            session, "changed" if why else "failed", why or str(failure["reason"]), failure
        )
    begun = session.folder.with_name(f"{session.folder.name}.part").is_dir()
    return (
        SessionStatus(session, "begun", "it was interrupted and goes on")
        if begun
        else SessionStatus(session, "new", "new")
    )


def to_look_at(verdict: Mapping[str, Any]) -> str:
    """Why someone has to look at a session that is done, '' where nobody has to.

    Args:
        verdict: as `sessions.verdict.read_verdict` gives it.
    """
    if not verdict["look_at_it"]:
        return ""
    accepted = ", accepted" if verdict["accepted"] else ""
    return f"{LOOK_AT_IT}{accepted}: {'; '.join(map(str, verdict['reasons']))}"


def _checks(session: PlannedSession, document: dict[str, Any]) -> Iterable[Callable[[], str]]:
    """Tests that say why a stored session is not the planned one, '' if it is; cheapest first."""
    return (
        lambda: _version_changed(document),
        lambda: plan_changed(session.plan, document.get("plan", {})),
        lambda: _model_changed(session.plan, document.get("model", {})),
        lambda: _input_changed(session, document.get("input", {})),
    )


def _version_changed(document: dict[str, Any]) -> str:
    then = document.get("versions", {}).get("liex_lab", "")
    now = package_version("liex_lab")
    if then != now:
        return f"version changed: {then or 'unknown'}, now {now}"
    schema = document.get("schema_version", SCHEMA_VERSION)
    return (
        f"version changed: session schema {schema}, now {SCHEMA_VERSION}"
        if schema != SCHEMA_VERSION
        else ""
    )


def plan_changed(plan: Plan, stored: dict[str, Any]) -> str:
    """What a plan says otherwise than the one that a session was measured by, '' if nothing.

    Args:
        plan: the plan of today.
        stored: the plan in session.json.
    """
    then = Plan.from_table(stored).model_dump()
    now = plan.model_dump()
    if plan.recording.mirrored is None:  # then it is found, and stored as it was found
        now["recording"]["mirrored"] = then["recording"]["mirrored"]
    differing = [
        f"{section}.{key} = {now[section][key]}"
        if isinstance(now[section], dict)
        else f"{section} = {now[section]}"
        for section in now
        for key in (now[section] if isinstance(now[section], dict) else [""])
        if (now[section][key] != then[section][key] if key else now[section] != then[section])
        and not (section == "session" and key in DESCRIBED)
        and section != "report"  # nothing that is measured
    ]
    more = f" and {len(differing) - 3} more" if len(differing) > 3 else ""
    return f"plan changed: {', '.join(differing[:3])}{more}" if differing else ""


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


def _model_changed(plan: Plan, stored: dict[str, Any]) -> str:
    from liex_lab.catalog import find_model, sha256

    if not stored:
        return ""
    return (
        "" if sha256(find_model(plan.estimation.model)) == stored.get("sha256") else "model changed"
    )


def _input_changed(session: PlannedSession, stored: dict[str, Any]) -> str:
    """By the files' sizes and times; where those differ, by their content."""
    if stored.get("stamp") == input_stamp(session.recording):
        return ""
    if session.recording.startswith(VIRTUAL):
        return "input changed: another virtual recording"
    if not stored.get("sha256"):
        return "input changed: sizes or times of its files"
    from ..build import open_planned

    if not session.recording_exists:
        return ""  # its results are all there is left of it; they are kept
    with open_planned(session.recording, session.plan) as recording:
        return "" if recording.digest() == stored["sha256"] else "input changed: its content"


def input_stamp(recording: str) -> str:
    """A short hash of names, sizes and times of a recording's files and of the notes beside them.

    Cheap to look up. Notes are files such as .toml, .csv and .json.

    Args:
        recording: a path, or the address of a virtual recording, which is returned as it is.

    Returns:
        32 hexadecimal digits; '' where there is no recording.
    """
    if recording.startswith(VIRTUAL):
        return recording
    path = Path(recording)
    if not path.exists():
        return ""
    folder = path if path.is_dir() else path.parent
    entries = []
    for inside, _, names in os.walk(folder):
        for name in names:
            file = Path(inside, name)
            try:
                found = file.stat()
            except OSError:
                continue
            if path.is_dir() or file == path or file.suffix.lower() in _SAYS:
                entries.append([str(file.relative_to(folder)), found.st_size, found.st_mtime_ns])
        if not path.is_dir():
            break
    return hashlib.sha256(json.dumps(sorted(entries)).encode()).hexdigest()[:32]
