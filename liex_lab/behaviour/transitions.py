"""First-order transition matrix of actions, tested against quasi-independence (Goodman 1968).

Expected: p(j after i) of a table with the counted row and column sums and an empty diagonal, fitted
by iterative proportional fitting (Deming and Stephan 1940), for an action never follows itself.
Observed n of n_from is compared with it by an exact two-sided binomial test per pair, and the p are
corrected by Benjamini and Hochberg's procedure.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from liex_lab.behaviour.multiplicity import false_discovery
from liex_lab.tables.schema import table_columns, to_pandas

Array = NDArray[np.float64]
Counts = NDArray[np.int64]
_ALIKE = 1e-7  # outcomes whose probabilities differ by less are as likely
_ROUNDS = 500  # of iterative scaling; it converges in some dozens


def transitions(
    bouts: pd.DataFrame, words: Sequence[str], gaps: pd.DataFrame, longest_pause_s: float
) -> pd.DataFrame:
    """The table `transitions` of one animal: every ordered pair of different actions.

    By chance, each action is followed by another one in proportion to how often those occur. One
    bout's action depends on the last one's only (first-order Markov); longer patterns are not
    looked for.

    Args:
        bouts: the table `bouts`, in order of time.
        words: the k words of the vocabulary; every action of `bouts` is one of them.
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
    """(k, k) int64, how often word j followed upon word i != j.

    A transition does not count across a gap with missing frames, or across an unnamed stretch
    longer than `longest_pause_s`.

    Args:
        bouts: the table `bouts`, in order of time.
        words: the k words of the vocabulary.
        gaps: the table `gaps`.
        longest_pause_s: longest time between two bouts that follow each other, s.
    """
    place = {word: k for k, word in enumerate(words)}
    code = np.array([place[word] for word in bouts["action"]], np.int64)
    start = bouts["start_s"].to_numpy(float)
    stop = bouts["stop_s"].to_numpy(float)
    counts = np.zeros((len(words), len(words)), np.int64)
    if len(code) < 2:
        return counts
    broken = gaps.loc[gaps["n_frames_missing"] > 0, "start_s"].to_numpy(float, copy=True)
    broken.sort()  # a gap parts two bouts when it begins after the one and before the other
    parted = np.searchsorted(broken, start[1:] - 1e-9) != np.searchsorted(broken, stop[:-1] - 1e-9)
    near = (start[1:] - stop[:-1] <= longest_pause_s) & ~parted & (code[1:] != code[:-1])
    np.add.at(counts, (code[:-1][near], code[1:][near]), 1)
    return counts


def by_chance(counts: Counts) -> Array:
    """(k, k) probability of j after i under quasi-independence, by iterative proportional fitting.

    Row and column sums are those counted, the diagonal is empty (Goodman 1968).

    Args:
        counts: (k, k) int64 transitions, zero on the diagonal.

    Returns:
        Rows add up to one; NaN in the rows of actions that nothing followed.
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
    """Two-sided p of the exact binomial test; NaN where chance leaves no choice.

    The probability of all outcomes that are no likelier than this one, as `scipy.stats.binomtest`
    has it: every run would import half of SciPy for that one number.
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
