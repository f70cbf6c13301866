"""Synthetic training set for regression forests: rendered depth patches with exact poses.

Domain randomisation: each image draws camera tilt and height, intrinsics, floor, walls,
neighbouring objects, body shape, posture and sensor noise at random, and keeps the exact pose as
its label. Images come in mini-sessions of `PER_SESSION` that share camera, floor, animal and
sensor, as the frames of a recording do. They are made in blocks; a block depends only on the seed
and its number, so that any part of a set can be reproduced bit for bit.

The floor is stored as inverse depth, 1 / z = a u + b v + c, which is linear in the pixel (u, v) for
a plane in a pinhole image.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from liex_lab.body.pose import Pose
from liex_lab.body.shape import Body, Surface
from liex_lab.geometry import SE3
from liex_lab.runtime.memory import Rows
from liex_lab.runtime.processes import in_parallel
from liex_lab.simulation import _render_kernels as render_kernels
from liex_lab.simulation._sensor_kernels import (
    ANIMAL,
    EROSION,
    N_PARAMETERS,
    NOISE,
    NORMAL,
    OBJECT,
)
from liex_lab.simulation.scene import PART_FACES, SceneSpec, draw_views, rounded
from liex_lab.simulation.species import Species

Array = NDArray[np.float64]

PER_SESSION = 8
BLOCK = 512  # images made from one generator


@dataclass(frozen=True)
class TrainingPatches(Rows):
    """Depth patches of S x S pixels around an animal, n of them, with their truth.

    Attributes:
        depth: (n, S, S) uint16 depth image, steps of `unit_mm`, 0 = unread.
        background: (n, S, S) uint16, likewise: the still scene as learned from a recording.
        origin: (n, 2) int32, the full image's pixel (u, v) of patch pixel (0, 0).
        intrinsics: (n, 4) fx, fy, cx, cy of the full image, px.
        floor: (n, 3) plane 1 / z = a u + b v + c in pixels of the full image, as estimated.
        root: (n) T_camera_root, the base joint in the camera frame.
        angles: (n, J, 3) joint angles, rad.
        scale: (n,) of this frame's bones over those of the skeleton.
        joints_mm: (n, J, 3) joints in the camera frame, mm.
        spine_mm: (n,) the animal's own size, mm, constant over its mini-session.
        body: (n) the animals' bodies, likewise.
        unit_mm: step of the stored depths, mm.
        spread_mm: (n,) standard deviation of the floor's readings, mm, or 0 if negligible.
        own_bones: whether `joints_mm` are those of each body's own proportions, which differ from
            the skeleton's.
    """

    depth: NDArray[np.uint16]
    background: NDArray[np.uint16]
    origin: NDArray[np.int32]
    intrinsics: Array
    floor: Array
    root: SE3
    angles: Array
    scale: Array
    joints_mm: Array
    spine_mm: Array
    body: Rows
    unit_mm: float = 1.0
    spread_mm: Array | float = 0.0
    own_bones: bool = False

    def __len__(self) -> int:
        """Number of patches n."""
        return len(self.depth)


@dataclass(frozen=True)
class Views(Rows):
    """Cameras above a floor, n of them.

    Attributes:
        intrinsics: (n, 4) fx, fy, cx, cy of the rendered images, px.
        size_px: (n, 2) int64, their width and height, px.
        T_arena_camera: (n) poses, the arena frame's origin at the cameras' feet.
        parameters: (n, N_PARAMETERS) of the units' sensors.
        rough: (n,) unevenness of the floor, mm.
        floor_error: (n, 3) errors of the estimated floor: slopes along the arena's x and y, rad,
            and additional distance below the camera, mm.
    """

    intrinsics: Array
    size_px: NDArray[np.int64]
    T_arena_camera: SE3
    parameters: Array
    rough: Array
    floor_error: Array

    @property
    def floor(self) -> Array:
        """Inverse-depth coefficients of the estimated floor, 1 / z = a u + b v + c.

        With n the floor's unit normal in the camera frame and d its distance, a = n_x / (fx d), b =
        n_y / (fy d) and c = n_z / d - a cx - b cy.

        Returns:
            (n, 3) a, b, c in 1/mm per pixel and 1/mm.
        """
        wrong = self.floor_error
        slope = np.stack([wrong[:, 0], wrong[:, 1], -np.ones(len(wrong))], axis=-1)
        slope /= np.linalg.norm(slope, axis=-1, keepdims=True)
        normal = np.einsum("nji,nj->ni", self.T_arena_camera.rotation, slope)
        distance = self.T_arena_camera.translation[:, 2] + wrong[:, 2]
        a, b = (normal[:, k] / self.intrinsics[:, k] / distance for k in range(2))
        c = normal[:, 2] / distance - a * self.intrinsics[:, 2] - b * self.intrinsics[:, 3]
        return np.column_stack([a, b, c])

    def patches(
        self,
        parts: tuple[render_kernels.Part, ...],
        trunk: Array,
        walls: Array,
        seeds: NDArray[np.uint64],
        window_px: int,
    ) -> tuple[NDArray[np.int64], NDArray[np.uint16], NDArray[np.uint16]]:
        """Render square patches centred on the trunks' bounding boxes.

        Args:
            parts: all objects, arena frame.
            trunk: (n, V, 3) vertices of the animals' trunks, mm, arena frame.
            walls: (n, WALL_COLUMNS) the wall in each image.
            seeds: (n,) of the sensors' noise.
            window_px: side of the patches, px.

        Returns:
            Pixels (n, 2) (u, v) of the full image at patch pixel (0, 0), which may be outside the
            image; depth and background (n, S, S) in the sensors' units.
        """
        T = self.T_arena_camera.inverse()
        p = np.einsum("nij,nvj->nvi", T.rotation, trunk) + T.translation[:, None]
        uv = p[..., :2] / p[..., 2:] * self.intrinsics[:, None, :2] + self.intrinsics[:, None, 2:]
        middle = (uv.min(axis=1) + uv.max(axis=1)) / 2.0
        origin = np.floor(middle - window_px / 2.0 + 0.5).astype(np.int64)
        depth, background = np.empty((2, len(trunk), window_px, window_px), np.uint16)
        in_parallel(
            render_kernels.draw_windows,
            len(trunk),
            parts,
            render_kernels.PatchCamera(self.intrinsics, self.size_px, origin),
            self.T_arena_camera.rotation,
            self.T_arena_camera.translation[:, 2].copy(),
            walls,
            self.rough,
            render_kernels.SensorNoise(self.parameters, seeds, NORMAL),
            depth,
            background,
        )
        return origin, depth, background


def training_blocks(
    seed: int,
    n_blocks: int,
    species: Species,
    *,
    first: int = 0,
    family: str = "train",
    degraded_share: float = 0.0,
    spine_mm: float | None = None,
    window_px: int = 144,
    per_session: int = PER_SESSION,
) -> Iterator[TrainingPatches]:
    """Blocks of `BLOCK` training patches from block `first` on.

    They are bit-identical for a seed, for any number of threads.

    Args:
        seed: of the whole set; a block depends only on the seed and its number.
        n_blocks: number of blocks.
        species: the species.
        first: number of the first block.
        family: of body shapes, one of `body.variation.FAMILIES`.
        degraded_share: share of mini-sessions with 1 to 2.5 times the noise; half of them have an
            outline eroded by one more pixel.
        spine_mm: mean length of the animals, mm; None uses the skeleton's own.
        window_px: side of the patches, px; it must contain the animal with a margin: 144 is enough
            for mice of up to 70 mm.
        per_session: images of one animal with one camera, a divisor of `BLOCK`.

    Yields:
        One set of `BLOCK` patches per block.
    """
    skeleton = species.skeleton
    m = BLOCK // per_session
    each = np.repeat(np.arange(m), per_session)
    surface = Surface.of(skeleton)
    scale = species.setting.scale
    for number in range(first, first + n_blocks):
        rng = np.random.default_rng([seed, number])
        body = species.shapes(rng, family, m)
        cameras = _draw_cameras(rng, species, body, degraded_share)
        T_arena_camera = draw_views(rng, m, species.setting)
        nominal = skeleton.length if spine_mm is None else spine_mm
        size = (nominal / skeleton.length * rng.uniform(*species.sizes, m))[each]
        rough = scale * rng.uniform(0.0, 1.0, m)
        floor_error = rng.standard_normal((m, 3)) * [0.003, 0.003, 0.8 * scale]
        intrinsics, size_px, parameters = cameras
        views = Views(intrinsics, size_px, T_arena_camera, parameters, rough, floor_error)[each]
        body = body[each]
        height = views.T_arena_camera.translation[:, 2]
        pose, girth = species.postures(rng, size, body, height)
        _place(rng, species, pose, views)
        vertices = surface.vertices(pose, body, girth, species.bends(rng, BLOCK))
        trunk = vertices[:, : surface.n_trunk_vertices]
        item, shown = _draw_neighbours(rng, trunk, size * skeleton.length, scale, species.floats)
        walls = _draw_walls(rng, trunk, species.setting)
        parts = (
            render_kernels.part_of(vertices, surface.faces, ANIMAL),
            render_kernels.part_of(item, PART_FACES, OBJECT, shown),
        )
        seeds = rng.integers(1, 2**63, BLOCK).astype(np.uint64)
        origin, depth, background = views.patches(parts, trunk, walls, seeds, window_px)
        visible = pose.moved(views.T_arena_camera.inverse())
        yield TrainingPatches(
            depth,
            background,
            origin.astype(np.int32),
            views.intrinsics,
            views.floor,
            visible.root,
            visible.angles,
            visible.scale,
            visible.joints(skeleton),
            size * skeleton.length,
            body,
            species.sensors[0].unit_mm,
            species.sensors[0].spread_mm(views.parameters, height),
        )


def _draw_cameras(
    rng: np.random.Generator, species: Species, body: Body, degraded_share: float
) -> tuple[Array, NDArray[np.int64], Array]:
    """Intrinsics (m, 4), image size (m, 2) and sensor parameters of m cameras of all makes."""
    m = len(body)
    intrinsics = np.empty((m, 4))
    size_px = np.empty((m, 2), np.int64)
    parameters = np.empty((m, N_PARAMETERS))
    for k, sensor in enumerate(species.sensors):
        rows = np.arange(m) % len(species.sensors) == k
        camera = sensor.camera.every(sensor.stride)
        # units of one make differ by a few per cent in focal length, and by some pixels in the
        # optical axis
        focal = rng.uniform(0.97, 1.03, (m, 1)) * [camera.fx, camera.fy]
        axis = rng.normal(0.0, 4.0, (m, 2)) + np.array([camera.cx, camera.cy])
        intrinsics[rows] = np.concatenate([focal, axis], axis=1)[rows]
        size_px[rows] = camera.width, camera.height
        parameters[rows] = sensor.coarse(sensor.draw(rng, m, body.fur))[rows]
    degrade(rng, parameters, degraded_share)
    return intrinsics, size_px, parameters


def degrade(rng: np.random.Generator, parameters: Array, share: float) -> None:
    """Give a share of the sensors more noise and holes, and half of those an eroded outline."""
    m = len(parameters)
    worse = rng.random(m) < share
    factor = rng.uniform(1.0, 2.5, m)
    eroded = rng.random(m) < 0.5
    parameters[worse, NOISE] *= factor[worse]
    parameters[worse & eroded, EROSION] += 1


def _place(rng: np.random.Generator, species: Species, pose: Pose, views: Views) -> None:
    """Translate the poses over the floor so that each animal is completely inside its image."""
    n = len(pose.scale)
    T = views.T_arena_camera
    skeleton = species.skeleton
    middle = pose.joints(skeleton).mean(axis=1)
    height = T.translation[:, 2] - (middle[:, 2] if species.floats else 0.0)
    margin = 0.85 * pose.scale * skeleton.length * views.intrinsics[:, 0] / height + 6.0
    uv = np.stack(
        [margin + rng.random(n) * (views.size_px[:, k] - 2.0 * margin) for k in range(2)],
        axis=-1,
    )
    ray = np.concatenate(
        [(uv - views.intrinsics[:, 2:]) / views.intrinsics[:, :2], np.ones((n, 1))],
        axis=1,
    )
    direction = np.einsum("nij,nj->ni", T.rotation, ray)
    spot = (height / -direction[:, 2])[:, None] * direction[:, :2]
    pose.root.translation[:, :2] += spot - middle[:, :2]


def _draw_neighbours(
    rng: np.random.Generator, trunk: Array, spine_mm: Array, scale: float, floats: bool
) -> tuple[Array, NDArray[np.bool_]]:
    """A block or ball (n, V, 3) next to each trunk, without contact, and its presence (n,).

    Next to a floating animal it is anywhere between the floor and the animal's back.
    """
    n = len(trunk)
    radii = spine_mm[:, None] * rng.uniform(0.12, 0.5, (n, 3))
    azimuth = rng.uniform(-np.pi, np.pi, n)
    toward = np.stack([np.cos(azimuth), np.sin(azimuth)], axis=-1)
    reach = np.einsum("nvk,nk->nv", trunk[..., :2], toward).max(axis=1)
    middle = trunk[..., :2].mean(axis=1)
    clear = reach - np.sum(middle * toward, axis=-1) + np.hypot(radii[:, 0], radii[:, 1])
    clear = clear + scale * rng.uniform(5.0, 40.0, n)
    lift = (
        rng.uniform(0.0, 1.0, n) * np.maximum(trunk[..., 2].max(axis=1) - radii[:, 2], 0.0)
        if floats
        else 0.0
    )
    centre = np.concatenate(
        [middle + clear[:, None] * toward, (radii[:, 2] + lift)[:, None]], axis=-1
    )
    power = np.where(rng.random(n) < 0.5, 2.0, 10.0)
    return rounded(centre, radii, rng.uniform(-np.pi, np.pi, n), power), rng.random(n) < 0.10


def _draw_walls(rng: np.random.Generator, trunk: Array, setting: SceneSpec) -> Array:
    """A straight wall (n, WALL_COLUMNS) beyond some of the trunks, as viewed from inside."""
    n = len(trunk)
    scale = setting.scale
    middle = trunk[..., :2].mean(axis=1)
    azimuth = np.arctan2(middle[:, 1], middle[:, 0]) + rng.normal(0.0, 0.7, n)
    outward = np.stack([np.cos(azimuth), np.sin(azimuth)], axis=-1)
    distance = np.einsum("nvk,nk->nv", trunk[..., :2], outward).max(axis=1) + scale * rng.uniform(
        1.0, 60.0, n
    )
    there = (rng.random(n) < 0.35) & (distance > 40.0 * scale)
    low, high = setting.walls_mm
    height = rng.uniform(0.75 * low, high, n)
    rounding = rng.uniform(0, 12, n)
    spread = rng.uniform(6, 25, n)
    return np.column_stack(
        [outward, np.where(there, distance, 0.0), height, scale * rounding, scale * spread]
    )
