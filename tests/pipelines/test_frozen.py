"""A stream that freezes while its stamps go on is a gap, however the recording is measured."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from liex_lab.pipelines import session as job
from liex_lab.pipelines import shards
from liex_lab.pipelines.doctor import examine
from liex_lab.pipelines.live import follow_live

from liex_lab.api import run_session
from liex_lab.plan import Plan
from liex_lab.recordings import open_recording
from liex_lab.recordings.streaming import Arrival, Arriving
from liex_lab.sessions import Session
from tests.pipelines.test_session import FRAME_NS, KEPT, mouse, pictures, times_ns  # noqa: F401
from tests.pipelines.test_shards import InTurn
from tests.recordings.writers import START_NS, write_png_folder
from tests.sessions.test_checkpoint import tables_of

FROZEN = slice(4, 13)  # across the border of two shards


@pytest.fixture(scope="module")
def frozen(mouse: Any, pictures: np.ndarray, times_ns: list[int], tmp_path_factory: Any) -> Path:  # noqa: F811
    depths = pictures.copy()
    depths[FROZEN] = depths[FROZEN.start - 1]
    folder = tmp_path_factory.mktemp("recording") / "frozen"
    return write_png_folder(folder, depths, mouse.camera, times_ns)


@pytest.fixture(scope="module")
def session(frozen: Path, tmp_path_factory: Any) -> Session:
    return Session.open(run_session(frozen, Plan.load("mouse"), tmp_path_factory.mktemp("alone")))


def test_frozen_frames_have_no_pose_and_are_a_gap_that_is_reported(session: Session) -> None:
    flagged = session.frames["flag"] == "repeated"
    assert np.flatnonzero(flagged).tolist() == [*range(FROZEN.start, FROZEN.stop)]
    assert session.kinematics.loc[flagged, ["x_mm", "speed_mm_s"]].isna().all(axis=None)
    assert session.frames.loc[flagged, "spine_mm"].isna().all()
    assert not session.frames.loc[flagged, "bridged"].any()
    assert session.frames.loc[~flagged, "spine_mm"].notna().all()
    gap = session.gaps[session.gaps["reason"] == "repeated"]
    assert gap[["start_frame", "stop_frame"]].to_numpy().tolist() == [[FROZEN.start, FROZEN.stop]]
    verdict = session.metadata["verdict"]
    assert verdict["look_at_it"]
    assert (
        "the stream froze: the depth image of the frame before repeats in 9 of 40"
        in verdict["sentence"]
    )


def test_it_ends_without_a_leap(session: Session, mouse: Any) -> None:  # noqa: F811
    centre = mouse.joints_arena[KEPT].mean(axis=1)[:, :2]
    true = np.linalg.norm(np.diff(centre, axis=0), axis=1).max() * 1e9 / FRAME_NS
    leap = np.linalg.norm(centre[FROZEN.stop] - centre[FROZEN.start - 1]) * 1e9 / FRAME_NS
    assert session.kinematics["speed_mm_s"].max() < 1.3 * true < 0.5 * leap


@pytest.mark.parametrize("how", ["shards", "shards after an accident", "chunks of 5"])
def test_the_tables_do_not_depend_on_how_the_recording_is_cut(
    how: str, session: Session, frozen: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pool = None
    if how == "chunks of 5":
        monkeypatch.setattr(job, "CHUNK", 5)
    else:
        monkeypatch.setattr(shards, "LENGTH", 8)
        monkeypatch.setattr(job, "LENGTH", 8)
        pool = InTurn()
    if how == "shards after an accident":
        with pytest.raises(Exception, match="without a word"):
            run_session(frozen, Plan.load("mouse"), tmp_path, pool=InTurn(accident_after=3))
    again = run_session(frozen, Plan.load("mouse"), tmp_path, pool=pool)
    assert tables_of(again) == tables_of(session.path)


def test_a_live_recording_that_freezes_is_flagged_alike(frozen: Path, session: Session) -> None:
    with open_recording(frozen) as opened:
        arriving = Arriving(
            "frozen",
            opened.camera,
            (Arrival(opened.frame(row), 0.0) for row in range(len(opened))),
        )
        _, tracked = follow_live(arriving, Plan.load("mouse"), learn_frames=len(opened))
    assert ((tracked.track.flag == "repeated") == (session.frames["flag"] == "repeated")).all()


def test_doctor_reports_when_it_froze_and_for_how_long(frozen: Path) -> None:
    told = [one for one in examine(frozen)["problems"] if "froze" in one]
    assert told == [
        "the stream froze: the depth image of the frame before repeats in 9 of 40 frames, 0.30 s "
        "in all, the longest time for 0.30 s from 0.13 s on; nothing is measured there"
    ]


def test_images_written_twice_count_once_and_nothing_else_changes(
    mouse: Any,  # noqa: F811
    pictures: np.ndarray,  # noqa: F811
    tmp_path: Path,
) -> None:
    depths = np.delete(pictures, 28, axis=0)[:30]
    times = START_NS + FRAME_NS * np.arange(len(depths))
    once = write_png_folder(tmp_path / "once", depths, mouse.camera, times.tolist())
    polled = np.sort(np.concatenate([times, times + FRAME_NS // 2]))
    twice = write_png_folder(
        tmp_path / "twice", np.repeat(depths, 2, 0), mouse.camera, polled.tolist()
    )
    right, found = (
        Session.open(run_session(one, Plan.load("mouse"), tmp_path)) for one in (once, twice)
    )
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
