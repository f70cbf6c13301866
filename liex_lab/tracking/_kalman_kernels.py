"""Kernels of the smoother: a filter of value and velocity and its way back, for vectors and for
rotations.

All coordinates of a group share one covariance (2, 2) of value and velocity, so only gains are
computed per frame, and every coordinate is moved by them. The velocity dies away within `fade`
seconds and is driven by white noise of density q (an integrated Ornstein-Uhlenbeck process; Johnson
et al. 2008); a frame's value is measured with variance r, infinite where nothing was measured.
Within dt the value goes on by go[t] times the velocity, of which keep[t] is left.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from liex_lab.body._kernels import exp_so3


@njit(cache=True)
def steps(times, fade, keep, go):
    """Fill keep (n,) and go (n,) s of the steps that lead to each frame."""
    keep[0] = 1.0
    go[0] = 0.0
    for t in range(1, times.size):
        keep[t] = np.exp(-(times[t] - times[t - 1]) / fade)
        go[t] = fade * (1.0 - keep[t])


@njit(cache=True)
def gains(times, r, q, fade, start, keep, go, forward, back, filtered, predicted, smoothed):
    """Gains and variances of n frames: forward (n, 2) of value and velocity, back (n, 2, 2) of the
    way back.

    filtered, predicted, smoothed (n, 2, 2) are covariances; start: the first frame that was
    measured.
    """
    n = times.size
    p = np.empty((2, 2))
    steps(times, fade, keep, go)
    for t in range(start, n):
        if t == start:
            p[0, 0] = r[t]
            p[0, 1] = 0.0
            p[1, 0] = 0.0
            p[1, 1] = 0.5 * q * fade
            predicted[t] = p
            forward[t, 0] = 1.0
            forward[t, 1] = 0.0
        else:
            k = keep[t]
            g = go[t]
            a = p[0, 0]
            b = p[0, 1]
            c = p[1, 1]
            p[0, 0] = a + 2 * g * b + g * g * c + q * _way(times[t] - times[t - 1], fade)
            p[0, 1] = k * (b + g * c) + q * 0.5 * g * g
            p[1, 1] = k * k * c + q * 0.5 * fade * (1 - k * k)
            p[1, 0] = p[0, 1]
            predicted[t] = p
            s = p[0, 0] + r[t]
            forward[t, 0] = p[0, 0] / s
            forward[t, 1] = p[0, 1] / s
            if np.isfinite(r[t]):
                k0 = forward[t, 0]
                k1 = forward[t, 1]
                p[1, 1] -= k1 * p[0, 1]
                p[0, 1] = (1 - k0) * p[0, 1]
                p[0, 0] = (1 - k0) * p[0, 0]
                p[1, 0] = p[0, 1]
        filtered[t] = p
    smoothed[n - 1] = filtered[n - 1]
    for t in range(n - 2, start - 1, -1):
        k = keep[t + 1]
        g = go[t + 1]
        f = filtered[t]
        m = predicted[t + 1]
        det = m[0, 0] * m[1, 1] - m[0, 1] * m[1, 0]
        # filtered @ transition^T @ inverse of predicted
        u00 = f[0, 0] + g * f[0, 1]
        u01 = k * f[0, 1]
        u10 = f[1, 0] + g * f[1, 1]
        u11 = k * f[1, 1]
        back[t, 0, 0] = (u00 * m[1, 1] - u01 * m[1, 0]) / det
        back[t, 0, 1] = (u01 * m[0, 0] - u00 * m[0, 1]) / det
        back[t, 1, 0] = (u10 * m[1, 1] - u11 * m[1, 0]) / det
        back[t, 1, 1] = (u11 * m[0, 0] - u10 * m[0, 1]) / det
        smoothed[t] = f + back[t] @ (smoothed[t + 1] - m) @ back[t].T


@njit(cache=True)
def _way(dt, fade):
    """Variance of the value after dt s of unit noise on the velocity."""
    x = dt / fade
    if x < 1e-2:  # the differences below lose their digits
        return dt**3 * (1.0 / 3.0 - x / 4.0 + 7.0 * x * x / 60.0)
    a = np.exp(-x)
    return fade**2 * (dt - 2.0 * fade * (1.0 - a) + 0.5 * fade * (1.0 - a * a))


@njit(cache=True)
def run_vector(y, known, start, keep, go, forward, back, out, rate):
    """Filter values y (n,), smooth them into out (n,) and their rates (n,) per second; known (n,):
    measured.
    """
    n = y.size
    out[start] = y[start]
    rate[start] = 0.0
    for t in range(start + 1, n):
        out[t] = out[t - 1] + go[t] * rate[t - 1]
        rate[t] = keep[t] * rate[t - 1]
        if known[t]:
            off = y[t] - out[t]
            out[t] += forward[t, 0] * off
            rate[t] += forward[t, 1] * off
    for t in range(n - 2, start - 1, -1):
        d0 = out[t + 1] - (out[t] + go[t + 1] * rate[t])
        d1 = rate[t + 1] - keep[t + 1] * rate[t]
        out[t] += back[t, 0, 0] * d0 + back[t, 0, 1] * d1
        rate[t] += back[t, 1, 0] * d0 + back[t, 1, 1] * d1
    for t in range(start):
        out[t] = out[start]


@njit(cache=True)
def run_place(times, y, r, known, start, drive, fade, out, spread):
    """Filter places y (n, 3) mm measured with covariances r (n, 3, 3) and smooth them into out (n,
    3), with their covariances `spread` (n, 3, 3); drive (3,): along each axis. Products are loops:
    matrices so small are not for BLAS.
    """
    n = y.shape[0]
    state = np.zeros((n, 6))
    p = np.zeros((n, 6, 6))
    ahead = np.zeros((n, 6))
    m = np.zeros((n, 6, 6))
    s = np.zeros((3, 3))
    gain = np.zeros((6, 3))
    inverse = np.zeros((6, 6))
    work = np.zeros((6, 6))
    for k in range(3):
        m[start, 3 + k, 3 + k] = 0.5 * drive[k] * fade
        for i in range(3):
            m[start, i, k] = 1e3 * r[start, i, k]
    for k in range(3):
        ahead[start, k] = y[start, k]
    for t in range(start, n):
        if t > start:
            _go_on(state[t - 1], p[t - 1], times[t] - times[t - 1], drive, fade, ahead[t], m[t])
        state[t] = ahead[t]
        p[t] = m[t]
        if not known[t]:
            continue
        for i in range(3):
            for k in range(3):
                s[i, k] = m[t, i, k] + r[t, i, k]
        _invert(s, inverse[:3, :3], work)
        for i in range(6):
            for k in range(3):
                gain[i, k] = (
                    m[t, i, 0] * inverse[0, k]
                    + m[t, i, 1] * inverse[1, k]
                    + m[t, i, 2] * inverse[2, k]
                )
        for i in range(6):
            for k in range(3):
                state[t, i] += gain[i, k] * (y[t, k] - ahead[t, k])
                for j in range(i + 1):  # one half: rounding that differs between the two would grow
                    p[t, i, j] -= gain[i, k] * m[t, k, j]
        for i in range(6):
            for j in range(i):
                p[t, j, i] = p[t, i, j]
    _way_back(times, fade, start, state, p, ahead, m)
    for t in range(n):
        out[t] = state[max(t, start), :3]
        spread[t] = p[max(t, start), :3, :3]


@njit(cache=True)
def _go_on(state, p, dt, drive, fade, ahead, m):
    """Fill ahead (6,) and m (6, 6) with what becomes of a state and its covariance in dt s."""
    keep = np.exp(-dt / fade)
    go = fade * (1.0 - keep)
    way = _way(dt, fade)
    for k in range(3):
        ahead[k] = state[k] + go * state[3 + k]
        ahead[3 + k] = keep * state[3 + k]
        for i in range(3):
            m[i, k] = p[i, k] + go * (p[3 + i, k] + p[i, 3 + k]) + go * go * p[3 + i, 3 + k]
            m[i, 3 + k] = keep * (p[i, 3 + k] + go * p[3 + i, 3 + k])
            m[3 + k, i] = m[i, 3 + k]
            m[3 + i, 3 + k] = keep * keep * p[3 + i, 3 + k]
    for k in range(3):
        m[k, k] += drive[k] * way
        m[k, 3 + k] += drive[k] * 0.5 * go * go
        m[3 + k, k] = m[k, 3 + k]
        m[3 + k, 3 + k] += drive[k] * 0.5 * fade * (1.0 - keep * keep)


@njit(cache=True)
def _way_back(times, fade, start, state, p, ahead, m):
    """Turn filtered states (n, 6) and covariances (n, 6, 6) into smoothed ones."""
    inverse = np.zeros((6, 6))
    work = np.zeros((6, 6))
    forth = np.zeros((6, 6))
    back = np.zeros((6, 6))
    change = np.zeros((6, 6))
    for t in range(times.size - 2, start - 1, -1):
        keep = np.exp(-(times[t + 1] - times[t]) / fade)
        go = fade * (1.0 - keep)
        for i in range(6):
            for k in range(3):
                forth[i, k] = p[t, i, k] + go * p[t, i, 3 + k]
                forth[i, 3 + k] = keep * p[t, i, 3 + k]
        _invert(m[t + 1], inverse, work)
        _times(forth, inverse, back)
        for i in range(6):
            for k in range(6):
                state[t, i] += back[i, k] * (state[t + 1, k] - ahead[t + 1, k])
                change[i, k] = p[t + 1, i, k] - m[t + 1, i, k]
        _times(back, change, work)
        for i in range(6):
            for k in range(6):
                total = 0.0
                for j in range(6):
                    total += work[i, j] * back[k, j]
                p[t, i, k] += total


@njit(cache=True)
def _times(a, b, out):
    """Out = a b, all (6, 6)."""
    for i in range(6):
        for k in range(6):
            total = 0.0
            for j in range(6):
                total += a[i, j] * b[j, k]
            out[i, k] = total


@njit(cache=True)
def _invert(a, out, work):
    """Out = the inverse of a symmetric positive definite matrix (k, k), by its Cholesky factor in
    `work`.
    """
    n = a.shape[0]
    for i in range(n):
        for j in range(i + 1):
            total = a[i, j]
            for k in range(j):
                total -= work[i, k] * work[j, k]
            work[i, j] = np.sqrt(max(total, 1e-300)) if i == j else total / work[j, j]
    for c in range(n):
        for i in range(n):
            total = 1.0 if i == c else 0.0
            for k in range(i):
                total -= work[i, k] * out[k, c]
            out[i, c] = total / work[i, i]
        for i in range(n - 1, -1, -1):
            total = out[i, c]
            for k in range(i + 1, n):
                total -= work[k, i] * out[k, c]
            out[i, c] = total / work[i, i]


@njit(cache=True)
def log_so3(r, out):
    """Rotation vector (3,) rad of a rotation (3, 3), through the quaternion of the largest
    component.
    """
    q = np.empty(4)
    d0 = r[0, 0]
    d1 = r[1, 1]
    d2 = r[2, 2]
    squares = np.array([1 + d0 + d1 + d2, 1 + d0 - d1 - d2, 1 - d0 + d1 - d2, 1 - d0 - d1 + d2])
    wx = r[2, 1] - r[1, 2]
    wy = r[0, 2] - r[2, 0]
    wz = r[1, 0] - r[0, 1]
    xy = r[0, 1] + r[1, 0]
    xz = r[0, 2] + r[2, 0]
    yz = r[1, 2] + r[2, 1]
    pivot = int(np.argmax(squares))
    if pivot == 0:
        q[0] = squares[0]
        q[1] = wx
        q[2] = wy
        q[3] = wz
    elif pivot == 1:
        q[0] = wx
        q[1] = squares[1]
        q[2] = xy
        q[3] = xz
    elif pivot == 2:
        q[0] = wy
        q[1] = xy
        q[2] = squares[2]
        q[3] = yz
    else:
        q[0] = wz
        q[1] = xz
        q[2] = yz
        q[3] = squares[3]
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
def run_rotations(y, known, start, keep, go, forward, back, out, rate):
    """As `run_vector` for rotations y (n, 3, 3): the velocity is the body's own angular velocity
    (n, 3) rad/s, the error a rotation vector on the right (left-invariant). Each axis of the body
    has its own gains: keep and go (3, n), forward (3, n, 2), back (3, n, 2, 2).
    """
    n = known.size
    w = np.empty(3)
    off = np.empty(3)
    ahead = np.empty((3, 3))
    out[start] = y[start]
    rate[start] = 0.0
    for t in range(start + 1, n):
        for k in range(3):
            w[k] = go[k, t] * rate[t - 1, k]
            rate[t, k] = keep[k, t] * rate[t - 1, k]
        _moved(out[t - 1], w, ahead)
        out[t] = ahead
        if known[t]:
            _between(ahead, y[t], off)
            for k in range(3):
                w[k] = forward[k, t, 0] * off[k]
                rate[t, k] += forward[k, t, 1] * off[k]
            _moved(ahead, w, out[t])
    here = np.empty((3, 3))
    expected = np.empty((3, 3))
    for t in range(n - 2, start - 1, -1):
        for k in range(3):
            w[k] = go[k, t + 1] * rate[t, k]
        here[:] = out[t]
        _moved(here, w, expected)
        _between(expected, out[t + 1], off)
        for k in range(3):
            faster = rate[t + 1, k] - keep[k, t + 1] * rate[t, k]
            w[k] = back[k, t, 0, 0] * off[k] + back[k, t, 0, 1] * faster
            rate[t, k] += back[k, t, 1, 0] * off[k] + back[k, t, 1, 1] * faster
        _moved(here, w, out[t])
    for t in range(start):
        out[t] = out[start]
