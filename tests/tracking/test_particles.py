"""Algorithm 3: the first frame places the particles, and what follows keeps to the animal while it
goes slowly.
"""

from __future__ import annotations

import numpy as np
import pytest

from liex_lab.estimation.estimator import PoseEstimator
from liex_lab.recordings.frame import DepthFrame
from liex_lab.tracking.particles import ParticleFilter, Wander
from tests.estimation.toy import CAMERA, FLOOR, SCENE, Toy, toy_mice, trained

STEP_NS = 33_333_333
FEW = Wander(n_particles=40)


@pytest.fixture(scope="module")
def toy() -> Toy:
    return toy_mice(3, 31, size=(1.0, 1.0))


@pytest.fixture(scope="module")
def estimator() -> PoseEstimator:
    return PoseEstimator(trained("default").model)


def follow(estimator: PoseEstimator, depths: np.ndarray, seed: int = 0) -> list[np.ndarray | None]:
    particles = ParticleFilter(estimator, SCENE, 1.0, np.random.default_rng(seed), FEW)
    steps = [particles.step(DepthFrame(k, k * STEP_NS, depth)) for k, depth in enumerate(depths)]
    return [None if step is None else step[0].joints(estimator.skeleton) for step in steps]


def test_an_animal_that_keeps_still_is_not_lost(estimator, toy):
    found = follow(estimator, np.repeat(toy.depths[:1], 5, axis=0))
    truth = FLOOR.T_arena_camera.inverse() @ toy.joints[0]
    for joints in found:
        assert joints is not None
        assert np.linalg.norm(joints - truth, axis=-1).mean() < 6.0


def test_the_same_seed_gives_the_same_track_and_another_one_does_not(estimator, toy):
    depths = np.repeat(toy.depths[:1], 3, axis=0)
    first, second, other = (follow(estimator, depths, seed)[-1] for seed in (1, 1, 2))
    assert first is not None
    assert second is not None
    assert other is not None
    np.testing.assert_array_equal(first, second)
    assert not np.array_equal(first, other)


def test_before_the_animal_is_found_and_without_a_foreground_there_is_no_estimate(estimator, toy):
    bare = FLOOR.depth(CAMERA.width, CAMERA.height)
    found = follow(estimator, np.stack([bare, toy.depths[0], bare, toy.depths[0]]))
    assert [joints is None for joints in found] == [True, False, True, False]
