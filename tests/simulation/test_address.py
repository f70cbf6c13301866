"""Virtual recordings by address, through the one door."""

from pathlib import Path

import numpy as np
import pytest

from liex_lab.catalog import find_sample
from liex_lab.optics.camera import KINECT_V2, PRIMESENSE_QVGA, Lens
from liex_lab.recordings import open_recording
from liex_lab.simulation.recording import RenderedRecording
from liex_lab.simulation.species import MouseSpecies
from tests.recordings.asking import refusal

ADDRESS = "synthetic:walk?seed=3&frames=6&sensor=primesense-qvga&spine_mm=70"


def test_an_address_says_seed_length_sensor_and_size() -> None:
    with open_recording(ADDRESS) as recording:
        assert isinstance(recording, RenderedRecording)
        assert (recording.name, recording.format, len(recording)) == (
            "synthetic-walk-3",
            "synthetic",
            6,
        )
        assert recording.camera == PRIMESENSE_QVGA
        assert recording.spine_mm == 70.0
        again = open_recording(Path(ADDRESS))  # as the command line hands it over
        assert recording.digest() == again.digest()
        np.testing.assert_array_equal(recording.frame(4).depth, again.frame(4).depth)


def test_every_setting_may_be_left_out() -> None:
    recording = open_recording("synthetic:walk")
    assert (len(recording), recording.camera) == (300, KINECT_V2)
    np.testing.assert_array_equal(
        recording.frame(5).depth, MouseSpecies().motion(0, 300).frame(5).depth
    )


@pytest.mark.parametrize(
    ("address", "says"),
    [
        ("synthetic:fly?seed=3", "the kinds are walk, swim, gesture, move"),
        ("synthetic:", "the kinds are walk"),
        ("synthetic:move?seed=3", "lacks the animal that moves"),
        ("synthetic:swim?sensor=kinect-v2", "sensor is one of raytrix-r5"),
        ("synthetic:swim?spine_mm=200", "spine_mm is a length from 15 to 87 mm"),
        ("synthetic:walk?sed=3", "nearest one is seed"),
        ("synthetic:walk?frames", "frames is a whole number"),
        ("synthetic:walk?frames=0", "got '0'"),
        ("synthetic:walk?frames=1e9", "got '1e9'"),
        ("synthetic:walk?seed=-1", "a whole number from 0 on"),
        ("synthetic:walk?sensor=webcam", "one of kinect-v2, primesense, primesense-qvga"),
        ("synthetic:walk?spine_mm=nan", "from 30 to 150 mm"),
        ("synthetic:walk?spine_mm=900", "from 30 to 150 mm"),
    ],
)
def test_a_wrong_address_is_told_in_a_sentence_with_an_example(address: str, says: str) -> None:
    sentence = refusal(Path(address))
    assert says in sentence
    assert "seed=3" in sentence


def test_a_stated_camera_changes_what_is_believed_and_not_the_pictures() -> None:
    wrong = open_recording(ADDRESS, camera=Lens(300.0, 300.0, 150.0, 100.0))
    assert (wrong.camera.fx, wrong.camera.width, wrong.camera.height) == (300.0, 320, 240)
    np.testing.assert_array_equal(wrong.frame(2).depth, open_recording(ADDRESS).frame(2).depth)
    assert "512 x 424" in refusal(Path(ADDRESS), camera=KINECT_V2)


def test_any_animal_moves_that_a_toml_describes() -> None:
    snake = open_recording(f"synthetic:move?animal={find_sample('snake.toml')}&frames=2&seed=5")
    assert isinstance(snake, RenderedRecording)
    assert (snake.name, snake.skeleton.name, len(snake)) == ("synthetic-move-5", "snake", 2)
