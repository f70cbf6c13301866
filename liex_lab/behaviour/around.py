"""Peri-event average: median and quartiles of a measure around the onsets of an action."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from liex_lab.behaviour.kinematics import segments

Array = NDArray[np.float64]

BEFORE_S = 1.0
AFTER_S = 2.0
_STEPS = 61
_FEWEST = 5  # bouts; of fewer no quartiles are told


@dataclass(frozen=True)
class Around:
    """A measure around the onsets of an action, at k times.

    Attributes:
        time_s: (k,) time relative to the onset, s.
        low: (k,) lower quartile over the bouts, in the measure's own unit.
        median: (k,) median over the bouts.
        high: (k,) upper quartile over the bouts.
        n: number of bouts.
    """

    time_s: Array
    low: Array
    median: Array
    high: Array
    n: int


def around_onsets(
    kinematics: pd.DataFrame, bouts: pd.DataFrame, action: str, column: str
) -> Around | None:
    """Peri-event median and quartiles of a column around every onset of an action.

    Values are interpolated linearly between the frames' true times, never across a gap; where a
    bout has no value it does not count, and a time with fewer than five values is NaN.

    Args:
        kinematics: the table `kinematics`.
        bouts: the table `bouts`.
        action: the action whose onsets are taken.
        column: the column of `kinematics`.

    Returns:
        From `BEFORE_S` before to `AFTER_S` after the onset; None where there are too few bouts.
    """
    own = bouts.loc[bouts["action"] == action, "start_s"].to_numpy(float)
    if len(own) < _FEWEST:
        return None
    time_s = kinematics["time_s"].to_numpy(float)
    values = kinematics[column].to_numpy(float)
    grid = np.linspace(-BEFORE_S, AFTER_S, _STEPS)
    wanted = own[:, None] + grid
    after = np.clip(np.searchsorted(time_s, wanted), 1, len(time_s) - 1)
    span = time_s[after] - time_s[after - 1]
    share = np.divide(wanted - time_s[after - 1], span, out=np.zeros_like(wanted), where=span > 0)
    found = values[after - 1] + share * (values[after] - values[after - 1])
    number = segments(time_s, np.isfinite(values))
    inside = (number[after] == number[after - 1]) & (wanted >= time_s[0]) & (wanted <= time_s[-1])
    found = np.where(inside, found, np.nan)
    enough = np.isfinite(found).sum(axis=0) >= _FEWEST
    quartiles = np.full((3, _STEPS), np.nan)
    quartiles[:, enough] = np.nanpercentile(found[:, enough], [25.0, 50.0, 75.0], axis=0)
    low, median, high = quartiles
    return Around(grid, low, median, high, len(own)) if enough.any() else None
