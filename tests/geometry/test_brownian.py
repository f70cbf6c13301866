"""Brownian motion on SE(3): Eq. 6 at the steps, Eq. 7 between them, the stated covariance."""

import numpy as np
import pytest

from liex_lab.geometry import SE3, brownian_ends, brownian_steps
from tests.oracles import motion

DELTA = 0.04
COVARIANCE = np.diag([0.04, 0.01, 0.09, 4.0, 9.0, 1.0])
COVARIANCE[0, 3] = COVARIANCE[3, 0] = 0.2


def test_steps_have_the_covariance_asked_for() -> None:
    found = np.cov(brownian_steps(np.random.default_rng(1), COVARIANCE, 40_000).T)
    spread = np.sqrt(np.outer(np.diag(COVARIANCE), np.diag(COVARIANCE)))
    np.testing.assert_allclose(found / spread, COVARIANCE / spread, atol=0.03)
    assert brownian_steps(np.random.default_rng(1), COVARIANCE, 5, 2, 3).shape == (2, 3, 5, 6)


def test_the_ends_follow_equation_6_at_the_steps_and_equation_7_between_them() -> None:
    steps = brownian_steps(np.random.default_rng(9), COVARIANCE, 3, 4)
    start = SE3.exp(brownian_steps(np.random.default_rng(10), COVARIANCE, 4))
    for share in (0.0, 0.4, 1.0, 2.7, 3.0):
        ends = brownian_ends(start, steps, DELTA, share * DELTA)
        parts = np.clip(share - np.arange(3), 0.0, 1.0)
        for k in range(4):
            by_hand = start.matrix[k] @ motion.chain(parts[:, None] * np.sqrt(DELTA) * steps[k])[-1]
            np.testing.assert_allclose(ends.matrix[k], by_hand, atol=1e-9)
    for time in (-0.1, 3.1 * DELTA):
        with pytest.raises(ValueError, match="the time must lie within the paths"):
            brownian_ends(start, steps, DELTA, time)


def test_the_motion_spreads_with_time_whatever_the_step() -> None:
    """After one second the covariance is C, in 2 steps or in 20: hence sqrt(delta)."""
    small = np.diag([1e-4, 1e-4, 1e-4, 1.0, 2.0, 3.0])  # small rotations, so that the steps add up
    for n_steps in (2, 20):
        steps = brownian_steps(np.random.default_rng(8), small, n_steps, 800)
        ends = brownian_ends(SE3.identity(800), steps, 1.0 / n_steps, 1.0).log()
        np.testing.assert_allclose(np.var(ends, axis=0), np.diag(small), rtol=0.15)
