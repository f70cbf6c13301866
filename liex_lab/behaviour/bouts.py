"""Rule-based ethogram of a mouse (rear, run, walk, pause) by double thresholds on speed and height.

One label per frame, half-open bouts, never across a gap. For every action: hysteresis (two
thresholds, enter and leave), then interruptions shorter than `merge_pauses_s` are bridged, then
bouts shorter than `min_bout_s` are dropped. If two actions claim a frame, the first of `ACTIONS`
wins. Default thresholds: Live Mouse Tracker (de Chaumont et al. 2019).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from liex_lab.behaviour.kinematics import segments
from liex_lab.behaviour.measures import measure_bouts
from liex_lab.tables.rows import constant_runs, frame_count, stop_times
from liex_lab.tables.schema import BOUTS, to_pandas

ACTIONS = ("rear", "run", "walk", "pause")  # if two claim a frame, the first wins

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class MouseRules:
    """Thresholds of the rule-based ethogram, by their names in a plan.

    `MouseRules(**plan.behaviour.model_dump())` makes them from a plan. The defaults are those of
    Live Mouse Tracker. Its rearing height of 40 mm applies to an adult of about 90 mm; a smaller
    animal rears from 0.6 of its own length. A bout of rearing extends down to two thirds of that
    height.

    Attributes:
        speed_half_window_s: speed at t is measured between frames this far before and after it, s.
        pause_below_mm_s: slower than this is a pause, mm/s.
        run_above_mm_s: faster than this is a run, mm/s.
        impossible_above_mm_s: faster than this is a tracking error, mm/s.
        rear_height_mm: height of the nose above the tail's base in an adult's rear, mm.
        rear_height_bl: the same for a smaller animal, in body lengths.
        rear_leave: rearing lasts down to this share of its height.
        speed_hysteresis: a threshold is crossed upwards this share above it, downwards this share
            below it.
        merge_pauses_s: shorter interruptions of a bout are bridged, s.
        min_bout_s: shorter bouts are dropped, s.
    """

    speed_half_window_s: float = 0.034
    pause_below_mm_s: float = 50.0
    run_above_mm_s: float = 300.0
    impossible_above_mm_s: float = 3000.0
    rear_height_mm: float = 40.0
    rear_height_bl: float = 0.6
    rear_leave: float = 2.0 / 3.0
    # a threshold is crossed upwards 10 % above it, downwards 10 % below
    speed_hysteresis: float = 0.1
    merge_pauses_s: float = 0.33
    min_bout_s: float = 0.23

    def rear_mm(self, spine_mm: float) -> float:
        """Least height of the nose above the tail's base in a rear, mm, for a spine of
        `spine_mm`.
        """
        return min(self.rear_height_mm, self.rear_height_bl * spine_mm)

    def definitions(self) -> dict[str, str]:
        """The definition of each word of `ACTIONS` with these thresholds, as sentences."""
        walk = f"{self.pause_below_mm_s / 10.0:g} cm/s"
        run = f"{self.run_above_mm_s / 10.0:g} cm/s"
        return {
            "rear": (
                f"the nose is {self.rear_height_mm:g} mm or more above the tail's base, or "
                f"{self.rear_height_bl:g} body lengths for an animal shorter than "
                f"{self.rear_height_mm / self.rear_height_bl:.0f} mm; rising and descending "
                f"belong to it, down to {self.rear_leave:.0%} of that height"
            ),
            "run": f"the body's centre moves faster than {run}",
            "walk": f"the body's centre moves at {walk} to {run}",
            "pause": f"the body's centre moves slower than {walk}",
        }


def find_bouts(
    frames: pd.DataFrame, kinematics: pd.DataFrame, rules: MouseRules | None = None
) -> pd.DataFrame:
    """The rule-based table `bouts` of one animal, with the measures of each bout.

    Args:
        frames: the table `frames`; spine_mm is read.
        kinematics: the table `kinematics` of the same frames.
        rules: the thresholds; None uses the defaults.

    Returns:
        One row per bout in order of time, source "rule"; the score is the share of its frames that
            satisfy the rule themselves.
    """
    rules = rules or MouseRules()
    time_s = kinematics["time_s"].to_numpy(float)
    observed = np.isfinite(kinematics["x_mm"].to_numpy(float))
    number = segments(time_s, observed)
    stop_s = stop_times(time_s)
    raw = raw_labels(
        kinematics,
        float(np.nanmedian(frames["spine_mm"])) if observed.any() else np.nan,
        number,
        rules,
    )
    label = np.full(len(time_s), "", dtype=object)
    for action in ACTIONS:
        free = (label == "") & observed
        for start, stop in tidy(raw[action] & free, free, number, time_s, stop_s, rules):
            label[start:stop] = action
    return _table(kinematics, label, raw, number, stop_s)


def raw_labels(
    kinematics: pd.DataFrame, spine_mm: float, number: NDArray[np.int64], rules: MouseRules
) -> dict[str, Mask]:
    """Per action (n,) bool: the frames that satisfy its rule, with hysteresis in every stretch.

    Args:
        kinematics: the table `kinematics`; without nose_over_rump_mm (a swimming animal) nothing
            rears.
        spine_mm: length of the animal's spine, mm.
        number: (n,) unbroken stretch of each frame, see `segments`.
        rules: the thresholds.
    """
    speed = kinematics["speed_mm_s"].to_numpy(float)
    slope = (
        kinematics["nose_over_rump_mm"].to_numpy(float)
        if "nose_over_rump_mm" in kinematics
        else speed * np.nan
    )
    rear_mm = rules.rear_mm(spine_mm)
    low = 1.0 - rules.speed_hysteresis
    high = 1.0 + rules.speed_hysteresis
    moving = hysteresis(speed, rules.pause_below_mm_s * high, rules.pause_below_mm_s * low, number)
    running = hysteresis(speed, rules.run_above_mm_s * high, rules.run_above_mm_s * low, number)
    known = np.isfinite(speed)
    return {
        "rear": hysteresis(slope, rear_mm, rules.rear_leave * rear_mm, number),
        "run": running & known,
        "walk": moving & ~running & known,
        "pause": ~moving & known,
    }


def hysteresis(values: Array, enter: float, leave: float, number: NDArray[np.int64]) -> Mask:
    """(n,) bool: the runs above `leave` that reach `enter`, separately in every stretch.

    It is True until the values fall below `leave`. The frames between `leave` and `enter` just
    before the threshold is reached are included (as in Canny's edge detector, not as in a causal
    Schmitt trigger).

    Args:
        values: (n,) the measure; NaN is below every threshold.
        enter: upper threshold, in the unit of `values`.
        leave: lower threshold, in the unit of `values`.
        number: (n,) unbroken stretch of each frame, see `segments`.
    """
    high = values >= enter
    inside = values >= leave
    out = np.zeros(len(values), bool)
    group = np.where(
        inside, number, -1 - number
    )  # a run of one group is within one stretch, all above `leave` or all below
    for start, stop, which in constant_runs(group):
        out[start:stop] = which >= 0 and bool(high[start:stop].any())
    return out


def tidy(
    mask: Mask,
    free: Mask,
    number: NDArray[np.int64],
    time_s: Array,
    stop_s: Array,
    rules: MouseRules,
) -> Iterator[tuple[int, int]]:
    """Yield the bouts (start, stop) of a mask: short pauses bridged, then short bouts dropped.

    Pauses are bridged over free frames of one stretch only.

    Args:
        mask: (n,) bool, the frames that satisfy the rule.
        free: (n,) bool, the frames that no earlier action claimed.
        number: (n,) unbroken stretch of each frame, see `segments`.
        time_s: (n,) times of the frames, s.
        stop_s: (n,) end of each frame's validity, s, see `stop_times`.
        rules: `merge_pauses_s` and `min_bout_s` are used.

    Yields:
        Rows [start, stop) of each bout, in order of time.
    """
    merged: list[tuple[int, int]] = []
    for start, stop, which in constant_runs(np.where(mask, number, -1)):
        if which < 0:
            continue
        if merged:
            last_start, last_stop = merged[-1]
            bridge = number[last_stop - 1] == which and free[last_stop:start].all()
            if bridge and time_s[start] - stop_s[last_stop - 1] < rules.merge_pauses_s:
                merged[-1] = (last_start, stop)
                continue
        merged.append((start, stop))
    for start, stop in merged:
        if stop_s[stop - 1] - time_s[start] >= rules.min_bout_s:
            yield start, stop


def _table(
    kinematics: pd.DataFrame,
    label: NDArray[np.object_],
    raw: dict[str, Mask],
    number: NDArray[np.int64],
    stop_s: Array,
) -> pd.DataFrame:
    """The table `bouts`: one row per run of equal labels inside one stretch."""
    time_s = kinematics["time_s"].to_numpy(float)
    count = frame_count(kinematics["frame_index"].to_numpy())
    code = {action: k for k, action in enumerate(ACTIONS)}
    runs = np.array([code.get(word, -1) for word in label], np.int64)
    pieces = [
        (start, stop)
        for start, stop, key in constant_runs(np.where(runs >= 0, runs + len(code) * number, -1))
        if key >= 0
    ]
    a, b = np.array(pieces, np.int64).reshape(-1, 2).T
    named = to_pandas(
        BOUTS,
        {
            "session_id": str(kinematics["session_id"].iloc[0]),
            "individual": str(kinematics["individual"].iloc[0]),
            "action": label[a],
            "start_s": time_s[a],
            "stop_s": stop_s[b - 1],
            "duration_s": stop_s[b - 1] - time_s[a],
            "start_frame": count[a],
            "stop_frame": count[b],
            "score": [float(raw[str(label[i])][i:j].mean()) for i, j in pieces],
            "source": "rule",
            "model_hash": "",
        },
    )
    return measure_bouts(named, kinematics)
