"""Synthetic recordings: the truth is exact, the same seed gives the same depth images."""

import numba
import numpy as np
import pytest

from liex_lab.body import Pose, Skeleton
from liex_lab.body.shape import BodyShape
from liex_lab.body.surface import Surface
from liex_lab.body.variation import draw_shapes
from liex_lab.errors import LiexError
from liex_lab.simulation.locomotion import walking_session
from liex_lab.simulation.pose_prior import KINDS, SHARES, sample_postures
from liex_lab.simulation.recording import SEALED, SEALED_SEED, SPLITS, SyntheticSession, split_of
from liex_lab.simulation.simulator import BodySimulator, world_of
from liex_lab.simulation.species import SENSORS, MouseSpecies
from liex_lab.simulation.training_patches import (
    PER_SESSION,
    TrainingPatches,
    training_blocks,
    training_windows,
)

MOUSE = Skeleton.load("mouse")
WORLD = BodySimulator(MouseSpecies(MOUSE))
N = 64  # patches of a block, see conftest


@pytest.fixture(scope="module")
def windows() -> TrainingPatches:
    return training_windows(11, N)


@pytest.fixture(scope="module", params=[0, 1], ids=["primesense", "kinect"])
def session(request: pytest.FixtureRequest) -> SyntheticSession:
    return SyntheticSession.draw([5, request.param], 12, sensor=SENSORS[request.param])


def in_windows(patches: TrainingPatches) -> np.ndarray:
    """Pixels (n, J, 2) of the joints within their patches."""
    uv = patches.joints_mm[..., :2] / patches.joints_mm[..., 2:] * patches.intrinsics[:, None, :2]
    return uv + patches.intrinsics[:, None, 2:] - patches.origin[:, None]


# postures


@pytest.mark.parametrize("family", ["train", "other"])
def test_every_posture_stands_on_the_floor_within_its_joints_limits(family: str) -> None:
    rng = np.random.default_rng(2)
    n = 600
    shape = draw_shapes(rng, MOUSE, family, n)
    kinds = rng.choice(len(KINDS), n, p=SHARES)
    pose, girth = sample_postures(rng, MOUSE, rng.uniform(0.85, 1.9, n), shape, kinds)
    surface = Surface.of(MOUSE)
    lowest = surface.vertices(pose, shape, girth)[:, : surface.n_trunk_vertices, 2].min(axis=1)
    assert (lowest > -2.0).all()
    assert (lowest < 4.0).all()
    assert (pose.joints(MOUSE)[:, 4, 2] > 0).all()
    assert (pose.angles >= MOUSE.limits[..., 0] - 1e-9).all()
    assert (pose.angles <= MOUSE.limits[..., 1] + 1e-9).all()


def test_a_rearing_mouse_lifts_its_nose_and_keeps_its_rump_down_whatever_its_heading() -> None:
    rng, n = np.random.default_rng(3), 4000
    kinds = np.full(n, KINDS.index("rear"))
    shape = BodyShape.default(MOUSE).broadcast(n)
    pose, _ = sample_postures(rng, MOUSE, np.full(n, 1.23), shape, kinds)
    joints = pose.joints(MOUSE)
    assert np.percentile(joints[:, 4, 2], 90) > 60.0
    assert joints[:, 0, 2].max() < 30.0
    forward = pose.root.rotation[:, :2, 0]
    forward /= np.linalg.norm(forward, axis=1, keepdims=True)
    assert np.linalg.norm(forward.mean(axis=0)) < 0.05


# training windows


def test_windows_hold_the_animal_and_their_truth_projects_into_them(
    windows: TrainingPatches,
) -> None:
    large = training_windows(12, N, spine_mm=95.0, window_px=224)
    assert large.spine_mm.min() > 80.0
    assert large.spine_mm.max() < 105.0
    for patches, margin in ((windows, 15), (large, 10)):
        uv = in_windows(patches)
        assert (uv > margin).all()
        assert (uv < patches.depth.shape[1] - margin).all()
    # where a joint of the trunk projects there is an animal above the floor, nearer than the joint,
    # or a hole
    near = []
    for i, (c, r) in enumerate(np.round(in_windows(windows)[:, 1]).astype(int)):
        seen = windows.depth[i, r - 1 : r + 2, c - 1 : c + 2]
        behind = windows.joints_mm[i, 1, 2] - seen[seen > 0]
        near.append((np.abs(behind - 14) < 14).any())
    assert np.mean(near) > 0.97


def test_the_pose_of_a_window_has_its_joints(windows: TrainingPatches) -> None:
    joints = Pose(windows.root, windows.angles, windows.scale).joints(MOUSE)
    np.testing.assert_allclose(joints, windows.joints_mm, atol=1e-9)
    height = (windows.T_arena_camera @ windows.joints_mm.transpose(1, 0, 2))[..., 2]
    assert (height > 0).all()
    assert height.max() < 130.0


def test_the_true_floor_plane_is_the_floor(windows: TrainingPatches) -> None:
    side = np.arange(windows.depth.shape[1])
    shares = []
    for i in range(0, N, 4):
        u, v = windows.origin[i][:, None] + side
        a, b, c = windows.floor_true[i]
        plane = 1.0 / (a * u[None] + b * v[:, None] + c)
        off = np.abs(windows.background[i] - plane)[windows.background[i] > 0]
        shares.append(np.mean(off < 6.0))
        estimate = 1.0 / (windows.floor[i] @ [*(windows.origin[i] + 72), 1.0])
        assert abs(estimate - plane[72, 72]) < 8.0
    assert np.median(shares) > 0.95


def test_frames_of_a_mini_session_share_animal_camera_and_floor(windows: TrainingPatches) -> None:
    for column in (windows.spine_mm, windows.intrinsics, windows.floor_true, windows.floor):
        grouped = column.reshape(N // PER_SESSION, PER_SESSION, -1)
        np.testing.assert_array_equal(grouped, grouped[:, :1].repeat(PER_SESSION, axis=1))
    stretch = windows.scale * MOUSE.length / windows.spine_mm
    assert 0.92 < stretch.min() < 0.95
    assert 1.05 < stretch.max() < 1.08


def test_windows_depend_on_the_seed_alone_not_on_threads_or_on_where_one_starts(
    windows: TrainingPatches,
) -> None:
    threads = numba.get_num_threads()
    numba.set_num_threads(1)
    again = training_windows(11, N + 8)
    numba.set_num_threads(threads)
    for one in (training_windows(11, 40, parallel=False), again):
        n = min(len(one), N)
        np.testing.assert_array_equal(one.depth[:n], windows.depth[:n])
        np.testing.assert_array_equal(one.joints_mm[:n], windows.joints_mm[:n])
    second = next(training_blocks(11, 1, first=1))
    assert second.session[0] == N // PER_SESSION
    assert not np.array_equal(second.depth, windows.depth)
    np.testing.assert_array_equal(again.depth[N:], second.depth[:8])


# sessions


def test_a_session_is_a_recording_that_reads_the_same_in_any_order(
    session: SyntheticSession,
) -> None:
    late = session.frame(9).depth
    kinect = session.width == 512
    again = SyntheticSession.draw([5, int(kinect)], 12, sensor=SENSORS[kinect])
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


def test_the_animal_and_the_floor_are_where_the_truth_says(session: SyntheticSession) -> None:
    np.testing.assert_allclose(
        session.T_arena_camera @ session.joints_camera, session.joints_arena, atol=1e-6
    )
    uv = session.camera.project(session.joints_camera)
    assert (uv > 0).all()
    assert (uv < [session.width - 1, session.height - 1]).all()
    hits = 0
    for i, frame in enumerate(session):
        c, r = np.round(uv[i, 1]).astype(int)
        seen = frame.depth[r - 1 : r + 2, c - 1 : c + 2]
        hits += bool((np.abs(seen[seen > 0] - session.joints_camera[i, 1, 2] + 14) < 14).any())
    assert hits >= 11
    np.testing.assert_allclose(
        session.floor.T_arena_camera.rotation, session.T_arena_camera.rotation, atol=1e-9
    )
    centre = session.T_arena_camera.inverse() @ [*session.scene.centre, 0.0]
    c, r = np.round(session.camera.project(centre)).astype(int)
    patch = (slice(r - 15, r + 15), slice(c - 15, c + 15))
    plane = session.floor.depth(session.width, session.height)
    assert np.median(np.abs(session.frame(0).depth[patch] - plane[patch])) < 6.0


@pytest.fixture(scope="module")
def hard() -> list[SyntheticSession]:
    return WORLD.test_split("hard", n_sessions=4)


def test_the_splits_are_fixed_halved_between_sensors_and_apart(hard) -> None:
    clean = WORLD.test_split("clean", n_sessions=2)
    first = SyntheticSession.draw([71_001, 0], sensor=SENSORS[0], name="clean-00")
    np.testing.assert_array_equal(clean[0].depths(0, 1), first.depths(0, 1))
    assert [s.width for s in clean + hard] == 3 * [640, 512]
    assert all(len(s) == 50 for s in clean + hard)
    assert not any(s.contents.shown.any() for s in clean)
    assert 0.3 < np.mean([s.contents.shown.mean() for s in hard]) < 0.65
    assert len({s.spine_mm for s in clean + hard}) == 6
    assert WORLD.test_split("clean", spine_mm=80.0, n_sessions=1)[0].spine_mm == 80.0
    with pytest.raises(LiexError, match="known are clean, hard, other-body, other-camera"):
        WORLD.test_split("easy")


@pytest.mark.parametrize("animal", ["mouse", "fish", "hand"])
def test_cameras_of_a_split_have_a_focal_length_that_no_training_picture_has(animal):
    world = world_of(Skeleton.load(animal))
    (learned,) = world.training_blocks(5, 1)
    focal = np.unique(learned.intrinsics[:, 0])
    others = {r.camera.fx for r in world.test_split("other-camera", n_sessions=2)}
    for whole in others:
        for seen in (focal, focal * 2.0):  # a light field is read at every second pixel
            assert np.abs(np.log(seen / whole)).min() > 0.06
    assert others != {r.camera.fx for r in world.test_split("clean", n_sessions=2)}


def test_the_sealed_split_has_all_kinds_of_recordings_and_a_seed_of_its_own():
    assert SEALED not in SPLITS
    assert SEALED_SEED not in {seed for seed, *_ in SPLITS.values()}
    assert [split_of(SEALED, k) for k in range(5)] == [*SPLITS, "clean"]
    assert split_of("hard", 3) == "hard"


def test_another_object_never_touches_the_animal_in_the_picture(hard) -> None:
    for s in hard:
        for i in np.flatnonzero(s.contents.shown)[:6]:
            thing = s.camera.project(s.T_arena_camera.inverse() @ s.contents.objects[i])
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
