"""Random forest on temporal-pyramid descriptors of cut-out sequences (Lie-X section 4.3).

The paper's recogniser: 50 trees of depth 20 (Breiman 2001, by scikit-learn) whose averaged leaf
histograms give the class; the descriptors are those of `descriptors`. Used to repeat the paper's
evaluation (section 5.4); uncut recordings have `timeline`.
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
    """A forest of 50 trees, 20 deep, on one of the `DESCRIPTORS`.

    Attributes:
        descriptor: 'tangent' or 'joints'.
        forest: the fitted `RandomForestClassifier`.
    """

    descriptor: str
    forest: Any

    @staticmethod
    def learn(descriptor: str, rows: Array, words: Sequence[str], seed: int) -> SequenceForest:
        """A forest from the descriptors of sequences and their words.

        Args:
            descriptor: which of the `DESCRIPTORS` the rows are.
            rows: (n, D) descriptors.
            words: (n) word of each sequence.
            seed: of the forest.

        Returns:
            The fitted forest.
        """
        from sklearn.ensemble import RandomForestClassifier

        forest = RandomForestClassifier(_TREES, max_depth=_DEPTH, random_state=seed)
        return SequenceForest(descriptor, forest.fit(rows, list(words)))

    def name(self, rows: Array) -> list[str]:
        """The word of each sequence: the largest class of the averaged leaves.

        Args:
            rows: (n, D) descriptors.

        Returns:
            n words.
        """
        return [str(word) for word in self.forest.predict(rows)]


def describe(descriptor: str, tracks: Sequence[Track]) -> Array:
    """The descriptors of sequences.

    Args:
        descriptor: one of the `DESCRIPTORS`.
        tracks: n sequences, at least one.

    Returns:
        (n, D).
    """
    return np.stack([DESCRIPTORS[descriptor](track) for track in tracks])
