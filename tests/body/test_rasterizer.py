"""The renderer against a ray through every pixel, and the laws a picture obeys."""

import numpy as np
import pytest

from liex_lab.body import Pose, Skeleton
from liex_lab.body.shape import Surface, render_mesh, render_meshes
from liex_lab.geometry import SE3
from liex_lab.optics.camera import KINECT_V2, Camera
from tests.oracles.raster import ray_cast_depth

CAMERA = Camera(200.0, 210.0, 30.0, 25.0, 64, 48)


def random_pose(animal: str, seed: int, z_mm: float) -> tuple[Surface, Pose]:
    rng = np.random.default_rng(seed)
    skeleton = Skeleton.load(animal)
    angles = rng.uniform(-0.4, 0.4, (skeleton.n_joints, 3)) * skeleton.axes
    angles[0] = 0.0
    twist = np.concatenate([rng.uniform(-1.5, 1.5, 3), np.zeros(3)])
    root = SE3(SE3.exp(twist).rotation, np.array([0.0, 0.0, z_mm]))
    return Surface.of(skeleton), Pose(root, angles, np.array(1.2))


@pytest.mark.parametrize(("animal", "z_mm"), [("mouse", 300.0), ("hand", 900.0)])
def test_pictures_agree_with_a_ray_through_every_pixel(animal: str, z_mm: float) -> None:
    surface, pose = random_pose(animal, 1, z_mm)
    window = (14, 10, 32, 30)
    fast = render_mesh(surface.vertices(pose), surface.faces, CAMERA, window)
    slow = ray_cast_depth(surface.vertices(pose), surface.faces, CAMERA, window)
    both = (fast > 0) & (slow > 0)
    assert both.sum() > 40
    # a ray along an edge may go either way
    assert ((fast > 0) != (slow > 0)).mean() < 1e-3
    np.testing.assert_allclose(fast[both], slow[both], rtol=3e-6)


def test_depth_across_a_tilted_triangle_is_perspective_correct() -> None:
    camera = Camera(100.0, 100.0, 50.0, 50.0, 101, 101)
    corners = np.array([[-200.0, -200.0, 300.0], [400.0, -200.0, 900.0], [0.0, 500.0, 600.0]])
    depth = render_mesh(corners, np.array([[0, 1, 2]], np.int32), camera)
    normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
    rows, columns = np.nonzero(depth)
    rays = camera.unproject(np.stack([columns, rows], -1), np.ones(len(rows)))
    np.testing.assert_allclose(
        depth[rows, columns], corners[0] @ normal / (rays @ normal), rtol=1e-6
    )
    assert len(rows) > 500


def test_what_is_behind_the_camera_is_not_drawn() -> None:
    surface, pose = random_pose("mouse", 4, -300.0)
    assert not render_mesh(surface.vertices(pose), surface.faces, CAMERA).any()


def test_a_batch_is_its_depth_images_one_by_one() -> None:
    surface, _ = random_pose("mouse", 5, 300.0)
    rng = np.random.default_rng(5)
    n, k = 20, KINECT_V2
    pose = Pose(SE3.exp(rng.uniform(-1, 1, (n, 6))), np.zeros((n, 5, 3)), rng.uniform(0.9, 1.1, n))
    T = SE3.identity(n)
    T.translation[:, 2] = 600.0
    vertices = surface.vertices(pose)
    intrinsics, origin = np.tile([k.fx, k.fy, k.cx, k.cy], (n, 1)), np.tile([210.0, 170.0], (n, 1))
    batch = render_meshes(vertices, surface.faces, T, intrinsics, origin, (96, 80))
    one = render_mesh(vertices[7], surface.faces, k, (210, 170, 96, 80), T[7])
    np.testing.assert_array_equal(batch[7], one)
