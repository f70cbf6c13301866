"""The scene behind the replay's cut-outs holds no animal, also where one hardly ever moves."""

from dataclasses import replace

import numpy as np
import pytest
from liex_lab.pipelines.build import build_background

from liex_lab.plan import Plan
from liex_lab.recordings.recording import Recording
from liex_lab.scene.background_segmenter import BackgroundSubtraction
from liex_lab.scene.learning import learn_scene
from liex_lab.sessions.cutouts import still_scene
from tests.scene.staged import bare_floor
from tests.scene.test_background_segmenter import (
    CAMERA,
    SPINES,
    recording_of,
    tilted,
    with_box,
)

FLOOR = tilted(4.0)
BARE = FLOOR.depth(CAMERA.width, CAMERA.height)
PLACE = ((60, 56), (12, 8))  # where it rests: centre and half sides, px
HEIGHT_MM = 25.0
NOISE_MM = 3.0


def sleeper(n_frames: int = 120, n_awake: int = 10) -> Recording:
    """An animal that sleeps, and walks off at the end."""
    asleep = [with_box(FLOOR, *PLACE, HEIGHT_MM)] * (n_frames - n_awake)
    awake = [with_box(FLOOR, (70 + 6 * k, 80), (12, 8), HEIGHT_MM) for k in range(n_awake)]
    return recording_of(asleep + awake)


def off(picture: np.ndarray) -> np.ndarray:
    """How far a scene lies before the bare floor, mm."""
    return BARE - picture.astype(np.float64)


def coarser(scene: BackgroundSubtraction, stride: int) -> BackgroundSubtraction:
    """The scene as it is learned where only every so many-th pixel is looked at."""
    every = scene.every(stride)
    return replace(every, camera=scene.camera, floor=scene.floor, stride=stride)


@pytest.mark.parametrize("stride", [1, 3, 4])
def test_an_animal_that_sleeps_most_of_the_time_leaves_no_ghost(stride: int) -> None:
    recording = sleeper()
    known, _ = learn_scene(recording, SPINES)
    assert (off(still_scene(recording)) > HEIGHT_MM - NOISE_MM).sum() > 300, "16 frames hold it"
    background = build_background(recording, Plan.load("mouse"), coarser(known, stride))
    assert background is not None
    assert np.abs(off(background)).max() < NOISE_MM


def test_a_scene_without_a_ghost_is_as_it_was_learned() -> None:
    recording = sleeper(n_awake=60)
    known, _ = learn_scene(recording, SPINES)
    np.testing.assert_array_equal(still_scene(recording, known), still_scene(recording))


def test_what_is_larger_than_any_animal_stays_where_only_the_bare_floor_is_known() -> None:
    house = np.full(BARE.shape, False)
    house[70:110, 80:150] = True

    def frame(centre: tuple[int, int]) -> np.ndarray:
        there = with_box(FLOOR, centre, PLACE[1], HEIGHT_MM)
        there[house] = BARE[house] - 60.0
        return there

    recording = recording_of([frame(PLACE[0])] * 110 + [frame((100, 30))] * 10)
    area = 24 * 16 * (600.0 / CAMERA.fx) ** 2
    known = replace(bare_floor(CAMERA, FLOOR), area_mm2=area)
    background = still_scene(recording, known)
    inside = off(background)[72:108, 82:148]  # its corners are the median's
    assert np.abs(inside - 60.0).max() < NOISE_MM
    assert np.abs(off(background)[:66]).max() < NOISE_MM, "the animal is gone"


def test_where_no_depth_is_kept_or_all_of_it_there_is_no_scene() -> None:
    recording = sleeper()
    known, _ = learn_scene(recording, SPINES)
    for kept in ("none", "all"):
        plan = Plan.load("mouse").with_settings([f"replay.depth={kept}"])
        assert build_background(recording, plan, known) is None
