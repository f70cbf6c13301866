"""Animals that come late, leave or sleep are found; an empty arena holds no animal."""

from functools import cache

import numpy as np
import pytest

from liex_lab.errors import EstimationError
from liex_lab.scene.background import learn_background
from liex_lab.scene.background_segmenter import BackgroundSubtraction
from liex_lab.scene.learning import learn_scene
from tests.scene.staged import shown, walked

SPINES = (40.0, 115.0)
N_FRAMES = 48


@cache
def filmed() -> tuple[np.ndarray, np.ndarray]:
    """Images of a mouse that walks, and of the same arena without it."""
    busy = walked()[1][:N_FRAMES]
    background = learn_background(busy)[0]
    noise = np.random.default_rng(0).normal(0.0, 1.2, busy.shape)
    there = (background - busy > 4.0) | ((busy == 0) & (background > 0))
    near = np.zeros_like(there)
    for v in range(-3, 4):
        for u in range(-3, 4):
            near |= np.roll(there, (v, u), (1, 2))
    return busy, np.where(near, background + noise * (background > 0), busy)


def found(pictures: np.ndarray) -> tuple[BackgroundSubtraction, np.ndarray]:
    scene, sample = learn_scene(shown(pictures), SPINES, N_FRAMES)
    return scene, scene.extract(sample, 1.0).found


def test_an_empty_arena_holds_no_animal():
    _, empty = filmed()
    with pytest.raises(EstimationError, match="no animal was found"):
        found(empty)


def test_an_animal_that_comes_after_two_thirds_is_found_when_it_comes():
    busy, empty = filmed()
    scene, there = found(np.concatenate([empty[:32], busy[32:]]))
    assert there[32:].all()
    assert not there[:32].any()
    assert 900.0 < scene.area_mm2 < 2000.0


@pytest.mark.nightly
def test_an_animal_that_leaves_is_found_until_it_leaves():
    busy, empty = filmed()
    _, there = found(np.concatenate([busy[:14], empty[14:]]))
    assert there[:14].all()
    assert not there[14:].any()


@pytest.mark.nightly
def test_specks_of_an_edge_that_flickers_are_no_animal_beside_one_that_sleeps():
    busy, empty = filmed()
    asleep = np.where(busy[5:6] > 0, busy[5:6] + empty - empty.mean(axis=0), 0.0)
    specks = asleep.copy()
    specks[::2, 20:26, 40:70] -= 70.0 * (specks[::2, 20:26, 40:70] > 0)
    scene, seen = found(specks)
    assert seen.all()
    assert 900.0 < scene.area_mm2 < 2000.0


@pytest.mark.parametrize("n_asleep", [41, pytest.param(48, marks=pytest.mark.nightly)])
def test_an_animal_that_sleeps_for_most_or_all_of_the_time_is_found_whole(n_asleep):
    busy, empty = filmed()
    asleep = np.where(busy[5:6] > 0, busy[5:6] + empty - empty.mean(axis=0), 0.0)
    scene, seen = found(np.concatenate([asleep[:n_asleep], busy[n_asleep:]]))
    assert seen.all()
    assert 900.0 < scene.area_mm2 < 2000.0


@pytest.mark.nightly
def test_a_resting_thing_larger_than_any_such_animal_is_none():
    _, empty = filmed()
    box = empty.copy()
    box[:, 60:150, 130:220] -= np.where(box[:, 60:150, 130:220] > 0, 60.0, 0.0)
    with pytest.raises(EstimationError, match="no animal was found"):
        found(box)


@pytest.mark.nightly
def test_a_house_is_not_taken_for_the_animal_that_comes_late():
    busy, empty = filmed()
    pictures = np.concatenate([empty[:32], busy[32:]])
    house = np.zeros(pictures.shape[1:], bool)
    house[75:90, 200:225] = True
    pictures = np.where(house & (pictures > 0), np.minimum(pictures, 650.0), pictures)
    _, there = found(pictures)
    assert there[32:].mean() > 0.9
    assert there[:32].mean() < 0.1


def test_the_foot_of_a_wall_is_not_the_animal_that_sleeps_all_the_time():
    busy, empty = filmed()
    asleep = np.where(busy[5:6] > 0, busy[5:6] + empty - empty.mean(axis=0), 0.0)
    asleep[:, 165:170, 95:225] -= np.where(asleep[:, 165:170, 95:225] > 0, 14.0, 0.0)
    scene, seen = found(asleep)
    assert seen.all()
    assert 900.0 < scene.area_mm2 < 2000.0
