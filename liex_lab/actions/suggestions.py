"""Active learning by uncertainty sampling: which segments of a recording to label next.

Windows of a recording are ranked by the mean entropy of the recogniser's posterior, H = -sum p log
p / log K (Settles 2009), and spread over the pairs of words that it confuses.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from liex_lab.actions.timeline import Recognised

Array = NDArray[np.float64]

_STEP = 0.5  # of a window: how far apart windows begin


def doubtful_segments(
    found: Recognised, times_ns: NDArray[np.int64], n: int, least_s: float
) -> list[dict[str, Any]]:
    """The least certain segments, the first of every pair of confused words before any second.

    Windows begin every half of their length; those taken do not overlap.

    Args:
        found: what the recogniser says of the recording.
        times_ns: (n,) time stamps.
        n: the most segments that are wanted.
        least_s: length of a segment, s.

    Returns:
        At most n tables of start_s, stop_s, uncertainty (mean entropy of the words' probabilities
        over its largest value, 0 to 1), guess and or_else (the two most probable words).
    """
    p = np.clip(np.nan_to_num(found.probability, nan=0.0), 1e-9, 1.0)
    known = np.isfinite(found.probability[:, 0])
    entropy = np.where(known, -(p * np.log(p)).sum(axis=1) / np.log(p.shape[1]), 0.0)
    time_s = (times_ns - times_ns[:1]) * 1e-9
    starts = np.arange(0.0, max(time_s[-1] - least_s, 0.0) + 1e-9, _STEP * least_s)
    low = np.searchsorted(time_s, starts)
    high = np.searchsorted(time_s, starts + least_s)
    total = np.concatenate([[0.0], np.cumsum(entropy)])
    mean = (total[high] - total[low]) / np.maximum(high - low, 1)
    taken = np.zeros(len(time_s), bool)
    pairs: dict[tuple[int, ...], int] = {}
    rows: list[tuple[int, float, int, dict[str, Any]]] = []
    for k in np.argsort(-mean, kind="stable"):
        a = int(low[k])
        b = int(high[k])
        if b <= a or taken[a:b].any() or mean[k] <= 0:
            continue
        first, second = np.argsort(-p[a:b].mean(axis=0))[:2]
        taken[a:b] = True
        pair = tuple(sorted((int(first), int(second))))
        pairs[pair] = pairs.get(pair, 0) + 1
        row = {
            "start_s": float(time_s[a]),
            "stop_s": float(starts[k] + least_s),
            "uncertainty": float(mean[k]),
            "guess": found.words[first] or "unlabelled",
            "or_else": found.words[second] or "unlabelled",
        }
        rows.append((pairs[pair], -float(mean[k]), len(rows), row))
        if len(rows) >= 6 * n:
            break
    return [row for *_, row in sorted(rows, key=lambda entry: entry[:3])[:n]]
