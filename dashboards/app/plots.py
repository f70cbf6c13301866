"""The dashboard's figures as plotly dicts: ethograms, time budgets, groups, curves, depth pictures.

Each function returns a figure as a dict (data and layout). Plotly reads markup in every text it is
given, so all names are escaped. A click is told by `customdata` (the key of a session) or by the
point's coordinates. No science is computed here.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

import numpy as np
import pandas as pd

from liex_lab.actions.vocabulary import UNLABELLED
from liex_lab.behaviour.cohort import counted_units
from liex_lab.behaviour.statistics import animal_means
from liex_lab.plan.subject import references_first

from ..figures.style import INK, LINE, MUTED
from ..figures.times import kept_rows
from ..report.contact_sheet import Array
from ..units import read_as, shown
from .data import GREY, NO_POSE, OTHER, Ethogram, raster

# Okabe and Ito's colours; beside them every group has its own mark
# the first group is the reference, in grey
GROUP_COLOURS = ("#7F7F7F", "#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
GROUP_MARKS = ("circle", "square", "diamond", "triangle-up", "cross", "x", "star")
NO_POSE_COLOUR = "#3a3f45"
FEW = 60  # sessions; with more, rows are thin
# parts of the time that a row of an ethogram shows; of all rows together
_COLUMNS = 800
_MOST_CELLS = 40_000
_FONT = {
    "family": 'system-ui, "Segoe UI", Roboto, "Helvetica Neue", sans-serif',
    "size": 13,
    "color": INK,
}


def text(name: str) -> str:
    """A name as plotly may show it: escaped, with spaces for underscores.

    Args:
        name: the name.
    """
    return escape(str(name).replace("_", " "))


def empty(sentence: str, height: int = 160) -> dict[str, Any]:
    """A figure that says why there is none.

    Args:
        sentence: why.
        height: height of the figure, px.
    """
    note = {
        "text": escape(sentence),
        "showarrow": False,
        "x": 0.5,
        "y": 0.5,
        "xref": "paper",
        "yref": "paper",
    }
    hidden = {"visible": False}
    return {"data": [], "layout": _layout(height, annotations=[note], xaxis=hidden, yaxis=hidden)}


def ethograms(
    ones: Mapping[str, Ethogram], coloured: Mapping[str, str], groups: Sequence[str] = ()
) -> dict[str, Any]:
    """A row per session, coloured by what the animal did; actions without a colour share a grey.

    Args:
        ones: the key of each session and its ethogram, the first on top.
        coloured: word -> colour.
        groups: the group of each session, named where its rows begin.
    """
    if not ones:
        return empty("No session is chosen, or none of those has an ethogram.")
    stop_s = max(max(one.duration_s for one in ones.values()), 1e-3)
    n_columns = min(_COLUMNS, max(120, _MOST_CELLS // len(ones)))
    words = list(coloured)
    every = [*words, *sorted({word for one in ones.values() for word in one.words} - set(words))]
    rows = np.stack([raster(one, every, 0.0, stop_s, n_columns) for one in ones.values()])
    unit, size = time_unit(stop_s)
    time_s = (np.arange(n_columns) + 0.5) * stop_s / n_columns
    # as places of the colours: 0 no pose, 1 unlabelled, 2 other actions, then the words
    painted = np.where(rows >= len(words), 2.0, rows + np.where(rows < 0, 2.0, 3.0))
    painted[time_s > np.array([[one.duration_s] for one in ones.values()])] = np.nan
    named = np.array([NO_POSE, "unlabelled", *every])  # of -2, -1 and the words
    place = rows + 2
    colours = [NO_POSE_COLOUR, UNLABELLED, GREY, *coloured.values()]
    trace = {
        "type": "heatmap",
        "z": painted.astype(np.float32),
        "x": (time_s / size).astype(np.float32),
        "y": [text(key) for key in ones],
        "text": np.array([text(name) for name in named])[place].tolist(),
        "showscale": False,
        "zmin": -0.5,
        "zmax": len(colours) - 0.5,
        "colorscale": _steps(colours),
        "ygap": 2 if len(ones) <= FEW else 1,
        "hoverongaps": False,
        "hovertemplate": f"%{{y}}<br>%{{x:.2f}} {unit}: %{{text}}<extra></extra>",
    }
    x = {"title": {"text": f"time, {unit}"}, "range": [0, stop_s / size], "showgrid": False}
    return {
        "data": [trace],
        "layout": _layout(
            _rows_height(len(ones)), xaxis=x, yaxis=_session_axis(list(ones), groups)
        ),
    }


def time_budgets(
    shares: pd.DataFrame,
    coloured: Mapping[str, str],
    words: Sequence[str],
    groups: Sequence[str] = (),
) -> dict[str, Any]:
    """A stacked bar per session: shares of the observed time in %, uncoloured actions in one grey.

    Args:
        shares: one row per session: `key`, and the column WORD_share of each action and of
            `unlabelled`.
        coloured: word -> colour.
        words: the actions.
        groups: the group of each session, named where its rows begin.
    """
    if shares.empty:
        return empty("No session is chosen, or none of those has a summary.")
    known = {**coloured, "unlabelled": UNLABELLED}
    known = {word: colour for word, colour in known.items() if f"{word}_share" in shares}
    rest = [f"{word}_share" for word in words if word not in known and f"{word}_share" in shares]
    parts = [(word, shares[f"{word}_share"].fillna(0.0), colour) for word, colour in known.items()]
    parts.insert(-1, (OTHER, shares[rest].fillna(0.0).sum(axis=1), GREY))
    keys = [str(key) for key in shares["key"]]
    data = [
        {
            "type": "bar",
            "orientation": "h",
            "y": [text(key) for key in keys],
            "x": 100.0 * values.to_numpy(float),
            "name": text(word),
            "marker": {"color": colour, "line": {"width": 0.5, "color": "#fff"}},
            "customdata": keys,
            "hovertemplate": f"%{{y}}<br>{_plain(word)}: %{{x:.1f}} %<extra></extra>",
        }
        for word, values, colour in parts
        if values.any()
    ]
    x = {"title": {"text": "share of the observed time, %"}, "range": [0, 100]}
    return {
        "data": data,
        "layout": _layout(
            _rows_height(len(keys)),
            xaxis=x,
            yaxis=_session_axis(keys, groups),
            barmode="stack",
            bargap=0.25,
            showlegend=False,
        ),
    }


def groups(
    table: pd.DataFrame, measure: str, unit: str, reference: str | None = None
) -> dict[str, Any]:
    """Strip plot of a measure by group: each animal's mean, its sessions, the mean of the animals.

    Args:
        table: one row per session: key, subject_id, group and the measure, see
            `StudyData.collected`.
        measure: the column to draw.
        unit: its unit in the table; empty where it has none.
        reference: the group that stands first, in grey; None takes one named like a control group.
    """
    factor = shown(1.0, unit)[0]
    known = table[np.isfinite(table[measure].astype(float))] if measure in table else table.iloc[:0]
    if known.empty:
        return empty("No session has a value of this measure.")
    names = references_first(set(known["group"].fillna("").astype(str)))
    if reference in names:
        names = [reference, *(name for name in names if name != reference)]
    rng = np.random.default_rng(0)
    data = []
    lines = []
    for k, name in enumerate(names):
        own = known[known["group"].fillna("") == name]
        values = factor * own[measure].to_numpy(float)
        animal, animals = pd.factorize(own["subject_id"].where(own["subject_id"] != "", own["key"]))
        means = animal_means(values, animal)
        beside = rng.uniform(-0.16, 0.16, len(animals)) if len(animals) > 1 else np.zeros(1)
        colour = GROUP_COLOURS[k % len(GROUP_COLOURS)]
        mark = GROUP_MARKS[k % len(GROUP_MARKS)]
        n_of = np.bincount(animal)
        label = text(name or "no group")
        data.append(
            {
                "type": "scatter",
                "mode": "markers",
                "x": k + beside[animal] + 0.02,
                "y": values,
                "name": "sessions",
                "customdata": [str(key) for key in own["key"]],
                "text": [text(key) for key in own["key"]],
                "marker": {"color": colour, "size": 6, "opacity": 0.45, "symbol": mark},
                "showlegend": False,
                "hovertemplate": "session %{text}: %{y:.4g}<extra></extra>",
            }
        )
        first = [
            str(own["key"].iloc[int(np.flatnonzero(animal == a)[0])]) for a in range(len(animals))
        ]
        data.append(
            {
                "type": "scatter",
                "mode": "markers",
                "x": k + beside,
                "y": means,
                "name": label,
                "showlegend": False,
                "customdata": first,
                "text": [
                    f"{text(a)}, {n} session{'s' if n > 1 else ''}"
                    for a, n in zip(animals, n_of, strict=True)
                ],
                "marker": {
                    "color": colour,
                    "size": 12,
                    "symbol": mark,
                    "line": {"color": "#fff", "width": 1.2},
                },
                "hovertemplate": "animal %{text}: %{y:.4g}<extra></extra>",
            }
        )
        mean = float(means.mean())
        lines.append(
            {
                "type": "line",
                "x0": k - 0.3,
                "x1": k + 0.3,
                "y0": mean,
                "y1": mean,
                "line": {"color": colour, "width": 2.5},
            }
        )
    counts = [
        f"{text(name or 'no group')}<br>{own['subject_id'].nunique()} animals, {len(own)} sessions"
        for name in names
        for own in [known[known["group"].fillna("") == name]]
    ]
    x = {
        "tickvals": list(range(len(names))),
        "ticktext": counts,
        "range": [-0.6, len(names) - 0.4],
        "showgrid": False,
        "zeroline": False,
    }
    title = escape(read_as(measure, unit))
    return {
        "data": data,
        "layout": _layout(380, xaxis=x, yaxis={"title": {"text": title}}, shapes=lines),
    }


def differences(stats: pd.DataFrame, unit: str) -> dict[str, Any]:
    """Each contrast's difference with its 95 % interval; a hollow mark where there is no test.

    Args:
        stats: rows of the table `stats` of one measure, see `cohort.compare`.
        unit: the measure's unit in the table; empty where it has none.
    """
    factor, unit = shown(1.0, unit)
    known = stats[np.isfinite(stats["estimate"].astype(float))]
    if known.empty:
        return empty("No difference can be given; the table below says why.", 220)
    places = list(range(len(known)))
    estimate = factor * known["estimate"].astype(float)
    low, high = (
        (factor * known[name].astype(float)).fillna(estimate) for name in ("ci_low", "ci_high")
    )
    tested = (known["test"] != "").to_numpy()
    trace = {
        "type": "scatter",
        "mode": "markers",
        "x": estimate.to_numpy(float),
        "y": places,
        "error_x": {
            "type": "data",
            "symmetric": False,
            "array": (high - estimate).to_numpy(float),
            "arrayminus": (estimate - low).to_numpy(float),
            "color": INK,
            "thickness": 1.6,
        },
        "marker": {
            "size": 11,
            "color": INK,
            "symbol": ["circle" if one else "circle-open" for one in tested],
        },
        "hovertemplate": "%{x:.4g}<extra></extra>",
    }
    y = {
        "tickvals": places,
        "ticktext": [
            f"{text(row['contrast'])}<br>{text(counted_units(row))}"
            for row in known.to_dict("records")
        ],
        "automargin": True,
        "autorange": "reversed",
        "showgrid": False,
    }
    x = {
        "title": {
            "text": f"difference{f', {escape(unit)}' if unit else ''}, with its 95 % interval"
        },
        "zeroline": True,
        "zerolinecolor": MUTED,
        "zerolinewidth": 1.5,
    }
    return {"data": [trace], "layout": _layout(150 + 44 * len(places), xaxis=x, yaxis=y)}


def whole_session(
    one: Ethogram,
    coloured: Mapping[str, str],
    traces: Sequence[tuple[str, Array, Array, str]],
    moment_s: float,
) -> dict[str, Any]:
    """A lane per action over a whole session, and curves below them.

    Args:
        one: the session's ethogram.
        coloured: word -> colour; each word has a lane.
        traces: the curves: (name with unit, time s (n,), values (n,), colour).
        moment_s: the moment that is marked, s since the first frame.
    """
    n = 1200
    stop_s = max(one.duration_s, 1e-3)
    words = list(coloured)
    lanes = [*words, NO_POSE]
    z = np.full((len(lanes), n), np.nan, np.float32)
    for k, word in enumerate(words):
        z[k, raster(_only(one, word), [word], 0.0, stop_s, n) == 0] = k
    z[
        -1,
        raster(Ethogram(one.spans_s[:0], [], one.lost_s, one.duration_s), [], 0.0, stop_s, n) == -2,
    ] = len(words)
    unit, size = time_unit(stop_s)
    x = (np.arange(n) + 0.5) * stop_s / n / size
    data: list[dict[str, Any]] = [
        {
            "type": "heatmap",
            "z": z,
            "x": x.astype(np.float32),
            "y": list(range(len(lanes))),
            "showscale": False,
            "zmin": -0.5,
            "zmax": len(lanes) - 0.5,
            "hoverongaps": False,
            "ygap": 3,
            "xaxis": "x",
            "yaxis": "y",
            "colorscale": _steps([*coloured.values(), NO_POSE_COLOUR]),
            "hovertemplate": f"%{{x:.2f}} {unit}<extra></extra>",
        }
    ]
    heights = [22 * len(lanes) + 20, *[96] * len(traces)]
    domains = _domains(heights)
    notes = []
    layout: dict[str, Any] = {
        "yaxis": {
            "tickvals": list(range(len(lanes))),
            "ticktext": [text(word) for word in lanes],
            "domain": domains[0],
            "autorange": "reversed",
            "showgrid": False,
            "automargin": True,
            "zeroline": False,
        }
    }
    for k, (name, time_s, values, colour) in enumerate(traces):
        rows = kept_rows(values, n)
        axis = f"y{k + 2}"
        data.append(
            {
                "type": "scatter",
                "mode": "lines",
                "x": time_s[rows] / size,
                "y": values[rows],
                "line": {"color": colour, "width": 1.2},
                "xaxis": "x",
                "yaxis": axis,
                "connectgaps": False,
                "hovertemplate": f"%{{x:.2f}} {unit}: %{{y:.4g}}<extra>{text(name)}</extra>",
            }
        )
        layout[f"yaxis{k + 2}"] = _curve_axis(domains[k + 1], values)
        notes.append(_title(name, domains[k + 1]))
    layout["xaxis"] = {
        "title": {"text": f"time, {unit}"},
        "range": [0, stop_s / size],
        "anchor": f"y{len(traces) + 1}" if traces else "y",
    }
    more = {"shapes": [cursor(moment_s / size)], "annotations": notes, "showlegend": False}
    return {"data": data, "layout": _layout(sum(heights) + 70, **layout, **more)}


def _only(one: Ethogram, word: str) -> Ethogram:
    chosen = np.array([name == word for name in one.words], bool)
    return Ethogram(one.spans_s[chosen], [word] * int(chosen.sum()), one.lost_s, one.duration_s)


def around(
    traces: Sequence[tuple[str, Array, Array, str]], moment_s: float, half_s: float
) -> dict[str, Any]:
    """The curves near a moment, every frame a point.

    Args:
        traces: the curves: (name with unit, time s (n,), values (n,), colour).
        moment_s: the moment, s since the first frame.
        half_s: how much before and after it is shown, s.
    """
    if not traces:
        return empty("This session has no kinematics.")
    heights = [104] * len(traces)
    domains = _domains(heights)
    data = []
    notes = []
    layout: dict[str, Any] = {}
    for k, (name, time_s, values, colour) in enumerate(traces):
        near = np.abs(time_s - moment_s) <= half_s
        axis = "y" if k == 0 else f"y{k + 1}"
        data.append(
            {
                "type": "scatter",
                "mode": "lines+markers",
                "x": time_s[near],
                "y": values[near],
                "yaxis": axis,
                "line": {"color": colour, "width": 1.4},
                "marker": {"size": 4, "color": colour},
                "connectgaps": False,
                "hovertemplate": "%{x:.3f} s: %{y:.4g}<extra></extra>",
            }
        )
        layout[f"yaxis{'' if k == 0 else k + 1}"] = _curve_axis(domains[k], values)
        notes.append(_title(name, domains[k]))
    layout["xaxis"] = {
        "title": {"text": "time, s"},
        "range": [moment_s - half_s, moment_s + half_s],
        "anchor": f"y{len(traces)}" if len(traces) > 1 else "y",
    }
    more = {"shapes": [cursor(moment_s)], "annotations": notes, "showlegend": False}
    return {"data": data, "layout": _layout(sum(heights) + 70, **layout, **more)}


def cursor(at: float) -> dict[str, Any]:
    """The vertical line that marks the moment, through all curves.

    Args:
        at: the moment, in the axis' own unit.
    """
    return {
        "type": "line",
        "x0": at,
        "x1": at,
        "y0": 0,
        "y1": 1,
        "yref": "paper",
        "line": {"color": INK, "width": 1.4, "dash": "dot"},
    }


def time_unit(stop_s: float) -> tuple[str, float]:
    """The unit of a time axis, and how many seconds it has.

    Args:
        stop_s: where the axis ends, s; beyond three minutes it counts minutes.
    """
    return ("min", 60.0) if stop_s > 180.0 else ("s", 1.0)


def _plain(name: str) -> str:
    """A name for one of plotly's templates, which would read %{...} in it."""
    return text(name).replace("%{", "% {")


def _rows_height(n: int) -> int:
    """Height of a figure with n rows of sessions, px."""
    return 80 + n * (24 if n <= FEW else 12)


def _session_axis(keys: Sequence[str], groups: Sequence[str] = ()) -> dict[str, Any]:
    """A vertical axis with a session in each row, the first on top; a group is named once."""
    n = len(keys)
    new = [k == 0 or groups[k] != groups[k - 1] for k in range(len(groups))]
    named = zip(groups, new, strict=True)
    heads = [f"<b>{text(group)}</b>  " if first else "" for group, first in named] or [""] * n
    return {
        "tickmode": "array",
        "tickvals": [text(key) for key in keys],
        "ticktext": [head + text(key) for head, key in zip(heads, keys, strict=True)],
        "type": "category",
        "autorange": "reversed",
        "automargin": True,
        "showgrid": False,
        "tickfont": {"size": 12 if n <= FEW else 9},
    }


def _domains(heights: Sequence[int]) -> list[list[float]]:
    """Where figures of these heights stand, the first on top, as shares of the paper."""
    # room for a title
    total = float(sum(heights))
    apart = 24.0
    top = 1.0
    out = []
    for height in heights:
        bottom = top - height / total
        out.append([max(bottom, 0.0), top - apart / total])
        top = bottom
    return out


def _curve_axis(domain: list[float], values: Array) -> dict[str, Any]:
    """The vertical axis of one of several curves; from zero where nothing is below it."""
    positive = not (values[np.isfinite(values)] < 0).any()
    return {
        "domain": domain,
        "automargin": True,
        "nticks": 4,
        "rangemode": "tozero" if positive else "normal",
    }


def _title(name: str, domain: list[float]) -> dict[str, Any]:
    """A curve's name above it, on the left."""
    return {
        "text": text(name),
        "showarrow": False,
        "xref": "paper",
        "yref": "paper",
        "x": 0,
        "y": domain[1],
        "xanchor": "left",
        "yanchor": "bottom",
        "font": {"size": 12, "color": MUTED},
    }


def _steps(colours: Sequence[str]) -> list[list[Any]]:
    """A colour scale of flat steps, one for each whole number from 0."""
    n = len(colours)
    return [[at, colour] for k, colour in enumerate(colours) for at in (k / n, (k + 1) / n)]


def _layout(height: int, **more: Any) -> dict[str, Any]:
    """What all figures share: our ink, no background, no toolbar's clutter."""
    axis = {
        "gridcolor": LINE,
        "linecolor": LINE,
        "zerolinecolor": LINE,
        "ticks": "outside",
        "tickcolor": LINE,
    }
    base: dict[str, Any] = {
        "height": height,
        "font": _FONT,
        "paper_bgcolor": "rgba(0,0,0,0)",
        "plot_bgcolor": "rgba(0,0,0,0)",
        "margin": {"l": 60, "r": 16, "t": 12, "b": 50},
        "hoverlabel": {"bgcolor": "#fff", "font": {"color": INK}},
        "dragmode": "zoom",
        "hovermode": "closest",
    }
    axes = {
        name: {**axis, **value}
        for name, value in more.items()
        if name.startswith(("xaxis", "yaxis"))
    }
    return {**base, **more, **axes}
