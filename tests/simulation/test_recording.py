"""Synthetic recordings: the truth is exact, the same seed gives the same depth images."""

import numpy as np
import pytest

from liex_lab.body import Pose, Skeleton
from liex_lab.body.shape import Surface
from liex_lab.body.variation import draw_shapes
from liex_lab.errors import LiexError
from liex_lab.runtime.processes import threads
from liex_lab.simulation.pose_prior import KINDS, sample_postures
from liex_lab.simulation.recording import SEALED, SPLITS, RenderedRecording, split_of
from liex_lab.simulation.sensors import SENSORS
from liex_lab.simulation.simulator import world_of
from liex_lab.simulation.species import MouseSpecies
from liex_lab.simulation.training_patches import PER_SESSION, TrainingPatches

MOUSE = Skeleton.load("mouse")
WORLD = MouseSpecies(MOUSE)


@pytest.fixture(scope="module")
def windows() -> TrainingPatches:
    return next(WORLD.training_blocks(11, 1))


@pytest.fixture(scope="module")
def session() -> RenderedRecording:
    return MouseSpecies().film([5, 1], 12, sensor=SENSORS[1])


# postures


@pytest.mark.parametrize("family", ["train", "other"])
def test_every_posture_stands_on_the_floor_within_its_joints_limits(family: str) -> None:
    rng, n = np.random.default_rng(2), 400
    shape = draw_shapes(rng, MOUSE, family, n)
    kinds = np.arange(n) % len(KINDS)
    pose, girth = sample_postures(rng, MOUSE, rng.uniform(0.85, 1.9, n), shape, kinds)
    surface = Surface.of(MOUSE)
    lowest = surface.vertices(pose, shape, girth)[:, : surface.n_trunk_vertices, 2].min(axis=1)
    assert (np.abs(lowest - 1.0) < 3.0).all()
    joints = pose.joints(MOUSE)
    assert (joints[:, 4, 2] > 0).all()
    assert (np.clip(pose.angles, *np.moveaxis(MOUSE.limits, -1, 0)) == pose.angles).all()
    reared = kinds == KINDS.index("rear")
    assert np.percentile(joints[reared, 4, 2], 90) > 60.0 > 2.0 * joints[reared, 0, 2].max()


# training windows


def test_windows_hold_the_animal_where_their_truth_says(windows: TrainingPatches) -> None:
    joints = Pose(windows.root, windows.angles, windows.scale).joints(MOUSE)
    np.testing.assert_allclose(joints, windows.joints_mm, atol=1e-9)
    (large,) = WORLD.training_blocks(12, 1, spine_mm=95.0, window_px=224)
    for patches, margin in ((windows, 15), (large, 10)):
        p = patches.joints_mm
        uv = p[..., :2] / p[..., 2:] * patches.intrinsics[:, None, :2]
        uv += patches.intrinsics[:, None, 2:] - patches.origin[:, None]
        assert (uv > margin).all()
        assert (uv < patches.depth.shape[1] - margin).all()
        # at a joint of the trunk the skin is nearer than the joint, or unread
        near = []
        for i, (c, r) in enumerate(np.round(uv[:, 1]).astype(int)):
            read = patches.depth[i, r - 1 : r + 2, c - 1 : c + 2]
            half = 0.265 * patches.spine_mm[i]  # of a mouse's height
            near.append((np.abs(p[i, 1, 2] - read[read > 0] - half) < half).any())
        assert np.mean(near) > 0.95
    assert 80.0 < large.spine_mm.min() < large.spine_mm.max() < 105.0


def test_the_estimated_floor_is_nearly_the_floor(windows: TrainingPatches) -> None:
    side = np.arange(windows.depth.shape[1])
    shares = []
    for i in range(0, len(windows), 4):
        u, v = windows.origin[i][:, None] + side
        a, b, c = windows.floor[i]
        plane = 1.0 / (a * u[None] + b * v[:, None] + c)
        off = np.abs(windows.background[i] - plane)[windows.background[i] > 0]
        shares.append(np.mean(off < 8.0))
    assert np.median(shares) > 0.95


def test_a_mini_session_shares_animal_and_camera(windows: TrainingPatches) -> None:
    for column in (windows.spine_mm, windows.intrinsics):
        grouped = column.reshape(len(windows) // PER_SESSION, PER_SESSION, -1)
        np.testing.assert_array_equal(grouped, grouped[:, :1].repeat(PER_SESSION, axis=1))
    stretch = windows.scale * MOUSE.length / windows.spine_mm
    assert 0.92 < stretch.min() < 0.95
    assert 1.05 < stretch.max() < 1.08


def test_blocks_depend_on_seed_and_number_alone_not_on_threads(windows: TrainingPatches) -> None:
    with threads(False):
        first, second = WORLD.training_blocks(11, 2)
    (alone,) = WORLD.training_blocks(11, 1, first=1)
    for one, other in ((first, windows), (second, alone)):
        np.testing.assert_array_equal(one.depth, other.depth)
        np.testing.assert_array_equal(one.joints_mm, other.joints_mm)
    assert not np.array_equal(second.depth, windows.depth)


# sessions


def test_a_session_is_a_recording_that_reads_the_same_in_any_order(
    session: RenderedRecording,
) -> None:
    late = session.frame(9).depth
    again = MouseSpecies().film([5, 1], 12, sensor=SENSORS[1])
    np.testing.assert_array_equal(late, again.frame(9).depth)
    chunks = [frame for chunk in session.chunks(5) for frame in chunk]
    assert [frame.index for frame in chunks] == list(range(12))
    np.testing.assert_array_equal(chunks[9].depth, late)
    assert late.shape == (session.height, session.width)
    assert (late >= 0).all()
    assert np.all(np.diff(session.times_ns) > 0)


def test_the_animal_and_the_floor_are_where_the_truth_says(session: RenderedRecording) -> None:
    T = session.T_arena_camera
    np.testing.assert_allclose(T @ session.joints_camera, session.joints_arena, atol=1e-6)
    np.testing.assert_allclose(session.floor.T_arena_camera.rotation, T.rotation, atol=1e-9)
    uv = session.camera.project(session.joints_camera)
    hits = 0
    for i, frame in enumerate(session):
        c, r = np.round(uv[i, 1]).astype(int)
        read = frame.depth[r - 1 : r + 2, c - 1 : c + 2]
        hits += bool((np.abs(read[read > 0] - session.joints_camera[i, 1, 2] + 14) < 14).any())
    assert hits >= 11
    centre = T.inverse() @ [*session.stage.scene.centre, 0.0]
    c, r = np.round(session.camera.project(centre)).astype(int)
    patch = (slice(r - 15, r + 15), slice(c - 15, c + 15))
    plane = session.floor.depth(session.width, session.height)
    assert np.median(np.abs(session.frame(0).depth[patch] - plane[patch])) < 6.0


def test_splits_are_fixed_halved_between_sensors_and_apart() -> None:
    clean, hard = (WORLD.test_split(name, n_sessions=2) for name in ("clean", "hard"))
    first = MouseSpecies().film([71_001, 0], sensor=SENSORS[0])
    np.testing.assert_array_equal(clean[0].depths(0, 1), first.depths(0, 1))
    assert [(s.width, len(s)) for s in clean + hard] == 2 * [(640, 50), (512, 50)]
    assert not any((s.stage.objects[0].moment >= 0).any() for s in clean)
    assert 0.3 < np.mean([s.stage.objects[0].moment >= 0 for s in hard]) < 0.65
    assert len({s.spine_mm for s in clean + hard}) == 4
    assert WORLD.test_split("clean", spine_mm=80.0, n_sessions=1)[0].spine_mm == 80.0
    with pytest.raises(LiexError, match="known are clean, hard, other-body, other-camera"):
        WORLD.test_split("easy")
    assert [split_of(SEALED, k) for k in range(5)] == [*SPLITS, "clean"]
    for s in hard:  # another object never touches the animal in the image
        (item,) = s.stage.objects
        for i in np.flatnonzero(item.moment >= 0)[:6]:
            mesh = s.camera.project(s.T_arena_camera.inverse() @ item.vertices()[i])
            body = s.camera.project(s.joints_camera[i])
            assert np.linalg.norm(mesh[:, None] - body, axis=-1).min() > 4.0


@pytest.mark.parametrize(
    "animal", ["mouse", *(pytest.param(a, marks=pytest.mark.nightly) for a in ("fish", "hand"))]
)
def test_other_cameras_have_a_focal_length_outside_the_training(animal: str) -> None:
    world = world_of(Skeleton.load(animal))
    sensors = world.sensors
    others = {r.camera.fx for r in world.test_split("other-camera", n_sessions=2)}
    for whole in others:
        for sensor in sensors:  # training varies the focal length by 3 %
            assert abs(np.log(sensor.camera.fx / whole)) > 0.09
    assert others != {r.camera.fx for r in world.test_split("clean", n_sessions=2)}


def test_a_walk_is_continuous_and_shows_every_kind_of_posture() -> None:
    s = MouseSpecies().motion(4, 450)
    speed = np.linalg.norm(np.diff(s.joints_arena, axis=0), axis=-1) * s.rate_hz
    assert speed.max() < 600.0
    assert np.linalg.norm(np.ptp(s.joints_arena[:, 0], axis=0)) > s.spine_mm
    assert s.joints_arena[:, 4, 2].max() > 0.7 * s.spine_mm  # it rears
    assert (s.stage.scene.wall_clearance(s.joints_arena[..., :2]) > 0).all()
    uv = s.camera.project(s.joints_camera)
    assert ((uv > 0) & (uv < [s.width - 1, s.height - 1])).all()
