"""The filter and its way back, against SciPy's matrices and against a dense least-squares twin."""

import numpy as np
from scipy.linalg import expm

from liex_lab.geometry import so3
from liex_lab.tracking import _smoother_kernels as kernels
from liex_lab.tracking import _smoother_kernels as poses

TIMES = np.cumsum([0.0, 0.03, 0.03, 0.1, 0.03, 0.03, 0.2, 0.03, 0.03])
Q, FADE = 40.0, 0.3


def gains(times, r, q):
    """A group's gains and what is left: the first measured frame, gains; covariances."""
    n = len(times)
    gain, covariances = kernels.Gains.blank(n).axis(0), kernels.Covariances.blank(n)
    start = int(np.argmax(np.isfinite(r)))
    kernels.gains(times, r, q, FADE, start, gain, covariances)
    return (start, gain), covariances.smoothed


def smoothed(times, y, r, q):
    """A value's smoothed curve, rates and variances by the kernels."""
    how, after = gains(times, r, q)
    out, rate = np.zeros((2, len(times)))
    kernels.smooth_values(y, np.isfinite(r), *how, out, rate)
    return out, rate, after


def transition(dt, q):
    """Matrix (2, 2) and noise (2, 2) of the integrated Ornstein-Uhlenbeck process, by the
    exponential of Van Loan.
    """
    drift = np.array([[0.0, 1.0], [0.0, -1.0 / FADE]])
    whole = expm(dt * np.block([[-drift, np.diag([0.0, q])], [np.zeros((2, 2)), drift.T]]))
    return whole[2:, 2:].T, whole[2:, 2:].T @ whole[:2, 2:]


def by_least_squares(times, y, r, q):
    """The same from the joint Gaussian of all states at once: the slow twin. y (n, k), r
    (n, k, k).
    """
    n, k = y.shape
    size = 2 * k
    precision, right = np.zeros((size * n, size * n)), np.zeros(size * n)
    precision[k:size, k:size] += np.diag(1.0 / (0.5 * q * FADE))
    for t in range(1, n):
        noise, move = np.zeros((size, size)), np.zeros((size, size))
        for a in range(k):
            at = np.ix_([a, k + a], [a, k + a])
            move[at], noise[at] = transition(times[t] - times[t - 1], q[a])
        step = np.hstack([-move, np.eye(size)])
        rows = slice(size * (t - 1), size * (t + 1))
        precision[rows, rows] += step.T @ np.linalg.inv(noise) @ step
    for t in np.flatnonzero(np.isfinite(r[:, 0, 0])).tolist():
        rows = slice(size * t, size * t + k)
        precision[rows, rows] += np.linalg.inv(r[t])
        right[rows] += np.linalg.inv(r[t]) @ y[t]
    covariance = np.linalg.inv(precision)
    mean = (covariance @ right).reshape(n, size)
    parts = [covariance[size * t : size * (t + 1), size * t : size * (t + 1)] for t in range(n)]
    return mean[:, :k], mean[:, k:], np.array(parts)


def test_smoothing_agrees_with_all_states_solved_at_once():
    rng = np.random.default_rng(2)
    y, r = np.cumsum(rng.normal(0.0, 1.0, len(TIMES))), rng.uniform(0.5, 2.0, len(TIMES))
    r[[3, 6]] = np.inf
    out, rate, after = smoothed(TIMES, y, r, Q)
    value, speed, covariance = by_least_squares(TIMES, y[:, None], r[:, None, None], np.array([Q]))
    np.testing.assert_allclose(out, value[:, 0], rtol=1e-6, atol=1e-7)
    np.testing.assert_allclose(rate, speed[:, 0], rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(after, covariance, rtol=1e-5, atol=1e-8)


def test_places_that_are_measured_better_in_one_direction_agree_with_all_states_solved_at_once():
    rng = np.random.default_rng(4)
    y, root = (
        np.cumsum(rng.normal(0.0, 1.0, (len(TIMES), 3)), axis=0),
        rng.normal(0.0, 0.6, (len(TIMES), 3, 3)),
    )
    r, q = root @ np.swapaxes(root, 1, 2) + 0.01 * np.eye(3), np.array([40.0, 40.0, 5.0])
    known = np.ones(len(TIMES), bool)
    known[[3, 6]] = False
    out, spread = np.zeros(y.shape), np.zeros(r.shape)
    kernels.smooth_positions(TIMES, y, r, known, 0, q, FADE, out, spread)
    r[~known] = np.inf
    value, _, covariance = by_least_squares(TIMES, y, r, q)
    np.testing.assert_allclose(
        out, value, atol=5e-3
    )  # the filter starts from a wide guess, not from none
    np.testing.assert_allclose(spread, covariance[:, :3, :3], atol=5e-3)


def test_a_long_curve_of_places_stays_sound():
    rng = np.random.default_rng(5)
    n = 3000
    y, r = (
        np.cumsum(rng.normal(0.0, 1.0, (n, 3)), axis=0),
        np.tile(np.diag([0.2, 0.01, 0.1]), (n, 1, 1)),
    )
    out, spread = np.zeros(y.shape), np.zeros(r.shape)
    kernels.smooth_positions(
        0.02 * np.arange(n), y, r, np.ones(n, bool), 0, np.full(3, 1e5), 0.3, out, spread
    )
    assert np.abs(out - y).max() < 3.0
    assert np.linalg.eigvalsh(spread).min() > 0.0


def test_rotations_about_one_axis_are_smoothed_as_their_angles_are():
    rng = np.random.default_rng(3)
    angle = np.cumsum(rng.normal(0.3, 0.3, len(TIMES)))
    r = np.full(len(TIMES), 0.02)
    r[4] = np.inf
    out, _, _ = smoothed(TIMES, angle, r, 5.0)
    axis = np.array([1.0, 2.0, -2.0]) / 3.0
    y = so3.exp(angle[:, None] * axis)
    (start, gain), _ = gains(TIMES, r, 5.0)
    each = kernels.Gains(*(np.stack([values] * 3) for values in gain))
    turned, rate = np.zeros(y.shape), np.zeros((len(y), 3))
    kernels.smooth_rotations(y, np.isfinite(r), start, each, turned, rate)
    np.testing.assert_allclose(turned, so3.exp(out[:, None] * axis), atol=1e-9)


def test_weights_are_those_of_a_t_distribution_and_the_gate_leaves_frames_out():
    rng = np.random.default_rng(4)
    seen = rng.normal(0.0, 3.0, (30, 5, 3))
    made = seen + rng.normal(0.0, 1.0, seen.shape) * rng.uniform(0.1, 4.0, (30, 1, 1))
    error, known = rng.uniform(0.5, 2.0, 30), rng.random(30) < 0.8
    weight, used = np.ones(30), known.copy()
    n_used = poses.weigh(seen, made, error, known, 4.0, 3.0, weight, used)
    off = np.linalg.norm(seen - made, axis=2).mean(axis=1) / error
    np.testing.assert_array_equal(used, known & (off <= 3.0))
    np.testing.assert_allclose(weight, np.where(known, 5.0 / (4.0 + off**2), 1.0), rtol=1e-12)
    assert 0 < n_used == used.sum() < known.sum()
