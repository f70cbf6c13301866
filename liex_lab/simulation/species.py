"""Interface between an animal and the renderer: sensors, surroundings, body shapes, pose prior.

`Species` is the interface that `training_patches`, `recording` and `locomotion` use; `MouseSpecies`
is the mouse, `fish.FishSpecies` the zebrafish, `generic.GenericSpecies` any animal with a skeleton.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from liex_lab.body.pose import Pose
from liex_lab.body.shape import BodyShape, draw_shapes, draw_tail_bends
from liex_lab.body.skeleton import Skeleton
from liex_lab.body.surface import Body
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
from liex_lab.simulation.pose_prior import KINDS, SHARES, SIZE_RANGE, sample_postures
from liex_lab.simulation.scene import ARENA, THINGS, SceneSpec

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
        p = np.zeros((n, k.N_PARAMETERS))
        p[:, k.UNIT] = self.unit_mm
        p[:, k.BACKGROUND] = 1.0
        p[:, k.KIND] = self.kind
        p[:, k.NOISE] = noise
        p[:, k.EROSION] = erosion_px
        p[:, k.FUR] = fur
        p[:, k.HOLES] = 10 ** rng.uniform(-4.5, -3.0, n)
        dark = rng.random(n) < 0.4
        p[:, k.DARK] = np.where(dark, 10 ** rng.uniform(-3.0, -1.7, n), 0.0)
        p[:, k.SIDE] = rng.choice([-1.0, 1.0], n)
        p[:, k.LUMPS] = rng.uniform(0.2, 1.0, n) * (0.6 + 0.8 * fur)
        if self.kind == k.PRIMESENSE_KIND:
            p[:, k.SMOOTH] = rng.uniform(0.04, 0.11, n)  # pixels of disparity
            p[:, k.WHITE] = rng.uniform(0.01, 0.04, n)
            p[:, k.EDGE_DROP] = rng.uniform(0.05, 0.5, n)
            p[:, k.GRID] = rng.uniform(3.0, 5.5, n)
            p[:, k.JITTER] = rng.uniform(0.3, 0.9, n)
        elif self.kind == k.LIGHT_FIELD_KIND:
            _draw_light_field(rng, p)
        else:
            p[:, k.SMOOTH] = rng.uniform(0.4, 1.3, n)  # of (1 + z^2) / 2 mm, z in metres
            p[:, k.WHITE] = rng.uniform(0.3, 1.1, n)
            p[:, k.EDGE_DROP] = rng.uniform(0.0, 0.15, n)
            p[:, k.GRID] = rng.uniform(2.5, 5.0, n)
            p[:, k.FLYING] = rng.uniform(0.2, 0.8, n)
            # dark hair has a small constant depth error
            p[:, k.BIAS] = np.where(dark, rng.uniform(-2.0, 4.0, n), rng.uniform(-0.5, 1.0, n))
        return p


def _draw_light_field(rng: np.random.Generator, p: Array) -> None:
    """Draw the noise parameters of n plenoptic cameras into p (n, N_PARAMETERS)."""
    n = len(p)
    p[:, k.SMOOTH] = rng.uniform(0.4, 1.2, n)  # mm at 250 mm
    p[:, k.WHITE] = rng.uniform(0.1, 0.4, n)
    p[:, k.LUMPS] = rng.uniform(0.05, 0.25, n)
    p[:, k.GRID] = rng.uniform(5.0, 11.0, n)  # the footprint of a few micro lenses, pixels
    p[:, k.JITTER] = rng.uniform(0.5, 2.5, n)
    p[:, k.BACKGROUND] = 0.5
    p[:, k.BIAS] = 0.0
    p[:, k.OUTLIERS] = rng.uniform(2.3, 3.2, n)  # standard deviations of a field
    # quantiles of a field: from a few per cent to a third of smooth skin has no texture, less of
    # the rest
    p[:, k.DARK] = rng.uniform(-2.6, -0.45, n)
    p[:, k.HOLES] = rng.uniform(-4.0, -1.2, n)
    p[:, k.FLYING] = rng.random(n) < 0.5  # whether the maker's software fills unread pixels


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


class Postures(NamedTuple):
    """Poses of n animals, drawn from a prior.

    Attributes:
        pose: (n) arena frame, base above the origin.
        girth: (n,) factor of all lengths across the bodies.
        kind: (n,) int64, index into the species' kinds of posture.
    """

    pose: Pose
    girth: Array
    kind: NDArray[np.int64]


class Species(Protocol):
    """An animal as used by the renderer; everything is drawn from the given generator.

    Attributes:
        skeleton: of the animal.
        sensors: makes of cameras.
        setting: ranges of its surroundings.
        things: kinds of distractors, see `scene.draw_thing`.
        sizes: smallest and largest animal over the nominal size.
        floats: whether it is above the floor, not on it.
        frame_ns: between two frames of a recording, ns.
    """

    @property
    def skeleton(self) -> Skeleton: ...  # noqa: D102

    @property
    def sensors(self) -> tuple[Sensor, ...]: ...  # noqa: D102

    @property
    def setting(self) -> SceneSpec: ...  # noqa: D102

    @property
    def things(self) -> tuple[str, ...]: ...  # noqa: D102

    @property
    def sizes(self) -> tuple[float, float]: ...  # noqa: D102

    @property
    def floats(self) -> bool: ...  # noqa: D102

    @property
    def frame_ns(self) -> int: ...  # noqa: D102

    def shapes(self, rng: np.random.Generator, family: str, n: int) -> Body:
        """Bodies of a family of shapes.

        Args:
            rng: random number generator.
            family: one of `body.shape.FAMILIES`.
            n: number of bodies.

        Returns:
            A batch of n bodies.
        """

    def postures(
        self, rng: np.random.Generator, size: Array, shape: Body, camera_mm: Array
    ) -> Postures:
        """A posture for each of n animals, on or above the floor.

        Args:
            rng: random number generator.
            size: (n,) of the animals over home size.
            shape: (n) their bodies.
            camera_mm: (n,) heights of the cameras above the floor, mm.

        Returns:
            The poses, base above the origin, with girths and kinds.
        """

    def bends(self, rng: np.random.Generator, n: int) -> Array | None:
        """Bends of tails, see `Surface.vertices`.

        Returns:
            (n, TAIL_RINGS) rad, or None for an animal without a separate tail.
        """


@dataclass(frozen=True)
class MouseSpecies:
    """A mouse in an arena, recorded by a PrimeSense or a Kinect v2.

    Attributes:
        skeleton: of the mouse; by default the preset's.
        sensors: makes of cameras.
        setting: ranges of its surroundings.
        things: kinds of distractors.
        sizes: smallest and largest mouse over the nominal size.
        floats: False, as it is on the floor.
        frame_ns: between two frames of a recording, ns.
    """

    skeleton: Skeleton = field(default_factory=lambda: Skeleton.load("mouse"))
    sensors: tuple[Sensor, ...] = SENSORS
    setting: SceneSpec = ARENA
    things: tuple[str, ...] = THINGS
    sizes: tuple[float, float] = SIZE_RANGE
    floats: bool = False
    frame_ns: int = 33_333_333

    def shapes(self, rng: np.random.Generator, family: str, n: int) -> BodyShape:
        """Mice of a family of shapes.

        Args:
            rng: random number generator.
            family: one of `body.shape.FAMILIES`.
            n: number of mice.

        Returns:
            A batch of n bodies.
        """
        return draw_shapes(rng, self.skeleton, family, n)

    def postures(
        self, rng: np.random.Generator, size: Array, shape: Body, camera_mm: Array
    ) -> Postures:
        """Mice that walk, curl up, rear, hunch and reach, with the frequencies of
        `pose_prior.SHARES`.

        Args:
            rng: random number generator.
            size: (n,) of the mice over home size.
            shape: (n) their bodies.
            camera_mm: (n,) not used, as mice are on the floor.

        Returns:
            The poses with girths and kinds, indices into `pose_prior.KINDS`.
        """
        assert isinstance(shape, BodyShape)
        kinds = rng.choice(len(KINDS), len(size), p=SHARES)
        pose, girth = sample_postures(rng, self.skeleton, len(size), size, shape, kinds)
        return Postures(pose, girth, kinds)

    def bends(self, rng: np.random.Generator, n: int) -> Array | None:
        """Bends of the tails.

        Returns:
            (n, TAIL_RINGS) rad, the bend at each ring.
        """
        return draw_tail_bends(rng, n)
