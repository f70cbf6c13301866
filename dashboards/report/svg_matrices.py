"""SVG figures of what actions sum up to: transition matrix, peri-event curves, activity."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

import numpy as np

from .svg import Array, Scale, svg, time_scale, x_axis, x_ticks, y_axis

_WIDTH = 300.0


def matrix(
    words: Sequence[str], probability: Array, chance: Array, significant: Array, counts: Array
) -> str:
    """Transition matrix, from a row's action to a column's: the darker, the more probable.

    ▲ marks pairs above and ▼ pairs below chance where that is certain.

    Args:
        words: the k actions.
        probability: (k, k) share of the row's successors; NaN on the diagonal and where nothing
            followed.
        chance: (k, k) the same by chance.
        significant: (k, k) bool, whether the two differ for certain.
        counts: (k, k) number of transitions.
    """
    # room for words as long as 'rear unsupported'
    cell = 58.0
    left = 158.0
    top = 104.0
    size = cell * len(words)
    parts = []
    for k, word in enumerate(words):
        label = escape(word.replace("_", " "))
        at = (k + 0.5) * cell
        parts.append(
            f'<text class="label" x="{left - 8}" y="{top + at + 4:.1f}" '
            f'text-anchor="end">{label} <tspan class="tick">n {np.nansum(counts[k]):.0f}</tspan>'
            "</text>"
        )
        x = left + at
        y = top - 8
        parts.append(
            f'<text class="label" x="{x:.1f}" y="{y}" transform="rotate(-40 {x:.1f} '
            f'{y})">{label}</text>'
        )
    for i, word in enumerate(words):
        for j, other in enumerate(words):
            x = left + j * cell
            y = top + i * cell
            p = probability[i, j]
            box = f'x="{x + 1:.1f}" y="{y + 1:.1f}" width="{cell - 2}" height="{cell - 2}" rx="4"'
            if i == j or not np.isfinite(p):
                parts.append(f'<rect class="void" {box}/>')
                continue
            mark = "" if not significant[i, j] else " ▲" if p > chance[i, j] else " ▼"
            title = (
                f"{word} to {other}: {int(counts[i, j])} times, {p:.0%}; by chance "
                f"{chance[i, j]:.0%}"
            )
            parts.append(
                f'<rect class="cell" fill-opacity="{0.06 + 0.94 * p:.3f}" '
                f"{box}><title>{escape(title)}</title></rect><text "
                f'class="{"inside" if p > 0.45 else "tick"}" x="{x + cell / 2:.1f}" '
                f'y="{y + cell / 2 + 4:.1f}" text-anchor="middle">{p:.0%}{mark}</text>'
            )
    parts.append(f'<text class="tick" x="{left - 8}" y="14" text-anchor="end">followed by</text>')
    return svg(max(left + size + 70, 400.0), top + size + 6, parts)  # few words are not blown up


def around(
    time_s: Array,
    low: Array,
    median: Array,
    high: Array,
    unit: str,
    colour: str,
    limits: tuple[float, float],
) -> str:
    """Median and quartiles of a measure around the onset of an action, at 0 s.

    Args:
        time_s: (k,) time relative to the onset, s.
        low: (k,) lower quartile.
        median: (k,) median; NaN where unknown.
        high: (k,) upper quartile.
        unit: unit of the measure.
        colour: colour of curve and band.
        limits: lower and upper end of the vertical axis.
    """
    width = _WIDTH
    bottom = 110.0
    across = Scale(float(time_s[0]), float(time_s[-1]), 52.0, width - 8.0)
    up = Scale(limits[0], limits[1], bottom, 8.0)
    known = np.isfinite(median)
    x, upper, lower, middle = (
        values[known] for values in (across(time_s), up(high), up(low), up(median))
    )
    band = " ".join(
        f"{a:.1f},{b:.1f}"
        for a, b in [*zip(x, upper, strict=True), *zip(x[::-1], lower[::-1], strict=True)]
    )
    line = "L".join(f"{a:.1f} {b:.1f}" for a, b in zip(x, middle, strict=True))
    zero = float(across(0.0))
    parts = [
        y_axis(up, unit, 3, 52.0, width - 8.0),
        x_ticks(across, bottom, "s from the onset", 6),
        f'<polygon fill="{colour}" opacity="0.22" points="{band}"/>',
        f'<path class="curve thick" stroke="{colour}" d="M{line}"/>',
        f'<line class="median" x1="{zero:.1f}" x2="{zero:.1f}" y1="8" y2="{bottom}"/>',
    ]
    return svg(width, bottom + 34, parts)


def activity(
    start_s: Array, stop_s: Array, parts_s: Sequence[tuple[str, Array, str]], observed_s: Array
) -> str:
    """Stacked shares of the observed time in each action per interval.

    Args:
        start_s: (k,) beginnings of the intervals, s.
        stop_s: (k,) their ends, s.
        parts_s: the actions: (word, time in it (k,) s, colour).
        observed_s: (k,) time with a pose, s.
    """
    time = time_scale(float(stop_s[-1]))
    top = 8.0
    bottom = 96.0
    up = Scale(0.0, 1.0, bottom, top)
    drawn = [y_axis(up, "share", 2), x_axis(time, bottom, top, True)]
    below = np.zeros(len(start_s))
    for word, seconds, colour in parts_s:
        share = np.divide(seconds, observed_s, out=np.zeros_like(seconds), where=observed_s > 0)
        for a, b, low, part in zip(start_s, stop_s, below, share, strict=True):
            if part > 0:
                x0 = float(time(a))
                x1 = float(time(b))
                y = float(up(min(low + part, 1.0)))
                drawn.append(
                    f'<rect fill="{colour}" x="{x0:.1f}" y="{y:.1f}" '
                    f'width="{max(x1 - x0 - 0.6, 0.4):.1f}" '
                    f'height="{max(float(up(low)) - y, 0.0):.1f}"><title>{escape(word)} '
                    f"{part:.0%}</title>"
                    "</rect>"
                )
        below += share
    return svg(time.stop + 22.0, bottom + 34, drawn)
