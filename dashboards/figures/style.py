"""The one style of all figures: sizes in mm, fonts, colours, panels, scale bars, and their bytes.

A figure is one or two columns of a journal wide. Its texts stay text, in SVG and in PDF, so that an
editor can change them. The four colours of ink and paper are told apart in the SVG, so that a page
can put its own in their place (dark mode).
"""

from __future__ import annotations

import io
import re
import threading
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

FORMATS = ("svg", "pdf", "png")
ONE_COLUMN_MM = 89.0
TWO_COLUMNS_MM = 183.0
LEFT_MM = 27.0  # of all figures over time, so that their axes stand below each other
RIGHT_MM = 5.0
INK = "#1f2328"
MUTED = "#626a73"
LINE = "#d9dbd7"
SOFT = "#f2f2ee"
PAPER = "#fdfdfb"
BLUE = "#4477aa"
GREEN = "#228833"
PURPLE = "#aa3377"
# Okabe and Ito's colours, which colour-blind people tell apart; every group has its own mark, too
# the first group is the reference, in grey
GROUP_COLOURS = ("#7f7f7f", "#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")
GROUP_MARKS = ("o", "s", "D", "^", "P", "X", "*")
_PAGE = {INK: "--ink", MUTED: "--muted", LINE: "--line", SOFT: "--soft", PAPER: "--paper"}
_FACE = "'DejaVu Sans'"  # comes with matplotlib: the same figure on every machine
_FACES = "Arial, Helvetica, 'DejaVu Sans', sans-serif"  # narrower ones fit, too
_KEYS = 6  # actions of a row of the key
_BARS_MM = (10.0, 20.0, 50.0, 100.0, 200.0, 500.0, 1000.0)
_ONE_AT_A_TIME = threading.RLock()  # matplotlib's settings are the process's
_STYLE: dict[str, Any] = {
    "font.family": ["DejaVu Sans"],
    "font.size": 6.5,
    "axes.titlesize": 7.0,
    "axes.titlelocation": "left",
    "axes.titlepad": 4.0,
    "axes.titley": 1.0,  # where it is would be looked for at every drawing
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
    "text.parse_math": False,  # a dollar in a name is a dollar
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

    A letter that the font lacks is no reason to complain: in an SVG the reader's font has it.
    """
    from matplotlib import rc_context

    style: Any = _STYLE  # matplotlib lists every name that a setting can have
    with _ONE_AT_A_TIME, rc_context(style), warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Glyph .* missing from", UserWarning)
        yield


def sheet(width_mm: float, height_mm: float) -> Figure:
    """An empty figure of a size on paper.

    Args:
        width_mm: its width, mm.
        height_mm: its height, mm.
    """
    from matplotlib.figure import Figure

    return Figure(figsize=(width_mm / 25.4, height_mm / 25.4))


def panel(
    figure: Figure, left_mm: float, bottom_mm: float, width_mm: float, height_mm: float
) -> Axes:
    """Axes at a place on the paper.

    Args:
        figure: the figure.
        left_mm: left edge of the axes' box from that of the paper, mm.
        bottom_mm: its lower edge from that of the paper, mm.
        width_mm: its width, mm.
        height_mm: its height, mm.
    """
    across, up = figure.get_size_inches() * 25.4
    place = (left_mm / across, bottom_mm / up, width_mm / across, height_mm / up)
    return figure.add_axes(place)


def heading(figure: Figure, text: str) -> None:
    """A title over the whole width of a figure, at its upper left corner.

    Args:
        figure: the figure.
        text: the title, perhaps of several lines.
    """
    across, up = figure.get_size_inches() * 25.4
    figure.text(2.0 / across, 1.0 - 2.0 / up, text, size=7.0, va="top")


def bar_length_mm(extent_mm: float) -> float:
    """A round length of a scale bar: about a quarter of the extent, mm.

    Args:
        extent_mm: what the panel shows across, mm.
    """
    fitting = [length for length in _BARS_MM if length <= 0.35 * extent_mm]
    return fitting[-1] if fitting else _BARS_MM[0]


def scale_bar(axes: Axes) -> float:
    """Draw a scale bar below a panel whose axes count millimetres; returns its length, mm.

    Args:
        axes: the panel; its limits have to stand.
    """
    left, right = axes.get_xlim()
    low, high = axes.get_ylim()
    length = bar_length_mm(right - left)
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
    """Let a panel show a square of the floor, without axes.

    Args:
        axes: the panel.
        low_mm: (2,) smallest x and y to be seen, mm.
        high_mm: (2,) largest.
    """
    middle = 0.5 * (np.asarray(low_mm) + np.asarray(high_mm))
    reach = 0.52 * max(float(np.max(np.asarray(high_mm) - np.asarray(low_mm))), 20.0)
    axes.set_xlim(middle[0] - reach, middle[0] + reach)
    axes.set_ylim(middle[1] - reach, middle[1] + reach)
    axes.set_aspect("equal")
    axes.set_axis_off()


def time_unit(duration_s: float) -> tuple[str, float]:
    """Unit of an axis of time and its length: s, min beyond three minutes, h beyond three hours.

    Args:
        duration_s: what the axis shows, s.
    """
    if duration_s > 3 * 3600:
        return "h", 3600.0
    return ("min", 60.0) if duration_s > 180 else ("s", 1.0)


def halo(text: Any) -> None:
    """Let a text be read upon anything: paper behind it, as an outline would make shapes of it.

    Args:
        text: matplotlib's text.
    """
    behind = {"boxstyle": "round,pad=0.15", "facecolor": PAPER, "alpha": 0.75, "linewidth": 0.0}
    text.set_bbox(behind)


def key_rows(words: Sequence[str]) -> int:
    """Rows that the key of some actions takes, of 4 mm each.

    Args:
        words: the actions.
    """
    return -(-len(words) // _KEYS)


def action_key(figure: Figure, colours: Mapping[str, str]) -> None:
    """The colours of actions, at the lower edge of a figure.

    Args:
        figure: the figure; `key_rows` says how much room is needed.
        colours: action -> colour.
    """
    from matplotlib.patches import Patch

    marks = [Patch(color=colour, label=word.replace("_", " ")) for word, colour in colours.items()]
    if marks:
        figure.legend(handles=marks, loc="lower center", ncols=_KEYS, handlelength=1.0)


def image_bytes(figure: Figure, kind: str) -> bytes:
    """A figure as a file, the same bytes whenever it is drawn; call it inside `drawing()`.

    Args:
        figure: the figure.
        kind: 'svg', 'pdf' or 'png'.
    """
    held = io.BytesIO()
    undated: dict[str, dict[str, Any]] = {
        "svg": {"Date": None},
        "pdf": {"CreationDate": None},
        "png": {"Software": None},
    }
    paper = "white" if kind == "png" else "none"
    figure.savefig(held, format=kind, metadata=undated[kind], facecolor=paper)
    made = held.getvalue()
    if kind == "svg":
        return made.replace(_FACE.encode(), _FACES.encode())
    return made


def on_page(svg: bytes, name: str, title: str) -> str:
    """A figure's SVG as an element of a page: no ids twice, the page's ink, paper and font.

    Args:
        svg: what `image_bytes` gave.
        name: of the figure, unlike all others of the page.
        title: what it shows, for those who cannot see it.
    """
    from html import escape

    text = svg.decode("utf-8")
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    text = re.sub(r"<style type=.*?</style>", "", text, flags=re.DOTALL)
    text = re.sub(r"<!--.*?-->", "", text, flags=re.DOTALL)
    box = re.search(r'viewBox="[^"]*"', text)
    shape = box[0] if box else ""
    text = re.sub(
        r"<svg[^>]*>",
        f'<svg {shape} role="img" aria-label="{escape(title)}">',
        text,
        count=1,
    )
    text = text.replace("xlink:href=", "href=")
    # groups are named in the files, for editors; on the page only what is pointed to needs a name
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
