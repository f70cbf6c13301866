"""Where the animal was: zones, walls, height in the water."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from liex_lab.arena.outline import UNKNOWN, Arena
from liex_lab.arena.zones import SEPARATOR
from liex_lab.behaviour.bouts import MouseRules, tidy
from liex_lab.behaviour.kinematics import segments
from liex_lab.behaviour.summary_columns import ZONES
from liex_lab.tables.rows import stop_times
from liex_lab.tables.schema import to_pandas

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Surroundings:
    """What is around the animal: the arena's shape, the zones' names, the height of the water's
    surface, mm.
    """

    arena: Arena = UNKNOWN
    zones: Sequence[str] = field(default=())
    surface_z_mm: float | None = None


def surface_height_mm(floor_distance_mm: float, optics: dict[str, object]) -> float | None:
    """Height of the water's surface above the floor, from what session.json says of camera and
    optics.
    """
    water = optics.get("water")
    if not isinstance(water, dict) or not water.get("height_mm"):
        return None
    height = floor_distance_mm - float(water["height_mm"])
    return height if height > 0 else None


def visits(
    frames: pd.DataFrame, kinematics: pd.DataFrame, zones: Sequence[str], rules: MouseRules
) -> pd.DataFrame:
    """The table `zones`: one row per zone."""
    time_s = kinematics["time_s"].to_numpy(float)
    stop_s = stop_times(time_s)
    observed = np.isfinite(kinematics["x_mm"].to_numpy(float))
    number = segments(time_s, observed)
    step = np.nan_to_num(kinematics["step_mm"].to_numpy(float))
    first = time_s[observed][0] if observed.any() else np.nan
    hold = np.where(observed, stop_s - time_s, 0.0)
    rows = []
    for zone, inside in zip(zones, inside_zones(frames, zones), strict=True):
        here = inside & observed
        stays = list(tidy(here, observed, number, time_s, stop_s, rules))
        lengths = [stop_s[b - 1] - time_s[a] for a, b in stays]
        rows.append(
            (
                zone,
                hold[here].sum(),
                hold[here].sum() / hold.sum() if hold.sum() > 0 else np.nan,
                len(stays),
                time_s[stays[0][0]] - first if stays else np.nan,
                np.mean(lengths) if stays else np.nan,
                step[here].sum(),
            )
        )
    names = [column.name for column in ZONES[2:]]
    values = zip(*rows, strict=True) if rows else [[] for _ in names]
    who = {name: [str(frames[name].iloc[0])] * len(rows) for name in ("session_id", "individual")}
    return to_pandas(
        ZONES, {**who, **{name: list(column) for name, column in zip(names, values, strict=True)}}
    )


def inside_zones(frames: pd.DataFrame, zones: Sequence[str]) -> list[Mask]:
    """For each zone (n,) whether the centroid lies in it."""
    if not zones:  # sessions of older versions have no such column
        return []
    words = pd.Series(frames["zone"].astype(str))
    different = {text: set(text.split(SEPARATOR)) for text in words.unique()}
    return [
        words.map({text: zone in names for text, names in different.items()}).to_numpy(bool)
        for zone in zones
    ]


def outer_margin_mm(arena: Arena) -> float:
    """How wide the border along the walls is that takes half of the floor's area; NaN for an
    unknown shape.
    """
    if arena.radius_mm is not None:
        return float(arena.radius_mm * (1.0 - np.sqrt(0.5)))
    if arena.half_mm is not None:
        a, b = arena.half_mm  # (a - m) (b - m) = a b / 2
        return float((a + b - np.sqrt((a + b) ** 2 - 2.0 * a * b)) / 2.0)
    return float("nan")


def place_measures(frames: pd.DataFrame, hold: Array, arena: Arena) -> dict[str, float]:
    """Distance from the walls; hold (n,) s is how long each observed frame counts, 0 for the
    others.
    """
    wall = (
        frames["wall_distance_mm"].to_numpy(float)
        if "wall_distance_mm" in frames
        else np.full(len(frames), np.nan)
    )
    known = np.isfinite(wall) & (hold > 0)
    margin = outer_margin_mm(arena)
    time = float(hold[known].sum())
    outer = (
        float(hold[known & (wall < margin)].sum()) / time
        if time > 0 and np.isfinite(margin)
        else np.nan
    )
    return {
        "wall_distance_mm": float(np.median(wall[known])) if known.any() else np.nan,
        "outer_half_share": outer,
    }


def depth_measures(
    kinematics: pd.DataFrame, hold: Array, surface_z_mm: float | None
) -> dict[str, float]:
    """Where in the water the animal was."""
    z = kinematics["z_mm"].to_numpy(float)
    time_s = kinematics["time_s"].to_numpy(float)
    known = np.isfinite(z)
    total = float(hold[known].sum())
    out = {
        "mean_height_mm": float((z[known] * hold[known]).sum()) / total if total > 0 else np.nan,
        "top_third_share": np.nan,
        "bottom_third_share": np.nan,
        "top_third_latency_s": np.nan,
    }
    if surface_z_mm is None or total <= 0:
        return out
    top = known & (z > 2.0 / 3.0 * surface_z_mm)
    out["top_third_share"] = float(hold[top].sum()) / total
    out["bottom_third_share"] = float(hold[known & (z < surface_z_mm / 3.0)].sum()) / total
    if top.any():
        out["top_third_latency_s"] = float(time_s[top][0] - time_s[known][0])
    return out
