"""Floor plane of a depth image by RANSAC on inverse depth, and the arena frame defined by it.

A plane in a pinhole image has 1 / z = a u + b v + c, linear in the pixel (u, v). `find_floor` tries
600 planes through three pixels each (RANSAC, Fischler and Bolles 1981), on few voters first and the
best 20 on more, and fits the winner to its inliers (8 mm) by least squares in three rounds.
`floor_region` marks the floor in the image.

Arena frame: z up from the floor, origin at the foot of the camera's perpendicular, x along the
camera's x.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from liex_lab.arrays import Array, Mask, NDArray
from liex_lab.errors import EstimationError
from liex_lab.geometry import SE3
from liex_lab.optics.camera import Camera

Depths = NDArray[np.float32]

# pixels that vote for a plane, and planes tried
_N_VOTERS = 6000
_INLIER_MM = 8.0  # a floor is flat to about this much, depth noise included
_MAX_TILT_DEG = 60.0
# background this near to the plane is floor: flatness, noise and lens errors together
_FLAT_MM = 15.0


@dataclass(frozen=True)
class Floor:
    """The floor plane normal . p = distance_mm in the camera frame.

    Attributes:
        normal: (3,) unit normal, pointing away from the lens.
        distance_mm: of the plane from the camera, mm.
        inverse_depth: (3,) a, b, c of 1 / z = a u + b v + c, 1/mm per pixel and 1/mm.
    """

    normal: Array
    distance_mm: float
    inverse_depth: Array

    @staticmethod
    def from_inverse_depth(coefficients: Array, camera: Camera) -> Floor:
        """The plane with 1 / z = a u + b v + c.

        Args:
            coefficients: (3,) a, b, c, 1/mm per pixel and 1/mm.
            camera: of these pixels.
        """
        a, b, c = coefficients
        toward = np.array([a * camera.fx, b * camera.fy, c + a * camera.cx + b * camera.cy])
        length = float(np.linalg.norm(toward))
        return Floor(toward / length, 1.0 / length, np.asarray(coefficients, float))

    @staticmethod
    def from_plane(normal: Array, distance_mm: float, camera: Camera) -> Floor:
        """The plane normal . p = distance_mm in the camera frame.

        Args:
            normal: (3,) pointing away from the lens, of any length.
            distance_mm: from the camera along the unit normal, mm.
            camera: of the pixels of `inverse_depth`.
        """
        n = np.asarray(normal, float) / np.linalg.norm(normal)
        a = n[0] / camera.fx / distance_mm
        b = n[1] / camera.fy / distance_mm
        return Floor(
            n,
            float(distance_mm),
            np.array([a, b, n[2] / distance_mm - a * camera.cx - b * camera.cy]),
        )

    @cached_property
    def T_arena_camera(self) -> SE3:
        """Transform from the camera frame into the arena frame.

        Arena frame: z up from the floor, origin at the foot of the camera's perpendicular, x along
        the camera's.
        """
        up = -self.normal
        x = np.array([1.0, 0.0, 0.0]) - up[0] * up
        x = x / np.linalg.norm(x)
        return SE3(np.stack([x, np.cross(up, x), up]), np.array([0.0, 0.0, self.distance_mm]))

    @property
    def tilt_rad(self) -> float:
        """Angle between the optical axis and the floor's perpendicular, rad."""
        return math.acos(min(1.0, float(self.normal[2])))

    def lens_distance_mm(self, lift_mm: Array | None = None) -> float:
        """Distance of the plane from the real lens, mm; `lift_mm` as in `unusual`."""
        return self.distance_mm - (0.0 if lift_mm is None else float(lift_mm @ self.normal))

    def unusual(self, lift_mm: Array | None = None) -> list[str]:
        """How the camera's position differs from those in the training data, a sentence each.

        Args:
            lift_mm: (3,) from the real lens to the camera's origin, mm, of the ideal camera above
                water; None without water.
        """
        distance = self.lens_distance_mm(lift_mm)
        differences = (  # from the cameras in the training data
            (
                not 150.0 <= distance <= 3000.0,
                f"the floor lies {distance:.0f} mm from the camera, outside the usual 150 to "
                "3000 mm; check the unit and the camera's height",
            ),
            (
                self.tilt_rad > math.radians(15.0),
                f"the camera is tilted by {math.degrees(self.tilt_rad):.0f} degrees from the "
                "vertical, and poses are learned up to 10; point it straight down",
            ),
        )
        return [sentence for differs, sentence in differences if differs]

    def inverse_at(self, u: NDArray[Any], v: NDArray[Any]) -> Array:
        """1 / depth of the plane in pixels (u, v), 1/mm."""
        a, b, c = self.inverse_depth
        return np.asarray(a * u + b * v + c)

    def heights(self, u: NDArray[Any], v: NDArray[Any], depth: NDArray[Any]) -> Array:
        """Heights above the plane, mm, of readings `depth` mm in pixels (u, v)."""
        return np.asarray(self.distance_mm * (1.0 - depth * self.inverse_at(u, v)))

    def for_camera(self, camera: Camera) -> Floor:
        """The same plane in the pixels of another camera at the same position."""
        return Floor.from_plane(self.normal, self.distance_mm, camera)

    def depth(self, width: int, height: int) -> NDArray[np.float32]:
        """Depth (height, width) float32 mm of the bare floor in every pixel; 0 above
        the horizon.
        """
        inverse = self.inverse_at(np.arange(width)[None, :], np.arange(height)[:, None])
        return np.where(inverse > 1e-6, 1.0 / np.maximum(inverse, 1e-6), 0.0).astype(np.float32)


def find_floor(background: NDArray[np.float32], camera: Camera, seed: int = 0) -> Floor:
    """The largest plane of an empty scene, by RANSAC on inverse depth and least squares.

    Args:
        background: (H, W) float32 mm, 0 where unread.
        camera: free of lens distortion.
        seed: of the random pixels.

    Raises:
        EstimationError: less than a fifth of the readable pixels lie on one plane that faces the
            camera (tilted by at most 60 degrees), fewer than 500 pixels are readable, or the
            camera's distortion was not corrected.
    """
    if camera.distortion is not None:
        raise EstimationError(
            "a floor is found in undistorted images only, but this camera's distortion was not "
            "corrected; pass the recording through liex_lab.recordings.rectify.rectified"
        )
    rows, columns = np.nonzero(background > 0)
    if len(rows) < 500:
        raise EstimationError(
            f"a floor needs at least 500 readable background pixels, got {len(rows)}; check the "
            "depth unit and range"
        )
    rng = np.random.default_rng(seed)
    # the plane is fitted to these pixels
    chosen = rng.choice(len(rows), min(60_000, len(rows)), replace=False)
    rows, columns = rows[chosen], columns[chosen]
    depth = background[rows, columns].astype(float)
    points, middle = _centred(rows, columns, background.shape)
    plane = _largest_plane(points[:_N_VOTERS], depth[:_N_VOTERS], camera.fx / middle[0], rng)
    plane, share = _refit(points, depth, plane, 3)  # on many pixels, not only on the voters
    floor = _in_pixels(plane, middle, camera)
    tilt = np.degrees(np.arccos(np.clip(floor.normal[2], -1, 1)))
    # the least share of the readable pixels, and the most tilt
    if share < 0.2 or tilt > _MAX_TILT_DEG:
        raise EstimationError(
            f"no floor was found: the largest plane contains {share:.0%} of the readable pixels "
            f"and is tilted by {tilt:.0f} degrees; the camera should point down at a floor"
        )
    return floor


def _largest_plane(points: Array, depth: Array, focal: float, rng: np.random.Generator) -> Array:
    """The plane (3,), 1 / depth = points . plane, with the most inliers among the points (n, 3),
    out of many planes through three points each.

    Planes that do not face the camera (walls) are discarded. All are tried on some points, the best
    few on more. focal: in the units of the points.
    """
    three = rng.integers(0, len(depth), (600, 3))  # planes tried
    p = points[three]
    w = 1.0 / depth[three]
    ends = np.stack([p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]], axis=1)
    rise = np.stack([w[:, 1] - w[:, 0], w[:, 2] - w[:, 0]], axis=1)
    area = ends[:, 0, 0] * ends[:, 1, 1] - ends[:, 0, 1] * ends[:, 1, 0]
    area = np.where(np.abs(area) > 1e-4, area, np.nan)  # three points in a line
    a = (rise[:, 0] * ends[:, 1, 1] - rise[:, 1] * ends[:, 0, 1]) / area
    b = (ends[:, 0, 0] * rise[:, 1] - ends[:, 1, 0] * rise[:, 0]) / area
    planes = np.stack([a, b, w[:, 0] - a * p[:, 0, 0] - b * p[:, 0, 1]], axis=1)
    planes = _facing(planes, focal)
    for n_kept, n_voters in ((20, _N_VOTERS // 6), (1, _N_VOTERS)):
        votes = _on(points[:n_voters] @ planes.T, depth[:n_voters, None]).sum(axis=0)
        planes = planes[np.argsort(-votes, kind="stable")[:n_kept]]
    return planes[0] if len(planes) else np.array([0.0, 0.0, 1.0 / float(np.median(depth))])


def _facing(planes: Array, focal: float) -> Array:
    """Those of the planes (n, 3) that face the camera; focal: in the units of their points."""
    rise = np.hypot(planes[:, 0], planes[:, 1]) * focal
    steepness = rise / np.where(planes[:, 2] > 0, planes[:, 2], np.nan)  # tangent of the tilt
    return np.asarray(planes[steepness < np.tan(np.radians(_MAX_TILT_DEG))])


def _centred(
    rows: NDArray[np.int64], columns: NDArray[np.int64], shape: tuple[int, ...]
) -> tuple[Array, Array]:
    """Pixels as points (..., 3) for planes, and the image's middle (2,) px.

    They are relative to the middle, in units of its size, for numerical precision.
    """
    middle = np.array([shape[1] / 2.0, shape[0] / 2.0])
    x, y = (columns - middle[0]) / middle[0], (rows - middle[1]) / middle[0]
    return np.stack([x, y, np.ones(rows.shape)], axis=-1), middle


def _in_pixels(plane: Array, middle: Array, camera: Camera) -> Floor:
    a, b, c = plane / [middle[0], middle[0], 1.0]
    return Floor.from_inverse_depth(np.array([a, b, c - a * middle[0] - b * middle[1]]), camera)


def _fit(points: Array, depth: Array) -> Array:
    """The plane (3,) nearest to points (n, 3) at depth (n,) mm, by least squares."""
    fitted = np.linalg.lstsq(points.T @ points, points.T @ (1.0 / depth), rcond=None)[0]
    return np.asarray(fitted, float)


def _on(inverse: Array, depth: Array, within_mm: float = _INLIER_MM) -> Mask:
    """Whether points at `depth` lie within `within_mm` of the plane with 1 / z = inverse."""
    return np.asarray((depth > 0) & (np.abs(depth * inverse - 1.0) < within_mm * inverse))


def _refit(
    points: Array, depth: Array, plane: Array, rounds: int, least: int = 3
) -> tuple[Array, float]:
    """The plane refitted to the points near it, and their share; 0 if fewer than `least` are."""
    share = 0.0
    for _ in range(rounds):
        near = _on(points @ plane, depth)
        if near.sum() < least:
            return plane, 0.0
        plane, share = _fit(points[near], depth[near]), float(near.mean())
    return plane, share


def fit_plane(background: NDArray[np.float32], where: Mask, camera: Camera) -> Floor:
    """The plane of some pixels, by least squares on inverse depth.

    Args:
        background: (H, W) float32 mm.
        where: (H, W) bool, readable pixels, at least three that are not collinear.
        camera: free of lens distortion.
    """
    rows, columns = np.nonzero(where)
    points, middle = _centred(rows, columns, background.shape)
    return _in_pixels(_fit(points, background[where].astype(float)), middle, camera)


def floor_region(background: NDArray[np.float32], bare: NDArray[np.float32]) -> Mask:
    """The convex hull of the largest connected part of the background on the plane.

    Floors of arenas and tanks are convex; the hull closes holes left by objects. Without a
    connected part, all pixels near the plane are returned.

    Args:
        background: (H, W) float32 mm, 0 where unread.
        bare: (H, W) float32 mm, depth of the bare floor, see `Floor.depth`.

    Returns:
        (H, W) bool.
    """
    patch = floor_patch(background, bare)
    return convex_hull(patch) if patch.any() else near_plane(background, bare)


def floor_patch(background: NDArray[np.float32], bare: NDArray[np.float32]) -> Mask:
    """The largest connected part of the background that lies on the bare floor.

    Pixels near the plane are opened with a square of 5 px before their components are labelled.

    Args:
        background: (H, W) float32 mm, 0 where unread.
        bare: (H, W) float32 mm, depth of the bare floor.

    Returns:
        (H, W) bool, all False if nothing lies on it.
    """
    import cv2

    opened = cv2.morphologyEx(
        near_plane(background, bare).astype(np.uint8), cv2.MORPH_OPEN, np.ones((5, 5), np.uint8)
    )
    labels, stats = components(opened)
    # row 0, the surroundings, counts no pixels
    return labels == (int(np.argmax(stats[:, cv2.CC_STAT_AREA])) or -1)


def near_plane(background: NDArray[np.float32], bare: NDArray[np.float32]) -> Mask:
    """Pixels (H, W) bool whose background lies within 15 mm of the bare floor (H, W) mm."""
    return (background > 0) & (np.abs(background - bare) < _FLAT_MM)


# Flat grounds of an empty scene: patches of every large plane that faces the camera.


_MAX_PLANES = 8
_ROUNDS = 4


@dataclass(frozen=True)
class FlatGround:
    """A connected flat patch of an empty scene that faces the camera.

    Attributes:
        floor: its plane.
        patch: (H, W) bool, its pixels.
        enclosed: share of its outline, 0 to 1, with a wall.
    """

    floor: Floor
    patch: Mask
    enclosed: float

    def region(self, reach_px: float) -> Mask:
        """The ground's convex hull (H, W) bool, extended by `reach_px`."""
        import cv2

        away = cv2.distanceTransform((~convex_hull(self.patch)).astype(np.uint8), cv2.DIST_L2, 5)
        return np.asarray(away <= reach_px)


def flat_grounds(
    background: NDArray[np.float32], camera: Camera, least_mm2: float
) -> list[FlatGround]:
    """The flat patches of an empty scene, those of the plane with the most pixels first.

    Args:
        background: (H, W) float32 mm, 0 where unread.
        camera: free of lens distortion.
        least_mm2: area of the smallest patch, mm^2.

    Returns:
        The grounds; empty if nothing is flat.
    """
    step = max(1, max(background.shape) // 160)  # about 160 analysed pixels per side
    rows, columns = np.mgrid[0 : background.shape[0] : step, 0 : background.shape[1] : step]
    depth = background[::step, ::step].astype(float)
    points, middle = _centred(rows, columns, background.shape)
    seeds = _seeds(points, depth, camera.fx / middle[0])
    left = depth > 0
    mm2_per_px = step * step / (camera.fx * camera.fy)
    grounds: list[FlatGround] = []
    for _ in range(_MAX_PLANES):
        if not len(seeds) or not left.any():
            break
        some = points[left]
        at = depth[left]
        stride = max(1, len(at) // 4000)
        votes = _on(some[::stride] @ seeds.T, at[::stride, None]).sum(axis=0)
        best = int(np.argmax(votes))
        if votes[best] * stride * float(np.median(at)) ** 2 * mm2_per_px < least_mm2:
            break
        plane, _ = _refit(some, at, seeds[best], _ROUNDS)
        grounds += _patches(background, _in_pixels(plane, middle, camera), camera, least_mm2)
        taken = left & _on(points @ plane, depth, 2.0 * _INLIER_MM)
        left &= ~taken
        seeds = np.delete(seeds, best, axis=0)
        seeds = seeds[~_same(seeds, plane, points[taken])]
    return grounds


def _seeds(points: Array, depth: Array, focal: float) -> Array:
    """The planes (n, 3), 1 / depth = points . plane, of the image's flat windows."""
    # windows along the longer side, each overlapping its neighbours by half
    side = max(4, max(depth.shape) // 14)
    found = []
    for row in range(0, max(1, depth.shape[0] - side + 1), side // 2):
        for column in range(0, max(1, depth.shape[1] - side + 1), side // 2):
            window = (slice(row, row + side), slice(column, column + side))
            read = depth[window] > 0
            if read.mean() < 0.5 or read.sum() < 12:  # too little is readable
                continue
            some = points[window][read]
            at = depth[window][read]
            kept = np.abs(at - np.median(at)) < 4.0 * np.median(np.abs(at - np.median(at))) + 1.0
            plane = _fit(some[kept], at[kept])
            # of the readable pixels, on its plane
            if _on(some @ plane, at).mean() >= 0.7 and plane[2] > 0:
                found.append(plane)
    return _facing(np.array(found).reshape(-1, 3), focal)


def _same(planes: Array, plane: Array, points: Array) -> Mask:
    """Which of the planes (n, 3) differ from one by less than the flatness
    tolerance over points.
    """
    if not len(points):
        return np.zeros(len(planes), np.bool_)
    some = points[:: max(1, len(points) // 200)]
    depth = 1.0 / np.maximum(some @ plane, 1e-9)
    return np.asarray(_on(some @ planes.T, depth[:, None]).mean(axis=0) > 0.9)


def _patches(
    background: NDArray[np.float32], floor: Floor, camera: Camera, least_mm2: float
) -> list[FlatGround]:
    """The connected parts of the background on a plane, largest first, each with its own plane.

    Unread pixels between pixels of the plane count as on it: glossy floors have holes.
    """
    import cv2

    height, width = background.shape
    flat = near_plane(background, floor.depth(width, height))
    holes = cv2.morphologyEx(flat.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((7, 7), np.uint8))
    whole = flat | ((holes > 0) & (background == 0))
    opened = cv2.morphologyEx(whole.astype(np.uint8), cv2.MORPH_OPEN, np.ones((5, 5), np.uint8))
    found = []
    for part in sorted(parts(opened > 0), key=lambda part: -np.count_nonzero(part))[:_MAX_PLANES]:
        patch = part & flat
        area = float((background[patch].astype(float) ** 2).sum()) / (camera.fx * camera.fy)
        if area < least_mm2:
            break
        own = _refitted(background, patch, floor, camera)
        found.append(FlatGround(own, part, _enclosed(background, part, own)))
    return found


def _refitted(background: NDArray[np.float32], patch: Mask, floor: Floor, camera: Camera) -> Floor:
    """The plane of one patch's own pixels, starting from the whole plane's."""
    rows, columns = np.nonzero(patch)
    points, middle = _centred(rows, columns, background.shape)
    a, b, c = floor.inverse_depth
    whole = np.array([a * middle[0], b * middle[0], c + a * middle[0] + b * middle[1]])
    own, share = _refit(points, background[patch].astype(float), whole, _ROUNDS, least=50)
    return _in_pixels(own, middle, camera) if share > 0 else floor


def _enclosed(background: NDArray[np.float32], patch: Mask, floor: Floor) -> float:
    """The share of a patch's outline just beyond which something rises above the floor.

    Outline along the image border is not enclosed.
    """
    import cv2

    hull = convex_hull(patch)
    reach = 2 * max(6, background.shape[1] // 40) + 1  # width of the inspected surroundings
    v, u = np.mgrid[0 : background.shape[0], 0 : background.shape[1]]
    high = np.where((background > 0) & ~hull, floor.heights(u, v, background), -1e6).astype(
        np.float32
    )
    highest = cv2.dilate(high, np.ones((reach, reach), np.uint8))
    ring = (cv2.dilate(hull.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0) & ~hull
    n_cut = int(hull[0].sum() + hull[-1].sum() + hull[:, 0].sum() + hull[:, -1].sum())
    # a wall rises this far above its floor
    return float((highest[ring] > 20.0).sum()) / max(1, int(ring.sum()) + n_cut)


# Masks of pixels: convex hulls and connected components.


def convex_hull(mask: Mask) -> Mask:
    """The pixels of the convex hull of a mask (H, W) bool, which is not empty."""
    import cv2

    filled = np.zeros(mask.shape, np.uint8)
    cv2.fillConvexPoly(filled, cv2.convexHull(cv2.findNonZero(mask.astype(np.uint8))), 1)
    return filled.astype(bool)


def components(mask: NDArray[Any]) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """The 8-connected components of a mask, numbered as `cv2.connectedComponents` does.

    Only its bounding box is searched.

    Args:
        mask: (H, W) uint8, nonzero inside.

    Returns:
        Labels (H, W), 0 outside, 1 and up inside; and (n, 5) left, top, width, height and pixels
            (`cv2.CC_STAT_*` columns) of each, row 0 is not filled.
    """
    import cv2

    left, top, width, height = cv2.boundingRect(mask)
    # OpenCV numbers components in the order of 2 x 2 blocks, so the box starts at an even pixel
    box = (slice(top - top % 2, top + height), slice(left - left % 2, left + width))
    labels = np.zeros(mask.shape, np.int32)
    if not width:
        return labels, np.zeros((1, 5), np.int32)
    _, labels[box], stats, _ = cv2.connectedComponentsWithStats(mask[box])
    stats[:, cv2.CC_STAT_LEFT] += box[1].start
    stats[:, cv2.CC_STAT_TOP] += box[0].start
    stats[0] = 0
    return labels, np.asarray(stats, np.int32)


def parts(mask: Mask, least_px: float = 1) -> Iterator[Mask]:
    """Yield each connected part (H, W) bool of a mask that has at least `least_px` pixels."""
    labels, stats = components(mask.astype(np.uint8))
    for k in range(1, len(stats)):
        if stats[k, -1] >= least_px:
            yield labels == k
