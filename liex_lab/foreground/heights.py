"""Heights above the floor of what stands out in a picture."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from liex_lab.arena.floor import Floor

Depths = NDArray[np.float32]


def heights_before(depth: Depths, limit: Depths, floor: Floor) -> Depths:
    """Heights of what is nearer than the background's limit.

    Args:
        depth: (H, W) float32 mm, 0 where unread.
        limit: (H, W) float32 mm; a reading below it is in front of the background.
        floor: the floor in the pixels of the picture.

    Returns:
        (H, W) float32 mm above the floor's plane, 0 where nothing stands out.
    """
    a, b, c = floor.inverse_depth
    rows, columns = np.nonzero((depth > 0) & (depth < limit))
    height = np.zeros(depth.shape, np.float32)
    inverse = a * columns + b * rows + c
    above = floor.distance_mm * (1.0 - depth[rows, columns] * inverse)
    height[rows, columns] = np.maximum(above, 0.0)
    return height
