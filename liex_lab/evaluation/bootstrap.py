"""Bootstrap intervals of a split's error, by recordings.

Frames of one recording share camera, arena and animal, so they are not independent: whole
recordings are drawn with replacement (cluster bootstrap; Davison and Hinkley 1997, section 3.8),
and the bounds are the 2.5 % and 97.5 % quantiles of the statistic over the draws.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_SEED = 20170703


def interval95(
    error: Array,
    recording: NDArray[np.int64],
    statistic: Callable[[Array], Any] = np.median,
    n_draws: int = 1_000,
) -> tuple[float, float] | None:
    """The 95 % interval of a statistic of frame errors, recordings drawn with replacement.

    Args:
        error: (n,) errors of frames, mm; NaN frames are left out.
        recording: (n,) number of each frame's recording.
        statistic: of the errors, such as their median or mean.
        n_draws: number of bootstrap draws.

    Returns:
        Lower and upper bound, mm; None where fewer than two recordings have an error.
    """
    seen = np.isfinite(error)
    groups = [error[seen & (recording == k)] for k in np.unique(recording[seen])]
    if len(groups) < 2:
        return None
    rng = np.random.default_rng(_SEED)
    drawn = [
        statistic(np.concatenate([groups[k] for k in rng.integers(len(groups), size=len(groups))]))
        for _ in range(n_draws)
    ]
    low, high = np.quantile(drawn, [0.025, 0.975])
    return float(low), float(high)
