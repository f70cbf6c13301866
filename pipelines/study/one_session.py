"""One session of a study: measured, or quarantined with a failed.json while the others go on."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any, Protocol

from liex_lab.errors import RecordingError
from liex_lab.plan import Plan
from liex_lab.plan.study import PlannedSession
from liex_lab.runtime.progress import Progress, silent
from liex_lab.sessions.backups import set_outdated, taken_from
from liex_lab.sessions.folder import describe_failure, read_failure, write_failure
from liex_lab.sessions.verdict import read_verdict

from ..shards import MEASURING
from ..workers import WorkerPool
from .changes import input_stamp
from .status import to_look_at


class RunSession(Protocol):
    """What measures a recording: `liex_lab.api.run_session`, which knows the views as well."""

    def __call__(
        self,
        recording: str,
        plan: Plan,
        *,
        folder: Path,
        overwrite: bool,
        notes: dict[str, Any],
        pool: WorkerPool | None,
        progress: Progress,
    ) -> Path:
        """Measure a recording, write the session folder `folder`, and return it.

        Args:
            recording: a path or address.
            plan: everything that the run depends on.
            folder: the session folder.
            overwrite: replace a session that is there already.
            notes: what session.json is to hold besides.
            pool: pool of workers for the shards of a long recording; None measures it in this
                process.
            progress: told frame by frame.
        """


def measure_one(
    session: PlannedSession,
    run: RunSession,
    progress: Progress = silent,
    run_id: str = "",
    pool: WorkerPool | None = None,
) -> dict[str, Any]:
    """Measure a session, or quarantine it, and tell how it went.

    Done twice it does the same: what was interrupted goes on, and what is there is replaced when
    the new one is whole.

    Args:
        session: what is measured, how and where to.
        run: measures the recording.
        progress: told frame by frame.
        run_id: of the study's run; a session that it has ended already is not measured again.
        pool: pool of workers for the session's shards.

    Returns:
        `id`, `state` (`done` or `failed`), `seconds`, `failure` (None where it is done),
        `corrections_taken_from` (the outdated copy that people had corrected; "" for none), and
        `look_at_it` (what there is to look at or to distrust although it is done; "" for nothing).
    """
    if run_id and (ended := _ended(session, run_id)):
        return ended
    began = time.perf_counter()
    stage = "opening the recording"
    frame = None

    def watch(done: int, total: int | None, what: str) -> None:
        """Note stage and frame for a failure's report, and pass `done`, `total` and `what` on."""
        nonlocal stage, frame
        stage = what
        frame = done if what == MEASURING else frame
        progress(done, total, what)

    failure = None
    try:
        if not session.recording_exists:
            raise RecordingError(
                f"there is no recording {session.recording}; correct its path, or copy it there"
            )
        stamp = input_stamp(session.recording)
        run(
            session.recording,
            session.plan,
            folder=session.folder,
            overwrite=True,
            notes={
                "input": {"stamp": stamp},
                "run_id": run_id,
                **({"problems": [session.remark]} if session.remark else {}),
            },
            pool=pool,
            progress=watch,
        )
    except Exception as error:
        failure = describe_failure(error, stage, frame) | {"run_id": run_id}
        quarantine(session, failure)
    seconds = round(time.perf_counter() - began, 3)
    return {
        "id": session.id,
        "state": "failed" if failure else "done",
        "seconds": seconds,
        "failure": failure,
        "corrections_taken_from": "" if failure else taken_from(session.folder),
        "look_at_it": "" if failure else to_look_at(read_verdict(session.folder)),
    }


def _ended(session: PlannedSession, run_id: str) -> dict[str, Any] | None:
    """How the session ended in this run of the study already, before its worker could tell."""
    failure = read_failure(session.folder)
    if failure and failure.get("run_id") == run_id:
        return {"id": session.id, "state": "failed", "seconds": 0.0, "failure": failure}
    try:
        document = json.loads((session.folder / "session.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    same = isinstance(document, dict) and document.get("run_id") == run_id
    return {"id": session.id, "state": "done", "seconds": 0.0, "failure": None} if same else None


def quarantine(session: PlannedSession, failure: dict[str, Any]) -> None:
    """Leave failed.json in the session's place, with plan and input so that changes show.

    Args:
        session: the session that failed; its older results are set aside.
        failure: what `describe_failure` tells of the error.
    """
    known = {
        "session_id": session.id,
        **failure,
        "plan": session.plan.model_dump(exclude_none=True),
    }
    known["input"] = {"stamp": input_stamp(session.recording)}
    set_outdated(session.folder)
    write_failure(session.folder, known)
