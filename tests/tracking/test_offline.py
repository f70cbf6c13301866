"""From single frames to a curve: smoother than they are, one way round, bridged for a while and no
longer.
"""

from dataclasses import fields, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from liex_lab.geometry import so3
from liex_lab.runtime.memory import on_disk
from liex_lab.tracking.curve import OnlineTracker, track_whole
from liex_lab.tracking.observations import Observations, joints_of
from liex_lab.tracking.smoother import SmoothedCurve
from liex_lab.tracking.track import Flip, Track, ends_of, short_gaps, spans, whole_gaps
from liex_lab.tracking.trust import covariance_of_root, single_frames
from tests.tracking.stories import MOUSE, SUBJECT, joint_error, lose, noisy, told, walk

SECONDS = np.delete(np.arange(150) / 30, [40, 41, 90])  # a camera that missed three frames


@pytest.fixture(scope="module")
def truth():
    return walk(SECONDS)


@pytest.fixture(scope="module")
def measured(truth):
    return noisy(truth, np.random.default_rng(4))


def test_the_curve_is_nearer_to_the_truth_than_its_frames_and_says_how_near(truth, measured):
    seen = told(SECONDS, measured)
    single, track = single_frames(SUBJECT, seen), track_whole(SUBJECT, seen).track
    before, after = joint_error(single.joints_mm, truth), joint_error(track.joints_mm, truth)
    assert after.mean() < 0.7 * before.mean()
    assert track.observed.all()
    assert not track.bridged.any()
    assert np.median(track.predicted_error_mm) < np.median(single.predicted_error_mm)
    off = np.abs(track.joints_mm - truth.joints(MOUSE)) / track.sd_mm[..., None]
    assert np.mean(off < 1.645) > 0.85


def test_what_a_shape_leaves_of_height_and_place_is_in_the_intervals_and_in_no_curve(measured):
    """Up from the floor, and of the two level axes half each; speeds are made without it."""
    seen = told(SECONDS, measured)
    usual = track_whole(replace(SUBJECT, unseen=(0.0, 0.0)), seen).track
    shaped = track_whole(replace(SUBJECT, unseen=(0.03, 0.02)), seen).track
    np.testing.assert_array_equal(shaped.joints_mm, usual.joints_mm)
    np.testing.assert_array_equal(shaped.sd_mm, usual.sd_mm)
    away = {"sd_z_mm": 0.03, "sd_xy_mm": 0.02 / np.sqrt(2.0)}
    for name, share in away.items():
        expected = np.hypot(usual.sd_mm, share * SUBJECT.length_mm)
        np.testing.assert_allclose(getattr(shaped, name), expected)
    assert (shaped.predicted_error_mm > usual.predicted_error_mm).all()


def test_the_roots_covariance_is_that_of_a_middle_that_is_off_and_a_turn_about_it(measured):
    rng, n = np.random.default_rng(8), 40_000
    pose = measured[:1]
    joints = joints_of(MOUSE, pose)
    middle, sd_turn = (
        np.array([[4.0, 1.0, 0.5], [1.0, 2.0, -0.3], [0.5, -0.3, 1.0]]),
        np.array([[0.04, 0.02, 0.06]]),
    )
    one = np.ones(1)
    said = covariance_of_root(
        SmoothedCurve(pose, joints, one, middle[None], sd_turn, sd_turn, one > 0)
    )[0]
    centre, turns = joints[0].mean(axis=0), sd_turn * rng.normal(size=(n, 3))
    turned = pose.root.rotation[0] @ so3.exp(turns)
    lever = pose.root.rotation[0].T @ (pose.root.translation[0] - centre)
    place = centre + rng.multivariate_normal(np.zeros(3), middle, n) + turned @ lever
    drawn = np.concatenate(
        [turns, (place - pose.root.translation[0]) @ pose.root.rotation[0]], axis=1
    )
    scale = np.sqrt(np.diagonal(said))
    np.testing.assert_allclose(
        np.cov(drawn.T) / np.outer(scale, scale), said / np.outer(scale, scale), atol=0.03
    )
    assert np.abs(said[:3, 3:] / np.outer(scale[:3], scale[3:])).max() > 0.3, (
        "a turn and a shift go together"
    )


def test_head_and_tail_are_told_apart_over_the_whole_recording(truth, measured):
    flipped = np.zeros(len(SECONDS), bool)
    flipped[[20, 70, 71, 72, 73, 74, 75, 76, 77, 120]] = True
    tracked = track_whole(SUBJECT, told(SECONDS, measured, flipped))
    assert joint_error(tracked.track.joints_mm, truth).max() < 5.0
    assert [(flip.start, flip.stop) for flip in tracked.flips] == [(20, 21), (70, 78), (120, 121)]
    assert all(
        flip.applied and flip.source == "model" and flip.p_flip > 0.9 for flip in tracked.flips
    )
    assert tracked.track.p_flip.max() < 0.2


def test_where_nothing_tells_head_from_tail_the_doubt_is_told(measured):
    seen = told(SECONDS, measured)
    seen.score[:, :2] = 5.0
    tracked = track_whole(SUBJECT, seen)
    assert (tracked.track.p_flip > 0.05).all()
    (flip,) = tracked.flips
    assert (flip.start, flip.stop, flip.applied) == (0, len(SECONDS), False)
    assert flip.p_flip == pytest.approx(tracked.track.p_flip.mean())


def test_outliers_do_not_pull_the_curve_and_are_not_measurements(truth, measured):
    away = measured[np.arange(len(SECONDS))]
    away.root.translation[[30, 31, 100]] += [60.0, -40.0, 0.0]
    seen = told(SECONDS, away)
    track = track_whole(SUBJECT, seen).track
    # something of its size is in full view there, and elsewhere than the curve: no pose is claimed
    assert np.flatnonzero(~track.posed).tolist() == [30, 31, 100]
    assert (track.flag[[30, 31, 100]] != "").all()
    assert joint_error(track.joints_mm, truth)[track.posed].max() < 5.0
    lose(seen, np.array([30, 31, 100]))  # hidden, the animal may be where the curve leads
    track = track_whole(SUBJECT, seen).track
    assert np.flatnonzero(track.bridged).tolist() == [30, 31, 100]
    assert joint_error(track.joints_mm, truth).max() < 5.0
    assert (track.n_foreground_px[track.bridged] == 0).all()


def test_a_short_gap_is_bridged_and_grows_uncertain_and_a_long_one_only_at_its_ends(
    truth, measured
):
    seen = told(SECONDS, measured)
    lose(seen, slice(50, 58))
    lose(seen, slice(100, 130))
    lose(seen, slice(145, None))
    seen.has_depth[100] = False
    track = track_whole(SUBJECT, seen).track
    # half of bridge_s is seven and a half frames
    assert np.flatnonzero(track.bridged).tolist() == [
        *range(50, 58),
        *range(100, 107),
        *range(123, 130),
    ]
    assert joint_error(track.joints_mm, truth)[50:58].max() < 8.0
    assert track.sd_mm[53].mean() > 1.2 * track.sd_mm[30].mean()
    assert np.isnan(track.joints_mm[107:123]).all()
    assert np.isfinite(track.sd_mm[100:107]).all()
    assert track.sd_mm[106].mean() > 1.2 * track.sd_mm[30].mean()
    assert np.isnan(track.joints_mm[145:]).all()
    assert set(track.flag[50:58]) == {"not_found"}
    assert track.flag[100] == "no_depth"
    none = track_whole(replace(SUBJECT, bridge_s=0.0), seen).track
    assert not none.bridged.any()
    assert np.isnan(none.joints_mm[50:58]).all()


def test_what_looks_unlike_the_animal_is_measured_where_it_lies_on_the_curve_and_is_whole(measured):
    seen = told(SECONDS, measured)
    rows = slice(70, 74)
    seen.score[rows], seen.error_mm[rows] = (
        1e4,
        3.0 * seen.error_mm[rows],
    )  # the metric has never seen such fur
    track = track_whole(SUBJECT, seen).track
    assert not track.bridged.any()
    assert track.observed.all()
    seen.n_px[rows] = 0.4 * np.median(seen.n_px[:, 0])
    half = track_whole(SUBJECT, seen).track
    assert np.flatnonzero(half.bridged).tolist() == [70, 71, 72, 73]


def test_of_half_an_animal_something_is_measured_and_trusted_less(truth, measured):
    seen = told(SECONDS, measured)
    hidden, half = slice(60, 72), slice(66, 72)
    seen.score[half], seen.n_px[half] = 1e4, 0.55 * np.median(seen.n_px[:, 0])
    lose(seen, slice(hidden.start, half.start))
    track = track_whole(SUBJECT, seen).track
    assert track.observed[half].all()
    lose(seen, hidden)
    gone = track_whole(SUBJECT, seen).track
    error, without = (joint_error(each.joints_mm, truth)[half].mean() for each in (track, gone))
    assert error < 0.8 * without
    assert track.sd_mm[69].mean() > 1.2 * track.sd_mm[30].mean()


def test_the_second_thing_is_taken_where_the_curve_leads_to_it(truth, measured):
    seen = told(SECONDS, measured)
    rows = slice(60, 66)
    for name in ("turn", "place", "angles", "scale", "error_mm", "score"):
        values = getattr(seen, name)
        values[rows, 2] = values[rows, 0]
    seen.place[rows, :2] += 150.0
    track = track_whole(SUBJECT, seen).track
    assert joint_error(track.joints_mm, truth).max() < 5.0
    assert track.observed[rows].all()


def test_a_human_turns_a_span_round_and_may_take_that_back(truth, measured):
    flipped = np.zeros(len(SECONDS), bool)
    flipped[:] = True  # every frame says it the wrong way, and none doubts it
    seen = told(SECONDS, measured, flipped)
    wrong = track_whole(SUBJECT, seen).track
    assert joint_error(wrong.joints_mm, truth).min() > 10.0
    span = Flip(0, len(SECONDS), 1.0, True, "human")
    tracked = track_whole(SUBJECT, seen, [span])
    assert joint_error(tracked.track.joints_mm, truth).max() < 5.0
    assert span in tracked.flips
    seen.score[:, 1] = (
        np.nan
    )  # no candidate points the other way: the body is turned round as it lies
    assert joint_error(track_whole(SUBJECT, seen, [span]).track.joints_mm, truth).max() < 6.0
    undone = track_whole(SUBJECT, seen, [replace(span, undone_at="2026-01-05T10:00:00+00:00")])
    np.testing.assert_array_equal(
        undone.track.joints_mm, track_whole(SUBJECT, seen).track.joints_mm
    )


@settings(max_examples=6)
@given(st.lists(st.tuples(st.integers(0, 146), st.integers(1, 60)), min_size=1, max_size=3))
def test_an_exchange_by_hand_turns_its_frames_and_no_others(measured, spans_):
    seen = told(SECONDS, measured)
    was = track_whole(SUBJECT, seen).track
    ends = [(start, min(start + n, len(SECONDS))) for start, n in spans_]
    net = np.zeros(len(SECONDS), bool)
    for start, stop in ends:
        net[start:stop] ^= True  # what is exchanged twice is as it was
    tracked = track_whole(SUBJECT, seen, [Flip(*end, 1.0, True, "human") for end in ends])
    along = [one.joints_mm[:, MOUSE.tip] - one.joints_mm[:, 0] for one in (was, tracked.track)]
    cosine = np.prod([np.linalg.norm(one, axis=1) for one in along], axis=0)
    cosine = np.sum(along[0] * along[1], axis=1) / cosine
    assert (np.where(net, -cosine, cosine) > 0.9).all(), "no frame turns through other angles"
    assert tracked.track.observed.all()
    inner = [end for end in ends_of(ends) if 0 < end < len(SECONDS)]
    assert list(tracked.cuts) == inner, "each end makes a half turn, and is cut"


def test_an_exchange_that_takes_a_half_turn_away_is_smoothed_over_its_ends(truth, measured):
    flipped = np.zeros(len(SECONDS), bool)
    flipped[60:100] = True  # every frame says it the wrong way for so long that it is believed
    seen = told(SECONDS, measured, flipped)
    wrong = track_whole(SUBJECT, seen).track
    assert joint_error(wrong.joints_mm, truth)[65:95].min() > 10.0
    tracked = track_whole(SUBJECT, seen, [Flip(60, 100, 1.0, True, "human")])
    assert tracked.cuts == ()
    assert tracked.track.posed.all()
    assert joint_error(tracked.track.joints_mm, truth).max() < 5.0


def test_a_recording_without_any_animal_is_empty_rows():
    seen = Observations.empty(MOUSE, np.arange(20) * 33_333_333)
    tracked = track_whole(SUBJECT, seen)
    assert not tracked.track.posed.any()
    assert tracked.flips == ()


def test_a_track_on_disk_is_the_one_in_memory(measured, tmp_path, monkeypatch):
    seen = told(SECONDS, measured)
    lose(seen, slice(50, 58))
    monkeypatch.setattr("liex_lab.tracking.curve._BLOCK", 40)
    monkeypatch.setattr("liex_lab.tracking.association._BLOCK", 30)
    flip = Flip(20, 30, 1.0, True, "human")
    here, there = (
        track_whole(SUBJECT, seen, [flip]),
        track_whole(SUBJECT, seen, [flip], allocate=on_disk(tmp_path)),
    )
    assert here.flips == there.flips
    for column in fields(Track):
        if column.name != "skeleton":
            assert (
                getattr(here.track, column.name).tobytes()
                == getattr(there.track, column.name).tobytes()
            )


def test_online_every_frame_gets_one_row_and_a_lag_makes_it_better(truth, measured):
    flipped = np.zeros(len(SECONDS), bool)
    flipped[[20, 70, 71]] = True
    seen = told(SECONDS, measured, flipped)
    lose(seen, slice(50, 54))
    error = []
    for lag in (0, 6):
        online = OnlineTracker(SUBJECT, lag)
        parts = [online.add(seen[k : k + 10]) for k in range(0, len(seen), 10)]
        assert parts[0] is not None
        assert parts[0].n_frames == 10 - lag
        rows = [part for part in (*parts, online.close()) if part is not None]
        times = np.concatenate([part.times_ns for part in rows])
        np.testing.assert_array_equal(times, seen.times_ns)
        joints = np.concatenate([part.joints_mm for part in rows])
        assert np.isfinite(joints).all(), "a short gap is bridged, at lag 0 by going on"
        error.append(joint_error(joints, truth))
    assert error[1].mean() < 0.9 * error[0].mean()
    assert max(e.max() for e in error) < 10.0


def test_gaps_are_measured_in_seconds_between_measurements():
    measured = np.array([False, True, False, False, True, False, True, False])
    seconds = np.array([0.0, 0.1, 0.2, 0.3, 0.4, 1.0, 1.5, 1.6])
    assert np.flatnonzero(short_gaps(seconds, measured, 0.31)).tolist() == [2, 3]
    assert np.flatnonzero(short_gaps(seconds, measured, 0.21)).tolist() == [2, 3]
    assert short_gaps(seconds, measured, 0.19).sum() == 0
    assert np.flatnonzero(short_gaps(seconds, measured, 1.01)).tolist() == [2, 3, 5]
    assert np.flatnonzero(short_gaps(seconds, measured, 0.15, ahead=True)).tolist() == [7]
    assert not short_gaps(seconds, np.zeros(8, bool), 1.0).any()
    assert np.flatnonzero(whole_gaps(seconds, measured, 0.31)).tolist() == [2, 3]
    assert not whole_gaps(seconds, measured, 0.29).any()


def test_spans_are_the_stretches_of_true():
    assert spans(np.array([True, False, True, True])) == [(0, 1), (2, 4)]


@pytest.mark.parametrize("n_animals", [1, 2])
def test_live_no_pose_of_one_of_two_animals_is_trusted(measured, n_animals):
    online = OnlineTracker(replace(SUBJECT, n_animals=n_animals))
    row = online.add(told(SECONDS, measured)[:30])
    assert row is not None
    assert ((row.flag != "") == (n_animals == 2)).all()
