"""A recording in, a session out, whose every frame is accounted for and near the truth."""

import os
import shutil
from dataclasses import replace
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from liex_lab.pipelines import session as job
from liex_lab.pipelines.build import build_recording, session_bytes
from liex_lab.pipelines.doctor import examine
from liex_lab.pipelines.live import track_live

from liex_lab.errors import EstimationError, PlanError, SessionError
from liex_lab.optics.camera import unusual_centre
from liex_lab.plan import Plan
from liex_lab.recordings import open_recording
from liex_lab.recordings.recording import Recording
from liex_lab.recordings.streaming import Arrival, Arriving
from liex_lab.sessions import Session
from liex_lab.simulation.recording import FRAME_NS
from liex_lab.tracking.tracker import FrameTracker
from tests.pipelines.conftest import BLANK, KEPT, SPINE_MM, TIMES_NS, measure
from tests.pipelines.test_shards import InTurn
from tests.recordings.ros_writers import Info, write_bag
from tests.recordings.writers import START_NS, write_png_folder
from tests.sessions.test_checkpoint import tables_of

MOUSE = Plan.load("mouse")
TABLES = ("frames", "poses", "rotations", "kinematics", "bouts", "gaps", "flips")


def joints_of(session: Session) -> np.ndarray:
    """(n, J, 3) mm, arena frame."""
    return session.poses[["x_mm", "y_mm", "z_mm"]].to_numpy().reshape(len(session.frames), -1, 3)


def test_every_delivered_frame_is_a_row_and_none_is_lost_without_a_flag(walked):
    n, n_joints = len(KEPT), 5
    assert [entry.name for entry in walked.path.parent.iterdir()] == ["walk.liex"]
    assert len(walked.frames) == len(walked.kinematics) == n
    assert (len(walked.poses), len(walked.rotations)) == (n * n_joints, n * (n_joints + 1))
    assert walked.frames["frame_index"].tolist() == list(range(n))
    assert walked.frames["time_ns"].tolist() == TIMES_NS
    np.testing.assert_allclose(
        walked.frames["time_s"], (KEPT - KEPT[0]) * FRAME_NS * 1e-9, atol=1e-9
    )
    assert not np.isnan(joints_of(walked)).any()
    assert np.flatnonzero(walked.frames["bridged"]).tolist() == [BLANK]
    assert walked.frames["flag"][BLANK] == "no_depth"
    assert not walked.frames["flag"].drop(BLANK).isin(["no_depth", "not_found"]).any()
    assert np.isnan(walked.kinematics["speed_mm_s"][BLANK]), "what was bridged was not measured"


def test_what_the_plan_states_of_bridges_and_size_is_heeded(walk, tmp_path):
    plan = MOUSE.with_settings(["tracking.bridge_s=0.0", f"animal.spine_mm={SPINE_MM}"])
    session = Session.open(measure(walk, plan, tmp_path))
    assert np.flatnonzero(np.isnan(joints_of(session)).any(axis=(1, 2))).tolist() == [BLANK]
    assert not session.frames["bridged"].any()
    assert session.metadata["animal"]["spine_mm"] == SPINE_MM
    assert "plan" in session.metadata["animal"]["origin"]


def test_joints_size_and_floor_are_near_the_truth(walked, mouse):
    in_camera = walked.T_arena_camera.inverse() @ joints_of(walked)
    error = np.linalg.norm(in_camera - mouse.joints_camera[KEPT], axis=-1).mean(axis=1)
    assert np.nanmedian(error) < 6.0
    assert np.nanquantile(error, 0.9) < 12.0
    inside = np.linalg.norm(joints_of(walked) - mouse.joints_arena[KEPT], axis=-1).mean(axis=1)
    assert np.nanmedian(inside) < 7.0  # the arena frame itself is measured, too
    forward, true_forward = (
        joints[:, 4] - joints[:, 0] for joints in (in_camera, mouse.joints_camera[KEPT])
    )
    agreement = np.sum(forward * true_forward, axis=1)
    assert (agreement[np.isfinite(agreement)] > 0).all()
    assert walked.metadata["animal"]["spine_mm"] == pytest.approx(SPINE_MM, rel=0.12)
    assert np.nanmedian(walked.frames["spine_mm"]) == pytest.approx(SPINE_MM, rel=0.12)
    assert walked.metadata["camera"]["floor_distance_mm"] == pytest.approx(
        mouse.floor.distance_mm, abs=5.0
    )
    assert np.nanmedian(walked.frames["residual_mm"]) < 5.0
    assert walked.arena.kind in ("round", "rectangular", "open")
    if walked.arena.kind != "open":
        assert walked.arena.edge == "wall"
        assert walked.frames["wall_distance_mm"].dropna().between(-5.0, 1000.0).all()


def test_gaps_are_kept(walked):
    dropped = walked.gaps[walked.gaps["reason"] == "camera_dropped"]
    assert dropped["n_frames_missing"].tolist() == [2, 1]
    assert dropped["start_frame"].tolist() == [15, 29]
    np.testing.assert_allclose(
        dropped["stop_s"], [17 * FRAME_NS * 1e-9, 32 * FRAME_NS * 1e-9], atol=1e-9
    )
    blank = walked.gaps[walked.gaps["reason"] == "no_depth"]
    assert blank[["start_frame", "stop_frame", "n_frames_missing"]].to_numpy().tolist() == [
        [BLANK, BLANK + 1, 1]
    ]
    assert walked.frames["gap_before"][[15, 29]].tolist() == [2, 1]
    assert walked.frames["gap_before"].sum() == 3


@pytest.mark.nightly
def test_tables_depend_neither_on_frames_in_memory_nor_on_who_opens_the_recording(
    walked, mouse, images, tmp_path, monkeypatch
):
    monkeypatch.setattr(job, "CHUNK", 7)
    opened = Recording(
        name="walk",
        format="images",
        camera=mouse.camera,
        times_ns=np.array(TIMES_NS),
        read=lambda k: images[k].astype(np.float32),
    )
    again = Session.open(measure(opened, None, tmp_path / "opened"))
    for name in TABLES:
        pd.testing.assert_frame_equal(again.table(name), walked.table(name))


def test_an_error_midway_leaves_no_folder_and_an_older_session_as_it_was(
    walked, walk, tmp_path, monkeypatch
):
    path = shutil.copytree(walked.path, tmp_path / "walk.liex")
    observe, calls = FrameTracker.observe, count()

    def once(self, frames):
        return observe(self, frames) if next(calls) == 0 else 1 / 0

    monkeypatch.setattr(FrameTracker, "observe", once)
    with pytest.raises(ZeroDivisionError):
        measure(walk, MOUSE, tmp_path, overwrite=True)
    assert tables_of(path) == tables_of(walked.path)
    assert [entry.name for entry in tmp_path.iterdir()] == ["walk.liex"]


def test_an_older_session_is_replaced_only_on_demand_and_that_is_refused_at_once(
    walked, walk, monkeypatch
):
    monkeypatch.setattr(
        job, "fit_plan", lambda *_, **__: pytest.fail("minutes of work before the refusal")
    )
    with pytest.raises(SessionError, match="overwrite"):
        measure(walk, MOUSE, walked.path.parent)


@pytest.mark.nightly
def test_a_recording_without_an_animal_is_refused_and_leaves_nothing(mouse, tmp_path):
    rng = np.random.default_rng(1)
    bare = mouse.floor.depth(mouse.width, mouse.height) + rng.normal(
        0, 1, (12, mouse.height, mouse.width)
    )
    folder = write_png_folder(tmp_path / "bare", bare.astype(np.uint16), mouse.camera)
    with pytest.raises(EstimationError, match="no animal was found") as error:
        measure(folder, MOUSE, tmp_path / "out")
    assert "\n" not in str(error.value)
    assert not list((tmp_path / "out").glob("*"))


@pytest.mark.nightly
def test_zones_are_drawn_in_a_file_that_the_plan_names(walk, walked, tmp_path):
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
    plan = MOUSE.with_settings([f"arena.zones={drawn}"])
    again = Session.open(measure(walk, plan, tmp_path))
    x = again.frames["centroid_x_mm"]
    expected = np.where(x.isna(), "", np.where(x < 0, "west", "east"))
    assert again.frames["zone"].tolist() == expected.tolist()
    row = again.summary.iloc[0]
    assert row["zone_west_s"] + row["zone_east_s"] == pytest.approx(row["observed_s"])
    pd.testing.assert_frame_equal(
        again.frames.drop(columns="zone"), walked.frames.drop(columns="zone")
    )


def test_an_error_in_the_zones_is_raised_before_any_work(walk, tmp_path, monkeypatch):
    learn = "liex_lab.scene.learning.learn_scene"
    monkeypatch.setattr(learn, lambda *_: pytest.fail("work was begun"))
    plan = MOUSE.with_settings([f"arena.zones={tmp_path / 'none.toml'}"])
    with pytest.raises(PlanError, match=r"there is no file .*none\.toml"):
        measure(walk, plan, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_calibration_of_another_lens_is_a_reason_until_the_right_one_is_stated(
    mouse, images, tmp_path
):
    right = mouse.camera
    wrong = Info(replace(right, fx=309.0, fy=309.0, cx=85.0), "/camera/color/camera_info", "colour")
    path = write_bag(
        tmp_path / "walk.bag",
        images,
        camera=right,
        times_ns=TIMES_NS,
        frame_id="depth",
        infos=[wrong],
    )
    plan = MOUSE.with_settings(["replay.depth=none"])
    found = Session.open(measure(path, plan, tmp_path / "out")).metadata
    (reason,) = found["verdict"]["reasons"]
    assert reason.startswith("the calibration is that of another lens (frame colour")
    assert reason in found["problems"]
    assert "the principal point (85.0, 119.5)" in found["verdict"]["cautions"][0]
    numbers = [f"camera.{name}={getattr(right, name)}" for name in ("fx", "fy", "cx", "cy")]
    with build_recording(path, plan.with_settings(numbers)) as opened:
        assert not [*opened.doubts, *opened.problems]
        assert unusual_centre(opened.camera) == ("", False)


@pytest.mark.nightly
def test_a_frame_written_during_the_run_needs_review_and_a_name_need_not_be_text(walk, tmp_path):
    copy = shutil.copytree(walk, tmp_path / os.fsdecode(b"\xff\xfe day one"))
    written = count(1)

    def progress(done: int, total: int | None, what: str) -> None:
        os.utime(next(copy.glob("*.png")), ns=(0, 10**9 * next(written)))

    plan = MOUSE.with_settings(["replay.depth=none"])
    session = Session.open(measure(copy, plan, tmp_path / "out", progress=progress))
    verdict = session.metadata["verdict"]
    assert verdict["look_at_it"]
    assert any(".png changed while the recording was measured" in r for r in verdict["reasons"])
    assert len(session.poses)
    assert "day one" in session.metadata["input"]["path"]


def test_the_disk_space_of_a_session_is_known_to_a_factor_of_two(walk, walked):
    size = sum(path.stat().st_size for path in walked.path.rglob("*") if path.is_file())
    with open_recording(walk) as recording:
        expected = session_bytes(
            recording,
            MOUSE,
            walked.metadata["animal"]["spine_mm"],
            walked.metadata["camera"]["floor_distance_mm"],
        )
    assert 0.5 < expected / size < 2.0


# A stream that freezes while its stamps go on is a gap, however the recording is measured.


FROZEN = slice(4, 13)  # across the border of two shards


@pytest.fixture(scope="module")
def frozen(mouse: Any, images: np.ndarray, tmp_path_factory: Any) -> Path:
    depths = images.copy()
    depths[FROZEN] = depths[FROZEN.start - 1]
    folder = tmp_path_factory.mktemp("recording") / "frozen"
    return write_png_folder(folder, depths, mouse.camera, TIMES_NS)


@pytest.fixture(scope="module")
def frozen_session(frozen: Path, tmp_path_factory: Any) -> Session:
    return Session.open(measure(frozen, MOUSE, tmp_path_factory.mktemp("alone")))


def test_frozen_frames_have_no_pose_and_are_a_gap_that_is_reported(frozen_session: Session) -> None:
    flagged = frozen_session.frames["flag"] == "repeated"
    assert np.flatnonzero(flagged).tolist() == [*range(FROZEN.start, FROZEN.stop)]
    assert frozen_session.kinematics.loc[flagged, ["x_mm", "speed_mm_s"]].isna().all(axis=None)
    assert frozen_session.frames.loc[flagged, "spine_mm"].isna().all()
    assert not frozen_session.frames.loc[flagged, "bridged"].any()
    assert frozen_session.frames.loc[~flagged, "spine_mm"].notna().all()
    gap = frozen_session.gaps[frozen_session.gaps["reason"] == "repeated"]
    assert gap[["start_frame", "stop_frame"]].to_numpy().tolist() == [[FROZEN.start, FROZEN.stop]]
    verdict = frozen_session.metadata["verdict"]
    assert verdict["look_at_it"]
    assert (
        "the stream froze: the depth image of the frame before repeats in 9 of 40"
        in verdict["sentence"]
    )


@pytest.mark.nightly
def test_the_tables_do_not_depend_on_how_the_recording_is_cut(
    frozen_session: Session, frozen: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(job, "LENGTH", 8)
    with pytest.raises(Exception, match="without a word"):
        measure(frozen, MOUSE, tmp_path, pool=InTurn(accident_after=3))
    monkeypatch.setattr(job, "CHUNK", 5)
    again = measure(frozen, MOUSE, tmp_path)
    assert tables_of(again) == tables_of(frozen_session.path)


@pytest.mark.nightly
def test_a_live_recording_that_freezes_is_flagged_alike(
    frozen: Path, frozen_session: Session
) -> None:
    with open_recording(frozen) as opened:
        arriving = Arriving(
            "frozen",
            opened.camera,
            (Arrival(opened.frame(row), 0.0) for row in range(len(opened))),
        )
        _, tracked = track_live(arriving, MOUSE, learn_frames=len(opened))
    assert (
        (tracked.track.flag == "repeated") == (frozen_session.frames["flag"] == "repeated")
    ).all()


def test_doctor_reports_when_it_froze_and_for_how_long(frozen: Path) -> None:
    told = [one for one in examine(frozen)["problems"] if "froze" in one]
    assert told == [
        "the stream froze: the depth image of the frame before repeats in 9 of 40 frames, 0.30 s "
        "in all, the longest time for 0.30 s from 0.13 s on; nothing is measured there"
    ]


@pytest.mark.nightly
def test_images_written_twice_count_once_and_nothing_else_changes(
    mouse: Any,
    images: np.ndarray,
    tmp_path: Path,
) -> None:
    depths = np.delete(images, 28, axis=0)[:30]
    times = START_NS + FRAME_NS * np.arange(len(depths))
    once = write_png_folder(tmp_path / "once", depths, mouse.camera, times.tolist())
    polled = np.sort(np.concatenate([times, times + FRAME_NS // 2]))
    twice = write_png_folder(
        tmp_path / "twice", np.repeat(depths, 2, 0), mouse.camera, polled.tolist()
    )
    right, found = (Session.open(measure(one, MOUSE, tmp_path)) for one in (once, twice))
    assert (found.frames["flag"][1::2] == "repeated").all()
    assert not (found.frames["flag"][::2] == "repeated").any()
    verdict = found.metadata["verdict"]
    assert any(
        "there twice: the camera made 30.00 frames/s, not 60.00" in one
        for one in verdict["cautions"]
    )
    assert not verdict["look_at_it"]
    assert verdict["expected_error_mm"] > 0.95 * right.metadata["verdict"]["expected_error_mm"]
    for name, within in (("distance_m", 0.05), ("observed_s", 0.02), ("mean_speed_mm_s", 0.05)):
        assert found.summary[name][0] == pytest.approx(right.summary[name][0], rel=within)
    assert found.summary["max_speed_mm_s"][0] < 1.1 * right.summary["max_speed_mm_s"][0]
    # a frame in which no animal is found takes its copy and the one before along
    assert found.gaps["n_frames_missing"].sum() <= 3 * right.gaps["n_frames_missing"].sum()
