"""Zones of the arena drawn by the user: named circles and polygons on the floor, from TOML.

A point is inside a polygon by the even-odd rule: the number of sides that a ray along x crosses.
Zones may be drawn in pixels; the view rays of their outline are intersected with the floor, 1 / z =
a u + b v + c.
"""

from __future__ import annotations

import difflib
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from liex_lab.errors import PlanError
from liex_lab.optics.camera import Camera
from liex_lab.runtime.text_files import read_toml
from liex_lab.scene.floor import Floor
from liex_lab.scene.outline import Arena, circle_points
from liex_lab.scene.region import crossing_sides

Array = NDArray[np.float64]

SEPARATOR = ";"  # between the names of zones that overlap, in tables
_KEYS = ("name", "circle", "polygon", "unit", "relative_to")
_EXAMPLE = '[[zones]], name = "centre", circle = { centre = [0, 0], radius = 80 }'


@dataclass(frozen=True)
class Zone:
    """A named part of the floor, in the arena frame: a circle or a polygon.

    Attributes:
        name: of the zone; columns are named after it.
        circle_mm: x, y and radius, mm; None for a polygon.
        polygon_mm: corners (x, y), mm; None for a circle.
    """

    name: str
    circle_mm: tuple[float, float, float] | None = None
    polygon_mm: tuple[tuple[float, float], ...] | None = None

    def contains(self, xy_mm: ArrayLike) -> NDArray[np.bool_]:
        """Whether points lie in the zone.

        Args:
            xy_mm: (n, 2) points, mm, arena frame.

        Returns:
            (n,) bool; False for NaN.
        """
        xy = np.asarray(xy_mm, float)
        if self.circle_mm is not None:
            x, y, radius = self.circle_mm
            return np.asarray(np.hypot(xy[:, 0] - x, xy[:, 1] - y) <= radius)
        inside = np.zeros(len(xy), np.bool_)
        corners = np.array(self.polygon_mm)
        for (x0, y0), (x1, y1) in zip(corners, np.roll(corners, -1, axis=0), strict=True):
            if y0 == y1:
                continue
            crosses = (y0 <= xy[:, 1]) != (y1 <= xy[:, 1])  # a ray along x crosses this side
            inside ^= crosses & (xy[:, 0] < x0 + (xy[:, 1] - y0) * (x1 - x0) / (y1 - y0))
        return inside

    def outline_mm(self) -> Array:
        """Corners of its outline, (n, 2) mm, for drawing."""
        if self.circle_mm is None:
            return np.array(self.polygon_mm)
        x, y, radius = self.circle_mm
        return np.array([x, y]) + radius * circle_points(64)

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers for session.json."""
        return {name: value for name, value in vars(self).items() if value is not None}

    @staticmethod
    def from_dict(numbers: dict[str, Any]) -> Zone:
        """The zone that `to_dict` wrote."""
        circle = numbers.get("circle_mm")
        polygon = numbers.get("polygon_mm")
        return Zone(
            str(numbers["name"]),
            None if circle is None else (float(circle[0]), float(circle[1]), float(circle[2])),
            None if polygon is None else _pairs(np.array(polygon, float)),
        )


def zone_names(zones: Sequence[Zone], xy_mm: ArrayLike) -> list[str]:
    """The names of the zones that contain each point.

    Args:
        zones: the zones, which may overlap.
        xy_mm: (n, 2) points, mm, arena frame.

    Returns:
        n strings, names joined by `SEPARATOR`; '' for none.
    """
    xy = np.asarray(xy_mm, float)
    inside = [(zone.name, zone.contains(xy)) for zone in zones]
    return [SEPARATOR.join(name for name, is_in in inside if is_in[k]) for k in range(len(xy))]


@dataclass(frozen=True)
class DrawnZone:
    """A zone as stated in a file: a circle about its only point, or a polygon.

    Attributes:
        name: of the zone.
        points: the circle's centre, or the polygon's corners, in `unit`.
        radius: of the circle, in `unit`; None for a polygon.
        unit: 'mm' of the arena frame, or 'px' of the depth image.
        relative_to: 'centre' for coordinates relative to the arena's centre and rotation; None
            otherwise.
        where: its name in error messages.
    """

    name: str
    points: tuple[tuple[float, float], ...]
    radius: float | None
    unit: str
    relative_to: str | None
    where: str

    def placed(self, camera: Camera, floor: Floor, arena: Arena) -> Zone:
        """The zone in the arena frame, mm.

        A circle in pixels becomes a polygon of 64 corners, as it is no circle on a tilted floor.

        Args:
            camera: of the pixels of a zone in px.
            floor: the floor's plane.
            arena: the detected outline, for zones relative to its centre.

        Raises:
            PlanError: the zone is drawn above the floor's horizon, or relative to the centre of an
                arena whose walls were not found.
        """
        points = np.array(self.points)
        if self.unit == "px":
            if self.radius is not None:  # a circle in the image is no circle on a tilted floor
                points = points + self.radius * circle_points(64)
            return Zone(self.name, polygon_mm=_pairs(self._on_floor(points, camera, floor)))
        if self.relative_to is not None:
            if arena.centre_mm is None:
                raise PlanError(
                    f"{self.where} is relative to the arena's centre, but no walls were found; "
                    "omit relative_to"
                )
            c = np.cos(arena.yaw_rad or 0.0)
            s = np.sin(arena.yaw_rad or 0.0)
            points = points @ np.array([[c, s], [-s, c]]) + np.array(arena.centre_mm)
        if self.radius is None:
            return Zone(self.name, polygon_mm=_pairs(points))
        return Zone(self.name, circle_mm=(*_pairs(points)[0], self.radius))

    def _on_floor(self, uv: Array, camera: Camera, floor: Floor) -> Array:
        """Intersections (n, 2) mm of the view rays of pixels (n, 2) with the floor."""
        a, b, c = floor.inverse_depth
        inverse = a * uv[:, 0] + b * uv[:, 1] + c
        if not (inverse > 0).all():
            raise PlanError(
                f"{self.where} reaches above the horizon of the floor; draw it on the floor"
            )
        return np.asarray((floor.T_arena_camera @ camera.unproject(uv, 1.0 / inverse))[:, :2])


def read_zones(path: str | Path) -> tuple[DrawnZone, ...]:
    """The zones in a TOML file.

    Each [[zones]] has a name, and a circle = { centre = [x, y], radius = r } or a polygon = [[x,
    y], ...]. unit = "mm" (the default) means millimetres of the arena frame, "px" pixels (u, v) of
    the depth image, whose view rays are intersected with the floor. relative_to = "centre" measures
    millimetres from the detected centre of the arena, rotated with it.

    Args:
        path: of the file.

    Returns:
        The zones in the order of the file, not yet placed on a floor.

    Raises:
        PlanError: the file or a zone is invalid; the message names the correction.
    """
    file = Path(path)
    try:
        table = read_toml(file)
    except FileNotFoundError:
        raise PlanError(
            f"there is no file {file} with zones; check the spelling of arena.zones"
        ) from None
    except (ValueError, IsADirectoryError) as error:
        raise PlanError(
            f"{file} should be a TOML file with zones, but it is not ({error}); correct it"
        ) from None
    entries = table.get("zones")
    if not isinstance(entries, list) or not entries or set(table) != {"zones"}:
        raise PlanError(
            f"{file} should contain only zones, each beginning with [[zones]]; as in {_EXAMPLE}"
        )
    zones = [_zone(file, number, entry) for number, entry in enumerate(entries, start=1)]
    names = [zone.name for zone in zones]
    if double := next((name for name in names if names.count(name) > 1), None):
        raise PlanError(f"{file} has two zones called '{double}'; give each a name of its own")
    return tuple(zones)


def _zone(file: Path, number: int, entry: Any) -> DrawnZone:
    where = f"zone {number} of {file}"
    if not isinstance(entry, dict):
        raise PlanError(
            f"{where} should be a table with a name and a circle or a polygon; as in {_EXAMPLE}"
        )
    for key in entry:
        if key not in _KEYS:
            near = difflib.get_close_matches(key, _KEYS, 1, cutoff=0.0)[0]
            raise PlanError(f"{where} has an unknown key '{key}'; the nearest known key is {near}")
    name = entry.get("name")
    if not (isinstance(name, str) and re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", name)):
        raise PlanError(
            f"{where} needs a name of letters, digits and _, for columns are named after it, got "
            f"{name!r}"
        )
    where = f"zone '{name}' of {file}"
    unit = entry.get("unit", "mm")
    relative = entry.get("relative_to")
    if unit not in ("mm", "px") or relative not in (None, "centre") or (unit == "px" and relative):
        raise PlanError(
            f'{where} should have unit = "mm" or "px", and only with mm optionally relative_to = '
            '"centre"; correct it'
        )
    if ("circle" in entry) == ("polygon" in entry):
        raise PlanError(f"{where} should have either a circle or a polygon; as in {_EXAMPLE}")
    if "polygon" in entry:
        return DrawnZone(
            name, _pairs(_polygon(where, entry["polygon"])), None, unit, relative, where
        )
    circle = entry["circle"]
    if not isinstance(circle, dict) or set(circle) != {"centre", "radius"}:
        raise PlanError(
            f"{where}: a circle is written as {{ centre = [0, 0], radius = 80 }}, got {circle!r}"
        )
    if not (_is_number(circle["radius"]) and circle["radius"] > 0):
        raise PlanError(
            f"{where}: the radius of a circle is a positive number, got {circle['radius']!r}"
        )
    return DrawnZone(
        name, (_point(where, circle["centre"]),), float(circle["radius"]), unit, relative, where
    )


def _polygon(where: str, polygon: Any) -> Array:
    """The validated corners (n, 2) of a polygon."""
    if not isinstance(polygon, list) or len(polygon) < 3:
        raise PlanError(
            f"{where}: a polygon is a list of at least three corners [x, y], got {polygon!r}"
        )
    corners = np.array([_point(where, corner) for corner in polygon])
    ends = np.roll(corners, -1, axis=0)
    if abs((corners[:, 0] * ends[:, 1] - corners[:, 1] * ends[:, 0]).sum()) < 1e-6:
        raise PlanError(f"{where}: the corners of the polygon enclose no area; correct them")
    if (crossing := crossing_sides(corners)) is not None:
        raise PlanError(
            f"{where}: sides {crossing[0] + 1} and {crossing[1] + 1} of the polygon cross; list "
            "its corners in order"
        )
    return corners


def _point(where: str, value: Any) -> tuple[float, float]:
    if not (
        isinstance(value, list) and len(value) == 2 and all(_is_number(number) for number in value)
    ):
        raise PlanError(f"{where}: a point is a pair of numbers [x, y], got {value!r}")
    return float(value[0]), float(value[1])


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _pairs(points: Array) -> tuple[tuple[float, float], ...]:
    return tuple((float(x), float(y)) for x, y in points)
