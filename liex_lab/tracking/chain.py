"""The animal's curve through the hypotheses of single frames: which of them it is, or none, over a whole recording."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from liex_lab.tracking import _chain as kernels
from liex_lab.tracking.observations import Observations

Array = NDArray[np.float64]

_BEAM = 24  # chains under way
NONE = kernels.NONE


@dataclass(frozen=True)
class ChainTuning:
    """What makes a chain likely; costs are nats, lengths those of an animal of the reference length.

    score_mm: this much of the metric's score weighs one nat, up to score_most of them; none: passing all hypotheses of
    a frame by; ceiling: the most a leap costs; error_factor: of the predicted errors, as standard deviations; shift and
    bend: how fast, in lengths a second, middle and posture move by themselves.
    """

    score_mm: float = 4.0
    score_most: float = 6.0
    none: float = 7.0
    ceiling: float = 12.0
    error_factor: float = 0.7
    shift: float = 3.0
    bend: float = 1.5


TUNING = ChainTuning()


class Chain:
    """Grows frame by frame; `path` is the best explanation of everything seen so far.

    length_mm: of the animal; relative_size: of its kind, see `Skeleton.relative_size`.
    """

    def __init__(self, length_mm: float, relative_size: float, tuning: ChainTuning = TUNING) -> None:
        self._length, self._unit, self._tuning = length_mm, relative_size, tuning
        self._live, self._n_live = np.zeros((_BEAM, 2), np.int64), 0

    def path(self, seen: Observations) -> NDArray[np.int64]:
        """(n,) the hypothesis of each frame that lies on the curve, or NONE."""
        n, h = seen.score.shape
        tuning = self._tuning
        emission = np.minimum(seen.score / (tuning.score_mm * self._unit), tuning.score_most)
        idle = np.concatenate([[0.0], np.cumsum(np.where(seen.known.any(axis=1), tuning.none, 0.0))])
        cost, parent = np.full((n, h), np.inf), np.full((n, h, 2), NONE, np.int64)
        levels = np.array([tuning.error_factor, tuning.shift, tuning.bend])
        n_live = kernels.extend_all(
            0, n, self._live, 0, seen.seconds, seen.joints, seen.error_mm, emission, idle, levels, self._length,
            tuning.ceiling, cost, parent,
        )  # fmt: skip
        path = np.full(n, NONE, np.int64)
        if n_live:
            kernels.trace_back(self._live[0, 0], self._live[0, 1], parent, 0, path)
        return path
