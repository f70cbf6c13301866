"""Renders an acting animal before a virtual depth camera: the patch around it, frame by frame.

The patches carry the floor as the camera would have estimated it, with an error. Whole pictures of
a long recording would be far more work than what an action recogniser needs of them.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from liex_lab.body.pose import Pose
from liex_lab.body.surface import Body, Surface
from liex_lab.foreground.height_maps import Patches
from liex_lab.geometry import SE3
from liex_lab.simulation import _render_kernels as render_kernels
from liex_lab.simulation._sensor_kernels import NORMAL, UNIT
from liex_lab.simulation.objects import PART_FACES, rounded
from liex_lab.simulation.scene import draw_views
from liex_lab.simulation.sensors import Sensor
from liex_lab.simulation.species import Species
from liex_lab.simulation.training_patches import inverse_depth_plane, window_origin

Array = NDArray[np.float64]

_BLOCK = 256  # frames rendered at a time


@dataclass(frozen=True)
class CameraPath:
    """One camera over a scene, at rest.

    Attributes:
        intrinsics: (4,) fx, fy, cx, cy of the pictures that are read, px.
        picture: (2,) their width and height, px.
        T_arena_camera: its pose.
        parameters: (N_PARAMETERS,) of the unit's sensor.
        floor_error: (3,) how far off the floor is estimated to be: slopes along x and y, rad, and
            mm farther below the camera.
    """

    intrinsics: Array
    picture: NDArray[np.int64]
    T_arena_camera: SE3
    parameters: Array
    floor_error: Array

    @staticmethod
    def draw(
        rng: np.random.Generator,
        species: Species,
        sensor: Sensor,
        fur: Array,
        height_mm: float,
        stride: int,
    ) -> CameraPath:
        """A camera of a make at a given height, of whose pixels every `stride`-th is read.

        Its picture is twice as wide and high as the sensor's, so that an animal has space for long
        stretches of action.

        Args:
            rng: source of randomness.
            species: the species; its scene's tilt and scale are drawn from.
            sensor: the camera's make.
            fur: (1,) of the animal, from 0 to 1.
            height_mm: of the camera above the floor, mm.
            stride: px of the sensor that one pixel stands for.

        Returns:
            The camera.
        """
        camera = sensor.camera.every(stride)
        focal = rng.uniform(0.98, 1.02) * np.array([camera.fx, camera.fy])
        T = draw_views(rng, 1, species.setting)
        place = SE3(T.rotation[0], np.array([0.0, 0.0, height_mm]))
        parameters = replace(sensor, stride=stride).coarse(sensor.draw(rng, 1, fur))[0]
        margin = np.array([camera.width, camera.height]) / 2.0
        picture = np.array([camera.width, camera.height]) + (2 * margin).astype(np.int64)
        error = rng.standard_normal(3) * [0.002, 0.002, 0.5 * species.setting.scale]
        return CameraPath(
            np.array([*focal, camera.cx + margin[0], camera.cy + margin[1]]),
            picture,
            place,
            parameters,
            error,
        )


def render_agent(
    rng: np.random.Generator,
    species: Species,
    camera: CameraPath,
    shape: Body,
    pose: Pose,
    girth: Array,
    walls: Array | None,
    window_px: int,
) -> Iterator[Patches]:
    """Patches around an animal in given poses, 256 frames at a time.

    Args:
        rng: source of randomness, for the noise and the tail.
        species: the species.
        camera: that looks at it.
        shape: its body, a batch of which the first counts.
        pose: (n) arena frame.
        girth: (n,) factor of all lengths across the body.
        walls: (n, WALL_COLUMNS) the wall that each frame shows; None shows none.
        window_px: side of the patches, px.

    Yields:
        Up to 256 patches: depth and background float32 mm with the camera's intrinsics and floor.
    """
    surface = Surface.of(species.skeleton)
    n = len(girth)
    seeds = rng.integers(1, 2**63, n).astype(np.uint64)
    bends = species.bends(rng, 1)
    for start in range(0, n, _BLOCK):
        part = slice(start, min(start + _BLOCK, n))
        m = part.stop - part.start
        lying = None if bends is None else np.repeat(bends, m, axis=0)
        vertices = surface.vertices(pose[part], shape[0].broadcast(m), girth[part], lying)
        T = SE3(
            np.tile(camera.T_arena_camera.rotation, (m, 1, 1)),
            np.tile(camera.T_arena_camera.translation, (m, 1)),
        )
        intrinsics = np.tile(camera.intrinsics, (m, 1))
        trunk = vertices[:, : surface.n_trunk_vertices]
        origin = window_origin(trunk, T.inverse(), intrinsics, window_px)
        depth = np.empty((m, window_px, window_px), np.uint16)
        background = np.empty_like(depth)
        nothing = rounded(np.zeros((m, 3)), np.ones((m, 3)), np.zeros(m), np.full(m, 2.0))
        render_kernels.draw_windows(
            render_kernels.Meshes(
                vertices, surface.faces, nothing, PART_FACES, np.zeros(m, np.bool_)
            ),
            render_kernels.PatchCamera(intrinsics, np.tile(camera.picture, (m, 1)), origin),
            render_kernels.ArenaView(
                T.rotation,
                T.translation[:, 2].copy(),
                np.zeros((m, render_kernels.WALL_COLUMNS)) if walls is None else walls[part],
                np.zeros(m),
            ),
            render_kernels.SensorNoise(np.tile(camera.parameters, (m, 1)), seeds[part], NORMAL),
            depth,
            background,
        )
        unit = np.float32(camera.parameters[UNIT])
        floor = inverse_depth_plane(T, intrinsics, np.tile(camera.floor_error, (m, 1)))
        yield Patches(
            depth * unit,
            background * unit,
            intrinsics,
            origin.astype(float),
            floor,
            species.skeleton.view,
        )
