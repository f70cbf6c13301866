"""Arenas and their surroundings: walled floors, benches, tables, cluttered rooms, cages, bedding.

A floor is a height field over a grid of 5 mm: a few long waves, the rounding exp(-distance /
spread) that multi-path reflections leave at the foot of walls, and bedding. Bedding is a sum of
lumps at random positions; an animal's steps compress it and push it aside, epoch by epoch
(`Bedding`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from liex_lab.geometry import SE3
from liex_lab.optics.camera import Camera
from liex_lab.simulation.scene import BOX, ROUND, SimulatedScene, floor_point
from liex_lab.simulation.scenes.meshes import Mesh, box, field, turned, wall

Array = NDArray[np.float64]

_GRID_MM = 5.0
_RIM_MM = 5.0
_BASE_MM = 6.0  # between an arena's floor and the surface below
_FAR_MM = 2600.0  # half the side of a room's floor
_CELL_MM = 100.0
_OUTLINE = 48  # corners of a round wall
_LUMP_MM = 18.0
_LUMP_SPACING_MM = 26.0
_PRESSED = 0.55  # share of the bedding's height that an animal compresses in an epoch


def look_down(camera_mm: float, tilt_rad: float, toward_rad: float) -> SE3:
    """Pose of a camera above a floor.

    Args:
        camera_mm: its height, mm.
        tilt_rad: of its axis from the vertical, rad.
        toward_rad: direction in the image that is tilted away from the floor, rad.

    Returns:
        T_arena_camera; the arena frame's origin is at the camera's foot, its x along the camera's.
    """
    up = -np.array(
        [
            np.sin(tilt_rad) * np.cos(toward_rad),
            np.sin(tilt_rad) * np.sin(toward_rad),
            np.cos(tilt_rad),
        ]
    )
    x = np.array([1.0, 0.0, 0.0]) - up[0] * up
    x /= np.linalg.norm(x)
    return SE3(np.stack([x, np.cross(up, x), up]), np.array([0.0, 0.0, camera_mm]))


def arena_at(
    camera: Camera,
    T_arena_camera: SE3,
    shift: tuple[float, float],
    half: tuple[float, float],
    yaw: float,
    wall_mm: float,
    clutter: Array,
    kind: str = BOX,
) -> SimulatedScene:
    """An arena for the paths of animals, without its depth image.

    Args:
        camera: the camera.
        T_arena_camera: its pose.
        shift: of the arena's centre from the point where the camera's axis meets the floor, mm.
        half: half its sides, or its radius twice, mm.
        yaw: its rotation, rad.
        wall_mm: height of the walls, mm.
        clutter: (n, 2) points that animals avoid, mm.
        kind: 'box' or 'round'.

    Returns:
        The arena; `still` is empty.
    """
    axis = np.array([camera.cx, camera.cy])
    centre = floor_point(camera, T_arena_camera, axis) + np.asarray(shift)
    return SimulatedScene(
        camera,
        T_arena_camera,
        kind,
        centre,
        np.asarray(half, float),
        yaw,
        wall_mm,
        clutter,
        np.zeros((0, 0), np.float32),
    )


def outline_of_walls(arena: SimulatedScene) -> Array:
    """The foot of an arena's walls: (n, 2) corners, counter-clockwise, mm."""
    if arena.kind == ROUND:
        phi = 2 * np.pi * np.arange(_OUTLINE) / _OUTLINE
        local = arena.half[0] * np.stack([np.cos(phi), np.sin(phi)], axis=-1)
    else:
        local = arena.half * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    return arena.centre + turned(local, arena.yaw)


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
    def draw(rng: np.random.Generator, arena: SimulatedScene) -> Ground:
        """Draw a floor with random unevenness."""
        x, y = (
            np.arange(-reach - 2 * _GRID_MM, reach + 2 * _GRID_MM + 0.1, _GRID_MM)
            for reach in arena.half
        )
        local = np.stack(np.meshgrid(x, y), axis=-1)
        heights = np.zeros(local.shape[:-1])
        for _ in range(4):
            way = rng.uniform(-np.pi, np.pi)
            length = rng.uniform(70.0, 350.0)
            along = local @ np.array([np.cos(way), np.sin(way)])
            heights += rng.uniform(0.0, 0.6) * np.sin(
                2 * np.pi * along / length + rng.uniform(0, 2 * np.pi)
            )
        clearance = arena.wall_clearance(arena.centre + turned(local, arena.yaw))
        if arena.wall_mm > 0:
            heights += rng.uniform(0.0, 8.0) * np.exp(
                -np.maximum(clearance, 0.0) / rng.uniform(6.0, 18.0)
            )
        return Ground(arena, x, y, heights, clearance > -1.5 * _GRID_MM)

    def mesh(self, bedding: Array | None = None) -> Mesh:
        """The floor as a mesh in the arena frame.

        Args:
            bedding: (m, n) heights of bedding, mm; None for no bedding.
        """
        heights = self.heights if bedding is None else self.heights + bedding
        flat = field(self.x, self.y, heights)
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
    def draw(rng: np.random.Generator, ground: Ground, tracks: Array, frames: int) -> Bedding:
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
        area = float(np.prod(2.0 * ground.arena.half))
        n_lumps = int(area / _LUMP_SPACING_MM**2)
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
            here = here * (1.0 - _PRESSED * trodden) + 4.0 * aside * rng.random(here.shape)
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
        bell = np.exp(-0.5 * (np.arange(-15, 16) / 5.0) ** 2)
        return np.convolve(np.pad(height, 15, mode="edge"), bell / bell.sum(), mode="valid")


def _lumps(grid: Array, places: Array, tall: Array, wide: Array) -> Array:
    """Heights (m, n) mm of lumps: the tallest at every node, with a low layer between them."""
    height = np.full(grid.shape[:-1], 2.0)
    for place, top, width in zip(places, tall, wide, strict=True):
        gap2 = ((grid - place) ** 2).sum(axis=-1)
        np.maximum(height, top * np.exp(-0.5 * gap2 / (0.5 * width) ** 2), out=height)
    return height


def walls_of(arena: SimulatedScene, slope: float = 0.0, rim_mm: float = _RIM_MM) -> list[Mesh]:
    """The walls of an arena.

    Args:
        arena: the arena; a wall height of 0 has none.
        slope: horizontal distance of the rim outside the foot, mm.
        rim_mm: width of the rim, mm.

    Returns:
        Their meshes.
    """
    if arena.wall_mm <= 0.0:
        return []
    return [wall(outline_of_walls(arena), -_BASE_MM, arena.wall_mm, rim_mm, slope)]


def bench(middle: Array) -> list[Mesh]:
    """A bench or floor below the arenas, as large as the camera's view.

    Args:
        middle: (2,) below the camera's axis, mm.
    """
    return [_level(middle, -_BASE_MM)]


def _level(middle: Array, z: float) -> Mesh:
    """A level surface as large as the camera's view, in cells: those behind it are skipped."""
    reach = np.arange(-_FAR_MM, _FAR_MM + 1.0, _CELL_MM)
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
    room = _level(arena.centre, -drop_mm)
    things = [top, room]
    for _ in range(3):
        way = rng.uniform(-np.pi, np.pi)
        half = rng.uniform(50.0, 130.0, 3)
        away = (np.hypot(*over) + rng.uniform(60.0, 350.0)) * np.array([np.cos(way), np.sin(way)])
        things.append(
            box([*(arena.centre + away), half[2] - drop_mm], half, rng.uniform(-np.pi, np.pi))
        )
    return things


def untidy(rng: np.random.Generator, arena: SimulatedScene) -> list[Mesh]:
    """A cluttered bench around an arena: boxes, books and instruments of many heights.

    Args:
        rng: random number generator.
        arena: the arena, which has free space around it.

    Returns:
        The meshes, without large level surfaces.
    """
    things = []
    reach = float(np.hypot(*arena.half)) + 20.0
    for ring in range(5):
        for _ in range(10 + 5 * ring):
            way = rng.uniform(-np.pi, np.pi)
            half = np.array([*rng.uniform(25.0, 90.0, 2), 0.0])
            away = reach + np.hypot(*half[:2]) * 0.6 + rng.uniform(0.0, 30.0) + 110.0 * ring
            high = rng.uniform(-90.0, 190.0)
            half[2] = 100.0
            place = arena.centre + away * np.array([np.cos(way), np.sin(way)])
            things.append(box([*place, high - half[2]], half, rng.uniform(-np.pi, np.pi)))
    return things


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
    bars = []
    for y in np.arange(-wide, wide + 0.1, 9.0):
        middle = arena.centre + turned(np.array([long - reach, y]), arena.yaw)
        bars.append(box([*middle, z], [reach, 1.3, 1.3], arena.yaw))
    for x in (long - 2.0 * reach, long - reach):
        middle = arena.centre + turned(np.array([x, 0.0]), arena.yaw)
        bars.append(box([*middle, z - 2.5], [1.8, wide, 1.8], arena.yaw))
    return bars


def house(arena: SimulatedScene, place: Array, yaw: float) -> list[Mesh]:
    """A shelter of 120 x 96 x 66 mm, open at one end.

    Args:
        arena: the arena.
        place: (2,) its centre, mm, arena frame.
        yaw: direction of its exit, rad.

    Returns:
        The meshes of its roof and three walls.
    """
    parts = []
    for x, y, z, half in (
        (0.0, 0.0, 66.0, (60.0, 48.0, 1.5)),
        (-59.0, 0.0, 33.0, (1.5, 48.0, 33.0)),
        (0.0, 47.0, 33.0, (60.0, 1.5, 33.0)),
        (0.0, -47.0, 33.0, (60.0, 1.5, 33.0)),
    ):
        middle = place + turned(np.array([x, y]), yaw)
        parts.append(box([*middle, z], half, yaw))
    return parts
