"""How good a sensor's readings are in a recording, measured where nothing moves and at the animal.

All of it over the sample from which the scene was learned; see `optics.sensor_card`.

- noise: a pixel's standard deviation over time about its background, by distance from the camera;
- step: the usual distance between neighbouring values of depth;
- seam: how far from the animal's outline readings are missing, beyond those missing anyway;
- mixed: at jumps of the still scene's depth, how often a reading lies between both sides.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

from liex_lab.optics.sensor_card import SensorCard

if TYPE_CHECKING:
    from liex_lab.foreground.still_scene import StillScene

Depths = NDArray[np.float32]

_N_PIXELS = 20_000  # looked at for noise and edges, spread over the picture
_N_FRAMES = 12  # looked at for the seam around the animal
_LEAST_READ = 0.5  # of the frames read a pixel that tells noise
_LEAST = 200  # pixels, readings or seam pixels below which nothing is told
_SAME_MM = 6.0  # or of the depth: readings this near to the background are of it
_SAME_SHARE = 0.012
_JUMP_MM = 60.0  # of depth within two pixels: an edge
_MIDDLE = (0.25, 0.75)  # of the jump: what lies there is of neither side
_REACH_PX = 4  # from the outline: the seam is looked for
_ROUND_MM = 0.05  # a finer step is none


def read_sensor(scene: StillScene, sample: Depths) -> SensorCard:
    """The card of the sensor that took a sample.

    Args:
        scene: the scene that was learned from it, with its animal's area.
        sample: (n, H, W) float32 mm, frames at the scene's stride, 0 where unread.
    """
    return SensorCard(
        _noise(scene.background, sample),
        _step(sample),
        _seam(scene, sample),
        _mixed(scene.background, sample),
    )


def _noise(background: Depths, sample: Depths) -> tuple[tuple[float, float], ...]:
    """Noise by depth: of the nearest, the middle and the farthest third of the still pixels, one of
    all where these are of one depth to a tenth.
    """
    known = np.flatnonzero(background > 0)
    known = known[:: max(1, len(known) // _N_PIXELS)]
    depth = background.ravel()[known]
    off = sample.reshape(len(sample), -1)[:, known] - depth
    still = np.abs(off) < np.maximum(_SAME_MM, _SAME_SHARE * depth)
    n = still.sum(axis=0)
    steady = n >= max(3, _LEAST_READ * len(sample))
    if steady.sum() < _LEAST:
        return ()
    off, still, n, depth = off[:, steady], still[:, steady], n[steady], depth[steady]
    mean = np.where(still, off, 0.0).sum(axis=0) / n
    sd = np.sqrt(np.where(still, (off - mean) ** 2, 0.0).sum(axis=0) / (n - 1))
    order = np.argsort(depth, kind="stable")
    low, high = depth[order[len(order) // 20]], depth[order[-1 - len(order) // 20]]
    parts = [order] if high < 1.1 * low else np.array_split(order, 3)
    return tuple(
        (round(float(np.median(depth[part])), 1), round(float(np.median(sd[part])), 2))
        for part in parts
    )


def _step(sample: Depths) -> float | None:
    """The usual distance between neighbouring values of depth near the median one."""
    read = sample[:: max(1, len(sample) // 8)]
    read = read[read > 0]
    if len(read) < _LEAST:
        return None
    middle = float(np.median(read))
    values = np.unique(read[np.abs(read - middle) < 0.03 * middle])
    if len(values) < 3:
        return None
    gap = float(np.median(np.diff(values)))
    return round(gap, 3) if gap > _ROUND_MM else None


def _seam(scene: StillScene, sample: Depths) -> float | None:
    """How many pixels of the picture around the animal are unread, beyond those unread anyway."""
    rows = np.linspace(0, len(sample) - 1, min(_N_FRAMES, len(sample))).astype(int)
    shown = sample[rows]
    crops = scene.extract(shown, 1.0)
    unread = np.zeros(_REACH_PX)
    seen = np.zeros(_REACH_PX)
    for i, own in zip(np.flatnonzero(crops.found), scene.places(crops), strict=True):
        v, u, height, width = cv2.boundingRect(own.T.astype(np.uint8))
        cut = (
            slice(max(0, v - _REACH_PX), v + height + _REACH_PX),
            slice(max(0, u - _REACH_PX), u + width + _REACH_PX),
        )
        around = cv2.distanceTransform((~own[cut]).astype(np.uint8), cv2.DIST_C, 3)
        for k in range(_REACH_PX):
            ring = (around == k + 1) & scene.on_floor[cut]
            unread[k] += (shown[i][cut][ring] == 0).sum()
            seen[k] += ring.sum()
    if seen.min() < _LEAST:
        return None
    anyway = float((shown[:, scene.on_floor] == 0).mean())
    return round(scene.stride * float(np.clip(unread / seen - anyway, 0.0, 1.0).sum()), 2)


def _mixed(background: Depths, sample: Depths) -> float | None:
    """Of the readings at edges of the still scene, the share that lies between both sides."""
    left, right = background[:, :-2], background[:, 2:]
    edge = (left > 0) & (right > 0) & (np.abs(left - right) > _JUMP_MM)
    rows, columns = np.nonzero(edge)
    chosen = slice(None, None, max(1, len(rows) // _N_PIXELS))
    rows, columns = rows[chosen], columns[chosen]
    reading = sample[:, rows, columns + 1]
    at = (reading - left[rows, columns]) / (right - left)[rows, columns]
    read = reading > 0
    if read.sum() < _LEAST:
        return None
    between = read & (at > _MIDDLE[0]) & (at < _MIDDLE[1])
    return round(float(between.sum() / read.sum()), 3)
