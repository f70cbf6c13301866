"""Kernels that compose a picture of a hand: what is behind it, the body that it belongs to, things
beside it.
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
    """One picture or window (H, W) uint16 mm; meshes (V, 3) mm in the camera frame.

    wall (4,): 1 / z = a u + b v + c behind everything and its unevenness, mm; c = 0: nothing is in
    range there. size: (width, height) of the whole picture, whose pixel `origin` comes to lie at
    (0, 0).
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
    """`picture` for a batch (n)."""
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
