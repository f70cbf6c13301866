"""A nest that appears becomes ground, an animal that sleeps never does."""

from functools import cache

import numpy as np
import pytest

from liex_lab.recordings.recording import Recording
from liex_lab.scene.background_segmenter import BackgroundSubtraction
from liex_lab.scene.changing_ground import ChangingGround, RaisedGround
from liex_lab.scene.learning import learn_scene
from tests.scene.staged import CAMERA

N = 192
ROWS, COLUMNS = np.mgrid[:240, :320]
PLACE = (100, 130)
ASLEEP = slice(128, N)
NEST = np.clip(1.6 - np.hypot(ROWS - PLACE[0], COLUMNS - PLACE[1]) / 22.0, 0.0, 1.0) * 28.0
TIMES = np.arange(N) * 10_000_000_000  # half an hour


@cache
def paths() -> np.ndarray:
    """Where the animal is in each frame, (row, column)."""
    rng = np.random.default_rng(3)
    return np.stack([rng.integers(70, 170, N), rng.integers(80, 240, N)], axis=1)


def recorded(
    nest: np.ndarray, sleeps: slice = slice(0)
) -> tuple[Recording, np.ndarray, np.ndarray]:
    """Frames of a tray with an animal of 22 x 36 px and 26 mm, and a nest of the share `nest` (N,);
    where the animal is, and its pixels.
    """
    place = paths().copy()
    place[sleeps] = PLACE
    rng = np.random.default_rng(1)
    tray = np.full((240, 320), 700.0)
    tray[:50], tray[190:], tray[:, :60], tray[:, 260:] = 620.0, 620.0, 620.0, 620.0
    own = np.abs(ROWS - place[:, :1, None]) < 11
    own &= np.abs(COLUMNS - place[:, 1:, None]) < 18
    ground = nest[:, None, None] * NEST
    depths = tray - ground - 26.0 * own + rng.normal(0.0, 1.0, own.shape)
    frames = np.round(depths).astype(np.float32)
    recording = Recording(
        name="tray", format="synthetic", camera=CAMERA, times_ns=TIMES, read=lambda k: frames[k]
    )
    return recording, frames, own


def learned(nest: np.ndarray, sleeps: slice = slice(0)) -> tuple[BackgroundSubtraction, np.ndarray]:
    """The scene, and the share (N,) of the animal's pixels that are found, less what is beside."""
    recording, frames, own = recorded(nest, sleeps)
    scene, _ = learn_scene(recording, (40.0, 115.0))
    crops = scene.extract(scene.levelled(frames, TIMES), 1.0)
    share = np.zeros(N)
    for k, mask in zip(np.flatnonzero(crops.found), scene.animal_masks(crops), strict=True):
        share[k] = (mask & own[k]).sum() / (mask | own[k]).sum()
    return scene, share


def step(at: int) -> np.ndarray:
    return np.clip((np.arange(N) - at) / 4.0, 0.0, 1.0)


@pytest.mark.parametrize("sleeps", [ASLEEP, slice(10, 74)])
def test_a_nest_becomes_ground_and_an_animal_asleep_on_it_or_before_it_does_not(sleeps) -> None:
    scene, share = learned(step(90), sleeps)
    assert scene.doubts == ()
    assert scene.ground is not None
    assert "changed by up to" in scene.remarks[-1]
    assert 900.0 <= scene.described().to_dict()["ground_changes_s"][-1] < 1100.0
    known = np.r_[0:85, 110:N]
    assert share[known].min() > 0.7
    assert np.median(share[sleeps]) > 0.9


def test_what_is_taken_away_is_followed() -> None:
    scene, share = learned(1.0 - step(90))
    assert scene.ground is not None
    assert scene.doubts == ()
    assert np.quantile(share, 0.1) > 0.8


def test_what_is_never_seen_without_the_animal_is_said_and_not_guessed() -> None:
    scene, _ = learned(step(110), slice(106, N))
    assert scene.ground is None
    assert isinstance(scene.changed, RaisedGround)


def test_ground_that_stays_changes_no_image() -> None:
    recording, frames, _ = recorded(np.zeros(N), ASLEEP)
    scene, _ = learn_scene(recording, (40.0, 115.0))
    assert (scene.ground, scene.doubts) == (None, ())
    assert scene.levelled(frames, TIMES) is frames


def test_a_frame_has_the_ground_of_its_time_and_an_animal_stays_as_it_is() -> None:
    where = np.zeros((4, 6), np.bool_)
    where[1:3, 2:5] = True
    readings = np.full((40, 6), 700.0, np.float32)
    readings[20:] = 680.0
    readings[19] = 650.0  # an animal
    shows = np.ones(40, np.bool_)
    shows[15:22] = False
    times = np.arange(40) * 1_000_000_000
    margin = np.full(6, 7.0, np.float32)
    ground = ChangingGround.follow(where, margin, readings, shows, times, 3.0)
    assert ground.changes_s == (22.0,)
    assert ground.unknown_share == pytest.approx(8 / 39)
    frames = np.full((3, 4, 6), 680.0, np.float32)
    frames[:, 1, 2] = 655.0
    seen = ground.levelled(frames, times[[3, 18, 30]])
    assert (seen[:, 2, 3] == [680.0, 680.0, 700.0]).all()
    assert (seen[:, 1, 2] == 655.0).all()
    assert (seen[:, ~where] == 680.0).all()
    np.testing.assert_array_equal(ground.levelled(frames[2:], times[[30]]), seen[2:])
