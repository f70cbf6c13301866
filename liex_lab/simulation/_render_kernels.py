"""Depth renderer: floor and wall by ray casting, meshes by z-buffer, then the sensor model.

The inverse depth 1 / z of a plane is linear in the pixel, a u + b v + c, so that floor and wall are
two planes per image; meshes keep the largest 1 / z at each pixel's centre. `draw_frames` makes
whole depth images and patches of them, on request with the background that is learned from many.
"""

from typing import Any, NamedTuple

import numpy as np

from liex_lab.body._rasterizer_kernels import draw_projected, project
from liex_lab.runtime.kernels import kernel
from liex_lab.simulation._sensor_kernels import (
    BACKGROUND,
    NOTHING,
    STILL,
    UNIT,
    normal,
    sense,
    smooth_field,
)

# columns of a ray-cast background: a, b, c of the floor's 1 / z; distance of the camera from it and
# its unevenness, mm; a, b, c of a wall's 1 / z; the wall's distance from the camera's foot, 0
# without one, its height, and depth and extent of the rounding that multiple reflections leave at
# its foot, mm
FLOOR = slice(0, 3)
WALL = slice(5, 8)
(_FLOOR_U, _FLOOR_V, _FLOOR_1, HEIGHT, ROUGH) = range(5)
(_WALL_U, _WALL_V, _WALL_1, WALL_DISTANCE, WALL_HEIGHT, WALL_ROUNDING, WALL_REACH) = range(5, 12)
N_GROUND = 12
FARTHEST_MM = 4500.0  # range of the sensors


class SensorNoise(NamedTuple):
    """A sensor and its noise in n images.

    Attributes:
        parameters: (n, N_PARAMETERS) of the sensor.
        seed: (n,) uint64 of the noise, not 0.
        table: (2^13,) float32 normal quantiles.
    """

    parameters: Any
    seed: Any
    table: Any


class PatchCamera(NamedTuple):
    """The cameras of n images or patches of images.

    Attributes:
        intrinsics: (n, 4) fx, fy, cx, cy, px.
        size: (n, 2) int64 width and height of the whole image, px; pixels outside are unread.
        origin: (n, 2) int64 pixel (u, v) of the whole image at (0, 0) of the patch.
        rotation: (n, 3, 3) of T_camera_arena.
        translation: (n, 3) of T_camera_arena, mm.
    """

    intrinsics: Any
    size: Any
    origin: Any
    rotation: Any
    translation: Any


class Backdrop(NamedTuple):
    """The still scene of n images.

    Attributes:
        stills: (E, H, W) float32 mm, ideal depth, 0 = nothing.
        epoch: (n,) int64 index of the still scene of each image; -1: floor and wall are ray-cast.
        ground: (n, N_GROUND) float64 floor and wall.
    """

    stills: Any
    epoch: Any
    ground: Any


class Parts(NamedTuple):
    """P meshes in n images, one after another.

    Attributes:
        vertices: (n, V, 3) mm, arena frame.
        faces: (F, 3) int32 triangles, indices within their own mesh.
        spans: (P + 1, 2) int64 first vertex and first face of each mesh, and their numbers.
        shown: (n, P) bool, whether it exists.
        label: (P,) uint8 kind of its pixels, ANIMAL or OBJECT.
    """

    vertices: Any
    faces: Any
    spans: Any
    shown: Any
    label: Any


@kernel()
def floor_and_wall(u0, v0, size, ground, uneven, depth, what):
    """Ideal depth and kind of a patch (H, W) of a floor with at most one straight wall.

    Args:
        u0: column of the patch's first pixel in the whole image.
        v0: its row.
        size: (2,) width and height of the whole image, px; pixels outside are unread.
        ground: (N_GROUND,).
        uneven: (H, W) heights of the floor, over `ground[ROUGH]`.
        depth: (H, W) float32 mm, output, 0 = nothing.
        what: (H, W) uint8 kinds, output, NOTHING or STILL.
    """
    rows, columns = depth.shape
    for r in range(rows):
        v = v0 + r
        for c in range(columns):
            u = u0 + c
            depth[r, c] = 0.0
            what[r, c] = NOTHING
            floor = ground[_FLOOR_U] * u + ground[_FLOOR_V] * v + ground[_FLOOR_1]
            outside = u < 0 or v < 0 or u >= size[0] or v >= size[1]
            if outside or floor * FARTHEST_MM < 1.0:
                continue
            t = 1.0 / floor
            raised = ground[ROUGH] * uneven[r, c]
            wall = ground[_WALL_U] * u + ground[_WALL_V] * v + ground[_WALL_1]
            if ground[WALL_DISTANCE] > 0.0:
                beyond = ground[WALL_DISTANCE] * (wall * t - 1.0)
                if beyond > 0.0:
                    if ground[HEIGHT] * (1.0 - floor / wall) < ground[WALL_HEIGHT]:
                        depth[r, c] = 1.0 / wall
                        what[r, c] = STILL
                    continue
                raised += ground[WALL_ROUNDING] * np.exp(beyond / ground[WALL_REACH])
            depth[r, c] = t - raised * t / ground[HEIGHT]
            what[r, c] = STILL


@kernel()
def draw_onto(vertices, faces, rotation, translation, intrinsics, u0, v0, label, depth, what):
    """Rasterise a mesh into an image or patch, within the mesh's bounding box only.

    Args:
        vertices: (V, 3) mm.
        faces: (F, 3) int32 triangles.
        rotation: (3, 3) from the vertices' frame into the camera frame.
        translation: (3,) likewise, mm.
        intrinsics: (4,) fx, fy, cx, cy, px.
        u0: column of the first pixel in the whole image.
        v0: its row.
        label: kind of the rendered pixels.
        depth: (H, W) float32 mm, changed in place.
        what: (H, W) uint8 kinds, changed in place.
    """
    projected = np.empty((len(vertices), 3))
    project(vertices, rotation, translation, intrinsics, projected)
    low_u = low_v = 1e9
    high_u = high_v = -1e9
    for i in range(len(vertices)):
        if projected[i, 2] > 0.0:
            low_u = min(low_u, projected[i, 0])
            high_u = max(high_u, projected[i, 0])
            low_v = min(low_v, projected[i, 1])
            high_v = max(high_v, projected[i, 1])
    left = max(0, int(low_u) - int(u0) - 1)
    top = max(0, int(low_v) - int(v0) - 1)
    right = min(depth.shape[1], int(high_u) - int(u0) + 2)
    bottom = min(depth.shape[0], int(high_v) - int(v0) + 2)
    if low_u > high_u or left >= right or top >= bottom:
        return
    inverse = np.zeros((bottom - top, right - left))
    draw_projected(projected, faces, u0 + left, v0 + top, inverse)
    for r in range(inverse.shape[0]):
        for c in range(inverse.shape[1]):
            if inverse[r, c] > 0.0:
                z = 1.0 / inverse[r, c]
                if depth[top + r, left + c] == 0.0 or z < depth[top + r, left + c]:
                    depth[top + r, left + c] = z
                    what[top + r, left + c] = label


@kernel(nogil=True)
def draw_frames(parts, cameras, backdrop, noises, out, learned, start, stop):
    """Render depth images, or patches of them.

    Args:
        parts: `Parts`, the objects that are not part of the still scene.
        cameras: `PatchCamera`.
        backdrop: `Backdrop`.
        noises: `SensorNoise`.
        out: (n, H, W) uint16 in steps of the sensor's unit, output, 0 = unread.
        learned: (n, H, W) uint16 likewise, output, the still scene as learned from many images; or
            (0, H, W).
        start: first item to process, see `in_parallel`.
        stop: the item after the last.
    """
    rows, columns = out.shape[1:]
    table = noises.table
    for i in range(start, stop):
        sensor = noises.parameters[i]
        size = cameras.size[i]
        intrinsics = cameras.intrinsics[i]
        u0 = float(cameras.origin[i, 0])
        v0 = float(cameras.origin[i, 1])
        state = np.array([noises.seed[i]], np.uint64)
        field = np.empty((rows, columns), np.float32)
        depth = np.empty((rows, columns), np.float32)
        what = np.empty((rows, columns), np.uint8)
        if backdrop.epoch[i] < 0:
            smooth_field(state, table, 24.0, field)
            floor_and_wall(u0, v0, size, backdrop.ground[i], field, depth, what)
        else:
            still = backdrop.stills[backdrop.epoch[i]]
            for r in range(rows):
                for c in range(columns):
                    depth[r, c] = still[r, c]
                    what[r, c] = STILL if still[r, c] > 0.0 else NOTHING
        if len(learned) > 0:
            # a background is learned from many frames: low noise, with small smooth errors
            smooth_field(state, table, 9.0, field)
            for r in range(rows):
                for c in range(columns):
                    error = sensor[BACKGROUND] * (0.4 * field[r, c] + 0.3 * normal(state, table))
                    z = (depth[r, c] + error) / sensor[UNIT]
                    learned[i, r, c] = int(z + 0.5) if depth[r, c] > 0.0 else 0
        for p in range(len(parts.label)):
            if parts.shown[i, p]:
                draw_onto(
                    parts.vertices[i, parts.spans[p, 0] : parts.spans[p + 1, 0]],
                    parts.faces[parts.spans[p, 1] : parts.spans[p + 1, 1]],
                    cameras.rotation[i],
                    cameras.translation[i],
                    intrinsics,
                    u0,
                    v0,
                    parts.label[p],
                    depth,
                    what,
                )
        inside = u0 >= 0 and v0 >= 0 and u0 + columns <= size[0] and v0 + rows <= size[1]
        for r in range(0 if inside else rows):
            for c in range(columns):
                if u0 + c < 0 or v0 + r < 0 or u0 + c >= size[0] or v0 + r >= size[1]:
                    depth[r, c] = 0.0
                    what[r, c] = NOTHING
        sense(
            depth,
            what,
            sensor,
            intrinsics[0],
            intrinsics[2] - u0,
            intrinsics[3] - v0,
            state,
            table,
            field,
            out[i],
        )
