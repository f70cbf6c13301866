"""A sensor that warms up changes nothing that is measured, and a still one is not touched."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from liex_lab.scene.background import FloorLevel, wandering
from liex_lab.scene.background_segmenter import BackgroundSubtraction
from tests.scene.staged import changed, stage, walk

SPINES = (40.0, 115.0)
N_FRAMES = 48


@cache
def mouse():
    return walk(stage((170.0, 150.0), height_mm=700.0, room=False), N_FRAMES)


def learned(wander_mm: float) -> tuple[BackgroundSubtraction, np.ndarray]:
    """The scene of a sensor that drifts, and how high the mouse is above the floor by frame."""
    off = wander_mm * (1.0 - np.exp(-np.arange(N_FRAMES) / 16.0))
    shown = changed(
        mouse(), lambda k, depth: np.where(depth > 0, depth + np.float32(off[k]), np.float32(0))
    )
    scene, _ = BackgroundSubtraction.learn(shown, SPINES, N_FRAMES)
    depths = np.stack([shown.frame(k).depth for k in range(N_FRAMES)])
    return scene, scene.extract(depths, 1.0).centroid[:, 2]


def test_an_animal_is_as_high_above_the_floor_as_before_a_sensor_that_does_not_drift() -> None:
    still, height = learned(0.0)
    warm, same = learned(6.0)
    assert still.level is None
    assert warm.level is not None
    assert warm.level.wander_mm == pytest.approx(4.8, abs=0.3)  # of 6 mm, from 5 to 95 %
    assert warm.floor.distance_mm == pytest.approx(still.floor.distance_mm, abs=1.0)
    np.testing.assert_allclose(same, height, atol=1.0)


def test_a_floor_that_jumps_or_is_still_does_not_wander() -> None:
    rng = np.random.default_rng(2)
    assert wandering(rng.normal(0.0, 0.3, 96)) is None
    assert wandering(rng.normal(0.0, 3.0, 96)) is None
    assert wandering(np.linspace(0.0, 90.0, 96)) is None
    assert wandering(np.zeros(1)) is None
    found = wandering(np.linspace(1.0, 7.0, 96) + rng.normal(0.0, 0.1, 96))
    assert found is not None
    assert found[0] == pytest.approx(1.1, abs=0.2)


def test_a_frame_that_shows_too_little_of_the_floor_keeps_its_level() -> None:
    background = np.full((60, 80), 700.0, np.float32)
    level = FloorLevel.on(background, np.ones((60, 80), np.bool_))
    frames = np.stack([background + 4.0, np.zeros_like(background)])
    np.testing.assert_allclose(level.of(frames), [4.0, 0.0])
    np.testing.assert_allclose(level.brought_back(frames), [background, 0.0 * background])
    assert level.every(2).of(frames[:, ::2, ::2])[0] == pytest.approx(4.0)
