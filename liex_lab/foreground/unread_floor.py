"""Floor that is never read: the mirror image of the camera in a glossy floor, dark patches.

Where the floor is unread, only what comes before it is read; so what stood there longest would be
taken for the background (the "sleeping person" problem once more). The floor's plane is the
background of such a place instead: one that is unread most of the time, that the floor surrounds,
and whose readings, if any, lie above the floor.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Mask = NDArray[np.bool_]

_READ = 0.5  # of the frames: what is read less often is a hole
_AROUND = 0.7  # of what surrounds a hole is floor
_FLAT_MM = 15.0  # this near to the plane


def unread_floor(
    sample: NDArray[np.float32],
    background: NDArray[np.float32],
    bare: NDArray[np.float32],
    on_floor: Mask,
    min_height_mm: float,
    least_px: float,
) -> Mask:
    """Where the floor is unread and something else was taken for it.

    Args:
        sample: (n, H, W) float32 mm, frames spread over a recording, 0 where unread.
        background: (H, W) float32 mm, the farthest mode of each pixel, 0 where there is none.
        bare: (H, W) float32 mm, depth of the floor's plane.
        on_floor: (H, W) bool, the floor with what stands on it.
        min_height_mm: a background that stands out by less is the floor.
        least_px: pixels of a hole at least; smaller ones hide no animal.

    Returns:
        (H, W) bool: pixels whose background is not the floor but should be.
    """
    import cv2

    dark = on_floor & ((sample > 0).mean(axis=0) < _READ)
    raised = dark & (background > 0) & (bare - background > min_height_mm)
    found = np.zeros(dark.shape, np.bool_)
    if not raised.any():
        return found
    n, labels, stats, _ = cv2.connectedComponentsWithStats(dark.astype(np.uint8))
    flat = (background > 0) & (np.abs(background - bare) < _FLAT_MM)
    ring = np.ones((7, 7), np.uint8)
    for k in range(1, n):
        hole = labels == k
        if stats[k, cv2.CC_STAT_AREA] < least_px or not (hole & raised).any():
            continue
        around = (cv2.dilate(hole.astype(np.uint8), ring) > 0) & ~dark & (background > 0)
        if around.any() and flat[around].mean() > _AROUND:
            found |= hole & raised
    return found
