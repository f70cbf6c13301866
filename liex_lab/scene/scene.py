"""The scene of a session: floor, region, outline, fixtures and number of animals.

A `Scene` is written to session.json (`scene`). Its region of interest is a polygon in pixels of the
rectified image; pixels outside are ignored. Its roughness is the spread of the ground about the
floor's plane, its fixtures are objects at rest on the floor.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from liex_lab.errors import PlanError
from liex_lab.optics.camera import Camera, SensorCard
from liex_lab.scene.floor import Floor
from liex_lab.scene.outline import UNKNOWN, Arena

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

LARGEST = "largest plane"
BY_SUPPORT = "where animals stand"
WALLED = "walled ground"
STATED = "plan"

HIGH_MM = 20.0  # least height of a fixture above the floor
LEAST_MM2 = 300.0  # smaller ones are specks
_MOST = 32  # fixtures reported
_MOST_ROUND = 1.6  # largest ratio of hull to area: beyond, it is the walls


@dataclass(frozen=True)
class Fixture:
    """An object at rest on the floor.

    Attributes:
        centre_mm: x and y of its middle, mm, arena frame.
        height_mm: of its top above the floor, mm.
        area_mm2: seen from the camera, mm^2.
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
    def from_dict(numbers: Mapping[str, Any]) -> Fixture:
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
        n_animals: how many of them move in one frame; 0 if none moved.
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
    """

    floor: Floor
    floor_from: str = LARGEST
    floor_support: float | None = None
    n_moving: int = 0
    n_animals: int = 0
    roughness_mm: float | None = None
    region_px: tuple[tuple[float, float], ...] = ()
    outline: Arena = UNKNOWN
    fixtures: tuple[Fixture, ...] = ()
    doubts: tuple[str, ...] = ()
    wander_mm: float | None = None
    thin_above: bool = False
    sensor: SensorCard | None = None

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
            "thin_above": self.thin_above,
            "fixtures": [fixture.to_dict() for fixture in self.fixtures],
            "doubts": list(self.doubts),
            **({} if self.sensor is None else {"sensor": self.sensor.to_dict()}),
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
    short = cv2.approxPolyDP(hull, 1.5, True)[:, 0]
    return tuple((float(u) * stride, float(v) * stride) for u, v in short)


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
    n, labels = cv2.connectedComponents(high.astype(np.uint8))
    found = []
    for k in range(1, n):
        mask = labels == k
        hull = cv2.convexHull(cv2.findNonZero(mask.astype(np.uint8)))
        if cv2.contourArea(hull) > _MOST_ROUND * mask.sum():
            continue  # the walls surround the floor and do not stand on it
        fixture = fixture_at(mask, background, floor, camera)
        if fixture.area_mm2 >= LEAST_MM2:
            found.append(fixture)
    return tuple(sorted(found, key=lambda fixture: -fixture.area_mm2)[:_MOST])


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
    top = float(np.percentile(points[:, 2], 95))
    return Fixture((float(middle[0]), float(middle[1])), top, area)
