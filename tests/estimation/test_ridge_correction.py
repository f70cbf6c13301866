"""A finished pose settles under its back: what is seen along it, and what a linear map makes of
that.
"""

import numpy as np
import pytest
from scipy.interpolate import interp1d
from scipy.spatial import cKDTree

from liex_lab.body.pose import Pose
from liex_lab.body.skeleton import Skeleton
from liex_lab.estimation import _feature_kernels as kernels
from liex_lab.estimation.cascade import ImageSet
from liex_lab.estimation.refine import RidgeCorrection, tangents
from liex_lab.geometry import SE3, so3

FISH = Skeleton.load("fish")
SIDE, STEP, FOCAL, DISTANCE = 96, 1.0, 600.0, 300.0
MM_PER_PX = 0.5  # at the height of the toy fish's back
THICK_MM, HALF_WIDTH_MM = 2.0, 2.0


def look() -> np.ndarray:
    """How the toy's maps are cut: an upright camera DISTANCE above the view's origin, the origin in
    the middle.
    """
    middle = (SIDE - 1) / 2.0
    return np.array(
        [FOCAL, FOCAL, middle, middle, 1, 0, 0, 0, -1, 0, 0, 0, -1, DISTANCE, 0, 0, STEP]
    )


def fish(n: int, seed: int) -> Pose:
    """Fish of 0.8 to 1.2 of the home size that hang near 20 mm of height, rise a little and bend a
    little.
    """
    rng = np.random.default_rng(seed)
    angles = np.zeros((n, FISH.n_joints, 3))
    angles[:, 1:-1, 2] = np.radians(rng.uniform(-4, 4, (n, 1)))
    turn = np.stack([np.zeros(n), np.zeros(n), rng.uniform(-np.pi, np.pi, n)], 1)
    lift = np.stack([np.zeros(n), rng.normal(0, 0.08, n), np.zeros(n)], 1)
    pose = Pose(
        SE3(so3.exp(turn) @ so3.exp(lift), np.zeros((n, 3))), angles, rng.uniform(0.8, 1.2, n)
    )
    pose.root.translation[:] = np.array([0.0, 0.0, 20.0]) - pose.joints(FISH).mean(axis=1)
    return pose


def maps(pose: Pose) -> np.ndarray:
    """Height maps (n, S, S) of backs THICK_MM above the chains, as wide as a fish of that size."""
    grid = (np.arange(SIDE) - (SIDE - 1) / 2.0) / FOCAL
    rays = np.stack(np.meshgrid(grid, -grid), axis=-1)
    out = np.zeros((len(pose.scale), SIDE, SIDE), np.int16)
    for i, joints in enumerate(pose.joints(FISH)):
        fine = interp1d(np.arange(21), joints, axis=0)(np.linspace(0, 20, 201))
        z = DISTANCE - fine[:, 2]
        off, nearest = cKDTree(fine[:, :2] / z[:, None]).query(rays)
        inside = off * z[nearest] < HALF_WIDTH_MM * pose.scale[i]
        out[i] = np.where(inside, 16.0 * (fine[nearest, 2] + THICK_MM * pose.scale[i]) + 0.5, 0)
    return out


def wrong(pose: Pose, seed: int) -> tuple[Pose, np.ndarray]:
    """The same fish too high or too low, too steep, and taken for one of another size (n,)."""
    rng, n = np.random.default_rng(seed), len(pose.scale)
    size = pose.scale * np.exp(rng.normal(0, 0.05, n))
    lift = np.stack([np.zeros(n), rng.normal(0, 0.05, n), np.zeros(n)], 1)
    off = Pose(SE3(pose.root.rotation @ so3.exp(lift), np.zeros((n, 3))), pose.angles, size)
    middle = pose.joints(FISH).mean(axis=1) + np.stack(
        [np.zeros(n), np.zeros(n), rng.normal(0, 0.6, n)], 1
    )
    off.root.translation[:] = middle - off.joints(FISH).mean(axis=1)
    return off, size


def images_of(heights: np.ndarray) -> ImageSet:
    return ImageSet(heights, np.tile(look(), (len(heights), 1)), np.zeros((len(heights), 9)))


@pytest.fixture(scope="module")
def settler() -> RidgeCorrection:
    true = fish(250, 1)
    off, size = wrong(true, 2)
    return RidgeCorrection.fit(
        FISH, off, images_of(maps(true)), size, true.joints(FISH), true.scale
    )


def test_the_height_of_the_back_over_a_joint_leaves_gross_errors_out():
    heights, out = np.zeros((SIDE, SIDE), np.int16), np.empty(2)
    heights[40:50, 40:56] = 16 * 25
    heights[46, 46] = 16 * 60
    kernels.back_over(heights, look(), np.array([-0.5, 0.5, 20.0]), 3.0, out)
    assert out.tolist() == [5.0, 1.0]
    kernels.back_over(heights, look(), np.array([30.0, 0.0, 20.0]), 3.0, out)
    assert out.tolist() == [0.0, 0.0]


@pytest.mark.parametrize("short_mm", [-3.0, 0.0, 2.0])
def test_where_the_animal_ends_past_its_chain(short_mm):
    heights = np.zeros((SIDE, SIDE), np.int16)
    heights[44:52, 20:70] = 16 * 20  # ends at column 69: (69 - 47.5) / 600 * 280 mm
    end = np.array([(69.5 - 47.5) / FOCAL * (DISTANCE - 20.0) - short_mm, 0.0, 20.0])
    past = kernels.end_past(heights, look(), end, end - [1.5, 0.0, 0.0], 5.0)
    assert past == pytest.approx(short_mm, abs=1.5 * 280.0 / FOCAL)  # it looks a pixel to each side


def test_wrong_poses_settle_and_tell_the_size(settler):
    true = fish(60, 5)
    off, size = wrong(true, 6)
    before: list[float] = []
    after: list[float] = []
    told: list[float] = []
    heights = maps(true)
    for i in range(len(size)):
        one = off[np.array([i])]
        images = images_of(heights[i : i + 1])
        corrected, grown, clear = settler.correct(one, images, float(size[i]))
        for pose, errors in ((one, before), (corrected, after)):
            errors.append(np.abs(pose.joints(FISH)[0, :, 2] - true.joints(FISH)[i, :, 2]).mean())
        told.append(np.log(size[i] / true.scale[i]) + grown[0])
        assert clear[0] > 0.5
    assert np.mean(after) < 0.35 * np.mean(before)
    assert np.mean(np.abs(told)) < 0.5 * np.mean(np.abs(np.log(size / true.scale)))


def test_a_pose_that_sees_nothing_stays_near_where_it_is(settler):
    off, size = wrong(fish(1, 7), 8)
    nothing = images_of(np.zeros((1, SIDE, SIDE), np.int16))
    corrected, grown, clear = settler.correct(off, nothing, float(size[0]))
    assert np.linalg.norm(corrected.joints(FISH) - off.joints(FISH), axis=-1).max() < 6.0
    assert abs(grown[0]) < 0.5
    assert clear[0] == 0.0


def test_tangents_follow_the_chain_in_the_pictures_plane():
    way = tangents(fish(5, 9).joints(FISH))
    np.testing.assert_allclose(np.linalg.norm(way, axis=-1), 1.0)
    assert (way[..., 2] == 0).all()
