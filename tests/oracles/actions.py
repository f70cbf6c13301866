"""The semi-Markov chain of actions by looking at every possible way through its states."""

import itertools

import numpy as np


def every_path(
    scores: np.ndarray, first: np.ndarray, stay: np.ndarray, leave: np.ndarray, switch: np.ndarray
):
    """All (log weight, words) of state sequences; arguments as in
    `liex_lab.actions._semi_markov_kernels`.
    """
    total, word = first[-1], np.repeat(np.arange(len(first) - 1), np.diff(first))
    last = first[1:] - 1
    for path in itertools.product(range(total), repeat=len(scores)):
        weight = scores[0, word[path[0]]] - np.log(total)
        for t in range(1, len(path)):
            a, b = path[t - 1], path[t]
            k, j = word[a], word[b]
            if a == last[k]:
                if b == a:
                    weight += stay[k]
                elif b == first[j] and j != k:
                    weight += leave[k] + switch[k, j]
                else:
                    weight = -np.inf
            elif b != a + 1:
                weight = -np.inf
            weight += scores[t, j]
            if weight == -np.inf:
                break
        if weight > -1e20:
            yield weight, [int(word[s]) for s in path]
