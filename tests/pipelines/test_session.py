"""`run_session`: a folder of pictures in, a session out, whose every frame is accounted for and
near the truth.
"""

from __future__ import annotations

import os
import shutil
from dataclasses import replace
from itertools import count

import numpy as np
import pandas as pd
import pytest
from liex_lab.pipelines import session as job
from liex_lab.pipelines.origin import session_bytes

from liex_lab.api import run_session
from liex_lab.errors import EstimationError, PlanError, SessionError
from liex_lab.plan import Plan
from liex_lab.recordings import open_recording
from liex_lab.recordings.frame import DepthFrame
from liex_lab.recordings.recording import Recording
from liex_lab.sessions import Session
from liex_lab.simulation.locomotion import walking_session
from liex_lab.simulation.recording import FRAME_NS, SyntheticSession
from liex_lab.simulation.species import PRIMESENSE_QVGA_SENSOR
from liex_lab.tracking.observations import Observations
from liex_lab.tracking.tracker import FrameTracker
from tests.recordings.ros_writers import Info, write_bag
from tests.recordings.writers import START_NS, write_png_folder

SPINE_MM, N_RENDERED = 65.0, 43
DROPPED = [15, 16, 31]  # frames that the camera did not deliver
KEPT = np.delete(np.arange(N_RENDERED), DROPPED)
BLANK = 28  # row of the recording in which the camera saw nothing at all
TABLES = ("frames", "poses", "rotations", "kinematics", "bouts", "gaps", "flips")


@pytest.fixture(scope="module")
def mouse() -> SyntheticSession:
    return walking_session(9, N_RENDERED, sensor=PRIMESENSE_QVGA_SENSOR, spine_mm=SPINE_MM)


@pytest.fixture(scope="module")
def pictures(mouse: SyntheticSession) -> np.ndarray:
    """What the camera delivered (n, H, W) uint16."""
    depths = mouse.depths(0, N_RENDERED)[KEPT].astype(np.uint16)
    depths[BLANK] = 0
    return depths


@pytest.fixture(scope="module")
def times_ns() -> list[int]:
    return [START_NS + FRAME_NS * int(k) for k in KEPT]


@pytest.fixture(scope="module")
def folder(mouse, pictures, times_ns, tmp_path_factory):
    return write_png_folder(
        tmp_path_factory.mktemp("recording") / "walk", pictures, mouse.camera, times_ns
    )


@pytest.fixture(scope="module")
def session(folder, tmp_path_factory) -> Session:
    out = tmp_path_factory.mktemp("sessions")
    path = run_session(folder, Plan.load("mouse"), out)
    assert path == out / "walk.liex"
    assert [entry.name for entry in out.iterdir()] == ["walk.liex"]
    return Session.open(path)


def joints_of(session: Session) -> np.ndarray:
    """(n, J, 3) mm, arena frame."""
    return session.poses[["x_mm", "y_mm", "z_mm"]].to_numpy().reshape(len(session.frames), -1, 3)


def tables_of(session: Session) -> dict[str, bytes]:
    return {name: (session.path / f"{name}.parquet").read_bytes() for name in TABLES}


def test_every_delivered_frame_is_a_row_of_every_table(session, times_ns):
    n, n_joints = len(KEPT), 5
    assert len(session.frames) == len(session.kinematics) == n
    assert (len(session.poses), len(session.rotations)) == (n * n_joints, n * (n_joints + 1))
    assert session.frames["frame_index"].tolist() == list(range(n))
    assert session.frames["time_ns"].tolist() == times_ns
    np.testing.assert_allclose(
        session.frames["time_s"], (KEPT - KEPT[0]) * FRAME_NS * 1e-9, atol=1e-9
    )


def test_no_frame_is_lost_without_a_flag(session):
    lost = np.isnan(joints_of(session)).any(axis=(1, 2))
    assert not lost.any()
    assert np.flatnonzero(session.frames["bridged"]).tolist() == [BLANK]
    assert session.frames["flag"][BLANK] == "no_depth"
    assert not session.frames["flag"].drop(BLANK).isin(["no_depth", "not_found"]).any()
    assert np.isnan(session.kinematics["speed_mm_s"][BLANK]), "what was bridged was not measured"


def test_nothing_is_bridged_where_the_plan_forbids_it(folder, tmp_path):
    plan = Plan.load("mouse").with_settings(["tracking.bridge_s=0.0"])
    session = Session.open(run_session(folder, plan, tmp_path))
    assert np.flatnonzero(np.isnan(joints_of(session)).any(axis=(1, 2))).tolist() == [BLANK]
    assert not session.frames["bridged"].any()


def test_joints_are_near_the_truth(session, mouse):
    in_camera = session.T_arena_camera.inverse() @ joints_of(session)
    error = np.linalg.norm(in_camera - mouse.joints_camera[KEPT], axis=-1).mean(axis=1)
    assert np.nanmedian(error) < 6.0
    assert np.nanquantile(error, 0.9) < 12.0
    inside = np.linalg.norm(joints_of(session) - mouse.joints_arena[KEPT], axis=-1).mean(axis=1)
    assert np.nanmedian(inside) < 7.0  # the arena frame itself is measured, too
    forward, true_forward = (
        joints[:, 4] - joints[:, 0] for joints in (in_camera, mouse.joints_camera[KEPT])
    )
    agreement = np.sum(forward * true_forward, axis=1)
    assert (agreement[np.isfinite(agreement)] > 0).all()


def test_the_animals_size_and_the_floor_are_measured(session, mouse):
    animal = session.metadata["animal"]
    assert animal["spine_mm"] == pytest.approx(SPINE_MM, rel=0.12)
    assert np.nanmedian(session.frames["spine_mm"]) == pytest.approx(SPINE_MM, rel=0.12)
    assert session.metadata["camera"]["floor_distance_mm"] == pytest.approx(
        mouse.floor.distance_mm, abs=5.0
    )
    assert np.nanmedian(session.frames["residual_mm"]) < 5.0


def test_gaps_are_kept(session):
    dropped = session.gaps[session.gaps["reason"] == "camera_dropped"]
    assert dropped["n_frames_missing"].tolist() == [2, 1]
    assert dropped["start_frame"].tolist() == [15, 29]
    np.testing.assert_allclose(
        dropped["stop_s"], [17 * FRAME_NS * 1e-9, 32 * FRAME_NS * 1e-9], atol=1e-9
    )
    blank = session.gaps[session.gaps["reason"] == "no_depth"]
    assert blank[["start_frame", "stop_frame", "n_frames_missing"]].to_numpy().tolist() == [
        [BLANK, BLANK + 1, 1]
    ]
    assert session.frames["gap_before"][[15, 29]].tolist() == [2, 1]
    assert session.frames["gap_before"].sum() == 3


def test_running_again_gives_the_same_tables_byte_for_byte(session, folder, tmp_path):
    assert tables_of(Session.open(run_session(folder, Plan.load("mouse"), tmp_path))) == tables_of(
        session
    )


@pytest.mark.parametrize("chunk", [7])
def test_tables_do_not_depend_on_how_many_frames_are_in_memory(
    session, folder, tmp_path, monkeypatch, chunk
):
    monkeypatch.setattr(job, "CHUNK", chunk)
    assert tables_of(Session.open(run_session(folder, Plan.load("mouse"), tmp_path))) == tables_of(
        session
    )


def test_the_same_frames_give_the_same_poses_from_a_recording_that_is_open_already(
    session, mouse, pictures, times_ns, tmp_path
):
    opened = Recording(
        name="walk",
        format="images",
        camera=mouse.camera,
        times_ns=np.array(times_ns),
        read=lambda k: pictures[k].astype(np.float32),
    )
    again = Session.open(run_session(opened, out=tmp_path))
    for name in TABLES:
        pd.testing.assert_frame_equal(again.table(name), session.table(name))


def test_a_size_that_the_plan_states_is_taken_as_it_is(folder, tmp_path):
    plan = Plan.load("mouse").with_settings([f"animal.spine_mm={SPINE_MM}"])
    animal = Session.open(run_session(folder, plan, tmp_path)).metadata["animal"]
    assert animal["spine_mm"] == SPINE_MM
    assert "plan" in animal["origin"]


def test_an_accident_midway_leaves_no_folder(folder, tmp_path, monkeypatch):
    observe, calls = FrameTracker.observe, []

    def once(self: FrameTracker, frames: list[DepthFrame]) -> Observations:
        calls.append(len(frames))
        if len(calls) == 2:
            raise RuntimeError("the power went out")
        return observe(self, frames)

    monkeypatch.setattr(FrameTracker, "observe", once)
    with pytest.raises(RuntimeError, match="the power went out"):
        run_session(folder, Plan.load("mouse"), tmp_path / "out")
    assert calls == [32, 8]
    assert not list((tmp_path / "out").glob("*"))


def test_an_accident_midway_leaves_an_older_session_as_it_was(
    session, folder, tmp_path, monkeypatch
):
    path = shutil.copytree(session.path, tmp_path / "walk.liex")
    monkeypatch.setattr(FrameTracker, "observe", lambda self, frames: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        run_session(folder, Plan.load("mouse"), tmp_path, overwrite=True)
    assert tables_of(Session.open(path)) == tables_of(session)
    assert [entry.name for entry in tmp_path.iterdir()] == ["walk.liex"]


def test_an_older_session_is_replaced_only_on_demand_and_that_is_said_at_once(
    session, folder, monkeypatch
):
    monkeypatch.setattr(
        job, "fit_plan", lambda *_, **__: pytest.fail("minutes of work before the refusal")
    )
    with pytest.raises(SessionError, match="overwrite"):
        run_session(folder, Plan.load("mouse"), session.path.parent)


def test_a_recording_without_an_animal_is_refused_and_leaves_nothing(mouse, tmp_path):
    rng = np.random.default_rng(1)
    bare = mouse.floor.depth(mouse.width, mouse.height) + rng.normal(
        0, 1, (12, mouse.height, mouse.width)
    )
    folder = write_png_folder(tmp_path / "bare", bare.astype(np.uint16), mouse.camera)
    with pytest.raises(EstimationError, match="no animal was found") as error:
        run_session(folder, Plan.load("mouse"), tmp_path / "out")
    assert "\n" not in str(error.value)
    assert not list((tmp_path / "out").glob("*"))


def test_zones_are_drawn_in_a_file_that_the_plan_names(folder, session, tmp_path):
    """Left and right of the arena's middle: every frame is in one of them, and together they take
    all the time.
    """
    drawn = tmp_path / "zones.toml"
    drawn.write_text("""
        [[zones]]
        name = "west"
        polygon = [[-2000, -2000], [0, -2000], [0, 2000], [-2000, 2000]]
        [[zones]]
        name = "east"
        polygon = [[0, -2000], [2000, -2000], [2000, 2000], [0, 2000]]
    """)
    again = Session.open(
        run_session(folder, Plan.load("mouse").with_settings([f"arena.zones={drawn}"]), tmp_path)
    )
    x = again.frames["centroid_x_mm"]
    expected = np.where(x.isna(), "", np.where(x < 0, "west", "east"))
    assert again.frames["zone"].tolist() == expected.tolist()
    row = again.summary.iloc[0]
    assert row["zone_west_s"] + row["zone_east_s"] == pytest.approx(row["observed_s"])
    pd.testing.assert_frame_equal(
        again.frames.drop(columns="zone"), session.frames.drop(columns="zone")
    )


def test_a_slip_in_the_zones_is_told_before_any_work(folder, tmp_path, monkeypatch):
    learn = "liex_lab.scene.learning.learn_scene"
    monkeypatch.setattr(learn, lambda *_: pytest.fail("work was begun"))
    plan = Plan.load("mouse").with_settings([f"arena.zones={tmp_path / 'none.toml'}"])
    with pytest.raises(PlanError, match=r"there is no file .*none\.toml"):
        run_session(folder, plan, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_the_shape_of_the_arena_is_found(session, mouse):
    arena = session.arena
    assert arena.kind in ("round", "rectangular", "open")
    if arena.kind != "open":
        assert arena.edge == "wall"
        assert session.frames["wall_distance_mm"].dropna().between(-5.0, 1000.0).all()


def test_a_calibration_of_another_lens_is_a_reason_until_the_right_one_is_stated(
    mouse, pictures, times_ns, tmp_path
):
    right = mouse.camera
    wrong = Info(replace(right, fx=309.0, fy=309.0, cx=85.0), "/camera/color/camera_info", "colour")
    path = write_bag(
        tmp_path / "walk.bag",
        pictures,
        camera=right,
        times_ns=times_ns,
        frame_id="depth",
        infos=[wrong],
    )
    plan = Plan.load("mouse").with_settings(["replay.depth=none"])
    made = run_session(path, plan, tmp_path / "wrong.liex")
    found = Session.open(made).metadata
    (reason,) = found["verdict"]["reasons"]
    assert reason.startswith("the calibration is that of another lens (frame colour")
    assert reason in found["problems"]
    assert "the principal point (85.0, 119.5)" in found["verdict"]["cautions"][0]
    numbers = [f"camera.{name}={getattr(right, name)}" for name in ("fx", "fy", "cx", "cy")]
    made = run_session(path, plan.with_settings(numbers), tmp_path / "right.liex")
    verdict = Session.open(made).metadata["verdict"]
    assert (verdict["reasons"], verdict["cautions"]) == ([], [])


def test_a_picture_that_is_written_to_during_the_run_is_a_reason_to_look_at_it(folder, tmp_path):
    copy = shutil.copytree(folder, tmp_path / "walk")

    written = count(1)

    def progress(done: int, total: int | None, what: str) -> None:
        os.utime(next(copy.glob("*.png")), ns=(0, 10**9 * next(written)))

    made = run_session(
        copy, Plan.load("mouse").with_settings(["replay.depth=none"]), tmp_path, progress=progress
    )
    verdict = Session.open(made).metadata["verdict"]
    assert verdict["look_at_it"]
    assert any(".png changed while the recording was measured" in r for r in verdict["reasons"])


def test_a_recording_whose_name_is_no_text_is_measured_all_the_same(folder, tmp_path):
    named = tmp_path / os.fsdecode(b"\xff\xfe day one")
    shutil.copytree(folder, named)
    made = run_session(
        named, Plan.load("mouse").with_settings(["replay.depth=none"]), tmp_path / "out"
    )
    session = Session.open(made)
    assert len(session.poses)
    assert "day one" in session.metadata["input"]["path"]


def test_the_room_that_a_session_takes_is_known_to_a_factor_of_two(folder, session):
    size = sum(path.stat().st_size for path in session.path.rglob("*") if path.is_file())
    with open_recording(folder) as recording:
        told = session_bytes(
            recording,
            Plan.load("mouse"),
            session.metadata["animal"]["spine_mm"],
            session.metadata["camera"]["floor_distance_mm"],
        )
    assert 0.5 < told / size < 2.0
