"""Ways through a virtual place: an animal goes on, turns, rises and sinks, and stays within the picture."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from liex_lab.recordings.stage import Stage

Array = NDArray[np.float64]


def wander(
    rng: np.random.Generator, stage: Stage, length: float, speed: Array, turning: Array, pitch: Array,
    water: tuple[float, float], step_s: float,
) -> tuple[Array, Array]:  # fmt: skip
    """Positions (n, 3) mm of the body's middle between two heights of the water, and headings (n,) rad.

    The fish turns away from walls and from the border of the picture; where there is no way on it stays.
    """
    n = len(speed)
    centre = stage.camera.unproject([(stage.camera.width - 1) / 2, (stage.camera.height - 1) / 2], 1.0)
    ray = stage.T_arena_camera.rotation @ centre
    low, high = water
    z = rng.uniform(low, high)
    home = (stage.T_arena_camera.translation + ray * (stage.T_arena_camera.translation[2] - z) / -ray[2])[:2]
    margin = 0.6 * length
    position, headings = np.empty((n, 3)), np.empty(n)
    xy, way = home + rng.normal(0.0, 0.1 * length, 2), rng.uniform(-np.pi, np.pi)
    for i in range(n):
        back = np.arctan2(home[1] - xy[1], home[0] - xy[0])
        away = (back - way + np.pi) % (2 * np.pi) - np.pi
        close = np.clip(1.0 - (stage.freedom(xy, z) - margin) / (0.8 * length), 0.0, 1.0)
        way += (turning[i] + 8.0 * close * np.clip(away, -1.0, 1.0)) * step_s
        run = speed[i] * length * step_s
        step = run * np.cos(pitch[i]) * np.array([np.cos(way), np.sin(way)])
        free = stage.freedom(xy + step, z)
        if free > margin or free > stage.freedom(xy, z):
            xy = xy + step
        z = float(np.clip(z + run * np.sin(pitch[i]), low, high))
        position[i], headings[i] = [*xy, z], way
    return position, headings


def smoothed(rows: Array, frames: float) -> Array:
    """Columns of (n, k) passed through a bell of that many frames, ends held."""
    reach = int(4 * frames)
    bell = np.exp(-0.5 * (np.arange(-reach, reach + 1) / frames) ** 2)
    padded = np.pad(rows, ((reach, reach), (0, 0)), mode="edge")
    return np.stack([np.convolve(column, bell / bell.sum(), mode="valid") for column in padded.T], axis=-1)
