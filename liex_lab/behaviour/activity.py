"""Activity over a session in bins of one minute: distance, mean speed and time in each action.

Time-binned activity as in open-field and locomotor assays; a recording of less than ten minutes is
cut into ten bins. Every time is a sum over observed frames of the time to the next frame, so the
actions and the time without a name add up to the observed time.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from liex_lab.tables.rows import stop_times
from liex_lab.tables.schema import table_columns, to_pandas

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
        The table; a frame counts in the bin in which it begins.
    """
    time_s = kinematics["time_s"].to_numpy(float)
    edges = intervals(float(stop_times(time_s)[-1]))
    row = np.clip(np.searchsorted(edges, time_s, side="right") - 1, 0, len(edges) - 2)
    hold = observed_hold(kinematics)
    step = kinematics["step_mm"].to_numpy(float)
    moved = np.isfinite(step)
    n = len(edges) - 1

    def total(values: Array, mask: NDArray[np.bool_]) -> Array:
        """Sum of `values` (n,) over the frames of `mask` (n,) in each bin, (k,)."""
        return np.bincount(row[mask], values[mask], n).astype(float)

    distance = total(step, moved)
    timed = total(hold, moved)
    spent = time_named(kinematics, bouts, words, row, n)
    return to_pandas(
        table_columns("activity", words=words),
        {
            **{name: [str(kinematics[name].iloc[0])] * n for name in ("session_id", "individual")},
            "start_s": edges[:-1],
            "stop_s": edges[1:],
            "observed_s": total(hold, hold > 0.0),
            "distance_mm": distance,
            "mean_speed_mm_s": np.divide(distance, timed, out=np.full(n, np.nan), where=timed > 0),
            "unlabelled_s": spent[:, 0],
            **{f"{word}_s": spent[:, k] for k, word in enumerate(words, 1)},
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


def observed_hold(kinematics: pd.DataFrame) -> Array:
    """How long each frame counts, (n,) s: until the next frame; 0 without a measured pose.

    Before a gap of the camera and at the end it is one median step.

    Args:
        kinematics: the table `kinematics` of n frames.
    """
    time_s = kinematics["time_s"].to_numpy(float)
    observed = np.isfinite(kinematics["x_mm"].to_numpy(float))
    return np.where(observed, stop_times(time_s) - time_s, 0.0)


def time_named(
    kinematics: pd.DataFrame,
    bouts: pd.DataFrame,
    words: Sequence[str],
    row: NDArray[np.int64] | int = 0,
    n: int = 1,
) -> Array:
    """Observed time without a name and in each action, (n, 1 + len(words)) s, in n intervals.

    A row adds up to the observed time of its interval, whatever gaps the bouts continue across.

    Args:
        kinematics: the table `kinematics`.
        bouts: the table `bouts`.
        words: the actions' names; bouts of any other count as unlabelled.
        row: the interval of each frame.
        n: number of intervals.
    """
    time_s = kinematics["time_s"].to_numpy(float)
    place = {word: k for k, word in enumerate(words, 1)}
    code = np.zeros(len(time_s), np.int64)
    # a frame at a bout's start belongs to it, one at its stop does not, however seconds are rounded
    spans = np.searchsorted(time_s, bouts[["start_s", "stop_s"]].to_numpy(float) - 1e-6)
    for (start, stop), word in zip(spans, bouts["action"], strict=True):
        code[start:stop] = place.get(word, 0)
    width = len(place) + 1
    spent = np.bincount(row * width + code, observed_hold(kinematics), n * width)
    return np.asarray(spent.reshape(n, width))
