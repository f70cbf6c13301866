"""Check of bouts against the measurable part of their definitions.

The limits are those of `actions.vocabulary`, which the printed definitions come from, too. A bout
that a recogniser named and that breaks a limit of its word is refused, and its track decoded again;
one that a person named stays, and the table `bouts` says in `contradicts` what does not hold.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from liex_lab.actions.vocabulary import Limit, limits_of, printed_meanings
from liex_lab.behaviour.bout_reader import BoutReader
from liex_lab.behaviour.kinematics import Joints, kinematics
from liex_lab.runtime.memory import Allocator
from liex_lab.tables.rows import Rows

if TYPE_CHECKING:
    from liex_lab.actions.timeline import Recognised, TimelineModel
    from liex_lab.tracking.track import Track

Array = NDArray[np.float64]
Reading = Callable[[BoutReader, int, int], tuple[float, ...]]


def _motion(*names: str) -> Reading:
    return lambda bout, a, b: tuple(bout.motion(a, b)[name] for name in names)


def _turn(name: str, sign: float = 1.0) -> Reading:
    return lambda bout, a, b: (sign * bout.turn(a, b)[name],)


def _median(values: Array) -> float:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else np.nan


def _beyond_noise(bout: BoutReader, a: int, b: int) -> float:
    """Mean speed less what errors of the pose alone look like, mm/s."""
    noise = _median(bout.column("speed_sd_mm_s", a, b))
    return max(bout.motion(a, b)["mean_speed_mm_s"] - (0.0 if np.isnan(noise) else noise), 0.0)


# how each of `actions.vocabulary.MEASURES` is read; where there are two values both have to fit
_READ: dict[str, Reading] = {
    "speed_mm_s": _motion("mean_speed_mm_s", "median_speed_mm_s"),
    "peak_speed_mm_s": _motion("peak_speed_mm_s"),
    "quiet_bl_s": lambda bout, a, b: (_beyond_noise(bout, a, b) / bout.length_mm,),
    "speed_bl_s": lambda bout, a, b: (bout.motion(a, b)["mean_speed_mm_s"] / bout.length_mm,),
    "duration_s": lambda bout, a, b: (bout.seconds(a, b),),
    "left_turn_rad": _turn("net_turn_rad"),
    "right_turn_rad": _turn("net_turn_rad", -1.0),
    "either_turn_rad": lambda bout, a, b: (abs(bout.turn(a, b)["net_turn_rad"]),),
    "swing_rad": _turn("heading_range_rad"),
    "bend_rad": _turn("bend_max_rad"),
    "usual_bend_rad": lambda bout, a, b: (_median(np.abs(bout.column("bend_rad", a, b))),),
    "pitch_rad": _turn("mean_pitch_rad"),
    "raised_bl": lambda bout, a, b: (bout.height(a, b)["peak_nose_over_rump_mm"] / bout.length_mm,),
    "moved_bl": lambda bout, a, b: (bout.motion(a, b)["displacement_mm"] / bout.length_mm,),
}


class BoutCheck:
    """Says of a bout what of its printed definition does not hold.

    Args:
        bouts: reads the measures of bouts.
        meanings: word -> definition as it is printed; only those of the bundled vocabularies have
            limits, see `actions.vocabulary.limits_of`.
    """

    def __init__(self, bouts: BoutReader, meanings: Mapping[str, str]) -> None:
        self._bouts = bouts
        self._limits = {word: limits_of(meaning) for word, meaning in meanings.items()}

    def broken(self, start: int, stop: int, word: str) -> str:
        """What a bout breaks of its word's definition, in words; empty where it breaks nothing.

        Args:
            start: first row of the bout in the table `kinematics`.
            stop: row after its last.
            word: its name.
        """
        told = (self._told(limit, start, stop) for limit in self._limits.get(word, ()))
        return "; ".join(filter(None, told))

    def _told(self, limit: Limit, start: int, stop: int) -> str:
        values = _READ[limit.measure](self._bouts, start, stop)
        wrong = [value for value in values if not limit.holds(value)]
        return f"{limit.shown(wrong[0])}, not {limit.span}" if wrong else ""


def recognise(
    recogniser: TimelineModel,
    track: Track,
    wall_mm: Array | None = None,
    moved: pd.DataFrame | None = None,
    allocate: Allocator = np.empty,
) -> Recognised:
    """The ethogram of a track, in which no bout contradicts its printed definition.

    Args:
        recogniser: names the track.
        track: one animal's track of n frames.
        wall_mm: (n,) distance of the animal from the nearest wall, mm; None where nobody knows.
        moved: the table `kinematics` of the track; None makes it with the default settings.
        allocate: allocator of large intermediate arrays and of the probabilities.
    """
    if moved is None:
        frames = Rows(track, np.arange(track.n_frames), "", "").frames_table
        moved = kinematics(frames, Joints.of_track(track), allocate=allocate)
    meanings = printed_meanings(recogniser.skeleton, recogniser.definitions)
    check = BoutCheck(BoutReader(moved), meanings)
    return recogniser.recognise(track, wall_mm, allocate, check.broken)
