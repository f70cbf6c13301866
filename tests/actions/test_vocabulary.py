"""The printed definition of a word and the check of its bouts come from the same limits."""

import math

import cv2
import numpy as np
import pytest

from liex_lab.actions.storage import bundled_action_models, load_action_model
from liex_lab.actions.vocabulary import (
    ABOUT,
    DEFINITIONS,
    MEASURES,
    NO_POSE,
    PALETTE,
    PREDICTED_ERROR,
    WORDS,
    Limit,
    action_colours,
    limits_of,
    printed_meanings,
)


@pytest.mark.parametrize("animal", sorted(WORDS))
def test_the_bundled_model_keeps_the_sentences_of_its_vocabulary(animal: str) -> None:
    assert animal in bundled_action_models()
    model = load_action_model(animal)
    assert model.definitions == DEFINITIONS[animal], "trained again it is the same, byte for byte"
    assert set(printed_meanings(animal, model.definitions).values()) == {
        one.printed for one in WORDS[animal].values()
    }


@pytest.mark.parametrize("animal", sorted(WORDS))
def test_every_number_that_is_checked_is_printed(animal: str) -> None:
    for word, one in WORDS[animal].items():
        assert one.limits, word
        for limit in one.limits:
            for bound in limit.bounds:
                if math.isfinite(bound):
                    assert f"{bound / MEASURES[limit.measure].kept:.3g}" in one.printed, word
        assert limits_of(one.printed) == one.limits


def test_a_sentence_of_ones_own_has_no_limits_whatever_its_word() -> None:
    kept = {"walk": "my own idea of walking", "pause": ""}
    assert printed_meanings("mouse", kept) == kept
    assert limits_of("my own idea of walking") == limits_of("") == ()


def test_about_widens_a_bound_to_either_side_of_zero() -> None:
    assert Limit("pitch_rad", most=-1.0, about=ABOUT).bounds[1] == pytest.approx(-1.0 + ABOUT)
    assert Limit("pitch_rad", least=2.0, about=ABOUT).bounds[0] == pytest.approx(
        2.0 * (1.0 - ABOUT)
    )
    assert Limit("duration_s", 1.0, 2.0).bounds == (1.0, 2.0)
    assert Limit("duration_s", 1.0, 2.0).holds(math.nan), (
        "what was not measured contradicts nothing"
    )
    assert not Limit("duration_s", 1.0, 2.0).holds(2.1)


def test_a_word_has_its_colour_in_every_vocabulary() -> None:
    for words in (*WORDS.values(), ("rear", "run", "walk", "pause")):
        colours = action_colours(list(words))
        assert len(set(colours.values())) == len(words)
        assert "#EE6677" not in colours.values(), "red is for errors"
    rules = action_colours(["rear", "run", "walk", "pause"])
    mouse = action_colours(list(WORDS["mouse"]))
    assert {word: mouse[word] for word in ("run", "walk", "pause")} == {
        word: rules[word] for word in ("run", "walk", "pause")
    }
    many = action_colours([f"w{k}" for k in range(len(PALETTE) + 2)])
    assert len(set(many.values())) == len(PALETTE)


# Two colours that mean two things are told apart by colour-blind people, too.


# Machado, Oliveira and Fernandes 2009, severity 1.0, of linear RGB
BLINDNESS = {
    "none": np.eye(3),
    "protanopia": [
        [0.152286, 1.052583, -0.204868],
        [0.114503, 0.786281, 0.099216],
        [-0.003882, -0.048116, 1.051998],
    ],
    "deuteranopia": [
        [0.367322, 0.860646, -0.227968],
        [0.280085, 0.672501, 0.047413],
        [-0.011820, 0.042940, 0.968881],
    ],
    "tritanopia": [
        [1.255528, -0.076749, -0.178779],
        [-0.078411, 0.930809, 0.147602],
        [0.004733, 0.691367, 0.303900],
    ],
}


def lab(colour: str, seen_by: str) -> np.ndarray:
    """CIE L*a*b* of a colour as somebody sees it."""
    srgb = np.array([int(colour[k : k + 2], 16) / 255.0 for k in (1, 3, 5)])
    linear = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    turned = np.clip(np.asarray(BLINDNESS[seen_by]) @ linear, 0.0, 1.0)
    back = np.where(turned <= 0.0031308, 12.92 * turned, 1.055 * turned ** (1 / 2.4) - 0.055)
    pixel = back.astype(np.float32).reshape(1, 1, 3)
    return np.asarray(cv2.cvtColor(pixel, cv2.COLOR_RGB2Lab)).reshape(3)


@pytest.mark.parametrize("seen_by", BLINDNESS)
def test_no_pose_and_the_predicted_error_are_told_apart(seen_by: str) -> None:
    apart = np.linalg.norm(lab(NO_POSE, seen_by) - lab(PREDICTED_ERROR, seen_by))
    assert apart > 20.0  # of which 2.3 can just be noticed


@pytest.mark.parametrize("animal", WORDS)
def test_no_action_has_the_colour_of_a_lost_frame_or_of_an_error(animal: str) -> None:
    taken = {colour.upper() for colour in action_colours(list(WORDS[animal])).values()}
    assert not taken & {NO_POSE.upper(), PREDICTED_ERROR.upper()}
