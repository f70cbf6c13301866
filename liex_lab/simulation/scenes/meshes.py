"""Triangle meshes that scenes are put together from: boxes, height fields, walls, cables.

A still scene is the nearest surface along every ray, so that its parts need not be closed: they are
drawn one by one with a z-buffer (`render_still`). Lengths in mm, arena frame: z up from the floor
on which the animal stands.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from liex_lab.body._rasterizer_kernels import draw, to_depth
from liex_lab.body._skinning_kernels import tube_faces
from liex_lab.geometry import SE3
from liex_lab.optics.camera import Camera

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
    """Triangles of one thing, or of many things together.

    Attributes:
        vertices: (V, 3) mm, arena frame.
        faces: (F, 3) int32.
    """

    vertices: Array
    faces: NDArray[np.int32]


def joined(parts: Sequence[Mesh]) -> Mesh:
    """Several meshes as one.

    Args:
        parts: the meshes; none make an empty mesh.

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
    """Points turned about the vertical.

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
        yaw: its turn about the vertical, rad.

    Returns:
        The mesh.
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
        The mesh, two triangles a cell.
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
        slope: how far the rim lies outside the foot, mm.

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
    """Tubes along curves, one a frame.

    Args:
        curves: (n, R, 3) mm, their midlines.
        radius: mm, one or (n,).

    Returns:
        Vertices (n, V, 3) mm and the faces (F, 3) int32 that they share.
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
    """Ideal depth of things that stand still.

    Args:
        parts: what stands there; each within view of the camera, not behind it.
        camera: the ideal pinhole camera.
        T_camera_arena: carries the arena frame into the camera's.

    Returns:
        (H, W) float32 mm, 0 where there is nothing.
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
