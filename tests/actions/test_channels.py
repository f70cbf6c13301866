"""Channels are seconds and body lengths whatever the camera's rate, and gaps part them."""

from pathlib import Path

import numpy as np
import pytest

from liex_lab.actions.channels import channel_names, segments_of, window_features
from liex_lab.actions.learning import position_descriptor, tangent_descriptor
from liex_lab.body.skeleton import Skeleton
from liex_lab.geometry import SE3, so3
from liex_lab.runtime.memory import on_disk
from liex_lab.tracking.track import Track
from tests.actions.toy import straight_track

RATES = (15.0, 30.0, 50.0, 100.0, 120.0)


@pytest.mark.parametrize("animal", ["fish", "mouse"])
@pytest.mark.parametrize("rate_hz", RATES)
def test_speed_and_turning_are_the_same_at_every_frame_rate(animal: str, rate_hz: float) -> None:
    clock, length = np.arange(0.0, 4.0, 1.0 / rate_hz), Skeleton.load(animal).length
    track = straight_track(animal, clock, 2.0 * length * clock, 0.5 * clock)
    names = channel_names(track.skeleton)
    (segment,) = segments_of(track, 50.0)
    middle = segment.values[20:-20]
    assert segment.values.shape[1] == len(names)
    assert np.median(middle[:, names.index("forward")]) == pytest.approx(2.0, rel=0.02)
    assert np.median(middle[:, names.index("yaw_rate~")]) == pytest.approx(0.5, rel=0.02)
    assert np.ptp(middle[:, names.index("straightness")]) < 0.01


def test_a_long_gap_parts_the_track_and_a_short_one_is_bridged() -> None:
    clock = np.arange(0.0, 6.0, 1.0 / 30.0)
    track = straight_track("mouse", clock, 100.0 * clock)
    track.joints_mm[60:66] = np.nan
    assert len(segments_of(track, 30.0)) == 1
    track.joints_mm[100:130] = np.nan
    first, second = segments_of(track, 30.0)
    assert first.times_s[-1] < 100 / 30.0
    assert second.times_s[0] >= 130 / 30.0 - 1e-9


def test_a_body_that_points_backwards_for_a_moment_is_left_out() -> None:
    clock = np.arange(0.0, 4.0, 1.0 / 30.0)
    track = straight_track("mouse", clock, 100.0 * clock)
    column = channel_names(track.skeleton).index("yaw_rate~")
    track.joints_mm[50] = track.joints_mm[50, ::-1].copy()
    assert np.abs(segments_of(track, 30.0)[0].values[:, column]).max() < 0.1


def test_a_camera_that_errs_more_throughout_changes_no_channel() -> None:
    clock = np.arange(0.0, 4.0, 1.0 / 30.0)
    track = straight_track("mouse", clock, 100.0 * clock)
    track.predicted_error_mm[:] = np.random.default_rng(3).uniform(1.0, 4.0, track.n_frames)
    values = segments_of(track, 30.0)[0].values.copy()
    track.predicted_error_mm[:] *= 2.5
    np.testing.assert_allclose(segments_of(track, 30.0)[0].values, values, atol=1e-9)
    assert np.ptp(values[:, channel_names(track.skeleton).index("doubt")]) > 0.5


def test_no_pose_at_all_gives_no_stretch() -> None:
    assert segments_of(Track.empty(Skeleton.load("mouse"), np.arange(9) * 10**7), 30.0) == []


def test_window_features_are_finite_and_as_many_for_short_stretches() -> None:
    clock = np.arange(0.0, 6.0, 1.0 / 30.0)
    track = straight_track("mouse", clock, 100.0 * clock)
    names = channel_names(track.skeleton)
    (long,), (short,) = segments_of(track, 30.0), segments_of(track[:3], 30.0)
    a, b = window_features(long, names), window_features(short, names)
    assert np.isfinite(a).all()
    assert np.isfinite(b).all()
    assert a.shape[1] == b.shape[1]


def test_the_papers_descriptors_have_252_and_888_numbers_and_do_not_depend_on_the_place() -> None:
    clock = np.arange(0.0, 1.0, 0.02)
    track = straight_track("fish", clock, 60.0 * clock**2, np.sin(3 * clock))
    tangent, joints = tangent_descriptor(track), position_descriptor(track)
    assert (tangent.shape, joints.shape) == ((252,), (888,))
    T = SE3(so3.exp([0.1, 0.2, 1.5]), np.array([40.0, -7.0, 3.0]))
    root = T @ SE3(track.root_rotation, track.root_mm)
    track.joints_mm[:] = T @ track.joints_mm
    track.root_rotation[:], track.root_mm[:] = root.rotation, root.translation
    np.testing.assert_allclose(tangent_descriptor(track), tangent, atol=1e-9)
    assert np.abs(position_descriptor(track) - joints).max() > 5.0


def test_the_halves_of_a_fish_are_its_joints_2_to_10_and_11_to_the_last() -> None:
    """Counted from 1 with the base, as in the paper: the hinge of joint 11 is the hind half's."""
    clock = np.arange(0.0, 1.0, 0.02)
    track = straight_track("fish", clock, 60.0 * clock, 0.0 * clock)
    still = tangent_descriptor(track)
    # the whole sequence comes last: 18 means, then 18 deviations
    front, hind = slice(-30, -27), slice(-24, -21)
    for joint, half, other, n in ((9, front, hind, 9), (10, hind, front, 10)):
        track.angles_rad[:] = 0.0
        track.angles_rad[:, joint, 2] = 0.9
        moved = tangent_descriptor(track) - still
        np.testing.assert_allclose(moved[half], [0.0, 0.0, 0.9 / n], atol=1e-6)
        np.testing.assert_allclose(moved[other], 0.0, atol=1e-6)


@pytest.mark.parametrize("rate_hz", [15.0, 100.0])
def test_channels_made_piece_by_piece_are_those_made_at_once(
    rate_hz: float, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    rng, clock = np.random.default_rng(1), np.arange(0.0, 6.0, 1.0 / rate_hz)
    track = straight_track("mouse", clock, 100.0 * clock, 0.5 * clock)
    track.joints_mm[:] += rng.normal(size=track.joints_mm.shape)
    (whole,) = segments_of(track, 30.0)
    monkeypatch.setattr("liex_lab.actions.channels._PIECE", 7)
    (pieces,) = segments_of(track, 30.0, allocate=on_disk(tmp_path))
    assert pieces.values.tobytes() == whole.values.tobytes()
