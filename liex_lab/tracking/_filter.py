"""Kernels of the smoother: a constant-velocity filter and its way back, for vectors and for rotations.

All coordinates of a group share one covariance (2, 2) of value and velocity, so only gains are computed per frame, and
every coordinate is moved by them. The acceleration is white noise of density q; a frame's value is measured with
variance r, infinite where nothing was measured.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from liex_lab.tracking._joints import exp_so3

_START_RATE = 1e2  # variance of the velocity before anything is known, of its usual variance


@njit(cache=True)
def gains(times, r, q, start, forward, back, filtered, predicted, smoothed):
    """Gains and variances of n frames: forward (n, 2) of value and velocity, back (n, 2, 2) of the way back.

    filtered, predicted, smoothed (n, 2, 2) are covariances; start: the first frame that was measured.
    """
    n = times.size
    p = np.empty((2, 2))
    for t in range(start, n):
        if t == start:
            p[0, 0], p[0, 1], p[1, 0] = r[t], 0.0, 0.0
            p[1, 1] = _START_RATE * q
            predicted[t] = p
            forward[t, 0], forward[t, 1] = 1.0, 0.0
        else:
            dt = times[t] - times[t - 1]
            a, b, c = p[0, 0], p[0, 1], p[1, 1]
            p[0, 0] = a + 2 * dt * b + dt * dt * c + q * dt**3 / 3
            p[0, 1] = b + dt * c + q * dt * dt / 2
            p[1, 1] = c + q * dt
            p[1, 0] = p[0, 1]
            predicted[t] = p
            s = p[0, 0] + r[t]
            forward[t, 0], forward[t, 1] = p[0, 0] / s, p[0, 1] / s
            if np.isfinite(r[t]):
                k0, k1 = forward[t, 0], forward[t, 1]
                p[1, 1] -= k1 * p[0, 1]
                p[0, 1] = (1 - k0) * p[0, 1]
                p[0, 0] = (1 - k0) * p[0, 0]
                p[1, 0] = p[0, 1]
        filtered[t] = p
    smoothed[n - 1] = filtered[n - 1]
    for t in range(n - 2, start - 1, -1):
        dt = times[t + 1] - times[t]
        f, m = filtered[t], predicted[t + 1]
        det = m[0, 0] * m[1, 1] - m[0, 1] * m[1, 0]
        # filtered @ transition^T @ inverse of predicted
        u00, u01 = f[0, 0] + dt * f[0, 1], f[0, 1]
        u10, u11 = f[1, 0] + dt * f[1, 1], f[1, 1]
        back[t, 0, 0] = (u00 * m[1, 1] - u01 * m[1, 0]) / det
        back[t, 0, 1] = (u01 * m[0, 0] - u00 * m[0, 1]) / det
        back[t, 1, 0] = (u10 * m[1, 1] - u11 * m[1, 0]) / det
        back[t, 1, 1] = (u11 * m[0, 0] - u10 * m[0, 1]) / det
        smoothed[t] = f + back[t] @ (smoothed[t + 1] - m) @ back[t].T


@njit(cache=True)
def run_vectors(times, y, known, start, forward, back, ahead, out, rate):
    """Filter vectors y (n, m) and smooth them into out (n, m) and their rates (n, m) per second.

    known (n,): measured; ahead (n, m) gets what the past says of each frame.
    """
    n, m = y.shape
    for t in range(start, n):
        for k in range(m):
            if t == start:
                out[t, k], rate[t, k], ahead[t, k] = y[t, k], 0.0, y[t, k]
                continue
            value = out[t - 1, k] + (times[t] - times[t - 1]) * rate[t - 1, k]
            speed = rate[t - 1, k]
            ahead[t, k] = value
            if known[t]:
                off = y[t, k] - value
                value += forward[t, 0] * off
                speed += forward[t, 1] * off
            out[t, k], rate[t, k] = value, speed
    for t in range(n - 2, start - 1, -1):
        dt = times[t + 1] - times[t]
        for k in range(m):
            d0 = out[t + 1, k] - (out[t, k] + dt * rate[t, k])
            d1 = rate[t + 1, k] - rate[t, k]
            out[t, k] += back[t, 0, 0] * d0 + back[t, 0, 1] * d1
            rate[t, k] += back[t, 1, 0] * d0 + back[t, 1, 1] * d1


@njit(cache=True)
def log_so3(r, out):
    """Rotation vector (3,) rad of a rotation (3, 3), through the quaternion of the largest component."""
    q = np.empty(4)
    d0, d1, d2 = r[0, 0], r[1, 1], r[2, 2]
    squares = np.array([1 + d0 + d1 + d2, 1 + d0 - d1 - d2, 1 - d0 + d1 - d2, 1 - d0 - d1 + d2])
    wx, wy, wz = r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]
    xy, xz, yz = r[0, 1] + r[1, 0], r[0, 2] + r[2, 0], r[1, 2] + r[2, 1]
    pivot = int(np.argmax(squares))
    if pivot == 0:
        q[0], q[1], q[2], q[3] = squares[0], wx, wy, wz
    elif pivot == 1:
        q[0], q[1], q[2], q[3] = wx, squares[1], xy, xz
    elif pivot == 2:
        q[0], q[1], q[2], q[3] = wy, xy, squares[2], yz
    else:
        q[0], q[1], q[2], q[3] = wz, xz, yz, squares[3]
    if q[0] < 0.0:
        q = -q
    length = np.sqrt(q[1] ** 2 + q[2] ** 2 + q[3] ** 2)
    whole = np.sqrt(q[0] ** 2 + length**2)
    factor = 2.0 / whole if length < 1e-9 * whole else 2.0 * np.arctan2(length, q[0]) / length
    for k in range(3):
        out[k] = factor * q[1 + k]


@njit(cache=True)
def _moved(r, w, out):
    """Out = r exp(w)."""
    step = np.empty((3, 3))
    exp_so3(w, step)
    for i in range(3):
        for k in range(3):
            out[i, k] = r[i, 0] * step[0, k] + r[i, 1] * step[1, k] + r[i, 2] * step[2, k]


@njit(cache=True)
def _between(a, b, out):
    """Out = log(a^T b)."""
    turn = np.empty((3, 3))
    for i in range(3):
        for k in range(3):
            turn[i, k] = a[0, i] * b[0, k] + a[1, i] * b[1, k] + a[2, i] * b[2, k]
    log_so3(turn, out)


@njit(cache=True)
def run_rotations(times, y, known, start, forward, back, ahead, out, rate):
    """As `run_vectors` for rotations y (n, 3, 3): the velocity is the body's own angular velocity (n, 3) rad/s, the
    error a rotation vector on the right (left-invariant).
    """
    n = times.size
    w, off = np.empty(3), np.empty(3)
    for t in range(start, n):
        if t == start:
            out[t], ahead[t] = y[t], y[t]
            rate[t] = 0.0
            continue
        for k in range(3):
            w[k] = (times[t] - times[t - 1]) * rate[t - 1, k]
        _moved(out[t - 1], w, ahead[t])
        out[t], rate[t] = ahead[t], rate[t - 1]
        if known[t]:
            _between(ahead[t], y[t], off)
            for k in range(3):
                w[k] = forward[t, 0] * off[k]
                rate[t, k] += forward[t, 1] * off[k]
            _moved(ahead[t], w, out[t])
    here, expected = np.empty((3, 3)), np.empty((3, 3))
    for t in range(n - 2, start - 1, -1):
        dt = times[t + 1] - times[t]
        for k in range(3):
            w[k] = dt * rate[t, k]
        here[:] = out[t]
        _moved(here, w, expected)
        _between(expected, out[t + 1], off)
        for k in range(3):
            faster = rate[t + 1, k] - rate[t, k]
            w[k] = back[t, 0, 0] * off[k] + back[t, 0, 1] * faster
            rate[t, k] += back[t, 1, 0] * off[k] + back[t, 1, 1] * faster
        _moved(here, w, out[t])
