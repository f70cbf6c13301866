"""What changed since a session of a study was measured or looked at: version, plan, model, input.

Inputs are compared by names, sizes and times, and where these differ by hash.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from liex_lab.plan import Plan
from liex_lab.plan.study import VIRTUAL, PlannedSession
from liex_lab.sessions.corrections import DESCRIBED
from liex_lab.sessions.provenance import SCHEMA_VERSION, package_version

_SAYS = {
    ".toml",
    ".txt",
    ".csv",
    ".json",
    ".yaml",
    ".yml",
}  # files beside a recording that say what is in it


def what_changed(session: PlannedSession, document: dict[str, Any]) -> str:
    """Why a stored session is not the planned one any more; '' if it is.

    Args:
        session: the planned session.
        document: what was stored: session.json, failed.json or look.json.

    Raises:
        PlanError: the stored plan is none.
    """
    return next(filter(None, (check() for check in _checks(session, document))), "")


def _checks(session: PlannedSession, document: dict[str, Any]) -> Iterable[Callable[[], str]]:
    """Tests that say what changed, '' if nothing did; cheapest first."""
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
    if now["animal"]["shared"] != then["animal"]["shared"]:
        shared = plan.animal.shared
        length = "" if shared is None or shared.spine_mm is None else f", {shared.spine_mm:g} mm"
        now["animal"]["shared"] = "nothing" if shared is None else f"by {shared.by}{length}"
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
