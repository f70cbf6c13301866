"""The whole line on the bundled sample with the bundled model, held against the truth the sample
was rendered from.
"""

from pathlib import Path

import numpy as np
import pytest
from liex_lab.pipelines.sample import LEFT_OUT, N_FRAMES, virtual_mouse
from typer.testing import CliRunner

import liex_lab
from liex_lab import catalog
from liex_lab.api import run_session
from liex_lab.cli import app
from liex_lab.errors import LiexError
from liex_lab.sessions import Session
from liex_lab.sessions.session import FILES
from liex_lab.simulation.agents.mouse import ACTIONS
from tests.recordings.writers import depth_frames, write_mcap

pytestmark = pytest.mark.skipif(
    "mouse" not in catalog.bundled_models(), reason="the mouse's model is not bundled yet"
)
KEPT = np.delete(np.arange(N_FRAMES), LEFT_OUT)


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Session:
    """What `liex demo` leaves."""
    out = tmp_path_factory.mktemp("demo")
    ran = CliRunner().invoke(app, ["demo", "--out", str(out)])
    assert (ran.exit_code, ran.stderr) == (0, "")
    assert ran.stdout.splitlines()[:2] == [
        f"session: {out / 'mouse_walk.liex'}",
        f"report:  {out / 'mouse_walk.liex' / 'report.html'}",
    ]
    assert f"video:   {out / 'mouse_walk.liex' / 'mouse_walk.mp4'}" in ran.stdout.splitlines()
    return Session.open(out / "mouse_walk.liex")


def test_the_folder_is_whole(session: Session) -> None:
    others = {"crossings.parquet", "interactions.parquet", "interaction_totals.parquet"}
    others |= {"triggers.parquet", "moseq.parquet", "hours.parquet", "rhythm.parquet"}
    others |= {"periods.parquet"}
    assert {path.name for path in session.path.iterdir()} == {
        *FILES.keys() - others,
        "report.html",
        "thumbnails",
        "figures",
        "mouse_walk.mp4",
    }
    drawn = {path.name for path in (session.path / "figures").iterdir()}
    assert {"occupancy.svg", "ethogram.svg", "arena.svg"} <= drawn
    others = {name for name in drawn if not name.endswith(".svg")}
    assert others == {"figures.pdf"}  # other formats are asked for
    # nothing is wrong with it; bouts that did not meet their definition are said to be refused
    refused = session.metadata.get("refused_bouts", {}).get("bouts", [])
    assert len(session.metadata["problems"]) == bool(refused)
    assert all("not meet the definition" in problem for problem in session.metadata["problems"])
    assert session.metadata["input"]["sha256"] == catalog.sha256(
        catalog.find_sample("mouse_walk.mcap")
    )


def test_every_frame_has_its_rows_and_every_gap_is_told(session: Session) -> None:
    n = len(KEPT)
    joints = session.metadata["animal"]["joints"]
    assert (len(session.frames), len(session.kinematics)) == (n, n)
    assert (len(session.poses), len(session.rotations)) == (n * len(joints), n * (len(joints) + 1))
    assert session.gaps["n_frames_missing"][
        session.gaps["reason"] == "camera_dropped"
    ].tolist() == [1, 3]
    assert (session.frames["flag"] == "").mean() > 0.95


def test_the_skeleton_is_where_the_truth_is(session: Session) -> None:
    mouse = virtual_mouse()
    joints = session.poses[["x_mm", "y_mm", "z_mm"]].to_numpy().reshape(len(KEPT), -1, 3)
    in_camera = session.T_arena_camera.inverse() @ joints
    error_mm = np.linalg.norm(in_camera - mouse.joints_camera[KEPT], axis=-1).mean(axis=1)
    assert np.nanmean(error_mm) < 0.06 * mouse.spine_mm
    truth = mouse.joints_camera[KEPT]
    heading = np.sum((in_camera[:, 4] - in_camera[:, 0]) * (truth[:, 4] - truth[:, 0]), axis=-1)
    assert (heading < 0).sum() <= 2, "head and tail are told apart"
    assert session.metadata["animal"]["spine_mm"] == pytest.approx(mouse.spine_mm, rel=0.1)
    assert session.metadata["camera"]["floor_distance_mm"] == pytest.approx(
        mouse.floor.distance_mm, rel=0.02
    )


def test_the_tables_say_what_the_animal_did(session: Session) -> None:
    mouse = virtual_mouse()
    row = session.summary.iloc[0]
    steps = np.linalg.norm(np.diff(mouse.joints_arena[:, :-1, :2].mean(axis=1), axis=0), axis=-1)
    assert row["distance_m"] == pytest.approx(steps.sum() / 1000, rel=0.15)
    assert row["rear_supported_count"] + row["rear_unsupported_count"] == 1
    assert 0.4 < row["rear_supported_s"] + row["rear_unsupported_s"] < 1.8
    assert row["walk_s"] > 1.0
    assert set(session.bouts["action"]) <= set(ACTIONS)
    assert set(session.bouts["source"]) == {"model"}
    assert set(session.metadata["actions"]) == set(ACTIONS)


@pytest.mark.nightly
def test_a_session_can_be_made_again_from_its_own_plan(session: Session, tmp_path: Path) -> None:
    plan = liex_lab.Plan.from_toml(session.plan)
    again = Session.open(run_session(catalog.find_sample("mouse_walk.mcap"), plan, tmp_path))
    for name in ("frames", "poses", "rotations", "kinematics", "bouts"):
        assert getattr(again, name).equals(getattr(session, name)), name


@pytest.mark.nightly
def test_a_recording_without_an_animal_is_told_and_leaves_nothing(tmp_path: Path) -> None:
    empty = depth_frames(20, 160, 120)
    empty[:] = np.where(empty > 0, np.maximum(empty, 699), 0)
    path = write_mcap(
        tmp_path / "r.mcap", empty, liex_lab.Camera(120.0, 120.0, 79.5, 59.5, 160, 120)
    )
    with pytest.raises(LiexError, match="no animal"):
        run_session(path, out=tmp_path / "results")
    assert not (tmp_path / "results").exists()
