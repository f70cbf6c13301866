"""What the tracker believes of an animal is a table that can be written again."""

import tomllib
from dataclasses import replace
from statistics import mean

import pytest

from liex_lab.tracking.smoother import TrackingParameters


@pytest.mark.parametrize("animal", ["mouse", "fish", "hand"])
def test_a_tuning_is_the_table_that_it_writes(animal):
    tuning = TrackingParameters.of(animal)
    assert TrackingParameters.from_table(tomllib.loads(tuning.to_toml(animal))[animal]) == tuning


def test_an_animal_without_its_own_is_taken_for_a_mouse_and_a_fish_is_none():
    mouse, snake = (TrackingParameters.of(name) for name in ("mouse", "snake"))
    assert mouse != TrackingParameters.of("fish")
    # but for what is of the mouse's own joints
    assert mouse.motion.joint_calibration
    height = (mean(mouse.motion.unseen_height),)
    assert snake == replace(
        mouse, motion=replace(mouse.motion, joint_calibration=(), unseen_height=height)
    )
