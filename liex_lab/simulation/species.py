"""Interface between an animal and the renderer: sensors, surroundings, body shapes, pose prior.

`Species` is the interface that `training_patches`, `recording` and `locomotion` use; `MouseSpecies`
is the mouse, `FishSpecies` the zebrafish, `GenericSpecies` any animal with a skeleton.
"""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from liex_lab.body.pose import Pose
from liex_lab.body.shape import Body, BodyShape, Surface
from liex_lab.body.skeleton import VIEWS, Skeleton
from liex_lab.body.variation import draw_shapes, draw_tail_bends, vary_body
from liex_lab.optics.camera import (
    AZURE_KINECT,
    KINECT_V2,
    PRIMESENSE,
    PRIMESENSE_QVGA,
    RAYTRIX_R5,
    RAYTRIX_R5_LONG,
    RAYTRIX_R5_WIDE,
    REALSENSE_D435,
    Camera,
)
from liex_lab.simulation import _sensor_kernels as k
from liex_lab.simulation.pose_prior import (
    FISH_KINDS,
    FISH_SHARES,
    KINDS,
    SHARES,
    SIZE_RANGE,
    centred,
    clearance,
    draw_angles,
    draw_bends,
    hung,
    root_rotation,
    sample_postures,
)
from liex_lab.simulation.scene import ARENA, OBJECTS, SceneSpec

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Sensor:
    """A make of depth sensor: its camera and its noise.

    Attributes:
        name: of the make.
        camera: its camera.
        kind: number of its noise model, `PRIMESENSE_KIND`, `KINECT_V2_KIND` or `LIGHT_FIELD_KIND`.
        unit_mm: step of its depth, mm.
        stride: only every `stride`-th pixel of its large depth images is read.
    """

    name: str
    camera: Camera
    kind: int
    unit_mm: float = 1.0
    stride: int = 1

    def coarse(self, parameters: Array) -> Array:
        """Parameters of this sensor's units for images of every `stride`-th pixel.

        Args:
            parameters: (n, N_PARAMETERS) of full-resolution images.

        Returns:
            (n, N_PARAMETERS), the lengths in pixels divided by the stride.
        """
        coarse = parameters.copy()
        coarse[:, [k.GRID, k.JITTER]] /= self.stride
        return coarse

    def spread_mm(self, parameters: Array, distance_mm: Array) -> Array | float:
        """Standard deviation of the readings of a surface by units of a light-field camera.

        For other sensors it is 0, as it is negligible.

        Args:
            parameters: (n, N_PARAMETERS) of the units.
            distance_mm: (n,) of the surface, mm.

        Returns:
            (n,) mm, or 0.0.
        """
        if self.kind != k.LIGHT_FIELD_KIND:
            return 0.0
        smooth, white, noise = (parameters[:, column] for column in (k.SMOOTH, k.WHITE, k.NOISE))
        return noise * (distance_mm / k.TYPICAL_MM) ** 2 * np.hypot(0.8 * smooth, white)

    def draw(
        self, rng: np.random.Generator, n: int, fur: Array, noise: float = 1.0, erosion_px: int = 0
    ) -> Array:
        """Parameters of n units of this sensor, each recording one animal.

        Args:
            rng: random number generator.
            n: number of units.
            fur: (n,) of the animals, from 0 (sleek) to 1 (long and soft).
            noise: multiplies random errors and the rate of holes.
            erosion_px: pixels stripped off the animal's outline.

        Returns:
            (n, N_PARAMETERS), columns as in `_sensor_kernels`.
        """
        holes = 10 ** rng.uniform(-4.5, -3.0, n)
        dark = rng.random(n) < 0.4
        columns: dict[int, Array | float] = {
            k.UNIT: self.unit_mm,
            k.BACKGROUND: 1.0,
            k.KIND: self.kind,
            k.NOISE: noise,
            k.EROSION: erosion_px,
            k.FUR: fur,
            k.HOLES: holes,
            k.DARK: np.where(dark, 10 ** rng.uniform(-3.0, -1.7, n), 0.0),
            k.SIDE: rng.choice([-1.0, 1.0], n),
            k.LUMPS: rng.uniform(0.2, 1.0, n) * (0.6 + 0.8 * fur),
        }
        if self.kind == k.PRIMESENSE_KIND:
            columns |= {
                k.SMOOTH: rng.uniform(0.04, 0.11, n),  # pixels of disparity
                k.WHITE: rng.uniform(0.01, 0.04, n),
                k.EDGE_DROP: rng.uniform(0.05, 0.5, n),
                k.GRID: rng.uniform(3.0, 5.5, n),
                k.JITTER: rng.uniform(0.3, 0.9, n),
            }
        elif self.kind == k.LIGHT_FIELD_KIND:
            columns |= {
                k.SMOOTH: rng.uniform(0.4, 1.2, n),  # mm at 250 mm
                k.WHITE: rng.uniform(0.1, 0.4, n),
                k.LUMPS: rng.uniform(0.05, 0.25, n),
                k.GRID: rng.uniform(5.0, 11.0, n),  # the footprint of a few micro lenses, pixels
                k.JITTER: rng.uniform(0.5, 2.5, n),
                k.BACKGROUND: 0.5,
                k.OUTLIERS: rng.uniform(2.3, 3.2, n),  # standard deviations of a field
                # quantiles of a field: from a few per cent to a third of smooth skin has no
                # texture, less of the rest
                k.DARK: rng.uniform(-2.6, -0.45, n),
                k.HOLES: rng.uniform(-4.0, -1.2, n),
                # the maker's software fills unread pixels
                k.FLYING: (rng.random(n) < 0.5).astype(float),
            }
        else:
            columns |= {
                k.SMOOTH: rng.uniform(0.4, 1.3, n),  # of (1 + z^2) / 2 mm, z in metres
                k.WHITE: rng.uniform(0.3, 1.1, n),
                k.EDGE_DROP: rng.uniform(0.0, 0.15, n),
                k.GRID: rng.uniform(2.5, 5.0, n),
                k.FLYING: rng.uniform(0.2, 0.8, n),
                # dark hair has a small constant depth error
                k.BIAS: np.where(dark, rng.uniform(-2.0, 4.0, n), rng.uniform(-0.5, 1.0, n)),
            }
        p = np.zeros((n, k.N_PARAMETERS))
        for column, values in columns.items():
            p[:, column] = values
        return p


PRIMESENSE_SENSOR = Sensor("PrimeSense", PRIMESENSE, k.PRIMESENSE_KIND)
KINECT_V2_SENSOR = Sensor("Kinect v2", KINECT_V2, k.KINECT_V2_KIND)
PRIMESENSE_QVGA_SENSOR = Sensor("PrimeSense QVGA", PRIMESENSE_QVGA, k.PRIMESENSE_KIND)
RAYTRIX_R5_SENSOR = Sensor("Raytrix R5", RAYTRIX_R5, k.LIGHT_FIELD_KIND, unit_mm=0.02, stride=2)
SENSORS = (
    PRIMESENSE_SENSOR,
    KINECT_V2_SENSOR,
)  # makes used for sessions and training windows
BY_NAME = {
    sensor.name.lower().replace(" ", "-"): sensor
    for sensor in (KINECT_V2_SENSOR, PRIMESENSE_SENSOR, PRIMESENSE_QVGA_SENSOR, RAYTRIX_R5_SENSOR)
}
# for each noise model, cameras with a focal length and resolution that training does not use: those
# in training are within 3 % of the makes in `SENSORS`, of the Raytrix R5 above or of the NYU camera
_UNSEEN = {
    k.PRIMESENSE_KIND: (Sensor("RealSense D435", REALSENSE_D435, k.PRIMESENSE_KIND),),
    k.KINECT_V2_KIND: (Sensor("Azure Kinect", AZURE_KINECT, k.KINECT_V2_KIND),),
    k.LIGHT_FIELD_KIND: (
        Sensor("Raytrix R5 wide", RAYTRIX_R5_WIDE, k.LIGHT_FIELD_KIND, unit_mm=0.02, stride=2),
        Sensor("Raytrix R5 long", RAYTRIX_R5_LONG, k.LIGHT_FIELD_KIND, unit_mm=0.02, stride=2),
    ),
}


def unseen(sensors: tuple[Sensor, ...]) -> tuple[Sensor, ...]:
    """Cameras that are not used in training, with the noise models of the given sensors.

    Args:
        sensors: makes used for training images.
    """
    kinds = dict.fromkeys(sensor.kind for sensor in sensors)
    return tuple(sensor for kind in kinds for sensor in _UNSEEN[kind])


@dataclass(frozen=True)
class Species:
    """An animal as used by the renderer; everything is drawn from the given generator.

    Attributes:
        skeleton: of the animal.
        sensors: makes of cameras.
        setting: ranges of its surroundings.
        objects: kinds of distractors, see `scene.draw_object`.
        sizes: smallest and largest animal over the nominal size.
        floats: whether it is above the floor, not on it.
        frame_ns: between two frames of a recording, ns.
    """

    skeleton: Skeleton
    sensors: tuple[Sensor, ...]
    setting: SceneSpec
    objects: tuple[str, ...]
    sizes: tuple[float, float] = SIZE_RANGE
    floats: bool = False
    frame_ns: int = 33_333_333

    def shapes(self, rng: np.random.Generator, family: str, n: int) -> Body:
        """Bodies of a family of shapes.

        Args:
            rng: random number generator.
            family: one of `body.variation.FAMILIES`.
            n: number of bodies.

        Returns:
            A batch of n bodies.
        """
        return vary_body(rng, self.skeleton, family, n)

    def postures(
        self, rng: np.random.Generator, size: Array, shape: Body, camera_mm: Array
    ) -> tuple[Pose, Array]:
        """A posture for each of n animals, on or above the floor.

        Args:
            rng: random number generator.
            size: (n,) of the animals over home size.
            shape: (n) their bodies.
            camera_mm: (n,) heights of the cameras above the floor, mm.

        Returns:
            The poses, base above the origin, with girths and kinds.
        """
        raise NotImplementedError

    def bends(self, rng: np.random.Generator, n: int) -> Array | None:
        """Bends of tails, see `Surface.vertices`.

        Returns:
            (n, TAIL_RINGS) rad, or None for an animal without a separate tail.
        """
        return None


@dataclass(frozen=True)
class MouseSpecies(Species):
    """A mouse in an arena, recorded by a PrimeSense or a Kinect v2."""

    skeleton: Skeleton = field(default_factory=lambda: Skeleton.load("mouse"))
    sensors: tuple[Sensor, ...] = SENSORS
    setting: SceneSpec = ARENA
    objects: tuple[str, ...] = OBJECTS

    def shapes(self, rng: np.random.Generator, family: str, n: int) -> BodyShape:
        """Mice of a family of shapes."""
        return draw_shapes(rng, self.skeleton, family, n)

    def postures(
        self, rng: np.random.Generator, size: Array, shape: Body, camera_mm: Array
    ) -> tuple[Pose, Array]:
        """Mice that walk, curl up, rear, hunch and reach, with the frequencies of
        `pose_prior.SHARES`; kinds are indices into `pose_prior.KINDS`.
        """
        assert isinstance(shape, BodyShape)
        kinds = rng.choice(len(KINDS), len(size), p=SHARES)
        return sample_postures(rng, self.skeleton, size, shape, kinds)

    def bends(self, rng: np.random.Generator, n: int) -> Array:
        """Bends of the tails (n, TAIL_RINGS), rad."""
        return draw_tail_bends(rng, n)


TANK = SceneSpec(
    camera_mm=(230.0, 330.0),
    tilt_rad=float(np.radians(6.0)),
    walls_mm=(30.0, 110.0),
    open_share=0.2,
    clutter=("pellet", "plant"),
    scale=0.3,
)
NEAREST_MM = 180.0  # of a fish to the camera: nearer, a large one does not fit in the image


@dataclass(frozen=True)
class FishSpecies(Species):
    """A zebrafish that swims anywhere in a tank, recorded from above by a Raytrix R5."""

    skeleton: Skeleton = field(default_factory=lambda: Skeleton.load("fish"))
    sensors: tuple[Sensor, ...] = (RAYTRIX_R5_SENSOR,)
    setting: SceneSpec = TANK
    objects: tuple[str, ...] = ("pellet", "plant", "fish")
    sizes: tuple[float, float] = (25.0 / 30.0, 40.0 / 30.0)
    floats: bool = True
    frame_ns: int = 20_000_000

    def postures(
        self, rng: np.random.Generator, size: Array, shape: Body, camera_mm: Array
    ) -> tuple[Pose, Array]:
        """Fish that glide, scoot and turn, mostly level, at any height above the floor, at least
        NEAREST_MM from the camera; kinds are indices into `pose_prior.FISH_KINDS`.
        """
        n = len(size)
        kind = rng.choice(len(FISH_KINDS), n, p=FISH_SHARES)
        steep = np.where(rng.random(n) < 0.12, 25.0, 8.0)
        pitch = np.clip(rng.normal(0.0, 1.0, n) * steep, -55.0, 55.0)
        roll = np.clip(rng.normal(0.0, 8.0, n), -25.0, 25.0)
        rotation = root_rotation(rng.uniform(-np.pi, np.pi, n), np.radians(pitch), np.radians(roll))
        pose = hung(self.skeleton, draw_bends(rng, self.skeleton, kind), rotation, size)
        low, high = clearance(self.skeleton, pose, shape, size)
        headroom = np.maximum(camera_mm - NEAREST_MM - high, low + 1.0)
        # some are just above the floor
        at = np.where(rng.random(n) < 0.12, rng.uniform(0.0, 0.06, n), rng.random(n))
        pose.root.translation[:, 2] += low + at * (headroom - low) + rng.uniform(0.5, 2.0, n)
        return pose, size


# tilts from which the resting orientation on the floor is chosen
_TILTS = 8
NEAR_SHARE = 0.55  # of the camera's height: upper limit of floating animals


@dataclass(frozen=True)
class GenericSpecies(Species):
    """An animal with only a skeleton and a surface, in any posture.

    It lies on the floor, in the lowest of several tilts, as gravity would have it, or (view frame
    'camera') floats above it.
    """

    @staticmethod
    def of(skeleton: Skeleton) -> "GenericSpecies":
        """The species of a skeleton: visible by the Raytrix R5 below 35 mm of length, in a scene in
        which the whole animal is visible from anywhere, at a sufficient size.
        """
        # a short animal uses a close-range camera
        sensors = (RAYTRIX_R5_SENSOR,) if skeleton.length < 35.0 else SENSORS
        scale = float(np.clip(skeleton.relative_size, 0.3, 2.0))
        # large in the image, with space to move, and not below the cameras' minimum distance
        least = ARENA.camera_mm[0] if sensors == SENSORS else 230.0
        wide = max(sensor.camera.fx / sensor.camera.height for sensor in sensors)
        near = max(least, 2.2 * skeleton.length * wide)
        walls = (ARENA.walls_mm[0] * scale, ARENA.walls_mm[1] * scale)
        return GenericSpecies(
            skeleton,
            sensors,
            SceneSpec(camera_mm=(near, 1.6 * near), walls_mm=walls, scale=scale),
            ("block", "ball"),
            floats=skeleton.view.frame != VIEWS[0],
        )

    def window_px(self, length_mm: float) -> int:
        """Side of a square patch, px, that contains an animal of this mean length at any position.

        Args:
            length_mm: mean length of the animals, mm.

        Returns:
            The side, a multiple of 8 px.
        """
        nearest = self.setting.camera_mm[0] * (1.0 - NEAR_SHARE if self.floats else 0.9)
        focal = max(sensor.camera.fx / sensor.stride for sensor in self.sensors)
        px = 1.1 * self.sizes[1] * length_mm * focal / nearest + 32.0
        return 8 * int(np.ceil(px / 8.0))

    def postures(
        self, rng: np.random.Generator, size: Array, shape: Body, camera_mm: Array
    ) -> tuple[Pose, Array]:
        """Postures within the joints' limits, smooth along the chains."""
        n = len(size)
        angles = draw_angles(rng, self.skeleton, n)
        heading = rng.uniform(-np.pi, np.pi, n)
        if self.floats:
            tilt = np.clip(rng.normal(0.0, 0.25, (2, n)), -0.9, 0.9)
            pose = centred(
                self.skeleton, angles, root_rotation(heading, tilt[0], 0.6 * tilt[1]), size
            )
            low, high = self.extent(pose, shape, size)
            headroom = np.maximum(NEAR_SHARE * camera_mm - high, -low + 1.0)
            pose.root.translation[:, 2] += -low + rng.random(n) * (headroom + low)
            return pose, size
        pose = self._fallen(rng, angles, heading, size)
        low, _ = self.extent(pose, shape, size)
        pose.root.translation[:, 2] += rng.uniform(0.0, 2.0, n) * self.setting.scale - low
        return pose, size

    def extent(self, pose: Pose, shape: Body, size: Array) -> tuple[Array, Array]:
        """Lowest and highest points (n,) mm of the bodies."""
        z = Surface.of(self.skeleton).vertices(pose, shape, size)[..., 2]
        return z.min(axis=1), z.max(axis=1)

    def _fallen(self, rng: np.random.Generator, angles: Array, heading: Array, size: Array) -> Pose:
        """The lowest of several random tilts, as under gravity; sometimes any of them."""
        n = len(size)
        tilts = rng.normal(0.0, 0.35, (_TILTS, 2, n))
        tilts[0] = 0.0
        poses = [
            centred(self.skeleton, angles, root_rotation(heading, t[0], t[1]), size) for t in tilts
        ]
        z = np.stack([pose.joints(self.skeleton)[..., 2] for pose in poses])
        best = np.argmin(z.mean(axis=2) - z.min(axis=2), axis=0)
        # not all lie as low as possible
        best = np.where(rng.random(n) < 0.15, rng.integers(_TILTS, size=n), best)
        return Pose.join(poses)[best * n + np.arange(n)]
