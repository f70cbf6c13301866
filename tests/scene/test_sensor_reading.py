"""A recording tells its sensor: noise, rounding, unread seams, readings between two sides."""

from __future__ import annotations

import numpy as np
import pytest

from liex_lab.optics.camera import SensorCard
from liex_lab.recordings.recording import Recording
from liex_lab.scene.background_segmenter import BackgroundSubtraction
from tests.scene.test_background_segmenter import CAMERA, SPINES, tilted, with_box

N_FRAMES = 40


def card_of(frames: list[np.ndarray]) -> SensorCard:
    recording = Recording(
        name="boxes",
        format="synthetic",
        camera=CAMERA,
        times_ns=np.arange(len(frames)) * 33_000_000,
        read=lambda k: frames[k],
    )
    scene, _ = BackgroundSubtraction.learn(recording, SPINES)
    assert scene.sensor is not None
    return scene.sensor


def walking(
    noise_mm: float = 0.0, step_mm: float = 0.0, seam_px: int = 0, shelf: bool = False
) -> list[np.ndarray]:
    """A box that goes across a floor, seen by a sensor of known faults."""
    rng = np.random.default_rng(3)
    frames = []
    for k in range(N_FRAMES):
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


@pytest.mark.parametrize("noise_mm", [0.5, 1.5])
def test_noise_is_the_spread_of_a_pixel_where_nothing_moves(noise_mm):
    card = card_of(walking(noise_mm))
    assert all(sd == pytest.approx(noise_mm, rel=0.1) for _, sd in card.noise)
    assert card.step_mm is None


@pytest.mark.parametrize("step_mm", [1.0, 2.5])
def test_what_depth_is_rounded_to_is_told(step_mm):
    assert card_of(walking(2.0, step_mm)).step_mm == pytest.approx(step_mm, abs=0.01)


@pytest.mark.parametrize("seam_px", [0, 2])
def test_the_seam_is_as_wide_as_what_is_unread_around_the_animal(seam_px):
    assert card_of(walking(0.5, seam_px=seam_px)).seam_px == pytest.approx(seam_px, abs=0.35)


def test_readings_between_both_sides_of_an_edge_are_counted():
    assert card_of(walking(0.5)).mixed_share is None
    # an edge has two pixels, of which one reads so in a fifth of the frames
    assert card_of(walking(0.5, shelf=True)).mixed_share == pytest.approx(0.1, abs=0.02)


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
