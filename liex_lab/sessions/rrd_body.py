"""Rigid skinning of the animal's body surface for the Rerun replay.

Every triangle follows one joint, so a frame costs a few rigid transforms instead of a mesh. The
trunk at home pose is cut at its joints, and each vertex belongs to its nearest bone.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from liex_lab.body.pose import Pose
from liex_lab.body.skeleton import Skeleton
from liex_lab.body.surface import Surface
from liex_lab.estimation.session_shape import built
from liex_lab.geometry import SE3, so3
from liex_lab.tracking.track import Track

Array = NDArray[np.float64]

BODY = "arena/body"
_SKIN = [176, 190, 205, 150]


@dataclass(frozen=True)
class BodyPart:
    """A piece of the surface, in the frame of the joint that carries it.

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
    """The session's body: that of the shape it kept, or the average one at its best girth.

    Args:
        skeleton: the skeleton, which has a surface.
        animal: section `animal` of session.json.

    Returns:
        The surface, and the girth over what is usual for its length.
    """
    shape = animal.get("shape") or {}
    average = Surface.of(skeleton)
    girth = float(animal.get("girth", 1.0))
    if not shape.get("kept") or average.shape is None:
        return average, girth
    return built(skeleton, shape["width"], shape["height"], shape["places"]), girth


def body_parts(surface: Surface, girth: float = 1.0) -> list[BodyPart]:
    """Trunk of an animal at home pose, cut at its joints.

    Each part reaches one ring of faces farther, so that a bent body shows no gap.

    Args:
        surface: of the animal.
        girth: of the animal, over what is usual for its length.

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
        stream.log(
            f"{BODY}/{rr.escape_entity_path_part(skeleton.names[part.joint])}", mesh, static=True
        )
    return [part.joint for part in parts]


def send_body(stream: Any, track: Track, rows: slice, when: list[Any], carriers: list[int]) -> None:
    """Log where the body's parts are in some frames; without a pose they shrink to nothing.

    Args:
        stream: the Rerun stream.
        track: the track.
        rows: the frames, consecutive rows of the track.
        when: the time columns of these frames.
        carriers: the joints that carry a part, as `log_body` returned them.
    """
    part = track[rows]
    seen = part.posed
    pose = Pose(part.root, part.angles_rad, part.scale)[seen]
    frames = pose.frames(track.skeleton)
    for joint in carriers:
        place = np.zeros((len(seen), 3))
        xyzw = np.tile([0.0, 0.0, 0.0, 1.0], (len(seen), 1))
        place[seen] = frames.translation[:, joint] / 1000.0
        xyzw[seen] = np.roll(so3.quaternion(frames.rotation[:, joint]), -1, axis=-1)
        size = np.where(seen, np.nan_to_num(part.scale), 0.0)
        columns = rr.Transform3D.columns(
            translation=place, quaternion=xyzw, scale=np.repeat(size[:, None], 3, axis=1)
        )
        stream.send_columns(
            f"{BODY}/{rr.escape_entity_path_part(track.skeleton.names[joint])}", when, [*columns]
        )
