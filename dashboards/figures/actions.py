"""Figures that aggregate actions: time budget, activity, transitions, curves around onsets."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from liex_lab.actions.vocabulary import UNLABELLED_COLOUR, action_colours
from liex_lab.behaviour.activity import Around, around_onsets

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
    SOFT,
    TWO_COLUMNS_MM,
    action_key,
    heading,
    key_rows,
    panel,
    sheet,
    time_unit,
)
from .times import drawn_curves

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

CERTAIN = 0.05  # level of the corrected p
_MORE = BLUE
_LESS = "#d55e00"
_AROUND = ("speed_mm_s", "nose_height_mm", "tail_beat_hz", "opening")
_BESIDE = 4  # panels per row


def time_budget(seen: Seen) -> Figure | None:
    """Share of the observed time in each action and unlabelled; None without actions."""
    row = seen.summary
    colours = {**action_colours(seen.words), "unlabelled": UNLABELLED_COLOUR}
    words = [word for word in colours if row is not None and f"{word}_share" in row]
    if row is None or not words or not np.isfinite([row[f"{word}_share"] for word in words]).any():
        return None
    shares = np.nan_to_num([100.0 * float(row[f"{word}_share"]) for word in words])
    n_bouts = [int(row[f"{word}_count"]) if f"{word}_count" in row else None for word in words]
    figure = sheet(ONE_COLUMN_MM, 4.0 * len(words) + 22.0)
    axes = panel(figure, LEFT_MM, 9.0, ONE_COLUMN_MM - LEFT_MM - 12.0, 4.0 * len(words))
    total = len(seen.bouts)
    heading(figure, f"Time budget, {seen.who}\nn = {counted(total, 'bout')}")
    axes.barh(range(len(words)), shares, 0.76, color=[colours[word] for word in words])
    for k, (share, n) in enumerate(zip(shares, n_bouts, strict=True)):
        count = "" if n is None else f"n = {n}"
        axes.annotate(
            count,
            (share, k),
            (2, 0),
            textcoords="offset points",
            va="center",
            size=5.5,
            color=MUTED,
        )
    axes.set_yticks(range(len(words)), [word.replace("_", " ") for word in words])
    axes.set_ylim(len(words) - 0.5, -0.5)
    axes.tick_params(axis="y", length=0)
    axes.set_xlim(0.0, max(1.05 * float(shares.max()), 1.0))
    axes.set_xlabel("share of the observed time, %")
    return figure


def activity(seen: Seen) -> Figure | None:
    """Stacked shares of the observed time in each action per interval; None without actions.

    Sessions of schema 7 and earlier counted lost frames in bouts; their shares are scaled to one.
    """
    table = seen.table("activity")
    if table is None or not len(table):
        return None
    colours = action_colours(seen.words)
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
    seen_words = [word for word, seconds in spent.items() if seconds.sum() > 1e-6]
    low = 9.0 + 4.0 * key_rows(seen_words)
    figure = sheet(TWO_COLUMNS_MM, low + 31.0)
    axes = panel(figure, LEFT_MM, low, TWO_COLUMNS_MM - LEFT_MM - RIGHT_MM, 23.0)
    axes.set_title(
        f"Shares over the session, {seen.who}, n = {counted(len(table), 'interval')} of "
        f"{stop[0] - start[0]:.3g} s"
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
    axes.set_xlim(0.0, float(stop[-1]) / size)
    axes.set_ylim(0.0, 100.0)
    axes.set_ylabel("%")
    axes.set_xlabel(f"time, {unit}")
    action_key(figure, {word: colours[word] for word in seen_words})
    return figure


def transitions(seen: Seen) -> Figure | None:
    """Transitions as matrix and graph, compared with chance; None with fewer than two actions."""
    table = seen.table("transitions")
    if table is None:
        return None
    words = [
        word
        for word in seen.words
        if (table.loc[table["from_action"] == word, "n_from"] > 0).any()
        or (table.loc[table["to_action"] == word, "n"] > 0).any()
    ]
    if len(words) < 2:
        return None
    found = {
        name: _spread(table, words, name) for name in ("n", "probability", "by_chance", "p_fdr")
    }
    side = min(68.0, 16.0 * len(words))
    wide = 68.0
    figure = sheet(TWO_COLUMNS_MM, wide + 14.0 + (18.0 if side == wide else 0.0))
    _matrix(panel(figure, LEFT_MM - 1.0, 4.0 + 0.4 * (wide - side), side, side), words, found)
    left = LEFT_MM + wide + 2.0  # as wide as possible, for the names around the circle
    graph = panel(figure, left, 4.0, TWO_COLUMNS_MM - 1.0 - left, wide - 6.0)
    _graph(graph, words, found, action_colours(seen.words))
    n = int(np.nansum(found["n"]))
    heading(
        figure,
        f"Transitions, {seen.who}, n = {counted(n, 'transition')}; percentage of transitions out "
        "of each row\n(in brackets: expected by chance); blue: more, orange: less often than "
        f"chance (corrected p ≤ {CERTAIN:g})",
    )
    return figure


def _spread(table: pd.DataFrame, words: list[str], column: str) -> Array:
    """(k, k) a column of the transitions, from the row's word to the column's; NaN if absent."""
    place = {word: k for k, word in enumerate(words)}
    own = table[table["from_action"].isin(words) & table["to_action"].isin(words)]
    out = np.full((len(words), len(words)), np.nan)
    at = own["from_action"].map(place).to_numpy(int), own["to_action"].map(place).to_numpy(int)
    out[at] = own[column].to_numpy(float)
    return out


def _against_chance(found: dict[str, Array], i: int, j: int) -> str:
    """The colour of a pair: significantly more or less often than chance, or neither."""
    if not found["p_fdr"][i, j] <= CERTAIN:
        return MUTED
    return _MORE if found["probability"][i, j] > found["by_chance"][i, j] else _LESS


def _matrix(axes: Axes, words: list[str], found: dict[str, Array]) -> None:
    """A square for each pair, with opacity by probability, and share and chance in %."""
    from matplotlib.patches import Rectangle

    k = len(words)
    small = 5.5 if k <= 7 else 4.2
    for i in range(k):
        for j in range(k):
            p = found["probability"][i, j]
            corner = (j - 0.47, i - 0.47)
            if i == j or not np.isfinite(p):
                axes.add_patch(Rectangle(corner, 0.94, 0.94, facecolor=SOFT, linewidth=0.0))
                continue
            colour = _against_chance(found, i, j)
            axes.add_patch(
                Rectangle(corner, 0.94, 0.94, facecolor=colour, alpha=0.05 + 0.5 * p, linewidth=0.0)
            )
            text = f"{100 * p:.0f}\n({100 * found['by_chance'][i, j]:.0f})"
            axes.text(j, i, text, ha="center", va="center", size=small, linespacing=1.25)
    names = [word.replace("_", " ") for word in words]
    counts = np.nansum(found["n"], axis=1).astype(int)
    axes.set_xlim(-0.5, k - 0.5)
    axes.set_ylim(k - 0.5, -0.5)
    axes.set_yticks(
        range(k), [f"{name}\nn = {n}" for name, n in zip(names, counts, strict=True)], size=5.5
    )
    axes.set_xticks(range(k), names, rotation=40, ha="left", size=5.5)
    axes.tick_params(length=0, top=False, labeltop=True, bottom=False, labelbottom=False)
    for spine in axes.spines.values():
        spine.set_visible(False)


def _graph(axes: Axes, words: list[str], found: dict[str, Array], colours: dict[str, str]) -> None:
    """Actions on a circle, with area by frequency; arrows with width by probability."""
    from matplotlib.patches import FancyArrowPatch

    k = len(words)
    angle = np.pi / 2 - 2.0 * np.pi * np.arange(k) / k
    place = np.column_stack([np.cos(angle), np.sin(angle)])
    counts = np.nansum(found["n"], axis=1) + np.nansum(found["n"], axis=0)
    size = 40.0 + 260.0 * counts / max(float(counts.max()), 1.0)
    for i in range(k):
        for j in range(k):
            p = found["probability"][i, j]
            if i == j or not found["n"][i, j] > 0:
                continue
            axes.add_patch(
                FancyArrowPatch(
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
            )
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
        up = "bottom" if y > 0.1 else "top" if y < -0.1 else "center"
        axes.text(1.14 * x, 1.14 * y, text, ha=across, va=up, size=6.0)
    axes.set_xlim(-1.96, 1.96)
    axes.set_ylim(-1.41, 1.41)
    axes.set_aspect("equal")
    axes.set_axis_off()


def aligned_curves(seen: Seen) -> Figure | None:
    """Median and quartiles of measures around the onsets of actions; None with too few bouts."""
    rows = _onsets(seen)
    if not rows:
        return None
    colours = action_colours(seen.words)
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
        axes.set_xlim(float(one.time_s[0]), float(one.time_s[-1]))
        axes.set_ylim(0.0, 1.05 * top[title] or 1.0)
        axes.grid(axis="y", color=LINE, linewidth=0.4)
        axes.set_title(f"{word.replace('_', ' ')}, n = {one.n}", size=6.5)
        axes.set_ylabel(f"{title.lower()}, {unit}")
        if line == lines - 1 or k + _BESIDE >= len(rows):
            axes.set_xlabel("time from the onset, s")
    heading(figure, f"About the onsets, {seen.who}: median and quartiles over the bouts")
    return figure


def _onsets(seen: Seen) -> list[tuple[str, str, str, Around]]:
    """(measure, unit, word, curves) of every action with enough bouts, in the displayed unit."""
    moved = seen.kinematics
    found: list[tuple[str, str, str, Around]] = []
    for curve in drawn_curves(seen) if moved is not None else ():
        name, title, unit = curve.column, curve.title, curve.unit
        if name not in _AROUND or moved is None:
            continue
        for word in seen.words:
            if name == "nose_height_mm" and not word.startswith("rear"):
                continue  # constant without rearing
            one = around_onsets(moved, seen.bouts, word, name)
            if one is not None:
                low, median, high = (
                    shown(some, unit)[0] for some in (one.low, one.median, one.high)
                )
                found.append(
                    (title, shown(1.0, unit)[1], word, Around(one.time_s, low, median, high, one.n))
                )
    return found
