"""Makes of depth sensors: their cameras, and ranges from which the noise of a unit is drawn.

Sources of today's cameras. Time of flight: up to 2.5 m the random error of the Azure Kinect is that
of the Kinect v2 (Kurillo et al., Sensors 2022, 22, 2469), and the Femto Bolt and Mega have its
sensor; an exposure takes 12.8 ms (Orbbec's hardware specification). Stereo: the error of depth is
z^2 / (f b) times that of disparity, in steps of 1/32 px (Intel, subpixel linearity of the D400
series); the baselines are the makers'. Assumed, for want of a published figure: an error of
disparity of 0.05 to 0.1 px, 8.5 ms of exposure of stereo cameras, steps of the Gemini like those of
the D400, and up to three times the noise on dark fur.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from liex_lab.arrays import Array, NDArray
from liex_lab.optics.camera import (
    AZURE_KINECT,
    DEPTH_MODES,
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


@dataclass(frozen=True)
class Sensor:
    """A make of depth sensor: its camera and its noise.

    Attributes:
        name: of the make.
        camera: its camera.
        kind: number of its noise model, `PRIMESENSE_KIND`, `KINECT_V2_KIND`, `LIGHT_FIELD_KIND` or
            `STEREO_KIND`.
        unit_mm: step of its depth, mm.
        stride: only every `stride`-th pixel of its large depth images is read.
        baseline_mm: between its two views, mm.
        steps: of disparity in a pixel.
        exposure_ms: of one depth image, ms; 0 records everything at rest and all fur alike.
    """

    name: str
    camera: Camera
    kind: int
    unit_mm: float = 1.0
    stride: int = 1
    baseline_mm: float = k.BASELINE_MM
    steps: float = k.SUBPIXEL
    exposure_ms: float = 0.0

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
            k.BASELINE: self.baseline_mm,
            k.STEPS: self.steps,
        }
        if self.kind == k.PRIMESENSE_KIND:
            columns |= {
                k.SMOOTH: rng.uniform(0.04, 0.11, n),  # pixels of disparity
                k.WHITE: rng.uniform(0.01, 0.04, n),
                k.EDGE_DROP: rng.uniform(0.05, 0.5, n),
                k.GRID: rng.uniform(3.0, 5.5, n),
                k.JITTER: rng.uniform(0.3, 0.9, n),
            }
        elif self.kind == k.STEREO_KIND:
            columns |= {
                k.SIDE: 1.0,  # depth is that of the left view
                k.SMOOTH: rng.uniform(0.06, 0.12, n),  # pixels of disparity, at nodes
                k.WHITE: rng.uniform(0.02, 0.05, n),
                k.EDGE_DROP: rng.uniform(0.05, 0.5, n),
                k.GRID: rng.uniform(4.0, 7.0, n),  # half of a matching window
                k.JITTER: rng.uniform(0.5, 1.5, n),
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
        if self.exposure_ms:
            columns[k.WEAK] = np.where(dark, rng.uniform(0.5, 2.0, n), 0.0)
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


def _on_sale(name: str, **facts: Any) -> Sensor:
    """A camera by name in its first depth mode, with an ideal lens."""
    mode = next(mode for mode in DEPTH_MODES if mode.name == name)
    return Sensor(name, replace(mode.camera, distortion=None), unit_mm=mode.unit_mm, **facts)


_TIME_OF_FLIGHT = {"kind": k.KINECT_V2_KIND, "exposure_ms": 12.8}
_STEREO = {"kind": k.STEREO_KIND, "exposure_ms": 8.5, "steps": 32.0}
# cameras that one can buy, or could until lately
ON_SALE = (
    *(_on_sale(name, **_TIME_OF_FLIGHT) for name in ("femto-bolt", "femto-mega", "azure-nfov")),
    *(
        _on_sale(name, baseline_mm=baseline_mm, **_STEREO)
        for name, baseline_mm in (
            ("gemini-2", 50.0),
            ("gemini-335", 50.0),
            ("d435", 50.0),
            ("d455", 95.0),
            ("d405", 18.0),
        )
    ),
)
BY_NAME = {
    sensor.name.lower().replace(" ", "-"): sensor
    for sensor in (
        KINECT_V2_SENSOR,
        PRIMESENSE_SENSOR,
        PRIMESENSE_QVGA_SENSOR,
        RAYTRIX_R5_SENSOR,
        *ON_SALE,
    )
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


def draw_units(
    rng: np.random.Generator, sensors: tuple[Sensor, ...], make: NDArray[np.int64], fur: Array
) -> tuple[Array, NDArray[np.int64], Array]:
    """Units of several makes, each recording one animal.

    Units of one make differ by a few per cent in focal length, and by some pixels in the optical
    axis.

    Args:
        rng: random number generator.
        sensors: the makes.
        make: (m,) index of the make of each unit.
        fur: (m,) of the animals, see `Sensor.draw`.

    Returns:
        Intrinsics (m, 4) and image sizes (m, 2), px, and parameters (m, N_PARAMETERS).
    """
    m = len(make)
    intrinsics, size_px = np.empty((m, 4)), np.empty((m, 2), np.int64)
    parameters = np.empty((m, k.N_PARAMETERS))
    for number, sensor in enumerate(sensors):
        rows = make == number
        camera = sensor.camera.every(sensor.stride)
        focal = rng.uniform(0.97, 1.03, (m, 1)) * [camera.fx, camera.fy]
        axis = rng.normal(0.0, 4.0, (m, 2)) + np.array([camera.cx, camera.cy])
        intrinsics[rows] = np.concatenate([focal, axis], axis=1)[rows]
        size_px[rows] = camera.width, camera.height
        parameters[rows] = sensor.coarse(sensor.draw(rng, m, fur))[rows]
    return intrinsics, size_px, parameters
