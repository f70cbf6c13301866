"""Kalman filter and Rauch-Tung-Striebel smoother of an integrated Ornstein-Uhlenbeck process.

State (x, v): dx = v dt, dv = -v / τ dt + sqrt(q) dW (correlated random walk, Johnson et al. 2008).
Over dt: F = [[1, g], [0, a]], a = exp(-dt / τ), g = τ (1 - a); process noise
    Q11 = q τ^2 (dt - 2 τ (1 - a) + τ (1 - a^2) / 2), Q12 = q g^2 / 2, Q22 = q τ (1 - a^2) / 2.
Filter (Kalman 1960): K = P- H^T / (P-_11 + r); r is infinite where nothing was measured.
Smoother (Rauch, Tung and Striebel 1965), x' and P' one frame later, - for predicted, s for
smoothed:
    G = P F^T (P-')^-1, x_s = x + G (x_s' - F x), P_s = P + G (P_s' - P-') G^T.

All scalar coordinates of a group share one covariance (2, 2) of value and velocity, so only gains
are computed per frame, and every coordinate is moved by them. Positions (3) have one coupled state
of six. Rotations use the left-invariant error log(R^T R') on SO(3), with the body's own angular
velocity. In the code `fade` is τ, `drive` and `q` the process variance, `keep` is a, and `go` is g.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from liex_lab.body._kernels import exp_so3


@njit(cache=True)
def steps(times, fade, keep, go):
    """Fill the decay a and the velocity's gain times dt, g, of the step that leads to each frame.

    Args:
        times: (n,) s.
        fade: decay time τ, s.
        keep: (n,) output, a = exp(-dt / τ); 1 at the first frame.
        go: (n,) output, g = τ (1 - a), s; 0 at the first frame.
    """
    keep[0] = 1.0
    go[0] = 0.0
    for t in range(1, times.size):
        keep[t] = np.exp(-(times[t] - times[t - 1]) / fade)
        go[t] = fade * (1.0 - keep[t])


@njit(cache=True)
def gains(times, r, q, fade, start, keep, go, forward, back, filtered, predicted, smoothed):
    """Fill Kalman gains, RTS gains and covariances of one scalar coordinate over n frames.

    The prior at `start` is the measurement, with the velocity's stationary variance q τ / 2.

    Args:
        times: (n,) s.
        r: (n,) measurement variance, infinite where nothing was measured.
        q: process variance, the density of the noise on the velocity.
        fade: decay time τ, s.
        start: index of the first frame that was measured; frames before it are not filled.
        keep: (n,) output, the decay a of each step.
        go: (n,) output, g of each step, s.
        forward: (n, 2) output, Kalman gain of value and velocity.
        back: (n, 2, 2) output, RTS gain; not filled at the last frame.
        filtered: (n, 2, 2) output, covariance after each measurement.
        predicted: (n, 2, 2) output, covariance before it.
        smoothed: (n, 2, 2) output, covariance given all measurements.
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
    """Q11 / q, s^3: process variance of the value after dt s; a series for small dt / τ."""
    x = dt / fade
    if x < 1e-2:  # the differences below lose their digits
        return dt**3 * (1.0 / 3.0 - x / 4.0 + 7.0 * x * x / 60.0)
    a = np.exp(-x)
    return fade**2 * (dt - 2.0 * fade * (1.0 - a) + 0.5 * fade * (1.0 - a * a))


@njit(cache=True)
def run_vector(y, known, start, keep, go, forward, back, out, rate):
    """Filter and smooth one scalar coordinate with the gains of `gains`.

    Args:
        y: (n,) measured values; not read where `known` is False.
        known: (n,) bool, measured.
        start: index of the first measured frame; `out` is constant before it.
        keep: (n,) decay of each step.
        go: (n,) g of each step, s.
        forward: (n, 2) Kalman gains.
        back: (n, 2, 2) RTS gains.
        out: (n,) output, smoothed values.
        rate: (n,) output, smoothed velocities per second, from `start` on.
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
    """Filter and smooth positions with full measurement covariances; the state is (6,).

    Products are loops: matrices so small are not for BLAS.

    Args:
        times: (n,) s.
        y: (n, 3) measured positions, mm.
        r: (n, 3, 3) their covariances, mm^2.
        known: (n,) bool, measured.
        start: index of the first measured frame; `out` and `spread` are constant before it.
        drive: (3,) process variance along each axis, mm^2/s^3.
        fade: decay time τ, s.
        out: (n, 3) output, smoothed positions, mm.
        spread: (n, 3, 3) output, their covariances, mm^2.
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
    """Kalman prediction: fill ahead (6,) and m (6, 6) from a state and its covariance."""
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
    """Rauch-Tung-Striebel pass, in place, over states (n, 6) and covariances (n, 6, 6)."""
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
    """Logarithm of SO(3), through the quaternion's largest component, so that it is exact up to π.

    Args:
        r: (3, 3) rotation.
        out: (3,) output, rotation vector, rad.
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
    """Filter and smooth rotations by the left-invariant error: `run_vector` on SO(3).

    The velocity is the body's own angular velocity, rad/s, and the error a rotation vector on the
    right, R' = R exp(w). Each axis of the body has its own gains.

    Args:
        y: (n, 3, 3) measured rotations.
        known: (n,) bool, measured.
        start: index of the first measured frame; `out` is constant before it.
        keep: (3, n) decay of each step.
        go: (3, n) g of each step, s.
        forward: (3, n, 2) Kalman gains.
        back: (3, n, 2, 2) RTS gains.
        out: (n, 3, 3) output, smoothed rotations.
        rate: (n, 3) output, smoothed angular velocities, rad/s.
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
