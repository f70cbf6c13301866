"""The paper's recogniser of cut-out sequences: a random forest on the temporal pyramid of a
descriptor.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from liex_lab.actions.descriptors import position_descriptor, tangent_descriptor
from liex_lab.tracking.track import Track

Array = NDArray[np.float64]

DESCRIPTORS: dict[str, Callable[[Track], Array]] = {
    "tangent": tangent_descriptor,
    "joints": position_descriptor,
}
_TREES = 50
_DEPTH = 20


@dataclass(frozen=True)
class SequenceForest:
    """A forest of 50 trees, 20 deep, on one of the `DESCRIPTORS`."""

    descriptor: str
    forest: Any

    @staticmethod
    def learn(descriptor: str, rows: Array, words: Sequence[str], seed: int) -> SequenceForest:
        """From descriptors (n, D) of sequences and their words (n)."""
        from sklearn.ensemble import RandomForestClassifier

        forest = RandomForestClassifier(_TREES, max_depth=_DEPTH, random_state=seed)
        return SequenceForest(descriptor, forest.fit(rows, list(words)))

    def name(self, rows: Array) -> list[str]:
        """The word (n) of each sequence with descriptors (n, D): the largest class of the averaged
        leaves.
        """
        return [str(word) for word in self.forest.predict(rows)]


def describe(descriptor: str, tracks: Sequence[Track]) -> Array:
    """The descriptors (n, D) of sequences."""
    return np.stack([DESCRIPTORS[descriptor](track) for track in tracks])
