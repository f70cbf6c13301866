"""Ethogram: an animal's actions over time, as half-open labelled intervals (bouts) in
nanoseconds.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from liex_lab.errors import LiexError
from liex_lab.recordings.timestamps import frames_apart, median_step

UNLABELLED = ""  # the word of a frame without an action
LONGEST_GAP_S = 0.4  # that the recogniser bridges
ACROSS_GAPS = (  # printed in columns.json, the report and the methods
    f"The recogniser continues a bout across gaps of up to {LONGEST_GAP_S:g} s (2.5 frame "
    "intervals of a slower camera), a person's bout may span any gap, and a bout named by a rule "
    "ends at a gap. The duration of a bout runs by the clock, gaps included; the time and the "
    "share of an action count observed frames only. No speed or distance is measured across a gap."
)


def runs_of(values: NDArray[Any]) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[Any]]:
    """Run-length encoding: starts, stops and values of the runs of equal values.

    Args:
        values: (m,) with m at least 1.

    Returns:
        Starts (r,), stops (r,), exclusive, and values (r,) of the runs.
    """
    starts = np.flatnonzero(np.append(True, values[1:] != values[:-1]))
    return starts, np.append(starts[1:], len(values)), values[starts]


@dataclass(frozen=True)
class Bout:
    """One named interval, half open: the frame at stop_ns is the first outside.

    Attributes:
        start_ns: onset, timestamp of the first frame inside.
        stop_ns: time of the first frame outside.
        action: a word of the vocabulary.
        score: probability of its name, mean over its frames.
    """

    start_ns: int
    stop_ns: int
    action: str
    score: float = 1.0


@dataclass(frozen=True)
class Ethogram:
    """One animal's bouts, in order and without overlap.

    Attributes:
        bouts: in order of time.
        vocabulary: word -> definition.
        source: model or human.

    Raises:
        LiexError: a bout stops before it starts, or two overlap.
    """

    bouts: tuple[Bout, ...]
    vocabulary: Mapping[str, str] = field(default_factory=dict)
    source: str = "model"

    def __post_init__(self) -> None:
        last = None
        for bout in self.bouts:
            if bout.stop_ns <= bout.start_ns:
                raise LiexError(
                    f"a bout of {bout.action} stops at {bout.stop_ns} ns, which is not after its "
                    "start"
                )
            if last is not None and bout.start_ns < last.stop_ns:
                raise LiexError(
                    f"bouts overlap: {last.action} stops at {last.stop_ns} ns, but {bout.action} "
                    f"starts at {bout.start_ns} ns; end one before the next begins"
                )
            last = bout

    def __iter__(self) -> Iterator[Bout]:
        """The bouts in order."""
        return iter(self.bouts)

    def __len__(self) -> int:
        """The number of bouts."""
        return len(self.bouts)

    def words(self, times_ns: NDArray[np.int64]) -> NDArray[np.str_]:
        """The word of every frame.

        Args:
            times_ns: (n,) timestamps, increasing.

        Returns:
            (n,) words, `UNLABELLED` outside all bouts.
        """
        ends = np.array([(bout.start_ns, bout.stop_ns) for bout in self.bouts], np.int64)
        actions = [bout.action for bout in self.bouts]
        return frame_words(actions, np.searchsorted(times_ns, ends.reshape(-1, 2)), len(times_ns))

    @staticmethod
    def of_words(
        words: Sequence[str] | NDArray[np.str_] | NDArray[np.signedinteger],
        times_ns: NDArray[np.int64],
        vocabulary: Mapping[str, str] | None = None,
        score: NDArray[np.float64] | None = None,
        part: NDArray[np.signedinteger] | None = None,
        source: str = "model",
        names: Sequence[str] | None = None,
    ) -> "Ethogram":
        """The bouts of labelled frames; frames that are `UNLABELLED` belong to none.

        Args:
            words: (n,) word of each frame, or its index in `names`.
            times_ns: (n,) timestamps, increasing.
            vocabulary: word -> definition; None if absent.
            score: (n,) probability of each frame's word; None counts as 1.
            part: (n,) number of each frame's unbroken segment; no bout crosses segments.
            source: model or human.
            names: the words, if `words` are indices.

        Returns:
            The ethogram; the score of a bout is the mean over its frames.
        """
        label = np.asarray(words, np.str_) if names is None else np.asarray(words)
        n = len(label)
        if n == 0:
            return Ethogram((), vocabulary or {}, source)
        part = np.zeros(n, np.int64) if part is None else part
        changes = (label[1:] != label[:-1]) | (part[1:] != part[:-1])
        starts = np.flatnonzero(np.append(True, changes))
        stops = np.append(starts[1:], n)
        stop_ns = frame_stops(times_ns)
        sure = np.ones(n) if score is None else score
        named = [str(one if names is None else names[one]) for one in label[starts]]
        bouts = [
            Bout(int(times_ns[a]), int(stop_ns[b - 1]), word, float(sure[a:b].mean()))
            for a, b, word in zip(starts, stops, named, strict=True)
            if word != UNLABELLED
        ]
        return Ethogram(tuple(bouts), vocabulary or {}, source)


def frame_words(actions: Sequence[str], spans: NDArray[np.int64], n: int) -> NDArray[np.str_]:
    """The words (n,) of frames by bouts in rows [start, stop), `spans` (k, 2); later ones win."""
    out = np.full(n, UNLABELLED, dtype=f"<U{max([1, *map(len, actions)])}")
    for action, (start, stop) in zip(actions, spans, strict=True):
        out[start:stop] = action
    return out


def frame_stops(times_ns: NDArray[np.int64]) -> NDArray[np.int64]:
    """End of each frame's validity.

    At the next frame; before a gap (1.5 median steps) or at the end, one median step later.

    Args:
        times_ns: (n,) timestamps, increasing.

    Returns:
        (n,) ns.
    """
    if len(times_ns) < 2:
        return times_ns + 1
    usual = median_step(times_ns)
    whole = frames_apart(times_ns, usual) == 1
    return times_ns + np.append(np.where(whole, np.diff(times_ns), usual), usual)
