"""Which recordings action recognisers are trained on and judged by. Individuals are never on both sides."""

from __future__ import annotations

from collections.abc import Sequence

from liex_lab.pipelines.acted import Scenario

from liex_lab.actions.labelled import LabelledTrack
from liex_lab.recordings import fish_acts, mouse_acts

WORDS = {"fish": fish_acts.ACTIONS, "mouse": mouse_acts.ACTIONS}
RATE_HZ = {"fish": 50.0, "mouse": 30.0}  # of their cameras
FAST_HZ = 100.0
N_TRAIN, N_TEST = 426, 173  # cut-out sequences, as in the paper, of 5 and 2 fish
_TRAIN_FISH, _TEST_FISH = (101, 102, 103, 104, 105), (106, 107)
_TRAIN_SET, _TEST_SET = tuple(range(201, 225)), tuple(range(301, 307))
_FAST_SET = {"fish": tuple(range(225, 233))}
_SECONDS, _FAST_SECONDS, _TEST_FAST_SECONDS = 40.0, 20.0, 30.0


def cut_sequences(animal: str, test: bool) -> list[Scenario]:
    """Single actions, cut out by hand as it were: the paper's experiment."""
    individuals, n = (_TEST_FISH, N_TEST) if test else (_TRAIN_FISH, N_TRAIN)
    words = WORDS[animal]
    return [
        Scenario(animal, individuals[k % len(individuals)], 1000 + k, RATE_HZ[animal], word=words[k % len(words)])
        for k in range(n)
    ]


def training_recordings(animal: str) -> list[Scenario]:
    """Uncut recordings to learn from, a fish's last ones by a faster camera."""
    usual = [Scenario(animal, one, 1, RATE_HZ[animal], _SECONDS) for one in _TRAIN_SET]
    return usual + [Scenario(animal, one, 2, FAST_HZ, _FAST_SECONDS) for one in _FAST_SET.get(animal, ())]


def by_usual_camera(tracks: Sequence[LabelledTrack]) -> list[LabelledTrack]:
    """Of the tracks of `training_recordings` those by the animal's usual camera."""
    return list(tracks[: len(_TRAIN_SET)])


def test_recordings(animal: str, fast: bool, minutes: float) -> list[Scenario]:
    """Uncut recordings, so many minutes in all, of individuals whose traits no other has; fast: by a faster camera."""
    seconds = _TEST_FAST_SECONDS if fast else 60.0 * minutes / len(_TEST_SET)
    rate = FAST_HZ if fast else RATE_HZ[animal]
    return [Scenario(animal, one, 3 + fast, rate, seconds, novel=True) for one in _TEST_SET]


test_recordings.__test__ = False  # type: ignore[attr-defined]  # its name is not a test's
