"""Robust Kalman filter and RTS smoother of whole poses: Student-t errors by iterated reweighting.

`smoother` makes four passes of the smoother over all coordinates at once; these kernels do the work
between them. After each pass a frame t at the mean joint distance δ_t from the curve, in predicted
errors, gets the weight w_t = (ν + 1) / (ν + δ_t^2), by which its measurement variance is divided
(EM for the t distribution, Lange et al. 1989), and is excluded if δ_t is beyond the gate. Positions
are those of the joints' mean, with an error ellipsoid aligned with the animal; the root follows
from the mean. In the code `degrees_of_freedom` is ν, `gate` the gate and `correlated_share` the
correlated share, whose square is subtracted from the variance. The kernels are separate because a
single kernel that called the others would compile each of them again, which takes half a minute.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from liex_lab.body._skinning_kernels import place_joints
from liex_lab.geometry._kernels import cholesky, exp_so3, log_so3, substitute
from liex_lab.runtime.kernels import inner_kernel, kernel


class TrackPoses(NamedTuple):
    """Poses of n frames as arrays.

    Attributes:
        rotation: (n, 3, 3) of the root.
        place: (n, 3) position of the root, mm.
        angles: (n, J, 3) rad.
        log_scale: (n,) logarithm of the bones' scale.
        joints: (n, J, 3) mm.
    """

    rotation: NDArray[np.float64]
    place: NDArray[np.float64]
    angles: NDArray[np.float64]
    log_scale: NDArray[np.float64]
    joints: NDArray[np.float64]


class Spread(NamedTuple):
    """Posterior spread of n frames.

    Attributes:
        middle: (n, 3, 3) covariance of the joints' mean, mm^2.
        turn: (n, 3) variance of the base's rotation about its own axes, rad^2.
        bend: (n, 3) variance of the other joints' angles about their axes, rad^2.
    """

    middle: NDArray[np.float64]
    turn: NDArray[np.float64]
    bend: NDArray[np.float64]


@kernel()
def middles(joints, known, tip, middle, frame):
    """Fill the joints' mean of each frame, and the animal's own axes in measured frames.

    Args:
        joints: (n, J, 3) measured joints, mm.
        known: (n,) bool, measured.
        tip: the joint at the opposite end from the base.
        middle: (n, 3) output, mm.
        frame: (n, 3, 3) output, columns along the animal, sideways and up.
    """
    n_joints = joints.shape[1]
    for t in range(known.size):
        for k in range(3):
            total = 0.0
            for j in range(n_joints):
                total += joints[t, j, k]
            middle[t, k] = total / n_joints
        if known[t]:
            _own_frame(joints[t, tip], joints[t, 0], frame[t])


@kernel()
def weigh(measured, made, error, known, degrees_of_freedom, gate, weight, used):
    """Fill measurement weights from their distances to the curve; returns how many are used.

    Args:
        measured: (n, J, 3) measured joints, mm.
        made: (n, J, 3) joints of the curve, mm.
        error: (n,) predicted mean joint error, mm.
        known: (n,) bool, measured.
        degrees_of_freedom: of the errors' t distribution.
        gate: predicted errors beyond which a measurement is excluded.
        weight: (n,) output at measured frames.
        used: (n,) bool output at measured frames, frames within the gate.
    """
    n_joints = measured.shape[1]
    n_used = 0
    for t in range(known.size):
        if known[t]:
            off = 0.0
            for j in range(n_joints):
                apart = 0.0
                for k in range(3):
                    apart += (measured[t, j, k] - made[t, j, k]) ** 2
                off += np.sqrt(apart) / n_joints
            off /= error[t]
            weight[t] = (degrees_of_freedom + 1.0) / (degrees_of_freedom + off * off)
            used[t] = off <= gate
            n_used += used[t]
    return n_used


@kernel()
def measured_spread(frame, error, weight, used, position_error, correlated_share, variance, r):
    """Fill the variance of each measurement, and the covariance of the joints' mean.

    Args:
        frame: (n, 3, 3) the animal's own axes.
        error: (n,) predicted mean joint error, mm.
        weight: (n,) divisor of the variance.
        used: (n,) bool, frames within the gate.
        position_error: (3,) over the predicted error, along the animal, sideways, up.
        correlated_share: share of an error whose square is subtracted.
        variance: (n,) output at used frames, mm^2.
        r: (n, 3, 3) output, added to at used frames, mm^2.
    """
    for t in range(error.size):
        if used[t]:
            variance[t] = (1.0 - correlated_share**2) * error[t] ** 2 / weight[t]
            for i in range(3):
                for k in range(3):
                    for a in range(3):
                        r[t, i, k] += (
                            frame[t, i, a] * frame[t, k, a] * variance[t] * position_error[a] ** 2
                        )


@kernel()
def place_middles(body, middle, made):
    """Translate poses so that their joints have the given means.

    Args:
        body: `KinematicTree` of the skeleton.
        middle: (n, 3) mm.
        made: `TrackPoses` whose place and joints are filled.
    """
    n_joints = body.parents.size
    made.place[:] = 0.0
    place_joints(
        body,
        made.rotation,
        made.place,
        made.angles,
        np.exp(made.log_scale),
        made.joints,
    )
    for t in range(middle.shape[0]):
        for k in range(3):
            mean = 0.0
            for j in range(n_joints):
                mean += made.joints[t, j, k] / n_joints
            made.place[t, k] = middle[t, k] - mean
            for j in range(n_joints):
                made.joints[t, j, k] += made.place[t, k]


@inner_kernel()
def _own_frame(tip, base, out):
    """Axes (3, 3) as columns: from base to tip (3,), sideways and level, and up."""
    x = tip[0] - base[0]
    y = tip[1] - base[1]
    z = tip[2] - base[2]
    length = max(np.sqrt(x**2 + y**2 + z**2), 1e-9)
    x /= length
    y /= length
    z /= length
    side_x = -y
    side_y = x
    level = np.sqrt(side_x**2 + side_y**2)
    if level < 1e-6:
        side_x = 0.0
        side_y = 1.0
        level = 1.0
        x, y, z = 0.0, 0.0, 1.0 if z >= 0 else -1.0
    side_x /= level
    side_y /= level
    side_z = 0.0
    out[0, 0] = x
    out[1, 0] = y
    out[2, 0] = z
    out[0, 1] = side_x
    out[1, 1] = side_y
    out[2, 1] = side_z
    out[0, 2] = y * side_z - z * side_y
    out[1, 2] = z * side_x - x * side_z
    out[2, 2] = x * side_y - y * side_x


# Kalman filter and Rauch-Tung-Striebel smoother of an integrated Ornstein-Uhlenbeck process.


class Gains(NamedTuple):
    """Filter and smoother gains of a group of coordinates over n frames, of one axis or (3, ...).

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
        """Zero gains of three axes over n frames."""
        return cls(np.zeros((3, n)), np.zeros((3, n)), np.zeros((3, n, 2)), np.zeros((3, n, 2, 2)))

    def axis(self, a: int) -> Gains:
        """Views of the gains of one of three axes."""
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
        """Zero covariances over n frames."""
        return cls(np.zeros((n, 2, 2)), np.zeros((n, 2, 2)), np.zeros((n, 2, 2)))


@kernel()
def _copy(a, out):
    """Out = a, both (k, l); assigning whole rows compiles to ten times the code."""
    for i in range(out.shape[0]):
        for k in range(out.shape[1]):
            out[i, k] = a[i, k]


@kernel()
def gains(times, r, q, tau, start, gain, covariances):
    """Fill Kalman gains, RTS gains and covariances of one scalar coordinate over n frames.

    The prior at `start` is the measurement, with the velocity's stationary variance q τ / 2.

    Args:
        times: (n,) s.
        r: (n,) measurement variance, infinite without a measurement.
        q: process variance, the density of the noise on the velocity.
        tau: decay time τ, s.
        start: index of the first measured frame; earlier frames are not filled.
        gain: `Gains`, output.
        covariances: `Covariances`, output.
    """
    n = times.size
    decay, gain_dt, kalman_gain, rts_gain = gain
    filtered, predicted, smoothed = covariances
    p = np.empty((2, 2))
    decay[0] = 1.0
    gain_dt[0] = 0.0
    for t in range(1, n):
        decay[t] = np.exp(-(times[t] - times[t - 1]) / tau)
        gain_dt[t] = tau * (1.0 - decay[t])
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
            a, b = p[0, 0], p[0, 1]
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
                k0, k1 = kalman_gain[t, 0], kalman_gain[t, 1]
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


@inner_kernel()
def _value_variance(dt, tau):
    """Q11 / q, s^3: process variance of the value after dt s; a series for small dt / τ."""
    x = dt / tau
    if x < 1e-2:  # the differences below lose precision
        return dt**3 * (1.0 / 3.0 - x / 4.0 + 7.0 * x * x / 60.0)
    a = np.exp(-x)
    return tau**2 * (dt - 2.0 * tau * (1.0 - a) + 0.5 * tau * (1.0 - a * a))


@kernel()
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
    decay, gain_dt, kalman_gain, rts_gain = gain
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


@kernel()
def smooth_positions(times, y, r, known, start, process_variance, tau, out, spread):
    """Filter and smooth positions with full measurement covariances; the state is (6,).

    Products are loops: the matrices are too small for BLAS.

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
                for j in range(i + 1):  # lower triangle only: asymmetric rounding would grow
                    p[t, i, j] -= gain[i, k] * m[t, k, j]
        for i in range(6):
            for j in range(i):
                p[t, j, i] = p[t, i, j]
    _rts_pass(times, tau, start, state, p, ahead, m)
    for t in range(n):
        for k in range(3):
            out[t, k] = state[max(t, start), k]
        _copy(p[max(t, start)], spread[t])


@kernel()
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


@inner_kernel()
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


@inner_kernel()
def _multiply(a, b, out):
    """Out = a b, all (6, 6)."""
    for i in range(6):
        for k in range(6):
            total = 0.0
            for j in range(6):
                total += a[i, j] * b[j, k]
            out[i, k] = total


@inner_kernel()
def _invert(a, out, work):
    """Out = inverse of a symmetric positive definite matrix (k, k), by Cholesky in `work`."""
    cholesky(a, work, 1e-300)
    out[:] = 0.0
    for c in range(a.shape[0]):
        out[c, c] = 1.0
        substitute(work, out[:, c])


@kernel()
def _moved(r, w, out):
    """Out = r exp(w)."""
    step = np.empty((3, 3))
    exp_so3(w[0], w[1], w[2], step)
    for i in range(3):
        for k in range(3):
            out[i, k] = r[i, 0] * step[0, k] + r[i, 1] * step[1, k] + r[i, 2] * step[2, k]


@kernel()
def _between(a, b, out):
    """Out = log(a^T b)."""
    turn = np.empty((3, 3))
    for i in range(3):
        for k in range(3):
            turn[i, k] = a[0, i] * b[0, k] + a[1, i] * b[1, k] + a[2, i] * b[2, k]
    log_so3(turn, out)


@kernel()
def smooth_rotations(y, known, start, gain, out, rate):
    """Filter and smooth rotations by the left-invariant error: `smooth_values` on SO(3).

    The velocity is the angular velocity in the body frame, rad/s, and the error a rotation vector
    on the right, R' = R exp(w). Each axis of the body has its own gains.

    Args:
        y: (n, 3, 3) measured rotations.
        known: (n,) bool, measured.
        start: index of the first measured frame; `out` is constant before it.
        gain: `Gains` (3, ...) of the three axes.
        out: (n, 3, 3) output, smoothed rotations.
        rate: (n, 3) output, smoothed angular velocities, rad/s.
    """
    decay, gain_dt, kalman_gain, rts_gain = gain
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
