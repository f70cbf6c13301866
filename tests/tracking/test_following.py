"""Frames around a pose that a person placed follow it as the smoother's own measurements would."""

from dataclasses import replace

import numpy as np
import pytest
from liex_lab.pipelines.correct import place_joints

from liex_lab.body.pose import Pose
from liex_lab.geometry import SE3
from liex_lab.sessions.corrections import JointMove
from liex_lab.tracking.smoother import TrackingParameters, _smoothed, let_follow, smooth
from liex_lab.tracking.track import Track
from tests.sessions.walking_mouse import WalkingMouse, steady

ROW = 60


def moved(track: Track, off_mm: tuple[float, float, float], follow: bool = True) -> np.ndarray:
    """The rows that change when the nose of one frame is put elsewhere."""
    was = Pose(
        SE3(track.root_rotation.copy(), track.root_mm.copy()), track.angles_rad.copy(), track.scale
    )
    place = track.joints_mm[ROW, -1] + off_mm
    mouse = WalkingMouse(steady(4.0))
    move = JointMove(ROW, track.skeleton.names[-1], *place)
    index = np.arange(len(track.times_ns))
    rows = place_joints(track, index, [move], mouse.camera, mouse.T_arena_camera)
    return let_follow(track, was, rows) if follow else rows


def jerk(track: Track) -> float:
    """The largest change of the nose's velocity from one frame to the next, mm/s."""
    nose = track.joints_mm[:, -1]
    return float(np.linalg.norm(np.diff(nose, 2, axis=0), axis=1).max() * 30.0)


@pytest.mark.parametrize("off", [(8.0, 8.0, 0.0), (0.0, 0.0, 15.0)])
def test_neighbours_follow_without_a_spike(off: tuple[float, float, float]) -> None:
    alone, together = (WalkingMouse(steady(4.0)).track() for _ in range(2))
    before = WalkingMouse(steady(4.0)).track()
    moved(alone, off, follow=False)
    rows = moved(together, off)
    assert jerk(together) < 0.62 * jerk(alone)
    np.testing.assert_array_equal(together.joints_mm[ROW], alone.joints_mm[ROW])  # as it was put
    away = np.linalg.norm(together.joints_mm - before.joints_mm, axis=-1)[:, -1]
    assert away[ROW + 1] > 0.3 * away[ROW]
    assert (np.diff(away[ROW : ROW + 4]) < 0).all()
    assert (np.diff(away[ROW - 3 : ROW + 1]) > 0).all()
    assert ROW not in rows
    assert away[: ROW - 40].max() < 0.2  # far off nothing moves
    assert away[ROW + 41 :].max() < 0.2
    far = np.setdiff1d(np.arange(len(away)), [*rows, ROW])
    np.testing.assert_array_equal(together.joints_mm[far], before.joints_mm[far])


def test_bones_keep_their_lengths_and_joints_their_limits() -> None:
    track = WalkingMouse(steady(4.0)).track()
    skeleton = track.skeleton
    rows = moved(track, (10.0, 15.0, 4.0))
    posed = Pose(track.root, track.angles_rad, track.scale).joints(skeleton)
    np.testing.assert_allclose(posed, track.joints_mm, atol=1e-6)
    low, high = skeleton.limits[..., 0], skeleton.limits[..., 1]
    assert (track.angles_rad[rows] >= low - 1e-9).all()
    assert (track.angles_rad[rows] <= high + 1e-9).all()


def test_a_gap_is_left_as_it_was_and_a_pose_beyond_it_hardly_moves() -> None:
    track = WalkingMouse(steady(4.0), lost=tuple(range(62, 100))).track()
    before = track.joints_mm.copy()
    rows = moved(track, (0.0, 12.0, 0.0))
    assert not set(rows) & set(range(62, 100))
    assert np.isnan(track.joints_mm[62:100]).all()
    assert np.linalg.norm(track.joints_mm[100:] - before[100:], axis=-1).max() < 6.0


def test_a_pose_that_was_put_where_it_was_moves_nothing() -> None:
    track = WalkingMouse(steady(4.0)).track()
    assert len(moved(track, (0.0, 0.0, 0.0))) == 0


def test_it_is_what_the_smoother_makes_of_one_measurement_more() -> None:
    """Without heavy tails: of poses that only shift sideways, smoothing with a measurement that is
    certain gives the curve without it, moved by `_smoothed`.
    """
    rng = np.random.default_rng(2)
    mouse = WalkingMouse(steady(4.0))
    track = mouse.track()
    n = len(track.times_ns)
    length = float(track.scale[0] * track.skeleton.length)
    usual = TrackingParameters.of("mouse").motion
    motion = replace(usual, degrees_of_freedom=1e12, gate=1e12, position_error=(0.5, 0.5, 0.5))
    error = 2.0 + rng.random(n)
    still = SE3(np.tile(np.eye(3), (n, 1, 1)), rng.normal(0.0, 2.0, (n, 3)))
    pose = Pose(still, np.zeros_like(track.angles_rad), track.scale)
    first = smooth(track.skeleton, mouse.times_s, pose, error, length, motion)
    off = np.zeros((n, 6 + pose.angles[0].size))
    off[ROW, :3] = (3.0, -5.0, 2.0)
    certain = error.copy()
    certain[ROW] = 1e-4
    place = pose.root.translation.copy()
    middle = first.joints.mean(axis=1)[ROW] - pose.joints(track.skeleton).mean(axis=1)[ROW]
    place[ROW] += middle + off[ROW, :3]
    placed = Pose(SE3(still.rotation, place), pose.angles, pose.scale)
    again = smooth(track.skeleton, mouse.times_s, placed, certain, length, motion)
    shifted = _smoothed(mouse.times_s, off, certain, length, motion)[:, :3]
    made = (again.joints - first.joints).mean(axis=1)
    np.testing.assert_allclose(shifted, made, atol=0.05)
    assert np.abs(made).max() > 4.9
