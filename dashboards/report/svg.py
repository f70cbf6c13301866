"""Small figures as SVG text: curves, ethogram, trajectory, histogram, time budget, depth picture.

They take the page's colours, print sharply and weigh a few kilobytes. Numbers come in as arrays,
text goes out; nothing is computed here but where a mark stands on the paper. Long curves are
thinned to the lowest and highest value per column (min-max decimation). Colours that belong to the
page (ink, grid) are CSS classes of the report's template. Lengths on the paper are in units of the
SVG's viewBox.
"""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from liex_lab.actions.colours import action_colours

Array = NDArray[np.float64]

# shared by all figures over time, so that their axes stand below each other
WIDTH = 920
LEFT = 116
RIGHT = 22
ARENA = "the arena"  # the outline that needs no name
_MAX_PLACES = 20_000  # of the way over the floor: five a second of an hour
_MAX_COLUMNS = 1200  # of a curve; more points than that cannot be told apart on a page
_VIRIDIS = np.array(
    [
        [68, 1, 84],
        [71, 44, 122],
        [59, 81, 139],
        [44, 113, 142],
        [33, 144, 141],
        [39, 173, 129],
        [92, 200, 99],
        [170, 220, 50],
        [253, 231, 37],
    ],
    float,
)


@dataclass(frozen=True)
class Scale:
    """A linear map from numbers to positions on the paper.

    Attributes:
        low: the number at `start`.
        high: the number at `stop`.
        start: position of `low` on the paper.
        stop: position of `high` on the paper; below `start` for an axis that points up.
    """

    low: float
    high: float
    start: float
    stop: float

    def __call__(self, value: Array | float) -> Array:
        """Positions on the paper of values of any shape.

        Args:
            value: the values.
        """
        share = (np.asarray(value, float) - self.low) / (self.high - self.low)
        return np.asarray(self.start + share * (self.stop - self.start))

    def ticks(self, about: int) -> list[float]:
        """Round numbers inside the scale: multiples of 1, 2, 2.5 or 5 times a power of ten.

        Args:
            about: how many are wanted; there may be somewhat fewer or one more.
        """
        step = (self.high - self.low) / max(about, 1)
        power = 10.0 ** np.floor(np.log10(step))
        step = power * next(m for m in (1.0, 2.0, 2.5, 5.0, 10.0) if m * power >= 0.999 * step)
        first = np.ceil(self.low / step - 1e-9)
        return [
            float(k * step) + 0.0 for k in np.arange(first, np.floor(self.high / step + 1e-9) + 1)
        ]


def time_scale(duration_s: float) -> Scale:
    """The axis that all figures over time share, s.

    Args:
        duration_s: length of the session, s.
    """
    return Scale(0.0, max(duration_s, 1e-3), LEFT, WIDTH - RIGHT)


def curve(
    time_s: Array,
    values: Array,
    time: Scale,
    unit: str,
    colour: str,
    shaded: Sequence[tuple[float, float]] = (),
    from_zero: bool = True,
    last: bool = False,
) -> str:
    """Values over time, broken where they are unknown.

    Args:
        time_s: (n,) times, s.
        values: (n,) values; NaN where unknown.
        time: the time axis.
        unit: unit of the values.
        colour: colour of the line.
        shaded: spans (start, stop) behind the curve, s.
        from_zero: whether the axis begins at zero, or below it where values do.
        last: whether the times are written below, as under the last of several figures.
    """
    top = 10.0
    bottom = 110.0
    height = bottom + (34 if last else 10)
    known = values[np.isfinite(values)]
    low, high = (float(known.min()), float(known.max())) if len(known) else (0.0, 1.0)
    low = min(low, 0.0) if from_zero else low
    spread = max(high - low, 1e-9, 0.02 * abs(high))
    scale = Scale(low, low + spread * 1.06, bottom, top)
    parts = [y_axis(scale, unit, 4), x_axis(time, bottom, top, last)]
    for start, stop in shaded:
        x0 = float(time(start))
        x1 = float(time(stop))
        parts.append(
            f'<rect class="shade" x="{x0:.1f}" y="{top}" width="{max(x1 - x0, 0.5):.1f}" '
            f'height="{bottom - top}"/>'
        )
    parts += [
        f'<path class="curve" stroke="{colour}" d="{d}"/>'
        for d in _paths(time(time_s), scale(values))
    ]
    return svg(WIDTH, height, parts)


def lanes(
    spans: Sequence[tuple[float, float, str]],
    words: Sequence[str],
    lost: Sequence[tuple[float, float]],
    time: Scale,
) -> str:
    """Ethogram: one row per word with its bouts as bars; times without a pose hatched.

    Args:
        spans: bouts (start, stop, word), s.
        words: the vocabulary, in the order in which it is coloured.
        lost: spans (start, stop) without a pose, s.
        time: the time axis.
    """
    own = action_colours(words)
    row = 18.0
    top = 6.0
    bottom = top + row * max(len(words), 1)
    parts = [x_axis(time, bottom, top, False)]
    for start, stop in lost:
        parts.append(_bar(time, start, stop, top, bottom - top, "url(#hatch)", "no pose"))
    for k, word in enumerate(words):
        y = top + k * row
        parts.append(
            f'<text class="label" x="{LEFT - 8}" y="{y + row / 2 + 4:.1f}" text-anchor="end">'
            f"{escape(word.replace('_', ' '))}</text>"
        )
        named = [(start, stop) for start, stop, action in spans if action == word]
        for start, stop in _merged(named, time):
            parts.append(
                _bar(
                    time,
                    start,
                    stop,
                    y + 2,
                    row - 4,
                    own[word],
                    f"{word} {stop - start:.2f} s",
                )
            )
    return svg(WIDTH, bottom + 8, [_HATCH, *parts])


def _merged(spans: Sequence[tuple[float, float]], time: Scale) -> list[tuple[float, float]]:
    """Spans in order, those joined that would be nearer than a hair on the paper.

    An hour has thousands.
    """
    least = 0.25 * (time.high - time.low) / (time.stop - time.start)
    out: list[tuple[float, float]] = []
    for start, stop in spans:
        if out and start - out[-1][1] < least and stop - out[-1][0] < 40 * least:
            out[-1] = (out[-1][0], stop)
        else:
            out.append((start, stop))
    return out


def trajectory(
    x_mm: Array,
    y_mm: Array,
    time_s: Array,
    outlines: Sequence[tuple[str, Array]] = (),
    size: int = 420,
) -> str:
    """The path over the floor seen from above, coloured by time from dark to light; y points up.

    Args:
        x_mm: (n,) x in the arena frame, mm; NaN where unknown.
        y_mm: (n,) y in the arena frame, mm; NaN where unknown.
        time_s: (n,) times, s.
        outlines: the arena and zones in it, each a name and its corners (k, 2) mm.
        size: width and height of the figure.
    """
    known = np.isfinite(x_mm) & np.isfinite(y_mm)
    if not known.any():
        return svg(size, 40, ['<text class="label" x="10" y="24">no position is known</text>'])
    margin = 52.0
    plot = size - 64.0
    shown = [
        np.column_stack([x_mm[known], y_mm[known]]),
        *(corners for _, corners in outlines if len(corners)),
    ]
    low = np.min([p.min(axis=0) for p in shown], axis=0)
    high = np.max([p.max(axis=0) for p in shown], axis=0)
    middle = 0.5 * (low + high)
    reach = 0.55 * max(float((high - low).max()), 20.0)
    across = Scale(middle[0] - reach, middle[0] + reach, margin, margin + plot)
    up = Scale(middle[1] - reach, middle[1] + reach, 8 + plot, 8.0)
    parts = [_frame(across, up)]
    for name, corners in outlines:
        places = " ".join(f"{float(across(x)):.1f},{float(up(y)):.1f}" for x, y in corners)
        parts.append(
            f'<polygon class="outline" points="{places}"><title>{escape(name)}</title></polygon>'
        )
    keep = np.unique(np.linspace(0, len(x_mm) - 1, min(len(x_mm), _MAX_PLACES)).astype(int))
    x = across(x_mm)[keep]
    y = up(y_mm)[keep]
    t = time_s[keep]
    span = max(float(t[-1] - t[0]), 1e-9)
    for piece in np.array_split(np.arange(len(keep)), min(64, max(1, len(keep) // 2))):
        rows = np.append(piece, piece[-1] + 1)[: len(keep) - piece[0]]
        colour = viridis(0.92 * float(t[piece[0]] - t[0]) / span)
        parts += [
            f'<path class="way" stroke="{colour}" d="{d}"/>' for d in _broken(x[rows], y[rows])
        ]
    first, final = np.flatnonzero(known)[[0, -1]]
    for row, colour, word in ((first, viridis(0.0), "start"), (final, viridis(0.92), "end")):
        px = float(across(x_mm[row]))
        py = float(up(y_mm[row]))
        parts.append(
            f'<circle class="mark" fill="{colour}" cx="{px:.1f}" cy="{py:.1f}" r="5">'
            f"<title>{word}</title></circle>"
        )
        parts.append(_label_beside(px, py - 6.0, word, size - 52.0, 8.0))
    for name, corners in outlines:  # last, so that the way does not hide them
        if name != ARENA and len(corners):
            place = float(across(corners[:, 0].mean())), float(up(corners[:, 1].max())) + 13.0
            parts.append(
                f'<text class="label halo" x="{place[0]:.1f}" y="{place[1]:.1f}" '
                'text-anchor="middle">'
                f"{escape(name)}</text>"
            )
    return svg(size, size, parts)


def histogram(values: Array, unit: str, colour: str, width: int = 420, height: int = 200) -> str:
    """How often values occur, over the range that holds 99 % of them; a line marks the median.

    Args:
        values: values of any shape, not negative; NaN is left out, and larger ones than the 99 %
            quantile count in the last bin.
        unit: their unit.
        colour: colour of the bars.
        width: width of the figure.
        height: height of the figure.
    """
    known = values[np.isfinite(values)]
    if len(known) == 0:
        return svg(width, 40, ['<text class="label" x="10" y="24">no value is known</text>'])
    bottom = height - 34.0
    top_value = max(float(np.quantile(known, 0.99)), 1e-6)
    counts, edges = np.histogram(np.minimum(known, top_value), bins=30, range=(0.0, top_value))
    across = Scale(0.0, top_value, 52.0, width - 12.0)
    up = Scale(0.0, max(float(counts.max()), 1.0) * 1.08, bottom, 8.0)
    parts = [y_axis(up, "frames", 3, 52.0, width - 12.0), x_ticks(across, bottom, unit, 5)]
    for count, a, b in zip(counts, edges[:-1], edges[1:], strict=True):
        x0 = float(across(a))
        x1 = float(across(b))
        y = float(up(float(count)))
        parts.append(
            f'<rect fill="{colour}" x="{x0 + 0.5:.1f}" y="{y:.1f}" '
            f'width="{max(x1 - x0 - 1, 0.5):.1f}" height="{bottom - y:.1f}"/>'
        )
    at = float(across(float(np.median(known))))
    parts.append(f'<line class="median" x1="{at:.1f}" x2="{at:.1f}" y1="8" y2="{bottom}"/>')
    parts.append(
        _label_beside(at, 18.0, f"median {float(np.median(known)):.2f} {unit}", width - 120.0, 5.0)
    )
    return svg(width, height, parts)


def budget(shares: Sequence[tuple[str, float, str]]) -> str:
    """One bar of shares that fills the width of the page.

    Args:
        shares: (word, share from 0 to 1, colour).
    """
    parts = []
    at = 0.0
    for word, share, colour in shares:
        if share > 0:
            parts.append(
                f'<rect fill="{colour}" x="{at * WIDTH:.1f}" y="0" width="{share * WIDTH:.1f}" '
                'height="26">'
                f"<title>{escape(word)} {share:.1%}</title></rect>"
            )
        at += share
    return svg(WIDTH, 26, parts)


def picture(
    depth: NDArray[np.uint16],
    uv: Array,
    bones: Sequence[tuple[int, int]],
    left: int,
    top: int,
    reach_mm: float,
) -> str:
    """A depth picture cut out of a frame, with the skeleton over it.

    Near is light: from the floor around the animal to `reach_mm` above it, so that walls do not
    take all the colours.

    Args:
        depth: (h, w) uint16 mm, 0 where unread.
        uv: (J, 2) joints, px of the whole frame, counted from the centre of its first pixel.
        bones: pairs of joints.
        left: column of the frame at which the picture begins, px.
        top: row of the frame at which the picture begins, px.
        reach_mm: height above the floor from which on everything is light, mm.
    """
    h, w = depth.shape
    points = (
        uv - [left, top] + 0.5
    )  # the paper counts from the corner of the picture, we from a pixel's centre
    r = w / 70.0
    parts = [f'<image href="{png_uri(shade(depth, reach_mm))}" width="{w}" height="{h}"/>']
    for a, b in bones:
        (x0, y0), (x1, y1) = points[a], points[b]
        parts.append(
            f'<line x1="{x0:.1f}" y1="{y0:.1f}" x2="{x1:.1f}" y2="{y1:.1f}" stroke="#fff" '
            f'stroke-width="{0.8 * r:.2f}"/>'
        )
    for k, (x, y) in enumerate(points):
        fill = "#fff" if k < len(points) - 1 else "#EE6677"
        parts.append(
            f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{r:.2f}" fill="{fill}" stroke="#222" '
            f'stroke-width="{0.25 * r:.2f}"/>'
        )
    return svg(w, h, parts)


def shade(depth: NDArray[np.uint16], reach_mm: float) -> NDArray[np.uint8]:
    """Colours (h, w, 3) RGB uint8 of a depth picture: far dark, near light, unread grey (viridis).

    Args:
        depth: (h, w) uint16 mm, 0 where unread; the floor is taken at its 95 % quantile.
        reach_mm: how much nearer than the floor is the lightest colour, mm.
    """
    read = depth > 0
    if not read.any():
        return np.full((*depth.shape, 3), 90, np.uint8)
    far = float(np.percentile(depth[read], 95.0)) + 3.0
    share = np.clip((far - depth) / reach_mm, 0.0, 1.0)
    at = share * (len(_VIRIDIS) - 1)
    low = np.minimum(at.astype(int), len(_VIRIDIS) - 2)
    rgb = _VIRIDIS[low] + (at - low)[..., None] * (_VIRIDIS[low + 1] - _VIRIDIS[low])
    rgb[~read] = 90.0
    return rgb.astype(np.uint8)


def png_uri(rgb: NDArray[np.uint8]) -> str:
    """A picture as a data URI of a PNG.

    Args:
        rgb: (h, w, 3) uint8 RGB.
    """
    import cv2

    _, encoded = cv2.imencode(".png", np.ascontiguousarray(rgb[..., ::-1]))
    return "data:image/png;base64," + base64.b64encode(encoded.tobytes()).decode()


def viridis(share: float) -> str:
    """A colour of the map viridis, as #rrggbb.

    Args:
        share: from 0 (dark) to 1 (light).
    """
    at = min(max(share, 0.0), 1.0) * (len(_VIRIDIS) - 1)
    low = min(int(at), len(_VIRIDIS) - 2)
    r, g, b = _VIRIDIS[low] + (at - low) * (_VIRIDIS[low + 1] - _VIRIDIS[low])
    return f"#{int(r):02x}{int(g):02x}{int(b):02x}"


_HATCH = (
    '<defs><pattern id="hatch" width="6" height="6" patternUnits="userSpaceOnUse" '
    'patternTransform="rotate(45)"><line class="hatch" x1="0" y1="0" x2="0" '
    'y2="6"/></pattern></defs>'
)


def svg(width: float, height: float, parts: Sequence[str]) -> str:
    """A figure of this size, which scales with the page, as an SVG element.

    Args:
        width: width of its viewBox.
        height: height of its viewBox.
        parts: its elements, as SVG text.
    """
    return f'<svg viewBox="0 0 {width:g} {height:g}" role="img">{"".join(parts)}</svg>'


def _label_beside(x: float, y: float, text: str, right_until: float, away: float) -> str:
    """A label to the right of x, or to the left of it where it would run out of the paper."""
    right = x <= right_until
    at, anchor = (x + away, "start") if right else (x - away, "end")
    return (
        f'<text class="label" x="{at:.1f}" y="{y:.1f}" text-anchor="{anchor}">{escape(text)}</text>'
    )


def _bar(
    time: Scale, start: float, stop: float, y: float, height: float, fill: str, title: str
) -> str:
    x0 = float(time(start))
    x1 = float(time(stop))
    return (
        f'<rect fill="{fill}" x="{x0:.2f}" y="{y:.1f}" width="{max(x1 - x0, 0.5):.2f}" '
        f'height="{height:.1f}">'
        f"<title>{escape(title)}</title></rect>"
    )


def y_axis(scale: Scale, unit: str, about: int, x0: float = LEFT, x1: float = WIDTH - RIGHT) -> str:
    """Ticks and lines of the vertical axis, with its unit.

    Args:
        scale: the axis.
        unit: its unit.
        about: how many ticks are wanted.
        x0: left end of the lines.
        x1: right end of the lines.
    """
    marks = []
    for tick in scale.ticks(about):
        y = float(scale(tick))
        marks.append(f'<line class="grid" x1="{x0}" x2="{x1}" y1="{y:.1f}" y2="{y:.1f}"/>')
        marks.append(
            f'<text class="tick" x="{x0 - 6}" y="{y + 3.5:.1f}" text-anchor="end">{tick:g}</text>'
        )
    middle = 0.5 * (scale.start + scale.stop)
    label = (
        f'<text class="label" transform="translate({x0 - 42:.0f} {middle:.0f}) rotate(-90)" '
        'text-anchor="middle">'
        f"{escape(unit)}</text>"
    )
    return "".join(marks) + label


def x_axis(time: Scale, bottom: float, top: float, last: bool) -> str:
    """The time axis: times below the last of several figures, thin lines in the others.

    Args:
        time: the time axis, s; beyond three minutes it is written in minutes.
        bottom: lower end of the lines.
        top: upper end of the lines.
        last: whether the times are written.
    """
    unit, size = ("min", 60.0) if time.high > 180 else ("s", 1.0)
    shown = Scale(time.low / size, time.high / size, time.start, time.stop)
    marks = [f'<line class="axis" x1="{time.start}" x2="{time.stop}" y1="{bottom}" y2="{bottom}"/>']
    for tick in shown.ticks(8):
        x = float(shown(tick))
        marks.append(f'<line class="grid" x1="{x:.1f}" x2="{x:.1f}" y1="{top}" y2="{bottom}"/>')
        if last:
            text = f"{tick:g} {unit}"
            marks.append(
                f'<text class="tick" x="{x:.1f}" y="{bottom + 16}" '
                f'text-anchor="middle">{text}</text>'
            )
    return "".join(marks)


def x_ticks(scale: Scale, bottom: float, unit: str, about: int) -> str:
    """Ticks below a figure, with their unit.

    Args:
        scale: the axis.
        bottom: where the axis stands.
        unit: its unit.
        about: how many ticks are wanted.
    """
    marks = [
        f'<line class="axis" x1="{scale.start}" x2="{scale.stop}" y1="{bottom}" y2="{bottom}"/>'
    ]
    marks += [
        f'<text class="tick" x="{float(scale(tick)):.1f}" y="{bottom + 16}" '
        f'text-anchor="middle">{tick:g}</text>'
        for tick in scale.ticks(about)
    ]
    middle = 0.5 * (scale.start + scale.stop)
    label = (
        f'<text class="label" x="{middle:.0f}" y="{bottom + 31}" '
        f'text-anchor="middle">{escape(unit)}</text>'
    )
    return "".join(marks) + label


def _frame(across: Scale, up: Scale) -> str:
    """A square plot's frame with millimetres on both sides."""
    bottom = up.start
    top = up.stop
    box = (
        f'<rect class="box" x="{across.start}" y="{top}" width="{across.stop - across.start}" '
        f'height="{bottom - top}"/>'
    )
    return box + y_axis(up, "mm", 5, across.start, across.stop) + x_ticks(across, bottom, "mm", 5)


def _paths(x: Array, y: Array) -> list[str]:
    """Path data of a curve; of a long one every column keeps its lowest and highest point."""
    rows = kept_rows(y, _MAX_COLUMNS)
    return _broken(x[rows], y[rows])


def kept_rows(y: Array, n_columns: int) -> NDArray[np.int64]:
    """(k,) int64 rows of a curve to draw: all, or each column's lowest and highest.

    Of a short curve all rows are kept. A column with an unknown value keeps that one, so that the
    hole is seen (min-max decimation).

    Args:
        y: (n,) the curve; NaN where unknown.
        n_columns: columns of the paper; a curve of more than twice as many values is long.
    """
    if len(y) <= 2 * n_columns:
        return np.arange(len(y))
    edges = np.linspace(0, len(y), n_columns + 1).astype(int)
    rows: list[int] = []
    for a, b in pairwise(edges):
        part = y[a:b]
        if np.isfinite(part).all():
            rows += sorted({a + int(part.argmin()), a + int(part.argmax())})
        else:  # a column with a hole shows the hole
            rows += [a, a + int(np.flatnonzero(~np.isfinite(part))[0])]
    return np.array(rows, np.int64)


def _broken(x: Array, y: Array) -> list[str]:
    """Path data of a line, interrupted where a point is unknown; a lone point becomes a dot."""
    known = np.isfinite(x) & np.isfinite(y)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], known, [False]]).astype(int)))
    paths = []
    for a, b in edges.reshape(-1, 2):
        points = [f"{px:.1f} {py:.1f}" for px, py in zip(x[a:b], y[a:b], strict=True)]
        paths.append("M" + "L".join(points) + ("h0.1" if len(points) == 1 else ""))
    return paths
