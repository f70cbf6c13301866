"""The scene of a session: floor, region, outline of the arena, fixtures and number of animals.

A `Scene` is written to session.json (`scene`). Its region of interest is a polygon in pixels of the
rectified image; pixels outside are ignored. Its roughness is the spread of the ground about the
floor's plane, its fixtures are objects at rest on the floor.

The outline is a circle or a rectangle, fitted robustly to the end of the floor. The circle is that
of least median distance (least median of squares, Rousseeuw 1984) among those through three outline
points each, refined by algebraic least squares (Kasa). The rectangle is rotated through a grid of
angles about OpenCV's minimum-area one; its sides are the medians of the points nearest to them. The
better of the two is accepted if its median residual is at most the larger of 4 mm and 2.5 % of its
size. The background just beyond the outline decides whether there are walls or a drop.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from liex_lab.errors import PlanError
from liex_lab.optics.camera import Camera, SensorCard
from liex_lab.scene.floor import Array, Floor, Mask, floor_patch, parts

OPEN = "open"
_BORDER_PX = 8  # outline this near to the image border is not the floor's own
_FIT_MM = 4.0  # largest residual of a fitted shape, or 2.5 % of its size
_WALL_MM = 20.0  # least height of a wall, or depth of a drop


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
        return {
            name: value
            if isinstance(value, str)
            else np.round(value, 4 if name == "yaw_rad" else 2).tolist()
            for name, value in vars(self).items()
            if value is not None
        }

    @staticmethod
    def from_dict(numbers: dict[str, Any]) -> "Arena":
        """The arena that `to_dict` wrote."""
        values: dict[str, Any] = {
            name: tuple(value) if isinstance(value, list) else value
            for name, value in numbers.items()
        }
        return Arena(**values)

    def __str__(self) -> str:
        """The shape and its size in words, as in 'round, radius 210 mm'."""
        if self.radius_mm is not None:
            return f"round, radius {self.radius_mm:.0f} mm"
        if self.half_mm is not None:
            return f"rectangular, {' x '.join(f'{2 * half:.0f}' for half in self.half_mm)} mm"
        return self.kind


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
    if share < 0.6 or len(points) < 40:  # too little of it is in view
        return Arena(OPEN, seen_share=share)
    edge = _edge(background, floor, camera, pixels)
    centre, radius, off_circle = fit_circle(points)
    middle, half, yaw, off_rectangle = fit_rectangle(points)
    size = float(np.sqrt(np.prod(half)))
    if min(off_circle, off_rectangle) > max(_FIT_MM, 0.025 * size):
        return Arena("irregular", seen_share=share, edge=edge)
    if off_circle <= off_rectangle:
        return Arena("round", _pair(centre), radius, None, None, off_circle, share, edge)
    if not _all_sides_in_view(points, middle, half, yaw):
        return Arena(OPEN, seen_share=share, edge=edge)
    return Arena("rectangular", _pair(middle), None, _pair(half), yaw, off_rectangle, share, edge)


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
    # farther inside the hull, it belongs to an object on the floor
    uv = uv[clear & (inward[uv[:, 1], uv[:, 0]] < 3.0)]
    uv = uv[np.linspace(0, len(uv) - 1, min(len(uv), 720)).astype(int)]
    share = _share_in_view(hull[:, 0].astype(float), width, height)
    depth = background[uv[:, 1], uv[:, 0]].astype(float)
    out = _outward(uv, hull[:, 0].mean(axis=0))
    # the last floor pixel ends half a pixel further out
    points = floor.T_arena_camera @ camera.unproject(uv + 0.5 * out, depth)
    return points[:, :2], uv, share


def _outward(pixels: Array, middle: Array) -> Array:
    """Unit vectors (n, 2) from the middle (2,) to pixels (n, 2)."""
    off = pixels - middle
    return np.asarray(off / np.maximum(np.linalg.norm(off, axis=1, keepdims=True), 1e-9))


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
    a, b, c = np.moveaxis(points[np.random.default_rng(0).integers(0, len(points), (150, 3))], 1, 0)
    p = b - a
    q = c - a
    twice = 2.0 * (p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0])
    usable = np.abs(twice) > 1e-9
    p, q, a, twice = p[usable], q[usable], a[usable], twice[usable]
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
                or np.diff(np.percentile(along, [10, 90]))[0] < 0.3 * 2.0 * half[1 - axis]
            ):
                return False
    return True


def _edge(background: NDArray[np.float32], floor: Floor, camera: Camera, pixels: Array) -> str:
    """What is just outside the outline, pixels (n, 2): wall, drop or unknown."""
    out = _outward(pixels, pixels.mean(axis=0))
    # walls are searched for within 60 mm
    reach = max(4.0, 60.0 * np.sqrt(camera.fx * camera.fy) / floor.distance_mm)
    beyond = pixels + out * np.arange(2.0, reach)[:, None, None]  # (k, n, 2)
    column, row = np.moveaxis(np.rint(beyond).astype(int), -1, 0)
    inside = (
        (row >= 0) & (row < background.shape[0]) & (column >= 0) & (column < background.shape[1])
    )
    depth = np.where(inside, background[np.where(inside, row, 0), np.where(inside, column, 0)], 0.0)
    height = np.where(depth > 0, floor.heights(column, row, depth), np.nan)
    valid = np.isfinite(height).any(axis=0)
    if valid.mean() < 0.3:
        return "unknown"
    if np.median(np.nanmax(height[:, valid], axis=0)) > _WALL_MM:
        return "wall"
    return "drop" if np.median(np.nanmin(height[:, valid], axis=0)) < -_WALL_MM else "unknown"


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


# Objects at rest on the floor, and the scene with them.

LARGEST = "largest plane"
BY_SUPPORT = "where animals stand"
WALLED = "walled ground"
STATED = "plan"

HIGH_MM = 20.0  # least height of a fixture above the floor
LEAST_MM2 = 300.0  # smaller ones are specks


@dataclass(frozen=True)
class Fixture:
    """An object at rest on the floor.

    Attributes:
        centre_mm: x and y of its middle, mm, arena frame.
        height_mm: of its top above the floor, mm.
        area_mm2: from the camera, mm^2.
        since_s: when it was placed there, s since the first frame; None if from the beginning.
        until_s: when it was removed; None if it stays.
    """

    centre_mm: tuple[float, float]
    height_mm: float
    area_mm2: float
    since_s: float | None = None
    until_s: float | None = None

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers for session.json; times only of a transient object."""
        times = {"since_s": self.since_s, "until_s": self.until_s}
        return {
            "centre_mm": [round(value, 1) for value in self.centre_mm],
            "height_mm": round(self.height_mm, 1),
            "area_mm2": round(self.area_mm2, 1),
            **{name: round(at, 2) for name, at in times.items() if at is not None},
        }

    @staticmethod
    def from_dict(numbers: Mapping[str, Any]) -> "Fixture":
        """The fixture that `to_dict` wrote, an entry of `scene.fixtures` in session.json."""
        x, y = numbers["centre_mm"][:2]
        times = numbers.get("since_s"), numbers.get("until_s")
        return Fixture((x, y), numbers["height_mm"], numbers["area_mm2"], *times)

    def __str__(self) -> str:
        """Its height, and its start and end times if transient."""
        since = "" if self.since_s is None else f" from {self.since_s:.1f}"
        until = "" if self.until_s is None else f" {'to' if since else 'until'} {self.until_s:.1f}"
        times = since + until
        return f"{self.height_mm:.0f} mm{f',{times} s' if times else ''}"


@dataclass(frozen=True)
class Scene:
    """The static scene of a recording, and how many animals move in it.

    Attributes:
        floor: the plane that animals stand on, camera frame.
        floor_from: how it was found: 'largest plane', 'where animals stand' (another plane than the
            largest), 'walled ground' (nothing moved, so it is doubtful) or 'plan'.
        floor_support: share of the moving objects, by volume, that stand on it, 0 to 1; None if too
            little moved.
        n_moving: moving objects of an animal's size in the sampled frames.
        n_animals: how many animals are in view at once; 0 if nothing moved.
        n_animals_share: share of the sampled frames with an animal in which as many stand free.
        roughness_mm: standard deviation of the ground, with bedding, about the floor's plane, mm;
            None if the ground is not visible.
        region_px: (u, v) corners, pixels, of the polygon that is analysed; empty for the full
            image.
        outline: the shape of the arena.
        fixtures: objects at rest on the floor, largest first; then transient objects in order of
            time.
        doubts: sentences on why the scene may be wrong.
        wander_mm: range of the floor's depth over the recording, mm, as of a sensor that warms up;
            None without drift.
        thin_above: whether something thin above the animal, a cable or bars, is removed from the
            images.
        sensor: quality of the sensor's readings; None if unknown.
        ground_changes_s: times, s since the first frame, from which the background is another one,
            as under a nest; empty if the ground does not change.
    """

    floor: Floor
    floor_from: str = LARGEST
    floor_support: float | None = None
    n_moving: int = 0
    n_animals: int = 0
    n_animals_share: float = 1.0
    roughness_mm: float | None = None
    region_px: tuple[tuple[float, float], ...] = ()
    outline: Arena = UNKNOWN
    fixtures: tuple[Fixture, ...] = ()
    doubts: tuple[str, ...] = ()
    wander_mm: float | None = None
    thin_above: bool = False
    sensor: SensorCard | None = None
    ground_changes_s: tuple[float, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers for session.json, without the outline, which is stored as `arena`."""
        support = self.floor_support
        return {
            "floor": {
                "normal": [float(value) for value in self.floor.normal],
                "distance_mm": float(self.floor.distance_mm),
                "from": self.floor_from,
                "support": None if support is None else round(support, 3),
                "roughness_mm": None if self.roughness_mm is None else round(self.roughness_mm, 2),
                "wander_mm": None if self.wander_mm is None else round(self.wander_mm, 2),
            },
            "region_px": [[round(u, 1), round(v, 1)] for u, v in self.region_px],
            "n_moving": self.n_moving,
            "n_animals": self.n_animals,
            "n_animals_share": round(self.n_animals_share, 3),
            "thin_above": self.thin_above,
            "fixtures": [fixture.to_dict() for fixture in self.fixtures],
            "doubts": list(self.doubts),
            **({} if self.sensor is None else {"sensor": self.sensor.to_dict()}),
            **(
                {"ground_changes_s": [round(at, 2) for at in self.ground_changes_s]}
                if self.ground_changes_s
                else {}
            ),
        }


def region_corners(region: Mask | None, stride: int) -> tuple[tuple[float, float], ...]:
    """The convex outline of a region, in pixels of the full image.

    Args:
        region: (H, W) bool of every `stride`-th pixel; None for the full image.
        stride: step, px.

    Returns:
        (u, v) corners; empty for the full image.
    """
    import cv2

    if region is None or not region.any():
        return ()
    hull = cv2.convexHull(cv2.findNonZero(region.astype(np.uint8)))
    return tuple(
        (float(u) * stride, float(v) * stride) for u, v in cv2.approxPolyDP(hull, 1.5, True)[:, 0]
    )


def plane_of(point: Sequence[float], normal: Sequence[float], camera: Camera) -> Floor:
    """The floor stated in a plan by a point and a normal.

    Args:
        point: (3,) mm, camera frame.
        normal: (3,) of any length, towards or away from the camera.
        camera: of the recording.

    Raises:
        PlanError: the plane passes through the camera, or is viewed edge-on.
    """
    n = np.asarray(normal, float)
    length = float(np.linalg.norm(n))
    distance = float(n @ np.asarray(point, float)) / length if length > 0 else 0.0
    if distance < 0:
        n = -n
        distance = -distance
    if distance < 1.0 or n[2] / length < np.cos(np.radians(75.0)):
        raise PlanError(
            "arena.floor should be a plane in front of the camera that faces it: point lies on it, "
            "mm in the camera's frame (x right, y down, z away), normal is its perpendicular, as "
            "in {point = [0, 0, 700], normal = [0, 0, 1]}"
        )
    return Floor.from_plane(n, distance, camera)


def roughness(
    background: NDArray[np.float32], bare: NDArray[np.float32], on_floor: Mask
) -> float | None:
    """Standard deviation of the ground about the floor's plane, mm, from the 68.3 % quantile.

    Args:
        background: (H, W) float32 mm, 0 where unread.
        bare: (H, W) float32 mm, depth of the plane.
        on_floor: (H, W) bool, the floor.

    Returns:
        The spread, which a third of the ground exceeds; None if no ground is read.
    """
    valid = on_floor & (background > 0) & (background != bare)
    if not valid.any():
        return None
    off = background[valid] - bare[valid]
    return float(np.percentile(np.abs(off - np.median(off)), 68.3))


def find_fixtures(
    background: NDArray[np.float32], floor: Floor, camera: Camera, on_floor: Mask
) -> tuple[Fixture, ...]:
    """Find objects at rest on the floor.

    Args:
        background: (H, W) float32 mm, 0 where unread.
        floor: its plane, in pixels of the camera.
        camera: of these pixels.
        on_floor: (H, W) bool, the floor.

    Returns:
        At most 32, largest first.
    """
    import cv2

    bare = floor.depth(camera.width, camera.height)
    # the foot of the walls is no object on the floor
    inner = cv2.erode(np.pad(on_floor, 1).astype(np.uint8), np.ones((9, 9), np.uint8))[1:-1, 1:-1]
    high = (inner > 0) & (background > 0) & (bare - background > HIGH_MM)
    found = []
    for mask in parts(high):
        hull = cv2.convexHull(cv2.findNonZero(mask.astype(np.uint8)))
        if cv2.contourArea(hull) > 1.6 * mask.sum():
            continue  # the walls surround the floor and do not stand on it
        fixture = fixture_at(mask, background, floor, camera)
        if fixture.area_mm2 >= LEAST_MM2:
            found.append(fixture)
    return tuple(sorted(found, key=lambda fixture: -fixture.area_mm2)[:32])


def fixture_at(mask: Mask, depth: NDArray[np.float32], floor: Floor, camera: Camera) -> Fixture:
    """The object in some pixels.

    Args:
        mask: (H, W) bool, its pixels, at least one.
        depth: (H, W) float32 mm, of its surface there.
        floor: its plane, in pixels of the camera.
        camera: of these pixels.
    """
    rows, columns = np.nonzero(mask)
    z = depth[rows, columns].astype(float)
    area = float((z**2).sum()) / (camera.fx * camera.fy)
    pixels = np.stack([columns, rows], axis=1).astype(float)
    points = floor.T_arena_camera @ camera.unproject(pixels, z)
    middle = points[:, :2].mean(axis=0)
    return Fixture(
        (float(middle[0]), float(middle[1])), float(np.percentile(points[:, 2], 95)), area
    )
