"""Figure 19 of the Lie-X paper: key frames and path of each action, as PNG."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from .looks import DPI

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_COLUMNS = 3
_SCALE_MM = 20.0
_BODY = "#b9bfc5"
_BONE = "#3a4046"
_MARGIN_MM = 8.0


def draw_key_frames(acts: Sequence[Mapping[str, Any]], path: Path) -> Path:
    """Write the figure of some actions.

    Args:
        acts: of each action `word`, `side`, `path_mm`, `bodies_mm`, `skeletons_mm`, `edges` and
            `seconds`.
        path: the PNG to write; its folder is made.

    Returns:
        `path`.
    """
    from matplotlib.figure import Figure

    rows = -(-len(acts) // _COLUMNS)
    figure = Figure(figsize=(3.6 * _COLUMNS, 3.5 * rows + 0.4), layout="constrained")
    grid = figure.subplots(rows, _COLUMNS, squeeze=False)
    for panel, act in zip(grid.flat, acts, strict=False):
        _act(panel, act)
    for panel in grid.flat[len(acts) :]:
        panel.set_axis_off()
    figure.suptitle(
        "Key frames of the fish's actions, and the path of the middle of its body from blue to "
        "red; bar: 20 mm",
        fontsize=9,
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=DPI)
    return path


def _act(panel: Axes, act: Mapping[str, Any]) -> None:
    for body in act["bodies_mm"]:
        panel.plot(body[:, 0], body[:, 1], ".", color=_BODY, ms=1.6, alpha=0.6)
    for joints in act["skeletons_mm"]:
        for a, b in act["edges"]:
            panel.plot(joints[[a, b], 0], joints[[a, b], 1], "-", color=_BONE, lw=0.9)
    way = act["path_mm"]
    panel.scatter(
        way[:, 0], way[:, 1], c=np.linspace(0, 1, len(way)), cmap="coolwarm", s=9, zorder=3
    )
    everything = np.concatenate([way, *act["bodies_mm"], *act["skeletons_mm"]])
    low, high = everything.min(axis=0), everything.max(axis=0)
    half = 0.5 * float((high - low).max()) + _MARGIN_MM  # square, whatever way it goes
    low, high = 0.5 * (low + high) - half, 0.5 * (low + high) + half
    panel.plot(
        [low[0] + 2.0, low[0] + 2.0 + _SCALE_MM], [low[1] + 2.0] * 2, "-", color="#000000", lw=2
    )
    panel.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), xticks=[], yticks=[])
    panel.set_aspect("equal")
    where = "from the side" if act["side"] else "from above"
    name = act["word"].replace("_", " ")
    panel.set_title(f"{name}, {1000 * act['seconds']:.0f} ms, {where}", fontsize=9)
