"""Vocabularies of the bundled ethograms: definitions of the words, and limits of their bouts;
words for what one animal does to another (`INTERACTIONS`).

A `Definition` is a sentence and its measurable limits. The numbers in the sentence, the clause
printed after it and the check of every bout (`behaviour.bouts`) all come from these limits.
Thresholds are starting values, from the literature.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import cycle
from typing import NamedTuple

# relative tolerance of a number given with "about"; a bout's ends are less certain
ABOUT = 0.25


class Measure(NamedTuple):
    """A measure of a bout that a definition may bound.

    Attributes:
        label: its name in a sentence.
        unit: the displayed unit, with its space if any.
        kept: the size of a displayed unit in the unit of the measure.
    """

    label: str
    unit: str = ""
    kept: float = 1.0


_DEGREES = (" degrees", math.radians(1.0))
_CM_S = (" cm/s", 10.0)
MEASURES = {
    "speed_mm_s": Measure("mean and median speed", *_CM_S),
    "peak_speed_mm_s": Measure("peak speed", *_CM_S),
    "speed_bl_s": Measure("mean speed", " lengths/s"),
    "quiet_bl_s": Measure("mean speed beyond speed_sd_mm_s, the noise,", " lengths/s"),
    "duration_s": Measure("duration", " s"),
    "left_turn_rad": Measure("net turn to its left", *_DEGREES),
    "right_turn_rad": Measure("net turn to its right", *_DEGREES),
    "either_turn_rad": Measure("net turn to either side", *_DEGREES),
    "swing_rad": Measure("swing of the heading", *_DEGREES),
    "bend_rad": Measure("largest bend", *_DEGREES),
    "usual_bend_rad": Measure("median bend", *_DEGREES),
    "pitch_rad": Measure("mean pitch", *_DEGREES),
    "raised_bl": Measure("highest nose above the tail's base", " lengths"),
    "moved_bl": Measure("displacement", " lengths"),
}


class Limit(NamedTuple):
    """Bounds of a measure for every bout of a word.

    Attributes:
        measure: one of `MEASURES`, whose name contains its unit.
        least: the lower bound, in that unit.
        most: the upper bound.
        about: relative tolerance of the bounds, for a definition with "about".
    """

    measure: str
    least: float = -math.inf
    most: float = math.inf
    about: float = 0.0

    @property
    def bounds(self) -> tuple[float, float]:
        """The checked bounds: least and most, in the unit of the measure."""
        low = self.least - self.about * abs(self.least) if math.isfinite(self.least) else self.least
        high = self.most + self.about * abs(self.most) if math.isfinite(self.most) else self.most
        return low, high

    def holds(self, value: float) -> bool:
        """Whether a value, in the unit of the measure, is within the bounds; NaN is."""
        low, high = self.bounds
        return not (value < low or value > high)

    def shown(self, value: float) -> str:
        """A value, in the unit of the measure, in words and in the displayed unit."""
        measure = MEASURES[self.measure]
        return f"{measure.label} {value / measure.kept:.3g}{measure.unit}"

    @property
    def span(self) -> str:
        """The checked bounds, in the displayed unit."""
        measure = MEASURES[self.measure]
        low, high = (f"{bound / measure.kept:.3g}" for bound in self.bounds)
        if math.isinf(self.most):
            return f"at least {low}{measure.unit}"
        if math.isinf(self.least):
            return f"at most {high}{measure.unit}"
        return f"{low} to {high}{measure.unit}"


@dataclass(frozen=True)
class Definition:
    """The definition of a word.

    Attributes:
        pattern: the sentence; {0}, {1}, ... are the finite bounds of its limits, in order.
        limits: its measurable part.
    """

    pattern: str
    limits: tuple[Limit, ...]

    @property
    def sentence(self) -> str:
        """The definition alone, used by virtual animals and stored in models."""
        bounds = [
            f"{bound / MEASURES[limit.measure].kept:.6g}"
            for limit in self.limits
            for bound in (limit.least, limit.most)
            if math.isfinite(bound)
        ]
        return self.pattern.format(*bounds)

    @property
    def printed(self) -> str:
        """The definition with the limits that are checked for every bout."""
        checked = (f"{MEASURES[limit.measure].label} {limit.span}" for limit in self.limits)
        return f"{self.sentence} (checked: {', '.join(checked)})"


_REARS = Limit("raised_bl", least=0.4)
WORDS: dict[str, dict[str, Definition]] = {
    "fish": {
        "scoot": Definition(
            "forward swim with tail beats, {0} to {1} lengths/s, bends below about {2} degrees in "
            "all, no turn",
            (
                Limit("speed_bl_s", 0.7, 4.0, about=ABOUT),
                Limit("usual_bend_rad", most=math.radians(32.0), about=ABOUT),
            ),
        ),
        "j_turn": Definition(
            "slow turn of up to {0} degrees by repeated one-sided bends far caudally, the front "
            "half straight",
            (Limit("either_turn_rad", most=math.radians(45.0), about=ABOUT),),
        ),
        "c_turn": Definition(
            "C-bend of more than about {0} degrees in all within some 0.1 s, then a counter-bend "
            "and a burst",
            (Limit("bend_rad", least=math.radians(90.0), about=ABOUT),),
        ),
        "r_turn": Definition(
            "routine turn by a single bend of about {0} to {1} degrees in all, without a strong "
            "counter-bend",
            (Limit("bend_rad", math.radians(45.0), math.radians(110.0), about=ABOUT),),
        ),
        "surface": Definition(
            "swims up, pitch above about {0} degrees",
            (Limit("pitch_rad", least=math.radians(15.0), about=ABOUT),),
        ),
        "dive": Definition(
            "swims down, pitch below about {0} degrees",
            (Limit("pitch_rad", most=math.radians(-15.0), about=ABOUT),),
        ),
        "zigzag": Definition(
            "erratic: turns of {0} degrees and more that change side every 0.2 to 0.4 s, at "
            "raised speed",
            (Limit("swing_rad", least=math.radians(65.0)),),
        ),
        "thrash": Definition(
            "large alternating bends of the whole body with little displacement",
            (Limit("moved_bl", most=1.0),),
        ),
        "freeze": Definition(
            "below about {0} lengths/s without tail beats for {1} s or more",
            (Limit("quiet_bl_s", most=0.1, about=ABOUT), Limit("duration_s", least=0.9)),
        ),
    },
    "mouse": {
        "walk": Definition(
            "goes at about {0} to {1} cm/s", (Limit("speed_mm_s", 50.0, 300.0, about=ABOUT),)
        ),
        "run": Definition(
            "goes faster than about {0} cm/s", (Limit("speed_mm_s", least=300.0, about=ABOUT),)
        ),
        "turn_left": Definition(
            "turns by more than {0} degrees to its left, at up to {1} cm/s",
            (Limit("left_turn_rad", least=math.radians(30.0)), Limit("speed_mm_s", most=150.0)),
        ),
        "turn_right": Definition(
            "turns by more than {0} degrees to its right, at up to {1} cm/s",
            (Limit("right_turn_rad", least=math.radians(30.0)), Limit("speed_mm_s", most=150.0)),
        ),
        "rear_supported": Definition(
            "nose raised far above the tail's base with a wall within about 5 cm before it; "
            "rising and descending belong to it",
            (_REARS,),
        ),
        "rear_unsupported": Definition(
            "nose raised far above the tail's base without a wall within about 5 cm before it; "
            "rising and descending belong to it",
            (_REARS,),
        ),
        "groom": Definition(
            "sits hunched below {0} cm/s with rhythmic strokes of head and paws",
            (Limit("speed_mm_s", most=20.0),),
        ),
        "pause": Definition(
            "stays below {0} cm/s and looks about", (Limit("speed_mm_s", most=50.0),)
        ),
        "freeze": Definition(
            "no movement of the body at all for {0} s or more",
            (Limit("duration_s", least=1.0), Limit("speed_mm_s", most=20.0)),
        ),
        "sniff": Definition(
            "nose down to the floor with fast small movements of the head, below {0} cm/s",
            (Limit("speed_mm_s", most=100.0),),
        ),
        "dart": Definition(
            "a burst from standing to {0} cm/s or more and back within about {1} s",
            (Limit("peak_speed_mm_s", least=230.0), Limit("duration_s", most=1.0, about=1.0 / 3.0)),
        ),
        "stretch_attend": Definition(
            "body long, low and straight, below {0} cm/s", (Limit("speed_mm_s", most=50.0),)
        ),
    },
}
DEFINITIONS: dict[str, dict[str, str]] = {
    animal: {word: one.sentence for word, one in words.items()} for animal, words in WORDS.items()
}
_BY_PRINT = {one.printed: one for words in WORDS.values() for one in words.values()}


def limits_of(meaning: str) -> tuple[Limit, ...]:
    """The limits of a printed definition; empty for any other sentence.

    Users' own definitions are not checked, so the sentence decides and not the word.

    Args:
        meaning: the definition of a word, as `Definition.printed` gives it.
    """
    known = _BY_PRINT.get(meaning)
    return known.limits if known else ()


def printed_meanings(skeleton: str, kept: Mapping[str, str]) -> dict[str, str]:
    """The definitions of a model; those of this vocabulary with their checked limits.

    Args:
        skeleton: name of the animal's skeleton.
        kept: word -> definition in the model.
    """
    own = WORDS.get(skeleton, {})
    return {
        word: own[word].printed if word in own and own[word].sentence == meaning else meaning
        for word, meaning in kept.items()
    }


class Interaction(NamedTuple):
    """The definition of a word for what one animal does to another.

    Attributes:
        meaning: the sentence; names in braces are settings of the plan's section `interactions`.
        mabe: its name in the MABe challenge of 2025; '' if that has none.
        mutual: both animals do it.
        ends: a mutual one that depends on which end is the head.
        layered: it may happen at the same time as others; of those that are not layered, one
            animal does one at a time to another, the first in the order of `INTERACTIONS`.
        not_in: words in whose frames a layered one is not named.
    """

    meaning: str
    mabe: str = ""
    mutual: bool = False
    ends: bool = False
    layered: bool = False
    not_in: tuple[str, ...] = ()


INTERACTIONS: dict[str, Interaction] = {
    "mount": Interaction(
        "the agent's chest lies over the target's trunk, {mount_above_mm:g} mm or more above its "
        "mid-axis, and both head the same way within {mount_angle_rad:g} rad; where a pose is "
        "missing, their outline lacks the area of {mount_hidden:g} animals or more, but less than "
        "half as much volume, and in most of {before_s:g} s before the agent was behind, headed so",
        "mount",
    ),
    "huddle": Interaction(
        "both rest together: their trunks touch (skins within {contact_mm:g} mm) for {huddle_s:g} "
        "s or more, and both are slower than {still_mm_s:g} mm/s",
        "huddle",
        mutual=True,
    ),
    "chase": Interaction("follows faster than {fast_mm_s:g} mm/s in the median", "chase"),
    "follow": Interaction(
        "both go faster than {moving_mm_s:g} mm/s, the agent's nose is within {follow_mm:g} mm of "
        "where the target's tail base was in the last {follow_s:g} s, and it heads as the target "
        "did there within {follow_angle_rad:g} rad",
        "follow",
    ),
    "nose_to_nose": Interaction(
        "both noses are within {nose_mm:g} mm of each other, each nearest to the other's front "
        "quarter, and one of the heads points at the other nose within {nose_angle_rad:g} rad",
        "sniffface",
        mutual=True,
        ends=True,
    ),
    "nose_to_tail_base": Interaction(
        "the agent's nose is within {nose_mm:g} mm of the target's tail base, nearest to its rear "
        "quarter, and the head points there within {nose_angle_rad:g} rad",
        "sniffgenital",
    ),
    "nose_to_side": Interaction(
        "the agent's nose is within {contact_mm:g} mm of the skin of the target's trunk, nearest "
        "to its middle half",
        "sniffbody",
    ),
    "side_by_side_same": Interaction(
        "noses and tail bases are within {side_by_side_mm:g} mm of each other",
        mutual=True,
        ends=True,
        layered=True,
        not_in=("mount",),
    ),
    "side_by_side_opposite": Interaction(
        "each nose is within {side_by_side_mm:g} mm of the other's tail base",
        mutual=True,
        ends=True,
        layered=True,
        not_in=("mount",),
    ),
    "contact": Interaction(
        "the skins are within {contact_mm:g} mm of each other, or one animal lies over the other",
        mutual=True,
        layered=True,
    ),
    "approach": Interaction(
        "the agent goes towards the target within 45 degrees, faster than {moving_mm_s:g} mm/s and "
        "than the target towards it, and nears it as fast, until the skins are within "
        "{near_mm:g} mm",
        "approach",
        layered=True,
    ),
    "escape": Interaction(
        "leaves, and is faster than {fast_mm_s:g} mm/s at some time", "escape", layered=True
    ),
    "leave": Interaction(
        "the agent goes away from the target within 45 degrees, faster than {moving_mm_s:g} mm/s "
        "and than the target from it, and parts from it as fast, from skins within {near_mm:g} mm "
        "until they are farther apart",
        "disengage",
        layered=True,
    ),
    "avoid": Interaction(
        "the agent goes away or aside, faster than {moving_mm_s:g} mm/s and not towards the "
        "target, while that one, {contact_mm:g} to {avoid_mm:g} mm from its skin, comes towards it "
        "faster than {moving_mm_s:g} mm/s and does not follow",
        "avoid",
        layered=True,
        not_in=("follow",),
    ),
    "isolated": Interaction(
        "the agent's skin is farther than {isolated_mm:g} mm from every other for {isolated_s:g} s "
        "or more; there is no target",
        layered=True,
    ),
}


class Fastest(NamedTuple):
    """The fastest part of an action, and the frame rate that resolves it.

    Attributes:
        what: name of the part.
        seconds: its duration, s.
        least_hz: the lowest frame rate that resolves it, 1/s.
    """

    what: str
    seconds: float
    least_hz: float


_BEAT = Fastest(
    "a beat of the tail", 0.1, 40.0
)  # up to 10 Hz in adults; frequencies are measured up to rate / 4
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


# Colours of actions, the same in the report, the replay and the dashboard.


NO_POSE = "#EE6677"
PREDICTED_ERROR = "#997700"
UNLABELLED_COLOUR = "#E2E2DC"
PALETTE = (
    "#FFAABB",
    "#CCBB44",
    "#4477AA",
    "#BBBBBB",
    "#228833",
    "#66CCEE",
    "#AA3377",
    "#332288",
    "#999933",
    "#EE8866",
    "#44BB99",
    "#882255",
)
_ANIMALS = ("#EE7733", "#33BBEE", "#EE3377", "#0077BB")
_OWN = {
    "walk": "#4477AA",
    "run": "#CCBB44",
    "pause": "#BBBBBB",
    "rear": "#AA3377",
    "rear_supported": "#AA3377",
    "rear_unsupported": "#FFAABB",
    "turn_left": "#228833",
    "turn_right": "#44BB99",
    "groom": "#332288",
    "freeze": "#66CCEE",
    "sniff": "#999933",
    "dart": "#EE8866",
    "stretch_attend": "#882255",
    "scoot": "#4477AA",
    "j_turn": "#228833",
    "r_turn": "#44BB99",
    "c_turn": "#EE8866",
    "surface": "#FFAABB",
    "dive": "#332288",
    "zigzag": "#CCBB44",
    "thrash": "#AA3377",
}


def action_colours(words: Sequence[str], own: Mapping[str, str] = _OWN) -> dict[str, str]:
    """The colour of each word, as #rrggbb; colours repeat beyond the palette.

    Args:
        words: a vocabulary, or some of its words, the most important first.
        own: the colours that words have if no earlier one has them.
    """
    chosen: dict[str, str] = {}
    for word in words:
        if own.get(word, "") not in {"", *chosen.values()}:
            chosen[word] = own[word]
    left = cycle([colour for colour in PALETTE if colour not in chosen.values()] or PALETTE)
    return {word: chosen.get(word) or next(left) for word in words}


def individual_colours(names: Sequence[str]) -> dict[str, str]:
    """The colour of each animal of an arena, as #rrggbb.

    Args:
        names: of all animals, in the order of the arena.
    """
    return dict(zip(names, cycle(_ANIMALS), strict=False))
