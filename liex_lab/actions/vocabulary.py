"""Vocabularies of the bundled ethograms: definitions of the words, and the fastest part of each.

Thresholds in the definitions are starting values, with the literature's.
"""

from __future__ import annotations

from typing import NamedTuple

DEFINITIONS: dict[str, dict[str, str]] = {
    "fish": {
        "scoot": (
            "forward swim with tail beats, 0.7 to 4 lengths/s, bends below about 32 degrees in "
            "all, no turn"
        ),
        "j_turn": (
            "slow turn of up to 45 degrees by repeated one-sided bends far caudally, the front "
            "half straight"
        ),
        "c_turn": (
            "C-bend of more than about 90 degrees in all within some 0.1 s, then a counter-bend "
            "and a burst"
        ),
        "r_turn": (
            "routine turn by a single bend of about 45 to 110 degrees in all, without a strong "
            "counter-bend"
        ),
        "surface": "swims up, pitch above about 15 degrees",
        "dive": "swims down, pitch below about -15 degrees",
        "zigzag": (
            "erratic: turns of 65 degrees and more that change side every 0.2 to 0.4 s, at "
            "raised speed"
        ),
        "thrash": "large alternating bends of the whole body with little displacement",
        "freeze": "below about 0.1 lengths/s without tail beats for 0.9 s or more",
    },
    "mouse": {
        "walk": "goes at about 5 to 30 cm/s",
        "run": "goes faster than about 30 cm/s",
        "turn_left": "turns by more than 30 degrees to its left, at up to 15 cm/s",
        "turn_right": "turns by more than 30 degrees to its right, at up to 15 cm/s",
        "rear_supported": (
            "nose raised far above the tail's base with a wall within about 5 cm before it; "
            "rising and descending belong to it"
        ),
        "rear_unsupported": (
            "nose raised far above the tail's base without a wall within about 5 cm before it; "
            "rising and descending belong to it"
        ),
        "groom": "sits hunched below 2 cm/s with rhythmic strokes of head and paws",
        "pause": "stays below 5 cm/s and looks about",
        "freeze": "no movement of the body at all for 1 s or more",
        "sniff": "nose down to the floor with fast small movements of the head, below 10 cm/s",
        "dart": "a burst from standing to 23 cm/s or more and back within about 1 s",
        "stretch_attend": "body long, low and straight, below 5 cm/s",
    },
}


class Fastest(NamedTuple):
    """The fastest part of an action, and from which frame rate on it can be followed.

    Attributes:
        what: what the part is.
        seconds: how long it takes, s.
        least_hz: the frame rate from which on it can be followed, 1/s.
    """

    what: str
    seconds: float
    least_hz: float


_BEAT = Fastest(
    "a beat of the tail", 0.1, 40.0
)  # up to 10 Hz in adults; a frequency is told up to rate / 4
FASTEST: dict[str, dict[str, Fastest]] = {
    "fish": {
        "c_turn": Fastest("its first bend", 0.02, 250.0),
        "scoot": _BEAT,
        "surface": _BEAT,
        "dive": _BEAT,
        "thrash": _BEAT,
        "zigzag": Fastest("one of its turns", 0.16, 20.0),
    },
    "mouse": {
        "groom": Fastest("a stroke", 0.17, 30.0),
        "sniff": Fastest("one movement of the head", 0.1, 40.0),
        "dart": Fastest("its start", 0.12, 25.0),
    },
}
