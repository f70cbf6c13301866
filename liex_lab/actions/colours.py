"""Colours of actions: a word has the same in the report, the replay and the dashboard.

Words of the bundled vocabularies have a colour of their own; others take those that are left, in
their order. Based on Paul Tol's qualitative schemes; red is kept for frames without a pose. The
predicted error has the dark yellow of his high-contrast scheme, which colour-blind people tell from
that red.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import cycle

NO_POSE = "#EE6677"
PREDICTED_ERROR = "#997700"
UNLABELLED = "#E2E2DC"
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


def action_colours(words: Sequence[str]) -> dict[str, str]:
    """The colour of each word of a vocabulary, as #rrggbb.

    Args:
        words: the words; beyond the palette colours come again.
    """
    chosen: dict[str, str] = {}
    for word in words:
        if word in _OWN and _OWN[word] not in chosen.values():
            chosen[word] = _OWN[word]
    free = [colour for colour in PALETTE if colour not in chosen.values()]
    left = cycle(free or PALETTE)
    return {word: chosen.get(word) or next(left) for word in words}
