"""Synthetic recordings: the truth is true, the same seed is the same picture, and the sensors err
as sensors do.
"""

from __future__ import annotations

import numba
import numpy as np
import pytest

from liex_lab.body import Pose, Skeleton
from liex_lab.body.shape import draw_shapes
from liex_lab.body.surface import Surface
from liex_lab.errors import LiexError
from liex_lab.optics.camera import Camera
from liex_lab.simulation import _sensor_kernels as k
from liex_lab.simulation.locomotion import walking_session
from liex_lab.simulation.pose_prior import KINDS, sample_postures
from liex_lab.simulation.recording import (
    _SEALED_SEED,
    SEALED,
    SPLITS,
    SyntheticSession,
    split_of,
    test_split,
)
from liex_lab.simulation.simulator import world_of
from liex_lab.simulation.species import KINECT_V2_SENSOR, PRIMESENSE_SENSOR, SENSORS
from liex_lab.simulation.training_patches import (
    BLOCK,
    PER_SESSION,
    TrainingPatches,
    training_blocks,
    training_windows,
)

MOUSE = Skeleton.load("mouse")


@pytest.fixture(scope="module")
def windows() -> TrainingPatches:
    return training_windows(11, BLOCK)


@pytest.fixture(scope="module", params=[0, 1], ids=["primesense", "kinect"])
def session(request: pytest.FixtureRequest) -> SyntheticSession:
    return SyntheticSession.draw([5, request.param], 12, sensor=SENSORS[request.param])


# postures


@pytest.mark.parametrize("family", ["train", "other"])
def test_every_posture_stands_on_the_floor_within_its_joints_limits(family: str) -> None:
    rng = np.random.default_rng(2)
    n = 600
    shape = draw_shapes(rng, MOUSE, family, n)
    pose, girth = sample_postures(rng, MOUSE, n, rng.uniform(0.85, 1.9, n), shape)
    surface = Surface.of(MOUSE)
    lowest = surface.vertices(pose, shape, girth)[:, : surface.n_trunk_vertices, 2].min(axis=1)
    assert (lowest > -2.0).all()
    assert (lowest < 4.0).all()
    assert (pose.joints(MOUSE)[:, 4, 2] > 0).all()
    assert (pose.angles >= MOUSE.limits[..., 0] - 1e-9).all()
    assert (pose.angles <= MOUSE.limits[..., 1] + 1e-9).all()


def test_a_rearing_mouse_lifts_its_nose_and_keeps_its_rump_down() -> None:
    rng = np.random.default_rng(3)
    pose, _ = sample_postures(rng, MOUSE, 400, 1.23, kinds=np.full(400, KINDS.index("rear")))
    joints = pose.joints(MOUSE)
    assert np.percentile(joints[:, 4, 2], 90) > 60.0
    assert joints[:, 0, 2].max() < 30.0


def test_headings_have_no_favourite() -> None:
    pose, _ = sample_postures(np.random.default_rng(4), MOUSE, 4000)
    forward = pose.root.rotation[:, :2, 0]
    assert (
        np.linalg.norm((forward / np.linalg.norm(forward, axis=1, keepdims=True)).mean(axis=0))
        < 0.05
    )


# training windows


def test_windows_hold_the_animal_and_their_truth_projects_into_them(
    windows: TrainingPatches,
) -> None:
    uv = windows.joints_mm[..., :2] / windows.joints_mm[..., 2:] * windows.intrinsics[:, None, :2]
    uv = uv + windows.intrinsics[:, None, 2:] - windows.origin[:, None]
    assert (uv > 15).all()
    assert (uv < windows.depth.shape[1] - 15).all()
    # where a joint of the trunk projects there is an animal above the floor, nearer than the joint,
    # or a hole
    near, total = 0, 0
    for i in range(len(windows)):
        c, r = np.round(uv[i, 1]).astype(int)
        seen = windows.depth[i, r - 1 : r + 2, c - 1 : c + 2]
        total += 1
        near += bool((np.abs(seen[seen > 0] - (windows.joints_mm[i, 1, 2] - 14)) < 14).any())
    assert near / total > 0.97


def test_the_pose_of_a_window_has_its_joints(windows: TrainingPatches) -> None:
    joints = Pose(windows.root, windows.angles, windows.scale).joints(MOUSE)
    np.testing.assert_allclose(joints, windows.joints_mm, atol=1e-9)
    heights = (windows.T_arena_camera @ windows.joints_mm.transpose(1, 0, 2)).transpose(1, 0, 2)[
        ..., 2
    ]
    assert (heights > 0).all()
    assert heights.max() < 130.0


def test_the_true_floor_plane_is_the_floor(windows: TrainingPatches) -> None:
    side = np.arange(windows.depth.shape[1])
    shares = []
    for i in range(0, len(windows), 16):
        a, b, c = windows.floor_true[i]
        plane = 1.0 / (
            a * (windows.origin[i, 0] + side)[None] + b * (windows.origin[i, 1] + side)[:, None] + c
        )
        shown = windows.background[i] > 0
        off = (windows.background[i] - plane)[shown]
        shares.append(np.mean(np.abs(off) < 6.0))
        estimate = 1.0 / (windows.floor[i] @ [*(windows.origin[i] + 72), 1.0])
        assert abs(estimate - plane[72, 72]) < 8.0
    assert np.median(shares) > 0.95


def test_frames_of_a_mini_session_share_animal_camera_and_floor(windows: TrainingPatches) -> None:
    for column in (windows.spine_mm, windows.intrinsics, windows.floor_true, windows.floor):
        grouped = column.reshape(BLOCK // PER_SESSION, PER_SESSION, -1)
        np.testing.assert_array_equal(grouped, grouped[:, :1].repeat(PER_SESSION, axis=1))
    stretch = windows.scale * MOUSE.length / windows.spine_mm
    assert 0.92 < stretch.min() < 0.95
    assert 1.05 < stretch.max() < 1.08


def test_windows_depend_on_the_seed_alone_not_on_threads_or_on_where_one_starts(
    windows: TrainingPatches,
) -> None:
    np.testing.assert_array_equal(
        training_windows(11, 40, parallel=False).depth, windows.depth[:40]
    )
    threads = numba.get_num_threads()
    numba.set_num_threads(1)
    again = training_windows(11, BLOCK)
    numba.set_num_threads(threads)
    np.testing.assert_array_equal(again.depth, windows.depth)
    np.testing.assert_array_equal(again.joints_mm, windows.joints_mm)
    second = next(training_blocks(11, 1, first=1))
    assert second.session[0] == BLOCK // PER_SESSION
    assert not np.array_equal(second.depth, windows.depth)
    np.testing.assert_array_equal(training_windows(11, BLOCK + 8).depth[BLOCK:], second.depth[:8])


def test_windows_for_a_large_animal_hold_it_too() -> None:
    large = training_windows(12, 64, spine_mm=95.0, window_px=224)
    assert large.spine_mm.min() > 80.0
    assert large.spine_mm.max() < 105.0
    uv = large.joints_mm[..., :2] / large.joints_mm[..., 2:] * large.intrinsics[:, None, :2]
    uv = uv + large.intrinsics[:, None, 2:] - large.origin[:, None]
    assert (uv > 10).all()
    assert (uv < 214).all()


# sensors


def flat(sensor_kind: int, depth_mm: float, noise: float = 1.0) -> np.ndarray:
    """A wall at one depth, read a hundred-odd pixels square by a middling unit."""
    sensor = SENSORS[sensor_kind]
    p = sensor.draw(np.random.default_rng(0), 200, np.zeros(200), noise).mean(axis=0)
    p[k.KIND], p[k.SIDE] = sensor_kind, 1.0
    shape = (160, 160)
    depth, out = np.full(shape, depth_mm, np.float32), np.empty(shape, np.uint16)
    k.sense(
        depth,
        np.full(shape, k.STILL, np.uint8),
        p,
        sensor.camera.fx,
        80.0,
        80.0,
        np.array([99], np.uint64),
        k.NORMAL,
        np.empty(shape, np.float32),
        out,
    )
    return out


@pytest.mark.parametrize("kind", [0, 1])
def test_noise_grows_with_distance_and_with_the_noise_factor(kind: int) -> None:
    spreads = [
        np.std(out[out > 0].astype(float))
        for out in (flat(kind, 500.0), flat(kind, 1500.0), flat(kind, 1500.0, 2.0))
    ]
    assert 0.2 < spreads[0] < 2.0
    assert spreads[1] > 1.5 * spreads[0]
    assert 1.6 < spreads[2] / spreads[1] < 2.4
    assert abs(flat(kind, 700.0)[flat(kind, 700.0) > 0].mean() - 700.0) < 1.0


def test_a_primesense_reads_only_depths_of_whole_eighths_of_disparity() -> None:
    out = flat(0, 3000.0)
    fb = PRIMESENSE_SENSOR.camera.fx * k.BASELINE_MM
    eighths = fb / out[out > 0].astype(float) * k.SUBPIXEL
    assert np.abs(eighths - np.round(eighths)).max() < 0.03  # what rounding to whole mm leaves
    assert len(np.unique(out)) < 40


def test_the_shadow_of_a_step_is_as_wide_as_the_baseline_makes_it() -> None:
    fb = PRIMESENSE_SENSOR.camera.fx * k.BASELINE_MM
    row = np.full(120, 900.0, np.float32)
    row[50:70] = 700.0
    shadow = np.empty(120, np.bool_)
    width = fb / 700.0 - fb / 900.0
    for side, band in ((1.0, slice(50 - int(width), 50)), (-1.0, slice(70, 70 + int(width)))):
        k._shadow(row, fb, side, shadow)
        assert abs(shadow.sum() - width) <= 1.5
        assert shadow[band].mean() > 0.9
        assert not shadow[50:70].any()


def test_a_kinect_mixes_depths_at_an_outline_and_a_primesense_does_not() -> None:
    between = []
    for kind in (0, 1):
        sensor = SENSORS[kind]
        p = sensor.draw(np.random.default_rng(1), 1, np.zeros(1))[0]
        if kind:
            p[k.FLYING] = 0.5
        depth, what = np.full((120, 120), 900.0, np.float32), np.full((120, 120), k.STILL, np.uint8)
        depth[40:80, 40:80], what[40:80, 40:80] = 800.0, k.ANIMAL
        out = np.empty((120, 120), np.uint16)
        k.sense(
            depth,
            what,
            p,
            sensor.camera.fx,
            60.0,
            60.0,
            np.array([7], np.uint64),
            k.NORMAL,
            np.empty((120, 120), np.float32),
            out,
        )
        between.append(((out > 820) & (out < 880)).sum())
    assert between[1] > 20 > between[0]


def test_erosion_strips_a_pixel_off_the_animal() -> None:
    areas = []
    for erosion in (0, 1):
        p = KINECT_V2_SENSOR.draw(np.random.default_rng(1), 1, np.zeros(1), 0.0, erosion)[0]
        p[k.FLYING] = p[k.BIAS] = p[k.LUMPS] = 0.0
        depth, what = np.full((60, 60), 900.0, np.float32), np.full((60, 60), k.STILL, np.uint8)
        depth[20:40, 20:40], what[20:40, 20:40] = 800.0, k.ANIMAL
        out = np.empty((60, 60), np.uint16)
        k.sense(
            depth,
            what,
            p,
            365.0,
            30.0,
            30.0,
            np.array([7], np.uint64),
            k.NORMAL,
            np.empty((60, 60), np.float32),
            out,
        )
        areas.append(int(((out > 0) & (out < 850)).sum()))
    assert areas == [400, 324]


# sessions


def test_a_session_is_a_recording_that_reads_the_same_in_any_order(
    session: SyntheticSession,
) -> None:
    late = session.frame(9).depth
    again = SyntheticSession.draw(
        [5, 0 if session.width == 640 else 1], 12, sensor=SENSORS[session.width == 512]
    )
    np.testing.assert_array_equal(late, again.frame(9).depth)
    chunks = [frame for chunk in session.chunks(5) for frame in chunk]
    assert [frame.index for frame in chunks] == list(range(12))
    np.testing.assert_array_equal(chunks[9].depth, late)
    assert late.shape == (session.height, session.width)
    assert late.dtype == np.float32
    assert np.isfinite(late).all()
    assert (late >= 0).all()
    assert session.format == "synthetic"
    assert np.all(np.diff(session.times_ns) > 0)


def test_the_animal_is_where_the_truth_says(session: SyntheticSession) -> None:
    np.testing.assert_allclose(
        session.T_arena_camera @ session.joints_camera.reshape(-1, 3),
        session.joints_arena.reshape(-1, 3),
        atol=1e-6,
    )
    uv = session.camera.project(session.joints_camera)
    assert (uv > 0).all()
    assert (uv < [session.width - 1, session.height - 1]).all()
    hits = 0
    for i, frame in enumerate(session):
        trunk = session.joints_camera[i, 1]
        c, r = np.round(session.camera.project(trunk)).astype(int)
        seen = frame.depth[r - 1 : r + 2, c - 1 : c + 2]
        hits += bool((np.abs(seen[seen > 0] - trunk[2] + 14) < 14).any())
    assert hits >= 11


def test_the_floor_of_a_session_is_where_its_plane_is(session: SyntheticSession) -> None:
    plane = session.floor.depth(session.width, session.height)
    np.testing.assert_allclose(
        session.floor.T_arena_camera.rotation, session.T_arena_camera.rotation, atol=1e-9
    )
    depth = session.frame(0).depth
    c, r = np.round(
        session.camera.project(session.T_arena_camera.inverse() @ [*session.scene.centre, 0.0])
    ).astype(int)
    patch = (slice(r - 15, r + 15), slice(c - 15, c + 15))
    assert np.median(np.abs(depth[patch] - plane[patch])) < 6.0


def test_the_splits_are_fixed_halved_between_sensors_and_apart() -> None:
    clean, hard = test_split("clean", n_sessions=4), test_split("hard", n_sessions=4)
    assert [s.width for s in clean] == [640, 512, 640, 512]
    assert all(len(s) == 50 for s in clean + hard)
    assert not any(s.contents.shown.any() for s in clean)
    assert 0.3 < np.mean([s.contents.shown.mean() for s in hard]) < 0.65
    assert len({s.spine_mm for s in clean + hard}) == 8
    assert test_split("clean", spine_mm=80.0, n_sessions=1)[0].spine_mm == 80.0
    with pytest.raises(LiexError, match="known are clean, hard, other-body, other-camera"):
        test_split("easy")


@pytest.mark.parametrize("animal", ["mouse", "fish", "hand"])
def test_cameras_of_a_split_have_a_focal_length_that_no_training_picture_has(animal):
    world = world_of(Skeleton.load(animal))
    (learned,) = world.training_blocks(5, 1)
    focal = np.unique(learned.intrinsics[:, 0])
    for recording in world.test_split("other-camera", n_sessions=2):
        whole = recording.camera.fx
        for seen in (focal, focal * 2.0):  # a light field is read at every second pixel
            assert np.abs(np.log(seen / whole)).min() > 0.06
    assert {r.camera.fx for r in world.test_split("other-camera", n_sessions=2)} != {
        r.camera.fx for r in world.test_split("clean", n_sessions=2)
    }


def test_the_sealed_split_has_all_kinds_of_recordings_and_a_seed_of_its_own():
    assert SEALED not in SPLITS
    assert _SEALED_SEED not in {seed for seed, *_ in SPLITS.values()}
    assert [split_of(SEALED, k) for k in range(5)] == [*SPLITS, "clean"]
    assert split_of("hard", 3) == "hard"


def test_another_object_never_touches_the_animal_in_the_picture() -> None:
    for s in test_split("hard", n_sessions=4):
        T_camera_arena = s.T_arena_camera.inverse()
        for i in np.flatnonzero(s.contents.shown)[:6]:
            thing = s.camera.project(T_camera_arena @ s.contents.things[i])
            body = s.camera.project(s.joints_camera[i])
            assert np.linalg.norm(thing[:, None] - body, axis=-1).min() > 4.0


def test_a_walk_is_continuous_and_shows_every_kind_of_posture() -> None:
    s = walking_session(4, 450)
    speed = np.linalg.norm(np.diff(s.joints_arena, axis=0), axis=-1) * s.rate_hz
    assert speed.max() < 600.0
    assert np.linalg.norm(np.ptp(s.joints_arena[:, 0], axis=0)) > s.spine_mm
    assert s.joints_arena[:, 4, 2].max() > 0.7 * s.spine_mm  # it rears
    assert (s.scene.wall_clearance(s.joints_arena[..., :2]) > 0).all()
    uv = s.camera.project(s.joints_camera)
    assert (uv > 0).all()
    assert (uv < [s.width - 1, s.height - 1]).all()
    assert isinstance(s.camera, Camera)
