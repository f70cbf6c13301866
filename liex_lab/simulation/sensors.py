"""Noise parameters of depth sensors: structured light, time of flight and light field.

Each make (`Sensor`) has a camera and ranges from which the parameters of a unit are drawn; the
models themselves are in `_sensor_kernels`: a PrimeSense (structured light), a Kinect v2 (time of
flight) and a Raytrix R5 (plenoptic). None of the ranges is fitted to a recording.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

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

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Sensor:
    """A make of depth sensor: its camera and how it errs.

    Attributes:
        name: of the make.
        camera: its camera.
        kind: number of its noise model, `PRIMESENSE_KIND`, `KINECT_V2_KIND` or `LIGHT_FIELD_KIND`.
        unit_mm: step of its depth, mm.
        stride: its pictures are so large that only every so many-th pixel is read.
    """

    name: str
    camera: Camera
    kind: int
    unit_mm: float = 1.0
    stride: int = 1

    def coarse(self, parameters: Array) -> Array:
        """Parameters of this sensor's units for pictures of every `stride`-th pixel.

        Args:
            parameters: (n, N_PARAMETERS) of whole pictures.

        Returns:
            (n, N_PARAMETERS), the lengths in pixels divided by the stride.
        """
        coarse = parameters.copy()
        coarse[:, [k.GRID, k.JITTER]] /= self.stride
        return coarse

    def spread_mm(self, parameters: Array, distance_mm: Array) -> Array | float:
        """Standard deviation of what units of a light-field camera read of one surface.

        Of other sensors it is 0, for it is small beside everything that they are used for.

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
        """Parameters of n units of this sensor, each looking at one animal.

        Args:
            rng: source of randomness.
            n: how many units.
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
            # dark hair returns late: its depth is a little off as a whole
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
    # quantiles of a field: from a few per cent to a third of the smooth skin bears no texture, less
    # of the rest
    p[:, k.DARK] = rng.uniform(-2.6, -0.45, n)
    p[:, k.HOLES] = rng.uniform(-4.0, -1.2, n)
    p[:, k.FLYING] = rng.random(n) < 0.5  # whether the maker's software fills what is unread


PRIMESENSE_SENSOR = Sensor("PrimeSense", PRIMESENSE, k.PRIMESENSE_KIND)
KINECT_V2_SENSOR = Sensor("Kinect v2", KINECT_V2, k.KINECT_V2_KIND)
PRIMESENSE_QVGA_SENSOR = Sensor("PrimeSense QVGA", PRIMESENSE_QVGA, k.PRIMESENSE_KIND)
RAYTRIX_R5_SENSOR = Sensor("Raytrix R5", RAYTRIX_R5, k.LIGHT_FIELD_KIND, unit_mm=0.02, stride=2)
SENSORS = (
    PRIMESENSE_SENSOR,
    KINECT_V2_SENSOR,
)  # those that sessions and training windows are drawn from
BY_NAME = {
    sensor.name.lower().replace(" ", "-"): sensor
    for sensor in (KINECT_V2_SENSOR, PRIMESENSE_SENSOR, PRIMESENSE_QVGA_SENSOR, RAYTRIX_R5_SENSOR)
}
# of each noise model, cameras whose focal length and resolution no training picture has: those are
# within 3 % of the makes in `SENSORS`, of the Raytrix R5 above or of the NYU camera
_UNSEEN = {
    k.PRIMESENSE_KIND: (Sensor("RealSense D435", REALSENSE_D435, k.PRIMESENSE_KIND),),
    k.KINECT_V2_KIND: (Sensor("Azure Kinect", AZURE_KINECT, k.KINECT_V2_KIND),),
    k.LIGHT_FIELD_KIND: (
        Sensor("Raytrix R5 wide", RAYTRIX_R5_WIDE, k.LIGHT_FIELD_KIND, unit_mm=0.02, stride=2),
        Sensor("Raytrix R5 long", RAYTRIX_R5_LONG, k.LIGHT_FIELD_KIND, unit_mm=0.02, stride=2),
    ),
}


def unseen(sensors: tuple[Sensor, ...]) -> tuple[Sensor, ...]:
    """Sensors that err as the given ones do, with cameras that no model was trained on.

    Args:
        sensors: makes that training pictures are drawn from.
    """
    kinds = dict.fromkeys(sensor.kind for sensor in sensors)
    return tuple(sensor for kind in kinds for sensor in _UNSEEN[kind])
