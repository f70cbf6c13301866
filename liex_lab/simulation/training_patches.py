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
from typing import Any

import numpy as np
from numpy.typing import NDArray

from liex_lab.body.pose import Pose
from liex_lab.body.shape import Body, BodyShape
from liex_lab.body.surface import Surface
from liex_lab.errors import LiexError
from liex_lab.geometry import SE3
from liex_lab.runtime.memory import Rows
from liex_lab.runtime.processes import threads
from liex_lab.simulation import _render_kernels as render_kernels
from liex_lab.simulation._sensor_kernels import ANIMAL, EROSION, NOISE, NORMAL, OBJECT
from liex_lab.simulation.scene import PART_FACES, SceneSpec, draw_views, rounded
from liex_lab.simulation.scenes.places import Mesh, draw_worn, joined
from liex_lab.simulation.species import MouseSpecies, Species

Array = NDArray[np.float64]

PER_SESSION = 8
BLOCK = 512  # images made from one generator
_OBJECT_SHARE = 0.10
_WALL_SHARE = 0.35


@dataclass(frozen=True)
class TrainingPatches(Rows):
    """Depth patches of S x S pixels around an animal, n of them, with their truth.

    Attributes:
        depth: (n, S, S) uint16 depth image, steps of `unit_mm`, 0 = unread.
        background: (n, S, S) uint16, likewise: the still scene as learned from a recording.
        origin: (n, 2) int32, the full image's pixel (u, v) of patch pixel (0, 0).
        intrinsics: (n, 4) fx, fy, cx, cy of the full image, px.
        floor: (n, 3) plane 1 / z = a u + b v + c in pixels of the full image, as estimated.
        floor_true: (n, 3) the same plane, exact.
        T_arena_camera: (n) exact transform from the camera frame into the arena frame.
        root: (n) T_camera_root, the base joint in the camera frame.
        angles: (n, J, 3) joint angles, rad.
        scale: (n,) of this frame's bones over those of the skeleton.
        joints_mm: (n, J, 3) joints in the camera frame, mm.
        spine_mm: (n,) the animal's own size, mm, constant over its mini-session.
        session: (n,) int64, number of the mini-session.
        sensor: (n,) int64, index into the animal's sensors.
        kind: (n,) int64, index into its kinds of posture.
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
    floor_true: Array
    T_arena_camera: SE3
    root: SE3
    angles: Array
    scale: Array
    joints_mm: Array
    spine_mm: Array
    session: NDArray[np.int64]
    sensor: NDArray[np.int64]
    kind: NDArray[np.int64]
    unit_mm: float = 1.0
    spread_mm: Array | float = 0.0
    own_bones: bool = False

    def __len__(self) -> int:
        """Number of patches n."""
        return len(self.depth)


@dataclass(frozen=True)
class _Views(Rows):
    """Camera, floor, sensor and animal of n images, one row each, constant in a mini-session."""

    sensor: NDArray[np.int64]
    intrinsics: Array
    size_px: NDArray[np.int64]
    T_arena_camera: SE3
    parameters: Array
    size: Array
    shape: Body
    rough: Array
    floor_error: Array


def training_windows(
    seed: int, n: int, species: Species | None = None, **settings: Any
) -> TrainingPatches:
    """The first n training patches of a seed, as made by `training_blocks`.

    Args:
        seed: of the whole set.
        n: number of patches; whole blocks are rendered and the last one is cut.
        species: the species; None is a mouse.
        **settings: further keyword arguments of `training_blocks`.

    Returns:
        n patches with their truth.
    """
    blocks = training_blocks(seed, -(-n // BLOCK), species, **settings)
    return TrainingPatches.join(list(blocks))[:n]


def training_blocks(
    seed: int,
    n_blocks: int,
    species: Species | None = None,
    *,
    first: int = 0,
    family: str = "train",
    noise: float = 1.0,
    erosion_px: int = 0,
    degraded_share: float = 0.0,
    spine_mm: float | None = None,
    window_px: int = 144,
    parallel: bool = True,
    worn_share: float = 0.0,
    per_session: int = PER_SESSION,
) -> Iterator[TrainingPatches]:
    """Blocks of `BLOCK` training patches from block `first` on.

    They are bit-identical for a seed, for any number of threads.

    Args:
        seed: of the whole set; a block depends only on the seed and its number.
        n_blocks: number of blocks.
        species: the species; None is a mouse.
        first: number of the first block.
        family: of body shapes, one of `body.shape.FAMILIES`.
        noise: multiplies the sensor's random errors and its rate of holes, see `Sensor.draw`.
        erosion_px: pixels stripped off the animal's outline, see `Sensor.draw`.
        degraded_share: share of mini-sessions with 1 to 2.5 times the noise; half of them have an
            outline eroded by one more pixel.
        spine_mm: mean length of the animals, mm; None uses the skeleton's own.
        window_px: side of the patches, px; it must contain the animal with a margin: 144 is enough
            for mice of up to 70 mm.
        parallel: render on all threads.
        worn_share: share of mini-sessions whose mouse has a head stage or a cable, see
            `scenes.places.draw_worn`; 0 gives the same patches as without this option.
        per_session: images of one animal with one camera, a divisor of `BLOCK`.

    Yields:
        One set of `BLOCK` patches per block.
    """
    species = MouseSpecies() if species is None else species
    surface = Surface.of(species.skeleton)
    for number in range(first, first + n_blocks):
        rng = np.random.default_rng([seed, number])
        views = _draw_views(
            rng, species, family, noise, erosion_px, degraded_share, spine_mm, per_session
        )
        wearing = (np.random.default_rng([seed, number, 1]), worn_share)
        first_session = number * (BLOCK // per_session)
        sessions = first_session + np.arange(BLOCK) // per_session
        yield _draw_block(rng, species, surface, views, window_px, sessions, parallel, wearing)


def drawn_bodies(
    seed: int,
    number: int,
    species: Species,
    *,
    family: str,
    degraded_share: float = 0.0,
    spine_mm: float | None = None,
    per_session: int = PER_SESSION,
) -> Body:
    """The bodies of a block of `training_blocks`, a batch with one per mini-session.

    Args:
        seed: of the whole set.
        number: of the block.
        species: the species.
        family: of body shapes, one of `body.shape.FAMILIES`.
        degraded_share: as for the block.
        spine_mm: as for the block.
        per_session: images of one animal with one camera.
    """
    rng = np.random.default_rng([seed, number])
    views = _draw_views(rng, species, family, 1.0, 0, degraded_share, spine_mm, per_session)
    return views.shape[::per_session]


def _draw_views(
    rng: np.random.Generator,
    species: Species,
    family: str,
    noise: float,
    erosion_px: int,
    degraded_share: float,
    spine_mm: float | None,
    per_session: int = PER_SESSION,
) -> _Views:
    """Cameras, floors and animals of one block's mini-sessions, repeated for their images."""
    m = BLOCK // per_session
    skeleton = species.skeleton
    sensor = np.arange(m) % len(species.sensors)
    shape = species.shapes(rng, family, m)
    intrinsics = np.empty((m, 4))
    size_px = np.empty((m, 2), np.int64)
    parameters = np.empty((m, 0))
    for k, kind in enumerate(species.sensors):
        rows = sensor == k
        camera = kind.camera.every(kind.stride)
        # units of one make differ by a few per cent in focal length, and by some pixels in the
        # optical axis
        focal = rng.uniform(0.97, 1.03, (m, 1)) * [camera.fx, camera.fy]
        axis = rng.normal(0.0, 4.0, (m, 2)) + np.array([camera.cx, camera.cy])
        intrinsics[rows] = np.concatenate([focal, axis], axis=1)[rows]
        size_px[rows] = camera.width, camera.height
        drawn = kind.coarse(kind.draw(rng, m, shape.fur, noise, erosion_px))
        parameters = drawn if not parameters.size else np.where(rows[:, None], drawn, parameters)
    degrade(rng, parameters, degraded_share)
    nominal = skeleton.length if spine_mm is None else spine_mm
    T_arena_camera = draw_views(rng, m, species.setting)
    scale = species.setting.scale
    views = _Views(
        sensor,
        intrinsics,
        size_px,
        T_arena_camera,
        parameters,
        nominal / skeleton.length * rng.uniform(*species.sizes, m),
        shape,
        scale * rng.uniform(0.0, 1.0, m),
        rng.standard_normal((m, 3)) * [0.003, 0.003, 0.8 * scale],
    )
    return views[np.repeat(np.arange(m), per_session)]


def degrade(rng: np.random.Generator, parameters: Array, share: float) -> None:
    """Give a share of the sensors more noise and holes, and half of those an eroded outline."""
    m = len(parameters)
    worse = rng.random(m) < share
    factor = rng.uniform(1.0, 2.5, m)
    eroded = rng.random(m) < 0.5
    parameters[worse, NOISE] *= factor[worse]
    parameters[worse & eroded, EROSION] += 1


def inverse_depth_plane(
    T_arena_camera: SE3, intrinsics: Array, tilt_and_lift: Array | None = None
) -> Array:
    """Inverse-depth coefficients of the floor, 1 / z = a u + b v + c, exact or with errors.

    With n the floor's unit normal in the camera frame and d its distance, a = n_x / (fx d), b = n_y
    / (fy d) and c = n_z / d - a cx - b cy.

    Args:
        T_arena_camera: (n) exact poses of the cameras, the arena frame's origin at their feet.
        intrinsics: (n, 4) fx, fy, cx, cy, px.
        tilt_and_lift: (n, 3) errors of an estimated floor: slopes along the arena's x and y, rad,
            and additional distance below the camera, mm; None is the exact floor.

    Returns:
        (n, 3) a, b, c in 1/mm per pixel and 1/mm.
    """
    wrong = np.zeros((len(intrinsics), 3)) if tilt_and_lift is None else tilt_and_lift
    slope = np.stack([wrong[:, 0], wrong[:, 1], -np.ones(len(wrong))], axis=-1)
    normal = np.einsum(
        "nji,nj->ni", T_arena_camera.rotation, slope / np.linalg.norm(slope, axis=-1, keepdims=True)
    )
    distance = T_arena_camera.translation[:, 2] + wrong[:, 2]
    a = normal[:, 0] / intrinsics[:, 0] / distance
    b = normal[:, 1] / intrinsics[:, 1] / distance
    return np.stack(
        [a, b, normal[:, 2] / distance - a * intrinsics[:, 2] - b * intrinsics[:, 3]], axis=-1
    )


def _draw_block(
    rng: np.random.Generator,
    species: Species,
    surface: Surface,
    views: _Views,
    window_px: int,
    sessions: NDArray[np.int64],
    parallel: bool,
    wearing: tuple[np.random.Generator, float],
) -> TrainingPatches:
    """The images of one block."""
    n = len(views.size)
    skeleton = species.skeleton
    scale = species.setting.scale
    pose, girth, kinds = species.postures(
        rng, views.size, views.shape, views.T_arena_camera.translation[:, 2]
    )
    _place(rng, species, pose, views)
    vertices = surface.vertices(pose, views.shape, girth, species.bends(rng, n), parallel)
    trunk = vertices[:, : surface.n_trunk_vertices]
    T_camera_arena = views.T_arena_camera.inverse()
    origin = window_origin(trunk, T_camera_arena, views.intrinsics, window_px)
    item, has_object = _draw_neighbours(
        rng, trunk, views.size * skeleton.length, scale, species.floats
    )
    objects = Mesh(item, PART_FACES)
    if wearing[1] > 0.0:
        if not isinstance(views.shape, BodyShape):
            raise LiexError(
                f"head stages and cables stand on a tubular body, which a {skeleton.name} has not; "
                "leave out worn_share"
            )
        per_session = int(np.sum(sessions == sessions[0]))
        worn, wears = draw_worn(
            wearing[0], skeleton, pose, views.shape, girth, wearing[1], per_session
        )
        absent = np.stack([~has_object, ~wears])[..., None, None] * np.array([0.0, 0.0, 1e7])
        objects = joined(
            [Mesh(item + absent[0], PART_FACES), Mesh(worn.vertices + absent[1], worn.faces)]
        )
        has_object = has_object | wears
    walls = _draw_walls(rng, trunk, species.setting)
    seeds = rng.integers(1, 2**63, n).astype(np.uint64)
    depth = np.empty((n, window_px, window_px), np.uint16)
    background = np.empty_like(depth)
    with threads(parallel):
        render_kernels.draw_windows(
            render_kernels.part_of(vertices, surface.faces, ANIMAL),
            render_kernels.part_of(objects.vertices, objects.faces, OBJECT, has_object),
            render_kernels.PatchCamera(views.intrinsics, views.size_px, origin),
            render_kernels.ArenaView(
                views.T_arena_camera.rotation,
                views.T_arena_camera.translation[:, 2].copy(),
                walls,
                views.rough,
            ),
            render_kernels.SensorNoise(views.parameters, seeds, NORMAL),
            depth,
            background,
        )
    visible = pose.moved(T_camera_arena)
    return TrainingPatches(
        depth,
        background,
        origin.astype(np.int32),
        views.intrinsics,
        inverse_depth_plane(views.T_arena_camera, views.intrinsics, views.floor_error),
        inverse_depth_plane(views.T_arena_camera, views.intrinsics),
        views.T_arena_camera,
        visible.root,
        visible.angles,
        visible.scale,
        visible.joints(skeleton),
        views.size * skeleton.length,
        sessions,
        views.sensor,
        kinds,
        species.sensors[0].unit_mm,
        species.sensors[0].spread_mm(views.parameters, views.T_arena_camera.translation[:, 2]),
    )


def _place(rng: np.random.Generator, species: Species, pose: Pose, views: _Views) -> None:
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


def window_origin(
    trunk: Array, T_camera_arena: SE3, intrinsics: Array, window_px: int
) -> NDArray[np.int64]:
    """First pixels of square patches centred on the trunk's bounding box.

    Args:
        trunk: (n, V, 3) vertices of the trunks, mm, arena frame.
        T_camera_arena: (n) from the arena frame into the camera frame.
        intrinsics: (n, 4) fx, fy, cx, cy, px.
        window_px: side of the patches, px.

    Returns:
        (n, 2) int64 pixel (u, v) of the full image at patch pixel (0, 0); may be outside the image.
    """
    p = (
        np.einsum("nij,nvj->nvi", T_camera_arena.rotation, trunk)
        + T_camera_arena.translation[:, None]
    )
    uv = p[..., :2] / p[..., 2:] * intrinsics[:, None, :2] + intrinsics[:, None, 2:]
    return np.floor((uv.min(axis=1) + uv.max(axis=1)) / 2.0 - window_px / 2.0 + 0.5).astype(
        np.int64
    )


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
    return rounded(centre, radii, rng.uniform(-np.pi, np.pi, n), power), rng.random(
        n
    ) < _OBJECT_SHARE


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
    there = (rng.random(n) < _WALL_SHARE) & (distance > 40.0 * scale)
    low, high = setting.walls_mm
    height = rng.uniform(0.75 * low, high, n)
    rounding = rng.uniform(0, 12, n)
    spread = rng.uniform(6, 25, n)
    return np.column_stack(
        [outward, np.where(there, distance, 0.0), height, scale * rounding, scale * spread]
    )
