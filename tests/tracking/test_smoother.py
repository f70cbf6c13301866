"""The filter and its way back, against SciPy's matrices and against a dense least-squares twin."""

from __future__ import annotations

import numpy as np
import pytest

from liex_lab.geometry import so3
from liex_lab.tracking import _filter as kernels
from liex_lab.tracking._joints import exp_so3

TIMES = np.cumsum([0.0, 0.03, 0.03, 0.1, 0.03, 0.03, 0.2, 0.03, 0.03])
Q = 40.0


def smoothed(times, y, r, q):
    """A group's smoothed values and variances by the kernels."""
    n = len(times)
    forward, back = np.zeros((n, 2)), np.zeros((n, 2, 2))
    filtered, predicted, after = np.zeros((3, n, 2, 2))
    start = int(np.argmax(np.isfinite(r)))
    kernels.gains(times, r, q, start, forward, back, filtered, predicted, after)
    ahead, out, rate = np.zeros((3, *y.shape))
    kernels.run_vectors(times, y, np.isfinite(r), start, forward, back, ahead, out, rate)
    return out, rate, after, (forward, back, start)


def by_least_squares(times, y, r, q):
    """The same from the joint Gaussian of all states at once: the slow twin."""
    n = len(times)
    precision, right = np.zeros((2 * n, 2 * n)), np.zeros(2 * n)
    precision[1, 1] = 1.0 / (1e2 * q)
    for t in range(1, n):
        dt = times[t] - times[t - 1]
        noise = q * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
        step = np.hstack([-np.array([[1.0, dt], [0.0, 1.0]]), np.eye(2)])
        rows = slice(2 * t - 2, 2 * t + 2)
        precision[rows, rows] += step.T @ np.linalg.inv(noise) @ step
    for k in np.flatnonzero(np.isfinite(r)):
        precision[2 * k, 2 * k] += 1.0 / r[k]
        right[2 * k] += y[k] / r[k]
    covariance = np.linalg.inv(precision)
    mean = covariance @ right
    return mean[::2], mean[1::2], np.array([covariance[2 * t : 2 * t + 2, 2 * t : 2 * t + 2] for t in range(n)])


def test_smoothing_agrees_with_all_states_solved_at_once():
    rng = np.random.default_rng(2)
    y = np.cumsum(rng.normal(0.0, 1.0, (len(TIMES), 2)), axis=0)
    r = rng.uniform(0.5, 2.0, len(TIMES))
    r[[3, 6]] = np.inf
    out, rate, after, _ = smoothed(TIMES, y, r, Q)
    for k in range(2):
        value, speed, covariance = by_least_squares(TIMES, y[:, k], r, Q)
        np.testing.assert_allclose(out[:, k], value, rtol=1e-6, atol=1e-7)
        np.testing.assert_allclose(rate[:, k], speed, rtol=1e-5, atol=1e-5)
        np.testing.assert_allclose(after, covariance, rtol=1e-5, atol=1e-8)


def test_rotations_about_one_axis_are_smoothed_as_their_angles_are():
    rng = np.random.default_rng(3)
    angle = np.cumsum(rng.normal(0.3, 0.3, len(TIMES)))
    r = np.full(len(TIMES), 0.02)
    r[4] = np.inf
    out, _, _, (forward, back, start) = smoothed(TIMES, angle[:, None], r, 5.0)
    axis = np.array([1.0, 2.0, -2.0]) / 3.0
    y = so3.exp(angle[:, None] * axis)
    ahead, turned, rate = np.zeros(y.shape), np.zeros(y.shape), np.zeros((len(TIMES), 3))
    kernels.run_rotations(TIMES, y, np.isfinite(r), start, forward, back, ahead, turned, rate)
    np.testing.assert_allclose(turned, so3.exp(out * axis), atol=1e-9)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-5, 0.4, 2.0, 3.1, np.pi])
def test_the_scalar_exponential_and_logarithm_are_those_of_the_geometry(angle):
    w = angle * np.array([2.0, -1.0, 2.0]) / 3.0
    rotation, back = np.zeros((3, 3)), np.zeros(3)
    exp_so3(w, rotation)
    np.testing.assert_allclose(rotation, so3.exp(w), atol=1e-14)
    kernels.log_so3(rotation, back)
    np.testing.assert_allclose(so3.exp(back), rotation, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(back), angle, atol=1e-7)
