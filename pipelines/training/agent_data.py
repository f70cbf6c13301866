"""Training and test splits of generated behaviour for action recognition.

Individuals (seeds) are never on both sides: cut-out sequences as in the paper (426 to
train on and 173 to test on, of 5 and 2 fish), 24 uncut training recordings of 40 s, for fish 8 more
of 20 s at 100 Hz, and up to 6 test recordings of about 300 s of individuals whose traits lie
outside the range that all others come from. Cameras film fish at 50 Hz and mice at 30 Hz.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TypeVar

import numpy as np

from liex_lab.simulation.agents import fish, mouse

from .agent_tracks import Scenario

Recorded = TypeVar("Recorded")

WORDS = {"fish": fish.ACTIONS, "mouse": mouse.ACTIONS}
RATE_HZ = {"fish": 50.0, "mouse": 30.0}  # of their cameras
FAST_HZ = 100.0
# cut-out sequences, as in the paper, of 5 and 2 fish
N_TRAIN = 426
N_TEST = 173
_TRAIN_FISH = (101, 102, 103, 104, 105)
_TEST_FISH = (106, 107)
_TRAIN_SET = tuple(range(201, 225))
_TEST_SET = tuple(range(301, 307))
_FAST_SET = {"fish": tuple(range(225, 233))}
_SECONDS = 40.0
_FAST_SECONDS = 20.0
_TEST_SECONDS = 300.0  # of a test recording, about: fewer minutes are fewer of the same recordings
_FAST_SHARE = 1.0 / 6.0  # of every test recording is filmed by a faster camera as well


def cut_sequences(animal: str, test: bool) -> list[Scenario]:
    """Cut-out sequences of single actions, the actions in turn: the paper's experiment.

    Args:
        animal: `fish` or `mouse`, a key of `WORDS`.
        test: the 173 test sequences of two individuals, else the 426 training sequences of five.
    """
    individuals, n = (_TEST_FISH, N_TEST) if test else (_TRAIN_FISH, N_TRAIN)
    words = WORDS[animal]
    return [
        Scenario(
            animal,
            individuals[k % len(individuals)],
            1000 + k,
            RATE_HZ[animal],
            word=words[k % len(words)],
        )
        for k in range(n)
    ]


def training_recordings(animal: str) -> list[Scenario]:
    """Uncut recordings to learn from, 40 s each; a fish's last 8 by a 100 Hz camera, 20 s each.

    Args:
        animal: `fish` or `mouse`.
    """
    usual = [Scenario(animal, one, 1, RATE_HZ[animal], _SECONDS) for one in _TRAIN_SET]
    return usual + [
        Scenario(animal, one, 2, FAST_HZ, _FAST_SECONDS) for one in _FAST_SET.get(animal, ())
    ]


def by_usual_camera(recordings: Sequence[Recorded]) -> list[Recorded]:
    """Those by the animal's usual camera, the first 24.

    Args:
        recordings: one entry for each of `training_recordings`, in that order.
    """
    return list(recordings[: len(_TRAIN_SET)])


def test_recordings(animal: str, fast: bool, minutes: float) -> list[Scenario]:
    """Uncut test recordings of individuals whose traits no other individual has.

    Args:
        animal: `fish` or `mouse`.
        fast: the first sixth of the same recordings by a 100 Hz camera, instead of all of them by
            the usual one.
        minutes: length in all; about 5 minutes come from each of at most 6 individuals.
    """
    n = int(np.clip(round(60.0 * minutes / _TEST_SECONDS), 1, len(_TEST_SET)))
    seconds = 60.0 * minutes / n
    usual = [
        Scenario(animal, one, 3, RATE_HZ[animal], seconds, novel=True) for one in _TEST_SET[:n]
    ]
    return (
        [replace(one, rate_hz=FAST_HZ, filmed_s=_FAST_SHARE * seconds) for one in usual]
        if fast
        else usual
    )


test_recordings.__test__ = False  # type: ignore[attr-defined]  # its name is not a test's
