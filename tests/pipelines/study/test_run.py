"""A study on real worker processes, with a run that takes no time: what fails is told, and stops no
other.
"""

import csv
import json
import os
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace

import pandas as pd
import pytest
from liex_lab.pipelines.study import cluster
from liex_lab.pipelines.study.cluster import SlurmTable
from liex_lab.pipelines.study.crew import measure_one, n_shared
from liex_lab.pipelines.study.run import list_sessions, write_study_table
from liex_lab.pipelines.study.status import plan_changed, standing, standings
from typer.testing import CliRunner

from liex_lab import api, cli
from liex_lab.errors import LiexError, StudyError
from liex_lab.plan import Plan
from liex_lab.plan.study import Study
from liex_lab.runtime import progress
from liex_lab.runtime.progress import Board
from liex_lab.sessions.corrections import Description
from liex_lab.sessions.verdict import Verdict
from tests.pipelines.pretended import pretended_run, shared_task

BROKEN = ("empty", "torn", "full", "fault", "missing")


def make_study(folder: Path, names: list[str], **more: str) -> Path:
    """A study with one animal and one recording for each name."""
    raw = folder / "rawdata"
    raw.mkdir(parents=True, exist_ok=True)
    text = 'name = "=1+1"\n'
    for name in names:
        if not name.startswith("missing"):
            (raw / f"{name}.mcap").write_bytes(name.encode())
        text += f'[[animals]]\nid = "{name}"\ngroup = "@g"\n'
        text += (
            f'[[sessions]]\nanimal = "{name}"\nsession = "01"\nrecording = "rawdata/{name}.mcap"\n'
        )
        text += more.get(name, "") + "\n"
    (folder / "study.toml").write_text(text)
    return folder / "study.toml"


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str, int]:
    """Nine sessions on two workers, five of them broken: the study's file, what was printed, the
    exit code.
    """
    folder = tmp_path_factory.mktemp("study")
    names = ["good0", "good1", "unlucky", *BROKEN, "last"]
    file = make_study(folder, [*names, "skipped"], skipped='exclude = "fell asleep"')
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("liex_lab.pipelines.study.run.run_session", pretended_run)
        result = CliRunner().invoke(cli.app, ["cohort", str(file), "--workers", "2"])
    return file, result.output, result.exit_code


def test_what_can_be_done_is_done_and_the_rest_is_quarantined(
    finished: tuple[Path, str, int],
) -> None:
    file, printed, code = finished
    assert code == 3, printed
    found = standings(Study.load(file))
    states = {one.session.animal.id: one.state for one in found}
    assert {name for name, state in states.items() if state == "failed"} == set(BROKEN)
    assert states["skipped"] == "excluded"
    assert list(states.values()).count("done") == 4, "one death of a worker is no reason to give up"
    assert "10 sessions: 4 done, 1 excluded, 5 failed" in printed
    assert f"liex cohort {file} --retry" in printed
    runs = {path.stem: path.stat().st_size for path in file.parent.glob("*.runs")}
    assert [runs[name] for name in ("unlucky", "good0", "good1")] == [2, 1, 1]
    for one in found:
        ends = [(one.session.folder / end).is_file() for end in ("session.json", "failed.json")]
        assert sum(ends) == (0 if one.session.exclude else 1), one.session.id
    assert not list(file.parent.rglob("*.part"))


def test_a_quarantined_session_says_why_where_and_what_to_do(
    finished: tuple[Path, str, int],
) -> None:
    told = {one.session.animal.id: one.failure or {} for one in standings(Study.load(finished[0]))}
    assert told["empty"]["reason"] == "no animal was found in the sampled frames"
    assert told["empty"]["remedy"] == "check the depth unit and the plan"
    assert (told["empty"]["stage"], told["empty"]["frame"]) == ("learning the background", None)
    assert (told["torn"]["stage"], told["torn"]["frame"]) == ("measuring poses", 32)
    assert "No space left" in told["full"]["reason"]
    assert "room" in told["full"]["remedy"]
    assert "slip of ours" in told["fault"]["reason"]
    assert any("ZeroDivisionError" in line for line in told["fault"]["traceback"])
    assert "there is no recording" in told["missing"]["reason"]
    assert all(
        {"stage", "frame", "reason", "remedy", "versions", "plan"} <= set(told[name])
        for name in BROKEN
    )


def test_the_studys_table_lists_every_session_and_holds_no_formula(
    finished: tuple[Path, str, int],
) -> None:
    folder = Study.load(finished[0]).cohort_folder
    table = pd.read_parquet(folder / "study.parquet")
    assert table["state"].value_counts().to_dict() == {"done": 4, "failed": 5, "excluded": 1}
    assert (table["group"] == "@g").all()
    rows = list(csv.reader((folder / "study.csv").read_text(encoding="utf-8").splitlines()))
    assert len(rows) == 11
    assert not [
        cell
        for row in rows
        for cell in row
        if cell[:1] in ("=", "+", "-", "@") and not cell[1:].isdigit()
    ]
    described = {entry["name"] for entry in json.loads((folder / "study_columns.json").read_text())}
    assert described == set(table.columns)


def test_workers_share_the_cores_and_the_sessions_that_are_left(
    finished: tuple[Path, str, int],
) -> None:
    assert [n_shared(n, 2) for n in range(6)] == [0, 1, 0, 1, 0, 1]
    assert [n_shared(n, 4) for n in (3, 4, 11)] == [3, 0, 3]
    assert n_shared(3, 0) == 0, "workers that are still to come cannot be counted"
    done = [one.session for one in standings(Study.load(finished[0])) if one.state == "done"]
    about = {one.animal.id: json.loads((one.folder / "session.json").read_text()) for one in done}
    assert [name for name, document in about.items() if document["shared"]] == ["last"]
    cores = max(1, len(os.sched_getaffinity(0)) // 2)
    assert {document["threads"] for document in about.values()} == {str(cores)}


@pytest.mark.nightly
def test_a_recording_that_kills_its_worker_is_given_up_and_stops_no_other(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = make_study(tmp_path, ["deadly", "good"])
    monkeypatch.setattr("liex_lab.pipelines.study.run.run_session", pretended_run)
    assert CliRunner().invoke(cli.app, ["cohort", str(file), "--workers", "2"]).exit_code == 3
    deadly, good = standings(Study.load(file))
    assert "worker process died" in (deadly.failure or {})["reason"]
    assert good.state == "done"
    assert 2 <= (tmp_path / "deadly.runs").stat().st_size <= 4


@pytest.mark.nightly
def test_all_workers_share_the_stretches_of_one_session() -> None:
    with cluster.crew_of(2, workers=2, threads=1) as crew:
        found = crew.client.submit(shared_task, 6, pure=False).result(timeout=120)
    assert sorted(number for number, _ in found) == list(range(6))
    assert len({process for _, process in found}) == 2, "the worker that steps aside does its share"


def one_session(tmp_path: Path, name: str = "good") -> Path:
    """A study of one session, measured."""
    file = make_study(tmp_path, [name])
    measure_one(Study.load(file).sessions[0], pretended_run)
    return file


def why(file: Path) -> tuple[str, str]:
    found = standing(Study.load(file).sessions[0])
    return found.state, found.reason


def test_a_session_is_done_again_only_when_input_plan_or_version_changed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = one_session(tmp_path)
    assert why(file) == ("done", "")
    text = file.read_text()
    file.write_text(text + "set = { behaviour.rear_height_mm = 41.0 }\n")
    assert why(file) == ("changed", "plan changed: behaviour.rear_height_mm = 41.0")
    file.write_text(text)
    monkeypatch.setattr("liex_lab.pipelines.study.status.package_version", lambda name: "9.9")
    assert why(file)[1].startswith("version changed: ")
    monkeypatch.undo()
    assert why(file) == ("done", "")
    recording = tmp_path / "rawdata" / "good.mcap"
    recording.write_bytes(b"other bytes")
    path = Study.load(file).sessions[0].folder / "session.json"
    stored = json.loads(path.read_text())["input"]["sha256"]
    for digest, expected in (
        ("0" * 64, ("changed", "input changed: its content")),
        (stored, ("done", "")),  # only copied to another place
    ):
        opened = nullcontext(SimpleNamespace(digest=lambda digest=digest: digest))
        monkeypatch.setattr(
            "liex_lab.pipelines.study.status.open_planned", lambda *_, opened=opened: opened
        )
        assert why(file) == expected
    recording.unlink()
    assert why(file) == ("done", ""), "results outlive their recording"


def test_who_an_animal_is_changes_without_measuring(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = one_session(tmp_path)
    text = file.read_text()
    file.write_text(text.replace('group = "@g"', 'group = "drug"\ncage = "c1"'))
    state, reason = why(file)
    assert (state, reason) == (
        "changed",
        "description changed: group = drug, cage = c1; nothing is measured again",
    )
    described = []

    def describe(session: Path, what: list[Description], **who: str) -> Path:
        described.append((Path(session), [str(one) for one in what]))
        return Path(session)

    def never(*_: object, **__: object) -> Path:
        raise AssertionError("it measured")

    monkeypatch.setattr("liex_lab.pipelines.study.run.correct_session", describe)
    monkeypatch.setattr("liex_lab.pipelines.study.run.run_session", never)
    runs = (tmp_path / "good.runs").stat().st_size
    api.run_study(file, workers=1)
    folder = Study.load(file).sessions[0].folder
    assert described == [(folder, ["group is drug", "cage is c1"])]
    assert (tmp_path / "good.runs").stat().st_size == runs
    file.write_text(text + "set = { behaviour.rear_height_mm = 41.0 }\n")
    assert why(file)[1].startswith("plan changed"), "what is measured by still counts"


def test_a_failed_session_is_left_alone_until_something_changed_or_it_is_asked_for(
    tmp_path: Path,
) -> None:
    file = one_session(tmp_path, "torn")
    study = Study.load(file)
    assert why(file)[0] == "failed"
    assert not standings(study)[0].to_do
    assert standings(study, retry=True)[0].to_do
    recording = tmp_path / "rawdata" / "torn.mcap"
    recording.write_bytes(b"copied again")
    assert why(file) == (
        "changed",
        "input changed: sizes or times of its files; before, it failed: frame 33 cannot be read",
    )


def test_an_outdated_session_that_fails_is_kept_under_another_name(tmp_path: Path) -> None:
    file = one_session(tmp_path)
    session = Study.load(file).sessions[0]
    measure_one(session, lambda *_, **__: 1 / 0)
    assert why(file)[0] == "failed"
    assert not (session.folder / "session.json").exists()
    assert (session.folder.with_name("behav.outdated") / "session.json").is_file()
    measure_one(session, pretended_run)
    assert why(file) == ("done", "")


def test_a_session_that_someone_has_to_look_at_is_done_and_says_why(
    tmp_path: Path,
) -> None:
    file = one_session(tmp_path)
    session = Study.load(file).sessions[0]
    path = session.folder / "session.json"
    document = json.loads(path.read_text())
    verdict = Verdict(40, 40, 39, 3, 9.0, 1, ("only 3 of the 40 frames are trusted",))
    path.write_text(json.dumps(document | {"verdict": verdict.to_dict()}))
    assert why(file) == ("done", "needs review: only 3 of the 40 frames are trusted")
    result = CliRunner().invoke(cli.app, ["cohort", str(file)])
    assert result.exit_code == 0, result.output
    listed, counted = result.output.strip().splitlines()
    reason = "needs review: only 3 of the 40 frames are trusted"
    assert listed.split() == ["done", session.id, *reason.split()]
    assert counted == "1 session: 1 done, needs review"
    (entry,) = list_sessions(file)[1]()
    assert (entry.state, entry.reason) == why(file)


def test_what_changes_no_measurement_changes_no_plan() -> None:
    plan = Plan.load("mouse")
    stored = plan.model_dump(exclude_none=True)
    asked = plan.with_settings(['report.figures=["svg", "pdf"]'])
    assert plan_changed(asked, stored) == ""
    del stored["report"]  # a session of before
    assert plan_changed(asked, stored) == ""
    assert "pause" in plan_changed(plan.with_settings(["behaviour.pause_below_mm_s=40"]), stored)
    hand = Plan.load("hand")
    left, right = (hand.with_settings([f"recording.mirrored={k}"]) for k in ("true", "false"))
    for found in (left, right):  # a plan that leaves open which hand it is
        assert plan_changed(hand, found.model_dump(exclude_none=True)) == ""
    assert "mirrored" in plan_changed(left, right.model_dump())


def test_a_damaged_end_of_a_session_is_done_again(tmp_path: Path) -> None:
    file = one_session(tmp_path)
    folder = Study.load(file).sessions[0].folder
    for text in ("", "[]", "{", '{"plan": 3}', '{"versions": []}'):
        (folder / "session.json").write_text(text)
        assert why(file)[0] == "changed", text
    (folder / "session.json").unlink()
    for text in ("", "[]", "{}", '{"reason": 3}'):
        (folder / "failed.json").write_text(text)
        assert why(file)[0] == "failed", text


def test_dry_run_changes_nothing_and_lists_recordings_that_never_were(tmp_path: Path) -> None:
    file = make_study(tmp_path, ["good", "missing", "missing2"])
    before = sorted(tmp_path.rglob("*"))
    result = CliRunner().invoke(cli.app, ["cohort", str(file), "--dry-run"])
    assert result.exit_code == 3
    assert result.output.startswith("new      sub-good_ses-01  new\n")
    assert "3 sessions: 1 new, 2 recording missing" in result.output
    assert sorted(tmp_path.rglob("*")) == before


def test_a_session_whose_recording_is_gone_is_not_done(tmp_path: Path) -> None:
    file = one_session(tmp_path)
    (tmp_path / "rawdata" / "good.mcap").unlink()
    result = CliRunner().invoke(cli.app, ["cohort", str(file)])
    assert result.exit_code == 3, result.output
    assert "missing  sub-good_ses-01  there is no recording " in result.output
    assert "1 session: 1 recording missing" in result.output
    assert (Study.load(file).sessions[0].folder / "session.json").is_file(), "its results stay"


def test_two_names_of_one_animal_and_one_recording_listed_twice_are_told(tmp_path: Path) -> None:
    file = make_study(tmp_path, ["m01day1", "m01day2", "m02", "m03"])
    text = file.read_text().replace('id = "m02"\ngroup = "@g"', 'id = "m02"\ngroup = "@G"')
    file.write_text(text.replace("rawdata/m02.mcap", "rawdata/m03.mcap"))
    for session in Study.load(file).sessions:
        measure_one(session, pretended_run)
    said = CliRunner().invoke(cli.app, ["cohort", str(file), "--dry-run"]).output
    assert (
        "sub-m02_ses-01: the study names the animal m02, and the recording's file name m03" in said
    )
    assert "group '@G' is taken for '@g'" in said
    assert "possible pseudo-replication: the animals m01day1, m01day2 may be one" in said
    assert "sub-m03_ses-01 is of the same recording as sub-m02_ses-01" in said


def test_two_runs_of_a_study_at_once_are_refused(tmp_path: Path) -> None:
    from liex_lab.runtime.durable import take_lock

    file = make_study(tmp_path, ["good"])
    folder = Study.load(file).cohort_folder
    folder.mkdir(parents=True)
    held = take_lock(folder / ".lock")
    assert held is not None
    with pytest.raises(LiexError, match="another process"):
        api.run_study(file)
    held.close()


def test_mistakes_on_the_command_line_are_told(tmp_path: Path) -> None:
    file = make_study(tmp_path, ["good"])
    with pytest.raises(LiexError, match="has no session sub-x"):
        api.run_study(file, only=["sub-x"])
    with pytest.raises(StudyError, match="either"):
        api.run_study(file, scheduler="tcp://127.0.0.1:1", slurm="slurm")
    assert CliRunner().invoke(cli.app, ["cohort", str(file), str(tmp_path)]).exit_code == 2
    empty = Study.from_table({}, tmp_path / "study.toml")
    assert write_study_table(empty, []).read_text().startswith("session_id,")


def test_the_job_script_for_slurm_asks_for_what_the_file_says(tmp_path: Path) -> None:
    from dask_jobqueue.slurm import SLURMJob
    from liex_lab.pipelines.study.cluster import slurm_options

    table = SlurmTable(
        partition="batch",
        account="neuro",
        memory="6GB",
        cores_per_job=3,
        walltime="02:00:00",
        prologue=["module load python/3.11"],
        directives=["--qos=normal"],
        log_folder="logs",
    )
    script = SLURMJob(
        "tls://10.0.0.1:8786", name="w0", **slurm_options(table, str(tmp_path))
    ).job_script()
    for line in (
        "#SBATCH -p batch",
        "#SBATCH -A neuro",
        "#SBATCH --cpus-per-task=3",
        "#SBATCH --mem=6G",
        "#SBATCH -t 02:00:00",
        "#SBATCH --qos=normal",
        "module load python/3.11",
        "export NUMBA_NUM_THREADS=3",
    ):
        assert f"\n{line}\n" in script, script
    assert "distributed.cli.dask_worker tls://10.0.0.1:8786" in script
    assert "--nthreads 1" in script


def test_the_bundled_slurm_file_loads_and_slips_are_told(tmp_path: Path) -> None:
    assert SlurmTable.load("slurm") == SlurmTable()
    for text, said in (
        ("jobs = 0", "greater"),
        ("job = 3", "job"),
        ("partition = 'a\\nb'", "partition"),
        ("prologue = ['a\\nrm']", "TOML|prologue"),
        ("[", "TOML"),
    ):
        (tmp_path / "own.toml").write_text(text.replace("'", '"'))
        with pytest.raises(StudyError, match=said):
            SlurmTable.load(tmp_path / "own.toml")
    with pytest.raises(StudyError, match="there is no file"):
        SlurmTable.load(tmp_path / "none.toml")


def test_a_board_says_how_long_it_will_take(monkeypatch: pytest.MonkeyPatch) -> None:
    lines: list[str] = []
    now = [0.0]
    monkeypatch.setattr(progress, "time", SimpleNamespace(monotonic=lambda: now[0]))
    board = Board(4, lines.append)
    board.report("a", 5, 10, "measuring")
    now[0] = 10.0
    assert board.share == pytest.approx(1 / 8)
    assert board.left_s == pytest.approx(70.0)
    board.finish("a", "is done", failed=False)
    assert lines == ["1 of 4: a is done, about 30 s left"]
    for name in "bcd":
        board.finish(name, "failed", failed=True)
    assert (board.n_failed, board.share, lines[-1]) == (3, 1.0, "4 of 4: d failed")
