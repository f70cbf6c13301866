"""Refraction at a flat water surface by Snell's law: the true position of a point observed from
air.

n sin r = sin i, with i and r the angles between ray and perpendicular in air and in water. A camera
above the water observes every point in a wrong direction and reports a wrong depth. The direction
is corrected by tracing the camera's ray down. The depth that the camera reports, the *apparent*
depth, depends on its principle:

- `light_field` (plenoptic cameras, many small views in all directions) and `structured_light` (also
stereo; two views displaced along the image's rows) triangulate: the apparent point is where the
back-traced rays of neighbouring views intersect. Straight down, that is at depth / n below the
surface. Obliquely the rays of a point meet at two depths (refraction at a plane is astigmatic):
views displaced within the plane of incidence see it at d cos^3(i) / (n cos^3(r)), views displaced
across it at d tan(r) / tan(i), for a point d below the surface. A camera reports the depth whose
disparity is the sum of both, each weighted with the part of the displacement along it; a light
field uses the mean over all directions. - `time_of_flight` cameras report half the path of the
light as if in air: the path in water counts n times, so that objects seem farther, not nearer. (n
is that of the group velocity, and near infrared is soon absorbed.) - `paraxial`: depth / n below
the surface at every angle, the textbook rule; for comparison.
"""

from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from liex_lab.errors import LiexError
from liex_lab.optics.camera import Camera

Array = NDArray[np.float64]

RANGINGS = ("light_field", "structured_light", "time_of_flight", "paraxial")
_STEEPEST = 0.05  # cosine between a ray and the perpendicular; flatter rays do not reach the water


@dataclass(frozen=True)
class Water:
    """A flat water surface below the camera.

    Attributes:
        height_mm: of the lens above the surface, along the perpendicular.
        refractive_index: of water over air, at least 1.
        tilt_x_rad: slope of the surface away from the camera towards the right of the image.
        tilt_y_rad: slope away from the camera towards the lower edge of the image.
        ranging: one of `RANGINGS`, see the module.

    Raises:
        LiexError: a height that is not positive, an index below 1, a tilt of 1.2 rad or more, or an
            unknown ranging.
    """

    height_mm: float
    refractive_index: float = 1.333
    tilt_x_rad: float = 0.0
    tilt_y_rad: float = 0.0
    ranging: str = "light_field"

    def __post_init__(self) -> None:
        numbers = (self.height_mm, self.refractive_index, self.tilt_x_rad, self.tilt_y_rad)
        possible = (
            self.height_mm > 0 and self.refractive_index >= 1 and np.abs(numbers[2:]).max() < 1.2
        )
        if not (possible and np.isfinite(numbers).all() and self.ranging in RANGINGS):
            raise LiexError(
                "a water surface has a positive height_mm below the lens, a "
                "refractive_index of at least 1, tilts below 1.2 rad and ranging "
                f"{', '.join(RANGINGS)}, got {asdict(self)}; correct [water] in the plan"
            )

    @property
    def normal(self) -> Array:
        """Unit normal (3,) of the surface, away from the camera, in the camera frame."""
        down = np.array([-np.tan(self.tilt_x_rad), -np.tan(self.tilt_y_rad), 1.0])
        return down / np.linalg.norm(down)

    @property
    def lift_mm(self) -> Array:
        """Translation (3,) mm from the camera's frame to that of `without`.

        To be added to points; the axes are parallel.
        """
        return (self.refractive_index - 1.0) * self.height_mm * self.normal

    def without(self, camera: Camera) -> Camera:
        """The ideal camera, higher up, that without the water has the same view as this one through
        it.

        Under water the rays that meet in the lens continue, near the perpendicular, as if they met
        n times as high above the surface. An ideal camera there (see `lift_mm`), with focal lengths
        n times as long, sees everything from the same side and in the same pixel; away from the
        perpendicular a point moves slightly towards the middle.

        Args:
            camera: the real one, without distortion.
        """
        n = self.refractive_index
        bent = self.law(np.zeros(2))[7:]
        return replace(
            camera,
            fx=n * camera.fx,
            fy=n * camera.fy,
            cx=camera.cx - n * camera.fx * float(bent[0] / bent[2]),
            cy=camera.cy - n * camera.fy * float(bent[1] / bent[2]),
        )

    def law(self, rays: ArrayLike) -> Array:
        """The effect of refraction on rays: ten numbers for each.

        (a, b, c, k, sx, sy, sz, bx, by, bz): a point reported at apparent depth z is d below the
        surface, where

            a d^2 + (b - c z) d = k z - 1,   if k z > 1,

        else above the water, at its apparent position; its position is (sx, sy, sz) + d (bx, by,
        bz), mm in the camera frame: the ray's own position on the surface, and its direction down.
        Rays flatter than 0.05 (cosine to the perpendicular) do not reach the water: k = 0.

        Args:
            rays: (..., 2), the x and y of (x, y, 1), camera frame.

        Returns:
            (..., 10).
        """
        xy = np.asarray(rays, float)
        ray = np.concatenate([xy, np.ones((*xy.shape[:-1], 1))], axis=-1)
        ray = ray / np.linalg.norm(ray, axis=-1, keepdims=True)
        down = self.normal
        n = self.refractive_index
        h = self.height_mm
        cos_air = ray @ down
        reaches = cos_air > _STEEPEST
        cos_air = np.maximum(cos_air, _STEEPEST)
        cos_water = np.sqrt(1.0 - (1.0 - cos_air**2) / n**2)
        surface = ray * (h / cos_air)[..., None]
        bent = ray / n + (cos_water - cos_air / n)[..., None] * down
        law = np.concatenate(
            [self._depth_law(ray, cos_air, cos_water), surface, bent / cos_water[..., None]],
            axis=-1,
        )
        law[..., 3] = np.where(reaches, cos_air / (ray[..., 2] * h), 0.0)
        return law

    def _depth_law(self, ray: Array, cos_air: Array, cos_water: Array) -> Array:
        """a, b, c of `law` and an empty column for k (..., 4), from unit rays and cosines."""
        n = self.refractive_index
        h = self.height_mm
        zero = np.zeros_like(cos_air)
        if self.ranging == "paraxial":
            return np.stack([zero, zero + 1.0 / (n * h), zero, zero], axis=-1)
        if self.ranging == "time_of_flight":
            return np.stack([zero, n * cos_air / (h * cos_water), zero, zero], axis=-1)
        within = cos_air**3 / (
            n * cos_water**3
        )  # apparent over true depth, views displaced in the plane of incidence
        across = cos_air / (n * cos_water)  # tan r / tan i
        weight_within, weight_across = self._weights(ray, cos_air)
        return np.stack(
            [
                within * across / h**2,
                (within + across) / h,
                (weight_within * across + weight_across * within) / h**2,
                zero,
            ],
            axis=-1,
        )

    def _weights(self, ray: Array, cos_air: Array) -> tuple[Array, Array]:
        """The parts (...) of the views' displacement within and across the plane of incidence of
        unit rays (..., 3).

        They weight the disparities: cos i / z' summed over both foci, z' being the distance of each
        below the lens.
        """
        side = np.cross(self.normal, ray)
        straight_down = (
            np.linalg.norm(side, axis=-1, keepdims=True) < 1e-9
        )  # where both foci coincide
        side = np.where(straight_down, np.cross([0.0, 1.0, 0.0], ray), side)
        side = side / np.linalg.norm(side, axis=-1, keepdims=True)
        along = np.cross(side, ray)
        axes = (0, 1) if self.ranging == "light_field" else (0,)
        within = np.zeros_like(cos_air)
        across = np.zeros_like(cos_air)
        for k in (
            axes
        ):  # the disparity of a displacement along one image axis is measured along that axis
            slope = ray[..., k] / ray[..., 2]
            within += (along[..., k] - slope * along[..., 2]) * along[..., k]
            across += (side[..., k] - slope * side[..., 2]) * side[..., k]
        share = cos_air / ray[..., 2] / len(axes)
        return within * share, across * share

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers for session.json."""
        return asdict(self)
