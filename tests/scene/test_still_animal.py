"""An animal that moves a part of itself but never leaves its place is still the animal, whole."""

from __future__ import annotations

from typing import TYPE_CHECKING, cast

import numpy as np
import pytest

from liex_lab.recordings import open_recording
from liex_lab.scene.background_segmenter import BackgroundSubtraction
from tests.scene.test_background_segmenter import SPINES, recording_of, tilted, with_box

if TYPE_CHECKING:
    from liex_lab.simulation.recording import TrueRecording

BODY = ((80, 60), (12, 8))  # centre and half sides, pixels


def nodding(k: int) -> np.ndarray:
    """A body that stays, and a head that goes from one side to the other."""
    frame = with_box(tilted(2.0), *BODY)
    v = 46 if k % 2 else 66
    frame[v : v + 8, 92:102] -= 25.0
    return frame


@pytest.mark.parametrize("n_frames", [20, 60])
def test_an_animal_that_only_turns_its_head_is_found_whole(n_frames):
    scene, sample = BackgroundSubtraction.learn(
        recording_of([nodding(k) for k in range(n_frames)]), SPINES
    )
    crops = scene.extract(sample, 1.0)
    assert crops.found.all()
    whole = BackgroundSubtraction.from_floor(scene.camera, scene.floor).extract(sample, 1.0).moments
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
    scene, sample = BackgroundSubtraction.learn(recording_of(frames), SPINES)
    crops = scene.extract(sample, 1.0)
    assert crops.found.all()
    whole = BackgroundSubtraction.from_floor(scene.camera, scene.floor).extract(sample, 1.0).moments
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
    scene, sample = BackgroundSubtraction.learn(recording_of([frame] * 20), SPINES)
    assert scene.floor.distance_mm == pytest.approx(floor.distance_mm, abs=0.6)
    assert scene.extract(sample, 1.0).found.all()


@pytest.mark.parametrize(("seed", "n_frames"), [(36, 30), (37, 30), (35, 90)])
def test_of_what_stands_still_in_a_noisy_picture_the_animal_is_what_changes(seed, n_frames):
    """Things stand on the floor beside it, the foot of a wall flickers, and it stays in place."""
    recording = open_recording(
        f"synthetic:walk?seed={seed}&frames={n_frames}&sensor=primesense-qvga"
    )
    scene, sample = BackgroundSubtraction.learn(recording, SPINES)
    crops = scene.extract(sample, 1.0)
    assert crops.found.all()
    true = cast("TrueRecording", recording).joints_arena
    off = scene.middles(crops)[:, :2] - true.mean(axis=1)[:, :2]
    assert np.linalg.norm(off, axis=1).max() < 20.0
