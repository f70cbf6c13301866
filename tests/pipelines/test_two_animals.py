"""Two animals in one arena: run, report and study say so, and the report shows the second one."""

import re
from pathlib import Path

import numpy as np
import pytest
from liex_lab.pipelines.convert import convert
from liex_lab.pipelines.session import run_session
from liex_lab.pipelines.study.crew import measure_one
from liex_lab.pipelines.study.run import to_measure
from liex_lab.pipelines.study.status import standings, to_check
from typer.testing import CliRunner

from liex_lab import cli
from liex_lab.behaviour.cohort import collect
from liex_lab.plan.study import Study
from liex_lab.sessions import Session
from liex_lab.sessions.individuals import by_arena
from liex_lab.simulation.scenes.catalogue import film

N_FRAMES = 60
SEED = 3
ADDRESS = f"synthetic:scene?name=two-animals&seed={SEED}&frames={N_FRAMES}"


SAID = "2 animals are in view at once, and 1 is measured"


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return convert(ADDRESS, tmp_path_factory.mktemp("raw") / "two.mcap").path


@pytest.fixture(scope="module")
def session(recording: Path) -> Session:
    """The session of a run that needs review, and reports both animals."""
    result = CliRunner().invoke(cli.app, ["run", str(recording), "--out", str(recording.parent)])
    assert result.exit_code == 4, result.output
    assert SAID in result.output.strip().splitlines()[-1]
    return Session.open(recording.with_suffix(".liex"))


@pytest.mark.nightly
def test_the_last_lines_and_the_table_of_a_study_report_both(
    recording: Path, tmp_path: Path
) -> None:
    (tmp_path / recording.name).symlink_to(recording)
    (tmp_path / "study.toml").write_text(
        'name = "two"\n[[animals]]\nid = "m1"\ngroup = "a"\n'
        f'[[sessions]]\nanimal = "m1"\nsession = "01"\nrecording = "{recording.name}"\n'
    )
    result = CliRunner().invoke(cli.app, ["cohort", str(tmp_path / "study.toml"), "--workers", "1"])
    assert result.exit_code == 0, result.output
    *_, done, counted = result.output.strip().splitlines()
    assert done.startswith("done")
    assert f"needs review: {SAID}" in done
    assert counted == "1 session: 1 done, needs review"
    (table,) = tmp_path.rglob("study.csv")
    assert "2 animals are in view" in table.read_text()


def test_no_pose_of_one_of_two_animals_is_trusted(session: Session) -> None:
    assert (session.frames["n_animals"] == 2).mean() > 0.9
    assert not (session.frames["flag"][session.frames["n_animals"] > 1] == "").any()
    verdict = session.metadata["verdict"]
    assert (verdict["n_animals"], verdict["look_at_it"]) == (2, True)
    assert verdict["n_animals_share"] > 0.9


def test_the_report_shows_the_one_that_is_not_measured_where_it_is(session: Session) -> None:
    page = (session.path / "report.html").read_text()
    assert "2 animals are in view, and only one of them is followed" in page
    found = re.search(r'<circle cx="([\d.]+)" cy="([\d.]+)"[^>]*class="beside"', page)
    assert found is not None
    assert "not measured</text>" in page
    entry = session.metadata["whole_picture"]
    assert (session.path / entry["file"]).is_file()
    # as it was rendered: each of the two is where a true animal is, and they are not the same
    animals = film("two-animals", SEED, N_FRAMES).animals
    row = int(np.flatnonzero(session.frames["frame_index"] == entry["frame_index"])[0])
    truth = [session.camera.project(animal.joints_camera[row].mean(axis=0)) for animal in animals]
    shown = np.array([float(found[1]), float(found[2])]) - 0.5
    poses = session.table("poses", ["u_px", "v_px"], [entry["frame_index"]])
    followed = poses[["u_px", "v_px"]].to_numpy(float).mean(axis=0)
    other = [np.linalg.norm(place - shown) for place in truth]
    own = [np.linalg.norm(place - followed) for place in truth]
    assert min(other) < 12
    assert min(own) < 12
    assert int(np.argmin(other)) != int(np.argmin(own))


def test_both_are_measured_each_in_a_session_of_its_own(recording: Path, tmp_path: Path) -> None:
    run = ["run", str(recording), "--out", str(tmp_path), "--set", "animal.count=auto"]
    result = CliRunner().invoke(cli.app, run)
    assert result.exit_code == 0, result.output
    truth = film("two-animals", SEED, N_FRAMES).animals
    nearest = []
    for k in (1, 2):
        session = Session.open(tmp_path / f"two-animal{k}.liex")
        assert set(session.frames["individual"]) == {f"animal{k}"}
        assert (session.frames["flag"] == "").mean() > 0.7
        verdict = session.metadata["verdict"]
        assert (verdict["n_animals"], verdict["n_measured"]) == (2, 2)
        assert (session.crossings["p_swap"] < 0.1).all()
        assert set(session.crossings["animals"]) <= {"animal1;animal2"}
        points = session.poses[["x_mm", "y_mm", "z_mm"]].to_numpy().reshape(N_FRAMES, -1, 3)
        joints = session.T_arena_camera.inverse() @ points
        off = [
            np.nanmedian(np.linalg.norm((joints - one.joints_camera).mean(axis=1), axis=-1))
            for one in truth
        ]
        assert min(off) < 10.0
        nearest.append(int(np.argmin(off)))
    assert sorted(nearest) == [0, 1]


def test_a_study_measures_both_at_once_and_counts_their_arena_once(
    recording: Path, tmp_path: Path
) -> None:
    (tmp_path / recording.name).symlink_to(recording)
    (tmp_path / "study.toml").write_text(
        'name = "pairs"\n[[animals]]\nid = "m1"\ngroup = "wt"\n[[animals]]\nid = "m2"\n'
        'group = "ko"\n[[sessions]]\nanimals = ["m1", "m2"]\nsession = "01"\n'
        f'recording = "{recording.name}"\n'
    )
    study = Study.load(tmp_path)
    (todo,) = to_measure(standings(study))
    result = measure_one(todo.session, run_session)
    assert result["failure"] is None
    done = standings(study)
    assert [one.state for one in done] == ["done", "done"]
    assert not to_check(done)
    sessions = [Session.open(one.folder) for one in study.sessions]
    (both,) = by_arena(sessions)
    assert [one.metadata["individual"] for one in both] == ["m1", "m2"]
    assert {*sessions[0].interactions["agent"]} <= {"m1", "m2"}
    table = collect(sessions)
    assert table["arena"].nunique() == 1
    assert table["group"].tolist() == ["wt", "ko"]
