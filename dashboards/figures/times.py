"""Figures over time: ethogram, curves, cumulative distance; distributions of speeds and errors."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from liex_lab.actions.vocabulary import PREDICTED_ERROR, action_colours
from liex_lab.behaviour.body import DrawnMeasure, drawn_measures

from ..units import counted, shown
from .seen import Array, Seen
from .style import (
    BLUE,
    INK,
    LEFT_MM,
    LINE,
    MUTED,
    ONE_COLUMN_MM,
    PAPER,
    RIGHT_MM,
    TWO_COLUMNS_MM,
    halo,
    panel,
    sheet,
    time_unit,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_MOST_COLUMNS = 1200  # of a curve; more points cannot be distinguished on a page
_LANE_MM = 4.0
_CURVE_MM = 17.0
_MOST_DOTS = 600  # frames of a stretch with a marker for each value
_BESIDE_S = 0.2  # margin of a stretch, so that its curves reach its ends
_HAIR_MM = 0.05  # bouts with a smaller distance are one bar


Span = tuple[float, float]


def drawn_curves(seen: Seen) -> list[DrawnMeasure]:
    """The curves of the animal that its session contains."""
    moved = seen.kinematics
    if moved is None:
        return []
    return [one for one in drawn_measures(seen.session.metadata["animal"]) if one.column in moved]


def ethogram(seen: Seen, span_s: Span | None = None) -> Figure | None:
    """A lane for each action, hatched without a pose; None without actions and losses.

    Args:
        seen: the animal.
        span_s: the displayed stretch, s; None shows the whole session.
    """
    first_s, last_s = span_s or (0.0, seen.duration_s)
    words = seen.words
    if not words and not len(seen.lost_s):
        return None
    height = _LANE_MM * max(len(words), 1)
    figure = sheet(TWO_COLUMNS_MM, height + 15.0)
    width = TWO_COLUMNS_MM - LEFT_MM - RIGHT_MM
    axes = panel(figure, LEFT_MM, 8.0, width, height)
    bouts = seen.bouts
    axes.set_title(
        f"Ethogram, {seen.who}, n = {counted(len(bouts), 'bout')}; hatched: no pose or no frame"
    )
    _, size = time_unit(last_s - first_s)
    least = _HAIR_MM * (last_s - first_s) / width

    def within(spans: Array) -> list[Span]:
        near = spans[(spans[:, 1] >= first_s) & (spans[:, 0] <= last_s)]
        return joined([(float(a), float(b)) for a, b in near], least)

    axes.broken_barh(
        [(a / size, (b - a) / size) for a, b in within(seen.lost_s)],
        (-0.5, max(len(words), 1)),
        facecolor=PAPER,  # over the bars: a bout across a gap has no bar there
        edgecolor=MUTED,
        linewidth=0.0,
        hatch="//////",
        zorder=1.5,
        gid="no pose",
    )
    for k, (word, colour) in enumerate(action_colours(words).items()):
        own = bouts.loc[bouts["action"] == word, ["start_s", "stop_s"]].to_numpy(float)
        axes.broken_barh(
            [(a / size, max(b - a, least) / size) for a, b in within(own)],
            (k - 0.38, 0.76),
            facecolor=colour,
            gid=f"bouts of {word}",
        )
    axes.set_ylim(max(len(words), 1) - 0.5, -0.5)
    axes.set_yticks(range(len(words)), [word.replace("_", " ") for word in words])
    axes.tick_params(axis="y", length=0)
    _clock(axes, (first_s, last_s))
    return figure


def curves(
    seen: Seen, span_s: Span | None = None, width_mm: float = TWO_COLUMNS_MM
) -> Figure | None:
    """The measures and the expected error over time; None without any pose.

    Args:
        seen: the animal.
        span_s: the displayed stretch, s; None shows the whole session.
        width_mm: width of the figure, mm.
    """
    first_s, last_s = span_s or (0.0, seen.duration_s)
    error = seen.broken(seen.frames["predicted_error_mm"])
    n = int(seen.frames["predicted_error_mm"].notna().sum())
    rows: list[tuple[str, str, Array, str, bool]] = []
    for one in drawn_curves(seen):
        values, unit = shown(seen.column(one.column), one.unit)
        rows.append((f"{one.title} {one.what}", unit, values, one.colour, one.from_zero))
    rows.append(("Predicted error of a joint", "mm", error, PREDICTED_ERROR, True))
    if not any(np.isfinite(values).any() for _, _, values, _, _ in rows):
        return None
    step = _CURVE_MM + 6.0
    figure = sheet(width_mm, len(rows) * step + 8.0)
    width = width_mm - LEFT_MM - RIGHT_MM
    time_s = seen.frames["time_s"].to_numpy(float)
    near = slice(*np.searchsorted(time_s, [first_s - _BESIDE_S, last_s + _BESIDE_S]))
    _, size = time_unit(last_s - first_s)
    rearing = seen.bouts["action"].astype(str).str.startswith("rear")
    rears = seen.bouts.loc[rearing, ["start_s", "stop_s", "action"]].to_numpy()
    colours = action_colours(seen.words)
    for k, (title, unit, values, colour, from_zero) in enumerate(rows):
        axes = panel(figure, LEFT_MM, 8.0 + (len(rows) - 1 - k) * step, width, _CURVE_MM)
        if " height above the floor" in title and len(rears):
            title += "; rearing shaded"
            for a, b, word in rears:
                shade = colours.get(str(word), MUTED)
                axes.axvspan(a / size, b / size, color=shade, alpha=0.3, linewidth=0.0)
        axes.set_title(
            f"{title}, {seen.who}, n = {counted(n, 'frame')}" if k == 0 else title, size=6.5
        )
        kept = kept_rows(values[near], _MOST_COLUMNS)
        marker = "" if span_s is None or len(kept) > _MOST_DOTS else "o"
        axes.plot(
            time_s[near][kept] / size, values[near][kept], color=colour, marker=marker, markersize=1
        )
        axes.set_ylabel(unit)
        axes.grid(axis="y", color=LINE, linewidth=0.4)
        _clock(axes, (first_s, last_s), last=k == len(rows) - 1)
        if from_zero:
            axes.set_ylim(bottom=float(np.nanmin(values, initial=0.0)))
    return figure


def cumulative_distance(seen: Seen) -> Figure | None:
    """The cumulative distance of the animal; None without a known step."""
    known = seen.kinematics is not None and np.isfinite(seen.column("step_mm")).any()
    if not known or seen.kinematics is None:
        return None
    time_s, metres, n = walked(seen)
    _, size = time_unit(seen.duration_s)
    figure = sheet(ONE_COLUMN_MM, 52.0)
    axes = panel(figure, 12.0, 9.0, ONE_COLUMN_MM - 17.0, 33.0)
    axes.set_title(
        f"Cumulative distance, {seen.who}\n{metres[-1]:.2f} m, n = {counted(n, 'frame')}"
    )
    rows = kept_rows(metres, _MOST_COLUMNS)
    axes.plot(time_s[rows] / size, metres[rows], color=BLUE, linewidth=1.0)
    axes.set_ylabel("distance, m")
    axes.set_ylim(bottom=0.0)
    _clock(axes, (0.0, seen.duration_s))
    return figure


def walked(seen: Seen) -> tuple[Array, Array, int]:
    """Times (n,) s, cumulative distance (n,) m, and the number of frames with a speed.

    The animal must have kinematics.
    """
    assert seen.kinematics is not None
    step = seen.kinematics["step_mm"].to_numpy(float)
    n = int(np.isfinite(step).sum())
    time_s = seen.kinematics["time_s"].to_numpy(float)
    return time_s, np.cumsum(np.nan_to_num(step)) / 1000.0, n


def speed_distribution(seen: Seen) -> Figure | None:
    """Share of the observed time at each speed; None if unknown."""
    if seen.kinematics is None or "speed_mm_s" not in seen.kinematics:
        return None
    values, unit = shown(seen.kinematics["speed_mm_s"].to_numpy(float), "mm/s")
    return distribution("Speed", seen, values, seen.hold_s, unit, BLUE)


def error_distribution(seen: Seen) -> Figure | None:
    """Share of the observed time at each predicted error; None if unknown."""
    from liex_lab.behaviour.activity import hold_times

    values = seen.frames["predicted_error_mm"].to_numpy(float)
    hold = hold_times(seen.frames["time_s"].to_numpy(float))
    return distribution("Predicted error of a joint", seen, values, hold, "mm", PREDICTED_ERROR)


def distribution(
    title: str, seen: Seen, values: Array, hold_s: Array, unit: str, colour: str
) -> Figure | None:
    """Histogram of values over the range of 99 % of them; a line marks the median.

    Args:
        title: name of the values.
        seen: the animal.
        values: (n,) not negative; NaN is left out, and values above the 99 % quantile count in the
            last bin.
        hold_s: (n,) duration of each, s.
        unit: their unit.
        colour: of the bars.

    Returns:
        The figure; None without a finite value.
    """
    known = np.isfinite(values)
    if not known.any():
        return None
    values = values[known]
    top = max(float(np.quantile(values, 0.99)), 1e-6)
    share, edges = np.histogram(
        np.minimum(values, top), bins=30, range=(0.0, top), weights=hold_s[known]
    )
    share = 100.0 * share / max(share.sum(), 1e-9)
    figure = sheet(ONE_COLUMN_MM, 52.0)
    axes = panel(figure, 12.0, 9.0, ONE_COLUMN_MM - 17.0, 33.0)
    axes.set_title(f"{title}, {seen.who}\nn = {counted(len(values), 'frame')}")
    axes.bar(edges[:-1], share, np.diff(edges), align="edge", color=colour, gid="distribution")
    median = float(np.median(values))
    axes.axvline(median, color=INK, linewidth=0.7, linestyle=(0, (3, 2)))
    right = median > 0.6 * top
    text = axes.annotate(
        f"median {median:.2f} {unit}",
        (median, 0.96),
        (-3 if right else 3, 0),
        xycoords=("data", "axes fraction"),
        textcoords="offset points",
        ha="right" if right else "left",
        va="top",
        size=6.0,
    )
    halo(text)
    axes.set_xlim(0.0, top)
    axes.set_xlabel(unit)
    axes.set_ylabel("share of the time, %")
    return figure


def joined(spans: Sequence[tuple[float, float]], least_s: float) -> list[tuple[float, float]]:
    """Spans in order; spans closer than `least_s` are joined, up to 40 times that length.

    Args:
        spans: start and stop of each, s, in order.
        least_s: least distance of separate spans, s.
    """
    out: list[tuple[float, float]] = []
    for start, stop in spans:
        if out and start - out[-1][1] < least_s and stop - out[-1][0] < 40 * least_s:
            out[-1] = (out[-1][0], stop)
        else:
            out.append((start, stop))
    return out


def kept_rows(y: Array, n_columns: int) -> NDArray[np.int64]:
    """(k,) int64 rows of a curve to draw: all, or each column's minimum and maximum.

    All rows of a short curve are used. A column with an unknown value includes it, so that the gap
    remains visible (min-max decimation).

    Args:
        y: (n,) the curve; NaN where unknown.
        n_columns: columns of the figure; a curve with more than twice as many values is long.
    """
    if len(y) <= 2 * n_columns:
        return np.arange(len(y))
    edges = np.linspace(0, len(y), n_columns + 1).astype(int)
    rows: list[int] = []
    for a, b in pairwise(edges):
        part = y[a:b]
        if np.isfinite(part).all():
            rows += sorted({a + int(part.argmin()), a + int(part.argmax())})
        else:  # keep the gap
            rows += [a, a + int(np.flatnonzero(~np.isfinite(part))[0])]
    return np.array(rows, np.int64)


def _clock(axes: Axes, span_s: Span, last: bool = True) -> None:
    """The time axis, the same for all figures of a session; labels only at the last one."""
    first_s, last_s = span_s
    unit, size = time_unit(last_s - first_s)
    axes.set_xlim(first_s / size, max(last_s, first_s + 1e-3) / size)
    axes.grid(axis="x", color=LINE, linewidth=0.4)
    axes.set_axisbelow(True)
    if last:
        axes.set_xlabel(f"time, {unit}")
    else:
        axes.tick_params(axis="x", labelbottom=False)
