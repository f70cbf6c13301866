"""Status of a study's sessions: done, failed, or pending (again) and why; read from disk.

No state is kept: a session is done while versions, plan, model and input in its session.json are
current. If sessions share the size and shape of their animal, each is inspected first (look.json).
"""

import hashlib
import json
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import pandas as pd

from liex_lab.behaviour.cohort import unified
from liex_lab.body.skeleton import Skeleton
from liex_lab.catalog import find_model, sha256
from liex_lab.errors import LiexError, RecordingError
from liex_lab.plan import Plan, sections
from liex_lab.plan.study import VIRTUAL, PlannedSession, Study, find_subject, same
from liex_lab.runtime import durable, processes
from liex_lab.runtime.progress import Progress, silent
from liex_lab.sessions.corrections import (
    DESCRIBED,
    START,
    read_log,
    read_verdict,
    with_description,
)
from liex_lab.sessions.folder import describe_failure, read_failure
from liex_lab.sessions.provenance import SCHEMA_VERSION, package_version, versions
from liex_lab.sessions.verdict import CAUTION, NEEDS_REVIEW, state_in_words

from ..build import animal_facts, build_estimator, build_recording, open_planned
from ..choice import fit_plan
from ..session import MEASURING
from .shared_body import MOST_APART, Inspection, agree, spread_of

INSPECTING = "inspecting the animal"


def what_changed(session: PlannedSession, document: dict[str, Any]) -> str:
    """Why a stored session.json, failed.json or look.json differs from the plan; '' if it does not.

    Raises:
        PlanError: the stored plan is not valid.
    """
    then = document.get("versions", {}).get("liex_lab", "")
    if then != (now := package_version("liex_lab")):
        return f"version changed: {then or 'unknown'}, now {now}"
    if (schema := document.get("schema_version", SCHEMA_VERSION)) != SCHEMA_VERSION:
        return f"version changed: session schema {schema}, now {SCHEMA_VERSION}"
    if why := plan_changed(session.plan, document.get("plan", {})):
        return why
    model = document.get("model", {})
    if model and model.get("sha256") != sha256(find_model(session.plan.estimation.model)):
        return "model changed"
    return _input_changed(session, document.get("input", {}))


def plan_changed(plan: Plan, stored: dict[str, Any]) -> str:
    """How a plan differs from the stored one of a session.json; '' if it does not."""
    then = Plan.from_table(stored).model_dump()
    now = plan.model_dump()
    if plan.recording.mirrored is None:  # then it is estimated, and the result is stored
        now["recording"]["mirrored"] = then["recording"]["mirrored"]
    if now["animal"]["shared"] != then["animal"]["shared"]:
        shared = plan.animal.shared
        length = "" if shared is None or shared.spine_mm is None else f", {shared.spine_mm:g} mm"
        now["animal"]["shared"] = "nothing" if shared is None else f"by {shared.by}{length}"
    skipped = {"report", *(f"session.{key}" for key in DESCRIBED)}  # do not affect measurements
    values, before = (
        {
            f"{section}.{key}" if key else section: value
            for section, part in plan.items()
            for key, value in (part.items() if isinstance(part, dict) else [("", part)])
            if section not in skipped
        }
        for plan in (now, then)
    )
    differing = [
        f"{name} = {value}"
        for name, value in values.items()
        if value != before.get(name) and name not in skipped
    ]
    more = f" and {len(differing) - 3} more" if len(differing) > 3 else ""
    return f"plan changed: {', '.join(differing[:3])}{more}" if differing else ""


def _input_changed(session: PlannedSession, stored: dict[str, Any]) -> str:
    """Compare the input by its files' sizes and times; if these differ, by content."""
    if stored.get("stamp") == input_stamp(session.recording):
        return ""
    if session.recording.startswith(VIRTUAL):
        return "input changed: another virtual recording"
    if not stored.get("sha256"):
        return "input changed: sizes or times of its files"
    if not session.recording_exists:
        return ""  # keep the results, as the recording is gone
    with open_planned(session.recording, session.plan) as recording:
        return "" if recording.digest() == stored["sha256"] else "input changed: its content"


def input_stamp(recording: str) -> str:
    """A short hash of names, sizes and times of a recording's files and metadata files.

    It is cheap, as no content is read. Metadata are files next to it such as .toml, .csv and .json.

    Args:
        recording: a path, or the address of a virtual recording, which is returned unchanged.

    Returns:
        32 hexadecimal digits; '' if there is no recording.
    """
    if recording.startswith(VIRTUAL):
        return recording
    if not durable.is_there(recording):
        return ""
    notes = {".toml", ".txt", ".csv", ".json", ".yaml", ".yml"}  # metadata next to a recording
    entries = []
    for path in durable.named_files(recording):
        whole = path.is_dir()
        folder = path if whole else path.parent
        for file in folder.rglob("*") if whole else folder.iterdir():
            if (whole or file == path or file.suffix.lower() in notes) and not file.is_dir():
                with suppress(OSError):  # it has just been removed
                    found = file.stat()
                    name = str(file.relative_to(folder))
                    entries.append([name, found.st_size, found.st_mtime_ns])
    return hashlib.sha256(json.dumps(sorted(entries)).encode()).hexdigest()[:32]


def shared_sessions(study: Study) -> list[tuple[PlannedSession, str]]:
    """The sessions of a study, in order, with size and shape shared by the stored findings.

    Returns:
        Each session, whose plan has the shared values or whose remark states why there are none;
        and the id of a session of its animal that has to be inspected first; '' if all were.
    """
    known = {session.id: (session, "") for session in study.sessions}
    for group in _groups(study):
        inspections: dict[str, Any] = {session.id: read_inspection(session) for session in group}
        missing = next((id for id, inspection in inspections.items() if inspection is None), "")
        members = group if missing else together(group, inspections)
        known |= {session.id: (session, missing) for session in members}
    return list(known.values())


def pending_inspections(
    study: Study, only: Sequence[str] = (), retry: bool = False, again: bool = False
) -> list[PlannedSession]:
    """Sessions to inspect before others of their animal are measured.

    Args:
        study: the study.
        only: ids of the sessions to measure; () means all.
        retry: inspect failed ones again.
        again: inspect all again.
    """

    def is_pending(session: PlannedSession) -> bool:
        inspection = None if again else read_inspection(session)
        return inspection is None or (retry and "failure" in inspection)

    groups = [g for g in _groups(study) if not only or any(one.id in only for one in g)]
    return [session for group in groups for session in group if is_pending(session)]


def _groups(study: Study) -> list[list[PlannedSession]]:
    """The sessions of each animal that may share: two or more with one skeleton and model."""
    if study.table.shared == "off":
        return []
    groups: dict[tuple[str, str, str], list[PlannedSession]] = {}
    for session in study.sessions:
        plan = session.plan
        if not session.exclude and not session.arena and plan.animal.shared is None:
            key = session.animal.id, plan.animal.skeleton, plan.estimation.model
            groups.setdefault(key, []).append(session)
    return [group for group in groups.values() if len(group) > 1]


def together(
    group: Sequence[PlannedSession], inspections: Mapping[str, dict[str, Any]]
) -> list[PlannedSession]:
    """The sessions of one animal with the shared values in their plans, or why there are none."""
    subject = group[0].animal.id
    taking_part = {
        s.id: Inspection.model_validate(inspections[s.id])
        for s in group
        if not _why_not(inspections[s.id])
    }
    alone = f"The sessions of {subject} do not share size and shape"
    if len(taking_part) < 2:
        shown_by = "one of them alone" if taking_part else "none of them"
        return [replace(s, remark=f"{alone}: {shown_by} shows the animal.") for s in group]
    found = list(taking_part.values())
    if (spread := spread_of(found)) > MOST_APART:
        lengths = sorted(one.animal.spine_mm for one in found)
        why = (
            f"{alone}: their lengths, {lengths[0]:.1f} to {lengths[-1]:.1f} mm, lie {spread:.1%} "
            f"apart, more than {MOST_APART:.0%}; each keeps its own."
        )
        return [replace(s, remark=why) for s in group]
    body = agree(subject, found)
    animals = {s.id: s.plan.animal.model_copy(update={"shared": body}) for s in group}
    return [
        replace(s, plan=s.plan.model_copy(update={"animal": animals[s.id]}))
        if s.id in taking_part
        else replace(
            s,
            remark=f"{s.id} does not share size and shape with the other sessions of {subject}: "
            f"{_why_not(inspections[s.id])}.",
        )
        for s in group
    ]


def _why_not(inspection: Mapping[str, Any]) -> str:
    """Why a session is not used for its animal's shared values; '' if it is."""
    if "failure" in inspection:
        return str(inspection["failure"].get("reason", ""))
    return ", and ".join(map(str, inspection["misfits"]))


class MeasuringStage:
    """Forwards progress, and stores stage and frame for the report of a failure.

    Attributes:
        name: the stage.
        frame: number of measured frames; None before the first one.
    """

    def __init__(self, progress: Progress) -> None:
        self.name = "opening the recording"
        self.frame: int | None = None
        self._progress = progress

    def __call__(self, done: int, total: int | None, what: str) -> None:
        """Store the stage, and forward the progress."""
        self.name = what
        self.frame = done if what == MEASURING else self.frame
        self._progress(done, total, what)


def inspect_animal(session: PlannedSession, progress: Progress = silent) -> dict[str, Any]:
    """Estimate the animal's size and shape from a session's sampled frames, without writing files.

    Returns:
        The content of look.json: plan, model and input, and `animal`, `log_sd`, `n_frames`,
            `stated` and `misfits`, or `failure`.
    """
    stage = MeasuringStage(progress)
    try:
        return about(session) | _found(session, stage)
    except Exception as error:
        return about(session) | {"failure": describe_failure(error, stage.name, None)}


def about(session: PlannedSession) -> dict[str, Any]:
    """The inputs of an inspection: version, plan and input."""
    return {
        "session_id": session.id,
        "schema_version": SCHEMA_VERSION,
        "versions": versions(),
        "plan": session.plan.model_dump(exclude_none=True),
        "input": {"stamp": input_stamp(session.recording)},
    }


def _found(session: PlannedSession, progress: Progress) -> dict[str, Any]:
    if not session.recording_exists:
        raise RecordingError(
            f"there is no recording {session.recording}; correct its path, or copy it there"
        )
    plan = session.plan
    with (
        processes.in_background(partial(build_estimator, plan)) as estimator,
        build_recording(session.recording, plan, progress) as opened,
    ):
        progress(0, None, INSPECTING)
        fitted = fit_plan(opened, plan, estimator, progress=progress)
    tracker = fitted.tracker
    fit = tracker.sample_fit
    return {
        "model": {"sha256": sha256(find_model(plan.estimation.model))},
        "animal": animal_facts(fitted.plan, tracker),
        "log_sd": round(tracker.size_spread, 6),
        "n_frames": 0 if fit is None else fit.n_found,
        "stated": plan.animal.spine_mm is not None,
        "misfits": list(fitted.misfits),
    }


def inspection_file(session: PlannedSession) -> Path:
    """The path of a session's look.json, next to its results."""
    return session.folder.with_name("look.json")


def write_inspection(session: PlannedSession, inspection: dict[str, Any]) -> None:
    """Write the findings on a session atomically."""
    file = inspection_file(session)
    durable.unlinked(file.parent).mkdir(parents=True, exist_ok=True)
    durable.write_whole(
        file, json.dumps(durable.storable_document(inspection), indent=1, default=str) + "\n"
    )


def read_inspection(session: PlannedSession) -> dict[str, Any] | None:
    """The stored findings on a session; None if there are none, or they are outdated.

    If the recording is gone, they remain valid as long as the rest is unchanged.
    """
    try:
        inspection = json.loads(inspection_file(session).read_text(encoding="utf-8"))
        failed = "failure" in inspection
        if not failed and not session.recording_exists:
            inspection = inspection | {"input": {"stamp": input_stamp(session.recording)}}
        if what_changed(session, inspection):
            return None
        if not _why_not(inspection) and not failed:
            shape = Inspection.model_validate(inspection).animal.shape
            sizes = [len(part) for part in (shape.width, shape.height, shape.joints_moved)]
            n_joints = Skeleton.load(session.plan.animal.skeleton).n_joints
            if shape.kept and sizes != [sections.N_PLACES, sections.N_PLACES, n_joints]:
                return None
    except (OSError, LiexError, ValueError, TypeError, KeyError, AttributeError, RecursionError):
        return None
    return dict(inspection)


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
        why = f"it shares size and shape with {waits_for}, which is inspected first"
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
        described = {} if why else _changed_description(session, document)
    except (OSError, ValueError, LiexError, AttributeError, TypeError, KeyError, RecursionError):
        why = "its session.json cannot be read"
    if described:
        listed = ", ".join(f"{key} = {value or 'unknown'}" for key, value in described.items())
        why = f"description changed: {listed}; nothing is measured again"
    if why:
        return SessionStatus(session, "changed", why, described=described)
    input = str(document.get("input", {}).get("sha256", ""))
    return SessionStatus(session, "done", review_note(read_verdict(session.folder)), input=input)


def to_check(found: Sequence[SessionStatus]) -> list[str]:
    """Possible errors in a study's animals: two names of one, or a recording listed twice."""
    sessions = [one.session for one in found if one.state != "excluded"]
    animals = {one.animal.id: one.animal.model_dump(exclude={"set"}) for one in sessions}
    table = pd.DataFrame(animals.values()).rename(columns={"id": "subject_id"})
    notes = [*misnamed(sessions), *unified(table)[1]]
    known: dict[str, str] = {}
    for one in (one for one in found if one.input):
        own = one.session.animal.id if one.session.arena else ""
        mark = f"{one.input} {one.session.plan.arena.region} {own}"
        first = known.setdefault(mark, one.session.id)
        if first != one.session.id:
            notes.append(f"{one.session.id} is of the same recording as {first}")
    return notes


def misnamed(sessions: Sequence[PlannedSession]) -> list[str]:
    """Sentences on sessions whose recordings are named after another animal of the study.

    Sessions with a region, as one of several arenas, or with several animals are skipped.
    """
    known = {same(one.animal.id): one.animal.id for one in sessions}
    notes = []
    for one in (one for one in sessions if one.plan.arena.region is None and not one.arena):
        found = find_subject(Path(one.recording))
        other = known.get(same(found.id)) if found.origin else None
        if other not in (None, one.animal.id):
            notes.append(
                f"{one.id}: the study names the animal {one.animal.id}, and the recording's "
                f"{found.origin} {other}"
            )
    return notes


def review_note(verdict: Mapping[str, Any]) -> str:
    """Why a session that is done needs review, and cautions about it.

    Returns:
        The session's own wording; '' if there is nothing to report.
    """
    sentences = []
    if verdict["look_at_it"]:
        accepted = ", accepted" if verdict["accepted"] else ""
        sentences.append(f"{NEEDS_REVIEW}{accepted}: {'; '.join(map(str, verdict['reasons']))}")
    if verdict["cautions"]:
        sentences.append(f"{CAUTION}: {'; '.join(map(str, verdict['cautions']))}")
    return ". ".join(sentences)


def _changed_description(session: PlannedSession, document: dict[str, Any]) -> dict[str, str]:
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
