"""What the tracker believes of an animal is a table that can be written again."""

from __future__ import annotations

import tomllib

import numpy as np
import pytest

from liex_lab.tracking.motion_model import Tuning


@pytest.mark.parametrize("animal", ["mouse", "fish", "hand"])
def test_a_tuning_is_the_table_that_it_writes(animal):
    tuning = Tuning.of(animal)
    assert Tuning.from_table(tomllib.loads(tuning.to_toml(animal))[animal]) == tuning


def test_an_animal_without_its_own_is_taken_for_a_mouse_and_a_fish_is_none():
    assert Tuning.of("snake") == Tuning.of("mouse") != Tuning.of("fish")


def test_the_kernels_get_every_number_of_it():
    motion = Tuning.of("fish").motion
    packed = motion.packed
    np.testing.assert_allclose(
        packed.turn[2], [motion.turn[2].error, motion.turn[2].drive, motion.turn[2].fade]
    )
    np.testing.assert_allclose(
        packed.place_drive, [motion.place_drive[0]] * 2 + [motion.place_drive[1]]
    )
