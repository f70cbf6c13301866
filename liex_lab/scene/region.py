"""Regions of an image stated in a plan: polygon, rectangle or circle, in pixels or millimetres.

Millimetres are measured on the floor, in the arena's frame: its origin is below the camera, x
points along the image's rows and y up the image. Corners in millimetres are projected from the
floor into the image. Overlapping arenas are refused.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from liex_lab.errors import PlanError
from liex_lab.optics.camera import Camera
from liex_lab.plan.sections import Region
from liex_lab.recordings.frame import region_mask
from liex_lab.scene.floor import Floor
from liex_lab.scene.outline import circle_points
from liex_lab.scene.scene import Mask

Array = NDArray[np.float64]
Corners = tuple[tuple[float, float], ...]


def crossing_sides(corners: Array) -> tuple[int, int] | None:
    """The first two sides of a polygon that cross inside both, counted from 0.

    Two segments cross if each separates the ends of the other.

    Args:
        corners: (n, 2), in order; side k connects corner k to the next.

    Returns:
        Their numbers, the smaller first; None if no sides cross.
    """
    ends = np.roll(corners, -1, axis=0)
    n = len(corners)
    for i in range(n - 2):
        others = slice(i + 2, n - (i == 0))
        a, b, c, d = corners[i], ends[i], corners[others], ends[others]
        crossing = (_side(a, b, c) * _side(a, b, d) < 0) & (_side(c, d, a) * _side(c, d, b) < 0)
        if crossing.any():
            return i, i + 2 + int(np.argmax(crossing))
    return None


def _side(p: Array, q: Array, r: Array) -> Array:
    """Twice the signed area of triangles p, q, r, any of them (..., 2)."""
    return np.asarray(
        (q[..., 0] - p[..., 0]) * (r[..., 1] - p[..., 1])
        - (q[..., 1] - p[..., 1]) * (r[..., 0] - p[..., 0])
    )


_N_CORNERS = 64  # of a circle
_DEEPEST_SHARE = 1e-3  # least depth of a corner, as a share of the floor's distance


def region_corners_px(
    region: Region, camera: Camera | None = None, floor: Floor | None = None
) -> Corners:
    """The corners of a region in the image.

    Args:
        region: as stated in a plan.
        camera: the ideal pinhole camera of the recording; needed for millimetres only.
        floor: likewise.

    Returns:
        (u, v) pixels.

    Raises:
        PlanError: sides of its polygon cross, or a corner in millimetres lies behind the camera.
    """
    corners = _drawn(region)
    if (crossing := crossing_sides(corners)) is not None:
        raise PlanError(
            f"arena.region: sides {crossing[0] + 1} and {crossing[1] + 1} of its polygon cross; "
            "list the corners in order around the arena"
        )
    if region.unit == "px":
        return tuple((float(u), float(v)) for u, v in corners)
    if camera is None or floor is None:
        raise PlanError("a region in mm needs a floor; state it in pixels, or state arena.floor")
    on_floor = np.column_stack([corners, np.zeros(len(corners))])
    points = floor.T_arena_camera.inverse() @ on_floor
    if (points[:, 2] < _DEEPEST_SHARE * floor.distance_mm).any():
        raise PlanError(
            "arena.region has corners that lie behind the camera; millimetres are measured from "
            "the point of the floor below the camera"
        )
    return tuple((float(u), float(v)) for u, v in camera.project(points))


def _drawn(region: Region) -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
    """The corners (n, 2) in the region's own unit."""
    if region.circle is not None:
        return np.array(region.circle.centre) + region.circle.radius * circle_points(_N_CORNERS)
    if region.rectangle is not None:
        (x0, y0), (x1, y1) = region.rectangle
        return np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]], float)
    return np.array(region.polygon, float).reshape(-1, 2)


def masks_apart(regions: Mapping[str, Corners], width: int, height: int) -> dict[str, Mask]:
    """The disjoint pixel masks of multiple arenas.

    Args:
        regions: (u, v) corners, pixels, by the arena's name.
        width: of the image, px.
        height: of the image, px.

    Returns:
        (height, width) bool by the arena's name.

    Raises:
        PlanError: a region is no polygon in the image, or two overlap.
    """
    masks = {}
    for name, corners in regions.items():
        try:
            masks[name] = region_mask(corners, width, height)
        except PlanError as error:
            raise PlanError(f"the arena {name}: {error}") from None
    for one, other in combinations(masks, 2):
        if n := int((masks[one] & masks[other]).sum()):
            raise PlanError(
                f"the arenas {one} and {other} overlap in {n} pixels, and an animal there would be "
                "in both; move their regions apart"
            )
    return masks
