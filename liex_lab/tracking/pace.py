"""Whether an animal goes as fast as animals do, by the clock of its recording.

A clock that runs too fast makes a walk a flight and nothing else: poses look as sound as ever, but
a smoother that believes the times cannot follow. What tells is how far the outline's centre goes,
which no model has a part in.
"""

from __future__ import annotations

import numpy as np

from liex_lab.tracking.track import Track

_OVER_S = 0.1  # noise of single frames is small beside what is gone in so long
_MOST_S = 0.2  # frames may be missing, but not so many
_N_LOOKED_AT = 20_000  # frames, spread over the recording
_FEWEST = 30
_MOST_LENGTHS_S = 10.0  # for a quarter of the time; 1 to 4 are usual, in short bursts 30


def why_too_fast(track: Track, length_mm: float) -> str:
    """That the animal goes faster than animals keep up; "" where it does not, or nobody can tell.

    Args:
        track: one row for every frame.
        length_mm: of the animal, mm.
    """
    times_s = (track.times_ns - track.times_ns[0]) / 1e9
    n = len(times_s)
    first = np.unique(np.linspace(0, n - 1, min(n, _N_LOOKED_AT)).round().astype(int))
    then = np.searchsorted(times_s, times_s[first] + _OVER_S)
    first, then = first[then < n], then[then < n]
    passed_s = times_s[then] - times_s[first]
    gone = track.centroid_mm[then, :2] - track.centroid_mm[first, :2]
    known = np.isfinite(gone).all(axis=1) & (passed_s <= _MOST_S)
    if known.sum() < _FEWEST:
        return ""
    speed = float(np.quantile(np.hypot(*gone[known].T) / passed_s[known], 0.75))
    if speed <= _MOST_LENGTHS_S * length_mm:
        return ""
    return (
        f"by its time stamps the animal goes {speed:,.0f} mm/s for a quarter of the time, "
        f"{speed / length_mm:.0f} of its lengths a second, which none keeps up: check the frame "
        "rate"
    )
