"""The fish: what real ones do it can do, too, and it hangs anywhere in the water."""

from pathlib import Path

import numpy as np
import pytest

from liex_lab.body.shape import Surface
from liex_lab.body.skeleton import Skeleton
from liex_lab.simulation.pose_prior import FISH_KINDS, draw_bends
from liex_lab.simulation.species import FishSpecies
from liex_lab.simulation.training_patches import TrainingPatches

FISH = Skeleton.load("fish")


@pytest.fixture(scope="module")
def pictures() -> TrainingPatches:
    """Training windows of fish."""
    return next(FishSpecies().training_blocks(3, 1, window_px=272))[:16]


def real_bends(reference_data: Path) -> np.ndarray:
    """Bends (n, 19) rad at the inner joints of annotated fish, signed by the side of the fish's own
    plane.
    """
    xyz = np.loadtxt(reference_data / "liex_tracks" / "fish_S1_frames_1_16.txt").reshape(-1, 21, 3)
    bones = np.diff(xyz, axis=1)
    bones /= np.linalg.norm(bones, axis=-1, keepdims=True)
    up = np.array([0.0, 0.0, 1.0])  # the camera looks along -z, and the fish are nearly level
    across = np.cross(bones[:, :-1], bones[:, 1:]) @ up
    return np.arctan2(across, np.sum(bones[:, :-1] * bones[:, 1:], axis=-1))


def test_every_real_posture_is_near_one_that_is_drawn(reference_data):
    rng = np.random.default_rng(0)
    drawn = draw_bends(rng, FISH, rng.integers(len(FISH_KINDS), size=20_000))[:, 1:20]
    for real in real_bends(reference_data):
        off = np.sqrt(np.mean((drawn - real) ** 2, axis=1)).min()
        assert (
            np.degrees(off) < 1.6
        )  # a joint; annotations hold two arcs, whole bodies of drawn ones wave a little


def test_bends_stay_within_the_joints_limits_and_the_hind_half_does_most_of_them():
    rng = np.random.default_rng(2)
    bends = draw_bends(rng, FISH, rng.integers(len(FISH_KINDS), size=3000))
    assert (bends >= FISH.limits[:, 2, 0]).all()
    assert (bends <= FISH.limits[:, 2, 1]).all()
    assert (bends[:, [0, 20]] == 0).all()
    front, hind = np.abs(bends[:, 1:10]).mean(), np.abs(bends[:, 11:20]).mean()
    assert 1.2 * front < hind < 3.0 * front


def test_the_joints_lie_within_the_fish_of_the_picture(pictures):
    uv = (
        pictures.joints_mm[..., :2] / pictures.joints_mm[..., 2:] * pictures.intrinsics[:, None, :2]
    )
    uv = np.rint(uv + pictures.intrinsics[:, None, 2:] - pictures.origin[:, None]).astype(int)
    for i in range(len(pictures)):
        depth, still = (
            picture[i] * pictures.unit_mm for picture in (pictures.depth, pictures.background)
        )
        inner = uv[i, 1:14]
        here, behind = depth[inner[:, 1], inner[:, 0]], still[inner[:, 1], inner[:, 0]]
        read = (here > 0) & (behind > 0)
        # the back is nearer than the mid-axis, by no more than half a fish's height
        assert ((pictures.joints_mm[i, 1:14, 2] - here)[read] > -3.0).mean() > 0.9
        assert ((behind - here)[read] > 2.0).mean() > 0.8


def test_fish_hang_between_the_floor_and_the_nearest_that_the_camera_sees_whole():
    rng = np.random.default_rng(4)
    species, n = FishSpecies(), 600
    size, camera_mm = rng.uniform(0.6, 1.5, n), rng.uniform(230.0, 330.0, n)
    shape = species.shapes(rng, "train", n)
    pose, girth = species.postures(rng, size, shape, camera_mm)
    z = Surface.of(FISH).vertices(pose, shape, girth)[..., 2]
    assert z.min() > 0.0
    assert (camera_mm - z.max(axis=1)).min() > 140.0
    height = z.mean(axis=1) / camera_mm
    assert np.quantile(height, 0.05) < 0.06
    assert np.quantile(height, 0.95) > 0.28


def test_a_swimming_fish_goes_head_first_and_stays_in_the_picture():
    fish = FishSpecies().motion(6, 150)
    uv = fish.camera.project(fish.joints_camera)
    assert ((uv > 0) & (uv < 1023)).all()
    middle = fish.joints_arena.mean(axis=1)
    step = np.diff(middle, axis=0)
    speed = np.linalg.norm(step, axis=1) * fish.rate_hz / fish.spine_mm
    assert speed.max() < 8.0  # lengths a second
    assert np.median(speed) > 0.1
    ahead = fish.joints_arena[:-1, 0] - fish.joints_arena[:-1, 10]
    cosine = (
        np.sum(step * ahead, axis=1) / np.linalg.norm(step, axis=1) / np.linalg.norm(ahead, axis=1)
    )
    assert np.median(cosine[speed > 0.5]) > 0.9
