"""Numba kernels of the estimation: what a candidate sees, and how a correction moves it.

A look, 17 float64, is how one height map was cut: fx fy cx cy, rotation (9, row-major) of
T_view_camera, distance of the camera above the view's origin (its translation is (0, 0, distance)),
crop origin u v, and crop step. Candidates live in that view frame: the arena frame, or the upright
camera frame of the paper's variant.
"""

from __future__ import annotations

import numpy as np
from numba import njit, prange

LOOK = 17
N_SCALARS = 11
# a threshold is an integer: logarithms and sines are scaled up to resolve a few thousandths
_LOG_UNIT = 500.0
_MM_UNIT = 16.0


@njit(cache=True)
def fill_view(rotation, position, look, size, reach, view):
    """View (9,) of a joint with rotation (3, 3) and position (3,) mm; reach mm of the offsets at
    home size.
    """
    x0 = position[0]
    y0 = position[1]
    z0 = position[2] - look[13]
    x = look[4] * x0 + look[7] * y0 + look[10] * z0
    y = look[5] * x0 + look[8] * y0 + look[11] * z0
    z = max(look[6] * x0 + look[9] * y0 + look[12] * z0, 1.0)
    per_px = 1.0 / look[16]
    iu = look[0] / z * per_px
    iv = look[1] / z * per_px
    view[0] = (look[0] * x / z + look[2] - look[14]) * per_px
    view[1] = (look[1] * y / z + look[3] - look[15]) * per_px
    unit = reach * size / 127.0
    for k in range(3):
        ax = look[4] * rotation[0, k] + look[7] * rotation[1, k] + look[10] * rotation[2, k]
        ay = look[5] * rotation[0, k] + look[8] * rotation[1, k] + look[11] * rotation[2, k]
        az = look[6] * rotation[0, k] + look[9] * rotation[1, k] + look[12] * rotation[2, k]
        view[2 + k] = unit * iu * (ax - x / z * az)
        view[5 + k] = unit * iv * (ay - y / z * az)
    view[8] = 16.0 * position[2] / size


@njit(cache=True)
def fill_scalars(rotation, position, scale, moments, size, scalars):
    """Numbers (N_SCALARS,) that describe the whole animal as a joint sees it, at home size."""
    area = max(moments[1], 1.0)
    volume = max(moments[2], 1.0)
    scalars[0] = _LOG_UNIT * np.log(area / (size * size))
    scalars[1] = _LOG_UNIT * np.log(volume / (size * size * size))
    scalars[2] = _MM_UNIT * moments[6] / size
    scalars[3] = _MM_UNIT * moments[7] / size
    dx = moments[3] - position[0]
    dy = moments[4] - position[1]
    scalars[4] = _MM_UNIT * (rotation[0, 0] * dx + rotation[1, 0] * dy) / size
    scalars[5] = _MM_UNIT * (rotation[0, 1] * dx + rotation[1, 1] * dy) / size
    scalars[6] = _MM_UNIT * position[2] / size
    c = rotation[0, 0]
    s = rotation[1, 0]
    norm = max(c * c + s * s, 1e-12)
    # how steeply the joint rises, over the back where its slope along the long axis is known (else
    # 0)
    rise = moments[8] * (np.cos(moments[5]) * c + np.sin(moments[5]) * s) / np.sqrt(norm)
    scalars[7] = _LOG_UNIT * (rotation[2, 0] - rise)
    scalars[8] = _LOG_UNIT * rotation[2, 1]
    # the sine of twice the angle from the joint's heading to the long axis, without asking for the
    # heading's angle
    twice = np.sin(2.0 * moments[5]) * (c * c - s * s) - np.cos(2.0 * moments[5]) * 2.0 * s * c
    scalars[9] = (
        _LOG_UNIT * twice / norm * (moments[6] - moments[7]) / max(moments[6] + moments[7], 1e-6)
    )
    scalars[10] = _LOG_UNIT * np.log(scale / size)


@njit(cache=True)
def so3_exp(wx, wy, wz, out):
    """Rotation (3, 3) of a rotation vector, rad; the scalar twin of geometry.so3.exp."""
    th2 = wx * wx + wy * wy + wz * wz
    if th2 < 1e-8:
        a = 1.0 - th2 / 6.0
        b = 0.5 - th2 / 24.0
    else:
        th = np.sqrt(th2)
        a = np.sin(th) / th
        b = 2.0 * np.sin(th / 2.0) ** 2 / th2
    out[0, 0] = 1.0 - b * (wy * wy + wz * wz)
    out[0, 1] = b * wx * wy - a * wz
    out[0, 2] = b * wx * wz + a * wy
    out[1, 0] = b * wx * wy + a * wz
    out[1, 1] = 1.0 - b * (wx * wx + wz * wz)
    out[1, 2] = b * wy * wz - a * wx
    out[2, 0] = b * wx * wz - a * wy
    out[2, 1] = b * wy * wz + a * wx
    out[2, 2] = 1.0 - b * (wx * wx + wy * wy)


@njit(cache=True)
def turn(rotation, wx, wy, wz):
    """Rotation (3, 3) <- rotation exp(w): on the right, for a correction lives in the joint's own
    frame.
    """
    step = np.empty((3, 3))
    so3_exp(wx, wy, wz, step)
    for i in range(3):
        a = rotation[i, 0]
        b = rotation[i, 1]
        c = rotation[i, 2]
        for k in range(3):
            rotation[i, k] = a * step[0, k] + b * step[1, k] + c * step[2, k]


@njit(cache=True)
def correct_base(rotation, position, scale, twist, size):
    """G <- g exp(twist) (Eq. 10) for the base; twist (7,) rad, mm at home size, log scale. Returns
    the new scale.
    """
    wx = twist[0]
    wy = twist[1]
    wz = twist[2]
    th2 = wx * wx + wy * wy + wz * wz
    if th2 < 1e-6:
        b = 0.5 - th2 / 24.0
        c = 1.0 / 6.0 - th2 / 120.0
    else:
        th = np.sqrt(th2)
        b = 2.0 * np.sin(th / 2.0) ** 2 / th2
        c = (th - np.sin(th)) / (th2 * th)
    nx = twist[3] * size
    ny = twist[4] * size
    nz = twist[5] * size
    # A nu = nu + b w x nu + c w x (w x nu), Eq. 5
    px = wy * nz - wz * ny
    py = wz * nx - wx * nz
    pz = wx * ny - wy * nx
    tx = nx + b * px + c * (wy * pz - wz * py)
    ty = ny + b * py + c * (wz * px - wx * pz)
    tz = nz + b * pz + c * (wx * py - wy * px)
    for i in range(3):
        position[i] += rotation[i, 0] * tx + rotation[i, 1] * ty + rotation[i, 2] * tz
    turn(rotation, wx, wy, wz)
    return scale * np.exp(twist[6])


@njit(cache=True)
def correct_joint(rotation, axes, values, lever):
    """G <- g exp(r) for a joint that turns about its free axes (3,) only; values are lever * rad,
    axis by axis.
    """
    w = np.zeros(3)
    used = 0
    for k in range(3):
        if axes[k]:
            w[k] = values[used] / lever
            used += 1
    turn(rotation, w[0], w[1], w[2])


@njit(cache=True)
def place_joint(j, parents, offsets, rest, scale, rotations, positions):
    """Put joint j where its parent carries it, at its home angle."""
    p = parents[j]
    for i in range(3):
        total = positions[p, i]
        for k in range(3):
            total += scale * rotations[p, i, k] * offsets[j, k]
        positions[j, i] = total
        for k in range(3):
            value = 0.0
            for m in range(3):
                value += rotations[p, i, m] * rest[j, m, k]
            rotations[j, i, k] = value


@njit(cache=True)
def place_rest(solved, parents, offsets, rest, scale, rotations, positions):
    """Put every joint without a regressor where its parent carries it."""
    for j in range(1, parents.size):
        is_solved = False
        for s in solved:
            is_solved |= s == j
        if not is_solved:
            place_joint(j, parents, offsets, rest, scale, rotations, positions)


@njit(cache=True, parallel=True)
def place_all(j, parents, offsets, rest, scale, rotations, positions):
    """`place_joint` for a batch: scale (n,), rotations (n, J, 3, 3), positions (n, J, 3)."""
    for s in prange(scale.size):
        place_joint(j, parents, offsets, rest, scale[s], rotations[s], positions[s])


@njit(cache=True, parallel=True)
def look_all(
    joints, looks, moments, image, size, reach, rotations, positions, scale, views, scalars
):
    """Views (n, V, 9) of the given joints, offsets reaching `reach` (V,) mm from each, and scalars
    (n, N_SCALARS) of the first of them, for a batch.
    """
    for s in prange(scale.size):
        i = image[s]
        for v in range(joints.size):
            fill_view(
                rotations[s, joints[v]],
                positions[s, joints[v]],
                looks[i],
                size[s],
                reach[v],
                views[s, v],
            )
        if scalars.shape[1] > 0:
            fill_scalars(
                rotations[s, joints[0]],
                positions[s, joints[0]],
                scale[s],
                moments[i],
                size[s],
                scalars[s],
            )


@njit(cache=True, parallel=True)
def correct_base_all(rotations, positions, scale, values, levers, size):
    """`correct_base` for a batch; values (n, 6 or 7) in lever units, levers (2,) of rotation and
    scale.
    """
    for s in prange(scale.size):
        twist = np.zeros(7)
        for k in range(3):
            twist[k] = values[s, k] / levers[0]
            twist[3 + k] = values[s, 3 + k]
        if values.shape[1] > 6:
            twist[6] = values[s, 6] / levers[1]
        scale[s] = correct_base(rotations[s, 0], positions[s, 0], scale[s], twist, size[s])


@njit(cache=True, parallel=True)
def correct_joint_all(j, rotations, axes, values, lever):
    """`correct_joint` of joint j for a batch; values (n, free axes)."""
    for s in prange(values.shape[0]):
        correct_joint(rotations[s, j], axes, values[s], lever)
