"""Position of the animal: zone visits, thigmotaxis (outer half of an open field), novel tank test.

A visit is a bout inside a zone, with the merging and the least length of `bouts.tidy`. The outer
half is the border along the walls that covers half of the floor's area: for a circle r (1 -
sqrt(1/2)), for a rectangle the m that solves (a - m)(b - m) = a b / 2, with a and b half its sides.
For a fish, the shares of the time in the top and bottom third of the water are measured. Shares are
of the observed time.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray

from liex_lab.behaviour.activity import observed_hold
from liex_lab.behaviour.bouts import MouseRules, tidy
from liex_lab.behaviour.kinematics import segments
from liex_lab.scene.outline import UNKNOWN, Arena
from liex_lab.scene.zones import SEPARATOR
from liex_lab.tables.rows import stop_times
from liex_lab.tables.schema import table_columns, to_pandas

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Surroundings:
    """The animal's surroundings.

    Attributes:
        arena: shape of the arena.
        zones: names of the zones.
        surface_z_mm: height of the water's surface above the floor, mm; None if absent or unknown.
        seams: frame indices of the camera at which a person's exchange of head and tail begins or
            ends; nothing is measured across one, as across a gap.
    """

    arena: Arena = UNKNOWN
    zones: Sequence[str] = field(default=())
    surface_z_mm: float | None = None
    seams: Sequence[int] = field(default=())


def surface_height_mm(floor_distance_mm: float, optics: dict[str, object]) -> float | None:
    """Height of the water's surface above the floor, mm, from session.json.

    Args:
        floor_distance_mm: distance of the camera from the floor, mm.
        optics: the camera's optics; water.height_mm is the distance of the surface below the lens,
            mm.

    Returns:
        None if there is no water, or the surface is not above the floor.
    """
    water = optics.get("water")
    if not isinstance(water, dict) or not water.get("height_mm"):
        return None
    height = floor_distance_mm - float(water["height_mm"])
    return height if height > 0 else None


def visits(
    frames: pd.DataFrame, kinematics: pd.DataFrame, zones: Sequence[str], rules: MouseRules
) -> pd.DataFrame:
    """The table `zones`: time, share, visits, latency, mean visit and distance of each zone.

    Args:
        frames: the table `frames`.
        kinematics: the table `kinematics` of the same frames.
        zones: names of the zones.
        rules: absences shorter than `merge_pauses_s` are bridged, then visits shorter than
            `min_bout_s` are dropped.
    """
    time_s = kinematics["time_s"].to_numpy(float)
    stop_s = stop_times(time_s)
    observed = np.isfinite(kinematics["x_mm"].to_numpy(float))
    number = segments(time_s, observed)
    step = np.nan_to_num(kinematics["step_mm"].to_numpy(float))
    first = time_s[observed][0] if observed.any() else np.nan
    hold = observed_hold(kinematics)
    rows = []
    for zone, inside in zip(zones, inside_zones(frames, zones), strict=True):
        here = inside & observed
        stays = list(tidy(here, observed, number, time_s, stop_s, rules))
        lengths = [stop_s[b - 1] - time_s[a] for a, b in stays]
        rows.append(
            {
                "session_id": str(frames["session_id"].iloc[0]),
                "individual": str(frames["individual"].iloc[0]),
                "zone": zone,
                "time_s": hold[here].sum(),
                "share": hold[here].sum() / hold.sum() if hold.sum() > 0 else np.nan,
                "n_visits": len(stays),
                "latency_s": time_s[stays[0][0]] - first if stays else np.nan,
                "mean_visit_s": np.mean(lengths) if stays else np.nan,
                "distance_mm": step[here].sum(),
            }
        )
    columns = table_columns("zones")
    return to_pandas(columns, {c.name: [row[c.name] for row in rows] for c in columns})


def inside_zones(frames: pd.DataFrame, zones: Sequence[str]) -> list[Mask]:
    """For each zone (n,) bool, whether the animal's centroid is inside it; zones may overlap.

    Args:
        frames: the table `frames`; its column zone contains names joined by `SEPARATOR`.
        zones: names of the zones; () for sessions of older versions, which have no such column.
    """
    if not zones:  # sessions of older versions have no such column
        return []
    words = pd.Series(frames["zone"].astype(str))
    different = {text: set(text.split(SEPARATOR)) for text in words.unique()}
    return [
        words.map({text: zone in names for text, names in different.items()}).to_numpy(bool)
        for zone in zones
    ]


def outer_margin_mm(arena: Arena) -> float:
    """Width of the border along the walls that covers half of the floor's area, mm.

    NaN for a shape that is neither a circle nor a rectangle.
    """
    if arena.radius_mm is not None:
        return float(arena.radius_mm * (1.0 - np.sqrt(0.5)))
    if arena.half_mm is not None:
        a, b = arena.half_mm  # (a - m) (b - m) = a b / 2
        return float((a + b - np.sqrt((a + b) ** 2 - 2.0 * a * b)) / 2.0)
    return float("nan")


def place_measures(frames: pd.DataFrame, hold: Array, arena: Arena) -> dict[str, float]:
    """Median distance from the walls, mm, and share of the time in the outer half of the floor.

    Args:
        frames: the table `frames` of n frames; without wall_distance_mm both are NaN.
        hold: (n,) duration of each observed frame, s; 0 for the others.
        arena: shape of the arena.

    Returns:
        The columns wall_distance_mm and outer_half_share of the summary.
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
    """Position in the water: the measures of the novel tank test.

    Args:
        kinematics: the table `kinematics` of n frames.
        hold: (n,) duration of each observed frame, s; 0 for the others.
        surface_z_mm: height of the water's surface above the floor, mm; None if unknown, which
            gives the mean height only.

    Returns:
        mean_height_mm, top_third_share, bottom_third_share and top_third_latency_s (s since the
            first pose); NaN if unknown.
    """
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


# Occupancy of the floor: time per cell, spread by a Gaussian kernel (kernel density estimate).


CELL_MM = 5.0
SD_MM = 10.0  # of the kernel: about half a mouse's width
_MOST_CELLS = 400  # along a side; larger floors have larger cells


@dataclass(frozen=True)
class Occupancy:
    """Time spent in each cell of the floor.

    Attributes:
        time_s: (ny, nx) time in each cell, s; row 0 has the smallest y.
        x_mm: (nx + 1,) edges of the columns, mm, arena frame.
        y_mm: (ny + 1,) edges of the rows, mm, arena frame.
        n: number of frames with a position.
    """

    time_s: Array
    x_mm: Array
    y_mm: Array
    n: int

    @property
    def observed_s(self) -> float:
        """The time in all cells, s."""
        return float(self.time_s.sum())

    @property
    def per_cm2(self) -> Array:
        """(ny, nx) time per area, s/cm²."""
        area = np.outer(np.diff(self.y_mm), np.diff(self.x_mm)) / 100.0
        return np.asarray(self.time_s / area)


def hold_times(time_s: ArrayLike) -> Array:
    """(n,) duration of each frame, s: until the next; a median step before a gap or at the end."""
    time = np.asarray(time_s, float)
    return np.asarray(stop_times(time) - time)


def occupancy(
    xy_mm: ArrayLike, hold_s: ArrayLike, low_mm: ArrayLike, high_mm: ArrayLike, sd_mm: float = SD_MM
) -> Occupancy:
    """Time spent in each cell of a rectangle of the floor.

    Args:
        xy_mm: (n, 2) positions, mm, arena frame; a row with NaN does not count.
        hold_s: (n,) duration of each, s.
        low_mm: (2,) the rectangle's smallest x and y, mm; it is extended to include all positions.
        high_mm: (2,) its largest x and y, mm.
        sd_mm: standard deviation of the kernel, mm; 0 for plain counting.
    """
    from scipy.ndimage import gaussian_filter

    xy = np.asarray(xy_mm, float)
    known = np.isfinite(xy).all(axis=1)
    xy = xy[known]
    hold = np.asarray(hold_s, float)[known]
    low = np.min([np.asarray(low_mm, float), *([xy.min(axis=0)] if len(xy) else [])], axis=0)
    high = np.max([np.asarray(high_mm, float), *([xy.max(axis=0)] if len(xy) else [])], axis=0)
    cell = max(CELL_MM, float((high - low).max()) / _MOST_CELLS)
    edges = [
        a + cell * np.arange(max(int(np.ceil((b - a) / cell)), 1) + 1)
        for a, b in zip(low, high, strict=True)
    ]
    counted, _, _ = np.histogram2d(xy[:, 1], xy[:, 0], [edges[1], edges[0]], weights=hold)
    if sd_mm > 0:
        counted = gaussian_filter(counted, sd_mm / cell, mode="reflect")
    return Occupancy(np.asarray(counted, float), edges[0], edges[1], len(xy))
