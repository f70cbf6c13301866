"""Small stages for stories about scenes: an arena anywhere, and a mouse that walks in it."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from unittest.mock import patch

import numpy as np

from liex_lab.geometry import SE3
from liex_lab.optics.camera import Camera
from liex_lab.recordings.recording import Recording
from liex_lab.scene.background_segmenter import BackgroundSubtraction
from liex_lab.scene.floor import Floor
from liex_lab.simulation.recording import RenderedRecording
from liex_lab.simulation.scene import BOX, SimulatedScene
from liex_lab.simulation.sensors import PRIMESENSE_QVGA_SENSOR
from liex_lab.simulation.species import MouseSpecies

CAMERA = PRIMESENSE_QVGA_SENSOR.camera


def bare_floor(camera: Camera, floor: Floor, min_height_mm: float = 7.0) -> BackgroundSubtraction:
    """A segmenter whose background is the floor plane alone."""
    bare = floor.depth(camera.width, camera.height)
    limit = np.maximum(bare - np.float32(min_height_mm), 0).astype(np.float32)
    return BackgroundSubtraction(camera, floor, bare, limit, np.ones(bare.shape, np.bool_))


def view(height_mm: float, tilt_deg: float = 0.0) -> SE3:
    """A camera so high above the arena's floor and tilted by so much."""
    tilt = np.radians(tilt_deg)
    up = -np.array([0.0, np.sin(tilt), np.cos(tilt)])
    x = np.array([1.0, 0.0, 0.0])
    return SE3(np.stack([x, np.cross(up, x), up]), np.array([0.0, 0.0, height_mm]))


def stage(
    half_mm: tuple[float, float] = (150.0, 150.0),
    *,
    height_mm: float = 900.0,
    wall_mm: float = 120.0,
    raised_mm: float = 0.0,
    tilt_deg: float = 0.0,
    centre_mm: tuple[float, float] = (0.0, 0.0),
    room: bool = True,
) -> SimulatedScene:
    """A box of an arena, raised above the floor of the room, which is in view all around it."""
    T = view(height_mm, tilt_deg)
    middle = CAMERA.unproject(np.array([CAMERA.cx, CAMERA.cy]), np.array(1.0))
    d = T.rotation @ middle
    foot = -height_mm / d[2] * d[:2] + np.array(centre_mm)
    empty = np.zeros((0, 0), np.float32)
    half = np.array(half_mm)
    scene = SimulatedScene(CAMERA, T, BOX, foot, half, 0.0, wall_mm, np.zeros((0, 2)), empty)
    u, v = np.meshgrid(np.arange(CAMERA.width), np.arange(CAMERA.height))
    rays = CAMERA.unproject(np.stack([u, v], axis=-1), np.ones(u.shape)) @ T.rotation.T
    fall = np.maximum(-rays[..., 2], 1e-3)
    on_floor = height_mm / fall
    inside = scene.wall_clearance(on_floor[..., None] * rays[..., :2]) > 0
    wall = scene._wall_distance(rays)
    high = height_mm + wall * rays[..., 2]
    on_wall = ~inside & (wall > 0) & (high > 0) & (high < wall_mm)
    around = (height_mm + raised_mm) / fall if room else np.zeros(u.shape)
    still = np.where(inside, on_floor, np.where(on_wall, wall, around))
    return replace(scene, still=still.astype(np.float32))


def walk(scene: SimulatedScene, n_frames: int = 96, seed: int = 5, **more) -> RenderedRecording:
    """A mouse of 65 mm that walks on a stage."""
    with patch.object(SimulatedScene, "draw", staticmethod(lambda *_: scene)):
        return MouseSpecies().motion(
            seed, n_frames, sensor=PRIMESENSE_QVGA_SENSOR, spine_mm=65.0, **more
        )


@cache
def walked(n_frames: int = 64) -> tuple[RenderedRecording, np.ndarray]:
    """A mouse that walks in a plain arena, and its depth images, rendered once."""
    mouse = walk(stage((170.0, 150.0), height_mm=700.0, room=False), n_frames)
    return mouse, mouse.depths(0, n_frames)


@cache
def on_a_table(n_frames: int = 24) -> tuple[RenderedRecording, np.ndarray]:
    """The same in an arena on a table, with the floor of the room in view."""
    mouse = walk(stage(height_mm=700.0, raised_mm=480.0), n_frames)
    return mouse, mouse.depths(0, n_frames)


def shown(depths: np.ndarray) -> Recording:
    """A recording of these images."""
    return Recording(
        name="shown",
        format="synthetic",
        camera=CAMERA,
        times_ns=np.arange(len(depths)) * 33_333_333,
        read=lambda k: depths[k],
    )


def altered(depths: np.ndarray, change: Callable[[int, np.ndarray], np.ndarray]) -> Recording:
    """A recording of these images, each changed by `change(number, image)`."""
    return shown(np.stack([change(k, one).astype(np.float32) for k, one in enumerate(depths)]))
