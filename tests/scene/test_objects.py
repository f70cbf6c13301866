"""An animal that moves a part of itself but never leaves its place is still the animal, whole."""

from __future__ import annotations

from typing import TYPE_CHECKING, cast

import numpy as np
import pytest

from liex_lab.optics.camera import SensorCard
from liex_lab.recordings import open_recording
from liex_lab.scene.learning import learn_scene
from liex_lab.scene.scene import Fixture
from tests.scene.staged import bare_floor
from tests.scene.test_background_segmenter import SPINES, recording_of, tilted, with_box

if TYPE_CHECKING:
    from liex_lab.simulation.recording import RenderedRecording


BODY = ((80, 60), (12, 8))  # centre and half sides, pixels


def nodding(k: int) -> np.ndarray:
    """A body that stays, and a head that goes from one side to the other."""
    frame = with_box(tilted(2.0), *BODY)
    v = 46 if k % 2 else 66
    frame[v : v + 8, 92:102] -= 25.0
    return frame


@pytest.mark.parametrize("n_frames", [20, pytest.param(60, marks=pytest.mark.nightly)])
def test_an_animal_that_only_turns_its_head_is_found_whole(n_frames):
    scene, sample = learn_scene(recording_of([nodding(k) for k in range(n_frames)]), SPINES)
    crops = scene.extract(sample, 1.0)
    assert crops.found.all()
    whole = bare_floor(scene.camera, scene.floor).extract(sample, 1.0).moments
    np.testing.assert_allclose(crops.moments[:, 1], whole[:, 1], rtol=0.3)
    assert np.linalg.norm(crops.moments[:, 3:5] - whole[:, 3:5], axis=1).max() < 8.0


def test_an_animal_that_goes_from_where_the_floor_is_never_read_was_whole_before():
    floor = tilted(2.0)
    bare = floor.depth(160, 120)

    def frame(k: int) -> np.ndarray:
        there = with_box(floor, *BODY) if k < 28 else with_box(floor, (40, 60), (20, 8))
        if k < 28:  # its fore part goes from one side to the other
            there[slice(46, 60) if k % 2 else slice(60, 74), 88:108] -= 25.0
        unread = (there > bare - 1.0)[40:80, 60:110]
        there[40:80, 60:110][unread] = 0.0
        return there

    frames = [frame(k) for k in range(40)]
    scene, sample = learn_scene(recording_of(frames), SPINES)
    crops = scene.extract(sample, 1.0)
    assert crops.found.all()
    whole = bare_floor(scene.camera, scene.floor).extract(sample, 1.0).moments
    np.testing.assert_allclose(crops.moments[:, 1], whole[:, 1], rtol=0.3)


@pytest.mark.parametrize("step_mm", [0.0, 6.0])
def test_where_nothing_moves_the_floor_is_what_the_animal_lies_on(step_mm):
    """An arena's floor lies 6 mm above the bench around it, and both are as large."""
    floor = tilted(2.0)
    frame = with_box(floor, (60, 56))
    bench = floor.depth(160, 120) + np.float32(step_mm)
    around = np.ones(frame.shape, bool)
    around[18:104, 20:118] = False
    frame[around] = bench[around]
    scene, sample = learn_scene(recording_of([frame] * 20), SPINES)
    assert scene.floor.distance_mm == pytest.approx(floor.distance_mm, abs=0.6)
    assert scene.extract(sample, 1.0).found.all()


@pytest.mark.parametrize(
    ("seed", "n_frames"),
    [
        (36, 30),
        *(pytest.param(*each, marks=pytest.mark.nightly) for each in ((37, 30), (35, 90))),
    ],
)
def test_of_what_stands_still_in_a_noisy_picture_the_animal_is_what_changes(seed, n_frames):
    """Things stand on the floor beside it, the foot of a wall flickers, and it stays in place."""
    recording = open_recording(
        f"synthetic:walk?seed={seed}&frames={n_frames}&sensor=primesense-qvga"
    )
    scene, sample = learn_scene(recording, SPINES)
    crops = scene.extract(sample, 1.0)
    assert crops.found.all()
    true = cast("RenderedRecording", recording).joints_arena
    off = scene.middles(crops)[:, :2] - true.mean(axis=1)[:, :2]
    assert np.linalg.norm(off, axis=1).max() < 20.0


# Things that are put in or taken out are fixtures with times; animals that rest are none.


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
    scene, _ = learn_scene(recording_of(frames), SPINES)
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


def test_nothing_is_put_in_by_an_animal_that_comes_to_rest_or_where_all_stays():
    for frames in (
        [walker(min(k, N_FRAMES - 20)) for k in range(N_FRAMES)],
        [walker(min(k, N_FRAMES - 40)) for k in range(N_FRAMES)],
        [with_thing(walker(k)) for k in range(N_FRAMES)],
        [walker(k) for k in range(N_FRAMES)],
    ):
        assert not transient_objects(frames)


def test_a_second_animal_that_comes_to_rest_is_not_put_in():
    frames = []
    for k in range(N_FRAMES):
        frame = walker(k)
        u = 30 + 2 * min(k, 38)
        frame[22:38, u - 12 : u + 12] -= 25.0
        frames.append(frame)
    assert not transient_objects(frames)


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


# A recording tells its sensor: noise, rounding, unread seams, readings between two sides.


N_READ = 40


def walking(
    noise_mm: float = 0.0, step_mm: float = 0.0, seam_px: int = 0, shelf: bool = False
) -> list[np.ndarray]:
    """A box that goes across a floor, seen by a sensor of known faults."""
    rng = np.random.default_rng(3)
    frames = []
    for k in range(N_READ):
        u, v = 30 + 2 * k, 60
        frame = with_box(tilted(2.0), (u, v), (12, 8))
        if shelf:  # 100 mm above the floor; of its edge a fifth of the readings lie between
            frame[:, :20] -= 100.0
            mixed = rng.random(frame.shape[0]) < 0.2
            frame[mixed, 20] -= 50.0
        frame = frame + rng.normal(0.0, noise_mm, frame.shape)
        if step_mm:
            frame = np.round(frame / step_mm) * step_mm
        if seam_px:
            body = frame[v - 8 : v + 8, u - 12 : u + 12].copy()
            frame[v - 8 - seam_px : v + 8 + seam_px, u - 12 - seam_px : u + 12 + seam_px] = 0.0
            frame[v - 8 : v + 8, u - 12 : u + 12] = body
        frames.append(frame.astype(np.float32))
    return frames


@pytest.mark.parametrize(
    ("faults", "noise_mm", "step_mm", "seam_px", "mixed"),
    [
        ({"noise_mm": 0.5}, 0.5, None, 0, None),
        ({"noise_mm": 1.5, "seam_px": 2}, 1.5, None, 2, None),
        ({"noise_mm": 2.0, "step_mm": 2.5}, None, 2.5, 0, None),
        # an edge has two pixels, of which one reads so in a fifth of the frames
        ({"noise_mm": 0.5, "shelf": True}, None, None, 0, 0.1),
    ],
)
def test_a_sensor_s_noise_steps_seam_and_mixed_readings_are_measured(
    faults, noise_mm, step_mm, seam_px, mixed
):
    scene, _ = learn_scene(recording_of(walking(**faults), noise_mm=0.0), SPINES)
    card = scene.sensor
    assert card is not None
    if noise_mm is not None:
        assert all(sd == pytest.approx(noise_mm, rel=0.1) for _, sd in card.noise)
    assert card.step_mm == (None if step_mm is None else pytest.approx(step_mm, abs=0.01))
    if mixed is None:
        assert card.seam_px == pytest.approx(seam_px, abs=0.35)
    assert card.mixed_share == (None if mixed is None else pytest.approx(mixed, abs=0.02))


def test_a_card_is_read_back_as_it_was_written_and_says_itself():
    card = SensorCard(((650.0, 1.25), (900.0, 2.5)), 2.0, 0.4, 0.07)
    assert SensorCard.from_dict(card.to_dict()) == card
    assert str(card) == (
        "noise 1.2 mm at 0.65 m, 2.5 mm at 0.90 m, steps of 2 mm, 0.4 px unread around the animal, "
        "7% of readings at edges are between both sides"
    )
    assert str(SensorCard()) == "noise unknown"
    filtered = "noise none, as of filtered or composed images"
    assert str(SensorCard(((650.0, 0.0),))) == filtered
