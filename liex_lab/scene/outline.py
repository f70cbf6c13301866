"""Shape of the arena: robust fits of a circle and a rectangle to the outline, and its walls.

The circle is that of least median distance (least median of squares, Rousseeuw 1984) among those
through three outline points each, refined by algebraic least squares (Kasa). The rectangle is
rotated through a grid of angles about OpenCV's minimum-area one; its sides are the medians of the
points nearest to them. The better of the two is accepted if its median residual is at most the
larger of 4 mm and 2.5 % of its size. The background just beyond the outline decides whether there
are walls or a drop.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from liex_lab.optics.camera import Camera
from liex_lab.scene.floor import Floor, floor_patch

Array = NDArray[np.float64]

ROUND = "round"
RECTANGULAR = "rectangular"
IRREGULAR = "irregular"
OPEN = "open"
_BORDER_PX = 8  # outline this near to the image border is not the floor's own
_NOTCH_PX = 3.0  # outline this far inside the convex hull belongs to an object on the floor
_VIEW_SHARE = 0.6  # least visible share of the outline
# largest residual of a fitted shape, relative to its size or in mm
_FIT_SHARE = 0.025
_FIT_MM = 4.0
_BAND_MM = 60.0  # width beyond the outline in which walls are searched for
_WALL_MM = 20.0  # least height of a wall, or depth of a drop
_SIDE_SHARE = 0.3  # least visible share of each side of a rectangle
_N_CIRCLES = 150  # tried
_MAX_POINTS = 720  # of the outline


@dataclass(frozen=True)
class Arena:
    """The outline of the floor, in the arena frame.

    An irregular or open arena has no such numbers.

    Attributes:
        kind: 'round', 'rectangular', 'irregular' (neither shape fits), or 'open' (the end of the
            floor is outside the image).
        centre_mm: x and y, mm.
        radius_mm: of a round one, mm.
        half_mm: half the lengths of a rectangular one's sides, mm.
        yaw_rad: their rotation, rad.
        residual_mm: median distance of the outline from the shape, mm.
        seen_share: visible share of the outline.
        edge: 'wall', 'drop' (the floor ends in the air) or 'unknown'.
    """

    kind: str
    centre_mm: tuple[float, float] | None = None
    radius_mm: float | None = None
    half_mm: tuple[float, float] | None = None
    yaw_rad: float | None = None
    residual_mm: float | None = None
    seen_share: float = 0.0
    edge: str = "unknown"

    def wall_distance_mm(self, xy_mm: Array) -> Array:
        """Signed distance of points from the nearest wall, negative beyond it.

        Args:
            xy_mm: (..., 2) points, mm, arena frame.

        Returns:
            (...) mm; NaN for an unknown shape.
        """
        xy = np.asarray(xy_mm, float)
        if self.centre_mm is None:
            return np.full(xy.shape[:-1], np.nan)
        offset = xy - np.array(self.centre_mm)
        if self.radius_mm is not None:
            return np.asarray(self.radius_mm - np.linalg.norm(offset, axis=-1))
        inside = np.array(self.half_mm) - np.abs(offset @ _turn(self.yaw_rad or 0.0))
        beyond = np.linalg.norm(np.maximum(-inside, 0.0), axis=-1)
        return np.asarray(np.where(beyond > 0, -beyond, inside.min(axis=-1)))

    def outline_mm(self) -> Array:
        """Corners of its outline, (n, 2) mm, for drawing; (0, 2) for an unknown shape."""
        if self.centre_mm is None:
            return np.empty((0, 2))
        if self.radius_mm is not None:
            return np.array(self.centre_mm) + self.radius_mm * circle_points(96)
        corners = np.array([[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]]) * np.array(
            self.half_mm
        )
        return np.asarray(np.array(self.centre_mm) + corners @ _turn(self.yaw_rad or 0.0).T)

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers for session.json, rounded; unknown values are omitted."""
        numbers = {
            name: value
            if isinstance(value, str)
            else np.round(value, 4 if name == "yaw_rad" else 2).tolist()
            for name, value in vars(self).items()
            if value is not None
        }
        return dict(numbers)

    @staticmethod
    def from_dict(numbers: dict[str, Any]) -> Arena:
        """The arena that `to_dict` wrote."""
        values: dict[str, Any] = {
            name: tuple(value) if isinstance(value, list) else value
            for name, value in numbers.items()
        }
        return Arena(**values)

    def __str__(self) -> str:
        """The shape and its size in words, as in 'round, radius 210 mm'."""
        texts = {
            ROUND: lambda: f"round, radius {self.radius_mm:.0f} mm",
            RECTANGULAR: lambda: (
                "rectangular, "
                + " x ".join(f"{2 * half:.0f}" for half in self.half_mm or ())
                + " mm"
            ),
        }
        return texts.get(self.kind, lambda: self.kind)()


UNKNOWN = Arena(OPEN)


def find_arena(background: NDArray[np.float32], floor: Floor, camera: Camera) -> Arena:
    """The shape of the floor's outline in an empty scene.

    Args:
        background: (H, W) float32 mm, 0 where unread.
        floor: the floor's plane.
        camera: of these pixels.

    Returns:
        The arena: 'open' if less than 60 % of the outline (of a rectangle: 30 % of any side) or
            fewer than 40 points of it are in view, 'irregular' if neither a circle nor a rectangle
            fits.
    """
    points, pixels, share = _outline(background, floor, camera)
    if share < _VIEW_SHARE or len(points) < 40:
        return Arena(OPEN, seen_share=share)
    edge = _edge(background, floor, camera, pixels)
    centre, radius, off_circle = fit_circle(points)
    middle, half, yaw, off_rectangle = fit_rectangle(points)
    size = float(np.sqrt(np.prod(half)))
    if min(off_circle, off_rectangle) > max(_FIT_MM, _FIT_SHARE * size):
        return Arena(IRREGULAR, seen_share=share, edge=edge)
    if off_circle <= off_rectangle:
        return Arena(ROUND, _pair(centre), radius, None, None, off_circle, share, edge)
    if not _all_sides_in_view(points, middle, half, yaw):
        return Arena(OPEN, seen_share=share, edge=edge)
    return Arena(RECTANGULAR, _pair(middle), None, _pair(half), yaw, off_rectangle, share, edge)


def _outline(
    background: NDArray[np.float32], floor: Floor, camera: Camera
) -> tuple[Array, Array, float]:
    """The end of the floor: points (n, 2) mm in the arena frame, their pixels (n, 2), and the
    visible share.

    Points are computed from the reading itself, as the foot of a wall stands on the wall's own line
    at any height.
    """
    import cv2

    height, width = background.shape
    patch = floor_patch(background, floor.depth(width, height))
    contours, _ = cv2.findContours(patch.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    if not contours:
        return np.empty((0, 2)), np.empty((0, 2)), 0.0
    contour = max(contours, key=len)
    hull = cv2.convexHull(contour)
    filled = cv2.fillConvexPoly(np.zeros(patch.shape, np.uint8), hull, 1)
    inward = cv2.distanceTransform(np.pad(filled, 1), cv2.DIST_L2, 5)[1:-1, 1:-1]
    uv = contour[:, 0]
    clear = ((uv >= _BORDER_PX) & (uv < np.array([width, height]) - _BORDER_PX)).all(axis=1)
    uv = uv[clear & (inward[uv[:, 1], uv[:, 0]] < _NOTCH_PX)]
    uv = uv[np.linspace(0, len(uv) - 1, min(len(uv), _MAX_POINTS)).astype(int)]
    share = _share_in_view(hull[:, 0].astype(float), width, height)
    depth = background[uv[:, 1], uv[:, 0]].astype(float)
    middle = hull[:, 0].mean(axis=0)
    out = (uv - middle) / np.maximum(np.linalg.norm(uv - middle, axis=1, keepdims=True), 1e-9)
    points = floor.T_arena_camera @ camera.unproject(
        uv + 0.5 * out, depth
    )  # the last floor pixel ends half a pixel further out
    return points[:, :2], uv, share


def _share_in_view(hull: Array, width: int, height: int) -> float:
    """The share of a convex outline (n, 2) px that is not along the image's edge."""
    ends = np.roll(hull, -1, axis=0)
    length = np.linalg.norm(ends - hull, axis=1)
    limit = np.array([width, height]) - _BORDER_PX
    at_edge = np.logical_or(
        ((hull < _BORDER_PX) & (ends < _BORDER_PX)).any(axis=1),
        ((hull >= limit) & (ends >= limit)).any(axis=1),
    )
    return float(length[~at_edge].sum() / max(length.sum(), 1e-9))


def fit_circle(points: Array) -> tuple[Array, float, float]:
    """The circle nearest to points, up to a third of which may be outliers.

    First, out of 150 circles through three points each, the one with the least median distance;
    then algebraic least squares on the points within three times that distance, in three rounds.

    Args:
        points: (n, 2) in any unit.

    Returns:
        Centre (2,), radius and median distance, in the unit of the points.
    """
    a, b, c = np.moveaxis(
        points[np.random.default_rng(0).integers(0, len(points), (_N_CIRCLES, 3))], 1, 0
    )
    p = b - a
    q = c - a
    twice = 2.0 * (p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0])
    usable = np.abs(twice) > 1e-9
    p = p[usable]
    q = q[usable]
    a = a[usable]
    twice = twice[usable]
    pp = (p * p).sum(axis=1)
    qq = (q * q).sum(axis=1)
    offset = (
        np.stack([q[:, 1] * pp - p[:, 1] * qq, p[:, 0] * qq - q[:, 0] * pp], axis=1)
        / twice[:, None]
    )
    distance = np.linalg.norm(points[:, None] - (a + offset), axis=2) - np.linalg.norm(
        offset, axis=1
    )
    best = np.abs(distance).T[np.median(np.abs(distance), axis=0).argmin()]
    some = points[best <= 3.0 * np.median(best) + 1e-6]
    for _ in range(3):
        design = np.concatenate([2.0 * some, np.ones((len(some), 1))], axis=1)
        x, y, c = np.linalg.lstsq(design, (some**2).sum(axis=1), rcond=None)[0]
        centre = np.array([x, y])
        radius = float(np.sqrt(max(c + x * x + y * y, 1e-9)))
        best = np.abs(np.linalg.norm(points - centre, axis=1) - radius)
        some = points[best <= 3.0 * np.median(best) + 1e-6]
    return centre, radius, float(np.median(best))


def fit_rectangle(points: Array) -> tuple[Array, Array, float, float]:
    """The rectangle nearest to points.

    Its angle is searched about that of the rectangle of least area in steps of 1, 0.1 and 0.01
    degrees.

    Args:
        points: (n, 2) in any unit.

    Returns:
        Centre (2,), half sides (2,), yaw rad and median distance. yaw is that of the first side,
        within 45 degrees of the x axis.
    """
    import cv2

    around = cv2.minAreaRect(points.astype(np.float32))
    best: tuple[float, float, Array, Array] = (np.inf, 0.0, np.zeros(2), np.ones(2))
    first = np.radians((around[2] + 45.0) % 90.0 - 45.0)
    for step in (np.radians(1.0), np.radians(0.1), np.radians(0.01)):
        start = first if not np.isfinite(best[0]) else best[1]
        for yaw in start + step * np.arange(-10, 11):
            mismatch, low, high = _sides(points @ _turn(yaw))
            if mismatch < best[0]:
                best = (mismatch, float(yaw), low, high)
    mismatch, yaw, low, high = best
    return _turn(yaw) @ ((low + high) / 2.0), (high - low) / 2.0, yaw, mismatch


def _sides(points: Array) -> tuple[float, Array, Array]:
    """Median distance of points (n, 2) from the sides of an upright rectangle, and its corners (2,)
    low and high.
    """
    low = np.percentile(points, 2, axis=0)
    high = np.percentile(points, 98, axis=0)
    for _ in range(4):
        gaps = np.stack([points - low, high - points], axis=1).reshape(
            len(points), 4
        )  # low x, low y, high x, high y
        side = np.abs(gaps).argmin(axis=1)
        for k in range(4):
            of_side = points[side == k, k % 2]
            if len(of_side) >= 3:
                (low if k < 2 else high)[k % 2] = np.median(of_side)
    gaps = np.stack([points - low, high - points], axis=1).reshape(len(points), 4)
    return float(np.median(np.abs(gaps).min(axis=1))), low, high


def _all_sides_in_view(points: Array, centre: Array, half: Array, yaw: float) -> bool:
    """Whether the outline (n, 2) covers a sufficient part of each side of the rectangle."""
    local = (points - centre) @ _turn(yaw)
    for axis in (0, 1):
        for end in (-1.0, 1.0):
            along = local[np.abs(local[:, axis] - end * half[axis]) < _FIT_MM, 1 - axis]
            if (
                len(along) < 8
                or np.diff(np.percentile(along, [10, 90]))[0] < _SIDE_SHARE * 2.0 * half[1 - axis]
            ):
                return False
    return True


def _edge(background: NDArray[np.float32], floor: Floor, camera: Camera, pixels: Array) -> str:
    """What is just outside the outline, pixels (n, 2): wall, drop or unknown."""
    middle = pixels.mean(axis=0)
    out = (pixels - middle) / np.maximum(
        np.linalg.norm(pixels - middle, axis=1, keepdims=True), 1e-9
    )
    reach = max(4.0, _BAND_MM * np.sqrt(camera.fx * camera.fy) / floor.distance_mm)
    beyond = pixels + out * np.arange(2.0, reach)[:, None, None]  # (k, n, 2)
    column, row = np.moveaxis(np.rint(beyond).astype(int), -1, 0)
    inside = (
        (row >= 0) & (row < background.shape[0]) & (column >= 0) & (column < background.shape[1])
    )
    depth = np.where(inside, background[np.where(inside, row, 0), np.where(inside, column, 0)], 0.0)
    a, b, c = floor.inverse_depth
    height = np.where(
        depth > 0, floor.distance_mm * (1.0 - depth * (a * column + b * row + c)), np.nan
    )
    valid = np.isfinite(height).any(axis=0)
    if valid.mean() < 0.3:
        return "unknown"
    highest = np.nanmax(height[:, valid], axis=0)
    lowest = np.nanmin(height[:, valid], axis=0)
    return (
        "wall"
        if np.median(highest) > _WALL_MM
        else "drop"
        if np.median(lowest) < -_WALL_MM
        else "unknown"
    )


def circle_points(n: int) -> Array:
    """N points (n, 2) of the unit circle, evenly spaced from (1, 0)."""
    angle = 2.0 * np.pi * np.arange(n) / n
    return np.stack([np.cos(angle), np.sin(angle)], axis=-1)


def _turn(yaw: float) -> Array:
    """Rotation (2, 2) by yaw; points @ it are rotated back."""
    c = np.cos(yaw)
    s = np.sin(yaw)
    return np.array([[c, -s], [s, c]])


def _pair(values: Array) -> tuple[float, float]:
    return float(values[0]), float(values[1])
