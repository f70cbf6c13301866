"""Activity over a session in bins of one minute: distance, mean speed and time in each action.

Time-binned activity as in open-field and locomotor assays; a recording of less than ten minutes is
cut into ten bins.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from liex_lab.behaviour.summary_columns import activity_columns
from liex_lab.tables.rows import stop_times
from liex_lab.tables.schema import to_pandas

Array = NDArray[np.float64]

BIN_S = 60.0
FEWEST = 10  # intervals; a shorter recording is cut into so many


def activity(kinematics: pd.DataFrame, bouts: pd.DataFrame, words: Sequence[str]) -> pd.DataFrame:
    """The table `activity` of one animal: one row per bin of time.

    Args:
        kinematics: the table `kinematics`.
        bouts: the table `bouts`, in order of time.
        words: the actions' names.

    Returns:
        The columns of `activity_columns`; a frame counts in the bin in which it begins, a bout in
        every bin it overlaps.
    """
    time_s = kinematics["time_s"].to_numpy(float)
    hold = stop_times(time_s) - time_s
    edges = intervals(float(time_s[-1] + hold[-1]))
    row = np.clip(np.searchsorted(edges, time_s, side="right") - 1, 0, len(edges) - 2)
    observed = np.isfinite(kinematics["x_mm"].to_numpy(float))
    step = kinematics["step_mm"].to_numpy(float)
    moved = np.isfinite(step)
    n = len(edges) - 1

    def total(values: Array, mask: NDArray[np.bool_]) -> Array:
        """Sum of `values` (n,) over the frames of `mask` (n,) in each bin, (k,)."""
        return np.bincount(row[mask], values[mask], n).astype(float)

    distance = total(step, moved)
    timed = total(hold, moved)
    spent = {}
    for word in words:
        own = bouts[bouts["action"] == word]
        spent[f"{word}_s"] = time_within(
            own["start_s"].to_numpy(float), own["stop_s"].to_numpy(float), edges
        )
    return to_pandas(
        activity_columns(words),
        {
            **{name: [str(kinematics[name].iloc[0])] * n for name in ("session_id", "individual")},
            "start_s": edges[:-1],
            "stop_s": edges[1:],
            "observed_s": total(hold, observed),
            "distance_mm": distance,
            "mean_speed_mm_s": np.divide(distance, timed, out=np.full(n, np.nan), where=timed > 0),
            **spent,
        },
    )


def intervals(duration_s: float) -> Array:
    """Edges (k + 1,) of the bins, s: whole minutes, the last one perhaps shorter.

    Less than ten minutes are cut into tenths.

    Args:
        duration_s: length of the recording, s.
    """
    if duration_s < FEWEST * BIN_S:
        return np.linspace(0.0, duration_s, FEWEST + 1)
    return np.append(np.arange(0.0, duration_s - 1e-9, BIN_S), duration_s)


def time_within(start_s: Array, stop_s: Array, edges: Array) -> Array:
    """(k,) time of spans within each of k intervals, s.

    Args:
        start_s: (n,) beginnings of the spans, s, in order; spans do not overlap.
        stop_s: (n,) their ends, s.
        edges: (k + 1,) edges of the intervals, s.
    """
    if len(start_s) == 0:
        return np.zeros(len(edges) - 1)
    # time spent in spans before each edge: a broken line through (start, so far) and (stop, so far
    # + length)
    so_far = np.append(0.0, np.cumsum(stop_s - start_s))
    at = np.stack([start_s, stop_s], axis=1).ravel()
    spent = np.stack([so_far[:-1], so_far[1:]], axis=1).ravel()
    return np.diff(np.interp(edges, at, spent))
