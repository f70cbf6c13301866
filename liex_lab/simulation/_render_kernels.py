"""Depth renderer: floor and wall by ray casting, meshes by z-buffer, then the sensor model.

A ray (x, y, 1) of a pixel, turned into the arena frame, meets the floor at depth height / -d_z and
a vertical wall at distance / (outward . d_xy); meshes keep the largest 1 / z under each pixel's
centre. `draw_windows` makes training patches with their learned background, `frames_parallel` whole
pictures.
"""

from __future__ import annotations

import numpy as np
from numba import njit, prange

from liex_lab.body._rasterizer_kernels import draw
from liex_lab.simulation._sensor_kernels import (
    ANIMAL,
    BACKGROUND,
    NOTHING,
    OBJECT,
    STILL,
    UNIT,
    normal,
    sense,
    smooth_field,
)

# columns of a wall: its outward normal in the floor (2), distance from the arena's origin, height,
# depth of the rounding that multiple reflections leave at its foot and how far that reaches, all
# mm; distance 0 is no wall
WALL_COLUMNS = 6


@njit(cache=True)
def floor_and_wall(u0, v0, picture, intrinsics, rotation, height, wall, uneven, rough, depth, what):
    """Ideal depth and kind of a patch (H, W) on a floor with at most one straight wall.

    Args:
        u0: column of the patch's first pixel in the whole picture.
        v0: its row.
        picture: (2,) width and height of the whole picture, px; outside it nothing is read.
        intrinsics: (4,) fx, fy, cx, cy, px.
        rotation: (3, 3) of T_arena_camera.
        height: of the camera above the floor, mm.
        wall: (WALL_COLUMNS,) the wall.
        uneven: (H, W) heights of the floor, over `rough`.
        rough: mm that a unit of `uneven` raises the floor.
        depth: (H, W) float32 mm, filled, 0 = nothing.
        what: (H, W) uint8 kinds, filled with NOTHING or STILL.
    """
    rows, columns = depth.shape
    for r in range(rows):
        v = v0 + r
        for c in range(columns):
            u = u0 + c
            depth[r, c] = 0.0
            what[r, c] = NOTHING
            if u < 0 or v < 0 or u >= picture[0] or v >= picture[1]:
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
            if wall[2] > 0.0:
                across = wall[0] * dx + wall[1] * dy
                beyond = across * t - wall[2]
                if beyond > 0.0:
                    t = wall[2] / across
                    if height + t * dz < wall[3]:
                        depth[r, c] = t
                        what[r, c] = STILL
                    continue
                raised += wall[4] * np.exp(beyond / wall[5])
            depth[r, c] = t + raised / dz
            what[r, c] = STILL


@njit(cache=True)
def merge(inverse, label, top, left, depth, what):
    """Put a drawn mesh (inverse depth, h, w) at row `top`, column `left` before what is farther.

    The pixels that it takes get the kind `label` in `what`.
    """
    for r in range(inverse.shape[0]):
        for c in range(inverse.shape[1]):
            if inverse[r, c] > 0.0:
                z = 1.0 / inverse[r, c]
                if depth[top + r, left + c] == 0.0 or z < depth[top + r, left + c]:
                    depth[top + r, left + c] = z
                    what[top + r, left + c] = label


@njit(cache=True)
def draw_onto(vertices, faces, rotation, translation, intrinsics, u0, v0, label, depth, what):
    """Rasterise a mesh over a picture or patch, touching only the mesh's own bounding box.

    Args:
        vertices: (V, 3) mm.
        faces: (F, 3) int32 triangles.
        rotation: (3, 3) from the vertices' frame into the camera frame.
        translation: (3,) likewise, mm.
        intrinsics: (4,) fx, fy, cx, cy, px.
        u0: column of the first pixel in the whole picture.
        v0: its row.
        label: kind of the pixels that are drawn.
        depth: (H, W) float32 mm, changed in place.
        what: (H, W) uint8 kinds, changed in place.
    """
    low_u = 1e9
    low_v = 1e9
    high_u = -1e9
    high_v = -1e9
    for i in range(len(vertices)):
        x = vertices[i, 0]
        y = vertices[i, 1]
        z = vertices[i, 2]
        zc = rotation[2, 0] * x + rotation[2, 1] * y + rotation[2, 2] * z + translation[2]
        if zc <= 1.0:
            continue
        xc = rotation[0, 0] * x + rotation[0, 1] * y + rotation[0, 2] * z + translation[0]
        yc = rotation[1, 0] * x + rotation[1, 1] * y + rotation[1, 2] * z + translation[1]
        u = intrinsics[0] * xc / zc + intrinsics[2]
        v = intrinsics[1] * yc / zc + intrinsics[3]
        low_u = min(low_u, u)
        high_u = max(high_u, u)
        low_v = min(low_v, v)
        high_v = max(high_v, v)
    left = max(0, int(low_u) - int(u0) - 1)
    top = max(0, int(low_v) - int(v0) - 1)
    right = min(depth.shape[1], int(high_u) - int(u0) + 2)
    bottom = min(depth.shape[0], int(high_v) - int(v0) + 2)
    if low_u > high_u or left >= right or top >= bottom:
        return
    inverse = np.zeros((bottom - top, right - left))
    draw(
        vertices,
        faces,
        rotation,
        translation,
        intrinsics[0],
        intrinsics[1],
        intrinsics[2],
        intrinsics[3],
        u0 + left,
        v0 + top,
        inverse,
    )
    merge(inverse, label, top, left, depth, what)


@njit(cache=True)
def _window(
    animal,
    faces,
    thing,
    thing_faces,
    has_thing,
    R_arena_camera,
    height,
    intrinsics,
    picture,
    origin,
    wall,
    rough,
    sensor,
    seed,
    table,
    depth_out,
    background_out,
):
    """One training patch: still scene, its learned background, animal, perhaps an object, noise."""
    shape = depth_out.shape
    state = np.array([seed], np.uint64)
    field = np.empty(shape, np.float32)
    depth = np.empty(shape, np.float32)
    what = np.empty(shape, np.uint8)
    smooth_field(state, table, 24.0, field)
    floor_and_wall(
        origin[0],
        origin[1],
        picture,
        intrinsics,
        R_arena_camera,
        height,
        wall,
        field,
        rough,
        depth,
        what,
    )
    smooth_field(state, table, 9.0, field)
    for r in range(shape[0]):
        for c in range(shape[1]):
            # a background is learned from many frames: nearly free of noise, a little off in
            # patches
            error = sensor[BACKGROUND] * (0.4 * field[r, c] + 0.3 * normal(state, table))
            background_out[r, c] = (
                int((depth[r, c] + error) / sensor[UNIT] + 0.5) if depth[r, c] > 0.0 else 0
            )
    rotation = np.ascontiguousarray(R_arena_camera.T)
    translation = -height * rotation[:, 2]
    u0 = float(origin[0])
    v0 = float(origin[1])
    draw_onto(animal, faces, rotation, translation, intrinsics, u0, v0, ANIMAL, depth, what)
    if has_thing:
        draw_onto(
            thing, thing_faces, rotation, translation, intrinsics, u0, v0, OBJECT, depth, what
        )
    for r in range(shape[0]):
        for c in range(shape[1]):
            u = origin[0] + c
            v = origin[1] + r
            if u < 0 or v < 0 or u >= picture[0] or v >= picture[1]:
                depth[r, c] = 0.0
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
        depth_out,
    )


@njit(cache=True, parallel=True)
def draw_windows(
    animal,
    faces,
    thing,
    thing_faces,
    has_thing,
    R_arena_camera,
    height,
    intrinsics,
    picture,
    origin,
    wall,
    rough,
    sensor,
    seed,
    table,
    depth_out,
    background_out,
):
    """Render n training patches and their learned backgrounds, one thread a patch.

    Args:
        animal: (n, V, 3) meshes of the animals, mm, arena frame.
        faces: (F, 3) int32 their triangles.
        thing: (n, W, 3) meshes of the objects beside them, mm, arena frame.
        thing_faces: (G, 3) int32 their triangles.
        has_thing: (n,) bool, which objects are there.
        R_arena_camera: (n, 3, 3) rotations of the cameras.
        height: (n,) of the cameras above the floor, mm.
        intrinsics: (n, 4) fx, fy, cx, cy, px.
        picture: (n, 2) int64 width and height of the whole pictures, px.
        origin: (n, 2) int64 picture pixel (u, v) of each patch's first.
        wall: (n, WALL_COLUMNS) walls.
        rough: (n,) unevenness of the floors, mm.
        sensor: (n, N_PARAMETERS) of the sensors.
        seed: (n,) uint64 of the noise, not 0.
        table: (2^13,) float32 normal quantiles.
        depth_out: (n, S, S) uint16 in steps of the sensor's unit, filled, 0 = unread.
        background_out: (n, S, S) uint16 likewise, the still scene as learned from many frames.
    """
    for i in prange(len(animal)):
        _window(
            animal[i],
            faces,
            thing[i],
            thing_faces,
            has_thing[i],
            R_arena_camera[i],
            height[i],
            intrinsics[i],
            picture[i],
            origin[i],
            wall[i],
            rough[i],
            sensor[i],
            seed[i],
            table,
            depth_out[i],
            background_out[i],
        )


@njit(cache=True)
def frame(
    still,
    animal,
    faces,
    thing,
    thing_faces,
    has_thing,
    rotation,
    translation,
    intrinsics,
    sensor,
    seed,
    table,
    out,
):
    """Render one full frame: the still scene, the animal, perhaps an object, and the sensor.

    Args:
        still: (H, W) float32 mm, the ideal still scene, 0 = nothing.
        animal: (V, 3) mesh, mm, arena frame.
        faces: (F, 3) int32 its triangles.
        thing: (W, 3) mesh of the object, mm, arena frame.
        thing_faces: (G, 3) int32 its triangles.
        has_thing: whether the object is there.
        rotation: (3, 3) of T_camera_arena.
        translation: (3,) of T_camera_arena, mm.
        intrinsics: (4,) fx, fy, cx, cy, px.
        sensor: (N_PARAMETERS,) of the sensor.
        seed: uint64 of the noise, not 0.
        table: (2^13,) float32 normal quantiles.
        out: (H, W) uint16 in steps of the sensor's unit, filled, 0 = unread.
    """
    state = np.array([seed], np.uint64)
    depth = still.copy()
    what = np.where(still > 0, np.uint8(STILL), np.uint8(NOTHING))
    draw_onto(animal, faces, rotation, translation, intrinsics, 0.0, 0.0, ANIMAL, depth, what)
    if has_thing:
        draw_onto(
            thing, thing_faces, rotation, translation, intrinsics, 0.0, 0.0, OBJECT, depth, what
        )
    field = np.empty(depth.shape, np.float32)
    sense(
        depth, what, sensor, intrinsics[0], intrinsics[2], intrinsics[3], state, table, field, out
    )


@njit(cache=True, parallel=True)
def frames_parallel(
    still,
    animal,
    faces,
    thing,
    thing_faces,
    has_thing,
    rotation,
    translation,
    intrinsics,
    sensor,
    seed,
    table,
    out,
):
    """Render n full frames of one scene, one thread a frame; see `frame`.

    Args:
        still: (H, W) float32 mm, shared.
        animal: (n, V, 3) meshes, mm, arena frame.
        faces: (F, 3) int32, shared.
        thing: (n, W, 3) meshes of the objects, mm, arena frame.
        thing_faces: (G, 3) int32, shared.
        has_thing: (n,) bool.
        rotation: (3, 3) of T_camera_arena, shared.
        translation: (3,) of T_camera_arena, mm, shared.
        intrinsics: (4,) fx, fy, cx, cy, px, shared.
        sensor: (n, N_PARAMETERS).
        seed: (n,) uint64, not 0.
        table: (2^13,) float32 normal quantiles.
        out: (n, H, W) uint16 in steps of the sensor's unit, filled, 0 = unread.
    """
    for i in prange(len(animal)):
        frame(
            still,
            animal[i],
            faces,
            thing[i],
            thing_faces,
            has_thing[i],
            rotation,
            translation,
            intrinsics,
            sensor[i],
            seed[i],
            table,
            out[i],
        )
