"""Scene and animal body in a Rerun replay: camera, arena, zones, region, fixtures, skinned surface.

The scene is static. Every triangle of the body follows one joint, so a frame costs a few rigid
transforms instead of a mesh: the trunk at home pose is cut at its joints, and each vertex belongs
to its nearest bone.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from itertools import cycle
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from liex_lab.actions import vocabulary
from liex_lab.body.pose import Pose
from liex_lab.body.skeleton import Skeleton
from liex_lab.body.surface import Surface
from liex_lab.estimation.session_shape import built
from liex_lab.geometry import SE3, so3
from liex_lab.optics.camera import Camera
from liex_lab.sessions.provenance import Provenance
from liex_lab.sessions.rrd_depth import IMAGE, MM_PER_UNIT
from liex_lab.tracking.track import Track

if TYPE_CHECKING:
    from liex_lab.scene.scene import Scene
    from liex_lab.tables.rows import Rows


Array = NDArray[np.float64]

OVERLAY: Final = f"{IMAGE}/overlay"
FLOOR: Final = "arena/floor"
BODY: Final = "arena/body"
PALETTE = tuple(int(colour[1:], 16) for colour in vocabulary.PALETTE)
_WALL = 0x9AA0A6
_GREY: Final = [154, 160, 166, 255]
_PURPLE: Final = [170, 51, 119, 255]
_SKIN = [176, 190, 205, 150]


def rgba(colours: Iterable[int]) -> NDArray[np.uint32]:
    """0xRRGGBB as uint32 colours, which Rerun cannot confuse with a list of channels."""
    return np.array([colour << 8 | 0xFF for colour in colours], np.uint32)


def log_camera(stream: Any, camera: Camera, T_arena_camera: SE3) -> None:
    """Log the arena's axes, the camera's pose in it and its intrinsics."""
    pose = rr.Transform3D(
        translation=T_arena_camera.translation / MM_PER_UNIT, mat3x3=T_arena_camera.rotation
    )
    lens = rr.Pinhole(
        image_from_camera=camera.matrix,
        resolution=[camera.width, camera.height],
        camera_xyz=rr.ViewCoordinates.RDF,
        image_plane_distance=0.05,
    )
    stream.log("arena", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    stream.log("arena/camera", pose, static=True)
    stream.log(IMAGE, lens, static=True)


def log_outlines(stream: Any, origin: Provenance) -> None:
    """Log walls and zones, on the floor and over the depth image."""
    walls = origin.arena.outline_mm()
    drawn = [("walls", "", walls, _WALL)] if len(walls) else []
    for zone, colour in zip(origin.zones, cycle(PALETTE), strict=False):
        part = f"zones/{rr.escape_entity_path_part(zone.name)}"
        drawn.append((part, zone.name, zone.outline_mm(), colour))
    for part, name, outline, colour in drawn:
        ring = np.column_stack([outline, np.zeros(len(outline))])[[*range(len(outline)), 0]]
        look: dict[str, Any] = {"colors": rgba([colour]), "labels": [name] if name else None}
        on_floor = rr.LineStrips3D([ring / MM_PER_UNIT], radii=0.001, **look)
        stream.log(f"{FLOOR}/{part}", on_floor, static=True)
        uv_px = origin.camera.project(origin.T_arena_camera.inverse() @ ring) + 0.5
        if np.isfinite(uv_px).all():
            in_image = rr.LineStrips2D([uv_px], radii=rr.Radius.ui_points(1.0), **look)
            stream.log(f"{OVERLAY}/{part}", in_image, static=True)


def log_surroundings(stream: Any, scene: Scene) -> None:
    """Log the region, outside of which nothing is measured, and the fixtures on the floor."""
    if scene.region_px:
        ring = np.array([*scene.region_px, scene.region_px[0]]) + 0.5
        outline = rr.LineStrips2D(
            [ring], radii=rr.Radius.ui_points(1.0), colors=[_GREY], labels=["region"]
        )
        stream.log(f"{OVERLAY}/region", outline, static=True)
    if scene.fixtures:
        tops = np.array([[*one.centre_mm, one.height_mm] for one in scene.fixtures])
        labels = [f"fixture, {one}" for one in scene.fixtures]
        things = rr.Points3D(tops / MM_PER_UNIT, radii=0.003, colors=[_GREY], labels=labels)
        stream.log(f"{FLOOR}/fixtures", things, static=True)


def log_hidden_places(stream: Any, rows: Rows) -> None:
    """Log the last position of the animal before each time it was hidden, with the times."""
    gaps = rows.gaps()
    hidden = (gaps["reason"] == "hidden") & np.isfinite(gaps["x_mm"])
    if not hidden.any():
        return
    x, y, start, stop = (gaps[name][hidden] for name in ("x_mm", "y_mm", "start_s", "stop_s"))
    labels = [f"hidden {a:.1f} to {b:.1f} s" for a, b in zip(start, stop, strict=True)]
    places = np.column_stack([x, y, np.zeros(len(x))]) / MM_PER_UNIT
    points = rr.Points3D(places, radii=0.004, colors=[_PURPLE], labels=labels)
    stream.log(f"{FLOOR}/hidden", points, static=True)


@dataclass(frozen=True)
class BodyPart:
    """A piece of the surface, in the frame of its joint.

    Attributes:
        joint: the joint's index.
        vertices: (V, 3) mm at scale 1.
        faces: (F, 3) vertex indices.
        normals: (V, 3) unit vectors.
    """

    joint: int
    vertices: Array
    faces: NDArray[np.int64]
    normals: Array


def body_of(skeleton: Skeleton, animal: Mapping[str, Any]) -> tuple[Surface, float]:
    """The session's body: the fitted shape if kept, or the average one at its best girth.

    Args:
        skeleton: the skeleton, which has a surface.
        animal: section `animal` of session.json.

    Returns:
        The surface, and the girth relative to the usual one for its length.
    """
    shape = animal.get("shape") or {}
    average = Surface.of(skeleton)
    girth = float(animal.get("girth", 1.0))
    if not shape.get("kept") or average.shape is None:
        return average, girth
    return built(skeleton, shape["width"], shape["height"], shape["places"]), girth


def body_parts(surface: Surface, girth: float = 1.0) -> list[BodyPart]:
    """Trunk of an animal at home pose, cut at its joints.

    Each part is extended by one ring of faces, so that a bent body shows no gap.

    Args:
        surface: of the animal.
        girth: of the animal, relative to the usual one for its length.

    Returns:
        One part per joint that carries any face.
    """
    skeleton = surface.skeleton
    home = Pose.home(skeleton)
    faces = surface.faces[: surface.n_trunk_faces].astype(np.int64)
    vertices = surface.vertices(home, girth=girth, parallel=False)
    frames = home.frames(skeleton)
    normals = _normals(vertices, faces)
    carrier = _carriers(skeleton, vertices)
    parts = []
    for joint in np.unique(carrier[faces]).tolist():
        own = faces[(carrier[faces] == joint).any(axis=1)]
        used, renumbered = np.unique(own, return_inverse=True)
        into = SE3(frames.rotation[joint], frames.translation[joint]).inverse()
        parts.append(
            BodyPart(
                int(joint),
                into @ vertices[used],
                renumbered.reshape(own.shape),
                normals[used] @ into.rotation.T,
            )
        )
    return parts


def _carriers(skeleton: Skeleton, vertices: Array) -> NDArray[np.int64]:
    """(V,) for each vertex the parent joint of the nearest bone at home pose."""
    home = Pose.home(skeleton).joints(skeleton)
    off = []
    for parent, child in skeleton.edges:
        along = home[child] - home[parent]
        share = np.clip(
            (vertices - home[parent]) @ along / max(float(along @ along), 1e-12), 0.0, 1.0
        )
        off.append(np.linalg.norm(vertices - home[parent] - share[:, None] * along, axis=1))
    return np.array([parent for parent, _ in skeleton.edges], np.int64)[np.argmin(off, axis=0)]


def _normals(vertices: Array, faces: NDArray[np.int64]) -> Array:
    """(V, 3) unit normals: the mean of the faces around each vertex, weighted by their areas."""
    corners = vertices[faces]
    of_faces = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    out = np.zeros(vertices.shape)
    for k in range(3):
        np.add.at(out, faces[:, k], of_faces)
    return out / np.maximum(np.linalg.norm(out, axis=1, keepdims=True), 1e-12)


def log_body(stream: Any, skeleton: Skeleton, animal: Mapping[str, Any]) -> list[int]:
    """Log the body's parts once; returns the joints that carry one.

    Args:
        stream: the Rerun stream.
        skeleton: the skeleton, which has a surface.
        animal: section `animal` of session.json, see `body_of`.
    """
    parts = body_parts(*body_of(skeleton, animal))
    for part in parts:
        mesh = rr.Mesh3D(
            vertex_positions=part.vertices / 1000.0,
            triangle_indices=part.faces,
            vertex_normals=part.normals,
            albedo_factor=_SKIN,
        )
        stream.log(_body_entity(skeleton, part.joint), mesh, static=True)
    return [part.joint for part in parts]


def body_columns(track: Track, carriers: list[int]) -> Iterator[tuple[str, Any]]:
    """Entity and columns of each part of the body in some frames; its scale is 0 without a pose.

    Args:
        track: the frames.
        carriers: the joints that carry a part, from `log_body`.
    """
    posed = track.posed
    frames = Pose(track.root, track.angles_rad, track.scale)[posed].frames(track.skeleton)
    size = np.where(posed, np.nan_to_num(track.scale), 0.0)
    for joint in carriers:
        place = np.zeros((len(posed), 3))
        xyzw = np.tile([0.0, 0.0, 0.0, 1.0], (len(posed), 1))
        place[posed] = frames.translation[:, joint] / MM_PER_UNIT
        xyzw[posed] = np.roll(so3.quaternion(frames.rotation[:, joint]), -1, axis=-1)
        columns = rr.Transform3D.columns(
            translation=place, quaternion=xyzw, scale=np.repeat(size[:, None], 3, axis=1)
        )
        yield _body_entity(track.skeleton, joint), columns


def _body_entity(skeleton: Skeleton, joint: int) -> str:
    return f"{BODY}/{rr.escape_entity_path_part(skeleton.names[joint])}"


# Size of a skeleton in replays, so that no animal vanishes behind its own joints.


_MOST_MM = 3.0
_OF_BONE = 0.3
_MOST_PT = 3.5
_LEAST_PT = 1.5


def dot_mm(skeleton: Skeleton) -> float:
    """Radius of a joint in space, mm: 0.3 of the median bone of the skeleton, at most 3."""
    bones = np.linalg.norm(skeleton.offsets[1:], axis=1)
    return float(min(_MOST_MM, _OF_BONE * np.median(bones)))


def dot_pt(skeleton: Skeleton) -> float:
    """Radius of a joint over an image, in screen points: at most 3.5, at least 1.5."""
    return max(_LEAST_PT, _MOST_PT * float(np.sqrt(dot_mm(skeleton) / _MOST_MM)))
