"""Where a glossy floor is unread, what stood there is no background."""

from __future__ import annotations

import numpy as np

from liex_lab.scene.background import unread_floor

FLOOR_MM = 700.0


def taken(sample: np.ndarray) -> np.ndarray:
    """Where something was taken for the floor, in a sample whose farthest readings are known."""
    bare = np.full(sample.shape[1:], FLOOR_MM, np.float32)
    background = sample.max(axis=0)
    return unread_floor(sample, background, bare, np.ones(bare.shape, np.bool_), 7.0, 30.0)


def frames() -> np.ndarray:
    return np.full((40, 60, 80), FLOOR_MM, np.float32)


def test_an_animal_that_stood_on_an_unread_patch_is_no_background() -> None:
    sample = frames()
    sample[:, 20:40, 30:50] = 0.0
    sample[:12, 25:35, 35:45] = FLOOR_MM - 25.0
    found = taken(sample)
    assert found[25:35, 35:45].all()
    assert found.sum() == 100


def test_a_thing_that_stays_and_is_read_is_background() -> None:
    sample = frames()
    sample[:, 20:40, 30:50] = FLOOR_MM - 40.0
    assert not taken(sample).any()


def test_a_dark_thing_on_a_wall_is_none_of_the_floor() -> None:
    sample = frames()
    sample[:, 10:50, 20:60] = FLOOR_MM - 80.0
    sample[:, 20:40, 30:50] = 0.0
    sample[:12, 20:40, 30:50] = FLOOR_MM - 100.0
    assert not taken(sample).any()


def test_specks_hide_no_animal() -> None:
    sample = frames()
    sample[:, 20:24, 30:34] = 0.0
    sample[:12, 20:24, 30:34] = FLOOR_MM - 25.0
    assert not taken(sample).any()
