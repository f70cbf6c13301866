"""Figures of several sessions: ethograms, budgets and distances by group, comparisons of
animals.
"""

import textwrap
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from urllib.parse import quote

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from liex_lab.actions.vocabulary import action_colours
from liex_lab.behaviour import cohort, statistics
from liex_lab.behaviour.activity import Occupancy, occupancy
from liex_lab.plan.study import references_first
from liex_lab.sessions import Session

from ..units import counted, read_as, shown, titled
from .animals import Array, SessionAnimal
from .places import aligned, extent_mm, occupancy_panels
from .style import (
    GROUP_COLOURS,
    GROUP_MARKS,
    INK,
    LEFT_MM,
    LINE,
    MUTED,
    ONE_COLUMN_MM,
    RIGHT_MM,
    TWO_COLUMNS_MM,
    action_key,
    draw_spans,
    heading,
    key_rows,
    name_rows,
    one_panel,
    panel,
    sheet,
    time_unit,
)
from .times import around_events, walked

NO_GROUP = "no group"


def by_group(animals: Sequence[SessionAnimal]) -> dict[str, dict[str, list[SessionAnimal]]]:
    """The sessions of each subject of each group, groups in the given order, subjects by name.

    Args:
        animals: animals of sessions, those of the reference group first; one without a subject's
            name is its own subject.
    """
    out: dict[str, dict[str, list[SessionAnimal]]] = {
        animal.group or NO_GROUP: {} for animal in animals
    }
    for animal in sorted(animals, key=lambda one: one.label):
        out[animal.group or NO_GROUP].setdefault(animal.label, []).append(animal)
    return out


def group_colour(name: str, names: Sequence[str]) -> str:
    """The colour of a group among all groups of a study, the reference first."""
    return GROUP_COLOURS[names.index(name) % len(GROUP_COLOURS)]


def ethograms(animals: Sequence[SessionAnimal]) -> Figure | None:
    """A row for each session, in order of group; None if no session has bouts."""
    rows = [
        (group, animal)
        for group, subjects in by_group(animals).items()
        for sessions in subjects.values()
        for animal in sessions
    ]
    n = sum(len(animal.bouts) for animal in animals)
    if not n:
        return None
    words = list(dict.fromkeys(word for _, animal in rows for word in animal.words))
    duration = max(animal.duration_s for animal in animals)
    unit, size = time_unit(duration)
    height = max(3.4 * len(rows), 8.0)
    bottom = 8.0 + 4.0 * key_rows(words)
    width = TWO_COLUMNS_MM - LEFT_MM - RIGHT_MM - 8.0
    figure, axes = one_panel(
        (TWO_COLUMNS_MM, height + bottom + 9.0),
        (LEFT_MM + 8.0, bottom, width, height),
        f"Ethograms, n = {counted(len(rows), 'session')}, {counted(n, 'bout')}",
    )
    colours = action_colours(words)
    hair_s = 0.05 * duration / width
    for k, (_, animal) in enumerate(rows):
        row = (k - 0.42, 0.84)
        draw_spans(axes, animal.lost_s, row, size, hair_s)
        for word in animal.words:
            own = animal.bouts.loc[animal.bouts["action"] == word, ["start_s", "stop_s"]]
            draw_spans(axes, own.to_numpy(float), row, size, hair_s, colours[word])
    name_rows(axes, [f"{animal.session.name} · {group}" for group, animal in rows])
    axes.tick_params(axis="y", labelsize=5.0)
    axes.set(xlim=(0.0, duration / size), xlabel=f"time, {unit}")
    action_key(figure, colours)
    return figure


def occupancy_by_subject(animals: Sequence[SessionAnimal]) -> Figure | None:
    """Heatmaps of every subject, the sum of its sessions; None without a known position."""
    panels = []
    for group, subjects in _occupancies(animals).items():
        for subject, (session, found) in subjects.items():
            panels.append(
                (
                    f"{subject} ({group}), {found.observed_s:.1f} s\n"
                    f"n = {counted(found.n, 'frame')}",
                    session,
                    found,
                )
            )
    return occupancy_panels(f"Occupancy by subject, n = {counted(len(panels), 'subject')}", panels)


def occupancy_by_group(animals: Sequence[SessionAnimal]) -> Figure | None:
    """Heatmaps of every group, with equal weight of its subjects; None without a known position."""
    panels = []
    for group, subjects in _occupancies(animals).items():
        own = [found for _, found in subjects.values() if found.n]
        if own:
            mean = replace(_added(own), time_s=np.mean([found.time_s for found in own], axis=0))
            counts = f"n = {counted(len(own), 'subject')}\nmean of {mean.observed_s:.1f} s each"
            session = next(iter(subjects.values()))[0]
            panels.append((f"{group}, {counts}", session, mean))
    return occupancy_panels(f"Occupancy by group, n = {counted(len(panels), 'group')}", panels)


def budgets_by_group(animals: Sequence[SessionAnimal]) -> Figure | None:
    """Share of the time in each action, by subject and as group means; None without actions."""
    groups = by_group(animals)
    words = list(dict.fromkeys(word for animal in animals for word in animal.words))
    shares = {
        group: np.array([_budget(sessions, words) for sessions in subjects.values()])
        for group, subjects in groups.items()
    }
    if not words or not any(np.isfinite(values).any() for values in shares.values()):
        return None
    height = (2.0 + 3.2 * len(groups)) * len(words)
    figure, axes = one_panel(
        (ONE_COLUMN_MM, height + 16.0 + 4.0 * len(groups)),
        (LEFT_MM, 9.0, ONE_COLUMN_MM - LEFT_MM - RIGHT_MM, height),
    )
    n = sum(len(values) for values in shares.values())
    heading(figure, f"Time budget: every subject, and the mean, n = {counted(n, 'subject')}")
    apart = 0.8 / len(groups)
    for g, (group, values) in enumerate(shares.items()):
        colour = group_colour(group, list(groups))
        at = np.arange(len(words)) + (g - (len(groups) - 1) / 2) * apart
        mean = 100.0 * np.nan_to_num(pd.DataFrame(values).mean())
        axes.barh(
            at,
            mean,
            0.9 * apart,
            color=colour,
            alpha=0.35,
            label=f"{group}, n = {counted(len(values), 'subject')}",
        )
        mark = GROUP_MARKS[g % len(GROUP_MARKS)]
        for one in values:
            axes.plot(100.0 * one, at, mark, color=colour, markersize=2.2, gid=f"subjects {group}")
    name_rows(axes, [word.replace("_", " ") for word in words])
    axes.set(xlim=(0.0, None), xlabel="share of the observed time, %")
    figure.legend(
        loc="upper left", bbox_to_anchor=(0.0, 1.0 - 5.0 / (figure.get_size_inches()[1] * 25.4))
    )
    return figure


def distance_by_group(animals: Sequence[SessionAnimal]) -> Figure | None:
    """Cumulative distance of every session, and each group's mean; None without a known step."""
    groups = by_group(animals)
    walks = {
        group: [
            walked(animal)
            for sessions in subjects.values()
            for animal in sessions
            if animal.kinematics is not None and len(animal.kinematics)
        ]
        for group, subjects in groups.items()
    }
    if not any(n for some in walks.values() for _, _, n in some):
        return None
    duration = max(animal.duration_s for animal in animals)
    unit, size = time_unit(duration)
    lines = [f"{group}, n = {counted(len(some), 'session')}" for group, some in walks.items()]
    figure, axes = one_panel(
        (ONE_COLUMN_MM, 58.0 + 3.5 * len(groups)),
        (12.0, 9.0, ONE_COLUMN_MM - 17.0, 40.0),
        "\n".join(["Cumulative distance: sessions, and the mean", *lines]),
    )
    for group, some in walks.items():
        colour = group_colour(group, list(groups))
        for time_s, metres, _ in some:
            rows = np.unique(np.linspace(0, len(time_s) - 1, min(len(time_s), 400)).astype(int))
            axes.plot(time_s[rows] / size, metres[rows], color=colour, linewidth=0.5, alpha=0.5)
        if known := [one for one in some if one[2]]:
            # the mean ends with the shortest session, or it would drop where a session ends
            grid = np.linspace(0.0, min(float(time_s[-1]) for time_s, _, _ in known), 400)
            mean = np.mean([np.interp(grid, time_s, metres) for time_s, metres, _ in known], axis=0)
            axes.plot(grid / size, mean, color=colour, linewidth=1.5, label=group)
    axes.set(xlabel=f"time, {unit}", ylabel="distance, m")
    axes.set(xlim=(0.0, duration / size), ylim=(0.0, None))
    axes.grid(color=LINE, linewidth=0.4)
    axes.legend(loc="upper left")
    return figure


def events_by_group(animals: Sequence[SessionAnimal]) -> Figure | None:
    """Measures around events of another instrument: every subject, and each group's mean.

    A subject's curve is the mean of its sessions' medians; None without five events of a name.
    """
    groups = by_group(animals)
    found: dict[tuple[str, str, str], dict[str, list[Array]]] = {}
    time_s = np.zeros(0)
    for group, subjects in groups.items():
        for sessions in subjects.values():
            own: dict[tuple[str, str, str], list[Array]] = {}
            for *key, one in (row for animal in sessions for row in around_events(animal)):
                own.setdefault((key[0], key[1], key[2]), []).append(one.median)
                time_s = one.time_s
            for name, medians in own.items():
                found.setdefault(name, {}).setdefault(group, []).append(np.mean(medians, axis=0))
    if not found:
        return None
    line = 41.0 + 4.0 * len(groups)
    figure = sheet(ONE_COLUMN_MM, line * len(found) + 6.0)
    for k, ((title, unit, event), curves) in enumerate(found.items()):
        at = 9.0 + line * (len(found) - 1 - k)
        axes = panel(figure, 12.0, at, ONE_COLUMN_MM - 17.0, 30.0)
        for group, some in curves.items():
            colour = group_colour(group, list(groups))
            for curve in some:
                axes.plot(time_s, curve, color=colour, linewidth=0.5, alpha=0.5)
            label = f"{group}, n = {counted(len(some), 'subject')}"
            axes.plot(time_s, np.mean(some, axis=0), color=colour, linewidth=1.5, label=label)
        axes.axvline(0.0, color=INK, linewidth=0.6, linestyle=(0, (3, 2)))
        axes.set(xlim=(time_s[0], time_s[-1]), ylabel=f"{title.lower()}, {unit}")
        axes.set(ylim=(0.0, None), xlabel="time from the event, s")
        axes.set_title(event.replace("_", " "), size=6.5)
        axes.grid(color=LINE, linewidth=0.4)
        axes.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0))
    heading(figure, "About the events: subjects, and the mean")
    return figure


def comparison(
    table: pd.DataFrame,
    stats: pd.DataFrame,
    measure: str,
    unit: str,
    accounted: str = "",
    link: Callable[[str], str] | None = None,
) -> Figure | None:
    """A measure by group: every session and animal, and the differences with 95 % intervals.

    Args:
        table: one row per session: subject_id, group and the measure, as in the sessions.csv of
            `liex compare`.
        stats: rows of the table `stats`.
        measure: the column to draw.
        unit: its unit in the table; "" if dimensionless.
        accounted: a sentence below the figure on the included and excluded sessions.
        link: the address of a session by its `key`, a column of the table; its mark becomes a link,
            with a description after #. None makes no links.

    Returns:
        The figure; None if no session has a value.
    """
    if measure not in table:
        return None
    known = table.assign(group=table["group"].fillna("").astype(str))
    known = known[np.isfinite(known[measure].astype(float)) & (known["group"] != "")]
    if known.empty:
        return None
    own = stats[stats["measure"] == measure]
    names = list(dict.fromkeys([*own["reference"].head(1), *references_first(known["group"])]))
    factor, read = shown(1.0, unit)
    height = max(42.0, 13.0 * len(own))
    lines = textwrap.wrap(accounted, 150)
    bottom = 13.0 + 2.6 * len(lines)
    figure = sheet(TWO_COLUMNS_MM, height + bottom + 9.0)
    left = panel(figure, 16.0, bottom, 72.0, height)
    counts, n_animals = [], []
    for k, name in enumerate(names):
        rows = known[known["group"] == name]
        n = rows["subject_id"].nunique()
        _strip(left, k, rows, factor * rows[measure].to_numpy(float), names, link)
        n_animals.append(f"{n} {name}")
        counts.append(f"{name}\n{counted(n, 'animal')}, {counted(len(rows), 'session')}")
    left.set_xticks(range(len(names)), counts)
    title = f"{titled(measure, unit)}, n = {', '.join(n_animals[::-1])} (animals)"
    left.set(xlim=(-0.6, len(names) - 0.4), ylabel=read_as(measure, unit), title=title)
    left.grid(axis="y", color=LINE, linewidth=0.4)
    edge = figure.get_size_inches()[1] * 25.4
    figure.text(
        2.0 / TWO_COLUMNS_MM, 2.0 / edge, "\n".join(lines), size=5.5, color=MUTED, va="bottom"
    )
    _differences(panel(figure, 122.0, bottom, 36.0, height), own, factor, read)
    return figure


def effects(stats: pd.DataFrame, units: Mapping[str, str]) -> Figure | None:
    """Hedges' g of every measure and contrast with its interval; None if absent.

    Args:
        stats: the table `stats`.
        units: column of the summary -> its unit.
    """
    known = stats[np.isfinite(stats["effect_size"].astype(float))].reset_index(drop=True)
    if known.empty:
        return None
    figure, axes = one_panel(
        (TWO_COLUMNS_MM, 4.2 * len(known) + 20.0),
        (78.0, 11.0, TWO_COLUMNS_MM - 84.0, 4.2 * len(known)),
    )
    _intervals(axes, known, "effect_size", "effect_low", "effect_high", 1.0)
    axes.set_yticks(
        range(len(known)),
        [
            f"{titled(str(row['measure']), units.get(str(row['measure']), ''))}: "
            f"{row['contrast']}, n = {cohort.counted_units(row)}"
            for row in known.to_dict("records")
        ],
        size=5.5,
    )
    heading(figure, f"Effect sizes, n = {counted(len(known), 'comparison')}")
    axes.set(
        ylim=(len(known) - 0.5, -0.5), xlabel="Hedges' g with its 95 % interval; hollow: no test"
    )
    return figure


def _strip(
    axes: Axes,
    k: int,
    rows: pd.DataFrame,
    values: Array,
    names: Sequence[str],
    link: Callable[[str], str] | None,
) -> None:
    """One group: a small mark per session, a large one per animal, a line at the animals' mean."""
    animal, names_of = pd.factorize(rows["subject_id"].astype(str))
    means = statistics.animal_means(values, animal)
    beside = np.linspace(-0.2, 0.2, len(names_of)) if len(names_of) > 1 else np.zeros(1)
    colour, mark = group_colour(names[k], names), GROUP_MARKS[k % len(GROUP_MARKS)]
    large = axes.scatter(
        k + beside, means, 20.0, colour, marker=mark, gid=f"animals {names[k]}", zorder=3
    )
    small = None
    if len(values) > len(names_of):  # else the sessions are the animals
        small = axes.scatter(
            k + beside[animal] + 0.03, values, 4.0, colour, marker=mark, alpha=0.5, zorder=2
        )
    if link is not None:
        keys = rows["key"].astype(str)
        of_animals = zip(
            keys.groupby(animal).first(),
            names_of,
            [counted(int(n), "session") for n in np.bincount(animal)],
            means,
            strict=True,
        )
        large.set_urls(
            [
                link(key) + quote(f"#animal {subject}, {n}: {mean:.4g}", "#")
                for key, subject, n, mean in of_animals
            ]
        )
        if small is not None:
            each = zip(keys, values, strict=True)
            small.set_urls([link(key) + quote(f"#{key}: {value:.4g}", "#") for key, value in each])
    axes.plot(
        [k - 0.3, k + 0.3], [means.mean()] * 2, color=INK, linewidth=1.2, gid=f"mean {names[k]}"
    )


def _differences(axes: Axes, own: pd.DataFrame, factor: float, unit: str) -> None:
    """Each contrast's difference with its interval, effect size and n, or "no test"."""
    known = own[np.isfinite(own["estimate"].astype(float))].reset_index(drop=True)
    if known.empty:
        axes.set_axis_off()
        axes.text(0.0, 0.5, "no difference can be given", transform=axes.transAxes)
        return
    _intervals(axes, known, "estimate", "ci_low", "ci_high", factor)
    rows = known.to_dict("records")
    for k, row in enumerate(rows):
        g = f"g {row['effect_size']:.2f}" if np.isfinite(row["effect_size"]) else "no g"
        p = f"p {row['p']:.2g}\ncorrected {row['p_fdr']:.2g}" if row["test"] else "no test"
        axes.annotate(
            f"{g}\n{p}",
            (1.02, k),
            xycoords=("axes fraction", "data"),
            va="center",
            size=5.5,
            color=MUTED,
        )
    axes.set_yticks(
        range(len(known)),
        [
            f"{row['contrast']}\nn = {cohort.counted_units(row)}".replace(", ", ",\n")
            for row in rows
        ],
        size=5.5,
    )
    axes.set(
        ylim=(len(known) - 0.4, -0.6),
        xlabel=f"difference{f', {unit}' if unit else ''}, with its 95 % interval",
    )


def _intervals(
    axes: Axes, known: pd.DataFrame, middle: str, low: str, high: str, factor: float
) -> None:
    """Marks with their intervals, one per row; hollow without a test."""
    spans = factor * known[[middle, low, high]].to_numpy(float)
    for k, ((value, a, b), test) in enumerate(zip(spans, known["test"].astype(str), strict=True)):
        if np.isfinite([a, b]).all():
            axes.plot([a, b], [k, k], color=INK, linewidth=1.0, gid=f"interval {k}")
        axes.plot(
            value,
            k,
            "o",
            color=INK,
            markerfacecolor=INK if test and test != "nan" else "none",
            markersize=4.0,
        )
    axes.axvline(0.0, color=MUTED, linewidth=0.6, linestyle=(0, (3, 2)))
    axes.spines["left"].set_visible(False)
    axes.tick_params(axis="y", length=0)


def _occupancies(
    animals: Sequence[SessionAnimal],
) -> dict[str, dict[str, tuple[Session, Occupancy]]]:
    """Each subject's first session and its occupancy on a common grid, by group."""
    corners = np.array([extent_mm(one.session, one.xy_mm, centred=True) for one in animals])
    low, high = corners[:, 0].min(axis=0), corners[:, 1].max(axis=0)
    return {
        group: {
            subject: (
                sessions[0].session,
                _added(
                    [
                        occupancy(aligned(one.session, one.xy_mm), one.hold_s, low, high)
                        for one in sessions
                    ]
                ),
            )
            for subject, sessions in subjects.items()
        }
        for group, subjects in by_group(animals).items()
    }


def _added(some: Sequence[Occupancy]) -> Occupancy:
    """The sum of occupancies on one grid."""
    return replace(
        some[0],
        time_s=np.sum([found.time_s for found in some], axis=0),
        n=sum(found.n for found in some),
    )


def _budget(sessions: Sequence[SessionAnimal], words: Sequence[str]) -> "pd.Series[float]":
    """Share of a subject's time in each action: the mean of its sessions; NaN if unknown."""
    known = [dict(animal.summary) for animal in sessions if animal.summary is not None]
    return pd.DataFrame(known, columns=[f"{word}_share" for word in words], dtype=float).mean()
