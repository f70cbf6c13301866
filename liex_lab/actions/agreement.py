"""Agreement of two raters beyond chance: Cohen's kappa with its interval.

    kappa = (p_o - p_e) / (1 - p_e),    p_o = sum_k p_kk,    p_e = sum_k p_k. p_.k

(Cohen 1960), with p_kl the share of the things that the first rater calls k and the second l. Its
variance for a sample is that of Fleiss, Cohen and Everitt (1969), and the 95 % interval the normal
one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

_NORMAL = 1.959964  # of a 95 % interval


@dataclass(frozen=True)
class Agreement:
    """How far two raters agree.

    Attributes:
        n: things that both rated.
        observed: share of them that both call the same.
        expected: share on which two who do not look would agree.
        kappa: agreement beyond chance over the most there can be: 1 where they always agree, 0
            where no more than by chance; NaN where there is nothing to agree on.
        low: lower limit of its 95 % interval; NaN where it cannot be told.
        high: upper limit.
    """

    n: int
    observed: float
    expected: float
    kappa: float
    low: float
    high: float


def cohens_kappa(first: Sequence[str], second: Sequence[str]) -> Agreement:
    """Agreement of two raters of the same things.

    Args:
        first: what the first rater calls each of them.
        second: what the second rater calls each of them.

    Raises:
        ValueError: they did not rate the same number of things.
    """
    if len(first) != len(second):
        raise ValueError(f"two raters of the same things, got {len(first)} and {len(second)}")
    n = len(first)
    nan = float("nan")
    if n == 0:
        return Agreement(0, nan, nan, nan, nan, nan)
    words = sorted({*first, *second})
    place = {word: k for k, word in enumerate(words)}
    share = np.zeros((len(words), len(words)))
    for a, b in zip(first, second, strict=True):
        share[place[a], place[b]] += 1.0 / n
    rows = share.sum(axis=1)
    columns = share.sum(axis=0)
    observed = float(np.trace(share))
    expected = float(rows @ columns)
    if expected >= 1.0 - 1e-12:  # both call everything the same word
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
