"""A pose taken into the picture: its slopes are true, it goes where the readings are, and it stays
a pose.
"""

from functools import cache

import numpy as np
import pytest
from scipy.ndimage import distance_transform_edt

from liex_lab.body.pose import Pose
from liex_lab.body.shape import Spheres, Surface, render_mesh
from liex_lab.body.skeleton import Skeleton
from liex_lab.estimation import _refine_kernels as kernels
from liex_lab.estimation._residual_kernels import place_balls
from liex_lab.estimation.cascade import ImageSet
from liex_lab.estimation.refine import Refiner
from liex_lab.geometry import SE3, so3
from liex_lab.optics.camera import Camera
from liex_lab.scene.floor import Floor
from liex_lab.scene.hand_segmenter import HandSegmenter, sight_rotations
from liex_lab.scene.height_maps import HeightMaps, view_of
from liex_lab.simulation.hand.postures import draw_postures, draw_turns
from tests.oracles.explain import explained

HAND = Skeleton.load("hand")
BALLS = Spheres.of(HAND)
REFINER = Refiner.of(HAND, BALLS)
CAMERA = Camera(300.0, 300.0, 159.5, 119.5, 320, 240)
SCENE = HandSegmenter(CAMERA, Floor.from_plane(np.array([0.0, 0.0, 1.0]), 900.0, CAMERA), HAND.view)


@cache
def hands(n: int = 24, seed: int = 0) -> tuple[HeightMaps, np.ndarray, Pose]:
    """Height maps of bare hands, how they were cut, and their poses in the view frames."""
    rng = np.random.default_rng(seed)
    angles, turns = draw_postures(rng, HAND, n), draw_turns(rng, n)
    place = np.column_stack([rng.uniform(-40, 40, (n, 2)), rng.uniform(600, 700, n)])
    pose = Pose(SE3(np.swapaxes(sight_rotations(place), 1, 2) @ turns, place), angles, np.ones(n))
    surface = Surface.of(HAND)
    depths = np.stack(
        [render_mesh(surface.vertices(pose[k]), surface.faces, CAMERA) for k in range(n)]
    )
    crops = SCENE.extract(depths, 1.0)
    crop_cameras = SCENE.crop_cameras(crops)
    return crops, crop_cameras, pose.moved(view_of(crop_cameras))


def shaken(pose: Pose, seed: int, strength: float = 1.0) -> Pose:
    """Poses about as far off as the regressors leave them."""
    rng = np.random.default_rng(seed)
    n = len(pose.scale)
    twist = strength * rng.normal(0.0, [0.1, 0.1, 0.1, 5.0, 5.0, 5.0], (n, 6))
    angles = pose.angles + strength * rng.normal(0.0, 0.2, pose.angles.shape) * HAND.axes
    angles = np.clip(angles, HAND.limits[..., 0], HAND.limits[..., 1])
    angles[:, 0] = 0.0
    return Pose(pose.root @ SE3.exp(twist), angles, pose.scale)


def alone(pose: Pose) -> Pose:
    """Poses (n) as (n, 1)."""
    root = SE3(pose.root.rotation[:, None], pose.root.translation[:, None])
    return Pose(root, pose.angles[:, None], pose.scale[:, None])


def refined(
    pose: Pose, heights: np.ndarray, crop_cameras: np.ndarray, size: float, n_steps: int
) -> Pose:
    after = REFINER.refine(alone(pose), heights, crop_cameras, size, n_steps)
    return Pose(
        SE3(after.root.rotation[:, 0], after.root.translation[:, 0]),
        after.angles[:, 0],
        after.scale[:, 0],
    )


def fit_of(
    pose: Pose, crops: HeightMaps, crop_cameras: np.ndarray, size: float = 1.0
) -> np.ndarray:
    images = ImageSet(crops.heights, crop_cameras, crops.moments)
    return REFINER.fit(alone(pose), images, size)[:, 0]


def off(a: Pose, b: Pose) -> np.ndarray:
    return np.linalg.norm(a.joints(HAND) - b.joints(HAND), axis=-1).mean(axis=1)


def test_poses_go_where_the_readings_are() -> None:
    crops, crop_cameras, true = hands()
    before = shaken(true, 1)
    after = refined(before, crops.heights, crop_cameras, 1.0, 8)
    assert np.median(off(after, true)) < 0.6 * np.median(off(before, true))
    assert (off(after, true) < off(before, true)).mean() > 0.85


def test_a_true_pose_stays_about_where_it_is() -> None:
    crops, crop_cameras, true = hands()
    assert np.median(off(refined(true, crops.heights, crop_cameras, 1.0, 8), true)) < 4.0


def test_joints_stay_within_their_limits_and_hinges_on_their_axes() -> None:
    crops, crop_cameras, true = hands()
    after = refined(shaken(true, 2, 3.0), crops.heights, crop_cameras, 1.0, 8)
    low, high = HAND.limits[..., 0], HAND.limits[..., 1]
    assert ((after.angles >= low - 1e-12) & (after.angles <= high + 1e-12))[:, 1:].all()
    np.testing.assert_allclose(np.linalg.det(after.root.rotation), 1.0)
    assert (after.angles[:, 0] == 0.0).all()


def test_of_several_poses_the_one_is_taken_that_lies_best_in_the_picture() -> None:
    crops, crop_cameras, true = hands()
    poses = [alone(shaken(true, 5, 6.0)), alone(true), alone(shaken(true, 6, 6.0))]
    both = Pose(
        SE3(
            *(
                np.concatenate([getattr(p.root, name) for p in poses], axis=1)
                for name in ("rotation", "translation")
            )
        ),
        np.concatenate([p.angles for p in poses], axis=1),
        np.concatenate([p.scale for p in poses], axis=1),
    )
    best, fit = REFINER.best(both, ImageSet(crops.heights, crop_cameras, crops.moments), 1.0, 2)
    near = refined(
        refined(true, crops.heights, crop_cameras, 1.0, 1), crops.heights, crop_cameras, 1.0, 1
    )
    taken = off(best, near) < 1e-9
    assert taken.mean() > 0.9
    np.testing.assert_allclose(fit[taken], fit_of(near, crops, crop_cameras)[taken])


def test_the_true_pose_explains_the_picture_best() -> None:
    crops, crop_cameras, true = hands()
    fit, wrong = (fit_of(pose, crops, crop_cameras) for pose in (true, shaken(true, 3, 2.0)))
    worse = wrong[:, [0, 1, 4, 5]] > fit[:, [0, 1, 4, 5]]
    assert (worse.mean(axis=0) > 0.9).all()


def test_explanations_agree_with_the_slow_twin() -> None:
    crops, crop_cameras, true = hands()
    pose = shaken(true, 4)
    fit, frames = fit_of(pose, crops, crop_cameras, 1.07), pose.frames(HAND)
    for k in range(4):
        slow = explained(
            crops.heights[k],
            crop_cameras[k],
            crops.moments[k, 5],
            BALLS,
            frames.rotation[k],
            frames.translation[k],
            float(pose.scale[k]),
            1.07,
        )
        np.testing.assert_allclose(fit[k], slow, rtol=1e-4, atol=1e-3)


def middles(root: SE3, angles: np.ndarray, scale: float) -> np.ndarray:
    """Middles (B, 3) of the balls of one pose, by the kernels' own forward kinematics."""
    rotations, positions = np.empty((HAND.n_joints, 3, 3)), np.empty((HAND.n_joints, 3))
    kernels.forward(
        REFINER.tree, root.rotation, root.translation, angles, scale, rotations, positions
    )
    out = np.empty((len(BALLS.radius), 3))
    place_balls(rotations, positions, scale, REFINER.body, out)
    return out


@pytest.mark.parametrize("k", [0, 5, 11])
def test_slopes_are_those_of_small_steps(k: int) -> None:
    _, _, pose = hands()
    root, angles = SE3(pose.root.rotation[k], pose.root.translation[k]), pose.angles[k]
    rotations, positions = np.empty((HAND.n_joints, 3, 3)), np.empty((HAND.n_joints, 3))
    kernels.forward(
        REFINER.tree, root.rotation, root.translation, angles, 1.0, rotations, positions
    )
    balls, free = middles(root, angles, 1.0), REFINER.tree.free
    axes = np.empty((len(free), 3))
    kernels.turning_axes(free, angles, rotations, axes)
    step = 1e-6
    ahead = [middles(root @ SE3.exp(step * np.eye(6)[i]), angles, 1.0) for i in range(6)]
    ahead.append(middles(root, angles, np.exp(step)))
    for joint, axis in free:
        moved = angles.copy()
        moved[joint, axis] += step
        ahead.append(middles(root, moved, 1.0))
    numeric = (np.stack(ahead, axis=-1) - balls[..., None]) / step
    slope = np.empty((3, 7 + len(free)))
    for b in range(BALLS.n_own):
        kernels.ball_slope(
            b,
            balls[b],
            REFINER.body,
            REFINER.tree,
            REFINER.free_angles,
            axes,
            rotations,
            positions,
            1.0,
            slope,
        )
        np.testing.assert_allclose(slope, numeric[b], atol=2e-3)


def test_the_nearest_reading_is_the_nearest() -> None:
    crops, _, _ = hands()
    known = np.full((96, 96, 2), -1, np.int32)
    true = distance_transform_edt(crops.heights[2] == 0)
    for r, c in np.argwhere(crops.heights[2] == 0)[::7]:
        kernels.nearest_reading(crops.heights[2], r, c, known)
        np.testing.assert_allclose(np.hypot(*(known[r, c] - [r, c])), true[r, c])


def test_a_chain_is_refined_as_well() -> None:
    mouse = Skeleton.load("mouse")
    refiner = Refiner.of(mouse, Spheres.of(mouse))
    assert refiner.free_angles.moves.shape == (mouse.n_joints, mouse.dof - 6)
    assert refiner.free_angles.moves[-1].all()  # every joint turns the tip
    turned = so3.exp(np.zeros((2, 3)))
    pose = Pose(SE3(turned, np.zeros((2, 3))), np.zeros((2, mouse.n_joints, 3)), np.ones(2))
    empty = np.zeros((2, 96, 96), np.int16)
    crop_cameras = np.tile(
        [300.0, 300.0, 0.0, 0.0, *np.diag([1.0, -1.0, -1.0]).ravel(), 600.0, 0.0, 0.0, 1.0], (2, 1)
    )
    assert np.isfinite(refiner.refine(alone(pose), empty, crop_cameras, 1.0, 3).joints(mouse)).all()
