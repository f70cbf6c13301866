"""Depth renderer of hands: wall plane, body, arm, hand and objects by z-buffer, then the sensor.

Meshes come in the camera frame. The wall behind them is 1 / z = a u + b v + c plus smooth
unevenness; arm and hand count as ANIMAL for the sensor, body and objects as OBJECT.
"""

from __future__ import annotations

import numpy as np
from numba import njit, prange

from liex_lab.simulation._render_kernels import draw_onto
from liex_lab.simulation._sensor_kernels import ANIMAL, NOTHING, OBJECT, STILL, sense, smooth_field


@njit(cache=True)
def picture(
    hand,
    hand_faces,
    arm,
    arm_faces,
    body,
    body_faces,
    thing,
    thing_faces,
    has_thing,
    wall,
    intrinsics,
    size,
    origin,
    sensor,
    seed,
    table,
    out,
):
    """Render one picture or patch (H, W) of a hand.

    Args:
        hand: (V, 3) mesh, mm, camera frame.
        hand_faces: (F, 3) int32 its triangles.
        arm: (A, 3) mesh, mm, camera frame.
        arm_faces: (G, 3) int32 its triangles.
        body: (B, 3) mesh of the body behind it, mm, camera frame.
        body_faces: (K, 3) int32 its triangles.
        thing: (W, 3) mesh of the object, mm, camera frame.
        thing_faces: (L, 3) int32 its triangles.
        has_thing: whether the object is there.
        wall: (4,) a, b, c of 1 / z = a u + b v + c behind everything, and its unevenness, mm; c =
            0: nothing is in range there.
        intrinsics: (4,) fx, fy, cx, cy, px.
        size: (2,) width and height of the whole picture, px; outside it nothing is read.
        origin: (2,) pixel (u, v) of the whole picture that comes to lie at (0, 0).
        sensor: (N_PARAMETERS,) of the sensor.
        seed: uint64 of the noise, not 0.
        table: (2^13,) float32 normal quantiles.
        out: (H, W) uint16 mm, filled, 0 = unread.
    """
    shape = out.shape
    state = np.array([seed], np.uint64)
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
    rotation = np.eye(3)
    translation = np.zeros(3)
    u0 = float(origin[0])
    v0 = float(origin[1])
    draw_onto(body, body_faces, rotation, translation, intrinsics, u0, v0, OBJECT, depth, what)
    if has_thing:
        draw_onto(
            thing, thing_faces, rotation, translation, intrinsics, u0, v0, OBJECT, depth, what
        )
    draw_onto(arm, arm_faces, rotation, translation, intrinsics, u0, v0, ANIMAL, depth, what)
    draw_onto(hand, hand_faces, rotation, translation, intrinsics, u0, v0, ANIMAL, depth, what)
    for r in range(shape[0]):
        for c in range(shape[1]):
            u = origin[0] + c
            v = origin[1] + r
            if u < 0 or v < 0 or u >= size[0] or v >= size[1]:
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
        out,
    )


@njit(cache=True, parallel=True)
def pictures(
    hand,
    hand_faces,
    arm,
    arm_faces,
    body,
    body_faces,
    thing,
    thing_faces,
    has_thing,
    wall,
    intrinsics,
    size,
    origin,
    sensor,
    seed,
    table,
    out,
):
    """Render n pictures or patches of hands, one thread a picture; see `picture`.

    Args:
        hand: (n, V, 3) meshes, mm, camera frame.
        hand_faces: (F, 3) int32, shared.
        arm: (n, A, 3) meshes, mm, camera frame.
        arm_faces: (G, 3) int32, shared.
        body: (n, B, 3) meshes, mm, camera frame.
        body_faces: (K, 3) int32, shared.
        thing: (n, W, 3) meshes, mm, camera frame.
        thing_faces: (L, 3) int32, shared.
        has_thing: (n,) bool.
        wall: (n, 4) planes behind everything, as in `picture`.
        intrinsics: (n, 4) fx, fy, cx, cy, px.
        size: (n, 2) width and height of the whole pictures, px.
        origin: (n, 2) first pixel (u, v) of each.
        sensor: (n, N_PARAMETERS).
        seed: (n,) uint64, not 0.
        table: (2^13,) float32 normal quantiles, shared.
        out: (n, H, W) uint16 mm, filled, 0 = unread.
    """
    for i in prange(len(hand)):
        picture(
            hand[i],
            hand_faces,
            arm[i],
            arm_faces,
            body[i],
            body_faces,
            thing[i],
            thing_faces,
            has_thing[i],
            wall[i],
            intrinsics[i],
            size[i],
            origin[i],
            sensor[i],
            seed[i],
            table,
            out[i],
        )
