"""A square plate above a flat floor, as a real camera reports it: through its bent lens, and
through water.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from liex_lab.optics.camera import Camera, Water
from tests.oracles.refraction import seen

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Plate:
    """A floor at floor_mm straight before the camera, and above it by high_mm a thin square, seen
    from above only.

    side_mm of the square; centre (x, y) mm in the camera frame; turn rad.
    """

    floor_mm: float
    side_mm: float
    high_mm: float = 20.0
    centre: tuple[float, float] = (0.0, 0.0)
    turn: float = 0.3

    def depth(self, camera: Camera, water: Water | None = None) -> Array:
        """What the camera reports (H, W) mm, without noise; 0 where its lens sees nothing."""
        top, near = plane(camera, water, self.floor_mm - self.high_mm)
        _, far = plane(camera, water, self.floor_mm)
        c, s = np.cos(self.turn), np.sin(self.turn)
        off = np.abs((top - np.array(self.centre)) @ np.array([[c, -s], [s, c]])).max(axis=-1)
        return np.where(off < self.side_mm / 2, near, far)


@lru_cache(maxsize=8)
def plane(camera: Camera, water: Water | None, z: float) -> tuple[Array, Array]:
    """The plane at depth z mm: the place (x, y) mm (H, W, 2) under every pixel, and the depth (H,
    W) mm reported.
    """
    v, u = np.mgrid[0 : camera.height, 0 : camera.width].astype(float)
    ray = camera.unproject(np.stack([u, v], axis=-1), 1.0)
    if water is None:
        return ray[..., :2] * z, np.where(np.isfinite(ray[..., 0]), z, 0.0)
    start, way = bent_down(ray, water)
    points = start + way * ((z - start[..., 2]) / way[..., 2])[..., None]
    xy, apparent = seen(
        points, water.normal, water.height_mm, water.refractive_index, water.ranging, 0.01
    )
    assert np.nanmax(np.abs(xy - ray[..., :2])) < 1e-6, "the way back is the way there"
    return points[..., :2], np.nan_to_num(apparent)


def bent_down(ray: Array, water: Water) -> tuple[Array, Array]:
    """Where rays (..., 3) meet the water, and how they go on: Snell's law as vectors."""
    unit = ray / np.linalg.norm(ray, axis=-1, keepdims=True)
    down = water.normal
    cosine = (unit @ down)[..., None]
    meets = unit * (water.height_mm / cosine)
    flat = (
        unit - cosine * down
    ) / water.refractive_index  # the part along the surface, as long as the sine
    return meets, flat + np.sqrt(1.0 - (flat * flat).sum(axis=-1, keepdims=True)) * down
