"""A sensor that warms up changes nothing that is measured, and a still one is not touched."""

import numpy as np
import pytest

from liex_lab.optics.camera import Camera
from liex_lab.scene.background import FloorLevel, SceneChange, wandering
from liex_lab.scene.background_segmenter import BackgroundSubtraction
from liex_lab.scene.changing_ground import RaisedGround
from liex_lab.scene.learning import learn_scene
from tests.scene.staged import altered, walked

SPINES = (40.0, 115.0)
N_FRAMES = 48


def learned(wander_mm: float) -> tuple[BackgroundSubtraction, np.ndarray]:
    """The scene of a sensor that drifts, and how high the mouse is above the floor by frame."""
    off = wander_mm * (1.0 - np.exp(-np.arange(N_FRAMES) / 16.0))
    warm = altered(
        walked()[1][:N_FRAMES], lambda k, d: np.where(d > 0, d + np.float32(off[k]), np.float32(0))
    )
    scene, _ = learn_scene(warm, SPINES, N_FRAMES)
    depths = np.stack([warm.frame(k).depth for k in range(N_FRAMES)])
    return scene, scene.extract(depths, 1.0).centroid[:, 2]


def test_an_animal_is_as_high_above_the_floor_as_before_a_sensor_that_does_not_drift() -> None:
    still, height = learned(0.0)
    warm, same = learned(6.0)
    assert (still.level, still.changed, still.doubts) == (None, None, ())
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


# A camera that is pushed while it records is told, an animal that changes its place is not.


N_CHANGED = 64
CAMERA = Camera(fx=290.0, fy=290.0, cx=159.5, cy=119.5, width=320, height=240)
TIMES = np.arange(N_CHANGED) / 30.0


def learned_from(change) -> BackgroundSubtraction:
    return learn_scene(altered(walked()[1], change), SPINES, N_CHANGED)[0]


def test_a_camera_that_is_lifted_is_told_with_the_time() -> None:
    scene = learned_from(lambda k, depth: np.where((depth > 0) & (k >= 40), depth + 30, depth))
    assert isinstance(scene.changed, SceneChange)
    assert scene.changed.share > 0.9
    assert scene.changed.at_s == pytest.approx(TIMES[40], abs=0.05)
    assert scene.described().doubts[-1:] == scene.doubts
    assert "the camera was displaced or its scene rearranged at 1.3 s" in scene.doubts[0]


@pytest.mark.nightly
def test_a_camera_that_reads_each_pixel_half_of_the_time_was_not_pushed() -> None:
    rng = np.random.default_rng(5)
    scene = learned_from(lambda k, depth: np.where(rng.random(depth.shape) < 0.5, 0, depth))
    assert scene.changed is None


def empty() -> np.ndarray:
    """A tray of 200 x 140 pixels with walls of 80 mm."""
    depth = np.full((240, 320), 700.0, np.float32)
    depth[:50], depth[190:], depth[:, :60], depth[:, 260:] = 620.0, 620.0, 620.0, 620.0
    return depth


def seen(*places: slice) -> np.ndarray:
    """The tray with an animal, 25 mm high and 5400 mm^2 large, in some columns of some frames."""
    frames = np.repeat(empty()[None], N_CHANGED, axis=0)
    for k, place in enumerate(places):
        part = slice(k * N_CHANGED // len(places), (k + 1) * N_CHANGED // len(places))
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


# A nest that is built, or bedding that is dug away, is told; animals that sleep are not.


ROWS, COLUMNS = np.mgrid[:240, :320]
NEST = np.clip(1.3 - np.hypot(ROWS - 70, COLUMNS - 210) / 22.0, 0.0, 1.0)  # 100 mm across


@pytest.mark.parametrize("height_mm", [15.0, -15.0])
def test_a_nest_that_is_built_and_bedding_that_is_dug_away_are_told(height_mm: float) -> None:
    def built(k: int, depth: np.ndarray) -> np.ndarray:
        bare = walked()[0].floor.depth(320, 240)
        ground = np.abs(depth - bare) < 6.0
        return depth - ground * (NEST * height_mm * k / (N_CHANGED - 1)).astype(np.float32)

    scene = learned_from(built)
    assert isinstance(scene.changed, RaisedGround)
    assert scene.changed.rise_mm == pytest.approx(0.65 * height_mm, abs=2.5)  # from third to third
    assert 30e2 < scene.changed.area_mm2 < 100e2
    assert f"such as a nest or bedding, {'rose' if height_mm > 0 else 'sank'} by" in scene.doubts[0]


def test_animals_that_sleep_are_no_ground_that_rises() -> None:
    sleeps = seen(slice(70, 110), slice(200, 240), slice(130, 170))
    on_floor = empty() == 700.0
    assert RaisedGround.find(sleeps, on_floor, CAMERA, (7.0, 1.5 * 5400.0)) is None
    risen = sleeps - np.linspace(0.0, 15.0, N_CHANGED)[:, None, None].astype(np.float32)
    assert RaisedGround.find(risen, on_floor, CAMERA, (7.0, 1.5 * 5400.0)) is not None
    assert RaisedGround.find(risen[:20], on_floor, CAMERA, (7.0, 8100.0)) is None
