"""Kinematic tree of an animal: joints, bone offsets, free axes and limits, read from a TOML file.

The skeletal model of Lie-X section 3: a base joint with six degrees of freedom and, below it,
joints that rotate about one to three axes of their own frame. Bones have fixed proportions; one
scale multiplies all of them. A skeleton is data, so an animal is added without code: the presets
'fish', 'mouse' and 'hand' are TOML files, and users may write their own. The [[joints]] tables
define the tree, [view] how the animal is viewed, and [surface] the body around the bones.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from liex_lab.arrays import Array, NDArray
from liex_lab.errors import LiexError, did_you_mean, expecting, how_to_install, refuse
from liex_lab.geometry import so3
from liex_lab.runtime.text_files import read_toml

AXES = ("roll", "pitch", "yaw")  # about x (forward), y (left), z (up) of the joint's own frame
PRESETS = Path(__file__).parent / "presets"
_JOINT_KEYS = {"name", "parent", "offset_mm", "rest_deg", "axes", "limits_deg"}
# home length of the mouse: lengths that apply to every animal are stated for it
REFERENCE_MM = 52.834
VIEWS = ("floor", "camera")
FOREGROUNDS = ("background", "nearest")
# of an animal of the reference length
_BEHIND_MM = 120.0
_SMOOTH_MM = 2.0
_MIN_HEIGHT_MM = 7.0
_AREA = (0.12, 1.3)
_HUGE = 1e9  # no number of a skeleton is as large


@dataclass(frozen=True)
class CameraView:
    """How an animal is viewed: the [view] table of its TOML.

    Attributes:
        frame: 'floor', heights are measured above the floor that it stands on, or 'camera', along
            the optical axis from behind_mm behind its mean depth, for an animal that swims or is
            lifted.
        behind_mm: distance of the reference plane behind the mean depth; the same for all sizes of
            an animal that swims (otherwise the height map would reveal the size used to cut it), at
            home size for a hand.
        smooth_mm: readings within this distance, at home size, are averaged.
        area: the smallest and the largest area in top view, of the squared length.
        min_height_mm: smaller heights above the background are not the animal.
        foreground: 'background', the animal is segmented from a still scene, or 'nearest', nothing
            is nearer to the camera.
    """

    frame: str = VIEWS[0]
    behind_mm: float = _BEHIND_MM
    smooth_mm: float = _SMOOTH_MM
    area: tuple[float, float] = _AREA
    min_height_mm: float = _MIN_HEIGHT_MM
    foreground: str = FOREGROUNDS[0]

    @staticmethod
    def from_table(table: dict[str, Any], relative_size: float, origin: str) -> CameraView:
        """The view stated in a TOML; omitted values are derived from the animal's size.

        Args:
            table: the [view] table, may be empty.
            relative_size: home length over REFERENCE_MM.
            origin: name of the file in errors.

        Raises:
            LiexError: an unknown key, or a value out of its range.
        """
        keys = CameraView.__annotations__
        if not isinstance(table, dict):
            raise LiexError(f"{origin}: [view] is a table, got {table!r}")
        for key in table:
            if key not in keys:
                raise LiexError(
                    f"{origin}: [view] has an unknown key '{key}'; use {', '.join(keys)}"
                )
        for key, choices in (("foreground", FOREGROUNDS), ("frame", VIEWS)):
            value = table.get(key, choices[0])
            if value not in choices:
                raise LiexError(
                    f"{origin}: [view] {key} is one of {', '.join(choices)}, got {value!r}"
                )
        area = table.get("area", list(_AREA))
        if not (
            isinstance(area, list)
            and [_is_number(a) for a in area] == [True, True]
            and 0 < area[0] < area[1]
        ):
            raise LiexError(
                f"{origin}: [view] area is [smallest, largest], two rising positive numbers, got "
                f"{area}"
            )
        lengths = {
            "behind_mm": _BEHIND_MM * relative_size,
            "smooth_mm": _SMOOTH_MM * relative_size,
            "min_height_mm": _MIN_HEIGHT_MM,
        }
        for key, usual in lengths.items():
            value = table.get(key, usual)
            if not (_is_number(value) and value > 0):
                raise LiexError(f"{origin}: [view] {key} is a positive number of mm, got {value!r}")
            lengths[key] = float(value)
        stated = {key: table[key] for key in ("frame", "foreground") if key in table}
        return CameraView(
            area=(float(area[0]), float(area[1])),
            behind_mm=lengths["behind_mm"],
            smooth_mm=lengths["smooth_mm"],
            min_height_mm=lengths["min_height_mm"],
            **stated,
        )


MOUSE_VIEW = CameraView()


@dataclass(frozen=True)
class Skeleton:
    """Kinematic tree of J joints: a straight home pose in top view, base at the origin.

    Frame of every joint: x forward (towards the head), y left, z up. The base joint, 0, has all six
    degrees of freedom. Parents precede their children.

    Attributes:
        name: of the animal.
        names: J names of the joints.
        parents: (J,) int64, -1 at the base.
        offsets: (J, 3) mm, from a joint's parent to the joint, in the parent's frame.
        rest: (J, 3, 3), rotates the parent's frame to the joint's at home.
        axes: (J, 3) bool, free rotations of the joint: roll, pitch and yaw (about x, y, z).
        limits: (J, 3, 2) rad, lowest and highest.
        surface: the [surface] table, see `Surface.of`.
        view: how the animal is viewed.
        table: the whole TOML.
    """

    name: str
    names: tuple[str, ...]
    parents: NDArray[np.int64]
    offsets: Array
    rest: Array
    axes: NDArray[np.bool_]
    limits: Array
    surface: dict[str, Any]
    view: CameraView
    table: dict[str, Any] = field(default_factory=dict, repr=False, compare=False)

    def __repr__(self) -> str:
        return (
            f"<Skeleton {self.name}: {self.n_joints} joints ({', '.join(self.names)}), "
            f"{self.length:.1f} mm long at home, {self.dof} degrees of freedom>"
        )

    @staticmethod
    def load(animal: str | Path) -> Skeleton:
        """The skeleton of a preset or of a user's TOML file.

        Args:
            animal: 'fish', 'mouse', 'hand', or the path of a file.

        Raises:
            LiexError: there is no such file, it is not TOML, or it does not describe a skeleton.
        """
        path = PRESETS / f"{animal}.toml"
        if not path.is_file():
            path = Path(animal)
        if not path.is_file():
            names = sorted(p.stem for p in PRESETS.glob("*.toml"))
            near = did_you_mean(animal, names, "did you mean '{}'?")
            hint = near or f"choose one of {', '.join(names)}, or give a .toml file"
            raise LiexError(f"there is no skeleton '{animal}': {hint}")
        with expecting(LiexError, f"the skeleton {path} should be a TOML file", ValueError):
            table = read_toml(path)
        return Skeleton.from_table(_with_mesh(table, path), str(path))

    @staticmethod
    def from_table(table: dict[str, Any], origin: str) -> Skeleton:
        """A skeleton from the content of its TOML.

        Args:
            table: content of the file.
            origin: name of the file in errors.

        Raises:
            LiexError: the error, and the joint that it is in.
        """
        joints = table.get("joints")
        surface = table.get("surface", {})
        refuse(
            LiexError,
            (
                not isinstance(table.get("name"), str)
                or not isinstance(joints, list)
                or not joints,
                f"{origin}: a skeleton needs a name and at least one [[joints]] table",
            ),
            (not isinstance(surface, dict), f"{origin}: [surface] is a table, got {surface!r}"),
        )
        rows = [_parsed_joint(joint, k, origin) for k, joint in enumerate(joints or [])]
        names, named_parents, offset, rest, free, limits_deg = zip(*rows, strict=True)
        if named_parents[0]:
            raise LiexError(
                f"{origin}: the first joint is the base and has no parent, got '{named_parents[0]}'"
            )
        for k, parent in enumerate(named_parents[1:], start=1):
            if parent not in names[:k]:
                raise LiexError(
                    f"{origin}: the parent '{parent}' of '{names[k]}' must be a joint listed "
                    "before it"
                )
        parents = [-1, *(names.index(parent) for parent in named_parents[1:])]
        if len(set(names)) != len(names):
            raise LiexError(f"{origin}: two joints have the same name; every joint needs its own")
        axes = np.array(free, bool)
        axes[0] = True
        offsets = np.array(offset, float)
        relative_size = round(float(_reach(parents, offsets).max()) / REFERENCE_MM, 6)
        if not 0.0 < relative_size < math.inf:
            raise LiexError(
                f"{origin}: a skeleton needs a second joint at some distance from the first one"
            )
        return Skeleton(
            name=table["name"],
            names=names,
            parents=np.array(parents, np.int64),
            offsets=offsets,
            rest=so3.exp(np.radians(rest)),
            axes=axes,
            limits=np.radians(limits_deg),
            surface=surface,
            view=CameraView.from_table(table.get("view", {}), relative_size, origin),
            table=table,
        )

    @property
    def n_joints(self) -> int:
        """Number of joints, end-effectors included."""
        return len(self.names)

    @property
    def is_chain(self) -> bool:
        """Whether each joint has only the next one as its child, as along a spine."""
        return bool(np.array_equal(self.parents, np.arange(-1, self.n_joints - 1)))

    @property
    def dof(self) -> int:
        """Degrees of freedom: six for the base and one for each free axis of the other joints."""
        return 6 + int(self.axes[1:].sum())

    @cached_property
    def edges(self) -> list[tuple[int, int]]:
        """The bones as (parent, child) pairs, J - 1 of them."""
        return [(int(p), j) for j, p in enumerate(self.parents) if p >= 0]

    @cached_property
    def reach(self) -> Array:
        """Lengths (J,) of the paths from the base to each joint at home, mm."""
        return _reach(self.parents, self.offsets)

    @cached_property
    def length(self) -> float:
        """Length of the longest path from the base at home, mm.

        The spine of a mouse, the body of a fish.
        """
        return float(self.reach.max())

    @cached_property
    def relative_size(self) -> float:
        """Home length over REFERENCE_MM, to six digits: 1 for the mouse."""
        return round(self.length / REFERENCE_MM, 6)

    @cached_property
    def next_joint(self) -> NDArray[np.int64]:
        """(J,) int64, each joint's first child, which its bone points to; -1 at an end-effector."""
        first = np.full(self.n_joints, -1, np.int64)
        for parent, child in reversed(self.edges):
            first[parent] = child
        return first

    @cached_property
    def tip(self) -> int:
        """The joint whose direction from the base is the animal's heading.

        The last of a chain, the base's first child in a tree.
        """
        return self.n_joints - 1 if self.is_chain else int(self.next_joint[0])

    @cached_property
    def solved(self) -> list[int]:
        """The joints that rotate and therefore need a regressor, base first."""
        return [0] + [j for j in range(1, self.n_joints) if self.axes[j].any()]


def _with_mesh(table: dict[str, Any], path: Path) -> dict[str, Any]:
    """The table of the TOML at `path`, in which a [surface] that names a mesh file contains the
    mesh itself.
    """
    surface = table.get("surface")
    if not isinstance(surface, dict) or "mesh" not in surface:
        return table

    name = surface["mesh"]
    unit_mm = surface.get("mesh_unit_mm", 1.0)
    if not isinstance(name, str) or not (_is_number(unit_mm) and unit_mm > 0):
        raise LiexError(
            f"{path}: [surface] mesh is the name of a file and mesh_unit_mm the mm that one of its "
            f"units is long, got {name!r} and {unit_mm!r}"
        )
    others = {key: value for key, value in surface.items() if key not in ("mesh", "mesh_unit_mm")}
    return table | {"surface": others | read_mesh(path.parent / name, float(unit_mm), str(path))}


def _reach(parents: Sequence[int] | NDArray[np.int64], offsets: Array) -> Array:
    """Lengths (J,) of the chains from the base to each joint, mm."""
    reach = np.zeros(len(offsets))
    for child in range(1, len(offsets)):
        reach[child] = reach[parents[child]] + np.linalg.norm(offsets[child])
    return reach


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < _HUGE


_Joint = tuple[str, str, list[float], list[float], list[bool], list[list[float]]]


def _parsed_joint(table: dict[str, Any], index: int, origin: str) -> _Joint:
    """Name, parent, offset mm, rest deg, axes and limits deg of one [[joints]] table."""
    name = table.get("name") if isinstance(table, dict) else None
    if not isinstance(name, str):
        raise LiexError(f"{origin}: joint {index} has no name")
    where = f"{origin}: joint '{name}'"
    for key in table:
        if key not in _JOINT_KEYS:
            raise LiexError(
                f"{where} has an unknown key '{key}'; use {', '.join(sorted(_JOINT_KEYS))}"
            )
    axes = table.get("axes", [])
    if not isinstance(axes, list) or any(axis not in AXES for axis in axes):
        raise LiexError(f"{where}: axes is a list out of {', '.join(AXES)}, got {axes}")
    limits_deg = table.get("limits_deg", {})
    usual = {axis: [-180.0, 180.0] if axis in axes else [0.0, 0.0] for axis in AXES}
    limits = (
        [limits_deg.get(axis, usual[axis]) for axis in AXES] if isinstance(limits_deg, dict) else []
    )
    if len(limits) != len(AXES) or not all(_is_range(pair) for pair in limits):
        raise LiexError(
            f"{where}: limits_deg gives [lowest, highest] degrees for each axis, got {limits_deg}"
        )
    return (
        name,
        table.get("parent", ""),
        _triple(table.get("offset_mm", [0.0, 0.0, 0.0]), f"{where}: offset_mm"),
        _triple(table.get("rest_deg", [0.0, 0.0, 0.0]), f"{where}: rest_deg"),
        [axis in axes for axis in AXES],
        limits,
    )


def _is_range(pair: Any) -> bool:
    return (
        isinstance(pair, list)
        and [_is_number(x) for x in pair] == [True, True]
        and pair[0] <= pair[1]
    )


def _triple(value: Any, where: str) -> list[float]:
    if not isinstance(value, list) or len(value) != 3 or not all(_is_number(x) for x in value):
        raise LiexError(f"{where} is a list of three numbers, got {value}")
    return [float(x) for x in value]


# Reading of a user's own triangle mesh: STL, OBJ, PLY or glTF, by Open3D.


_MOST_FACES = 4000


def read_mesh(path: Path, unit_mm: float, origin: str) -> dict[str, Any]:
    """The entries of a [surface] table for the mesh of a file.

    Simplified to the resolution of a depth image: at most 4000 triangles; vertices are rounded to a
    thousandth of a mm.

    Args:
        path: of the file (.stl, .obj, .ply, .glb ...).
        unit_mm: length of one unit of the file, mm.
        origin: name of the TOML in errors.

    Returns:
        vertices_mm, V triples of mm, and faces, F triples of vertex numbers.

    Raises:
        LiexError: there is no such file, no Open3D, or no triangles in it.
    """
    if not path.is_file():
        raise LiexError(
            f"{origin}: [surface] mesh should be a file next to the TOML, but there is no {path}"
        )
    try:
        import open3d
    except (ImportError, OSError) as error:
        raise LiexError(
            f"{origin}: reading {path.name} needs Open3D ({error}); {how_to_install('mesh')}"
        ) from None
    with open3d.utility.VerbosityContextManager(open3d.utility.VerbosityLevel.Error):
        mesh = open3d.io.read_triangle_mesh(path)
        mesh.merge_close_vertices(1e-9)
        mesh.remove_degenerate_triangles()
        if len(mesh.triangles) > _MOST_FACES:
            mesh = mesh.simplify_quadric_decimation(_MOST_FACES)
        mesh.remove_unreferenced_vertices()
    vertices = np.asarray(mesh.vertices) * unit_mm
    faces = np.asarray(mesh.triangles)
    if len(faces) < 4 or not np.isfinite(vertices).all():
        raise LiexError(
            f"{origin}: [surface] mesh should be a file with the triangles of a body, but {path} "
            f"contains {len(faces)} of them; export it as STL, OBJ or PLY"
        )
    return {"vertices_mm": np.round(vertices, 3).tolist(), "faces": faces.tolist()}
