"""Things that are put in or taken out are fixtures with times; animals that rest are none."""

from __future__ import annotations

import numpy as np
import pytest

from liex_lab.scene.background_segmenter import BackgroundSubtraction
from liex_lab.scene.scene import Fixture
from tests.scene.test_background_segmenter import SPINES, recording_of, tilted, with_box

N_FRAMES = 60
FLOOR = tilted(2.0)
THING = ((130, 30), (6, 6))  # centre and half sides, pixels


def walker(k: int) -> np.ndarray:
    """An animal that goes to and fro across the floor."""
    return with_box(FLOOR, (30 + int(40 * abs(1.0 - k / 15.0 % 2.0)), 80), (12, 8))


def with_thing(frame: np.ndarray, high: float = 60.0) -> np.ndarray:
    (u, v), (half_u, half_v) = THING
    frame[v - half_v : v + half_v, u - half_u : u + half_u] -= high
    return frame


def transient_objects(frames: list[np.ndarray]) -> list[Fixture]:
    scene, _ = BackgroundSubtraction.learn(recording_of(frames), SPINES)
    return [
        one
        for one in scene.described().fixtures
        if one.since_s is not None or one.until_s is not None
    ]


@pytest.mark.parametrize(("start", "stop"), [(20, 60), (0, 40), (15, 45)])
def test_a_thing_stands_there_from_when_it_is_put_in_until_it_is_taken_out(start, stop):
    (thing,) = transient_objects(
        [with_thing(walker(k)) if start <= k < stop else walker(k) for k in range(N_FRAMES)]
    )
    assert thing.since_s == (pytest.approx(start * 0.033) if start else None)
    assert thing.until_s == (pytest.approx(stop * 0.033) if stop < N_FRAMES else None)
    assert thing.height_mm == pytest.approx(60.0, abs=4.0)
    true = FLOOR.T_arena_camera @ np.array([(129.5 - 79.5) * 1.8, (29.5 - 59.5) * 1.8, 540.0])
    assert np.linalg.norm(np.array(thing.centre_mm) - true[:2]) < 6.0


def test_a_hand_that_puts_something_in_is_no_thing_and_does_not_hide_it():
    frames = [with_thing(walker(k)) if k >= 30 else walker(k) for k in range(N_FRAMES)]
    for k in range(24, 32):
        frames[k][: 28 + k % 7, 110:145] = 420.0 + 15.0 * (k % 3)  # it does not keep still
    (thing,) = transient_objects(frames)
    assert thing.since_s is not None
    assert 0.8 < thing.since_s < 1.2
    assert thing.height_mm == pytest.approx(60.0, abs=4.0)


@pytest.mark.parametrize("n_rests", [20, 40])
def test_an_animal_that_comes_to_rest_is_not_put_in(n_rests):
    assert not transient_objects([walker(min(k, N_FRAMES - n_rests)) for k in range(N_FRAMES)])


def test_a_second_animal_that_comes_to_rest_is_not_put_in():
    frames = []
    for k in range(N_FRAMES):
        frame = walker(k)
        u = 30 + 2 * min(k, 38)
        frame[22:38, u - 12 : u + 12] -= 25.0
        frames.append(frame)
    assert not transient_objects(frames)


def test_where_nothing_is_put_in_no_fixture_has_times():
    assert not transient_objects([with_thing(walker(k)) for k in range(N_FRAMES)])
    assert not transient_objects([walker(k) for k in range(N_FRAMES)])


@pytest.mark.parametrize(
    ("since_s", "until_s", "said"),
    [
        (None, None, "56 mm"),
        (4.3, None, "56 mm, from 4.3 s"),
        (None, 5.8, "56 mm, until 5.8 s"),
        (4.3, 5.8, "56 mm, from 4.3 to 5.8 s"),
    ],
)
def test_a_fixture_says_when_it_stands_there_and_is_read_back_as_it_was_written(
    since_s, until_s, said
):
    fixture = Fixture((10.0, -20.0), 56.2, 2100.0, since_s, until_s)
    assert str(fixture) == said
    assert Fixture.from_dict(fixture.to_dict()) == fixture
