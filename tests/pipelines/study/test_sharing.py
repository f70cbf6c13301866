"""Sessions of one animal share its size and shape, whoever looks at them and in whatever order."""

import json
import shutil
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Any

import pytest
from liex_lab.pipelines.study import status
from liex_lab.pipelines.study.crew import measure_one
from liex_lab.pipelines.study.run import list_sessions, run_study, study_rows
from liex_lab.pipelines.study.status import (
    SessionStatus,
    pending_inspections,
    shared_sessions,
    standings,
)

from liex_lab.errors import LiexError, PlanError, StudyError
from liex_lab.plan import Plan
from liex_lab.plan.study import Study
from liex_lab.runtime.progress import Board
from tests.pipelines.pretended import pretended_inspection, pretended_run

Sessions = dict[str, float]  # "m07/name" and the length that its recording shows, mm


class Here:
    """A crew of this process alone: what a worker does is the same."""

    def inspect(self, sessions: Any, inspect: Any, told: Any, finished: Any) -> None:
        for session in sessions:
            finished(inspect(session, lambda *_: None))

    def measure(self, todo: Any, run: Any, told: Any, finished: Any) -> None:
        for one in todo:
            finished(measure_one(one.session, run))


@contextmanager
def here(n_tasks: int, **_: Any) -> Any:
    """Stands in for `crew_of`."""
    assert n_tasks > 0
    yield Here()


@pytest.fixture(autouse=True)
def in_process(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("liex_lab.pipelines.study.run.crew_of", here)
    monkeypatch.setattr("liex_lab.pipelines.study.run.compile_ahead", lambda *_: None)
    monkeypatch.setattr("liex_lab.pipelines.study.run.run_session", pretended_run)
    monkeypatch.setattr("liex_lab.pipelines.study.run.inspect_animal", pretended_inspection)


def make_study(folder: Path, sessions: Sessions, head: str = 'shared = "subject"\n') -> Path:
    """A study of sessions called animal/recording."""
    (folder / "rawdata").mkdir(parents=True, exist_ok=True)
    text = head
    for animal in sorted({name.partition("/")[0] for name in sessions}):
        text += f'[[animals]]\nid = "{animal}"\n'
    for name, length in sessions.items():
        animal, _, title = name.partition("/")
        path = folder / "rawdata" / f"{title}.mcap"
        if not path.exists() or path.read_text() != str(length):
            path.write_text(str(length))
        text += f'[[sessions]]\nanimal = "{animal}"\nsession = "{title}"\n'
        text += f'recording = "rawdata/{title}.mcap"\n'
    (folder / "study.toml").write_text(text)
    return folder / "study.toml"


def run(file: Path, **more: Any) -> dict[str, SessionStatus]:
    def board(n: int) -> Any:
        return nullcontext(Board(n, lambda _: None))

    found = run_study(file, workers=1, board=board, **more)
    return {one.session.id.rpartition("-")[2]: one for one in found}


def measured_by(one: SessionStatus) -> Any:
    """What the session.json of a session says that it was measured with."""
    document = json.loads((one.session.folder / "session.json").read_text())
    return document["plan"]["animal"].get("shared")


def counted(folder: Path, name: str, what: str) -> int:
    path = folder / f"{name}.{what}"
    return path.stat().st_size if path.exists() else 0


def test_sessions_of_one_animal_are_measured_with_one_length(tmp_path: Path) -> None:
    file = make_study(tmp_path, {"m07/a": 80.0, "m08/x": 70.0, "m07/b": 84.0})
    found = run(file)
    assert {one.state for one in found.values()} == {"done"}
    shared = measured_by(found["a"])
    assert shared == measured_by(found["b"])
    assert (shared["subject"], shared["n_sessions"]) == ("m07", 2)
    assert 80.0 < shared["spine_mm"] < 84.0
    assert shared["girth"] == pytest.approx(1.1)
    assert measured_by(found["x"]) is None, "an animal of one session has nobody to share with"
    assert counted(tmp_path, "x", "looks") == 0
    told = {
        row["session_id"]: row["shared"] for row in study_rows(Study.load(file), [*found.values()])
    }
    assert told["sub-m07_ses-a"] == (
        f"{shared['spine_mm']:.1f} mm long, the average shape, by 2 sessions of m07"
    )
    assert told["sub-m08_ses-x"] == ""


def test_nothing_is_shared_or_looked_at_unless_the_study_says_so(tmp_path: Path) -> None:
    for head in ("", 'shared = "off"\n'):
        found = run(make_study(tmp_path, {"m07/a": 80.0, "m07/b": 84.0}, head))
        assert measured_by(found["a"]) is None
        assert found["a"].session.remark == ""
    assert counted(tmp_path, "a", "looks") == 0
    assert counted(tmp_path, "a", "runs") == 1
    with pytest.raises(StudyError, match="shared should be 'off' or 'subject'"):
        Study.load(make_study(tmp_path, {}, 'shared = "cage"\n'))


def test_an_interrupted_study_goes_on_to_the_same_and_looks_at_nobody_twice(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    lengths = {"m07/a": 80.0, "m07/b": 84.0, "m07/c": 81.5}
    whole = run(make_study(tmp_path / "whole", lengths))
    cut = make_study(tmp_path / "cut", lengths)
    looked: list[str] = []

    def interrupted(session: Any, progress: Any) -> Any:
        if len(looked) == 2:
            raise KeyboardInterrupt
        looked.append(session.id)
        return pretended_inspection(session, progress)

    with monkeypatch.context() as patch:
        patch.setattr("liex_lab.pipelines.study.run.inspect_animal", interrupted)
        with pytest.raises(KeyboardInterrupt):
            run(cut)
    states = [one.state for one in standings(Study.load(cut))]
    assert states == ["new"] * 3
    found = run(cut)
    assert [measured_by(found[name]) for name in "abc"] == [
        measured_by(whole[name]) for name in "abc"
    ]
    assert [counted(tmp_path / "cut", name, "looks") for name in "abc"] == [1, 1, 1]
    run(cut)
    assert [counted(tmp_path / "cut", name, "runs") for name in "abc"] == [1, 1, 1]


def test_one_session_alone_is_measured_with_what_all_of_its_animal_agree_on(
    tmp_path: Path,
) -> None:
    lengths = {"m07/a": 80.0, "m07/b": 84.0, "m08/c": 60.0, "m08/d": 61.0}
    all_of_them = run(make_study(tmp_path / "all", lengths))
    file = make_study(tmp_path / "one", lengths)
    found = run(file, only=["sub-m07_ses-b"])
    assert measured_by(found["b"]) == measured_by(all_of_them["b"])
    assert found["a"].state == "new"
    assert counted(tmp_path / "one", "c", "looks") == 0, "nobody asked for that animal"


def test_another_session_changes_what_all_of_its_animal_are_measured_with(tmp_path: Path) -> None:
    lengths = {"m07/a": 80.0, "m07/b": 84.0, "m08/x": 60.0, "m08/y": 61.0}
    run(make_study(tmp_path, lengths))
    file = make_study(tmp_path, {**lengths, "m07/c": 86.0})
    waiting = {one.session.id.rpartition("-")[2]: one for one in standings(Study.load(file))}
    assert waiting["a"].state == "changed"
    assert "sub-m07_ses-c, which is inspected first" in waiting["a"].reason
    assert (waiting["c"].state, waiting["x"].state) == ("new", "done")
    found = run(file)
    assert measured_by(found["a"])["n_sessions"] == 3
    assert measured_by(found["a"]) == measured_by(found["c"])
    assert [counted(tmp_path, name, "runs") for name in "abcxy"] == [2, 2, 1, 1, 1]
    assert [counted(tmp_path, name, "looks") for name in "abc"] == [1, 1, 1]


def test_who_does_not_share_keeps_its_own_and_the_reason_is_stated(tmp_path: Path) -> None:
    lengths = {
        "m06/p": 80.0,
        "m06/q": 86.5,
        "m07/a": 80.0,
        "m07/b": 88.0,
        "m08/x": 70.0,
        "m08/y": 71.0,
        "m08/empty": 1.0,
        "m08/other": 60.0,
        "m09/k": 80.0,
        "m09/empty2": 1.0,
        "m10/r": 80.0,
        "m10/s": 82.0,
        "m10/t": 99.0,
    }
    file = make_study(tmp_path, lengths)
    file.write_text(file.read_text().rstrip() + '\nexclude = "another mouse"\n')
    found = run(file)
    own = {name for name, one in found.items() if one.state == "done" and not measured_by(one)}
    assert own == {"a", "b", "other", "k"}
    assert {name for name, one in found.items() if one.state == "failed"} == {"empty", "empty2"}
    assert found["t"].state == "excluded"
    assert measured_by(found["r"])["n_sessions"] == 2
    assert measured_by(found["x"])["spine_mm"] == pytest.approx(70.5, abs=0.01)
    apart = (
        "The sessions of m07 do not share size and shape: their lengths, 80.0 to 88.0 mm, lie "
        "9.5% apart, more than 8%; each keeps its own."
    )
    assert [found[name].session.remark for name in "abxypq"] == [apart, apart, "", "", "", ""]
    assert found["k"].session.remark.endswith("one of them alone shows the animal.")
    assert found["other"].session.remark == (
        "sub-m08_ses-other does not share size and shape with the other sessions of m08: its body "
        "covers 3% of the outline that is seen."
    )
    rows = {row["session_id"]: row for row in study_rows(Study.load(file), [*found.values()])}
    assert rows["sub-m07_ses-a"]["shared"] == apart
    document = json.loads((found["a"].session.folder / "session.json").read_text())
    assert document["problems"] == [apart]
    listed = {entry.key: entry.reason for entry in list_sessions(file)[1]()}
    assert (listed["sub-m07_ses-a"], listed["sub-m08_ses-x"]) == (apart, "")
    assert run(file)["a"].state == "done", "it is nothing to be done again for"
    counts = [counted(tmp_path, name, "looks") for name in ("t", "x", "empty")]
    run(file, retry=True)
    again = [counted(tmp_path, name, "looks") for name in ("t", "x", "empty")]
    assert (counts, again) == ([0, 1, 1], [0, 1, 2])
    assert counted(tmp_path, "x", "runs") == 1


def test_who_an_animal_is_changes_without_a_look(tmp_path: Path) -> None:
    file = make_study(tmp_path, {"m07/a": 80.0, "m07/b": 82.0})
    run(file)
    file.write_text(file.read_text().replace('id = "m07"', 'id = "m07"\ngroup = "drug"'))
    assert pending_inspections(Study.load(file)) == []
    found = {one.session.id[-1]: one for one in standings(Study.load(file))}
    assert found["a"].described == {"group": "drug"}


def test_a_length_that_the_plan_states_stays_and_is_no_finding(tmp_path: Path) -> None:
    file = make_study(tmp_path, {"m07/a": 80.0, "m07/b": 82.0, "m07/c": 84.0})
    file.write_text(file.read_text() + "set = { animal.spine_mm = 84.0 }\n")
    assert {one.state for one in run(file, dry_run=True).values()} == {"new"}
    assert counted(tmp_path, "a", "looks") == 0, "a dry run inspects nobody"
    found = run(file)
    assert measured_by(found["c"])["spine_mm"] == pytest.approx(81.0, abs=0.05)
    document = json.loads((found["c"].session.folder / "session.json").read_text())
    assert document["plan"]["animal"]["spine_mm"] == 84.0, "it goes before what is shared"


def test_a_look_outlives_its_recording_and_a_damaged_one_is_made_again(tmp_path: Path) -> None:
    file = make_study(tmp_path, {"m07/a": 80.0, "m07/b": 82.0})
    found = run(file)
    recording = tmp_path / "rawdata" / "a.mcap"
    shutil.move(recording, tmp_path / "a.mcap")
    assert pending_inspections(Study.load(file)) == []
    shutil.move(tmp_path / "a.mcap", recording)
    look = status.inspection_file(found["a"].session)
    good = json.loads(look.read_text())
    for text in (
        "",
        "[]",
        "{",
        json.dumps(good | {"animal": {"spine_mm": -1.0, "girth": 1.0}}),
        json.dumps(good | {"animal": {"spine_mm": float("nan"), "girth": 1.0}}),
        json.dumps(good | {"animal": {"spine_mm": 80.0, "girth": 1.0, "shape": {"kept": True}}}),
        json.dumps(good | {"log_sd": float("inf")}),
        json.dumps(good | {"n_frames": 0}),
        json.dumps(good | {"failure": 3}),
        json.dumps({key: value for key, value in good.items() if key != "misfits"}),
    ):
        look.write_text(text)
        assert [one.id for one in pending_inspections(Study.load(file))] == ["sub-m07_ses-a"], text
    assert run(file)["a"].state == "done"
    assert counted(tmp_path, "a", "runs") == 1, "it found the same"


def test_no_look_is_written_through_a_link(tmp_path: Path) -> None:
    file = make_study(tmp_path / "study", {"m07/a": 80.0, "m07/b": 82.0})
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    animal = Study.load(file).results / "sub-m07"
    animal.mkdir(parents=True)
    (animal / "ses-b").symlink_to(elsewhere, target_is_directory=True)
    with pytest.raises(LiexError, match="link"):
        run(file, only=["sub-m07_ses-a"])
    assert not list(elsewhere.iterdir())


def test_what_is_shared_is_a_plan_that_comes_back_from_its_file(tmp_path: Path) -> None:
    shape = {"width": [1.1] * 5, "height": [0.9] * 5, "joints_moved": [[0.0, 0.001, -0.01]] * 5}
    body = {"subject": "m07", "n_sessions": 2, "spine_mm": 81.03, "girth": None, "shape": shape}
    table = Plan.load("mouse").model_dump(exclude_none=True)
    plan = Plan.from_table({**table, "animal": {**table["animal"], "shared": body}})
    assert Plan.from_toml(plan.to_toml()) == plan
    assert "<SharedBody of 2 sessions of m07: 81.03 mm long>" in repr(plan)
    for wrong in (
        {**body, "n_sessions": 1},
        {**body, "spine_mm": 0.0},
        {**body, "shape": {**shape, "width": [1.0] * 4}},
        {**body, "shape": {**shape, "height": [0.0] * 5}},
        {**body, "shape": {**shape, "joints_moved": [[0.0, 0.0]] * 5}},
    ):
        with pytest.raises(PlanError):
            Plan.from_table({"animal": {"shared": wrong}})


@pytest.mark.nightly
def test_the_worker_processes_of_a_study_look_and_their_death_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.undo()
    file = make_study(tmp_path, {"m07/a": 80.0, "m07/b": 82.0, "m07/deadly": 81.0})
    found = run(file, workers=2)
    assert measured_by(found["a"])["n_sessions"] == 2
    assert measured_by(found["a"]) == measured_by(found["b"])
    assert found["deadly"].state == "failed"
    (last,) = [one for one, _ in shared_sessions(Study.load(file)) if "deadly" in one.id]
    assert "the worker process died 4 times" in last.remark
