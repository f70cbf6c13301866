"""One body for the sessions of one animal: a random-effects mean of what each found by itself.

Session i tells the logarithm of the length, y_i, by n_i frames that scatter by s_i. That sessions
differ by more than this (camera, light, posture) is the variance t^2 between them, found by the
method of moments (DerSimonian and Laird 1986):

    y = sum w_i y_i / sum w_i,    w_i = 1 / (s_i^2 / n_i + t^2),
    t^2 = max(0, (Q - (k - 1)) / (sum v_i - sum v_i^2 / sum v_i)),    v_i = n_i / s_i^2,

with Q = sum v_i (y_i - m)^2 about the mean m by the weights v_i. A shape is the mean of the kept
ones' labels (`session_shape.labels_of`), weighted by the frames that show the animal well, and is
shared where the sessions that kept one show it in more frames than those that refused one; else the
average body is, at the mean of the girths that sessions found it to have. Sums are exact
(`math.fsum`), so the order of the sessions does not matter.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

MOST_APART = 0.08  # of the median length: beyond it the animal has grown, or is another
_LEAST_SD = 0.001  # of the length: no session tells it better


@dataclass(frozen=True)
class Found:
    """What one session found of its animal by itself.

    Attributes:
        spine_mm: the animal's length, mm.
        stated: whether the plan states that length; then it is not a finding.
        log_sd: standard deviation of the logarithm of the length that single frames tell.
        n_frames: frames with a pose.
        girth: of the average body; it does not count where a shape was kept.
        shape: (K,) labels of the shape that was kept, see `session_shape.labels_of`; None of a
            session that kept none.
        refused: whether frames that were held out contradicted a shape of its own.
        n_well_seen: frames that show the animal well.
    """

    spine_mm: float
    stated: bool = False
    log_sd: float = 0.0
    n_frames: int = 1
    girth: float = 1.0
    shape: Array | None = None
    refused: bool = False
    n_well_seen: int = 0

    @property
    def variance(self) -> float:
        """Of the logarithm of the length, by the scatter of its own frames alone."""
        return max(self.log_sd**2 / max(self.n_frames, 1), _LEAST_SD**2)


@dataclass(frozen=True)
class Agreed:
    """What sessions of one animal agree on.

    Attributes:
        spine_mm: the length, mm; None where every session's plan states its own.
        girth: of the average body; None where a shape is shared.
        shape: (K,) labels of the shape; None where too few sessions bear one out.
    """

    spine_mm: float | None
    girth: float | None
    shape: Array | None


def spread_of(found: Sequence[Found]) -> float:
    """How far apart the lengths lie: largest less smallest, over the median.

    Args:
        found: of sessions of one animal, at least one.
    """
    lengths = [one.spine_mm for one in found]
    return (max(lengths) - min(lengths)) / float(np.median(lengths))


def agree(found: Sequence[Found]) -> Agreed:
    """What sessions agree on, whatever their order.

    Args:
        found: of sessions of one animal whose lengths lie no more than `MOST_APART` apart.
    """
    measured = [one for one in found if not one.stated]
    shape = _shape(found)
    average = [one for one in found if one.shape is None]
    girth = None
    if shape is None and average:
        girth = _mean([one.girth for one in average], [float(one.n_frames) for one in average])
    return Agreed(_length(measured) if measured else None, girth, shape)


def _length(measured: Sequence[Found]) -> float:
    y = [math.log(one.spine_mm) for one in measured]
    variance = [one.variance for one in measured]
    between = _between(y, [1.0 / v for v in variance])
    return math.exp(_mean(y, [1.0 / (v + between) for v in variance]))


def _between(y: Sequence[float], v: Sequence[float]) -> float:
    """The variance between sessions, t^2, by the method of moments."""
    m = _mean(y, v)
    q = math.fsum(v_i * (y_i - m) ** 2 for y_i, v_i in zip(y, v, strict=True))
    whole = math.fsum(v)
    per = whole - math.fsum(v_i**2 for v_i in v) / whole
    return max(0.0, (q - (len(y) - 1)) / per) if len(y) > 1 else 0.0


def _shape(found: Sequence[Found]) -> Array | None:
    kept = [(one.shape, one.n_well_seen) for one in found if one.shape is not None]
    n_against = sum(one.n_well_seen for one in found if one.refused)
    if sum(n for _, n in kept) <= n_against:
        return None
    weights = [float(n) for _, n in kept]
    columns = zip(*(shape.tolist() for shape, _ in kept), strict=True)
    return np.array([_mean(column, weights) for column in columns])


def _mean(values: Sequence[float], weights: Sequence[float]) -> float:
    return math.fsum(w * x for w, x in zip(weights, values, strict=True)) / math.fsum(weights)
