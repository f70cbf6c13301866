"""`liex train tracking`: numbers that are changed are kept where tracks come nearer to the
truth.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from liex_lab.pipelines.training import motion_model
from liex_lab.pipelines.training.motion_model import (
    Measured,
    calibrate_builds,
    calibrate_each_joint,
    calibrate_expected,
    calibrate_joints,
    calibrate_roots,
    train_tracking,
    with_motion,
)

from liex_lab.geometry import so3
from liex_lab.tracking.curve import track_whole
from liex_lab.tracking.smoother import TrackingParameters
from liex_lab.tracking.track import Track
from tests.tracking.stories import MOUSE, SUBJECT, noisy, told, walk

SECONDS = np.arange(80) / 30.0
# of a mouse whose build is known
KNOWN = with_motion(
    TrackingParameters.of("mouse"),
    joint_calibration=(),
    unseen_height=(0.0,),
    unseen_shift=0.0,
    expected_share=1.0,
)


@pytest.fixture(scope="module")
def measured() -> list[Measured]:
    truth = walk(SECONDS)
    joints = truth.joints(MOUSE)
    return [
        Measured(
            kind,
            told(SECONDS, noisy(truth, np.random.default_rng(seed), sd_mm)),
            *(SUBJECT, truth, joints, 0.0, 0.0),
        )
        for kind, seed, sd_mm in (("easy", 1, 0.8), ("hard", 2, 2.0))
    ]


def tracked(each: Measured, tuning: TrackingParameters) -> Track:
    return track_whole(each.subject, each.observations, (), tuning).track


def covered(measured: list[Measured], tuning: TrackingParameters) -> list[float]:
    """Of each sequence the share of joint coordinates within their 90 % intervals."""
    shares = []
    for each in measured:
        stretch_sd = tuning.motion.stretch_sd(each.blur, each.size_spread)
        track = tracked(replace(each, subject=replace(each.subject, stretch_sd=stretch_sd)), tuning)
        inside = np.abs(track.joints_mm - each.truth) < 1.645 * track.sd_mm[..., None]
        shares.append(float(inside.mean()))
    return shares


def test_an_honest_track_covers_nine_in_ten(measured):
    mouse = TrackingParameters.of("mouse")
    # joints get widths of their own afterwards, which here would be those of other errors
    wrong = with_motion(mouse, calibration=((0.03, 0.3),), joint_calibration=())
    tuning = calibrate_joints(measured, wrong)
    stated = [at for at, _ in tuning.motion.calibration]
    assert stated == sorted(stated)
    assert 0.86 < np.mean(covered(measured, tuning)) < 0.94


def test_who_is_taken_for_smaller_has_wider_intervals_and_who_is_not_has_none(measured):
    spread, sequences = 0.1, []
    for k, size in enumerate((1.0, 1.0, 0.88, 1.12)):
        each = measured[k % 2]
        pose = replace(each.pose, scale=size * each.pose.scale)
        truth = pose.joints(MOUSE)
        sequences.append(
            replace(each, pose=pose, truth=truth, size_spread=0.0 if size == 1.0 else spread)
        )
    tuning = calibrate_joints(sequences, KNOWN)
    alike = calibrate_joints([replace(each, size_spread=0.0) for each in sequences], KNOWN)
    assert tuning.motion.stretch[1] > 0
    assert alike.motion.stretch == (0.0, 0.0), "what tells nothing is not used"
    assert np.ptp(covered(sequences, tuning)) < 0.5 * np.ptp(covered(sequences, alike))


@pytest.mark.parametrize(
    ("way", "offs_mm"),
    [("up", (-9.0, -4.0, 5.0, 7.0, 10.0)), ("along", (-9.0, -5.0, 4.0, 6.0, 9.0))],
)
def test_errors_that_last_throughout_a_recording_are_covered(measured, way, offs_mm):
    tuning, builds, ways = KNOWN, [], []
    for k, off_mm in enumerate(offs_mm):
        truth = measured[k % 2].truth
        along = truth[:, -1] - truth[:, 0]
        along /= np.linalg.norm(along, axis=1)[:, None]
        ways.append(np.full_like(along, [0.0, 0.0, 1.0]) if way == "up" else along)
        subject = replace(SUBJECT, stretch_sd=0.0)
        truth = truth + off_mm * ways[-1][:, None]
        builds.append(replace(measured[k % 2], truth=truth, subject=subject))
    wider = calibrate_builds(builds, tuning)
    inside: dict[str, list] = {}
    for each, direction in zip(builds, ways, strict=True):
        track = tracked(each, wider)
        off = np.abs(np.einsum("njk,nk->nj", track.joints_mm - each.truth, direction))
        # half of the variance along the body stands beside x and half beside y
        beside = np.sqrt(2.0 * track.sd_xy_mm**2 - track.sd_mm**2)
        held = off <= 1.645 * (track.sd_z_mm if way == "up" else beside)
        inside.setdefault(each.kind, []).append(held)
    least = min(np.mean(held) for held in inside.values())
    assert least == pytest.approx(0.9, abs=0.03), "of the family that needs most"
    blind = calibrate_builds([], tuning).motion
    assert (blind.unseen_height, blind.unseen_shift) == ((0.0,), 0.0)


def test_each_joint_has_intervals_of_its_own(measured):
    # of one joint the truth lies nearer than its spread says, and of another farther away
    plain = TrackingParameters.of("mouse")
    rng = np.random.default_rng(4)
    wrong = []
    for known in measured:
        each = replace(known, subject=replace(known.subject, stretch_sd=0.0))  # as of no blur
        track = tracked(each, with_motion(plain, joint_calibration=()))
        sd = track.sd_mm[..., None] * np.array([3.0, 1.0, 1.0, 0.2, 1.0])[:, None]
        off = sd * rng.standard_normal(each.truth.shape)
        wrong.append(replace(each, truth=track.joints_mm + off))
    tuning = calibrate_each_joint(wrong, plain)
    rump, *inner, neck, _ = tuning.motion.joint_calibration
    assert rump > 2.0
    assert neck < 0.4
    np.testing.assert_allclose(inner, 1.0, atol=0.1)
    held = []
    for each in wrong:
        track = tracked(each, tuning)
        off = np.abs(track.joints_mm - each.truth)[..., :2]
        held.append((off <= 1.645 * track.sd_mm[..., None]).mean(axis=(0, 2)))
    np.testing.assert_allclose(np.min(held, axis=0), 0.9, atol=0.02)  # in the family of least
    assert len(plain.motion.joint_calibration) == MOUSE.n_joints
    assert TrackingParameters.of("starling").motion.joint_calibration == (), "not the mouse's"


def test_an_error_larger_than_those_calibrated_is_not_told_small(measured):
    tuning = calibrate_joints(measured, TrackingParameters.of("mouse"))
    stated, factor = np.array(tuning.motion.calibration).T
    assert stated[-1] == 1.0
    assert factor[-1] >= 1.0


def test_a_small_family_of_bodies_counts_as_much_as_a_large_one(measured):
    few, many = measured
    once = calibrate_expected([few, many], TrackingParameters.of("mouse"))
    often = calibrate_expected([few, many, many, many], TrackingParameters.of("mouse"))
    assert once.motion.expected_share == often.motion.expected_share


def test_the_predicted_error_is_right_in_the_median(measured):
    plain = with_motion(KNOWN, unseen_height=(0.1,))
    lower = [
        replace(
            each,
            truth=each.truth - [0.0, 0.0, 4.0 + k],
            subject=replace(each.subject, stretch_sd=0.0),
        )
        for k, each in enumerate(measured)
    ]
    tuning = calibrate_expected(lower, plain)
    ratio = []
    for each in lower:
        track = tracked(each, tuning)
        error_mm = np.linalg.norm(track.joints_mm - each.truth, axis=-1).mean(axis=1)
        ratio.append(error_mm / track.predicted_error_mm)
    assert np.median(np.concatenate(ratio)) == pytest.approx(1.0, abs=0.02)


def test_a_height_nobody_sees_is_in_the_error_and_upright_in_the_roots_covariance(measured):
    each = measured[0]
    plain = KNOWN
    higher = with_motion(plain, unseen_height=(0.1,))
    before, after = (tracked(each, one) for one in (plain, higher))
    there = before.posed & after.posed
    R = before.root_rotation[there]
    more = after.cov_root[there] - before.cov_root[there]
    upright = R @ more[:, 3:, 3:] @ np.swapaxes(R, 1, 2)
    sd_mm = 0.1 * each.subject.length_mm
    np.testing.assert_allclose(upright - np.diag([0.0, 0.0, sd_mm**2]), 0.0, atol=1e-6)
    np.testing.assert_allclose(
        after.predicted_error_mm[there], np.hypot(before.predicted_error_mm[there], 0.8 * sd_mm)
    )
    np.testing.assert_array_equal(after.sd_mm[there], before.sd_mm[there])
    np.testing.assert_array_equal(before.sd_z_mm[there], before.sd_mm[there])
    np.testing.assert_array_equal(after.sd_xy_mm[there], before.sd_mm[there])
    np.testing.assert_allclose(after.sd_z_mm[there], np.hypot(before.sd_mm[there], sd_mm))


def trained_twice(folder: Path, **settings: object) -> list[bytes]:
    """The file that one thread writes, and that of two."""
    return [
        train_tracking("mouse", folder / f"{k}.toml", workers=k, **settings).read_bytes()
        for k in (1, 2)
    ]


def test_the_table_is_the_same_on_one_thread_and_on_two(measured, tmp_path, monkeypatch):
    each_kind = {each.kind: each for each in measured}
    monkeypatch.setattr(motion_model, "measure", lambda animal, kind, *_: each_kind[kind])
    monkeypatch.setattr(motion_model, "other_builds", lambda *_: measured[:1])
    monkeypatch.setattr(motion_model, "foreign_bodies", lambda *_: measured[1:])
    one, two = trained_twice(tmp_path, seeds=(31,))
    assert one == two


@pytest.mark.nightly
def test_the_table_of_rendered_sequences_is_the_same_on_one_thread_and_on_two(tmp_path):
    one, two = trained_twice(tmp_path, n_frames=100, seeds=(31,))
    assert one == two


def test_roots_and_bends_are_covered_as_well(measured):
    tuning = calibrate_roots(measured, KNOWN)
    turned, placed, bent = [], [], []
    free = MOUSE.axes[1:]
    for each in measured:
        track = tracked(each, tuning)
        off = track.root.inverse() @ each.pose.root
        turned.append(np.abs(so3.log(off.rotation)) / track.sd_root[:, :3])
        placed.append(np.abs(off.translation) / track.sd_root[:, 3:])
        angles = np.abs(track.angles_rad - each.pose.angles)
        bent.append(angles[:, 1:][:, free] / track.sd_angles_rad[:, 1:][:, free])
    for z in (turned, placed, bent):
        assert 0.85 < np.mean(np.concatenate(z) < 1.645) < 0.95
