"""The style of all figures: sizes in mm, fonts, colours, panels, scale bars, and file contents.

A figure is one or two journal columns wide. Texts stay text in SVG and PDF, so that they can be
edited. The colours of ink and paper are distinct in the SVG, so that a page can replace them (dark
mode).
"""

import io
import re
import threading
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from html import escape
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from liex_lab.arrays import Array

FORMATS = ("svg", "pdf", "png")
ONE_COLUMN_MM = 89.0
TWO_COLUMNS_MM = 183.0
LEFT_MM = 27.0  # of all figures over time, so that their axes align
RIGHT_MM = 5.0
INK = "#1f2328"
MUTED = "#626a73"
LINE = "#d9dbd7"
SOFT = "#f2f2ee"
PAPER = "#fdfdfb"
BLUE = "#4477aa"
# Okabe and Ito's colour-blind safe colours; every group also has its own mark
# the first group is the reference, in grey
GROUP_COLOURS = ("#7f7f7f", "#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")
GROUP_MARKS = ("o", "s", "D", "^", "P", "X", "*")
_PAGE = {INK: "--ink", MUTED: "--muted", LINE: "--line", SOFT: "--soft", PAPER: "--paper"}
_FACES = "Arial, Helvetica, 'DejaVu Sans', sans-serif"  # narrower fonts fit as well
_KEYS = 6  # actions per row of the key
_BARS_MM = (10.0, 20.0, 50.0, 100.0, 200.0, 500.0, 1000.0)
_ONE_AT_A_TIME = threading.RLock()  # matplotlib's settings are global
_STYLE: dict[str, Any] = {
    "font.family": ["DejaVu Sans"],
    "font.size": 6.5,
    "axes.titlesize": 7.0,
    "axes.titlelocation": "left",
    "axes.titlepad": 4.0,
    "axes.titley": 1.0,  # else computed at every drawing
    "axes.labelsize": 6.5,
    "axes.labelpad": 2.0,
    "axes.linewidth": 0.6,
    "axes.edgecolor": MUTED,
    "axes.labelcolor": INK,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.facecolor": "none",
    "figure.facecolor": "none",
    "text.color": INK,
    "text.parse_math": False,  # a dollar sign is literal
    "xtick.color": MUTED,
    "ytick.color": MUTED,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "xtick.labelsize": 6.0,
    "ytick.labelsize": 6.0,
    "xtick.major.size": 2.0,
    "ytick.major.size": 2.0,
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "xtick.major.pad": 1.5,
    "ytick.major.pad": 1.5,
    "lines.linewidth": 0.7,
    "lines.solid_joinstyle": "round",
    "patch.linewidth": 0.5,
    "hatch.linewidth": 0.4,
    "legend.frameon": False,
    "legend.fontsize": 6.0,
    "svg.fonttype": "none",
    "svg.hashsalt": "liex_lab",
    "pdf.fonttype": 42,
    "path.simplify": True,
    "savefig.dpi": 300,
}


@contextmanager
def drawing() -> Iterator[None]:
    """The style, while figures are drawn and written.

    Warnings of missing glyphs are suppressed, because an SVG uses the reader's font.
    """
    style: Any = _STYLE  # matplotlib types every setting's name
    with _ONE_AT_A_TIME, rc_context(style), warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Glyph .* missing from", UserWarning)
        yield


def sheet(width_mm: float, height_mm: float) -> Figure:
    """An empty figure of a size in mm."""
    return Figure(figsize=(width_mm / 25.4, height_mm / 25.4))


def panel(
    figure: Figure, left_mm: float, bottom_mm: float, width_mm: float, height_mm: float
) -> Axes:
    """Axes at a position of the figure.

    Args:
        figure: the figure.
        left_mm: left edge of the axes' box from the figure's left edge, mm.
        bottom_mm: its lower edge from the figure's lower edge, mm.
        width_mm: its width, mm.
        height_mm: its height, mm.
    """
    across, up = figure.get_size_inches() * 25.4
    return figure.add_axes((left_mm / across, bottom_mm / up, width_mm / across, height_mm / up))


def one_panel(
    size_mm: tuple[float, float], box_mm: tuple[float, float, float, float], title: str = ""
) -> tuple[Figure, Axes]:
    """A figure of a size with one panel at a position, see `panel`, and the panel's title."""
    figure = sheet(*size_mm)
    axes = panel(figure, *box_mm)
    axes.set_title(title)
    return figure, axes


def heading(figure: Figure, text: str) -> None:
    """A title at the upper left corner of a figure, possibly of several lines."""
    across, up = figure.get_size_inches() * 25.4
    figure.text(2.0 / across, 1.0 - 2.0 / up, text, size=7.0, va="top")


def scale_bar(axes: Axes) -> float:
    """Draw a scale bar below a panel with axes in millimetres; returns its length, mm.

    The panel's limits must already be set.
    """
    left, right = axes.get_xlim()
    low, high = axes.get_ylim()
    # about a quarter of the panel, and round
    length = max([mm for mm in _BARS_MM if mm <= 0.35 * (right - left)], default=_BARS_MM[0])
    y = low - 0.03 * (high - low)
    axes.plot(
        [left, left + length],
        [y, y],
        color=INK,
        linewidth=1.6,
        solid_capstyle="butt",
        clip_on=False,
        gid="scale-bar",
    )
    text = f"{length:g} mm" if length < 1000 else f"{length / 1000:g} m"
    axes.text(left + 0.5 * length, y - 0.015 * (high - low), text, ha="center", va="top", size=6.0)
    return length


def floor_limits(axes: Axes, low_mm: Any, high_mm: Any) -> None:
    """Show a square of the floor in a panel, without axes.

    Args:
        axes: the panel.
        low_mm: (2,) smallest visible x and y, mm.
        high_mm: (2,) largest visible x and y, mm.
    """
    middle = 0.5 * (np.asarray(low_mm) + np.asarray(high_mm))
    reach = 0.52 * max(float(np.max(np.asarray(high_mm) - np.asarray(low_mm))), 20.0)
    (x0, y0), (x1, y1) = middle - reach, middle + reach
    axes.set(xlim=(x0, x1), ylim=(y0, y1), aspect="equal")
    axes.set_axis_off()


def time_unit(duration_s: float) -> tuple[str, float]:
    """Unit of a time axis and its length, s: s, min (over three minutes) or h (over three
    hours).
    """
    if duration_s > 3 * 3600:
        return "h", 3600.0
    return ("min", 60.0) if duration_s > 180 else ("s", 1.0)


def halo(text: Any) -> None:
    """Put a box of paper behind a text, for legibility; an outline would turn it into shapes."""
    text.set_bbox(
        {"boxstyle": "round,pad=0.15", "facecolor": PAPER, "alpha": 0.75, "linewidth": 0.0}
    )


def key_rows(words: Sequence[str]) -> int:
    """Rows of 4 mm in the key of some actions."""
    return -(-len(words) // _KEYS)


def action_key(figure: Figure, colours: Mapping[str, str]) -> None:
    """The colours of actions, at the lower edge of a figure; its height is that of `key_rows`.

    Args:
        figure: the figure.
        colours: action -> colour.
    """
    marks = [Patch(color=colour, label=word.replace("_", " ")) for word, colour in colours.items()]
    if marks:
        figure.legend(handles=marks, loc="lower center", ncols=_KEYS, handlelength=1.0)


def name_rows(axes: Axes, names: Sequence[str], least: int = 0) -> None:
    """Name the rows of a panel, the first on top; at least `least` rows."""
    axes.set_yticks(range(len(names)), names)
    axes.set_ylim(max(len(names), least) - 0.5, -0.5)
    axes.tick_params(axis="y", length=0)


def draw_spans(
    axes: Axes,
    spans_s: Array,
    row: tuple[float, float],
    size: float,
    hair_s: float,
    colour: str = "",
    **style: Any,
) -> None:
    """Draw spans of time as bars; without a colour they are hatched, as lost time.

    Args:
        axes: a panel over time.
        spans_s: (n, 2) start and stop of each, s, in order.
        row: lower edge and height of the bars.
        size: the unit of the time axis, s.
        hair_s: the shortest visible time, s; closer spans are joined.
        colour: of the bars.
        style: further arguments of `broken_barh`.
    """
    bars = [(a, b - a) for a, b in joined(spans_s.tolist(), hair_s)]
    if colour:
        style["facecolor"] = colour
        bars = [(a, max(length, hair_s)) for a, length in bars]
    else:  # over the bars: a bout across a gap has no bar there
        style |= {"facecolor": PAPER, "edgecolor": MUTED, "linewidth": 0.0, "hatch": "//////"}
        style["zorder"] = 1.5
    axes.broken_barh([(a / size, length / size) for a, length in bars], row, **style)


def joined(spans: Sequence[Sequence[float]], least_s: float) -> list[tuple[float, float]]:
    """Spans in order; spans closer than `least_s` are joined, up to 40 times that length.

    Args:
        spans: start and stop of each, s, in order.
        least_s: least distance of separate spans, s.
    """
    out: list[tuple[float, float]] = []
    for start, stop in spans:
        if out and start - out[-1][1] < least_s and stop - out[-1][0] < 40 * least_s:
            start = out.pop()[0]
        out.append((start, stop))
    return out


def image_bytes(figure: Figure, kind: str) -> bytes:
    """A figure as a file, with reproducible bytes; call it inside `drawing()`.

    Args:
        figure: the figure.
        kind: 'svg', 'pdf' or 'png'.
    """
    held = io.BytesIO()
    undated: Any = {{"svg": "Date", "pdf": "CreationDate", "png": "Software"}[kind]: None}
    figure.savefig(
        held, format=kind, metadata=undated, facecolor="white" if kind == "png" else "none"
    )
    made = held.getvalue()
    # this font comes with matplotlib: the same figure on every machine
    return made.replace(b"'DejaVu Sans'", _FACES.encode()) if kind == "svg" else made


def on_page(svg: bytes, name: str, title: str) -> str:
    """A figure's SVG as an element of a page: unique ids, the page's ink, paper and font.

    Args:
        svg: the result of `image_bytes`.
        name: of the figure, unique on the page.
        title: its description for screen readers.
    """
    text = svg.decode("utf-8")
    text = text[text.index("<svg") :]
    text = re.sub(
        r"<metadata>.*?</metadata>|<style type=.*?</style>|<!--.*?-->", "", text, flags=re.DOTALL
    ).replace("xlink:href=", "href=")
    shape = "".join(re.findall(r'viewBox="[^"]*"', text)[:1])
    head = f'<svg {shape} role="img" aria-label="{escape(title)}">'
    text = re.sub(r"<svg[^>]*>", lambda _: head, text, count=1)
    # groups have ids in the files, for editors; on the page only referenced ids are needed
    pointed = set(re.findall(r"(?:url\(|href=\")#([^\")]+)", text))
    text = re.sub(
        r' id="([^"]*)"',
        lambda found: f' id="{name}-{found[1]}"' if found[1] in pointed else "",
        text,
    )
    text = re.sub(r"(url\(|href=\")#", rf"\g<1>#{name}-", text)
    for colour, variable in _PAGE.items():
        text = text.replace(colour, f"var({variable})")
    return re.sub(r"\n\s*", "\n", text.replace(_FACES, "var(--face)"))
