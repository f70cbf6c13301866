"""What a candidate sees is what the camera sees, and corrections are the group's own products."""

import numpy as np
import pytest

from liex_lab.body.pose import KinematicTree, forward_kinematics
from liex_lab.body.skeleton import Skeleton
from liex_lab.estimation import _feature_kernels as kernels
from liex_lab.forests._kernels import VIEW
from liex_lab.geometry import SE3, so3
from liex_lab.optics.camera import KINECT_V2, PRIMESENSE, Camera
from liex_lab.scene.floor import Floor
from liex_lab.scene.height_maps import HeightMaps
from tests.scene.staged import bare_floor

REACH = 50.0


class Window:
    """One height map's look, and the exact way from a point of its view frame to a crop pixel."""

    def __init__(self, camera: Camera, tilt_deg: float, step: int, camera_view: bool) -> None:
        tilt = np.radians(tilt_deg)
        floor = Floor.from_plane(
            np.array([np.sin(tilt), -0.4 * np.sin(tilt), np.cos(tilt)]), 700.0, camera
        )
        scene = bare_floor(camera, floor)
        distance = 655.0 if camera_view else floor.distance_mm
        origin = np.array([[camera.width // 2 - 30, camera.height // 2 - 70]], np.int32)
        crops = HeightMaps(
            np.zeros((1, 96, 96), np.int16),
            origin,
            np.array([step], np.int32),
            np.ones(1, np.int64),
            np.zeros((1, 9)),
            np.array([distance]),
            np.ones(1, np.int64),
            np.full((1, 4, 4), np.nan),
        )
        self.look = scene.crop_cameras(crops, camera_view)[0]
        self.camera, self.origin, self.step = camera, origin[0], step
        self.T_camera_view = SE3(
            scene.view_rotation(camera_view), np.array([0.0, 0.0, distance])
        ).inverse()

    def crop_pixel(self, p_view: np.ndarray) -> np.ndarray:
        """Crop pixels (..., 2) under points (..., 3) mm of the view frame."""
        return (self.camera.project(self.T_camera_view @ p_view) - self.origin) / self.step

    def view(
        self, rotation: np.ndarray, position: np.ndarray, size: float = 1.0, reach: float = REACH
    ) -> np.ndarray:
        view = np.empty(VIEW)
        kernels.fill_view(rotation, position, self.look, size, reach, view)
        return view


CASES = (
    (PRIMESENSE, 0.0, 1, False),
    (PRIMESENSE, 9.0, 2, False),
    (KINECT_V2, 5.0, 1, False),
    (Camera(900.0, 850.0, 500.0, 420.0, 1024, 1024), 12.0, 3, False),
    (KINECT_V2, 7.0, 2, True),
)
WINDOWS = [Window(*case) for case in CASES]


def drawn_joint(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    return so3.exp(rng.normal(0, 1.0, 3)), rng.uniform([-120, -90, 2], [120, 90, 60])


@pytest.mark.parametrize("window", WINDOWS)
def test_a_joint_and_offsets_from_it_are_seen_as_the_exact_projection_sees_them(window):
    """Offsets to first order."""
    rng = np.random.default_rng(1)
    for size in (0.8, 1.0, 1.9):
        rotation, position = drawn_joint(rng)
        view = window.view(rotation, position, size)
        np.testing.assert_allclose(view[:2], window.crop_pixel(position), atol=1e-9)
        assert view[8] == pytest.approx(16.0 * position[2] / size)
        step = 1e-3 * REACH * size / 127.0 * rotation.T
        ahead, behind = (window.crop_pixel(position + sign * step) for sign in (1, -1))
        np.testing.assert_allclose(view[2:8].reshape(2, 3).T, (ahead - behind) / 2e-3, atol=1e-8)


@pytest.mark.parametrize(("turned", "grown"), [(0.7, 1.0), (-2.9, 1.0), (0.0, 1.6), (2.0, 0.7)])
def test_the_numbers_about_the_whole_animal_do_not_change_when_it_turns_or_grows(turned, grown):
    rng = np.random.default_rng(5)
    rotation, position = drawn_joint(rng)
    moments = np.array([900.0, 1300.0, 21000.0, 12.0, -7.0, 0.4, 16.0, 7.0, 0.2])
    before, after = np.empty((2, kernels.N_SCALARS))
    kernels.fill_scalars(rotation, position, 0.95, moments, 1.0, before)
    turn = so3.exp(np.array([0.0, 0.0, turned]))
    centre = grown * turn[:2, :2] @ moments[3:5]
    moved = moments * [1, grown**2, grown**3, 0, 0, 1, grown, grown, 1] + [
        0,
        0,
        0,
        *centre,
        turned,
        0,
        0,
        0,
    ]
    kernels.fill_scalars(
        turn @ rotation, grown * turn @ position, 0.95 * grown, moved, grown, after
    )
    np.testing.assert_allclose(after, before, atol=1e-8)


@pytest.mark.parametrize("animal", ["mouse", "fish", "hand"])
def test_joints_placed_and_turned_one_after_the_other_give_the_forward_kinematics(animal):
    rng = np.random.default_rng(9)
    skeleton = Skeleton.load(animal)
    angles = rng.normal(0, 0.4, (skeleton.n_joints, 3)) * skeleton.axes
    angles[0] = 0.0
    root, scale = SE3(*drawn_joint(rng)), 1.13
    expected = forward_kinematics(skeleton, root, angles, np.array(scale))
    rotations, positions = np.zeros((skeleton.n_joints, 3, 3)), np.zeros((skeleton.n_joints, 3))
    rotations[0], positions[0] = root.rotation, root.translation
    tree, home = KinematicTree.of(skeleton), (scale, rotations, positions)
    for joint in skeleton.solved[1:]:
        kernels.place_joint(joint, tree, tree.rest[joint], *home)
        kernels.correct_joint(
            rotations[joint], skeleton.axes[joint], angles[joint][skeleton.axes[joint]], 1.0
        )
    solved = (rotations.copy(), positions.copy())
    kernels.place_rest(np.array(skeleton.solved), tree, *home)
    np.testing.assert_allclose(rotations, expected[0], atol=1e-12)
    np.testing.assert_allclose(positions, expected[1], atol=1e-10)
    np.testing.assert_array_equal(rotations[skeleton.solved], solved[0][skeleton.solved])
    np.testing.assert_array_equal(positions[skeleton.solved], solved[1][skeleton.solved])
