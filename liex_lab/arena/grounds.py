"""Flat grounds of an empty scene: every large plane that faces the camera, and its patches.

A floor need not be the largest plane in view: an arena may stand on a table, a platform in an
arena. Candidates grow from small windows of the picture that are flat (region growing, Besl and
Jain 1988): each window's plane, in inverse depth as in `floor`, is fitted by least squares; the one
that the most pixels lie on is fitted to them again and takes them away, and so on while any is
left. The connected patches of each plane are the grounds. Which of them is the floor, what moves
tells (`foreground.standing`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from liex_lab.arena.floor import Floor, near_plane
from liex_lab.optics.camera import Camera

Array = NDArray[np.float64]

_MAX_TILT_DEG = 60.0
_WINDOWS = 14  # along the picture's longer side, each overlapping its neighbours by half
_READ_SHARE = 0.5  # of a window's pixels that must be readable
_FLAT_SHARE = 0.7  # and of those, that must lie on its plane
_FLAT_MM = 8.0
_SIDE = 160  # pixels a side that are looked at
_MAX_PLANES = 8
_ROUNDS = 4
_BEYOND_PX = 6  # so far from a patch its surroundings are looked at
_RISE_MM = 20.0  # by which a wall rises above its floor at least


@dataclass(frozen=True)
class Ground:
    """A connected flat patch of an empty scene that faces the camera.

    Attributes:
        floor: its plane.
        patch: (H, W) bool, where it lies in the picture.
        enclosed: share of its outline, 0 to 1, from which something rises.
    """

    floor: Floor
    patch: NDArray[np.bool_]
    enclosed: float

    def region(self, reach_px: float) -> NDArray[np.bool_]:
        """The ground's convex hull, and what lies around it.

        Args:
            reach_px: how far around it, px.

        Returns:
            (H, W) bool.
        """
        import cv2

        region = np.zeros(self.patch.shape, np.uint8)
        points = cv2.findNonZero(self.patch.astype(np.uint8))
        cv2.fillConvexPoly(region, cv2.convexHull(points), 1)
        away = cv2.distanceTransform(1 - region, cv2.DIST_L2, 5)
        return np.asarray(away <= reach_px)


def flat_grounds(background: NDArray[np.float32], camera: Camera, least_mm2: float) -> list[Ground]:
    """The flat patches of an empty scene, those of the plane with the most pixels first.

    Args:
        background: (H, W) float32 mm, 0 where unread.
        camera: that took it, free of lens distortion.
        least_mm2: smaller patches are left out, mm^2.

    Returns:
        The grounds, none where nothing is flat.
    """
    step = max(1, max(background.shape) // _SIDE)
    rows, columns = np.mgrid[0 : background.shape[0] : step, 0 : background.shape[1] : step]
    depth = background[::step, ::step].astype(float)
    middle = np.array([background.shape[1] / 2.0, background.shape[0] / 2.0])
    points = np.stack(
        [(columns - middle[0]) / middle[0], (rows - middle[1]) / middle[0], np.ones(rows.shape)],
        axis=-1,
    )
    read = depth > 0
    seeds = _seeds(points, depth, camera.fx / middle[0])
    left = read.copy()
    mm2_per_px = step * step / (camera.fx * camera.fy)
    grounds: list[Ground] = []
    for _ in range(_MAX_PLANES):
        if not len(seeds) or not left.any():
            break
        some = points[left]
        at = depth[left]
        stride = max(1, len(at) // 4000)
        votes = _on(some[::stride] @ seeds.T, at[::stride, None], _FLAT_MM).sum(axis=0)
        best = int(np.argmax(votes))
        if votes[best] * stride * float(np.median(at)) ** 2 * mm2_per_px < least_mm2:
            break
        plane = seeds[best]
        for _ in range(_ROUNDS):
            near = _on(some @ plane, at, _FLAT_MM)
            if near.sum() >= 3:
                plane = _fit(some[near], at[near])
        grounds += _patches(background, _in_pixels(plane, middle, camera), camera, least_mm2)
        taken = left & _on(points @ plane, depth, 2.0 * _FLAT_MM)
        left &= ~taken
        seeds = np.delete(seeds, best, axis=0)
        seeds = seeds[~_same(seeds, plane, points[taken])]
    return grounds


def _seeds(points: Array, depth: Array, focal: float) -> Array:
    """The planes (n, 3), 1 / depth = points . plane, of the picture's flat windows."""
    side = max(4, max(depth.shape) // _WINDOWS)
    found = []
    for row in range(0, max(1, depth.shape[0] - side + 1), side // 2):
        for column in range(0, max(1, depth.shape[1] - side + 1), side // 2):
            window = (slice(row, row + side), slice(column, column + side))
            read = depth[window] > 0
            if read.mean() < _READ_SHARE or read.sum() < 12:
                continue
            some = points[window][read]
            at = depth[window][read]
            kept = np.abs(at - np.median(at)) < 4.0 * np.median(np.abs(at - np.median(at))) + 1.0
            plane = _fit(some[kept], at[kept])
            if _on(some @ plane, at, _FLAT_MM).mean() >= _FLAT_SHARE and plane[2] > 0:
                found.append(plane)
    planes = np.array(found).reshape(-1, 3)
    steepness = np.hypot(planes[:, 0], planes[:, 1]) * focal / np.maximum(planes[:, 2], 1e-12)
    return np.asarray(planes[steepness < np.tan(np.radians(_MAX_TILT_DEG))])


def _fit(points: Array, depth: Array) -> Array:
    """The plane (3,) nearest to points (n, 3) at depth (n,) mm, by least squares."""
    return np.asarray(
        np.linalg.lstsq(points.T @ points, points.T @ (1.0 / depth), rcond=None)[0], float
    )


def _on(inverse: Array, depth: Array, within_mm: float) -> NDArray[np.bool_]:
    """Whether points at `depth` lie within so many mm of the plane that has 1 / z = inverse."""
    return np.asarray((depth > 0) & (np.abs(depth * inverse - 1.0) < within_mm * inverse))


def _same(planes: Array, plane: Array, points: Array) -> NDArray[np.bool_]:
    """Which of the planes (n, 3) differ from one by less than a floor's flatness over points."""
    if not len(points):
        return np.zeros(len(planes), np.bool_)
    some = points[:: max(1, len(points) // 200)]
    depth = 1.0 / np.maximum(some @ plane, 1e-9)
    return np.asarray(_on(some @ planes.T, depth[:, None], _FLAT_MM).mean(axis=0) > 0.9)


def _in_pixels(plane: Array, middle: Array, camera: Camera) -> Floor:
    a, b, c = plane / [middle[0], middle[0], 1.0]
    return Floor.from_inverse_depth(np.array([a, b, c - a * middle[0] - b * middle[1]]), camera)


def _patches(
    background: NDArray[np.float32], floor: Floor, camera: Camera, least_mm2: float
) -> list[Ground]:
    """The connected parts of the background on a plane, largest first, each with a plane of its
    own.

    Pixels without a reading between pixels of the plane count as on it: glossy floors have holes.
    """
    import cv2

    height, width = background.shape
    bare = floor.depth(width, height)
    flat = near_plane(background, bare)
    holes = cv2.morphologyEx(flat.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((7, 7), np.uint8))
    whole = flat | ((holes > 0) & (background == 0))
    opened = cv2.morphologyEx(whole.astype(np.uint8), cv2.MORPH_OPEN, np.ones((5, 5), np.uint8))
    n, labels, stats, _ = cv2.connectedComponentsWithStats(opened)
    found = []
    for k in sorted(range(1, n), key=lambda k: -int(stats[k, cv2.CC_STAT_AREA]))[:_MAX_PLANES]:
        patch = (labels == k) & flat
        area = float((background[patch].astype(float) ** 2).sum()) / (camera.fx * camera.fy)
        if area < least_mm2:
            break
        own = _refitted(background, patch, floor, camera)
        found.append(Ground(own, labels == k, _enclosed(background, labels == k, own, camera)))
    return found


def _refitted(
    background: NDArray[np.float32], patch: NDArray[np.bool_], floor: Floor, camera: Camera
) -> Floor:
    """The plane of one patch's own pixels, from the whole plane's."""
    rows, columns = np.nonzero(patch)
    depth = background[rows, columns].astype(float)
    middle = np.array([background.shape[1] / 2.0, background.shape[0] / 2.0])
    points = np.stack(
        [(columns - middle[0]) / middle[0], (rows - middle[1]) / middle[0], np.ones(len(rows))],
        axis=1,
    )
    a, b, c = floor.inverse_depth
    plane = np.array([a * middle[0], b * middle[0], c + a * middle[0] + b * middle[1]])
    for _ in range(_ROUNDS):
        near = _on(points @ plane, depth, _FLAT_MM)
        if near.sum() < 50:
            return floor
        plane = _fit(points[near], depth[near])
    return _in_pixels(plane, middle, camera)


def _enclosed(
    background: NDArray[np.float32], patch: NDArray[np.bool_], floor: Floor, camera: Camera
) -> float:
    """The share of a patch's outline just beyond which something rises above the floor.

    What the picture's border cuts is not enclosed.
    """
    import cv2

    height, width = background.shape
    hull = np.zeros(patch.shape, np.uint8)
    outline = cv2.convexHull(cv2.findNonZero(patch.astype(np.uint8)))
    cv2.fillConvexPoly(hull, outline, 1)
    reach = 2 * max(_BEYOND_PX, width // 40) + 1
    a, b, c = floor.inverse_depth
    v, u = np.mgrid[0:height, 0:width]
    above = floor.distance_mm * (1.0 - background * (a * u + b * v + c))
    high = np.where((background > 0) & (hull == 0), above, -1e6).astype(np.float32)
    highest = cv2.dilate(high, np.ones((reach, reach), np.uint8))
    ring = (cv2.dilate(hull, np.ones((3, 3), np.uint8)) > 0) & (hull == 0)
    inside = hull.astype(bool)
    n_cut = int(inside[0].sum() + inside[-1].sum() + inside[:, 0].sum() + inside[:, -1].sum())
    return float((highest[ring] > _RISE_MM).sum()) / max(1, int(ring.sum()) + n_cut)
