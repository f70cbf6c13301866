"""A session that people corrected fails, is done, fails again: the corrections follow it."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from liex_lab.pipelines.correct import correct_session
from liex_lab.pipelines.study.crew import measure_one
from liex_lab.pipelines.study.status import standing

from liex_lab.errors import RecordingError
from liex_lab.plan import Plan
from liex_lab.plan.study import PlannedSession, Study
from liex_lab.sessions import Session
from liex_lab.sessions import correcting as ask
from liex_lab.sessions.corrections import read_log
from tests.pipelines.study.test_run import make_study
from tests.sessions.walking_mouse import WalkingMouse, write

MOUSE = WalkingMouse(np.arange(12) / 30.0)


def run(
    recording: str, plan: Plan, *, folder: Path, overwrite: bool, pool: object, **more: Any
) -> Path:
    """Stands in for `run_session`: a small session, unless the recording is torn."""
    if Path(recording).read_bytes() == b"torn":
        raise RecordingError("frame 3 cannot be read; copy the recording again")
    return write(folder, MOUSE, plan_toml=plan.to_toml(), overwrite=overwrite).path


@pytest.fixture
def session(tmp_path: Path) -> PlannedSession:
    """A session that was measured and corrected."""
    (one,) = Study.load(make_study(tmp_path, ["good"])).sessions
    assert measure_one(one, run)["state"] == "done"
    correct(one, "groom", 0.1)
    return one


def correct(one: PlannedSession, action: str, start_s: float) -> None:
    edit = ask.add_bout(Session.open(one.folder), action, start_s, start_s + 0.05, new_word=True)
    correct_session(one.folder, [edit], report=False)


def fails(one: PlannedSession) -> None:
    good = Path(one.recording).read_bytes()
    Path(one.recording).write_bytes(b"torn")
    assert measure_one(one, run)["state"] == "failed"
    assert standing(one).state == "failed"
    Path(one.recording).write_bytes(good)


def words(one: PlannedSession) -> set[str]:
    return set(Session.open(one.folder).bouts["action"])


def copies(one: PlannedSession) -> list[str]:
    return sorted(path.name for path in one.folder.parent.iterdir() if path != one.folder)


def test_corrections_follow_a_session_through_every_failure(session: PlannedSession) -> None:
    for _ in range(2):
        fails(session)
        told = measure_one(session, run)
        assert told["state"] == "done"
        assert told["corrections_taken_from"] == "behav.outdated"
        assert "groom" in words(session)
        assert copies(session) == ["behav.outdated"], "what was taken over need not be kept twice"
    assert measure_one(session, run)["corrections_taken_from"] == ""


@pytest.mark.nightly
def test_an_outdated_copy_with_corrections_of_its_own_is_never_removed(
    session: PlannedSession,
) -> None:
    fails(session)
    (session.folder / "failed.json").unlink()
    outdated = session.folder.with_name("behav.outdated")
    hidden = outdated.rename(outdated.with_name("hidden"))
    measure_one(session, run)  # a session of its own, and corrections of its own
    correct(session, "rear", 0.2)
    hidden.rename(outdated)
    fails(session)
    assert copies(session) == ["behav.outdated", "behav.outdated-2"]
    fails(session)
    assert measure_one(session, run)["state"] == "done"
    assert "rear" in words(session), "of two copies the newest"
    fails(session)
    fails(session)
    assert copies(session) == ["behav.outdated", "behav.outdated-2"]
    assert str(read_log(outdated.with_name("behav.outdated-2")).entries[0].what).startswith("groom")
