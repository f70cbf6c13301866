"""The printed definition of a word and the check of its bouts come from the same limits."""

import math

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


@pytest.mark.parametrize("animal", WORDS)
def test_no_action_has_the_colour_of_a_lost_frame_or_of_an_error(animal: str) -> None:
    taken = {colour.upper() for colour in action_colours(list(WORDS[animal])).values()}
    assert not taken & {NO_POSE.upper(), PREDICTED_ERROR.upper()}
