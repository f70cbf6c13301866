"""A square plate above a flat floor, as a real camera reports it: through its bent lens, and through water."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from liex_lab.camera import Camera
from liex_lab.water import Water
from tests.oracles.refraction import seen

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Plate:
    """A floor at floor_mm straight before the camera, and above it by high_mm a thin square, seen from above only.

    side_mm of the square; centre (x, y) mm in the camera frame; turn rad.
    """

    floor_mm: float
    side_mm: float
    high_mm: float = 20.0
    centre: tuple[float, float] = (0.0, 0.0)
    turn: float = 0.3

    def depth(self, camera: Camera, water: Water | None = None) -> Array:
        """What the camera reports (H, W) mm, without noise; 0 where its lens sees nothing."""
        v, u = np.mgrid[0 : camera.height, 0 : camera.width].astype(float)
        ray = camera.unproject(np.stack([u, v], axis=-1), 1.0)
        start, way = np.zeros(3), ray
        if water is not None:
            start, way = bent_down(ray, water)
        points = self.hit(start, way)
        if water is None:
            return np.nan_to_num(points[..., 2])
        xy, apparent = seen(points, water.normal, water.height_mm, water.refractive_index, water.ranging, 0.01)
        assert np.nanmax(np.abs(xy - ray[..., :2])) < 1e-6, "the way back is the way there"
        return np.nan_to_num(apparent)

    def hit(self, start: Array, way: Array) -> Array:
        """The first point (..., 3) of lines that begin at `start` and go along `way`: on the square or on the floor."""
        top, floor = (start + way * ((z - start[..., 2]) / way[..., 2])[..., None]
                      for z in (self.floor_mm - self.high_mm, self.floor_mm))  # fmt: skip
        c, s = np.cos(self.turn), np.sin(self.turn)
        off = top[..., :2] - np.array(self.centre)
        inside = np.abs(off @ np.array([[c, -s], [s, c]])).max(axis=-1) < self.side_mm / 2
        return np.where(inside[..., None], top, floor)


def bent_down(ray: Array, water: Water) -> tuple[Array, Array]:
    """Where rays (..., 3) meet the water, and how they go on: Snell's law as vectors."""
    unit = ray / np.linalg.norm(ray, axis=-1, keepdims=True)
    down = water.normal
    cosine = (unit @ down)[..., None]
    meets = unit * (water.height_mm / cosine)
    flat = (unit - cosine * down) / water.refractive_index  # the part along the surface, as long as the sine
    return meets, flat + np.sqrt(1.0 - (flat * flat).sum(axis=-1, keepdims=True)) * down
