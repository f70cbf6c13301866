"""Triangle meshes as parts of scenes: boxes, height fields, walls, cables.

A still scene is the nearest surface along every ray, so its parts need not be closed: they are
rendered one by one with a z-buffer (`render_still`). Lengths in mm, arena frame: z up from the
floor below the animal.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from liex_lab.body._rasterizer_kernels import draw, to_depth
from liex_lab.body._skinning_kernels import tube_faces
from liex_lab.body.pose import Pose
from liex_lab.body.shape import BodyShape
from liex_lab.body.skeleton import Skeleton
from liex_lab.geometry import SE3
from liex_lab.optics.camera import Camera
from liex_lab.simulation.locomotion import smoothed

Array = NDArray[np.float64]
CABLE_SEGMENTS = 6

_BOX_CORNERS = np.array([[x, y, z] for z in (-1, 1) for y in (-1, 1) for x in (-1, 1)], float)
_BOX_FACES = np.array(
    [
        *[[0, 1, 3], [0, 3, 2], [4, 7, 5], [4, 6, 7], [0, 5, 1], [0, 4, 5]],
        *[[2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]],
    ],
    np.int32,
)


class Mesh(NamedTuple):
    """Triangles of one or more objects.

    Attributes:
        vertices: (V, 3) mm, arena frame.
        faces: (F, 3) int32.
    """

    vertices: Array
    faces: NDArray[np.int32]


def joined(parts: Sequence[Mesh]) -> Mesh:
    """Join several meshes.

    Args:
        parts: the meshes; may be empty.

    Returns:
        One mesh with all their triangles.
    """
    starts = np.cumsum([0, *(len(part.vertices) for part in parts)])
    return Mesh(
        np.concatenate([np.zeros((0, 3)), *(part.vertices for part in parts)]),
        np.concatenate(
            [np.zeros((0, 3), np.int32)]
            + [part.faces + np.int32(start) for part, start in zip(parts, starts, strict=False)]
        ),
    )


def turned(xy: Array, yaw: float) -> Array:
    """Points rotated about the vertical.

    Args:
        xy: (..., 2) mm.
        yaw: rad.

    Returns:
        (..., 2) mm.
    """
    c = np.cos(yaw)
    s = np.sin(yaw)
    return np.stack([c * xy[..., 0] - s * xy[..., 1], s * xy[..., 0] + c * xy[..., 1]], axis=-1)


def box(centre: Sequence[float] | Array, half: Sequence[float] | Array, yaw: float = 0.0) -> Mesh:
    """A block with sharp edges.

    Args:
        centre: (3,) mm.
        half: (3,) half its sides, mm.
        yaw: its rotation about the vertical, rad.
    """
    corners = _BOX_CORNERS * np.asarray(half, float)
    corners = np.concatenate([turned(corners[:, :2], yaw), corners[:, 2:]], axis=1)
    return Mesh(corners + np.asarray(centre, float), _BOX_FACES)


def field(x: Array, y: Array, heights: Array) -> Mesh:
    """A surface over a grid, such as an uneven floor.

    Args:
        x: (n,) mm.
        y: (m,) mm.
        heights: (m, n) mm.

    Returns:
        The mesh, two triangles per cell.
    """
    m, n = heights.shape
    at_x, at_y = np.meshgrid(x, y)
    first = (np.arange(m - 1)[:, None] * n + np.arange(n - 1)).ravel().astype(np.int32)
    lower = np.stack([first, first + 1, first + np.int32(n + 1)], axis=-1)
    upper = np.stack([first, first + np.int32(n + 1), first + np.int32(n)], axis=-1)
    vertices = np.stack([at_x, at_y, heights], axis=-1).reshape(-1, 3)
    return Mesh(vertices, np.concatenate([lower, upper]).astype(np.int32))


def wall(outline: Array, low: float, high: float, thick: float, slope: float = 0.0) -> Mesh:
    """A closed wall along an outline, with its rim on top.

    Args:
        outline: (n, 2) its inner foot, counter-clockwise about the origin of the outline, mm.
        low: height of its foot, mm.
        high: height of its rim, mm.
        thick: width of the rim, mm.
        slope: horizontal distance of the rim outside the foot, mm.

    Returns:
        The mesh: inner face, rim and outer face.
    """
    n = len(outline)
    middle = outline.mean(axis=0)
    outward = outline - middle
    reach = np.linalg.norm(outward, axis=1, keepdims=True)
    rings = [
        (outline, low),
        (middle + outward * (1.0 + slope / reach), high),
        (middle + outward * (1.0 + (slope + thick) / reach), high),
        (middle + outward * (1.0 + thick / reach), low),
    ]
    vertices = np.concatenate([np.column_stack([xy, np.full(n, z)]) for xy, z in rings])
    k = np.arange(n, dtype=np.int32)
    after = (k + 1) % n
    faces = []
    for ring in range(len(rings) - 1):
        a = np.int32(ring * n)
        b = np.int32((ring + 1) * n)
        faces += [
            np.stack([a + k, a + after, b + after], axis=-1),
            np.stack([a + k, b + after, b + k], axis=-1),
        ]
    return Mesh(vertices, np.concatenate(faces).astype(np.int32))


def cables(curves: Array, radius: Array | float) -> tuple[Array, NDArray[np.int32]]:
    """Tubes along curves, one per frame.

    Args:
        curves: (n, R, 3) mm, their midlines.
        radius: mm, one or (n,).

    Returns:
        Vertices (n, V, 3) mm and their shared faces (F, 3) int32.
    """
    n, rings, _ = curves.shape
    along = np.gradient(curves, axis=1)
    along /= np.maximum(np.linalg.norm(along, axis=-1, keepdims=True), 1e-9)
    side = np.cross(along, np.array([0.31, 0.95, 0.05]))
    side /= np.maximum(np.linalg.norm(side, axis=-1, keepdims=True), 1e-9)
    other = np.cross(along, side)
    phi = 2 * np.pi * np.arange(CABLE_SEGMENTS) / CABLE_SEGMENTS
    around = np.cos(phi)[:, None] * side[:, :, None] + np.sin(phi)[:, None] * other[:, :, None]
    thick = np.asarray(radius)[..., None, None, None]
    skin = (curves[:, :, None] + thick * around).reshape(n, -1, 3)
    vertices = np.concatenate([curves[:, :1], skin, curves[:, -1:]], axis=1)
    return vertices, tube_faces(rings, CABLE_SEGMENTS)


def render_still(parts: Sequence[Mesh], camera: Camera, T_camera_arena: SE3) -> NDArray[np.float32]:
    """Ideal depth of still objects.

    Args:
        parts: the objects; each within view of the camera, not behind it.
        camera: the ideal pinhole camera.
        T_camera_arena: transform from the arena frame into the camera frame.

    Returns:
        (H, W) float32 mm, 0 for nothing.
    """
    inverse = np.zeros((camera.height, camera.width))
    depth = np.empty((camera.height, camera.width), np.float32)
    for part in parts:
        draw(
            np.ascontiguousarray(part.vertices),
            part.faces,
            np.ascontiguousarray(T_camera_arena.rotation),
            T_camera_arena.translation,
            camera.fx,
            camera.fy,
            camera.cx,
            camera.cy,
            0.0,
            0.0,
            inverse,
        )
    to_depth(inverse, depth)
    return depth


# Equipment of animals: a head stage, and a cable from it to a commutator above the arena.


HEAD_STAGE_MM = (10.0, 8.0, 12.0)
PLUG_MM = (5.0, 5.0, 7.0)
_NECK = -2  # first joint of the head's bone
_AT_STATION = 0.83  # of the spine: behind the eyes
_RINGS = 30


def on_head(skeleton: Skeleton, pose: Pose, shape: BodyShape, girth: Array) -> SE3:
    """Pose of an object that is cemented to the skull.

    Args:
        skeleton: of the animal, a chain.
        pose: (n) arena frame.
        shape: its body, or n bodies.
        girth: (n,) factor of all lengths across the body.

    Returns:
        (n) T_arena_mount: x forward, z up from the skull, the origin on the skin.
    """
    frames = pose.frames(skeleton)
    stations = np.asarray(skeleton.surface["stations"], float)
    k = int(np.searchsorted(stations, _AT_STATION)) - 1
    share = (_AT_STATION - stations[k]) / (stations[k + 1] - stations[k])
    thick = (1.0 - share) * shape.half_height[..., k] + share * shape.half_height[..., k + 1]
    reach = np.linalg.norm(skeleton.offsets[1:], axis=1)
    ahead = (_AT_STATION * reach.sum() - reach[: _NECK + 1].sum()) * pose.scale
    local = np.stack([ahead, np.zeros_like(ahead), thick * girth], axis=-1)
    rotation = frames.rotation[:, _NECK]
    shift = np.einsum("nij,nj->ni", rotation, local)
    return SE3(rotation, frames.translation[:, _NECK] + shift)


def stage_on(mount: SE3, sides_mm: tuple[float, float, float]) -> tuple[Array, NDArray[np.int32]]:
    """A block on the head.

    Args:
        mount: (n) T_arena_mount.
        sides_mm: its length, width and height.

    Returns:
        Vertices (n, V, 3) mm, arena frame, and faces (F, 3).
    """
    half = 0.5 * np.array(sides_mm)
    block = box([0.0, 0.0, half[2] - 1.0], half)
    placed = np.einsum("nij,vj->nvi", mount.rotation, block.vertices) + mount.translation[:, None]
    return placed, block.faces


def tether(
    rng: np.random.Generator, mount: SE3, commutator: Array, thick_mm: float
) -> tuple[Array, NDArray[np.int32]]:
    """A flexible cable from the head to a commutator.

    Args:
        rng: random number generator.
        mount: (n) T_arena_mount.
        commutator: (3,) mm, arena frame.
        thick_mm: its diameter, mm.

    Returns:
        Vertices (n, V, 3) mm, arena frame, and faces (F, 3).
    """
    n = len(mount.translation)
    way = rng.uniform(-np.pi, np.pi) + np.cumsum(smoothed(rng.normal(0.0, 0.12, (n, 1)), 12.0))
    longest = float(np.linalg.norm(commutator - mount.translation, axis=-1).max())
    length = np.full(n, longest * rng.uniform(1.03, 1.08))
    return cables(_hanging(mount, commutator, length, way), 0.5 * thick_mm)


def _hanging(mount: SE3, commutator: Array, length: Array, way: Array) -> Array:
    """Midlines (n, R, 3) mm of cables that bow towards `way` (n,) rad; `length` (n,) mm."""
    start = mount.translation + PLUG_MM[2] * mount.rotation[..., 2]
    span = commutator - start
    apart = np.linalg.norm(span, axis=-1)
    bow = 2.0 / np.pi * np.sqrt(apart * np.maximum(length - apart, 0.0))
    side = np.stack([np.cos(way), np.sin(way), np.full(len(way), -0.15)], axis=-1)
    s = np.linspace(0.0, 1.0, _RINGS)[:, None]
    straight = start[:, None] + s * span[:, None]
    swing = (bow[:, None] * side)[:, None] * np.sin(np.pi * s)
    # stiff at the plug: it rises from the head before it bends
    stiff = (25.0 * mount.rotation[..., 2])[:, None] * (s * np.exp(-((s / 0.12) ** 2)) / 0.06)
    return np.asarray(straight + swing + stiff)


def draw_worn(
    rng: np.random.Generator,
    skeleton: Skeleton,
    pose: Pose,
    shape: BodyShape,
    girth: Array,
    share: float,
    per_session: int,
) -> tuple[Array, NDArray[np.int32], NDArray[np.bool_]]:
    """Head stages and cables of animals in independent postures, for training images.

    Half of the animals with equipment have a head stage of 6 to 14 mm a side, the others a plug and
    a cable of 2 to 5 mm to their own commutator.

    Args:
        rng: random number generator.
        skeleton: of the animals, a chain.
        pose: (n) arena frame.
        shape: (n) their bodies.
        girth: (n,) factors of all lengths across the bodies.
        share: share of animals with equipment.
        per_session: consecutive postures of one animal.

    Returns:
        Vertices (n, V, 3) mm, arena frame, faces (F, 3), and whether each posture has them (n,).
    """
    n = len(girth)
    each = np.arange(n) // per_session
    m = int(each[-1]) + 1
    wears = rng.random(m) < share
    tethered = rng.random(m) < 0.5
    blocks = rng.uniform([7.0, 6.0, 7.0], [14.0, 10.0, 14.0], (m, 3))
    sides = np.where(tethered[:, None], np.array(PLUG_MM), blocks)[each]
    mount = on_head(skeleton, pose, shape, girth)
    block = box([0.0, 0.0, 0.0], [0.5, 0.5, 0.5])
    local = block.vertices * sides[:, None]
    local[..., 2] += 0.5 * sides[:, None, 2] - 1.0
    stage = np.einsum("nij,nvj->nvi", mount.rotation, local) + mount.translation[:, None]
    away = rng.uniform(0.0, 160.0, m)[each]
    towards = rng.uniform(-np.pi, np.pi, n)
    high = rng.uniform(180.0, 320.0, m)[each]
    above = np.stack([away * np.cos(towards), away * np.sin(towards), high], axis=-1)
    commutator = mount.translation + above
    length = np.linalg.norm(above, axis=-1) * rng.uniform(1.0, 1.15, n)
    curves = _hanging(mount, commutator, length, rng.uniform(-np.pi, np.pi, n))
    cable, faces = cables(curves, 0.5 * rng.uniform(2.0, 5.0, m)[each])
    cable = np.where(tethered[each][:, None, None], cable, stage[:, :1])  # one point draws nothing
    joined_faces = np.concatenate([block.faces, faces + np.int32(len(block.vertices))])
    return np.concatenate([stage, cable], axis=1), joined_faces.astype(np.int32), wears[each]


def holder(commutator: Array) -> list[Mesh]:
    """The commutator and the arm that supports it above the arena.

    Args:
        commutator: (3,) mm, arena frame.
    """
    x, y, z = commutator
    return [
        box([x, y, z + 14.0], [11.0, 11.0, 14.0]),
        box([x, y + 400.0, z + 28.0], [7.0, 400.0, 7.0]),
    ]
