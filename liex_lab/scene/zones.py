"""Regions and zones drawn by the user: the arena's region in the image, and zones on the floor.

A region is a polygon, rectangle or circle of a plan, in pixels or in millimetres of the arena
frame: x along image rows and y up the image. Corners in millimetres are projected from the floor
into the image. Overlapping arenas are refused.

Zones are named circles and polygons from TOML, or of a kind: centre and periphery, corners, and
objects with a margin. A point is inside a polygon by the even-odd rule: the number of sides that a
ray along x crosses; the periphery is a polygon whose outline turns back around the centre. Zones
may be drawn in pixels; the view rays of their outline are intersected with the floor, 1 / z = a u +
b v + c.
"""

import difflib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field, TypeAdapter, ValidationError, model_validator

from liex_lab.errors import PlanError
from liex_lab.optics.camera import Camera
from liex_lab.plan.sections import Circle, Corner, Region, SettingsTable
from liex_lab.recordings.frame import region_mask
from liex_lab.runtime.text_files import read_toml
from liex_lab.scene.floor import Array, Floor
from liex_lab.scene.scene import Arena, Mask, circle_points

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
    if (points[:, 2] < 1e-3 * floor.distance_mm).any():
        raise PlanError(
            "arena.region has corners that lie behind the camera; millimetres are measured from "
            "the point of the floor below the camera"
        )
    return tuple((float(u), float(v)) for u, v in camera.project(points))


def _drawn(region: Region) -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
    """The corners (n, 2) in the region's own unit."""
    if region.circle is not None:
        return np.array(region.circle.centre) + region.circle.radius * circle_points(64)
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


# Zones on the floor.

SEPARATOR = ";"  # between the names of zones that overlap, in tables
# joints that a part of the body may be, the first that the animal has
PARTS = {"nose": ("nose", "head"), "tail_base": ("tail_base", "rump")}
Part = Literal["centre", "nose", "tail_base"]
_EXAMPLE = '[[zones]], name = "centre", circle = { centre = [0, 0], radius = 80 }'


@dataclass(frozen=True)
class Zone:
    """A named part of the floor, in the arena frame: a circle or a polygon.

    Attributes:
        name: of the zone; columns are named after it.
        circle_mm: x, y and radius, mm; None for a polygon.
        polygon_mm: corners (x, y), mm; None for a circle.
        part: of the animal that is in it, a key of `PARTS`; None for its centre.
    """

    name: str
    circle_mm: tuple[float, float, float] | None = None
    polygon_mm: tuple[tuple[float, float], ...] | None = None
    part: str | None = None

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
    def from_dict(numbers: dict[str, Any]) -> "Zone":
        """The zone that `to_dict` wrote."""
        return TypeAdapter(Zone).validate_python(numbers)


def zone_names(
    zones: Sequence[Zone], xy_mm: ArrayLike, parts: Mapping[str, ArrayLike] | None = None
) -> list[str]:
    """The names of the zones that contain the animal in each frame.

    Args:
        zones: the zones, which may overlap.
        xy_mm: (n, 2) its centre, mm, arena frame.
        parts: (n, 2) of its other parts that zones name.

    Returns:
        n strings, names joined by `SEPARATOR`; '' for none.
    """
    xy = np.asarray(xy_mm, float)
    places = {None: xy} | {part: np.asarray(at, float) for part, at in (parts or {}).items()}
    inside = [(zone.name, zone.contains(places[zone.part])) for zone in zones]
    return [SEPARATOR.join(name for name, is_in in inside if is_in[k]) for k in range(len(xy))]


class ObjectPoint(SettingsTable):
    """A point and a margin, see `DrawnZone.object`."""

    at: Corner
    margin: Annotated[float, Field(gt=0)]


def joint_of(part: str, joints: Sequence[str]) -> int:
    """Number of the joint that is a part of the body.

    Args:
        part: a key of `PARTS`.
        joints: names of the animal's joints.

    Raises:
        PlanError: the animal has no such part.
    """
    for name in PARTS[part]:
        if name in joints:
            return list(joints).index(name)
    raise PlanError(
        f"arena.zones: this animal has no {' or '.join(PARTS[part])} among its joints "
        f"({', '.join(joints[:6])}), which part = '{part}' needs; leave part out"
    )


class DrawnZone(SettingsTable):
    """A zone as stated in a file: a circle, a polygon, or one of a kind.

    Attributes:
        name: of the zone; columns are named after it. Not of the kinds 'centre_periphery' and
            'corners', which name their own.
        circle: its centre and radius, in `unit`.
        polygon: its corners, in `unit`.
        kind: 'centre_periphery' and 'corners' are made of the detected arena.
        object: a point and the radius around it that counts, in `unit`; the nose visits it unless
            another part is stated.
        part: of the animal that is in the zone, 'centre', 'nose' or 'tail_base'.
        share: of 'centre_periphery': the centre's width over the arena's.
        size: of 'corners': their side, mm.
        unit: 'mm' of the arena frame, or 'px' of the depth image.
        relative_to: 'centre' for coordinates relative to the arena's centre and rotation; None
            otherwise.
    """

    name: str = Field("", pattern=r"^([A-Za-z][A-Za-z0-9_]*)?$")
    circle: Circle | None = None
    polygon: Annotated[list[Corner], Field(min_length=3)] | None = None
    kind: Literal["centre_periphery", "corners"] | None = None
    object: ObjectPoint | None = None
    part: Part | None = None
    share: Annotated[float, Field(gt=0, lt=1)] = 0.5
    size: Annotated[float, Field(gt=0)] = 100.0
    unit: Literal["mm", "px"] = "mm"
    relative_to: Literal["centre"] | None = None

    @model_validator(mode="after")
    def _is_drawn(self) -> Self:
        if [self.circle, self.polygon, self.kind, self.object].count(None) != 3:
            raise ValueError("should have either a circle or a polygon, a kind or an object")
        if self.kind is None and not self.name:
            raise ValueError("name is missing")
        if self.kind is not None and (self.name or self.unit == "px" or self.relative_to):
            raise ValueError("should have no name, unit or relative_to beside its kind")
        if self.unit == "px" and self.relative_to:
            raise ValueError('should have relative_to only with unit = "mm"')
        corners = np.array(self.polygon or [[0, 0], [1, 0], [0, 1]], float)
        x, y = corners.T
        if abs((x * np.roll(y, -1) - np.roll(x, -1) * y).sum()) < 1e-6:
            raise ValueError("has a polygon whose corners enclose no area")
        if (crossing := crossing_sides(corners)) is not None:
            raise ValueError(
                f"has a polygon whose sides {crossing[0] + 1} and {crossing[1] + 1} cross; list "
                "its corners in order"
            )
        return self

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the zones that it makes."""
        of_kind = {
            "centre_periphery": ("centre", "periphery"),
            "corners": tuple(f"corner_{k}" for k in range(1, 5)),
        }
        return of_kind[self.kind] if self.kind else (self.name,)

    @property
    def body_part(self) -> str | None:
        """The part of the animal, as in `Zone.part`."""
        part = self.part or ("nose" if self.object else "centre")
        return None if part == "centre" else part

    def placed(self, camera: Camera, floor: Floor, arena: Arena) -> tuple[Zone, ...]:
        """The zones in the arena frame, mm.

        A circle in pixels becomes a polygon of 64 corners, as it is no circle on a tilted floor.

        Args:
            camera: of the pixels of a zone in px.
            floor: the floor's plane.
            arena: the detected outline, for zones relative to its centre or made of it.

        Raises:
            PlanError: the zone is drawn above the floor's horizon, relative to the centre of an
                arena whose walls were not found, or at corners that it does not have.
        """
        if self.kind is not None:
            outlines = self._of_arena(arena)
            return tuple(
                Zone(name, polygon_mm=_pairs(outline), part=self.body_part)
                for name, outline in zip(self.names, outlines, strict=True)
            )
        circle = self.circle
        if self.object is not None:
            circle = Circle(centre=self.object.at, radius=self.object.margin)
        points = np.array([circle.centre] if circle else self.polygon, float)
        if self.unit == "px":
            if circle:
                points = points + circle.radius * circle_points(64)
            inverse = floor.inverse_at(points[:, 0], points[:, 1])
            if not (inverse > 0).all():
                raise PlanError(
                    f"arena.zones: the zone '{self.name}' reaches above the horizon of the floor; "
                    "draw it on the floor"
                )
            on_floor = floor.T_arena_camera @ camera.unproject(points, 1.0 / inverse)
            return (Zone(self.name, polygon_mm=_pairs(on_floor[:, :2]), part=self.body_part),)
        if self.relative_to is not None:
            c = np.cos(arena.yaw_rad or 0.0)
            s = np.sin(arena.yaw_rad or 0.0)
            points = points @ np.array([[c, s], [-s, c]]) + self._centre_of(arena)
        if circle is None:
            return (Zone(self.name, polygon_mm=_pairs(points), part=self.body_part),)
        return (Zone(self.name, (*_pairs(points)[0], circle.radius), part=self.body_part),)

    def _centre_of(self, arena: Arena) -> Array:
        """The middle (2,) of the detected arena, mm."""
        if arena.centre_mm is None:
            raise PlanError(
                f"arena.zones: the zone '{self.names[0]}' is relative to the arena's centre, but "
                "no walls were found; omit relative_to, or draw it instead of its kind"
            )
        return np.array(arena.centre_mm)

    def _of_arena(self, arena: Arena) -> list[Array]:
        """The outlines of the zones of a kind, mm."""
        centre, outer = self._centre_of(arena), arena.outline_mm()
        if self.kind == "centre_periphery":
            inner = centre + self.share * (outer - centre)
            ring = np.concatenate([outer, outer[:1], inner, inner[:1]])
            return [inner, ring]
        if arena.half_mm is None:
            raise PlanError(
                "arena.zones: corners are those of a rectangular arena, but this one is "
                f"{arena.kind}; draw the zones instead"
            )
        squares = []
        for k in range(4):
            sides = np.stack([outer[(k + 1) % 4], outer[k - 1]]) - outer[k]
            a, b = self.size * sides / np.linalg.norm(sides, axis=1, keepdims=True)
            squares.append(outer[k] + np.array([0.0 * a, a, a + b, b]))
        return squares


class _ZonesFile(SettingsTable):
    """The zones in a TOML file."""

    zones: list[DrawnZone] = Field(min_length=1)

    @model_validator(mode="after")
    def _are_named(self) -> Self:
        names = [name for zone in self.zones for name in zone.names]
        if double := next((name for name in names if names.count(name) > 1), None):
            raise ValueError(f"has two zones called '{double}'; give each a name of its own")
        return self


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
        return zones_of(read_toml(file), str(file))
    except FileNotFoundError:
        raise PlanError(
            f"there is no file {file} with zones; check the spelling of arena.zones"
        ) from None
    except (ValueError, IsADirectoryError) as error:
        raise PlanError(
            f"{file} should be a TOML file with zones, but it is not ({error}); correct it"
        ) from None


def zones_of(table: Mapping[str, Any], origin: str) -> tuple[DrawnZone, ...]:
    """The zones in the table of a TOML file, as `read_zones`.

    Args:
        table: its content.
        origin: the file's name, for messages.
    """
    try:
        return tuple(_ZonesFile.model_validate(table).zones)
    except ValidationError as error:
        raise PlanError(f"{origin}: {_sentence(error)}") from None


def _sentence(error: ValidationError) -> str:
    """The errors of a file as one sentence on the first of them; a misspelt key is the first."""
    first = min(error.errors(include_url=False), key=lambda one: one["type"] != "extra_forbidden")
    loc = [part + 1 if isinstance(part, int) else part for part in first["loc"]]
    where = " ".join(map(str, loc)) or "the file"
    if first["type"] == "extra_forbidden":
        known = DrawnZone.model_fields if len(loc) > 1 else _ZonesFile.model_fields
        near = difflib.get_close_matches(str(loc[-1]), known, 1, cutoff=0.0)[0]
        return f"{where} is an unknown key; the nearest known key is {near}"
    message = first["msg"].removeprefix("Value error, ")
    for pydantic, own in (
        ("Input should", "should"),
        ("Field required", "is missing"),
        (
            "String should match pattern",
            "should be letters, digits and _:",
        ),
        ("a valid dictionary or instance of", "a table, a"),
    ):
        message = message.replace(pydantic, own)
    got = "" if first["type"] in ("value_error", "missing") else f", got {first['input']!r}"
    return f"{where} {message}{got}; as in {_EXAMPLE}"


def _pairs(points: Array) -> tuple[tuple[float, float], ...]:
    return tuple((float(x), float(y)) for x, y in points)
