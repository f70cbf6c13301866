"""The order and the length of actions: a chain in which each lasts a least time, learned from
labelled bouts.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from liex_lab.actions import _semi_markov_kernels as kernels
from liex_lab.runtime.memory import Room, blocks, let_go

Array = NDArray[np.float64]

_SHORT = 0.08  # quantile of an action's lengths that counts as the shortest
_PIECE = 8192  # ticks whose probabilities are worked out at once ...
_MARGIN = 512  # ... with so many more on either side


@dataclass(frozen=True)
class ActionChain:
    """shortest_s, mean_s (K,): how long each action lasts at least and on average; follow (K, K):
    the chance that one follows another, 0 on the diagonal.
    """

    shortest_s: Array
    mean_s: Array
    follow: Array

    @staticmethod
    def learn(runs: Sequence[Sequence[tuple[int, float]]], n_words: int) -> ActionChain:
        """From the bouts (word, length in s) of recordings, in order. Words that never occur get
        usual values.
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
        return ActionChain(
            shortest, np.maximum(mean, shortest), counts / counts.sum(axis=1, keepdims=True)
        )

    def _terms(self, step_s: float) -> tuple[NDArray[np.int64], Array, Array, Array]:
        """What the kernels want to know, on a clock with this step."""
        least = np.maximum(np.round(self.shortest_s / step_s).astype(np.int64), 1)
        more = np.maximum(
            self.mean_s / step_s - least, 0.5
        )  # ticks spent in the last state beyond the first
        go = more / (1.0 + more)
        with np.errstate(divide="ignore"):
            switch = np.maximum(np.log(self.follow), -1e30)
        return np.concatenate([[0], np.cumsum(least)]), np.log(go), np.log1p(-go), switch

    def decode(self, scores: Array, step_s: float, room: Room = np.empty) -> NDArray[np.int64]:
        """The most probable word (m,) of every tick, from log scores (m, K). room: for what takes
        much of it on the way.
        """
        scores = np.ascontiguousarray(scores)
        terms = self._terms(step_s)
        value = np.empty(terms[0][-1])
        label = np.zeros(len(scores), np.int64)
        came_from = room(scores.shape, np.int16)
        stayed = room(scores.shape, np.bool_)
        for ticks in blocks(len(scores), _PIECE):
            kernels.go_on(ticks.start, ticks.stop, scores, *terms, value, came_from, stayed)
            let_go(scores, came_from, stayed)
        kernels.trace_back(terms[0], value, came_from, stayed, label)
        return label

    def probabilities(self, scores: Array, step_s: float, room: Room = np.empty) -> Array:
        """The probability (m, K) of each word at every tick, given all of them; room: where they
        are to lie.
        """
        out = room(scores.shape, float)
        terms = self._terms(step_s)
        for ticks in blocks(len(scores), _PIECE):
            low = max(0, ticks.start - _MARGIN)
            high = min(len(scores), ticks.stop + _MARGIN)
            piece = np.empty((high - low, scores.shape[1]))
            kernels.probabilities(np.ascontiguousarray(scores[low:high]), *terms, piece)
            out[ticks] = piece[ticks.start - low : ticks.stop - low]
            let_go(scores, out)
        return out
