"""Brownian motion on SE(3): Eq. 6 at the steps, Eq. 7 between them, the stated covariance
everywhere.
"""

import numpy as np
import pytest

from liex_lab.geometry import SE3, brownian_ends, brownian_path, brownian_steps
from tests.oracles import motion

DELTA = 0.04
COVARIANCE = np.diag([0.04, 0.01, 0.09, 4.0, 9.0, 1.0])
COVARIANCE[0, 3] = COVARIANCE[3, 0] = 0.2
START = SE3.exp([0.3, -0.2, 2.9, 100.0, 50.0, 600.0])


def test_steps_have_the_covariance_asked_for() -> None:
    steps = brownian_steps(np.random.default_rng(1), COVARIANCE, 40_000)
    assert steps.shape == (40_000, 6)
    found = np.cov(steps.T)
    spread = np.sqrt(np.diag(COVARIANCE))
    np.testing.assert_allclose(
        found / np.outer(spread, spread), COVARIANCE / np.outer(spread, spread), atol=0.03
    )
    assert brownian_steps(np.random.default_rng(1), COVARIANCE, 5, 2, 3).shape == (2, 3, 5, 6)


def test_the_path_is_equation_6_at_the_steps_and_equation_7_between_them() -> None:
    steps = brownian_steps(np.random.default_rng(2), COVARIANCE, 6)
    path = brownian_path(START, steps, DELTA, DELTA * np.arange(7))
    by_hand = START.matrix
    for k, step in enumerate(steps):
        np.testing.assert_allclose(path.matrix[k], by_hand, atol=1e-9)
        for share in (0.25, 0.5, 0.9):
            between = brownian_path(START, steps, DELTA, (k + share) * DELTA).matrix[0]
            wanted = by_hand @ motion.exp(share * np.sqrt(DELTA) * step)
            np.testing.assert_allclose(between, wanted, atol=1e-9)
        by_hand = by_hand @ motion.exp(np.sqrt(DELTA) * step)
        around = brownian_path(START, steps, DELTA, (k + 1) * DELTA - np.array([1e-9, 0.0]))
        assert np.abs(around.matrix - by_hand).max() < 1e-6


def test_the_motion_spreads_with_time_whatever_the_step() -> None:
    """After one second the covariance is C, in 2 steps or in 20: that is what sqrt(delta)
    is for.
    """
    small = np.diag([1e-4, 1e-4, 1e-4, 1.0, 2.0, 3.0])  # hardly turning, so that the steps add up
    for n_steps in (2, 20):
        steps = brownian_steps(np.random.default_rng(8), small, n_steps, 800)
        ends = brownian_ends(SE3.identity(800), steps, 1.0 / n_steps, 1.0).log()
        np.testing.assert_allclose(np.var(ends, axis=0), np.diag(small), rtol=0.15)


def test_the_motion_is_left_invariant() -> None:
    steps = brownian_steps(np.random.default_rng(7), COVARIANCE, 4)
    times = np.linspace(0, 4 * DELTA, 9)
    from_start, from_origin = (
        brownian_path(g, steps, DELTA, times) for g in (START, SE3.identity())
    )
    np.testing.assert_allclose(from_start.matrix, (START @ from_origin).matrix, atol=1e-9)


@pytest.mark.parametrize("times", [[-0.01], [5 * DELTA]])
def test_a_time_outside_the_path_is_refused(times: list[float]) -> None:
    with pytest.raises(ValueError, match="within the path"):
        brownian_path(START, np.zeros((4, 6)), DELTA, times)


def test_the_ends_of_many_paths_are_those_of_each() -> None:
    steps = brownian_steps(np.random.default_rng(9), COVARIANCE, 3, 7)
    start = SE3.exp(brownian_steps(np.random.default_rng(10), COVARIANCE, 7))
    for time in (0.0, 0.4 * DELTA, DELTA, 2.7 * DELTA, 3 * DELTA):
        ends = brownian_ends(start, steps, DELTA, time)
        for k in range(7):
            alone = brownian_path(start[k], steps[k], DELTA, time)
            np.testing.assert_allclose(ends.matrix[k], alone.matrix[0], atol=1e-9)
    for time in (-0.1, 3.1 * DELTA):
        with pytest.raises(ValueError, match="the time must lie within the paths"):
            brownian_ends(start, steps, DELTA, time)
