"""Depth renderer of hands: wall plane, body, arm, hand and objects by z-buffer, then the sensor.

Meshes come in the camera frame. The wall behind them is 1 / z = a u + b v + c plus smooth
unevenness; arm and hand count as ANIMAL for the sensor, body and objects as OBJECT.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import njit, prange

from liex_lab.simulation._render_kernels import camera_of, draw_onto, noise_of
from liex_lab.simulation._sensor_kernels import ANIMAL, NOTHING, OBJECT, STILL, sense, smooth_field


class HandMeshes(NamedTuple):
    """A hand and what is about it; of many pictures, all but faces with a leading axis (n,).

    Attributes:
        hand: (V, 3) mesh, mm, camera frame.
        hand_faces: (F, 3) int32 its triangles.
        arm: (A, 3) mesh, mm, camera frame.
        arm_faces: (G, 3) int32 its triangles.
        body: (B, 3) mesh of the body behind it, mm, camera frame.
        body_faces: (K, 3) int32 its triangles.
        thing: (W, 3) mesh of the object, mm, camera frame.
        thing_faces: (L, 3) int32 its triangles.
        has_thing: whether the object is there.
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


@njit(cache=True)
def _put(vertices, faces, intrinsics, u0, v0, label, depth, what):
    """Rasterise a mesh of the camera frame over a picture or patch; see `draw_onto`."""
    draw_onto(vertices, faces, np.eye(3), np.zeros(3), intrinsics, u0, v0, label, depth, what)


@njit(cache=True)
def picture(meshes, wall, camera, noise, out):
    """Render one picture or patch (H, W) of a hand.

    Args:
        meshes: `HandMeshes` of the picture.
        wall: (4,) a, b, c of 1 / z = a u + b v + c behind everything, and its unevenness, mm; c =
            0: nothing is in range there.
        camera: `PatchCamera` of the picture.
        noise: `SensorNoise` of the picture.
        out: (H, W) uint16 mm, filled, 0 = unread.
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


@njit(cache=True, parallel=True)
def pictures(meshes, walls, cameras, noises, out):
    """Render n pictures or patches of hands, one thread a picture; see `picture`.

    Args:
        meshes: `HandMeshes` of the pictures.
        walls: (n, 4) planes behind everything, as in `picture`.
        cameras: `PatchCamera` of the pictures.
        noises: `SensorNoise` of the pictures.
        out: (n, H, W) uint16 mm, filled, 0 = unread.
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
