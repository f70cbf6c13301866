"""A human says where head and tail are exchanged: everything in the session follows, and nothing is
lost.
"""

from __future__ import annotations

import re
import shlex
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from liex_lab.pipelines.correct import corrected_track
from typer.testing import CliRunner

from liex_lab import cli
from liex_lab.api import correct_session, run_session
from liex_lab.behaviour.summary import measure_session
from liex_lab.errors import SessionError
from liex_lab.plan import Plan
from liex_lab.sessions import Session, correcting
from liex_lab.sessions.correcting import disagreements, flip_span
from liex_lab.sessions.corrections import FlipSpan, JointMove, Log, LogEntry
from liex_lab.sessions.evidence import skeleton_of, track_of

ADDRESS = "synthetic:walk?seed=3&frames=30&sensor=primesense-qvga&spine_mm=70"
SPAN = slice(9, 18)
FROM_S, TO_S = 0.3, 0.6


@pytest.fixture(scope="module")
def tracked(tmp_path_factory: pytest.TempPathFactory) -> Session:
    plan = Plan.load("mouse").with_settings(["animal.spine_mm=70"])
    return Session.open(run_session(ADDRESS, plan, tmp_path_factory.mktemp("tracked")))


@pytest.fixture(scope="module")
def flipped(tracked: Session, tmp_path_factory: pytest.TempPathFactory) -> Session:
    folder = Path(
        shutil.copytree(tracked.path, tmp_path_factory.mktemp("flipped") / tracked.path.name)
    )
    return Session.open(correct_session(folder, [flip_span(tracked, FROM_S, TO_S)]))


def along(session: Session) -> np.ndarray:
    """From rump to nose (n, 3)."""
    poses = session.poses.set_index("joint")[["x_mm", "y_mm", "z_mm"]]
    return poses.loc["nose"].to_numpy() - poses.loc["rump"].to_numpy()


def test_the_span_points_the_other_way_and_what_lies_far_from_it_stays(tracked, flipped):
    agree = np.sum(along(tracked) * along(flipped), axis=1)
    assert (agree[SPAN.start + 1 : SPAN.stop - 1] < 0).all()
    assert (agree[: SPAN.start - 3] > 0).all()
    assert (agree[SPAN.stop + 3 :] > 0).all()


def test_every_table_follows(tracked, flipped):
    middle = SPAN.start + 4
    turned = flipped.kinematics["heading_rad"][middle] - tracked.kinematics["heading_rad"][middle]
    assert abs(np.cos(turned) + 1.0) < 0.5
    assert not np.allclose(flipped.rotations["wz_rad"], tracked.rotations["wz_rad"], equal_nan=True)
    for name in ("plan", "camera", "input", "files"):
        assert flipped.metadata[name] == tracked.metadata[name]
    for name in ("frame_index", "time_ns", "gap_before"):
        pd.testing.assert_series_equal(flipped.frames[name], tracked.frames[name])
    (row,) = flipped.flips[flipped.flips["source"] == "human"].itertuples()
    assert (row.start_frame, row.stop_frame, row.applied) == (SPAN.start, SPAN.stop, True)


def test_only_the_frames_of_the_span_change_and_no_flag_does(tracked, flipped):
    was, now = (one.poses["x_mm"].to_numpy().reshape(30, -1) for one in (tracked, flipped))
    changed = np.flatnonzero((was != now).any(axis=1))
    assert changed.tolist() == list(range(SPAN.start, SPAN.stop))
    assert (np.sum(along(tracked) * along(flipped), axis=1)[SPAN] < 0).all()
    pd.testing.assert_series_equal(flipped.frames["flag"], tracked.frames["flag"])
    assert flipped.kinematics["heading_rad"].notna().all()


def test_nothing_is_measured_across_the_ends_of_an_exchange(tracked, flipped):
    for name in ("yaw_rate_rad_s", "speed_mm_s"):
        most = tracked.kinematics[name].abs().max()
        assert flipped.kinematics[name].abs().max() < 1.3 * most
    again = measure_session(flipped)
    pd.testing.assert_frame_equal(again.kinematics, flipped.kinematics)


def test_an_exchange_that_disagrees_names_its_half_turns_and_the_command_that_agrees(
    flipped, tmp_path
):
    (sentence,) = disagreements(flipped)
    assert re.search(
        r"turn of 1[5-8]\d degrees at frame 9 and 1[5-8]\d degrees at frame 18", sentence
    )
    folder = Path(shutil.copytree(flipped.path, tmp_path / "obeyed.liex"))
    commands = re.findall(r"`liex (.*?)`", sentence.replace(str(flipped.path), str(folder)))
    for command in commands:
        ran = CliRunner().invoke(cli.app, shlex.split(command))
        assert ran.exit_code == 0, ran.output
    obeyed = Session.open(folder)
    assert disagreements(obeyed) == []
    assert (np.sum(along(tracked_of(obeyed)) * along(obeyed), axis=1) < 0).all()


def tracked_of(session: Session) -> Session:
    return Session.open(session.path, raw=True)


def test_a_joint_placed_before_its_frame_was_exchanged_is_of_the_other_end(tracked, tmp_path):
    skeleton, row = skeleton_of(tracked), 12
    nose = track_of(tracked, skeleton).joints_mm[row, -1] + np.array([2.0, -2.0, 1.0])
    move = JointMove(row, "nose", *nose.tolist())
    flip = FlipSpan(SPAN.start, SPAN.stop)
    entries = [LogEntry(1, "", "", move), LogEntry(2, "", "", flip)]
    found = corrected_track(tracked, Log("", tuple(entries)), skeleton).track
    assert np.linalg.norm(found.joints_mm[row, 0] - nose) < 1.5, "its rump is there now"
    later = corrected_track(tracked, Log("", tuple(entries[::-1])), skeleton)
    assert np.linalg.norm(later.track.joints_mm[row, -1] - nose) < 20.0, "what was said last holds"


def test_frames_without_a_pose_cannot_be_exchanged(tracked, monkeypatch):
    monkeypatch.setattr(correcting, "_ahead", lambda session: np.full((30, 3), np.nan))
    with pytest.raises(SessionError, match="has a pose, so there is nothing to exchange"):
        flip_span(tracked, FROM_S, TO_S)


def test_what_was_measured_is_as_it_was_and_the_correction_can_be_taken_back(
    tracked, flipped, tmp_path
):
    folder = Path(shutil.copytree(flipped.path, tmp_path / flipped.path.name))
    pd.testing.assert_frame_equal(Session.open(folder, raw=True).poses, tracked.poses)
    assert (folder / "poses.parquet").read_bytes() == (tracked.path / "poses.parquet").read_bytes()
    again = Session.open(correct_session(folder, undo=[1]))
    pd.testing.assert_frame_equal(again.poses, tracked.poses)
    pd.testing.assert_frame_equal(again.bouts, tracked.bouts)


def test_a_session_without_what_its_frames_said_tells_what_to_do(tracked, tmp_path):
    folder = Path(shutil.copytree(tracked.path, tmp_path / "old.liex"))
    flip = flip_span(tracked, FROM_S, TO_S)
    (folder / "observations.npz").unlink()
    with pytest.raises(SessionError, match=r"run `liex run` on the recording again"):
        correct_session(folder, [flip])
    (folder / "observations.npz").write_bytes(b"PK not really")
    with pytest.raises(SessionError, match="damaged"):
        correct_session(folder, [flip])
    assert not (folder / "corrected").exists()
