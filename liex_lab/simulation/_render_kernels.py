"""Depth renderer: floor and wall by ray casting, meshes by z-buffer, then the sensor model.

The ray (x, y, 1) of a pixel, rotated into the arena frame, meets the floor at depth height / -d_z
and a vertical wall at distance / (outward . d_xy); meshes keep the largest 1 / z at each pixel's
centre. `draw_windows` makes training patches with their learned background, `draw_frames` whole
depth images, `draw_hands` images and patches of hands.
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

# columns of a straight wall: its outward normal in the floor; its distance from the arena's origin,
# mm, 0 for no wall; height, mm; depth and extent of the rounding that multiple reflections leave at
# its foot, mm
(
    WALL_X,
    WALL_Y,
    WALL_DISTANCE,
    WALL_HEIGHT,
    WALL_ROUNDING,
    WALL_REACH,
) = range(6)


WALL_COLUMNS = 6


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
    """

    intrinsics: Any
    size: Any
    origin: Any


class Part(NamedTuple):
    """One object in n images.

    Attributes:
        vertices: (n, V, 3) mesh, mm.
        faces: (F, 3) int32 its triangles.
        shown: (n,) bool, whether it exists.
        label: kind of its pixels, ANIMAL or OBJECT.
    """

    vertices: Any
    faces: Any
    shown: Any
    label: Any


def part_of(vertices: Any, faces: Any, label: int, shown: Any = None) -> Part:
    """A `Part` with arrays as the kernels need them; None shows it in all images."""
    n = len(vertices)
    return Part(
        np.ascontiguousarray(vertices, float),
        np.ascontiguousarray(faces, np.int32),
        np.ones(n, np.bool_) if shown is None else np.ascontiguousarray(shown, np.bool_),
        label,
    )


@kernel()
def floor_and_wall(u0, v0, size, intrinsics, rotation, height, wall, uneven, rough, depth, what):
    """Ideal depth and kind of a patch (H, W) on a floor with at most one straight wall.

    Args:
        u0: column of the patch's first pixel in the whole image.
        v0: its row.
        size: (2,) width and height of the whole image, px; pixels outside are unread.
        intrinsics: (4,) fx, fy, cx, cy, px.
        rotation: (3, 3) of T_arena_camera.
        height: of the camera above the floor, mm.
        wall: (WALL_COLUMNS,).
        uneven: (H, W) heights of the floor, over `rough`.
        rough: height of the floor per unit of `uneven`, mm.
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
            if u < 0 or v < 0 or u >= size[0] or v >= size[1]:
                continue
            x = (u - intrinsics[2]) / intrinsics[0]
            y = (v - intrinsics[3]) / intrinsics[1]
            dx = rotation[0, 0] * x + rotation[0, 1] * y + rotation[0, 2]
            dy = rotation[1, 0] * x + rotation[1, 1] * y + rotation[1, 2]
            dz = rotation[2, 0] * x + rotation[2, 1] * y + rotation[2, 2]
            if dz > -1e-3:
                continue
            t = -height / dz
            raised = rough * uneven[r, c]
            if wall[WALL_DISTANCE] > 0.0:
                across = wall[WALL_X] * dx + wall[WALL_Y] * dy
                beyond = across * t - wall[WALL_DISTANCE]
                if beyond > 0.0:
                    t = wall[WALL_DISTANCE] / across
                    if height + t * dz < wall[WALL_HEIGHT]:
                        depth[r, c] = t
                        what[r, c] = STILL
                    continue
                raised += wall[WALL_ROUNDING] * np.exp(beyond / wall[WALL_REACH])
            depth[r, c] = t + raised / dz
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
    low_u = 1e9
    low_v = 1e9
    high_u = -1e9
    high_v = -1e9
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


@kernel()
def _expose(
    parts, i, rotation, translation, cameras, noises, state, forget, field, depth, what, out
):
    """Rasterise the objects that exist in image i onto its still scene, and let the sensor read it.

    Args:
        parts: tuple of `Part`.
        i: the image.
        rotation: (3, 3) from the parts' frame into the camera frame.
        translation: (3,) likewise, mm.
        cameras: `PatchCamera`.
        noises: `SensorNoise`.
        state: (1,) uint64, of the random numbers.
        forget: whether pixels outside the whole image have no kind either.
        field: (H, W) float32, overwritten.
        depth: (H, W) float32 mm, changed in place.
        what: (H, W) uint8 kinds, changed in place.
        out: (H, W) uint16, output.
    """
    intrinsics = cameras.intrinsics[i]
    size = cameras.size[i]
    u0 = float(cameras.origin[i, 0])
    v0 = float(cameras.origin[i, 1])
    for part in parts:
        if part.shown[i]:
            draw_onto(
                part.vertices[i],
                part.faces,
                rotation,
                translation,
                intrinsics,
                u0,
                v0,
                part.label,
                depth,
                what,
            )
    rows, columns = depth.shape
    inside = u0 >= 0 and v0 >= 0 and u0 + columns <= size[0] and v0 + rows <= size[1]
    for r in range(0 if inside else rows):
        for c in range(columns):
            if u0 + c < 0 or v0 + r < 0 or u0 + c >= size[0] or v0 + r >= size[1]:
                depth[r, c] = 0.0
                what[r, c] = NOTHING if forget else what[r, c]
    sense(
        depth,
        what,
        noises.parameters[i],
        intrinsics[0],
        intrinsics[2] - u0,
        intrinsics[3] - v0,
        state,
        noises.table,
        field,
        out,
    )


@kernel(nogil=True)
def draw_windows(
    parts,
    cameras,
    R_arena_camera,
    height,
    walls,
    rough,
    noises,
    depth_out,
    background_out,
    start,
    stop,
):
    """Render training patches and their learned backgrounds.

    Args:
        parts: tuple of `Part` in the arena frame.
        cameras: `PatchCamera`.
        R_arena_camera: (n, 3, 3) rotation of the camera.
        height: (n,) of the camera above the floor, mm.
        walls: (n, WALL_COLUMNS) the wall.
        rough: (n,) unevenness of the floor, mm.
        noises: `SensorNoise`.
        depth_out: (n, S, S) uint16 in steps of the sensor's unit, output, 0 = unread.
        background_out: (n, S, S) uint16 likewise, the still scene as learned from many frames.
        start: first item to process, see `in_parallel`.
        stop: the item after the last.
    """
    shape = depth_out.shape[1:]
    table = noises.table
    for i in range(start, stop):
        sensor = noises.parameters[i]
        state = np.array([noises.seed[i]], np.uint64)
        field = np.empty(shape, np.float32)
        depth = np.empty(shape, np.float32)
        what = np.empty(shape, np.uint8)
        smooth_field(state, table, 24.0, field)
        floor_and_wall(
            cameras.origin[i, 0],
            cameras.origin[i, 1],
            cameras.size[i],
            cameras.intrinsics[i],
            R_arena_camera[i],
            height[i],
            walls[i],
            field,
            rough[i],
            depth,
            what,
        )
        smooth_field(state, table, 9.0, field)
        for r in range(shape[0]):
            for c in range(shape[1]):
                # a background is learned from many frames: low noise, with small smooth errors
                error = sensor[BACKGROUND] * (0.4 * field[r, c] + 0.3 * normal(state, table))
                background_out[i, r, c] = (
                    int((depth[r, c] + error) / sensor[UNIT] + 0.5) if depth[r, c] > 0.0 else 0
                )
        rotation = np.ascontiguousarray(R_arena_camera[i].T)
        translation = -height[i] * rotation[:, 2]
        _expose(
            parts,
            i,
            rotation,
            translation,
            cameras,
            noises,
            state,
            False,
            field,
            depth,
            what,
            depth_out[i],
        )


@kernel(nogil=True)
def draw_frames(still, parts, rotation, translation, cameras, noises, out, start, stop):
    """Render full frames of one scene.

    Args:
        still: (H, W) float32 mm, the ideal still scene, 0 = nothing.
        parts: tuple of `Part` in the arena frame.
        rotation: (3, 3) of T_camera_arena.
        translation: (3,) of T_camera_arena, mm.
        cameras: `PatchCamera`, the whole image n times.
        noises: `SensorNoise`.
        out: (n, H, W) uint16 in steps of the sensor's unit, output, 0 = unread.
        start: first item to process, see `in_parallel`.
        stop: the item after the last.
    """
    for i in range(start, stop):
        state = np.array([noises.seed[i]], np.uint64)
        what = np.where(still > 0, np.uint8(STILL), np.uint8(NOTHING))
        field = np.empty(still.shape, np.float32)
        _expose(
            parts,
            i,
            rotation,
            translation,
            cameras,
            noises,
            state,
            False,
            field,
            still.copy(),
            what,
            out[i],
        )


@kernel(nogil=True)
def draw_hands(parts, walls, cameras, noises, out, start, stop):
    """Render depth images or patches of hands.

    Args:
        parts: tuple of `Part` in the camera frame: bodies behind the hands, objects next to them,
            arms and hands.
        walls: (n, 4) a, b, c of 1 / z = a u + b v + c behind everything, and its unevenness, mm; c
            = 0: nothing in range.
        cameras: `PatchCamera`.
        noises: `SensorNoise`.
        out: (n, H, W) uint16 mm, output, 0 = unread.
        start: first item to process, see `in_parallel`.
        stop: the item after the last.
    """
    shape = out.shape[1:]
    for i in range(start, stop):
        wall = walls[i]
        origin = cameras.origin[i]
        state = np.array([noises.seed[i]], np.uint64)
        field = np.empty(shape, np.float32)
        depth = np.empty(shape, np.float32)
        what = np.empty(shape, np.uint8)
        smooth_field(state, noises.table, 24.0, field)
        for r in range(shape[0]):
            for c in range(shape[1]):
                inverse = wall[0] * (origin[0] + c) + wall[1] * (origin[1] + r) + wall[2]
                there = inverse > 1.0 / 4500.0
                depth[r, c] = 1.0 / inverse + wall[3] * field[r, c] if there else 0.0
                what[r, c] = STILL if there else NOTHING
        _expose(
            parts,
            i,
            np.eye(3),
            np.zeros(3),
            cameras,
            noises,
            state,
            True,
            field,
            depth,
            what,
            out[i],
        )
