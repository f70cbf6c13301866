"""Window features of every tick: mean, spread and extreme of the channels over windows in seconds.

Centred windows of half width 0.06, 0.2 and 0.6 s give mean and standard deviation, four windows
beside the tick (out to 0.9 s) mean and root mean square, and one of half width 0.25 s the largest
size; all by running sums or filters, in time linear in the ticks. Windows end where the segment
does.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from liex_lab.actions.channels import Segment

Array = NDArray[np.float64]

HALF_WINDOWS_S = (0.06, 0.2, 0.6)
SIDE_WINDOWS_S = ((-0.9, -0.35), (-0.35, -0.08), (0.08, 0.35), (0.35, 0.9))
RANGE_S = 0.25


def window_features(segment: Segment, names: Sequence[str]) -> NDArray[np.float32]:
    """Features of every tick of a segment: its channels now, and their mean and spread around it.

    Of channels that change sign in a mirror (their names end in ~) the sizes of the means count,
    and their signs in the centred windows only.

    Args:
        segment: channels (m, C) of an unbroken segment, m at least 2.
        names: (C) names of the channels.

    Returns:
        (m, F) float32.
    """
    x = segment.values
    step = segment.times_s[1] - segment.times_s[0]
    signed = np.array([name.endswith("~") for name in names])
    n = x.shape[1]
    n_signed = int(signed.sum())
    n_features = (
        n + n_signed + len(HALF_WINDOWS_S) * (2 * n + n_signed) + len(SIDE_WINDOWS_S) * 2 * n + n
    )
    found = np.empty((len(x), n_features), np.float32)
    filled = 0

    def put(*parts: Array) -> None:  # one by one, for all of them in double precision are large
        """Append columns (m, k) to the features, one part after the other."""
        nonlocal filled
        for part in parts:
            found[:, filled : filled + part.shape[1]] = part
            filled += part.shape[1]

    sums, squares = (np.concatenate([np.zeros((1, n)), np.cumsum(v, axis=0)]) for v in (x, x * x))
    put(x, np.abs(x[:, signed]))
    for half in HALF_WINDOWS_S:
        mean, square = (_window_mean(total, -half, half, step) for total in (sums, squares))
        put(mean, np.abs(mean[:, signed]), np.sqrt(np.maximum(square - mean * mean, 0.0)))
    for start, stop in SIDE_WINDOWS_S:
        mean, square = (_window_mean(total, start, stop, step) for total in (sums, squares))
        put(np.where(signed, np.abs(mean), mean), np.sqrt(np.maximum(square, 0.0)))
    put(_extreme(np.abs(x), RANGE_S, step))
    assert filled == n_features
    return found


def _window_mean(total: Array, start_s: float, stop_s: float, step: float) -> Array:
    """Means (m, C) over [t + start_s, t + stop_s] from running sums (m + 1, C); beyond the ends,
    the nearest tick.
    """
    m = len(total) - 1
    rows = np.arange(m)
    low = np.clip(rows + round(start_s / step), 0, m - 1)
    high = np.clip(rows + round(stop_s / step), 0, m - 1) + 1
    return np.asarray((total[high] - total[low]) / (high - low)[:, None])


def _extreme(x: Array, half_s: float, step: float) -> Array:
    """The largest (m, C) within half_s of each tick."""
    from scipy.ndimage import maximum_filter1d

    return np.asarray(
        maximum_filter1d(x, 2 * max(1, round(half_s / step)) + 1, axis=0, mode="nearest")
    )
