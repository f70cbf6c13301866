"""Synthetic training set for regression forests: rendered depth patches with exact poses.

Domain randomisation: each image draws camera tilt and height, intrinsics, floor, walls,
neighbouring objects, body shape, posture and sensor noise at random, and keeps the exact pose as
its label. Images come in mini-sessions of `PER_SESSION` that share camera, floor, animal and
sensor, as the frames of a recording do. They are made in blocks; a block depends only on the seed
and its number, so that any part of a set can be reproduced bit for bit.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from liex_lab.arrays import Array, NDArray
from liex_lab.body.pose import Pose
from liex_lab.body.skeleton import Skeleton
from liex_lab.geometry import SE3
from liex_lab.runtime.memory import Rows
from liex_lab.simulation import _render_kernels as kernels
from liex_lab.simulation._sensor_kernels import EROSION, NOISE
from liex_lab.simulation.rendering import Solid, Views, inverse_depth
from liex_lab.simulation.scene import PART_FACES, SceneSpec, rounded

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


def degrade(rng: np.random.Generator, parameters: Array, share: float) -> None:
    """Give a share of the sensors more noise and holes, and half of those an eroded outline."""
    m = len(parameters)
    worse = rng.random(m) < share
    factor = rng.uniform(1.0, 2.5, m)
    eroded = rng.random(m) < 0.5
    parameters[worse, NOISE] *= factor[worse]
    parameters[worse & eroded, EROSION] += 1


def floor_views(
    intrinsics: Array,
    size_px: NDArray[np.int64],
    T_arena_camera: SE3,
    parameters: Array,
    error: Array,
    rough: Array | float = 0.0,
) -> Views:
    """Cameras above a floor without walls.

    Args:
        intrinsics: (n, 4) fx, fy, cx, cy of the whole images, px.
        size_px: (n, 2) their width and height, px.
        T_arena_camera: (n) poses, the arena frame's origin at the cameras' feet.
        parameters: (n, N_PARAMETERS) of the units' sensors.
        error: (n, 3) of the estimated floor: slopes along the arena's x and y, rad, and additional
            distance below the camera, mm.
        rough: (n,) unevenness of the floor, mm.
    """
    T = T_arena_camera
    height = T.translation[:, 2]
    ground = np.zeros((len(height), kernels.N_GROUND))
    ground[:, kernels.FLOOR] = inverse_depth(-T.rotation[:, 2], height, intrinsics)
    ground[:, kernels.HEIGHT] = height
    ground[:, kernels.ROUGH] = rough
    slope = np.stack([error[:, 0], error[:, 1], -np.ones(len(error))], axis=-1)
    slope /= np.linalg.norm(slope, axis=-1, keepdims=True)
    normal = np.einsum("nji,nj->ni", T.rotation, slope)
    floor = inverse_depth(normal, height + error[:, 2], intrinsics)
    return Views(intrinsics, size_px, T, parameters, ground, floor)


def place(
    rng: np.random.Generator, skeleton: Skeleton, pose: Pose, views: Views, floats: bool
) -> None:
    """Translate the poses over the floor so that each animal is completely inside its image."""
    n = len(pose.scale)
    T = views.T_arena_camera
    middle = pose.joints(skeleton).mean(axis=1)
    height = T.translation[:, 2] - (middle[:, 2] if floats else 0.0)
    margin = 0.85 * pose.scale * skeleton.length * views.intrinsics[:, 0] / height + 6.0
    uv = margin[:, None] + rng.random((2, n)).T * (views.size_px - 2.0 * margin[:, None])
    ray = np.column_stack([(uv - views.intrinsics[:, 2:]) / views.intrinsics[:, :2], np.ones(n)])
    direction = np.einsum("nij,nj->ni", T.rotation, ray)
    spot = (height / -direction[:, 2])[:, None] * direction[:, :2]
    pose.root.translation[:, :2] += spot - middle[:, :2]


def neighbours(
    rng: np.random.Generator,
    bodies: Array,
    radii: Array,
    gap: tuple[float, float],
    depth: Callable[[Array], tuple[Array, Array | float]],
    block: float,
    share: float,
) -> Solid:
    """A block or ball beside each body, without contact, in a share of the images.

    Args:
        rng: random number generator.
        bodies: (n, V, 3) mm; the objects are beside them in x and y.
        radii: (n, 3) half axes of the objects, mm.
        gap: smallest and largest gap between them, mm.
        depth: of the bodies, the objects' z (n,), mm, and a factor of their x and y.
        block: power of a block's superellipsoid, see `rounded`.
        share: of images with an object.
    """
    n = len(bodies)
    azimuth = rng.uniform(-np.pi, np.pi, n)
    toward = np.stack([np.cos(azimuth), np.sin(azimuth)], axis=-1)
    reach = np.einsum("nvk,nk->nv", bodies[..., :2], toward).max(axis=1)
    middle = bodies[..., :2].mean(axis=1)
    clear = reach - np.sum(middle * toward, axis=-1) + np.hypot(radii[:, 0], radii[:, 1])
    clear = clear + rng.uniform(*gap, n)
    z, spread = depth(bodies)
    xy = (middle + clear[:, None] * toward).T * spread
    centre = np.column_stack([*xy, z])
    power = np.where(rng.random(n) < 0.5, 2.0, block)
    mesh = rounded(centre, radii, rng.uniform(-np.pi, np.pi, n), power)
    return Solid.of(mesh, PART_FACES, rng.random(n) < share)


def draw_walls(rng: np.random.Generator, trunk: Array, setting: SceneSpec, views: Views) -> None:
    """A straight wall beyond some of the trunks, in place, as viewed from inside."""
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
    put_walls(
        views,
        outward,
        np.where(there, distance, 0.0),
        rng.uniform(0.75 * low, high, n),
        scale * rng.uniform(0, 12, n),
        scale * rng.uniform(6, 25, n),
    )


def put_walls(
    views: Views,
    outward: Array,
    distance: Array,
    height: Array | float,
    rounding: Array | float,
    reach: Array | float,
) -> None:
    """Put straight walls before cameras, in place.

    Args:
        views: n cameras; their ground changes.
        outward: (n, 2) normals of the walls in the floor.
        distance: (n,) of the walls from the cameras' feet, mm; 0 for none.
        height: (n,) of the walls, mm.
        rounding: (n,) depth of the rounding that multiple reflections leave at their feet, mm.
        reach: (n,) its extent, mm.
    """
    normal = np.einsum("nji,nj->ni", views.T_arena_camera.rotation[:, :2], outward)
    apart = np.maximum(distance, 1.0)
    views.ground[:, kernels.WALL] = inverse_depth(normal, apart, views.intrinsics)
    columns = np.broadcast_arrays(distance, height, rounding, reach)
    views.ground[:, kernels.WALL_DISTANCE : kernels.WALL_DISTANCE + 4] = np.stack(columns, axis=1)
