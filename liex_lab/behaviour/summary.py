"""One row per animal: how far, how fast, how often; shares are of the time in which the animal was observed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from liex_lab.behaviour.bouts import MouseRules, find_bouts
from liex_lab.behaviour.columns import ACTIONS, COLUMNS, SUMMARY, zone_columns
from liex_lab.behaviour.kinematics import kinematics
from liex_lab.recordings.zones import SEPARATOR
from liex_lab.sessions.rows import stop_times
from liex_lab.sessions.tables import to_pandas


@dataclass(frozen=True)
class Behaviour:
    """The three behaviour tables of one animal."""

    kinematics: pd.DataFrame
    bouts: pd.DataFrame
    summary: pd.DataFrame
    rules: MouseRules
    zones: Sequence[str] = ()

    def for_session(self) -> dict[str, Any]:
        """The arguments that hand all of it to a session: `writer.close(**behaviour.for_session())`."""
        return {
            "kinematics": self.kinematics, "bouts": self.bouts, "summary": self.summary,
            "columns": (*COLUMNS, *zone_columns(self.zones)),
            "actions": self.rules.definitions(), "record": {"rules": asdict(self.rules)},
        }  # fmt: skip


def measure(
    frames: pd.DataFrame, poses: pd.DataFrame, rules: MouseRules | None = None, zones: Sequence[str] = ()
) -> Behaviour:
    """Everything this room knows to say about one animal, from its tables `frames` and `poses`; zones: their names."""
    rules = rules or MouseRules()
    moved = kinematics(frames, poses, rules.speed_half_window_s, rules.impossible_above_mm_s)
    bouts = find_bouts(frames, moved, rules)
    return Behaviour(moved, bouts, summarise(frames, moved, bouts, zones), rules, zones)


def summarise(
    frames: pd.DataFrame, kinematics: pd.DataFrame, bouts: pd.DataFrame, zones: Sequence[str] = ()
) -> pd.DataFrame:
    """The table `summary`: one row from the tables `frames`, `kinematics` and `bouts` of one animal."""
    time_s = kinematics["time_s"].to_numpy(float)
    hold = stop_times(time_s) - time_s
    observed = np.isfinite(kinematics["x_mm"].to_numpy(float))
    speed, step = (kinematics[name].to_numpy(float) for name in ("speed_mm_s", "step_mm"))
    known = np.isfinite(speed)
    observed_s, moving_s = float(hold[observed].sum()), float(hold[known].sum())
    distance = float(np.nansum(step))
    spent = bouts.groupby("action")["duration_s"].sum()
    seconds = {action: float(spent.get(action, 0.0)) for action in ACTIONS}
    unlabelled = max(0.0, observed_s - sum(seconds.values()))
    if unlabelled < 1e-9:  # rounding of sums of seconds
        unlabelled = 0.0
    budget = {**seconds, "unlabelled": unlabelled}
    return to_pandas([*SUMMARY, *zone_columns(zones)], {
        "session_id": str(frames["session_id"].iloc[0]), "individual": str(frames["individual"].iloc[0]),
        "n_frames": len(frames), "n_lost": int((~observed).sum()),
        "n_doubtful": int((frames["flag"] == "doubtful").sum()),
        "duration_s": float(stop_times(time_s)[-1]), "observed_s": observed_s,
        "spine_mm": float(np.nanmedian(frames["spine_mm"])) if observed.any() else np.nan,
        "distance_m": distance / 1000.0,
        "distance_moving_m": float(bouts.loc[bouts["action"].isin(["walk", "run"]), "path_mm"].sum()) / 1000.0,
        "mean_speed_mm_s": distance / moving_s if moving_s > 0 else np.nan,
        "median_speed_mm_s": float(np.median(speed[known])) if known.any() else np.nan,
        "max_speed_mm_s": float(speed[known].max()) if known.any() else np.nan,
        "rear_count": int((bouts["action"] == "rear").sum()),
        **{f"{word}_s": value for word, value in budget.items()},
        **{f"{word}_share": value / observed_s if observed_s > 0 else np.nan for word, value in budget.items()},
        **_time_in_zones(frames, zones, np.where(observed, hold, 0.0)),
    })  # fmt: skip


def _time_in_zones(frames: pd.DataFrame, zones: Sequence[str], hold: NDArray[np.float64]) -> dict[str, float]:
    """Seconds in each zone, and shares of the observed time; hold (n,) s is how long each frame counts."""
    observed_s, found = float(hold.sum()), {}
    for zone in zones:
        inside = np.array([zone in str(names).split(SEPARATOR) for names in frames["zone"]], np.bool_)
        found[f"zone_{zone}_s"] = float(hold[inside].sum())
        found[f"zone_{zone}_share"] = found[f"zone_{zone}_s"] / observed_s if observed_s > 0 else np.nan
    return found
