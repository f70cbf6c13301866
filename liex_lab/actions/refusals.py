"""Bouts that a recogniser may not name so, since they contradict what their word means."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from liex_lab.actions.ethogram import UNLABELLED

Broken = Callable[[int, int, str], str]


@dataclass(frozen=True)
class Refused:
    """A bout that the network and the chain would have named, but that contradicts its definition.

    Attributes:
        rows: its frames.
        action: the word that was refused.
        named: what most of its frames are named instead, '' for nothing.
        why: what of the definition does not hold.
    """

    rows: slice
    action: str
    named: str
    why: str


class FrameCheck:
    """Checks bouts of ticks by their frames.

    Args:
        broken: says what frames [start, stop) break of a word's definition; None finds nothing.
        first: row of the first frame of the segment.
        tick: (r,) tick of each of its frames, ascending.
    """

    def __init__(self, broken: Broken | None, first: int, tick: NDArray[np.int64]) -> None:
        self._broken = broken
        self._first = first
        self._tick = tick

    def broken(self, start: int, stop: int, word: str) -> tuple[slice, str]:
        """The frames of a bout of ticks, and what it breaks of its word's definition.

        Args:
            start: first tick.
            stop: tick after the last.
            word: the bout's name.
        """
        a, b = (self._first + int(k) for k in np.searchsorted(self._tick, [start, stop]))
        if self._broken is None or word == UNLABELLED or a == b:
            return slice(a, b), ""
        return slice(a, b), self._broken(a, b, word)


def overlap(one: slice, other: slice) -> bool:
    """Whether two spans of frames have a frame in common.

    Args:
        one: a span.
        other: another one.
    """
    return one.start < other.stop and other.start < one.stop


def commonest(values: NDArray[np.int64]) -> int:
    """The value that occurs most often, the smallest of several.

    Args:
        values: (n,) not negative, n at least 1.
    """
    return int(np.bincount(values).argmax())
