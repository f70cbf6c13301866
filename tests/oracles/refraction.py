"""Seeing through water the slow way: from a known point back to the lens, by bisection on Snell's
law alone.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from liex_lab.optics.camera import Water

Array = NDArray[np.float64]


def ray_to(
    point: Array, lens: Array, normal: Array, distance_mm: float, n: float
) -> tuple[Array, Array, Array]:
    """Unit ray (..., 3) with which light from `point` (..., 3) under the plane normal . p =
    distance_mm reaches `lens` (3,), and the lengths mm (...) of its way in air and in water.
    """
    height = distance_mm - lens @ normal
    offset = point - lens
    depth = offset @ normal - height
    flat = offset - (offset @ normal)[..., None] * normal
    reach = np.linalg.norm(flat, axis=-1)
    low, high = np.zeros_like(reach), reach / height + 1e-12  # tangents of the angle in air
    for _ in range(48):
        tangent = 0.5 * (low + high)
        sine = tangent / np.sqrt(1.0 + tangent**2) / n
        short = height * tangent + depth * sine / np.sqrt(1.0 - sine**2) < reach
        low, high = np.where(short, tangent, low), np.where(short, high, tangent)
    outward = flat / np.maximum(reach, 1e-12)[..., None]
    ray = normal + low[..., None] * outward
    in_air = height * np.sqrt(1.0 + low**2)
    in_water = np.hypot(depth, reach - height * low)
    return ray / np.linalg.norm(ray, axis=-1, keepdims=True), in_air, in_water


def seen(
    point: Array, normal: Array, height_mm: float, n: float, ranging: str, baseline_mm: float = 1e-3
) -> tuple[Array, Array]:
    """What a camera at the origin reports of points (..., 3) under water: the ray's x and y (...,
    2), and the depth.

    Two views `baseline_mm` apart give a disparity, and with it the depth; a light field is the mean
    of the disparities along both picture axes. The displacement is centred on the lens, whose
    picture the depth belongs to.
    """
    ray, in_air, in_water = ray_to(point, np.zeros(3), normal, height_mm, n)
    xy = ray[..., :2] / ray[..., 2:]
    if ranging == "time_of_flight":
        return xy, (in_air + n * in_water) * ray[..., 2]
    disparity = []
    for axis in range(2 if ranging == "light_field" else 1):
        two = []
        for side in (-0.5, 0.5):
            lens = np.zeros(3)
            lens[axis] = side * baseline_mm
            view = ray_to(point, lens, normal, height_mm, n)[0]
            two.append(view[..., axis] / view[..., 2])
        disparity.append((two[0] - two[1]) / baseline_mm)
    return xy, 1.0 / np.mean(disparity, axis=0)


def true_points(water: Water, rays: ArrayLike, depth: ArrayLike) -> Array:
    """Positions (..., 3) mm of points at apparent depths (...) mm on rays (..., 2), x and y of
    (x, y, 1), by the quadratic equation of `Water.law`.
    """
    xy, z = np.asarray(rays, float), np.asarray(depth, float)
    law = water.law(xy)
    excess = law[..., 3] * z - 1.0
    b = law[..., 1] - law[..., 2] * z
    wet = np.maximum(excess, 0.0)
    below = 2.0 * wet / (b + np.sqrt(b * b + 4.0 * law[..., 0] * wet))
    seeming = np.concatenate([xy, np.ones((*xy.shape[:-1], 1))], axis=-1) * z[..., None]
    down = law[..., 4:7] + below[..., None] * law[..., 7:]
    return np.where((excess > 0)[..., None], down, seeming)
