"""Ray-cast model of an arena in front of a depth camera: floor, walls, clutter, free positions.

Floor and walls are intersected analytically with the ray of every pixel: the plane z = 0 raised by
a few long sine waves, a vertical cylinder or a rotated box for the walls, and a rounding
exp(-distance / spread) at their foot, as caused by multi-path reflections. Clutter is rasterised on
top. Free positions for an animal are found by rejection sampling against the signed distance from
the walls, the clutter and the image border.

Arena frame: z up from the floor, the origin at the foot of the camera's perpendicular.
"""

from dataclasses import dataclass, field, replace

import numpy as np

from liex_lab.arrays import Array, ArrayLike, NDArray
from liex_lab.body._skinning_kernels import joined_faces
from liex_lab.body.shape import render_mesh
from liex_lab.geometry import SE3
from liex_lab.optics.camera import Camera

OBJECTS = ("block", "ball", "cable", "hand")
N_PARTS = 8
SPHERE_TUBE = _RINGS, _SEGMENTS = (7, 14)
_THETA = np.pi * np.arange(1, _RINGS + 1)[:, None] / (_RINGS + 1)
_PHI = 2 * np.pi * np.arange(_SEGMENTS) / _SEGMENTS
_RING = np.broadcast_arrays(
    -np.cos(_THETA), np.sin(_THETA) * np.cos(_PHI), np.sin(_THETA) * np.sin(_PHI)
)
# vertices (V, 3) of a sphere as a tube: pole, rings, pole
SPHERE = np.concatenate(
    [[[-1.0, 0.0, 0.0]], np.stack(_RING, axis=-1).reshape(-1, 3), [[1.0, 0.0, 0.0]]]
)
OBJECT_FACES = joined_faces([SPHERE_TUBE] * N_PARTS)
PART_FACES = joined_faces([SPHERE_TUBE])


def turned(xy: Array, yaw: Array | float) -> Array:
    """Points rotated about the vertical.

    Args:
        xy: (..., 2) mm.
        yaw: one, or one of each point (...), rad.

    Returns:
        (..., 2) mm.
    """
    c = np.cos(yaw)
    s = np.sin(yaw)
    return np.stack([c * xy[..., 0] - s * xy[..., 1], s * xy[..., 0] + c * xy[..., 1]], axis=-1)


def rounded(centre: Array, radii: Array, yaw: Array, power: Array) -> Array:
    """Vertices of superellipsoids, rotated about the vertical.

    Args:
        centre: (..., 3) centres, mm.
        radii: (..., 3) half axes, mm.
        yaw: (...) rotation about the z axis, rad.
        power: (...) exponent; 2 is an ellipsoid, a large power a block.

    Returns:
        (..., V, 3) mm, with triangles as in `PART_FACES`.
    """
    p = np.asarray(power, float)[..., None, None]
    unit = SPHERE / (np.abs(SPHERE) ** p).sum(axis=-1, keepdims=True) ** (1.0 / p)
    local = unit * np.asarray(radii, float)[..., None, :]
    xy = turned(local[..., :2], np.asarray(yaw)[..., None])
    return np.concatenate([xy, local[..., 2:]], axis=-1) + np.asarray(centre, float)[..., None, :]


# parts of an object: centre and radii, mm; yaw, rad; power of the superellipsoid
Parts = list[tuple[ArrayLike, ArrayLike, float, float]]


def mesh_of(parts: Parts) -> Array:
    """Vertices (N_PARTS * V, 3) of an object of at most N_PARTS superellipsoids; unused ones have
    zero size.
    """
    unused = (np.zeros(3), np.zeros(3), 0.0, 2.0)
    columns = zip(*(parts + [unused] * (N_PARTS - len(parts))), strict=True)
    return rounded(*(np.array(column) for column in columns)).reshape(-1, 3)


def _block(rng: np.random.Generator, spine_mm: float) -> Parts:
    radii = spine_mm * rng.uniform(0.16, 0.55, 3) * [1.0, 0.75, 0.6]
    return [([0.0, 0.0, radii[2]], radii, rng.uniform(-np.pi, np.pi), 12.0)]


def _ball(rng: np.random.Generator, spine_mm: float) -> Parts:
    radii = spine_mm * rng.uniform(0.16, 0.55, 3) * [1.0, 0.75, 0.6]
    radii = radii.mean() * rng.uniform(0.9, 1.1, 3)
    return [([0.0, 0.0, radii[2]], radii, 0.0, 2.0)]


def _pellet(rng: np.random.Generator, spine_mm: float) -> Parts:
    """A sinking lump of food."""
    radii = spine_mm * rng.uniform(0.04, 0.13) * rng.uniform(0.7, 1.0, 3)
    return [([0.0, 0.0, radii[2] + spine_mm * rng.uniform(0.0, 2.0)], radii, 0.0, 2.0)]


def _plant(rng: np.random.Generator, spine_mm: float) -> Parts:
    """A tuft of thin leaves in the water."""
    parts: Parts = []
    for _ in range(N_PARTS):
        tall = spine_mm * rng.uniform(0.3, 0.9)
        radii = [spine_mm * rng.uniform(0.02, 0.05), spine_mm * rng.uniform(0.03, 0.10), tall]
        centre = [*rng.normal(0.0, 0.12, 2) * spine_mm, 0.9 * tall]
        parts.append((centre, radii, rng.uniform(-np.pi, np.pi), 2.0))
    return parts


def _fish(rng: np.random.Generator, spine_mm: float) -> Parts:
    """Another fish, much smaller than the animal: a body and a tail."""
    long = spine_mm * rng.uniform(0.30, 0.55)
    heading = rng.uniform(-np.pi, np.pi)
    ahead = np.array([np.cos(heading), np.sin(heading)])
    lift = spine_mm * rng.uniform(0.15, 1.5)
    return [
        ([*(at * long * ahead), lift], long * np.array(sides), heading, 2.0)
        for at, sides in ((0.12, [0.40, 0.075, 0.11]), (-0.32, [0.22, 0.02, 0.07]))
    ]


def _cable(rng: np.random.Generator, spine_mm: float) -> Parts:
    step = rng.uniform(10, 22)
    thick = rng.uniform(3, 7)
    heading = rng.uniform(-3, 3)
    bend = rng.normal(0, 0.25)
    at = np.array([-3.5 * step * np.cos(heading), -3.5 * step * np.sin(heading)])
    parts: Parts = []
    for _ in range(N_PARTS):
        parts.append(([*at, thick], [0.8 * step, thick, thick], heading, 2.0))
        at = at + step * np.array([np.cos(heading), np.sin(heading)])
        heading += bend + rng.normal(0, 0.15)
    return parts


def _hand(rng: np.random.Generator, spine_mm: float) -> Parts:
    lift = rng.uniform(0, 50)
    size = rng.uniform(0.8, 1.1)
    pointing = rng.uniform(-np.pi, np.pi)
    parts: Parts = [([0.0, 0.0, lift + 16], size * np.array([42.0, 38.0, 15.0]), pointing, 3.0)]
    for k in range(1, 6):
        fan = pointing + (k - 3) * 0.28
        reach = size * (70.0 if k < 5 else 55.0)
        centre = [reach * np.cos(fan), reach * np.sin(fan), lift + 12]
        parts.append((centre, size * np.array([34.0, 8.0, 8.0]), fan, 2.0))
    return parts


def draw_object(rng: np.random.Generator, kind: str, spine_mm: float) -> Array:
    """Vertices of one random object on the floor around the origin.

    Blocks and balls are from a third of to slightly over the animal's size; in a tank there are
    sinking pellets, plants and another swimming fish. Unused parts have zero size.

    Args:
        rng: random number generator.
        kind: 'block', 'ball', 'cable', 'hand', 'pellet', 'plant' or 'fish'.
        spine_mm: length of the animal, mm, which sets the size; cables and hands have their own.

    Returns:
        (N_PARTS * V, 3) mm, arena frame, with triangles as in `OBJECT_FACES`.
    """
    parts = {
        "block": _block,
        "ball": _ball,
        "pellet": _pellet,
        "plant": _plant,
        "fish": _fish,
        "cable": _cable,
        "hand": _hand,
    }[kind](rng, spine_mm)
    return mesh_of(parts)


ROUND = "round"
BOX = "box"
_TRIES = 64


@dataclass(frozen=True)
class SceneSpec:
    """Ranges of an animal's surroundings, from which a scene is drawn; lengths in mm.

    Attributes:
        camera_mm: lowest and highest camera above the floor.
        tilt_rad: largest tilt of a camera, rad.
        walls_mm: lowest and highest walls.
        open_share: share of scenes without walls.
        clutter: kinds of objects in the scene, see `draw_object`.
        scale: of corners, unevenness, distances and estimation errors, over those of a mouse's
            arena.
    """

    camera_mm: tuple[float, float] = (500.0, 1000.0)
    tilt_rad: float = float(np.radians(10.0))
    walls_mm: tuple[float, float] = (80.0, 400.0)
    open_share: float = 0.1
    clutter: tuple[str, ...] = ("block", "ball")
    scale: float = 1.0


ARENA = SceneSpec()


@dataclass(frozen=True)
class SimulatedScene:
    """The still scene of a virtual camera.

    Attributes:
        camera: the camera.
        T_arena_camera: its exact pose.
        kind: 'round' or 'box', the outline of the walls.
        centre: (2,) of the walls in the arena frame, mm.
        half: (2,) half extents of the walls (or their radius, twice), mm.
        yaw: rotation of the walls, rad.
        wall_mm: height of the walls, mm; 0 is an open table.
        clutter: (n, 2) outline points of the clutter, mm, arena frame.
        still: (H, W) float32 mm, the ideal depth without the animal, 0 = nothing in range.
    """

    camera: Camera
    T_arena_camera: SE3
    kind: str
    centre: Array
    half: Array
    yaw: float
    wall_mm: float
    clutter: Array = field(default_factory=lambda: np.zeros((0, 2)))
    still: NDArray[np.float32] = field(default_factory=lambda: np.zeros((0, 0), np.float32))

    @staticmethod
    def draw(
        rng: np.random.Generator, camera: Camera, spine_mm: float, setting: SceneSpec = ARENA
    ) -> "SimulatedScene":
        """A random arena, large enough for the animal, with the floor's centre in view.

        Walls are at least 1.6 body lengths from the centre; about a third of the scenes have one or
        two pieces of clutter near the wall.

        Args:
            rng: random number generator.
            camera: the camera.
            spine_mm: length of the animal, mm.
            setting: ranges to draw from.

        Returns:
            The scene with its ideal depth image.
        """
        T_arena_camera = draw_views(rng, 1, setting)[0]
        height = float(T_arena_camera.translation[2])
        view = height * np.array([camera.width / camera.fx, camera.height / camera.fy]) / 2.0
        kind = str(rng.choice([ROUND, BOX]))
        least = 1.6 * spine_mm
        most = 420.0 * max(setting.scale, 1.0)
        if kind == ROUND:
            half = np.full(2, max(least, rng.uniform(0.75, 1.15) * min(view[1], most)))
        else:
            half = np.maximum(least, rng.uniform(0.7, 1.1, 2) * np.minimum(view, most))
        middle = np.array([(camera.width - 1) / 2.0, (camera.height - 1) / 2.0])
        centre = floor_point(camera, T_arena_camera, middle) + rng.uniform(-0.15, 0.15, 2) * half
        low, high = setting.walls_mm
        yaw = rng.uniform(-0.3, 0.3)
        wall_mm = rng.uniform(low, min(high, 0.7 * height))
        wall_mm *= rng.random() >= setting.open_share  # else an open table
        scene = SimulatedScene(camera, T_arena_camera, kind, centre, half, yaw, wall_mm)
        still = scene._ideal_depth(rng, setting.scale)
        outline = [np.zeros((0, 2))]
        for _ in range(rng.choice([0, 1, 2], p=[0.65, 0.25, 0.10])):
            mesh = draw_object(rng, str(rng.choice(setting.clutter)), 0.8 * spine_mm)
            azimuth = rng.uniform(-np.pi, np.pi)
            local = 0.8 * half * [np.cos(azimuth), np.sin(azimuth)]
            mesh[:, :2] += centre + turned(local, yaw)
            item = render_mesh(mesh, OBJECT_FACES, camera, T_camera_mesh=T_arena_camera.inverse())
            still = np.where((item > 0) & ((still == 0) | (item < still)), item, still)
            outline.append(mesh[:, :2])
        return replace(scene, clutter=np.concatenate(outline), still=still)

    def wall_clearance(self, xy: Array) -> Array:
        """Signed distance of floor points from the walls, mm; negative outside.

        Args:
            xy: (..., 2) points, mm, arena frame.

        Returns:
            (...) mm.
        """
        local = turned(xy - self.centre, -self.yaw)
        if self.kind == ROUND:
            return self.half[0] - np.hypot(local[..., 0], local[..., 1])
        return np.min(self.half - np.abs(local), axis=-1)

    def freedom(self, xy: Array, z: float = 0.0) -> float:
        """Distance of one point from walls, clutter and the image border, mm.

        Args:
            xy: (2,) point, mm, arena frame.
            z: its height above the floor, mm.

        Returns:
            The smallest of the three; the border's is at the point's own depth. Negative outside.
        """
        c = self.camera
        p = self.T_arena_camera.inverse() @ np.array([xy[0], xy[1], z])
        uv = c.project(p)
        border = np.minimum(uv, np.array([c.width - 1, c.height - 1]) - uv).min() * p[2] / c.fx
        free = min(float(self.wall_clearance(xy)), float(border))
        if len(self.clutter):
            free = min(free, float(np.linalg.norm(self.clutter - xy, axis=1).min()))
        return free

    def _ideal_depth(self, rng: np.random.Generator, scale: float) -> NDArray[np.float32]:
        """Depth (H, W) mm along every ray: floor within the walls, walls up to their height.

        The floor continues beyond an open table; beyond walls there is nothing, or in 40 % of the
        scenes the cluttered surroundings of the arena.
        """
        T, camera = self.T_arena_camera, self.camera
        pixels = np.stack(np.meshgrid(np.arange(camera.width), np.arange(camera.height)), axis=-1)
        d = camera.unproject(pixels, 1.0) @ T.rotation.T
        height = T.translation[2]
        fall = np.where(d[..., 2] < -1e-3, -d[..., 2], 1e-3)
        floor = height / fall
        ground = floor[..., None] * d[..., :2]
        raised = unevenness(rng, ground, scale)
        wall_clearance = self.wall_clearance(ground)
        raised += rounding(rng, wall_clearance, 12.0, 25.0, scale) * (self.wall_mm > 0)
        inside = (wall_clearance > 0) & (d[..., 2] < -1e-3)
        depth = np.where(inside, floor - raised / fall, 0.0)
        wall = self._wall_distance(d)
        on_wall = ~inside & (wall > 0) & (height + wall * d[..., 2] < self.wall_mm)
        depth = np.where(on_wall, wall, depth)
        beyond = ~inside & ~on_wall
        if self.wall_mm == 0.0:
            depth = np.where(beyond, floor - raised / fall, depth)
        elif rng.random() < 0.4:  # the cluttered room around the arena
            around = (
                height + rng.uniform(0.0, 700.0) * scale - 60.0 * unevenness(rng, ground, scale)
            )
            depth = np.where(beyond & (d[..., 2] < -0.2), around / fall, depth)
        return np.where((depth > 100.0) & (depth < 4500.0), depth, 0.0).astype(np.float32)

    def _wall_distance(self, direction: Array) -> Array:
        """Depth (H, W) mm at which rays leave the walls' outline; 0 if they never do."""
        start = turned(-self.centre, -self.yaw)
        d = turned(direction[..., :2], -self.yaw)
        if self.kind == ROUND:
            a, b = np.sum(d * d, axis=-1), d @ start
            root = b * b - a * (start @ start - self.half[0] ** 2)
            far = (-b + np.sqrt(np.maximum(root, 0))) / np.maximum(a, 1e-12)
            return np.where((root > 0) & (a > 1e-12), far, 0.0)
        with np.errstate(divide="ignore", invalid="ignore"):
            leave = (np.sign(d) * self.half - start) / d
        return np.maximum(np.nanmin(np.where(np.isfinite(leave), leave, np.inf), axis=-1), 0.0)

    def places(
        self, rng: np.random.Generator, outline: Array, tops: Array, bottoms: Array | None = None
    ) -> Array:
        """Shifts that move each of n bodies to a random free position, completely inside the image.

        Of 64 random positions the first free one is used, else the one with the largest clearance.

        Args:
            rng: random number generator.
            outline: (n, K, 2) outermost points of the bodies in top view, mm.
            tops: (n,) highest points of the bodies, mm above the floor.
            bottoms: (n,) lowest points, mm; None for the floor.

        Returns:
            (n, 2) shifts, mm.
        """
        n = len(outline)
        middle = outline.mean(axis=1)
        reach = float(self.half.max()) if self.wall_mm > 0 else 0.9 * float(self.half.max())
        aim = self.centre + rng.uniform(-reach, reach, (n, _TRIES, 2))
        points = outline[:, None] - middle[:, None, None] + aim[:, :, None]
        wall_clearance = self.wall_clearance(points).min(axis=2) - 3.0
        T_camera_arena = self.T_arena_camera.inverse()
        c = self.camera
        for height in (np.zeros(n) if bottoms is None else bottoms, tops):
            above = np.broadcast_to(height[:, None, None, None], (*points.shape[:-1], 1))
            uv = c.project(T_camera_arena @ np.concatenate([points, above], axis=-1))
            border = (
                np.minimum(uv, np.array([c.width - 1, c.height - 1]) - uv).min(axis=(2, 3)) - 6.0
            )
            wall_clearance = np.minimum(wall_clearance, border)
        if len(self.clutter):
            gap = (
                np.linalg.norm(points[:, :, :, None] - self.clutter[::7], axis=-1).min(axis=(2, 3))
                - 12.0
            )
            wall_clearance = np.minimum(wall_clearance, gap)
        # the first free position, else the one with the largest clearance
        chosen = np.where(
            (wall_clearance > 0).any(axis=1),
            np.argmax(wall_clearance > 0, axis=1),
            np.argmax(wall_clearance, axis=1),
        )
        return aim[np.arange(n), chosen] - middle


def draw_views(rng: np.random.Generator, m: int, setting: SceneSpec = ARENA) -> SE3:
    """Poses of downward-facing cameras, tilted in any direction.

    The tilt's direction is uniform and its angle such that the tilts are uniform over a disc.

    Args:
        rng: random number generator.
        m: number of cameras.
        setting: supplies the ranges `camera_mm` and `tilt_rad`.

    Returns:
        (m) T_arena_camera; the arena frame's origin is at the camera's foot, its x along the
        camera's.
    """
    tilt = setting.tilt_rad * np.sqrt(rng.random(m))
    toward = rng.uniform(-np.pi, np.pi, m)
    return overhead_pose(rng.uniform(*setting.camera_mm, m), tilt, toward)


def overhead_pose(camera_mm: Array, tilt_rad: Array, toward_rad: Array) -> SE3:
    """Poses of cameras above a floor.

    Args:
        camera_mm: (m,) their heights, mm.
        tilt_rad: (m,) of their axes from the vertical, rad.
        toward_rad: (m,) direction in the image that is tilted away from the floor, rad.

    Returns:
        (m) T_arena_camera; the arena frame's origin is at the camera's foot, its x along the
        camera's.
    """
    up = -np.stack(
        [
            np.sin(tilt_rad) * np.cos(toward_rad),
            np.sin(tilt_rad) * np.sin(toward_rad),
            np.cos(tilt_rad),
        ],
        axis=-1,
    )
    x = np.array([1.0, 0.0, 0.0]) - up[:, :1] * up
    x /= np.linalg.norm(x, axis=-1, keepdims=True)
    translation = camera_mm[:, None] * [0.0, 0.0, 1.0]
    return SE3(np.stack([x, np.cross(up, x), up], axis=-2), translation)


def floor_point(camera: Camera, T_arena_camera: SE3, uv: Array) -> Array:
    """Points of the floor z = 0 at given pixels.

    Args:
        camera: the camera.
        T_arena_camera: its pose, the arena frame's origin at its foot.
        uv: (..., 2) pixels.

    Returns:
        (..., 2) mm, arena frame.
    """
    ray = camera.unproject(uv, np.ones(np.shape(uv)[:-1])) @ T_arena_camera.rotation.T
    return T_arena_camera.translation[2] / -ray[..., 2:] * ray[..., :2]


def outline_of(vertices: Array, n_directions: int = 24) -> Array:
    """Outermost points of bodies in top view, one in each of evenly spaced directions.

    Args:
        vertices: (n, V, 3) meshes, mm, arena frame.
        n_directions: number of directions.

    Returns:
        (n, n_directions, 2) mm.
    """
    angle = 2 * np.pi * np.arange(n_directions) / n_directions
    extent = vertices[..., :2] @ np.stack([np.cos(angle), np.sin(angle)])
    return np.take_along_axis(vertices[..., :2], extent.argmax(axis=1)[..., None], axis=1)


def unevenness(
    rng: np.random.Generator, ground: Array, scale: float = 1.0, most: float = 0.7
) -> Array:
    """Heights (H, W) mm of an uneven floor: a few long waves over points (H, W, 2) mm."""
    waves = np.zeros(ground.shape[:-1])
    for _ in range(4):
        azimuth = rng.uniform(-np.pi, np.pi)
        length = rng.uniform(70.0, 350.0) * scale
        along = ground @ np.array([np.cos(azimuth), np.sin(azimuth)])
        waves += (
            rng.uniform(0.0, most)
            * scale
            * np.sin(2 * np.pi * along / length + rng.uniform(0, 2 * np.pi))
        )
    return waves


def rounding(
    rng: np.random.Generator, clearance: Array, deep: float, far: float, scale: float = 1.0
) -> Array:
    """Heights that multi-path reflections add to a floor at the foot of walls.

    Args:
        rng: random number generator.
        clearance: (...) distance from the walls, mm.
        deep: largest height at their foot, mm at scale 1.
        far: largest extent, mm at scale 1.
        scale: of the surroundings, see `SceneSpec`.

    Returns:
        (...) mm.
    """
    height = rng.uniform(0.0, deep) * scale
    return height * np.exp(-np.maximum(clearance, 0.0) / (rng.uniform(6.0, far) * scale))
