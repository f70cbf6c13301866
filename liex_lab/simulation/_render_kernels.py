"""Depth renderer: floor and wall by ray casting, meshes by z-buffer, then the sensor model.

The ray (x, y, 1) of a pixel, rotated into the arena frame, meets the floor at depth height / -d_z
and a vertical wall at distance / (outward . d_xy); meshes keep the largest 1 / z at each pixel's
centre. `draw_windows` makes training patches with their learned background, `frames_parallel` whole
depth images.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import prange

from liex_lab.body._rasterizer_kernels import draw
from liex_lab.runtime.kernels import inner_kernel, kernel
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


class Wall(NamedTuple):
    """A straight wall; the fields are in the order of the packed array.

    Attributes:
        normal_x: x of its outward normal in the floor.
        normal_y: y of its outward normal in the floor.
        distance: from the arena's origin, mm; 0 is no wall.
        height: mm.
        rounding: depth of the rounding that multiple reflections leave at its foot, mm.
        rounding_reach: its extent, mm.
    """

    normal_x: Any
    normal_y: Any
    distance: Any
    height: Any
    rounding: Any
    rounding_reach: Any


WALL_COLUMNS = len(Wall._fields)


class SensorNoise(NamedTuple):
    """A sensor and its noise; for many images, parameters and seed have a leading axis (n,).

    Attributes:
        parameters: (N_PARAMETERS,) of the sensor.
        seed: uint64 of the noise, not 0.
        table: (2^13,) float32 normal quantiles.
    """

    parameters: Any
    seed: Any
    table: Any


class PatchCamera(NamedTuple):
    """The camera of an image or of a patch of it; for many, all with a leading axis (n,).

    Attributes:
        intrinsics: (4,) fx, fy, cx, cy, px.
        picture: (2,) int64 width and height of the whole image, px; pixels outside are unread.
        origin: (2,) int64 pixel (u, v) of the whole image at (0, 0) of the patch.
    """

    intrinsics: Any
    picture: Any
    origin: Any


class Meshes(NamedTuple):
    """An animal and an optional object; for many images, all but faces with a leading axis (n,).

    Attributes:
        animal: (V, 3) mesh of the animal, mm, arena frame.
        faces: (F, 3) int32 its triangles.
        thing: (W, 3) mesh of the object next to it, mm, arena frame.
        thing_faces: (G, 3) int32 its triangles.
        has_thing: whether the object exists.
    """

    animal: Any
    faces: Any
    thing: Any
    thing_faces: Any
    has_thing: Any


class ArenaView(NamedTuple):
    """A camera above a floor with at most one wall; for many patches, all with a leading axis (n,).

    Attributes:
        R_arena_camera: (3, 3) rotation of the camera.
        height: of the camera above the floor, mm.
        wall: (WALL_COLUMNS,) the wall.
        rough: unevenness of the floor, mm.
    """

    R_arena_camera: Any
    height: Any
    wall: Any
    rough: Any


@inner_kernel()
def noise_of(noises, i):
    """The `SensorNoise` of image i."""
    return SensorNoise(noises.parameters[i], noises.seed[i], noises.table)


@inner_kernel()
def camera_of(cameras, i):
    """The `PatchCamera` of image i."""
    return PatchCamera(cameras.intrinsics[i], cameras.picture[i], cameras.origin[i])


@inner_kernel()
def _meshes_of(meshes, i):
    """The `Meshes` of image i."""
    return Meshes(
        meshes.animal[i],
        meshes.faces,
        meshes.thing[i],
        meshes.thing_faces,
        meshes.has_thing[i],
    )


@inner_kernel()
def _unpack_wall(packed):
    """The record of one packed wall (WALL_COLUMNS,)."""
    return Wall(packed[0], packed[1], packed[2], packed[3], packed[4], packed[5])


@inner_kernel()
def floor_and_wall(u0, v0, picture, intrinsics, rotation, height, wall, uneven, rough, depth, what):
    """Ideal depth and kind of a patch (H, W) on a floor with at most one straight wall.

    Args:
        u0: column of the patch's first pixel in the whole image.
        v0: its row.
        picture: (2,) width and height of the whole image, px; pixels outside are unread.
        intrinsics: (4,) fx, fy, cx, cy, px.
        rotation: (3, 3) of T_arena_camera.
        height: of the camera above the floor, mm.
        wall: the wall.
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
            if wall.distance > 0.0:
                across = wall.normal_x * dx + wall.normal_y * dy
                beyond = across * t - wall.distance
                if beyond > 0.0:
                    t = wall.distance / across
                    if height + t * dz < wall.height:
                        depth[r, c] = t
                        what[r, c] = STILL
                    continue
                raised += wall.rounding * np.exp(beyond / wall.rounding_reach)
            depth[r, c] = t + raised / dz
            what[r, c] = STILL


@kernel()
def merge(inverse, label, top, left, depth, what):
    """Merge a rendered mesh (inverse depth, h, w) at row `top`, column `left`, by z-buffer.

    The pixels that it covers get the kind `label` in `what`.
    """
    for r in range(inverse.shape[0]):
        for c in range(inverse.shape[1]):
            if inverse[r, c] > 0.0:
                z = 1.0 / inverse[r, c]
                if depth[top + r, left + c] == 0.0 or z < depth[top + r, left + c]:
                    depth[top + r, left + c] = z
                    what[top + r, left + c] = label


@inner_kernel()
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


@inner_kernel()
def _draw_meshes(meshes, rotation, translation, intrinsics, u0, v0, depth, what):
    """Rasterise the animal and, if present, the object into an image or patch."""
    draw_onto(
        meshes.animal,
        meshes.faces,
        rotation,
        translation,
        intrinsics,
        u0,
        v0,
        ANIMAL,
        depth,
        what,
    )
    if meshes.has_thing:
        draw_onto(
            meshes.thing,
            meshes.thing_faces,
            rotation,
            translation,
            intrinsics,
            u0,
            v0,
            OBJECT,
            depth,
            what,
        )


@inner_kernel()
def _window(meshes, camera, view, noise, depth_out, background_out):
    """One training patch: still scene, its learned background, animal, optional object, noise."""
    shape = depth_out.shape
    intrinsics = camera.intrinsics
    origin = camera.origin
    sensor = noise.parameters
    table = noise.table
    state = np.array([noise.seed], np.uint64)
    field = np.empty(shape, np.float32)
    depth = np.empty(shape, np.float32)
    what = np.empty(shape, np.uint8)
    smooth_field(state, table, 24.0, field)
    floor_and_wall(
        origin[0],
        origin[1],
        camera.picture,
        intrinsics,
        view.R_arena_camera,
        view.height,
        _unpack_wall(view.wall),
        field,
        view.rough,
        depth,
        what,
    )
    smooth_field(state, table, 9.0, field)
    for r in range(shape[0]):
        for c in range(shape[1]):
            # a background is learned from many frames: low noise, with small smooth errors
            error = sensor[BACKGROUND] * (0.4 * field[r, c] + 0.3 * normal(state, table))
            background_out[r, c] = (
                int((depth[r, c] + error) / sensor[UNIT] + 0.5) if depth[r, c] > 0.0 else 0
            )
    rotation = np.ascontiguousarray(view.R_arena_camera.T)
    translation = -view.height * rotation[:, 2]
    u0 = float(origin[0])
    v0 = float(origin[1])
    _draw_meshes(meshes, rotation, translation, intrinsics, u0, v0, depth, what)
    for r in range(shape[0]):
        for c in range(shape[1]):
            u = origin[0] + c
            v = origin[1] + r
            if u < 0 or v < 0 or u >= camera.picture[0] or v >= camera.picture[1]:
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


@kernel(parallel=True)
def draw_windows(meshes, cameras, views, noises, depth_out, background_out):
    """Render n training patches and their learned backgrounds, one thread per patch.

    Args:
        meshes: `Meshes` of the patches.
        cameras: `PatchCamera` of the patches.
        views: `ArenaView` of the patches.
        noises: `SensorNoise` of the patches.
        depth_out: (n, S, S) uint16 in steps of the sensor's unit, output, 0 = unread.
        background_out: (n, S, S) uint16 likewise, the still scene as learned from many frames.
    """
    for i in prange(len(depth_out)):
        view = ArenaView(views.R_arena_camera[i], views.height[i], views.wall[i], views.rough[i])
        _window(
            _meshes_of(meshes, i),
            camera_of(cameras, i),
            view,
            noise_of(noises, i),
            depth_out[i],
            background_out[i],
        )


@kernel()
def frame(still, meshes, rotation, translation, intrinsics, noise, out):
    """Render one full frame: the still scene, the animal, an optional object, and the sensor.

    Args:
        still: (H, W) float32 mm, the ideal still scene, 0 = nothing.
        meshes: `Meshes` of the frame.
        rotation: (3, 3) of T_camera_arena.
        translation: (3,) of T_camera_arena, mm.
        intrinsics: (4,) fx, fy, cx, cy, px.
        noise: `SensorNoise` of the frame.
        out: (H, W) uint16 in steps of the sensor's unit, output, 0 = unread.
    """
    state = np.array([noise.seed], np.uint64)
    depth = still.copy()
    what = np.where(still > 0, np.uint8(STILL), np.uint8(NOTHING))
    _draw_meshes(meshes, rotation, translation, intrinsics, 0.0, 0.0, depth, what)
    field = np.empty(depth.shape, np.float32)
    sense(
        depth,
        what,
        noise.parameters,
        intrinsics[0],
        intrinsics[2],
        intrinsics[3],
        state,
        noise.table,
        field,
        out,
    )


@kernel(parallel=True)
def frames_parallel(still, meshes, rotation, translation, intrinsics, noises, out):
    """Render n full frames of one scene, one thread per frame; see `frame`.

    Args:
        still: (H, W) float32 mm, shared.
        meshes: `Meshes` of the frames.
        rotation: (3, 3) of T_camera_arena, shared.
        translation: (3,) of T_camera_arena, mm, shared.
        intrinsics: (4,) fx, fy, cx, cy, px, shared.
        noises: `SensorNoise` of the frames.
        out: (n, H, W) uint16 in steps of the sensor's unit, output, 0 = unread.
    """
    for i in prange(len(out)):
        frame(
            still,
            _meshes_of(meshes, i),
            rotation,
            translation,
            intrinsics,
            noise_of(noises, i),
            out[i],
        )


# Depth renderer of hands: wall plane, body, arm, hand and objects by z-buffer, then the sensor.


class HandMeshes(NamedTuple):
    """A hand and its surroundings; for many images, all but faces with a leading axis (n,).

    Attributes:
        hand: (V, 3) mesh, mm, camera frame.
        hand_faces: (F, 3) int32 its triangles.
        arm: (A, 3) mesh, mm, camera frame.
        arm_faces: (G, 3) int32 its triangles.
        body: (B, 3) mesh of the body behind it, mm, camera frame.
        body_faces: (K, 3) int32 its triangles.
        thing: (W, 3) mesh of the object, mm, camera frame.
        thing_faces: (L, 3) int32 its triangles.
        has_thing: whether the object exists.
    """

    hand: Any
    hand_faces: Any
    arm: Any
    arm_faces: Any
    body: Any
    body_faces: Any
    thing: Any
    thing_faces: Any
    has_thing: Any


@kernel()
def _put(vertices, faces, intrinsics, u0, v0, label, depth, what):
    """Rasterise a mesh in the camera frame into an image or patch; see `draw_onto`."""
    draw_onto(vertices, faces, np.eye(3), np.zeros(3), intrinsics, u0, v0, label, depth, what)


@kernel()
def picture(meshes, wall, camera, noise, out):
    """Render one depth image or patch (H, W) of a hand.

    Args:
        meshes: `HandMeshes` of the image.
        wall: (4,) a, b, c of 1 / z = a u + b v + c behind everything, and its unevenness, mm; c =
            0: nothing in range.
        camera: `PatchCamera` of the image.
        noise: `SensorNoise` of the image.
        out: (H, W) uint16 mm, output, 0 = unread.
    """
    shape = out.shape
    intrinsics = camera.intrinsics
    origin = camera.origin
    table = noise.table
    state = np.array([noise.seed], np.uint64)
    field = np.empty(shape, np.float32)
    depth = np.empty(shape, np.float32)
    what = np.empty(shape, np.uint8)
    smooth_field(state, table, 24.0, field)
    for r in range(shape[0]):
        for c in range(shape[1]):
            inverse = wall[0] * (origin[0] + c) + wall[1] * (origin[1] + r) + wall[2]
            there = inverse > 1.0 / 4500.0
            depth[r, c] = 1.0 / inverse + wall[3] * field[r, c] if there else 0.0
            what[r, c] = STILL if there else NOTHING
    u0 = float(origin[0])
    v0 = float(origin[1])
    _put(meshes.body, meshes.body_faces, intrinsics, u0, v0, OBJECT, depth, what)
    if meshes.has_thing:
        _put(meshes.thing, meshes.thing_faces, intrinsics, u0, v0, OBJECT, depth, what)
    _put(meshes.arm, meshes.arm_faces, intrinsics, u0, v0, ANIMAL, depth, what)
    _put(meshes.hand, meshes.hand_faces, intrinsics, u0, v0, ANIMAL, depth, what)
    for r in range(shape[0]):
        for c in range(shape[1]):
            u = origin[0] + c
            v = origin[1] + r
            if u < 0 or v < 0 or u >= camera.picture[0] or v >= camera.picture[1]:
                depth[r, c] = 0.0
                what[r, c] = NOTHING
    sense(
        depth,
        what,
        noise.parameters,
        intrinsics[0],
        intrinsics[2] - u0,
        intrinsics[3] - v0,
        state,
        table,
        field,
        out,
    )


@kernel(parallel=True)
def pictures(meshes, walls, cameras, noises, out):
    """Render n depth images or patches of hands, one thread per image; see `picture`.

    Args:
        meshes: `HandMeshes` of the images.
        walls: (n, 4) planes behind everything, as in `picture`.
        cameras: `PatchCamera` of the images.
        noises: `SensorNoise` of the images.
        out: (n, H, W) uint16 mm, output, 0 = unread.
    """
    for i in prange(len(out)):
        drawn = HandMeshes(
            meshes.hand[i],
            meshes.hand_faces,
            meshes.arm[i],
            meshes.arm_faces,
            meshes.body[i],
            meshes.body_faces,
            meshes.thing[i],
            meshes.thing_faces,
            meshes.has_thing[i],
        )
        picture(drawn, walls[i], camera_of(cameras, i), noise_of(noises, i), out[i])
