"""Activity over a session in bins of one minute: distance, mean speed and time in each action.

Time-binned activity as in open-field and locomotor assays; a recording of less than ten minutes is
divided into ten bins. Every time is a sum over observed frames of the time to the next frame, so
the times of the actions and the unlabelled time add up to the observed time.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from liex_lab.behaviour.kinematics import segments
from liex_lab.behaviour.statistics import false_discovery
from liex_lab.tables.rows import stop_times
from liex_lab.tables.schema import table_columns, to_pandas

Array = NDArray[np.float64]

BIN_S = 60.0
FEWEST = 10  # bins, of a shorter recording


def activity(kinematics: pd.DataFrame, bouts: pd.DataFrame, words: Sequence[str]) -> pd.DataFrame:
    """The table `activity` of one animal: one row per time bin.

    A frame counts in the bin in which it begins.

    Args:
        kinematics: the table `kinematics`.
        bouts: the table `bouts`, in order of time.
        words: the actions' names.
    """
    time_s = kinematics["time_s"].to_numpy(float)
    edges = intervals(float(stop_times(time_s)[-1]))
    row = np.clip(np.searchsorted(edges, time_s, side="right") - 1, 0, len(edges) - 2)
    hold = observed_hold(kinematics)
    step = kinematics["step_mm"].to_numpy(float)
    moved = np.isfinite(step)
    n = len(edges) - 1

    def total(values: Array, mask: NDArray[np.bool_]) -> Array:
        """Sum of `values` (n,) over the frames of `mask` (n,) in each bin, (k,)."""
        return np.bincount(row[mask], values[mask], n).astype(float)

    distance = total(step, moved)
    timed = total(hold, moved)
    spent = time_named(kinematics, bouts, words, row, n)
    return to_pandas(
        table_columns("activity", words=words),
        {
            **{name: [str(kinematics[name].iloc[0])] * n for name in ("session_id", "individual")},
            "start_s": edges[:-1],
            "stop_s": edges[1:],
            "observed_s": total(hold, hold > 0.0),
            "distance_mm": distance,
            "mean_speed_mm_s": np.divide(distance, timed, out=np.full(n, np.nan), where=timed > 0),
            "unlabelled_s": spent[:, 0],
            **{f"{word}_s": spent[:, k] for k, word in enumerate(words, 1)},
        },
    )


def intervals(duration_s: float) -> Array:
    """Edges (k + 1,) of the bins of a recording, s: whole minutes, the last one possibly shorter.

    Less than ten minutes are divided into tenths.
    """
    if duration_s < FEWEST * BIN_S:
        return np.linspace(0.0, duration_s, FEWEST + 1)
    return np.append(np.arange(0.0, duration_s - 1e-9, BIN_S), duration_s)


def observed_hold(kinematics: pd.DataFrame) -> Array:
    """The duration of each frame, (n,) s: until the next frame; 0 without a measured pose.

    Before a gap of the camera and at the end it is one median step.
    """
    time_s = kinematics["time_s"].to_numpy(float)
    observed = np.isfinite(kinematics["x_mm"].to_numpy(float))
    return np.where(observed, stop_times(time_s) - time_s, 0.0)


def time_named(
    kinematics: pd.DataFrame,
    bouts: pd.DataFrame,
    words: Sequence[str],
    row: NDArray[np.int64] | int = 0,
    n: int = 1,
) -> Array:
    """Observed time without a name and in each action, (n, 1 + len(words)) s, in n intervals.

    A row adds up to the observed time of its interval, even if bouts continue across gaps.

    Args:
        kinematics: the table `kinematics`.
        bouts: the table `bouts`.
        words: the actions' names; bouts of any other count as unlabelled.
        row: the interval of each frame.
        n: number of intervals.
    """
    time_s = kinematics["time_s"].to_numpy(float)
    index = {word: k for k, word in enumerate(words, 1)}
    code = np.zeros(len(time_s), np.int64)
    # a frame at a bout's start belongs to it, one at its stop does not, despite rounded seconds
    spans = np.searchsorted(time_s, bouts[["start_s", "stop_s"]].to_numpy(float) - 1e-6)
    for (start, stop), word in zip(spans, bouts["action"], strict=True):
        code[start:stop] = index.get(word, 0)
    width = len(index) + 1
    spent = np.bincount(row * width + code, observed_hold(kinematics), n * width)
    return np.asarray(spent.reshape(n, width))


# First-order transition matrix of actions, tested against quasi-independence (Goodman 1968).


Counts = NDArray[np.int64]
_ALIKE = 1e-7  # outcomes with a smaller difference are equally likely
_ROUNDS = 500  # of iterative scaling, which converges in a few dozen


def transitions(
    bouts: pd.DataFrame, words: Sequence[str], gaps: pd.DataFrame, longest_pause_s: float
) -> pd.DataFrame:
    """The table `transitions` of one animal: every ordered pair of different actions.

    By chance, each action is followed by another one in proportion to the frequency of the latter.
    A bout's action is assumed to depend only on the previous one (first-order Markov); longer
    patterns are not analysed.

    Args:
        bouts: the table `bouts`, in order of time.
        words: the k words of the vocabulary, which include every action of `bouts`.
        gaps: the table `gaps`.
        longest_pause_s: bouts further apart than this do not follow each other, s.

    Returns:
        k (k - 1) rows of the table `transitions`.
    """
    counts = count_transitions(bouts, words, gaps, longest_pause_s)
    expected = by_chance(counts)
    rows, columns = np.nonzero(~np.eye(len(words), dtype=bool))
    n = counts[rows, columns]
    n_from = counts.sum(axis=1)[rows]
    chance = expected[rows, columns]
    p = np.array(
        [_binomial(int(k), int(total), q) for k, total, q in zip(n, n_from, chance, strict=True)]
    )
    names = np.array(words, dtype=object)
    return to_pandas(
        table_columns("transitions"),
        {
            **{name: [_first(bouts, name)] * len(n) for name in ("session_id", "individual")},
            "from_action": names[rows],
            "to_action": names[columns],
            "n": n,
            "n_from": n_from,
            "probability": np.divide(n, n_from, out=np.full(len(n), np.nan), where=n_from > 0),
            "by_chance": chance,
            "p": p,
            "p_fdr": false_discovery(p),
        },
    )


def count_transitions(
    bouts: pd.DataFrame, words: Sequence[str], gaps: pd.DataFrame, longest_pause_s: float
) -> Counts:
    """(k, k) int64, the number of transitions from word i to word j != i.

    A transition does not count across a gap with missing frames, or across an unnamed stretch
    longer than `longest_pause_s`.

    Args:
        bouts: the table `bouts`, in order of time.
        words: the k words of the vocabulary.
        gaps: the table `gaps`.
        longest_pause_s: longest time between two bouts that follow each other, s.
    """
    index = {word: k for k, word in enumerate(words)}
    code = np.array([index[word] for word in bouts["action"]], np.int64)
    start = bouts["start_s"].to_numpy(float)
    stop = bouts["stop_s"].to_numpy(float)
    counts = np.zeros((len(words), len(words)), np.int64)
    if len(code) < 2:
        return counts
    broken = gaps.loc[gaps["n_frames_missing"] > 0, "start_s"].to_numpy(float, copy=True)
    broken.sort()  # a gap separates two bouts if it begins between them
    parted = np.searchsorted(broken, start[1:] - 1e-9) != np.searchsorted(broken, stop[:-1] - 1e-9)
    near = (start[1:] - stop[:-1] <= longest_pause_s) & ~parted & (code[1:] != code[:-1])
    np.add.at(counts, (code[:-1][near], code[1:][near]), 1)
    return counts


def by_chance(counts: Counts) -> Array:
    """(k, k) probability of j after i under quasi-independence, by iterative proportional fitting.

    Row and column sums equal the counts, the diagonal is empty (Goodman 1968).

    Args:
        counts: (k, k) int64 transitions, zero on the diagonal.

    Returns:
        Rows add up to one; NaN in the rows of actions without a successor.
    """
    rows = counts.sum(axis=1).astype(float)
    columns = counts.sum(axis=0).astype(float)
    fitted = (~np.eye(len(counts), dtype=bool)).astype(float) * np.outer(rows > 0, columns > 0)
    for _ in range(_ROUNDS):
        fitted *= np.divide(
            rows, fitted.sum(axis=1), out=np.zeros_like(rows), where=fitted.sum(axis=1) > 0
        )[:, None]
        deviation = np.divide(
            columns, fitted.sum(axis=0), out=np.zeros_like(rows), where=fitted.sum(axis=0) > 0
        )
        fitted *= deviation
        if np.abs(deviation[columns > 0] - 1.0).max(initial=0.0) < 1e-9:
            break
    total = fitted.sum(axis=1, keepdims=True)
    return np.divide(fitted, total, out=np.full_like(fitted, np.nan), where=total > 0)


def _binomial(n: int, total: int, chance: float) -> float:
    """Two-sided p of the exact binomial test; NaN if `chance` is 0 or 1.

    It sums the probabilities of all outcomes that are at most as likely as the observed one, as
    `scipy.stats.binomtest` does. That function is avoided because importing it is slow.
    """
    if total == 0 or not 1e-9 < chance < 1.0 - 1e-9:
        return float("nan")
    from scipy.special import gammaln, xlogy

    k = np.arange(total + 1)
    likely = np.exp(
        gammaln(total + 1)
        - gammaln(k + 1)
        - gammaln(total - k + 1)
        + xlogy(k, chance)
        + xlogy(total - k, 1.0 - chance)
    )
    return min(1.0, float(likely[likely <= likely[n] * (1.0 + _ALIKE)].sum()))


def _first(table: pd.DataFrame, name: str) -> str:
    return str(table[name].iloc[0]) if len(table) else ""


# Peri-event average: median and quartiles of a measure around the onsets of an action.


BEFORE_S = 1.0
AFTER_S = 2.0
_STEPS = 61
_FEWEST = 5  # bouts for quartiles


@dataclass(frozen=True)
class Around:
    """A measure around the onsets of an action, at k times.

    Attributes:
        time_s: (k,) time relative to the onset, s.
        low: (k,) lower quartile over the bouts, in the measure's own unit.
        median: (k,) median over the bouts.
        high: (k,) upper quartile over the bouts.
        n: number of bouts.
    """

    time_s: Array
    low: Array
    median: Array
    high: Array
    n: int


def around_onsets(
    kinematics: pd.DataFrame, bouts: pd.DataFrame, action: str, column: str
) -> Around | None:
    """Peri-event median and quartiles of a column around every onset of an action.

    Values are interpolated linearly between the frames' true times, never across a gap. A bout
    without a value does not count, and a time with fewer than five values is NaN.

    Args:
        kinematics: the table `kinematics`.
        bouts: the table `bouts`.
        action: the action.
        column: the column of `kinematics`.

    Returns:
        From `BEFORE_S` before to `AFTER_S` after the onset; None if there are too few bouts.
    """
    own = bouts.loc[bouts["action"] == action, "start_s"].to_numpy(float)
    if len(own) < _FEWEST:
        return None
    time_s = kinematics["time_s"].to_numpy(float)
    values = kinematics[column].to_numpy(float)
    grid = np.linspace(-BEFORE_S, AFTER_S, _STEPS)
    wanted = own[:, None] + grid
    after = np.clip(np.searchsorted(time_s, wanted), 1, len(time_s) - 1)
    span = time_s[after] - time_s[after - 1]
    share = np.divide(wanted - time_s[after - 1], span, out=np.zeros_like(wanted), where=span > 0)
    found = values[after - 1] + share * (values[after] - values[after - 1])
    number = segments(time_s, np.isfinite(values))
    inside = (number[after] == number[after - 1]) & (wanted >= time_s[0]) & (wanted <= time_s[-1])
    found = np.where(inside, found, np.nan)
    enough = np.isfinite(found).sum(axis=0) >= _FEWEST
    quartiles = np.full((3, _STEPS), np.nan)
    quartiles[:, enough] = np.nanpercentile(found[:, enough], [25.0, 50.0, 75.0], axis=0)
    low, median, high = quartiles
    return Around(grid, low, median, high, len(own)) if enough.any() else None
