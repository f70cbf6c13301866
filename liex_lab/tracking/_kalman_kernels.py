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
velocity. In the code `tau` is τ, `process_variance` and `q` the process variance, `decay` is a, and
`gain_dt` is g.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import njit

from liex_lab.geometry._cholesky_kernels import cholesky, substitute
from liex_lab.geometry._so3_kernels import exp_so3, log_so3


class Gains(NamedTuple):
    """How the coordinates of a group are moved over n frames; one axis, or (3, ...) of three.

    Attributes:
        decay: (n,) decay a of the step that leads to each frame.
        gain_dt: (n,) g of each step, s.
        kalman_gain: (n, 2) Kalman gain of value and velocity.
        rts_gain: (n, 2, 2) RTS gain; not filled at the last frame.
    """

    decay: Any
    gain_dt: Any
    kalman_gain: Any
    rts_gain: Any

    @classmethod
    def blank(cls, n: int) -> Gains:
        """Gains of three axes over n frames, not filled yet.

        Args:
            n: number of frames.
        """
        return cls(np.zeros((3, n)), np.zeros((3, n)), np.zeros((3, n, 2)), np.zeros((3, n, 2, 2)))

    def axis(self, a: int) -> Gains:
        """The gains of one of three axes; views.

        Args:
            a: number of the axis.
        """
        return Gains(*(values[a] for values in self))


class Covariances(NamedTuple):
    """Covariances of a group's value and velocity over n frames.

    Attributes:
        filtered: (n, 2, 2) after each measurement.
        predicted: (n, 2, 2) before it.
        smoothed: (n, 2, 2) given all measurements.
    """

    filtered: Any
    predicted: Any
    smoothed: Any

    @classmethod
    def blank(cls, n: int) -> Covariances:
        """Covariances over n frames, not filled yet.

        Args:
            n: number of frames.
        """
        return cls(np.zeros((n, 2, 2)), np.zeros((n, 2, 2)), np.zeros((n, 2, 2)))


@njit(cache=True)
def _copy(a, out):
    """Out = a, both (k, l): an assignment of rows compiles to ten times as much."""
    for i in range(out.shape[0]):
        for k in range(out.shape[1]):
            out[i, k] = a[i, k]


@njit(cache=True)
def steps(times, tau, decay, gain_dt):
    """Fill the decay a and the velocity's gain times dt, g, of the step that leads to each frame.

    Args:
        times: (n,) s.
        tau: decay time τ, s.
        decay: (n,) output, a = exp(-dt / τ); 1 at the first frame.
        gain_dt: (n,) output, g = τ (1 - a), s; 0 at the first frame.
    """
    decay[0] = 1.0
    gain_dt[0] = 0.0
    for t in range(1, times.size):
        decay[t] = np.exp(-(times[t] - times[t - 1]) / tau)
        gain_dt[t] = tau * (1.0 - decay[t])


@njit(cache=True)
def gains(times, r, q, tau, start, gain, covariances):
    """Fill Kalman gains, RTS gains and covariances of one scalar coordinate over n frames.

    The prior at `start` is the measurement, with the velocity's stationary variance q τ / 2.

    Args:
        times: (n,) s.
        r: (n,) measurement variance, infinite where nothing was measured.
        q: process variance, the density of the noise on the velocity.
        tau: decay time τ, s.
        start: index of the first frame that was measured; frames before it are not filled.
        gain: `Gains`, output.
        covariances: `Covariances`, output.
    """
    n = times.size
    decay = gain.decay
    gain_dt = gain.gain_dt
    kalman_gain = gain.kalman_gain
    rts_gain = gain.rts_gain
    filtered = covariances.filtered
    predicted = covariances.predicted
    smoothed = covariances.smoothed
    p = np.empty((2, 2))
    steps(times, tau, decay, gain_dt)
    for t in range(start, n):
        if t == start:
            p[0, 0] = r[t]
            p[0, 1] = 0.0
            p[1, 0] = 0.0
            p[1, 1] = 0.5 * q * tau
            _copy(p, predicted[t])
            kalman_gain[t, 0] = 1.0
            kalman_gain[t, 1] = 0.0
        else:
            k = decay[t]
            g = gain_dt[t]
            a = p[0, 0]
            b = p[0, 1]
            c = p[1, 1]
            p[0, 0] = a + 2 * g * b + g * g * c + q * _value_variance(times[t] - times[t - 1], tau)
            p[0, 1] = k * (b + g * c) + q * 0.5 * g * g
            p[1, 1] = k * k * c + q * 0.5 * tau * (1 - k * k)
            p[1, 0] = p[0, 1]
            _copy(p, predicted[t])
            s = p[0, 0] + r[t]
            kalman_gain[t, 0] = p[0, 0] / s
            kalman_gain[t, 1] = p[0, 1] / s
            if np.isfinite(r[t]):
                k0 = kalman_gain[t, 0]
                k1 = kalman_gain[t, 1]
                p[1, 1] -= k1 * p[0, 1]
                p[0, 1] = (1 - k0) * p[0, 1]
                p[0, 0] = (1 - k0) * p[0, 0]
                p[1, 0] = p[0, 1]
        _copy(p, filtered[t])
    _copy(filtered[n - 1], smoothed[n - 1])
    for t in range(n - 2, start - 1, -1):
        k = decay[t + 1]
        g = gain_dt[t + 1]
        f = filtered[t]
        m = predicted[t + 1]
        det = m[0, 0] * m[1, 1] - m[0, 1] * m[1, 0]
        # filtered @ transition^T @ inverse of predicted
        u00 = f[0, 0] + g * f[0, 1]
        u01 = k * f[0, 1]
        u10 = f[1, 0] + g * f[1, 1]
        u11 = k * f[1, 1]
        rts_gain[t, 0, 0] = (u00 * m[1, 1] - u01 * m[1, 0]) / det
        rts_gain[t, 0, 1] = (u01 * m[0, 0] - u00 * m[0, 1]) / det
        rts_gain[t, 1, 0] = (u10 * m[1, 1] - u11 * m[1, 0]) / det
        rts_gain[t, 1, 1] = (u11 * m[0, 0] - u10 * m[0, 1]) / det
        for i in range(2):
            for j in range(2):
                p[i, j] = smoothed[t + 1, i, j] - m[i, j]
        back = rts_gain[t] @ p @ rts_gain[t].T
        for i in range(2):
            for j in range(2):
                smoothed[t, i, j] = f[i, j] + back[i, j]


@njit(cache=True)
def _value_variance(dt, tau):
    """Q11 / q, s^3: process variance of the value after dt s; a series for small dt / τ."""
    x = dt / tau
    if x < 1e-2:  # the differences below lose their digits
        return dt**3 * (1.0 / 3.0 - x / 4.0 + 7.0 * x * x / 60.0)
    a = np.exp(-x)
    return tau**2 * (dt - 2.0 * tau * (1.0 - a) + 0.5 * tau * (1.0 - a * a))


@njit(cache=True)
def smooth_values(y, known, start, gain, out, rate):
    """Filter and smooth one scalar coordinate with the gains of `gains`.

    Args:
        y: (n,) measured values; not read where `known` is False.
        known: (n,) bool, measured.
        start: index of the first measured frame; `out` is constant before it.
        gain: `Gains` of the coordinate's group.
        out: (n,) output, smoothed values.
        rate: (n,) output, smoothed velocities per second, from `start` on.
    """
    decay = gain.decay
    gain_dt = gain.gain_dt
    kalman_gain = gain.kalman_gain
    rts_gain = gain.rts_gain
    n = y.size
    out[start] = y[start]
    rate[start] = 0.0
    for t in range(start + 1, n):
        out[t] = out[t - 1] + gain_dt[t] * rate[t - 1]
        rate[t] = decay[t] * rate[t - 1]
        if known[t]:
            off = y[t] - out[t]
            out[t] += kalman_gain[t, 0] * off
            rate[t] += kalman_gain[t, 1] * off
    for t in range(n - 2, start - 1, -1):
        d0 = out[t + 1] - (out[t] + gain_dt[t + 1] * rate[t])
        d1 = rate[t + 1] - decay[t + 1] * rate[t]
        out[t] += rts_gain[t, 0, 0] * d0 + rts_gain[t, 0, 1] * d1
        rate[t] += rts_gain[t, 1, 0] * d0 + rts_gain[t, 1, 1] * d1
    for t in range(start):
        out[t] = out[start]


@njit(cache=True)
def smooth_positions(times, y, r, known, start, process_variance, tau, out, spread):
    """Filter and smooth positions with full measurement covariances; the state is (6,).

    Products are loops: matrices so small are not for BLAS.

    Args:
        times: (n,) s.
        y: (n, 3) measured positions, mm.
        r: (n, 3, 3) their covariances, mm^2.
        known: (n,) bool, measured.
        start: index of the first measured frame; `out` and `spread` are constant before it.
        process_variance: (3,) process variance along each axis, mm^2/s^3.
        tau: decay time τ, s.
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
        m[start, 3 + k, 3 + k] = 0.5 * process_variance[k] * tau
        for i in range(3):
            m[start, i, k] = 1e3 * r[start, i, k]
    for k in range(3):
        ahead[start, k] = y[start, k]
    for t in range(start, n):
        if t > start:
            _predict(
                state[t - 1],
                p[t - 1],
                times[t] - times[t - 1],
                process_variance,
                tau,
                ahead[t],
                m[t],
            )
        for k in range(6):
            state[t, k] = ahead[t, k]
        _copy(m[t], p[t])
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
    _rts_pass(times, tau, start, state, p, ahead, m)
    for t in range(n):
        for k in range(3):
            out[t, k] = state[max(t, start), k]
        _copy(p[max(t, start)], spread[t])


@njit(cache=True)
def _predict(state, p, dt, process_variance, tau, ahead, m):
    """Kalman prediction: fill ahead (6,) and m (6, 6) from a state and its covariance."""
    decay = np.exp(-dt / tau)
    gain_dt = tau * (1.0 - decay)
    way = _value_variance(dt, tau)
    for k in range(3):
        ahead[k] = state[k] + gain_dt * state[3 + k]
        ahead[3 + k] = decay * state[3 + k]
        for i in range(3):
            m[i, k] = (
                p[i, k]
                + gain_dt * (p[3 + i, k] + p[i, 3 + k])
                + gain_dt * gain_dt * p[3 + i, 3 + k]
            )
            m[i, 3 + k] = decay * (p[i, 3 + k] + gain_dt * p[3 + i, 3 + k])
            m[3 + k, i] = m[i, 3 + k]
            m[3 + i, 3 + k] = decay * decay * p[3 + i, 3 + k]
    for k in range(3):
        m[k, k] += process_variance[k] * way
        m[k, 3 + k] += process_variance[k] * 0.5 * gain_dt * gain_dt
        m[3 + k, k] = m[k, 3 + k]
        m[3 + k, 3 + k] += process_variance[k] * 0.5 * tau * (1.0 - decay * decay)


@njit(cache=True)
def _rts_pass(times, tau, start, state, p, ahead, m):
    """Rauch-Tung-Striebel pass, in place, over states (n, 6) and covariances (n, 6, 6)."""
    inverse = np.zeros((6, 6))
    work = np.zeros((6, 6))
    forth = np.zeros((6, 6))
    rts_gain = np.zeros((6, 6))
    change = np.zeros((6, 6))
    for t in range(times.size - 2, start - 1, -1):
        decay = np.exp(-(times[t + 1] - times[t]) / tau)
        gain_dt = tau * (1.0 - decay)
        for i in range(6):
            for k in range(3):
                forth[i, k] = p[t, i, k] + gain_dt * p[t, i, 3 + k]
                forth[i, 3 + k] = decay * p[t, i, 3 + k]
        _invert(m[t + 1], inverse, work)
        _multiply(forth, inverse, rts_gain)
        for i in range(6):
            for k in range(6):
                state[t, i] += rts_gain[i, k] * (state[t + 1, k] - ahead[t + 1, k])
                change[i, k] = p[t + 1, i, k] - m[t + 1, i, k]
        _multiply(rts_gain, change, work)
        for i in range(6):
            for k in range(6):
                total = 0.0
                for j in range(6):
                    total += work[i, j] * rts_gain[k, j]
                p[t, i, k] += total


@njit(cache=True)
def _multiply(a, b, out):
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
    cholesky(a, work, 1e-300)
    out[:] = 0.0
    for c in range(a.shape[0]):
        out[c, c] = 1.0
        substitute(work, out[:, c])


@njit(cache=True)
def _moved(r, w, out):
    """Out = r exp(w)."""
    step = np.empty((3, 3))
    exp_so3(w[0], w[1], w[2], step)
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
def smooth_rotations(y, known, start, gain, out, rate):
    """Filter and smooth rotations by the left-invariant error: `smooth_values` on SO(3).

    The velocity is the body's own angular velocity, rad/s, and the error a rotation vector on the
    right, R' = R exp(w). Each axis of the body has its own gains.

    Args:
        y: (n, 3, 3) measured rotations.
        known: (n,) bool, measured.
        start: index of the first measured frame; `out` is constant before it.
        gain: `Gains` (3, ...) of the three axes.
        out: (n, 3, 3) output, smoothed rotations.
        rate: (n, 3) output, smoothed angular velocities, rad/s.
    """
    decay = gain.decay
    gain_dt = gain.gain_dt
    kalman_gain = gain.kalman_gain
    rts_gain = gain.rts_gain
    n = known.size
    w = np.empty(3)
    off = np.empty(3)
    ahead = np.empty((3, 3))
    _copy(y[start], out[start])
    for k in range(3):
        rate[start, k] = 0.0
    for t in range(start + 1, n):
        for k in range(3):
            w[k] = gain_dt[k, t] * rate[t - 1, k]
            rate[t, k] = decay[k, t] * rate[t - 1, k]
        _moved(out[t - 1], w, ahead)
        _copy(ahead, out[t])
        if known[t]:
            _between(ahead, y[t], off)
            for k in range(3):
                w[k] = kalman_gain[k, t, 0] * off[k]
                rate[t, k] += kalman_gain[k, t, 1] * off[k]
            _moved(ahead, w, out[t])
    here = np.empty((3, 3))
    expected = np.empty((3, 3))
    for t in range(n - 2, start - 1, -1):
        for k in range(3):
            w[k] = gain_dt[k, t + 1] * rate[t, k]
        _copy(out[t], here)
        _moved(here, w, expected)
        _between(expected, out[t + 1], off)
        for k in range(3):
            faster = rate[t + 1, k] - decay[k, t + 1] * rate[t, k]
            w[k] = rts_gain[k, t, 0, 0] * off[k] + rts_gain[k, t, 0, 1] * faster
            rate[t, k] += rts_gain[k, t, 1, 0] * off[k] + rts_gain[k, t, 1, 1] * faster
        _moved(here, w, out[t])
    for t in range(start):
        _copy(out[start], out[t])
