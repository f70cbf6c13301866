"""Activity of one animal in time and space: time bins, transitions, onsets, zones, occupancy.

Activity is in bins of one minute, as in open-field and locomotor assays; a recording of less than
ten minutes is divided into ten bins. Every time is a sum over observed frames of the time to the
next frame, so the times of the actions and the unlabelled time add up to the observed time.

A visit is a bout inside a zone, with the merging and the least length of `bouts.tidy`. The outer
half is the border along the walls that covers half of the floor's area: for a circle r (1 -
sqrt(1/2)), for a rectangle the m that solves (a - m)(b - m) = a b / 2, with a and b half its sides.
For a fish, the shares of the time in the top and bottom third of the water are measured. Shares are
of the observed time.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import pandas as pd

from liex_lab.arrays import Array, ArrayLike, Mask, NDArray
from liex_lab.behaviour.bouts import MouseRules, tidy
from liex_lab.behaviour.days import Light
from liex_lab.behaviour.kinematics import segments
from liex_lab.behaviour.statistics import false_discovery
from liex_lab.recordings.timestamps import GAP_FACTOR
from liex_lab.runtime.memory import blocks
from liex_lab.scene.scene import UNKNOWN, Arena
from liex_lab.scene.zones import SEPARATOR
from liex_lab.tables.rows import stop_times
from liex_lab.tables.schema import table_columns, to_pandas

BIN_S = 60.0
FEWEST = 10  # bins, of a shorter recording
_BLOCK = 1 << 17  # frames in memory at once


def activity(
    kinematics: pd.DataFrame, bouts: pd.DataFrame, words: Sequence[str], bin_s: float = 0.0
) -> pd.DataFrame:
    """The table `activity` of one animal: one row per time bin.

    A frame counts in the bin in which it begins.

    Args:
        kinematics: the table `kinematics`.
        bouts: the table `bouts`, in order of time.
        words: the actions' names.
        bin_s: length of a bin, s; 0 is a minute, or a tenth of less than ten minutes.
    """
    time_s = kinematics["time_s"].to_numpy(float)
    edges = intervals(float(stop_times(time_s)[-1]), bin_s)
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


def intervals(duration_s: float, bin_s: float = 0.0) -> Array:
    """Edges (k + 1,) of the bins of a recording, s: whole minutes, the last one possibly shorter.

    Less than ten minutes are divided into tenths, unless `bin_s` states the length.
    """
    if not bin_s and duration_s < FEWEST * BIN_S:
        return np.linspace(0.0, duration_s, FEWEST + 1)
    return np.append(np.arange(0.0, duration_s - 1e-9, bin_s or BIN_S), duration_s)


def observed_hold(kinematics: pd.DataFrame) -> Array:
    """The duration of each frame, (n,) s: until the next frame; 0 without a measured pose.

    Before a gap of the camera and at the end it is one median step.
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

    A row adds up to the observed time of its interval, even if bouts continue across gaps.

    Args:
        kinematics: the table `kinematics`.
        bouts: the table `bouts`.
        words: the actions' names; bouts of any other count as unlabelled.
        row: the interval of each frame.
        n: number of intervals.
    """
    time_s = kinematics["time_s"].to_numpy(float)
    index = {word: k for k, word in enumerate(words, 1)}
    code = np.zeros(len(time_s), np.int64)
    # a frame at a bout's start belongs to it, one at its stop does not, despite rounded seconds
    spans = np.searchsorted(time_s, bouts[["start_s", "stop_s"]].to_numpy(float) - 1e-6)
    for (start, stop), word in zip(spans, bouts["action"], strict=True):
        code[start:stop] = index.get(word, 0)
    width = len(index) + 1
    spent = np.bincount(row * width + code, observed_hold(kinematics), n * width)
    return np.asarray(spent.reshape(n, width))


# First-order transition matrix of actions, tested against quasi-independence (Goodman 1968).


Counts = NDArray[np.int64]
_ALIKE = 1e-7  # outcomes with a smaller difference are equally likely
_ROUNDS = 500  # of iterative scaling, which converges in a few dozen


def transitions(
    bouts: pd.DataFrame, words: Sequence[str], gaps: pd.DataFrame, longest_pause_s: float
) -> pd.DataFrame:
    """The table `transitions` of one animal: every ordered pair of different actions.

    By chance, each action is followed by another one in proportion to the frequency of the latter.
    A bout's action is assumed to depend only on the previous one (first-order Markov); longer
    patterns are not analysed.

    Args:
        bouts: the table `bouts`, in order of time.
        words: the k words of the vocabulary, which include every action of `bouts`.
        gaps: the table `gaps`.
        longest_pause_s: bouts further apart than this do not follow each other, s.

    Returns:
        k (k - 1) rows of the table `transitions`.
    """
    counts = count_transitions(bouts, words, gaps, longest_pause_s)
    expected = by_chance(counts)
    rows, columns = np.nonzero(~np.eye(len(words), dtype=bool))
    n = counts[rows, columns]
    n_from = counts.sum(axis=1)[rows]
    chance = expected[rows, columns]
    p = np.array(
        [_binomial(int(k), int(total), q) for k, total, q in zip(n, n_from, chance, strict=True)]
    )
    names = np.array(words, dtype=object)
    return to_pandas(
        table_columns("transitions"),
        {
            **{name: [_first(bouts, name)] * len(n) for name in ("session_id", "individual")},
            "from_action": names[rows],
            "to_action": names[columns],
            "n": n,
            "n_from": n_from,
            "probability": np.divide(n, n_from, out=np.full(len(n), np.nan), where=n_from > 0),
            "by_chance": chance,
            "p": p,
            "p_fdr": false_discovery(p),
        },
    )


def count_transitions(
    bouts: pd.DataFrame, words: Sequence[str], gaps: pd.DataFrame, longest_pause_s: float
) -> Counts:
    """(k, k) int64, the number of transitions from word i to word j != i.

    A transition does not count across a gap with missing frames, or across an unnamed stretch
    longer than `longest_pause_s`.

    Args:
        bouts: the table `bouts`, in order of time.
        words: the k words of the vocabulary.
        gaps: the table `gaps`.
        longest_pause_s: longest time between two bouts that follow each other, s.
    """
    index = {word: k for k, word in enumerate(words)}
    code = np.array([index[word] for word in bouts["action"]], np.int64)
    start = bouts["start_s"].to_numpy(float)
    stop = bouts["stop_s"].to_numpy(float)
    counts = np.zeros((len(words), len(words)), np.int64)
    if len(code) < 2:
        return counts
    broken = gaps.loc[gaps["n_frames_missing"] > 0, "start_s"].to_numpy(float, copy=True)
    broken.sort()  # a gap separates two bouts if it begins between them
    parted = np.searchsorted(broken, start[1:] - 1e-9) != np.searchsorted(broken, stop[:-1] - 1e-9)
    near = (start[1:] - stop[:-1] <= longest_pause_s) & ~parted & (code[1:] != code[:-1])
    np.add.at(counts, (code[:-1][near], code[1:][near]), 1)
    return counts


def by_chance(counts: Counts) -> Array:
    """(k, k) probability of j after i under quasi-independence, by iterative proportional fitting.

    Row and column sums equal the counts, the diagonal is empty (Goodman 1968).

    Args:
        counts: (k, k) int64 transitions, zero on the diagonal.

    Returns:
        Rows add up to one; NaN in the rows of actions without a successor.
    """
    rows = counts.sum(axis=1).astype(float)
    columns = counts.sum(axis=0).astype(float)
    fitted = (~np.eye(len(counts), dtype=bool)).astype(float) * np.outer(rows > 0, columns > 0)
    for _ in range(_ROUNDS):
        fitted *= np.divide(
            rows, fitted.sum(axis=1), out=np.zeros_like(rows), where=fitted.sum(axis=1) > 0
        )[:, None]
        deviation = np.divide(
            columns, fitted.sum(axis=0), out=np.zeros_like(rows), where=fitted.sum(axis=0) > 0
        )
        fitted *= deviation
        if np.abs(deviation[columns > 0] - 1.0).max(initial=0.0) < 1e-9:
            break
    total = fitted.sum(axis=1, keepdims=True)
    return np.divide(fitted, total, out=np.full_like(fitted, np.nan), where=total > 0)


def _binomial(n: int, total: int, chance: float) -> float:
    """Two-sided p of the exact binomial test; NaN if `chance` is 0 or 1.

    It sums the probabilities of all outcomes that are at most as likely as the observed one, as
    `scipy.stats.binomtest` does. That function is avoided because importing it is slow.
    """
    if total == 0 or not 1e-9 < chance < 1.0 - 1e-9:
        return float("nan")
    from scipy.special import gammaln, xlogy

    k = np.arange(total + 1)
    likely = np.exp(
        gammaln(total + 1)
        - gammaln(k + 1)
        - gammaln(total - k + 1)
        + xlogy(k, chance)
        + xlogy(total - k, 1.0 - chance)
    )
    return min(1.0, float(likely[likely <= likely[n] * (1.0 + _ALIKE)].sum()))


def _first(table: pd.DataFrame, name: str) -> str:
    return str(table[name].iloc[0]) if len(table) else ""


# Peri-event average: median and quartiles of a measure around the onsets of an action.


BEFORE_S = 1.0
AFTER_S = 2.0
_STEPS = 61
_FEWEST = 5  # bouts for quartiles


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

    Values are interpolated linearly between the frames' true times, never across a gap. A bout
    without a value does not count, and a time with fewer than five values is NaN.

    Args:
        kinematics: the table `kinematics`.
        bouts: the table `bouts`.
        action: the action.
        column: the column of `kinematics`.

    Returns:
        From `BEFORE_S` before to `AFTER_S` after the onset; None if there are too few bouts.
    """
    own = bouts.loc[bouts["action"] == action, "start_s"].to_numpy(float)
    if len(own) < _FEWEST:
        return None
    time_s = kinematics["time_s"].to_numpy(float)
    values = kinematics[column].to_numpy(float)
    grid = np.linspace(-BEFORE_S, AFTER_S, _STEPS)
    usual_s = float(np.median(np.diff(time_s), overwrite_input=True))
    quartiles = np.full((3, _STEPS), np.nan)
    for part in blocks(_STEPS, 8):  # a day has tens of thousands of bouts
        wanted = own[:, None] + grid[part]
        after = np.clip(np.searchsorted(time_s, wanted), 1, len(time_s) - 1)
        span = time_s[after] - time_s[after - 1]
        share = np.divide(
            wanted - time_s[after - 1], span, out=np.zeros_like(wanted), where=span > 0
        )
        found = values[after - 1] + share * (values[after] - values[after - 1])
        inside = (span <= GAP_FACTOR * usual_s) & (wanted >= time_s[0])
        found = np.where(inside & (wanted <= time_s[-1]), found, np.nan)
        enough = np.isfinite(found).sum(axis=0) >= _FEWEST
        quartiles[:, part][:, enough] = np.nanpercentile(
            found[:, enough], [25.0, 50.0, 75.0], axis=0
        )
    low, median, high = quartiles
    known = np.isfinite(median).any()
    return Around(grid, low, median, high, len(own)) if known else None


# Position of the animal: zone visits, thigmotaxis (outer half of an open field), novel tank test.


@dataclass(frozen=True)
class Surroundings:
    """The animal's surroundings.

    Attributes:
        arena: shape of the arena.
        zones: names of the zones.
        surface_z_mm: height of the water's surface above the floor, mm; None if absent or unknown.
        seams: frame indices of the camera at which a person's exchange of head and tail begins or
            ends; nothing is measured across one, as across a gap.
        light: the room's light; None if unknown.
    """

    arena: Arena = UNKNOWN
    zones: Sequence[str] = field(default=())
    surface_z_mm: float | None = None
    seams: Sequence[int] = field(default=())
    light: Light | None = None


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
        least = rules.merge_pauses_s, rules.min_bout_s
        stays = list(tidy(here, observed, number, time_s, stop_s, *least))
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
    words = frames["zone"].astype("category").cat
    names = [set(text.split(SEPARATOR)) for text in words.categories]
    return [np.array([zone in one for one in names])[words.codes] for zone in zones]


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
        return np.asarray(self.time_s / (np.outer(np.diff(self.y_mm), np.diff(self.x_mm)) / 100.0))


def hold_times(time_s: ArrayLike) -> Array:
    """(n,) duration of each frame, s: until the next; a median step before a gap or at the end."""
    time = np.asarray(time_s, float)
    return np.asarray(stop_times(time) - time)


def occupancy(
    xy_mm: ArrayLike,
    hold_s: ArrayLike,
    low_mm: ArrayLike,
    high_mm: ArrayLike,
    sd_mm: float = 10.0,  # of the kernel: about half a mouse's width
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
    hold = np.asarray(hold_s, float)
    low = np.fmin(np.asarray(low_mm, float), np.fmin.reduce(xy, initial=np.inf))
    high = np.fmax(np.asarray(high_mm, float), np.fmax.reduce(xy, initial=-np.inf))
    # along a side; larger floors have larger cells
    cell = max(5.0, float((high - low).max()) / 400)
    edges = [
        a + cell * np.arange(max(int(np.ceil((b - a) / cell)), 1) + 1)
        for a, b in zip(low, high, strict=True)
    ]
    counted = np.zeros((len(edges[1]) - 1, len(edges[0]) - 1))
    for rows in blocks(len(xy), _BLOCK):
        some = known[rows]
        x, y = xy[rows][some].T
        counted += np.histogram2d(y, x, [edges[1], edges[0]], weights=hold[rows][some])[0]
    if sd_mm > 0:
        counted = gaussian_filter(counted, sd_mm / cell, mode="reflect")
    return Occupancy(np.asarray(counted, float), edges[0], edges[1], int(known.sum()))
