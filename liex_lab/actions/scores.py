"""Scores of recognised actions: frame-wise F1, segmental F1@50, confusion matrix.

F1 = 2 TP / (found + true), by frames or by bouts; a bout is correct if its intersection over union
with a true bout of its action is at least 0.5 (segmental F1@50, Lea et al. 2017). The 95 % interval
of a share is Wilson's (1927).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from liex_lab.actions.ethogram import UNLABELLED
from liex_lab.actions.labels import LabelledTrack

Array = NDArray[np.float64]
Words = NDArray[np.str_]


def timeline_scores(
    pairs: Iterable[tuple[LabelledTrack, Words]], words: Sequence[str]
) -> dict[str, Any]:
    """Scores of recognised words against the labels of their tracks.

    Args:
        pairs: labelled tracks, each with its recognised words (n,).
        words: the vocabulary, with or without `UNLABELLED`.

    Returns:
        macro_f1: mean over the labelled actions of their frame-wise F1; segment_f1_50: F1 of bouts,
            correct if the intersection over union with a true bout of the action is at least 0.5;
            per_action: F1, precision and recall of frames, segment F1, and number of bouts. NaN if
            the denominator is zero.
    """
    named = [word for word in words if word != UNLABELLED]
    hits, found, true = (dict.fromkeys(named, 0) for _ in range(3))
    frames = {word: np.zeros(3, np.int64) for word in words}
    for one, recognised in pairs:
        for word in words:
            a = one.words == word
            b = recognised == word
            frames[word] += [int((a & b).sum()), int(b.sum()), int(a.sum())]
        for word in named:
            counted = match_bouts(one.words == word, recognised == word)
            for total, n in zip((hits, found, true), counted, strict=True):
                total[word] += n
    per_action = {
        word or "unlabelled": {
            "f1": _f1(*frames[word]),
            "precision": _share(frames[word][0], frames[word][1]),
            "recall": _share(frames[word][0], frames[word][2]),
            **(
                {"segment_f1_50": _f1(hits[word], found[word], true[word]), "bouts": true[word]}
                if word
                else {}
            ),
        }
        for word in words
    }
    labelled = [word for word in named if frames[word][2] > 0]
    return {
        "macro_f1": float(np.mean([per_action[word]["f1"] for word in labelled]))
        if labelled
        else float("nan"),
        "segment_f1_50": _f1(sum(hits.values()), sum(found.values()), sum(true.values())),
        "per_action": per_action,
    }


def match_bouts(
    true: NDArray[np.bool_], found: NDArray[np.bool_], overlap: float = 0.5
) -> tuple[int, int, int]:
    """The number of found bouts that match a true one; each true bout counts once.

    Args:
        true: (n,) bool, frames of the action by the labels.
        found: (n,) bool, frames of the action as recognised.
        overlap: least intersection over union of a match.

    Returns:
        Matches, bouts found, true bouts.
    """
    spans = _spans(true)
    guesses = _spans(found)
    taken = set()
    hits = 0
    for start, stop in guesses:
        shares = [
            (min(stop, b) - max(start, a)) / (max(stop, b) - min(start, a))
            if min(stop, b) > max(start, a)
            else 0.0
            for a, b in spans
        ]
        best = int(np.argmax(shares)) if shares else -1
        if best >= 0 and shares[best] >= overlap and best not in taken:
            taken.add(best)
            hits += 1
    return hits, len(guesses), len(spans)


def _spans(mask: NDArray[np.bool_]) -> list[tuple[int, int]]:
    edges = np.flatnonzero(np.diff(np.concatenate([[0], mask.astype(np.int8), [0]])))
    return [(int(a), int(b)) for a, b in edges.reshape(-1, 2)]


def _share(part: int, whole: int) -> float:
    return float(part / whole) if whole else float("nan")


def _f1(hits: int, found: int, true: int) -> float:
    return float(2.0 * hits / (found + true)) if found + true else float("nan")


def confusion(true: Sequence[str], found: Sequence[str], words: Sequence[str]) -> list[list[int]]:
    """Confusion matrix (K, K) as lists; rows: true words; columns: recognised words.

    Args:
        true: (n) true word of each, all of them in `words`.
        found: (n) recognised words; those not in `words` are left out.
        words: the K words, in the order of rows and columns.
    """
    index = {word: k for k, word in enumerate(words)}
    out = np.zeros((len(words), len(words)), int)
    for a, b in zip(true, found, strict=True):
        if b in index:
            out[index[a], index[b]] += 1
    return out.tolist()


def interval95(hits: float, n: int) -> tuple[float, float]:
    """Wilson's 95 % interval of a share of hits out of n.

    Args:
        hits: number of hits, or a sum of shares.
        n: number of trials, at least 1.

    Returns:
        Lower and upper limit, 0 to 1.
    """
    z = 1.959964
    p = hits / n
    middle = p + z * z / (2 * n)
    half = z * np.sqrt(p * (1 - p) / n + z * z / (4 * n * n))
    return float((middle - half) / (1 + z * z / n)), float((middle + half) / (1 + z * z / n))


# Agreement of two raters beyond chance: Cohen's kappa with its interval.


_NORMAL = 1.959964  # of a 95 % interval


@dataclass(frozen=True)
class Agreement:
    """Agreement of two raters.

    Attributes:
        n: number of items rated by both.
        observed: share of items with the same rating.
        expected: share of the same rating by chance.
        kappa: agreement beyond chance, relative to its maximum: 1 for perfect agreement, 0 for
            chance; NaN if undefined.
        low: lower limit of its 95 % interval; NaN if undefined.
        high: upper limit.
    """

    n: int
    observed: float
    expected: float
    kappa: float
    low: float
    high: float


def cohens_kappa(first: Sequence[str], second: Sequence[str]) -> Agreement:
    """Agreement of two raters of the same items.

    Args:
        first: the first rater's words.
        second: the second rater's words.

    Raises:
        ValueError: they did not rate the same number of items.
    """
    if len(first) != len(second):
        raise ValueError(f"two raters of the same things, got {len(first)} and {len(second)}")
    n = len(first)
    nan = float("nan")
    if n == 0:
        return Agreement(0, nan, nan, nan, nan, nan)
    words = sorted({*first, *second})
    index = {word: k for k, word in enumerate(words)}
    share = np.zeros((len(words), len(words)))
    for a, b in zip(first, second, strict=True):
        share[index[a], index[b]] += 1.0 / n
    rows = share.sum(axis=1)
    columns = share.sum(axis=0)
    observed = float(np.trace(share))
    expected = float(rows @ columns)
    if expected >= 1.0 - 1e-12:  # both use one word for everything
        return Agreement(n, observed, expected, nan, nan, nan)
    kappa = (observed - expected) / (1.0 - expected)
    own = np.diag(share) @ ((1.0 - (rows + columns) * (1.0 - kappa)) ** 2)
    both = (columns[:, None] + rows[None, :]) ** 2
    other = (1.0 - kappa) ** 2 * ((share * both).sum() - np.diag(share) @ np.diag(both))
    centre = (kappa - expected * (1.0 - kappa)) ** 2
    variance = max(float(own + other - centre), 0.0) / (n * (1.0 - expected) ** 2)
    reach = _NORMAL * float(np.sqrt(variance))
    return Agreement(
        n, observed, expected, float(kappa), max(kappa - reach, -1.0), min(kappa + reach, 1.0)
    )
