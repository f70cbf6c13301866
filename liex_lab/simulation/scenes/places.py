"""Arenas and their surroundings: walled floors, benches, tables, cluttered rooms, cages, bedding.

A floor is a height field over a grid of 5 mm: a few long waves, the rounding exp(-distance /
spread) that multi-path reflections leave at the foot of walls, and bedding. Bedding is a sum of
lumps at random positions; an animal's steps compress it and push it aside, epoch by epoch
(`Bedding`).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from liex_lab.arrays import Array, NDArray
from liex_lab.body._skinning_kernels import tube_faces
from liex_lab.body.pose import Pose
from liex_lab.body.shape import BodyShape, render_mesh
from liex_lab.body.skeleton import Skeleton
from liex_lab.geometry import SE3
from liex_lab.optics.camera import Camera
from liex_lab.simulation.locomotion import smoothed
from liex_lab.simulation.scene import ROUND, SimulatedScene, rounding, turned, unevenness

CABLE_SEGMENTS = 6

_BOX_CORNERS = np.array([[x, y, z] for z in (-1, 1) for y in (-1, 1) for x in (-1, 1)], float)
_BOX_FACES = np.array(
    [
        *[[0, 1, 3], [0, 3, 2], [4, 7, 5], [4, 6, 7], [0, 5, 1], [0, 4, 5]],
        *[[2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]],
    ],
    np.int32,
)


class Mesh(NamedTuple):
    """Triangles of one or more objects.

    Attributes:
        vertices: (V, 3) mm, arena frame.
        faces: (F, 3) int32.
    """

    vertices: Array
    faces: NDArray[np.int32]


def box(centre: Sequence[float] | Array, half: Sequence[float] | Array, yaw: float = 0.0) -> Mesh:
    """A block with sharp edges.

    Args:
        centre: (3,) mm.
        half: (3,) half its sides, mm.
        yaw: its rotation about the vertical, rad.
    """
    corners = _BOX_CORNERS * np.asarray(half, float)
    corners = np.concatenate([turned(corners[:, :2], yaw), corners[:, 2:]], axis=1)
    return Mesh(corners + np.asarray(centre, float), _BOX_FACES)


def field(x: Array, y: Array, heights: Array) -> Mesh:
    """A surface over a grid, such as an uneven floor.

    Args:
        x: (n,) mm.
        y: (m,) mm.
        heights: (m, n) mm.

    Returns:
        The mesh, two triangles per cell.
    """
    m, n = heights.shape
    at_x, at_y = np.meshgrid(x, y)
    first = (np.arange(m - 1)[:, None] * n + np.arange(n - 1)).ravel().astype(np.int32)
    lower = np.stack([first, first + 1, first + np.int32(n + 1)], axis=-1)
    upper = np.stack([first, first + np.int32(n + 1), first + np.int32(n)], axis=-1)
    vertices = np.stack([at_x, at_y, heights], axis=-1).reshape(-1, 3)
    return Mesh(vertices, np.concatenate([lower, upper]).astype(np.int32))


def cables(curves: Array, radius: float) -> Mesh:
    """Tubes along curves, one per frame.

    Args:
        curves: (n, R, 3) mm, their midlines.
        radius: mm.

    Returns:
        Vertices (n, V, 3) mm and their shared faces (F, 3) int32.
    """
    n, rings, _ = curves.shape
    along = np.gradient(curves, axis=1)
    along /= np.maximum(np.linalg.norm(along, axis=-1, keepdims=True), 1e-9)
    side = np.cross(along, np.array([0.31, 0.95, 0.05]))
    side /= np.maximum(np.linalg.norm(side, axis=-1, keepdims=True), 1e-9)
    other = np.cross(along, side)
    phi = 2 * np.pi * np.arange(CABLE_SEGMENTS) / CABLE_SEGMENTS
    around = np.cos(phi)[:, None] * side[:, :, None] + np.sin(phi)[:, None] * other[:, :, None]
    skin = (curves[:, :, None] + radius * around).reshape(n, -1, 3)
    vertices = np.concatenate([curves[:, :1], skin, curves[:, -1:]], axis=1)
    return Mesh(vertices, tube_faces(rings, CABLE_SEGMENTS))


def render_still(parts: Sequence[Mesh], camera: Camera, T_camera_arena: SE3) -> NDArray[np.float32]:
    """Ideal depth of still objects.

    Args:
        parts: at least one object; each within view of the camera, not behind it.
        camera: the ideal pinhole camera.
        T_camera_arena: transform from the arena frame into the camera frame.

    Returns:
        (H, W) float32 mm, 0 for nothing.
    """
    starts = np.cumsum([0, *(len(part.vertices) for part in parts)])
    faces = [part.faces + np.int32(start) for part, start in zip(parts, starts, strict=False)]
    vertices = np.concatenate([part.vertices for part in parts])
    return render_mesh(vertices, np.concatenate(faces), camera, T_camera_mesh=T_camera_arena)


# Equipment of animals: a head stage, and a cable from it to a commutator above the arena.


HEAD_STAGE_MM = (10.0, 8.0, 12.0)
PLUG_MM = (5.0, 5.0, 7.0)
_NECK = -2  # first joint of the head's bone
_AT_STATION = 0.83  # of the spine: behind the eyes
_RINGS = 30


def on_head(skeleton: Skeleton, pose: Pose, shape: BodyShape, girth: Array) -> SE3:
    """Pose of an object that is cemented to the skull.

    Args:
        skeleton: of the animal, a chain.
        pose: (n) arena frame.
        shape: its body, or n bodies.
        girth: (n,) factor of all lengths across the body.

    Returns:
        (n) T_arena_mount: x forward, z up from the skull, the origin on the skin.
    """
    neck = pose.frames(skeleton)[:, _NECK]
    stations = np.asarray(skeleton.surface["stations"], float)
    k = int(np.searchsorted(stations, _AT_STATION)) - 1
    share = (_AT_STATION - stations[k]) / (stations[k + 1] - stations[k])
    thick = (1.0 - share) * shape.half_height[..., k] + share * shape.half_height[..., k + 1]
    reach = np.linalg.norm(skeleton.offsets[1:], axis=1)
    ahead = (_AT_STATION * reach.sum() - reach[: _NECK + 1].sum()) * pose.scale
    local = np.stack([ahead, np.zeros_like(ahead), thick * girth], axis=-1)
    return SE3(neck.rotation, neck @ local)


def stage_on(mount: SE3, sides_mm: tuple[float, float, float]) -> Mesh:
    """A block on the head.

    Args:
        mount: (n) T_arena_mount.
        sides_mm: its length, width and height.

    Returns:
        Vertices (n, V, 3) mm, arena frame, and faces (F, 3).
    """
    half = 0.5 * np.array(sides_mm)
    block = box([0.0, 0.0, half[2] - 1.0], half)
    return Mesh(mount[:, None] @ block.vertices, block.faces)


def tether(rng: np.random.Generator, mount: SE3, commutator: Array, thick_mm: float) -> Mesh:
    """A flexible cable from the head to a commutator, which bows to a side that turns slowly.

    Args:
        rng: random number generator.
        mount: (n) T_arena_mount.
        commutator: (3,) mm, arena frame.
        thick_mm: its diameter, mm.

    Returns:
        Vertices (n, V, 3) mm, arena frame, and faces (F, 3).
    """
    n = len(mount.translation)
    way = rng.uniform(-np.pi, np.pi) + np.cumsum(smoothed(rng.normal(0.0, 0.12, n), 12.0))
    longest = np.linalg.norm(commutator - mount.translation, axis=-1).max()
    length = longest * rng.uniform(1.03, 1.08)
    start = mount.translation + PLUG_MM[2] * mount.rotation[..., 2]
    span = commutator - start
    apart = np.linalg.norm(span, axis=-1)
    bow = 2.0 / np.pi * np.sqrt(apart * np.maximum(length - apart, 0.0))
    side = np.stack([np.cos(way), np.sin(way), np.full(n, -0.15)], axis=-1)
    s = np.linspace(0.0, 1.0, _RINGS)[:, None]
    straight = start[:, None] + s * span[:, None]
    swing = (bow[:, None] * side)[:, None] * np.sin(np.pi * s)
    # stiff at the plug: it rises from the head before it bends
    stiff = (25.0 * mount.rotation[..., 2])[:, None] * (s * np.exp(-((s / 0.12) ** 2)) / 0.06)
    return cables(straight + swing + stiff, 0.5 * thick_mm)


def holder(commutator: Array) -> list[Mesh]:
    """The commutator and the arm that supports it above the arena.

    Args:
        commutator: (3,) mm, arena frame.
    """
    x, y, z = commutator
    return [
        box([x, y, z + 14.0], [11.0, 11.0, 14.0]),
        box([x, y + 400.0, z + 28.0], [7.0, 400.0, 7.0]),
    ]


_GRID_MM = 5.0
_RIM_MM = 5.0
_BASE_MM = 6.0  # between an arena's floor and the surface below
_OUTLINE = 48  # corners of a round wall
_LUMP_MM = 18.0


@dataclass(frozen=True)
class Ground:
    """The floor of one arena over a grid.

    Attributes:
        arena: the arena.
        x: (n,) mm, from its centre, along its own axes.
        y: (m,) mm.
        heights: (m, n) mm, without bedding.
        within: (m, n) bool, grid nodes that belong to the floor.
    """

    arena: SimulatedScene
    x: Array
    y: Array
    heights: Array
    within: NDArray[np.bool_]

    @staticmethod
    def draw(rng: np.random.Generator, arena: SimulatedScene, scale: float = 1.0) -> "Ground":
        """Draw a floor with random unevenness, see `scene.SceneSpec` for its scale."""
        x, y = (
            np.arange(-reach - 2 * _GRID_MM, reach + 2 * _GRID_MM + 0.1, _GRID_MM)
            for reach in arena.half
        )
        local = np.stack(np.meshgrid(x, y), axis=-1)
        heights = unevenness(rng, local, scale, most=0.6)
        clearance = arena.wall_clearance(arena.centre + turned(local, arena.yaw))
        heights += rounding(rng, clearance, 8.0, 18.0, scale)
        return Ground(arena, x, y, heights, clearance > -1.5 * _GRID_MM)

    def mesh(self, bedding: Array | float = 0.0) -> Mesh:
        """The floor as a mesh in the arena frame.

        Args:
            bedding: (m, n) heights of bedding on it, mm.
        """
        flat = field(self.x, self.y, self.heights + bedding)
        xy = self.arena.centre + turned(flat.vertices[:, :2], self.arena.yaw)
        inside = self.within.ravel()[flat.faces].all(axis=1)
        return Mesh(np.concatenate([xy, flat.vertices[:, 2:]], axis=1), flat.faces[inside])

    def local(self, xy: Array) -> Array:
        """Points of the arena frame in the floor's own axes.

        Args:
            xy: (..., 2) mm, arena frame.

        Returns:
            (..., 2) mm from the arena's centre.
        """
        return turned(xy - self.arena.centre, -self.arena.yaw)


@dataclass(frozen=True)
class Bedding:
    """Bedding whose lumps change slowly, mostly along the animal's path.

    Attributes:
        ground: the floor below it.
        heights: (E, m, n) float32 mm, by epoch.
        frames: frames per epoch.
    """

    ground: Ground
    heights: NDArray[np.float32]
    frames: int

    @staticmethod
    def draw(rng: np.random.Generator, ground: Ground, tracks: Array, frames: int) -> "Bedding":
        """Draw the bedding under a walking animal.

        Args:
            rng: random number generator.
            ground: the floor.
            tracks: (n, 2) position of the animal in each frame, mm, arena frame; NaN if absent.
            frames: frames per epoch.

        Returns:
            The bedding of all epochs.
        """
        grid = np.stack(np.meshgrid(ground.x, ground.y), axis=-1)
        # one lump per square of 26 mm
        n_lumps = int(np.prod(2.0 * ground.arena.half) / 26.0**2)
        places = rng.uniform(-1.0, 1.0, (n_lumps, 2)) * ground.arena.half
        tall = _LUMP_MM * rng.uniform(0.35, 1.0, n_lumps)
        wide = rng.uniform(8.0, 18.0, n_lumps)
        here = _lumps(grid, places, tall, wide)
        at = ground.local(tracks)
        epochs = []
        for start in range(0, len(tracks), frames):
            moved = rng.random(n_lumps) < 0.01  # some lumps move spontaneously
            places[moved] += rng.normal(0.0, 6.0, (int(moved.sum()), 2))
            if moved.any():
                here = 0.9 * here + 0.1 * _lumps(grid, places, tall, wide)
            trodden = np.zeros(here.shape)
            for spot in at[start : start + frames : 5]:
                if np.isfinite(spot).all():
                    gap = np.linalg.norm(grid - spot, axis=-1)
                    trodden = np.maximum(trodden, np.exp(-0.5 * (gap / 16.0) ** 2))
            aside = np.clip(np.abs(np.gradient(trodden)[0]) + np.abs(np.gradient(trodden)[1]), 0, 1)
            # share of the height that an animal compresses in an epoch
            here = here * (1.0 - 0.55 * trodden) + 4.0 * aside * rng.random(here.shape)
            epochs.append(np.minimum(here, 1.4 * _LUMP_MM).astype(np.float32))
        return Bedding(ground, np.stack(epochs), frames)

    def below(self, tracks: Array) -> Array:
        """Height of the bedding under an animal, smooth in time.

        Args:
            tracks: (n, 2) position of the animal in each frame, mm, arena frame.

        Returns:
            (n,) mm.
        """
        at = self.ground.local(tracks)
        height = np.zeros(len(tracks))
        for i, spot in enumerate(at):
            rows = np.abs(self.ground.y - spot[1]) < 20.0
            columns = np.abs(self.ground.x - spot[0]) < 20.0
            patch = self.heights[i // self.frames][np.ix_(rows, columns)]
            height[i] = float(patch.mean()) if patch.size else 0.0
        return smoothed(height, 5.0, deviations=3.0)


def _lumps(grid: Array, places: Array, tall: Array, wide: Array) -> Array:
    """Heights (m, n) mm of lumps: the tallest at every node, with a low layer between them."""
    height = np.full(grid.shape[:-1], 2.0)
    for place, top, width in zip(places, tall, wide, strict=True):
        gap2 = ((grid - place) ** 2).sum(axis=-1)
        np.maximum(height, top * np.exp(-0.5 * gap2 / (0.5 * width) ** 2), out=height)
    return height


def walls_of(arena: SimulatedScene, slope: float = 0.0, rim_mm: float = _RIM_MM) -> Mesh:
    """The walls of an arena: inner face, rim and outer face.

    Args:
        arena: the arena.
        slope: horizontal distance of the rim outside the foot, mm.
        rim_mm: width of the rim, mm.
    """
    if arena.kind == ROUND:
        phi = 2 * np.pi * np.arange(_OUTLINE) / _OUTLINE
        local = arena.half[0] * np.stack([np.cos(phi), np.sin(phi)], axis=-1)
    else:
        local = arena.half * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    outline = arena.centre + turned(local, arena.yaw)
    n = len(outline)
    middle = outline.mean(axis=0)
    outward = outline - middle
    reach = np.linalg.norm(outward, axis=1, keepdims=True)
    rings = [
        (outline, -_BASE_MM),
        (middle + outward * (1.0 + slope / reach), arena.wall_mm),
        (middle + outward * (1.0 + (slope + rim_mm) / reach), arena.wall_mm),
        (middle + outward * (1.0 + rim_mm / reach), -_BASE_MM),
    ]
    vertices = np.concatenate([np.column_stack([xy, np.full(n, z)]) for xy, z in rings])
    k = np.arange(n, dtype=np.int32)
    ring = n * np.arange(len(rings) - 1, dtype=np.int32)[:, None]
    low, low_next = ring + k, ring + (k + 1) % n
    faces = [[low, low_next, low_next + n], [low, low_next + n, low + n]]
    return Mesh(vertices, np.moveaxis(np.array(faces, np.int32), 1, -1).reshape(-1, 3))


def level(middle: Array, z: float = -_BASE_MM) -> Mesh:
    """A level surface as large as the camera's view, in cells: those behind it are skipped.

    Args:
        middle: (2,) below the camera's axis, mm.
        z: its height, mm; by default that of a bench or floor below the arenas.
    """
    reach = np.arange(-2600.0, 2601.0, 100.0)
    return field(middle[0] + reach, middle[1] + reach, np.full((len(reach), len(reach)), z))


def table(rng: np.random.Generator, arena: SimulatedScene, drop_mm: float) -> list[Mesh]:
    """A table or stool under an arena, and the room's floor below with a few objects on it.

    Args:
        rng: random number generator.
        arena: the arena on the table.
        drop_mm: from the arena's floor to the room's, mm.

    Returns:
        The meshes.
    """
    over = arena.half + rng.uniform(50.0, 90.0, 2)
    top = box([*arena.centre, -_BASE_MM - 12.0], [*over, 12.0], arena.yaw)
    objects = [top, level(arena.centre, -drop_mm)]
    for _ in range(3):
        way = rng.uniform(-np.pi, np.pi)
        half = rng.uniform(50.0, 130.0, 3)
        away = (np.hypot(*over) + rng.uniform(60.0, 350.0)) * np.array([np.cos(way), np.sin(way)])
        objects.append(
            box([*(arena.centre + away), half[2] - drop_mm], half, rng.uniform(-np.pi, np.pi))
        )
    return objects


def untidy(rng: np.random.Generator, arena: SimulatedScene) -> list[Mesh]:
    """A cluttered bench around an arena: boxes, books and instruments of many heights.

    Args:
        rng: random number generator.
        arena: the arena, which has free space around it.

    Returns:
        The meshes, without large level surfaces.
    """
    objects = []
    reach = float(np.hypot(*arena.half)) + 20.0
    for ring in range(5):
        for _ in range(10 + 5 * ring):
            way = rng.uniform(-np.pi, np.pi)
            half = np.array([*rng.uniform(25.0, 90.0, 2), 0.0])
            away = reach + np.hypot(*half[:2]) * 0.6 + rng.uniform(0.0, 30.0) + 110.0 * ring
            high = rng.uniform(-90.0, 190.0)
            half[2] = 100.0
            place = arena.centre + away * np.array([np.cos(way), np.sin(way)])
            objects.append(box([*place, high - half[2]], half, rng.uniform(-np.pi, np.pi)))
    return objects


def lid_bars(arena: SimulatedScene, share: float = 0.35) -> list[Mesh]:
    """The wire lid of a cage, slid open: bars over one end of it.

    Args:
        arena: the cage; its long side is its first.
        share: share of the cage's length covered by bars.

    Returns:
        The meshes: bars along the cage every 9 mm, and two across.
    """
    long, wide = arena.half
    z = arena.wall_mm + 2.0
    reach = share * long
    # position along and across the cage, height, and half sides
    along = [(long - reach, y, z, [reach, 1.3, 1.3]) for y in np.arange(-wide, wide + 0.1, 9.0)]
    across = [(x, 0.0, z - 2.5, [1.8, wide, 1.8]) for x in (long - 2.0 * reach, long - reach)]
    return [
        box([*(arena.centre + turned(np.array([x, y]), arena.yaw)), high], half, arena.yaw)
        for x, y, high, half in (*along, *across)
    ]


def house(place: Array, yaw: float) -> list[Mesh]:
    """A shelter of 120 x 96 x 66 mm, open at one end.

    Args:
        place: (2,) its centre, mm, arena frame.
        yaw: direction of its exit, rad.

    Returns:
        The meshes of its roof and three walls.
    """
    sides = (
        (0.0, 0.0, 66.0, (60.0, 48.0, 1.5)),
        (-59.0, 0.0, 33.0, (1.5, 48.0, 33.0)),
        (0.0, 47.0, 33.0, (60.0, 1.5, 33.0)),
        (0.0, -47.0, 33.0, (60.0, 1.5, 33.0)),
    )
    return [
        box([*(place + turned(np.array([x, y]), yaw)), z], half, yaw) for x, y, z, half in sides
    ]
