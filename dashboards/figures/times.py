"""Figures of one animal over time and by action: ethogram, curves, budgets, distributions."""

from itertools import pairwise

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import FancyArrowPatch, Rectangle

from liex_lab.actions.vocabulary import PREDICTED_ERROR, UNLABELLED_COLOUR, action_colours
from liex_lab.arrays import Array, NDArray
from liex_lab.behaviour.activity import Around, around_onsets
from liex_lab.behaviour.body import DrawnMeasure, drawn_measures

from ..units import counted, shown
from .animals import SessionAnimal
from .style import (
    BLUE,
    INK,
    LEFT_MM,
    LINE,
    MUTED,
    ONE_COLUMN_MM,
    PAPER,
    RIGHT_MM,
    SOFT,
    TWO_COLUMNS_MM,
    action_key,
    draw_spans,
    halo,
    heading,
    key_rows,
    name_rows,
    one_panel,
    panel,
    sheet,
    time_unit,
)

_MOST_COLUMNS = 1200  # of a curve; more points cannot be distinguished on a page
_CURVE_MM = 17.0
_MOST_EVENTS = 12  # names of events
_SMALL_BOX = (12.0, 9.0, ONE_COLUMN_MM - 17.0, 33.0)
_BESIDE_S = 0.2  # margin of a stretch, so that its curves reach its ends


Span = tuple[float, float]


def drawn_curves(animal: SessionAnimal) -> list[DrawnMeasure]:
    """The curves of the animal that its session contains."""
    moved = animal.kinematics
    curves = [] if moved is None else drawn_measures(animal.session.metadata["animal"])
    return [one for one in curves if moved is not None and one.column in moved]


def ethogram(animal: SessionAnimal, span_s: Span | None = None) -> Figure | None:
    """A lane for each action, hatched without a pose; None without actions and losses.

    Args:
        animal: the animal.
        span_s: the displayed stretch, s; None shows the whole session.
    """
    first_s, last_s = span_s or (0.0, animal.duration_s)
    words = animal.words
    if not words and not len(animal.lost_s):
        return None
    height = 4.0 * max(len(words), 1)  # a lane's height, mm
    width, bouts = TWO_COLUMNS_MM - LEFT_MM - RIGHT_MM, animal.bouts
    figure, axes = one_panel(
        (TWO_COLUMNS_MM, height + 15.0),
        (LEFT_MM, 8.0, width, height),
        f"Ethogram, {animal.label}, n = {counted(len(bouts), 'bout')}; hatched: no pose or no "
        "frame",
    )
    _, size = time_unit(last_s - first_s)
    # bouts closer than 0.05 mm on paper are one bar
    hair_s = 0.05 * (last_s - first_s) / width

    def draw(spans: Array, row: tuple[float, float], gid: str, colour: str = "") -> None:
        draw_spans(
            axes,
            spans[(spans[:, 1] >= first_s) & (spans[:, 0] <= last_s)],
            row,
            size,
            hair_s,
            colour,
            gid=gid,
        )

    draw(animal.lost_s, (-0.5, max(len(words), 1)), "no pose")
    for k, (word, colour) in enumerate(action_colours(words).items()):
        draw(
            bouts.loc[bouts["action"] == word, ["start_s", "stop_s"]].to_numpy(float),
            (k - 0.38, 0.76),
            f"bouts of {word}",
            colour,
        )
    name_rows(axes, [word.replace("_", " ") for word in words], least=1)
    _clock(axes, (first_s, last_s))
    return figure


def curves(
    animal: SessionAnimal, span_s: Span | None = None, width_mm: float = TWO_COLUMNS_MM
) -> Figure | None:
    """The measures and the expected error over time; None without any pose.

    Args:
        animal: the animal.
        span_s: the displayed stretch, s; None shows the whole session.
        width_mm: width of the figure, mm.
    """
    first_s, last_s = span_s or (0.0, animal.duration_s)
    error = animal.frames["predicted_error_mm"]
    time_s = animal.frames["time_s"].to_numpy(float)
    near = slice(*np.searchsorted(time_s, [first_s - _BESIDE_S, last_s + _BESIDE_S]))
    rows: list[tuple[str, str, Array, Array, str, float | None]] = []
    n_known: list[int] = []

    def add(title: str, unit: str, values: Array, colour: str, from_zero: bool) -> None:
        """Keep what is drawn of a curve."""
        kept = kept_rows(values[near], _MOST_COLUMNS)
        low = float(np.nanmin(values, initial=0.0)) if from_zero else None
        rows.append((title, unit, time_s[near][kept], values[near][kept], colour, low))
        n_known.append(int(np.isfinite(values).sum()))

    for one in drawn_curves(animal):
        values, unit = shown(animal.column(one.column), one.unit)
        add(f"{one.title} {one.what}", unit, values, one.colour, one.from_zero)
    if error.notna().any():
        add("Predicted error of a joint", "mm", animal.broken(error), PREDICTED_ERROR, True)
    if not any(n_known):
        return None
    n = int(error.notna().sum() or n_known[0])
    step = _CURVE_MM + 6.0
    figure = sheet(width_mm, len(rows) * step + 8.0)
    width = width_mm - LEFT_MM - RIGHT_MM
    _, size = time_unit(last_s - first_s)
    rears = animal.bouts.loc[
        animal.bouts["action"].astype(str).str.startswith("rear"), ["start_s", "stop_s", "action"]
    ].to_numpy()
    colours = action_colours(animal.words)
    for k, (title, unit, at_s, values, colour, low) in enumerate(rows):
        axes = panel(figure, LEFT_MM, 8.0 + (len(rows) - 1 - k) * step, width, _CURVE_MM)
        if " height above the floor" in title and len(rears):
            title += "; rearing shaded"
            for a, b, word in rears:
                axes.axvspan(
                    a / size,
                    b / size,
                    color=colours.get(str(word), MUTED),
                    alpha=0.3,
                    linewidth=0.0,
                )
        axes.set_title(
            f"{title}, {animal.label}, n = {counted(n, 'frame')}" if k == 0 else title, size=6.5
        )
        # a marker for each value of a short stretch
        marker = "" if span_s is None or len(values) > 600 else "o"
        axes.plot(at_s / size, values, color=colour, marker=marker, markersize=1)
        axes.set(ylabel=unit, ylim=(low, None))
        axes.grid(axis="y", color=LINE, linewidth=0.4)
        _clock(axes, (first_s, last_s), last=k == len(rows) - 1)
    return figure


def cumulative_distance(animal: SessionAnimal) -> Figure | None:
    """The cumulative distance of the animal; None without a known step."""
    if not np.isfinite(animal.column("step_mm")).any():
        return None
    time_s, metres, n = walked(animal)
    _, size = time_unit(animal.duration_s)
    title = f"Cumulative distance, {animal.label}\n{metres[-1]:.2f} m, n = {counted(n, 'frame')}"
    figure, axes = one_panel((ONE_COLUMN_MM, 52.0), _SMALL_BOX, title)
    rows = kept_rows(metres, _MOST_COLUMNS)
    axes.plot(time_s[rows] / size, metres[rows], color=BLUE, linewidth=1.0)
    axes.set(ylabel="distance, m", ylim=(0.0, None))
    _clock(axes, (0.0, animal.duration_s))
    return figure


def walked(animal: SessionAnimal) -> tuple[Array, Array, int]:
    """Times (n,) s, cumulative distance (n,) m, and the number of frames with a speed.

    The animal must have kinematics.
    """
    assert animal.kinematics is not None
    step = animal.kinematics["step_mm"].to_numpy(float)
    return (
        animal.kinematics["time_s"].to_numpy(float),
        np.cumsum(np.nan_to_num(step)) / 1000.0,
        int(np.isfinite(step).sum()),
    )


def speed_distribution(animal: SessionAnimal) -> Figure | None:
    """Share of the observed time at each speed; None if unknown."""
    if animal.kinematics is None or "speed_mm_s" not in animal.kinematics:
        return None
    values, unit = shown(animal.kinematics["speed_mm_s"].to_numpy(float), "mm/s")
    return distribution("Speed", animal, values, animal.hold_s, unit, BLUE)


def error_distribution(animal: SessionAnimal) -> Figure | None:
    """Share of the observed time at each predicted error; None if unknown."""
    values = animal.frames["predicted_error_mm"].to_numpy(float)
    return distribution(
        "Predicted error of a joint",
        animal,
        values,
        animal.hold_s,
        "mm",
        PREDICTED_ERROR,
    )


def clock_residuals(animal: SessionAnimal) -> Figure | None:
    """Residuals of the events that both clocks recorded, over time; None without another clock."""
    found = animal.session.metadata.get("sync")
    if not found:
        return None
    time_s, residual_ms = np.reshape(np.array(found["residuals"], float), (-1, 2)).T
    width = TWO_COLUMNS_MM - LEFT_MM - RIGHT_MM
    figure, axes = one_panel(
        (TWO_COLUMNS_MM, 37.0),
        (LEFT_MM, 8.0, width, 22.0),
        f"Clock of {found['name']}, n = {counted(found['n_matched'], 'event')}, residual "
        f"{found['rms_ms']:.2f} ms (RMS)",
    )
    span = min(0.0, *time_s), max(animal.duration_s, *time_s)
    _, size = time_unit(span[1] - span[0])
    axes.axhline(0.0, color=MUTED, linewidth=0.5)
    axes.plot(time_s / size, residual_ms, ".", color=BLUE, markersize=2.5, gid="residuals")
    axes.set_ylabel("residual, ms")
    _clock(axes, span)
    return figure


def distribution(
    title: str, animal: SessionAnimal, values: Array, hold_s: Array, unit: str, colour: str
) -> Figure | None:
    """Histogram of values over the range of 99 % of them; a line marks the median.

    Args:
        title: name of the values.
        animal: the animal.
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
    if not known.all():  # copies of a day are large
        values, hold_s = values[known], hold_s[known]
    median, most = (float(one) for one in np.quantile(values, [0.5, 0.99]))
    top = max(most, 1e-6)
    share, edges = np.histogram(np.minimum(values, top), bins=30, range=(0.0, top), weights=hold_s)
    share = 100.0 * share / max(share.sum(), 1e-9)
    title = f"{title}, {animal.label}\nn = {counted(len(values), 'frame')}"
    figure, axes = one_panel((ONE_COLUMN_MM, 52.0), _SMALL_BOX, title)
    axes.bar(edges[:-1], share, np.diff(edges), align="edge", color=colour, gid="distribution")
    axes.axvline(median, color=INK, linewidth=0.7, linestyle=(0, (3, 2)))
    right = median > 0.6 * top
    label = axes.annotate(
        f"median {median:.2f} {unit}",
        (median, 0.96),
        (-3 if right else 3, 0),
        xycoords=("data", "axes fraction"),
        textcoords="offset points",
        ha="right" if right else "left",
        va="top",
        size=6.0,
    )
    halo(label)
    axes.set(xlim=(0.0, top), xlabel=unit, ylabel="share of the time, %")
    return figure


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


# By action

CERTAIN = 0.05  # level of the corrected p
_BESIDE = 4  # panels per row


def time_budget(animal: SessionAnimal) -> Figure | None:
    """Share of the observed time in each action and unlabelled; None without actions."""
    row = animal.summary
    colours = {**action_colours(animal.words), "unlabelled": UNLABELLED_COLOUR}
    words = [word for word in colours if row is not None and f"{word}_share" in row]
    if row is None or not words or not np.isfinite([row[f"{word}_share"] for word in words]).any():
        return None
    shares = np.nan_to_num([100.0 * float(row[f"{word}_share"]) for word in words])
    n_bouts = [int(row[f"{word}_count"]) if f"{word}_count" in row else None for word in words]
    figure, axes = one_panel(
        (ONE_COLUMN_MM, 4.0 * len(words) + 22.0),
        (LEFT_MM, 9.0, ONE_COLUMN_MM - LEFT_MM - 12.0, 4.0 * len(words)),
    )
    heading(figure, f"Time budget, {animal.label}\nn = {counted(len(animal.bouts), 'bout')}")
    axes.barh(range(len(words)), shares, 0.76, color=[colours[word] for word in words])
    for k, (share, n) in enumerate(zip(shares, n_bouts, strict=True)):
        axes.annotate(
            "" if n is None else f"n = {n}",
            (share, k),
            (2, 0),
            textcoords="offset points",
            va="center",
            size=5.5,
            color=MUTED,
        )
    name_rows(axes, [word.replace("_", " ") for word in words])
    axes.set(
        xlim=(0.0, max(1.05 * float(shares.max()), 1.0)), xlabel="share of the observed time, %"
    )
    return figure


def activity(animal: SessionAnimal) -> Figure | None:
    """Stacked shares of the observed time in each action per interval; None without actions.

    Sessions of schema 7 and earlier counted lost frames in bouts; their shares are scaled to one.
    """
    table = animal.table("activity")
    if table is None or not len(table):
        return None
    colours = action_colours(animal.words)
    words = [word for word in colours if f"{word}_s" in table]
    start, stop, observed = (
        table[name].to_numpy(float) for name in ("start_s", "stop_s", "observed_s")
    )
    if not words or not observed.sum() > 0:
        return None
    unit, size = time_unit(float(stop[-1]))
    spent = {word: table[f"{word}_s"].to_numpy(float) for word in words}
    total = np.maximum(observed, np.sum([*spent.values()], axis=0))
    spent["unlabelled"] = total - np.sum([*spent.values()], axis=0)
    colours["unlabelled"] = UNLABELLED_COLOUR
    present = [word for word, seconds in spent.items() if seconds.sum() > 1e-6]
    low = 9.0 + 4.0 * key_rows(present)
    figure, axes = one_panel(
        (TWO_COLUMNS_MM, low + 31.0),
        (LEFT_MM, low, TWO_COLUMNS_MM - LEFT_MM - RIGHT_MM, 23.0),
        f"Shares over the session, {animal.label}, n = {counted(len(table), 'interval')} of "
        f"{stop[0] - start[0]:.3g} s",
    )
    below = np.zeros(len(table))
    for word, seconds in spent.items():
        share = np.divide(seconds, total, out=np.zeros(len(table)), where=observed > 0)
        if share.any():
            axes.bar(
                start / size,
                100.0 * share,
                0.985 * (stop - start) / size,
                100.0 * below,
                align="edge",
                color=colours[word],
                gid=f"share of {word}",
            )
        below += share
    axes.set(xlim=(0.0, float(stop[-1]) / size), ylim=(0.0, 100.0))
    axes.set(xlabel=f"time, {unit}", ylabel="%")
    action_key(figure, {word: colours[word] for word in present})
    return figure


def transitions(animal: SessionAnimal) -> Figure | None:
    """Transitions as matrix and graph, compared with chance; None with fewer than two actions."""
    table = animal.table("transitions")
    if table is None:
        return None
    words = [
        word
        for word in animal.words
        if (table.loc[table["from_action"] == word, "n_from"] > 0).any()
        or (table.loc[table["to_action"] == word, "n"] > 0).any()
    ]
    if len(words) < 2:
        return None
    found = {  # (k, k) from the row's word to the column's; NaN if absent
        name: table.pivot(index="from_action", columns="to_action", values=name)
        .reindex(index=words, columns=words)
        .to_numpy(float)
        for name in ("n", "probability", "by_chance", "p_fdr")
    }
    side = min(68.0, 16.0 * len(words))
    wide = 68.0
    figure = sheet(TWO_COLUMNS_MM, wide + 14.0 + (18.0 if side == wide else 0.0))
    _matrix(panel(figure, LEFT_MM - 1.0, 4.0 + 0.4 * (wide - side), side, side), words, found)
    left = LEFT_MM + wide + 2.0  # as wide as possible, for the names around the circle
    _graph(
        panel(figure, left, 4.0, TWO_COLUMNS_MM - 1.0 - left, wide - 6.0),
        words,
        found,
        action_colours(animal.words),
    )
    n = int(np.nansum(found["n"]))
    heading(
        figure,
        f"Transitions, {animal.label}, n = {counted(n, 'transition')}; percentage of transitions "
        "out of each row\n(in brackets: expected by chance); blue: more, orange: less often than "
        f"chance (corrected p ≤ {CERTAIN:g})",
    )
    return figure


def _against_chance(found: dict[str, Array], i: int, j: int) -> str:
    """The colour of a pair: significantly more or less often than chance, or neither."""
    if not found["p_fdr"][i, j] <= CERTAIN:
        return MUTED
    # less often
    return BLUE if found["probability"][i, j] > found["by_chance"][i, j] else "#d55e00"


def _matrix(axes: Axes, words: list[str], found: dict[str, Array]) -> None:
    """A square for each pair, with opacity by probability, and share and chance in %."""
    k = len(words)
    small = 5.5 if k <= 7 else 4.2
    for (i, j), p in np.ndenumerate(found["probability"]):
        known = i != j and np.isfinite(p)
        fill = (_against_chance(found, i, j), 0.05 + 0.5 * p) if known else SOFT
        axes.add_patch(Rectangle((j - 0.47, i - 0.47), 0.94, 0.94, facecolor=fill, linewidth=0.0))
        if known:
            axes.text(
                j,
                i,
                f"{100 * p:.0f}\n({100 * found['by_chance'][i, j]:.0f})",
                ha="center",
                va="center",
                size=small,
                linespacing=1.25,
            )
    names = [word.replace("_", " ") for word in words]
    counts = np.nansum(found["n"], axis=1).astype(int)
    axes.set(xlim=(-0.5, k - 0.5), ylim=(k - 0.5, -0.5))
    axes.set_yticks(
        range(k), [f"{name}\nn = {n}" for name, n in zip(names, counts, strict=True)], size=5.5
    )
    axes.set_xticks(range(k), names, rotation=40, ha="left", size=5.5)
    axes.tick_params(length=0, top=False, labeltop=True, bottom=False, labelbottom=False)
    axes.spines[:].set_visible(False)


def _graph(axes: Axes, words: list[str], found: dict[str, Array], colours: dict[str, str]) -> None:
    """Actions on a circle, with area by frequency; arrows with width by probability."""
    k = len(words)
    angle = np.pi / 2 - 2.0 * np.pi * np.arange(k) / k
    place = np.column_stack([np.cos(angle), np.sin(angle)])
    counts = np.nansum(found["n"], axis=1) + np.nansum(found["n"], axis=0)
    size = 40.0 + 260.0 * counts / max(float(counts.max()), 1.0)
    for (i, j), p in np.ndenumerate(found["probability"]):
        if i != j and found["n"][i, j] > 0:
            arrow = FancyArrowPatch(
                (place[i, 0], place[i, 1]),
                (place[j, 0], place[j, 1]),
                connectionstyle="arc3,rad=0.14",
                arrowstyle="-|>",
                mutation_scale=4.0 + 4.0 * p,
                shrinkA=0.55 * np.sqrt(size[i]),
                shrinkB=0.55 * np.sqrt(size[j]),
                linewidth=0.3 + 3.0 * p,
                color=_against_chance(found, i, j),
                alpha=0.85,
            )
            axes.add_patch(arrow)
    axes.scatter(
        place[:, 0],
        place[:, 1],
        s=size,
        c=[colours[word] for word in words],
        edgecolors=PAPER,
        zorder=3,
    )
    for word, (x, y) in zip(words, place, strict=True):
        text = word.replace("_", " ")
        across = "left" if x > 0.1 else "right" if x < -0.1 else "center"
        axes.text(
            1.14 * x,
            1.14 * y,
            text,
            ha=across,
            va="bottom" if y > 0.1 else "top" if y < -0.1 else "center",
            size=6.0,
        )
    axes.set(xlim=(-1.96, 1.96), ylim=(-1.41, 1.41), aspect="equal")
    axes.set_axis_off()


def aligned_curves(animal: SessionAnimal) -> Figure | None:
    """Median and quartiles of measures around the onsets of actions; None with too few bouts."""
    colours = action_colours(animal.words)
    rows = _onsets(animal, animal.bouts, list(colours))
    return _aligned(animal, rows, colours, ("the onsets", "the bouts"))


def event_curves(animal: SessionAnimal) -> Figure | None:
    """The same around events of another instrument; None with too few of each name."""
    rows = around_events(animal)
    colours = dict.fromkeys([word for _, _, word, _ in rows], BLUE)
    return _aligned(animal, rows, colours, ("the events", "the events"))


def around_events(animal: SessionAnimal) -> list[tuple[str, str, str, Around]]:
    """Measure, unit, event and curves, in the displayed unit, of every event with enough of it."""
    events = animal.table("events")
    if events is None:
        return []
    named = events.rename(columns={"event": "action", "time_s": "start_s"})
    return _onsets(animal, named, list(named["action"].astype(str).unique()[:_MOST_EVENTS]))


def _aligned(
    animal: SessionAnimal,
    rows: list[tuple[str, str, str, Around]],
    colours: dict[str, str],
    about: tuple[str, str],
) -> Figure | None:
    if not rows:
        return None
    side = (TWO_COLUMNS_MM - 4.0) / _BESIDE
    lines = -(-len(rows) // _BESIDE)
    figure = sheet(TWO_COLUMNS_MM, lines * 33.0 + 9.0)
    top = {
        title: max(float(np.nanmax(one.high)) for other, _, _, one in rows if other == title)
        for title, _, _, _ in rows
    }
    for k, (title, unit, word, one) in enumerate(rows):
        line, column = divmod(k, _BESIDE)
        axes = panel(
            figure, 11.0 + column * side, 9.0 + (lines - 1 - line) * 33.0, side - 13.0, 20.0
        )
        colour = colours[word]
        axes.fill_between(one.time_s, one.low, one.high, color=colour, alpha=0.3, linewidth=0.0)
        axes.plot(one.time_s, one.median, color=colour, linewidth=1.1)
        axes.axvline(0.0, color=INK, linewidth=0.6, linestyle=(0, (3, 2)))
        axes.set(xlim=(one.time_s[0], one.time_s[-1]), ylim=(0.0, 1.05 * top[title] or 1.0))
        axes.grid(axis="y", color=LINE, linewidth=0.4)
        axes.set_title(f"{word.replace('_', ' ')}, n = {one.n}", size=6.5)
        axes.set_ylabel(f"{title.lower()}, {unit}")
        if line == lines - 1 or k + _BESIDE >= len(rows):
            axes.set_xlabel(f"time from {about[0][:-1]}, s")
    heading(figure, f"About {about[0]}, {animal.label}: median and quartiles over {about[1]}")
    return figure


def _onsets(
    animal: SessionAnimal, bouts: pd.DataFrame, words: list[str]
) -> list[tuple[str, str, str, Around]]:
    """(measure, unit, word, curves) of every action with enough bouts, in the displayed unit."""
    found: list[tuple[str, str, str, Around]] = []
    moved = animal.kinematics
    if moved is None:
        return found
    for curve in (
        one
        for one in drawn_curves(animal)
        if one.column in ("speed_mm_s", "nose_height_mm", "tail_beat_hz", "opening")
    ):
        for word in words:
            if curve.column == "nose_height_mm" and word in animal.words and word[:4] != "rear":
                continue  # constant without rearing
            one = around_onsets(moved, bouts, word, curve.column)
            if one is not None:
                low, median, high = (
                    shown(some, curve.unit)[0] for some in (one.low, one.median, one.high)
                )
                found.append(
                    (
                        curve.title,
                        shown(1.0, curve.unit)[1],
                        word,
                        Around(one.time_s, low, median, high, one.n),
                    )
                )
    return found
