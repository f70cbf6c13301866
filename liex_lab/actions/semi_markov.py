"""Hidden semi-Markov model of actions: durations and transitions from bouts, and decoding.

A bout of action k lasts d_k + Geometric ticks: at least the shortest usual length (8 % quantile of
the labelled bouts), on average the mean length; then action j follows with probability follow[k,
j], estimated with half a pseudo-count. Decoding is by Viterbi, posteriors by forward-backward over
the expanded states (`_semi_markov_kernels`; Yu 2010).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from liex_lab.actions import _semi_markov_kernels as kernels
from liex_lab.runtime.memory import Allocator, blocks
from liex_lab.runtime.shapes import check_shapes

Array = NDArray[np.float64]

_SHORT = 0.08  # quantile of an action's lengths that counts as the shortest
_PIECE = 8192  # ticks per block of probabilities ...
_MARGIN = 512  # ... and its margin on either side


@dataclass(frozen=True)
class SemiMarkovModel:
    """Durations and transitions of K actions.

    Attributes:
        shortest_s: (K,) shortest duration, s.
        mean_s: (K,) mean duration, s.
        follow: (K, K) probability that one follows another, 0 on the diagonal, rows sum to 1.
    """

    shortest_s: Array
    mean_s: Array
    follow: Array

    @staticmethod
    def learn(runs: Sequence[Sequence[tuple[int, float]]], n_words: int) -> SemiMarkovModel:
        """The model of labelled bouts; words without bouts get default durations (0.1 s and 0.5 s).

        Args:
            runs: for each recording, the bouts (word, length in s) in order.
            n_words: size K of the vocabulary, at least 2.
        """
        lengths: list[list[float]] = [[] for _ in range(n_words)]
        counts = np.full((n_words, n_words), 0.5)
        for run in runs:
            for word, length in run:
                lengths[word].append(length)
            for (before, _), (after, _) in pairwise(run):
                counts[before, after] += 1.0
        np.fill_diagonal(counts, 0.0)
        shortest = np.array([np.quantile(some, _SHORT) if some else 0.1 for some in lengths])
        mean = np.array([np.mean(some) if some else 0.5 for some in lengths])
        return SemiMarkovModel(
            shortest, np.maximum(mean, shortest), counts / counts.sum(axis=1, keepdims=True)
        )

    def _terms(self, step_s: float) -> tuple[NDArray[np.int64], Array, Array, Array]:
        """The kernels' `first`, `stay`, `leave` and `switch` on a clock with this step."""
        least = np.maximum(np.round(self.shortest_s / step_s).astype(np.int64), 1)
        more = np.maximum(
            self.mean_s / step_s - least, 0.5
        )  # ticks spent in the last state beyond the first
        go = more / (1.0 + more)
        with np.errstate(divide="ignore"):
            switch = np.maximum(np.log(self.follow), -1e30)
        return np.concatenate([[0], np.cumsum(least)]), np.log(go), np.log1p(-go), switch

    def decode(
        self, scores: Array, step_s: float, allocate: Allocator = np.empty
    ) -> NDArray[np.int64]:
        """The most probable sequence of words (Viterbi).

        Args:
            scores: (m, K) log scores of each tick.
            step_s: step of the clock, s.
            allocate: allocator of the back-pointers, (m, K) twice.

        Returns:
            (m,) int64 index of the word of every tick.
        """
        scores = np.ascontiguousarray(scores)
        terms = self._terms(step_s)
        check_shapes("a recording", ("scores", scores, ("m", len(terms[0]) - 1)))
        value = np.empty(terms[0][-1])
        label = np.zeros(len(scores), np.int64)
        came_from = allocate(scores.shape, np.int16)
        stayed = allocate(scores.shape, np.bool_)
        for ticks in blocks(len(scores), _PIECE):
            kernels.go_on(ticks.start, ticks.stop, scores, *terms, value, came_from, stayed)
        kernels.trace_back(terms[0], value, came_from, stayed, label)
        return label

    def probabilities(self, scores: Array, step_s: float, allocate: Allocator = np.empty) -> Array:
        """The posterior of each word at every tick (forward-backward).

        Computed in blocks of 8192 ticks with a margin of 512 on either side.

        Args:
            scores: (m, K) log scores of each tick.
            step_s: step of the clock, s.
            allocate: allocator of the result.

        Returns:
            (m, K) probabilities, rows sum to 1.
        """
        terms = self._terms(step_s)
        check_shapes("a recording", ("scores", scores, ("m", len(terms[0]) - 1)))
        out = allocate(scores.shape, float)
        for ticks in blocks(len(scores), _PIECE):
            low = max(0, ticks.start - _MARGIN)
            high = min(len(scores), ticks.stop + _MARGIN)
            piece = np.empty((high - low, scores.shape[1]))
            kernels.probabilities(np.ascontiguousarray(scores[low:high]), *terms, piece)
            out[ticks] = piece[ticks.start - low : ticks.stop - low]
        return out
