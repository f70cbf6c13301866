"""A camera that is pushed while it records is told, an animal that changes its place is not."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from liex_lab.optics.camera import Camera
from liex_lab.scene.background_segmenter import BackgroundSubtraction
from liex_lab.scene.still_scene import SceneChange
from tests.scene.staged import changed, stage, walk

SPINES = (40.0, 115.0)
N_FRAMES = 64
CAMERA = Camera(fx=290.0, fy=290.0, cx=159.5, cy=119.5, width=320, height=240)
TIMES = np.arange(N_FRAMES) / 30.0


@cache
def mouse():
    return walk(stage((170.0, 150.0), height_mm=700.0, room=False), N_FRAMES)


def learned(change) -> BackgroundSubtraction:
    return BackgroundSubtraction.learn(changed(mouse(), change), SPINES, N_FRAMES)[0]


def test_a_scene_that_keeps_still_is_not_doubted() -> None:
    scene = learned(lambda k, depth: depth)
    assert scene.changed is None
    assert scene.doubts == ()


def test_a_camera_that_is_lifted_is_told_with_the_time() -> None:
    scene = learned(lambda k, depth: np.where((depth > 0) & (k >= 40), depth + 30, depth))
    assert scene.changed is not None
    assert scene.changed.share > 0.9
    assert scene.changed.at_s == pytest.approx(TIMES[40], abs=0.05)
    assert scene.described().doubts[-1:] == scene.doubts
    assert "the camera was displaced or its scene rearranged at 1.3 s" in scene.doubts[0]


def test_a_camera_that_reads_each_pixel_half_of_the_time_was_not_pushed() -> None:
    rng = np.random.default_rng(5)
    scene = learned(lambda k, depth: np.where(rng.random(depth.shape) < 0.5, 0, depth))
    assert scene.changed is None


def empty() -> np.ndarray:
    """A tray of 200 x 140 pixels with walls of 80 mm."""
    depth = np.full((240, 320), 700.0, np.float32)
    depth[:50], depth[190:], depth[:, :60], depth[:, 260:] = 620.0, 620.0, 620.0, 620.0
    return depth


def seen(*places: slice) -> np.ndarray:
    """The tray with an animal, 25 mm high and 5400 mm^2 large, in some columns of some frames."""
    frames = np.repeat(empty()[None], N_FRAMES, axis=0)
    for k, place in enumerate(places):
        part = slice(k * N_FRAMES // len(places), (k + 1) * N_FRAMES // len(places))
        frames[part, 100:125, place] = 675.0
    return frames


def test_a_camera_that_is_pushed_aside_is_told_and_so_is_one_that_slides() -> None:
    still = seen(slice(100, 140))
    pushed = np.stack([np.roll(one, 25 * (k >= 20), axis=1) for k, one in enumerate(still)])
    found = SceneChange.find(pushed, TIMES, CAMERA, 5400.0)
    assert found is not None
    assert found.at_s == pytest.approx(TIMES[20])
    sliding = np.stack([np.roll(one, round(0.4 * k), axis=1) for k, one in enumerate(still)])
    assert SceneChange.find(sliding, TIMES, CAMERA, 5400.0) is not None


def test_an_animal_that_sleeps_here_and_there_changes_nothing() -> None:
    sleeps = seen(slice(70, 110), slice(200, 240), slice(130, 170), slice(70, 110))
    assert SceneChange.find(sleeps, TIMES, CAMERA, 5400.0) is None


def test_too_few_frames_tell_nothing() -> None:
    assert SceneChange.find(seen(slice(70, 110))[:15], TIMES[:15], CAMERA, 5400.0) is None
