"""Benjamini and Hochberg's step-up procedure: control of the false discovery rate of many tests.

With the m known p sorted upwards, p_fdr(i) = min over j >= i of m p(j) / j, at most 1 (Benjamini
and Hochberg 1995).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray


def false_discovery(p: ArrayLike) -> NDArray[np.float64]:
    """Benjamini and Hochberg's corrected p of a family of tests.

    Args:
        p: (n,) p values; NaN, a test not done, is not of the family.

    Returns:
        (n,) corrected p, 0 to 1; NaN where `p` is NaN.
    """
    values = np.asarray(p, float)
    out = np.full(values.shape, np.nan)
    known = np.flatnonzero(np.isfinite(values))
    if len(known) == 0:
        return out
    order = known[np.argsort(values[known])]
    scaled = values[order] * len(order) / np.arange(1, len(order) + 1)
    out[order] = np.minimum(np.minimum.accumulate(scaled[::-1])[::-1], 1.0)
    return out
