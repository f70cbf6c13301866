"""Figures 9 to 12 and 17 of the Lie-X paper: poses of all methods beside the truth, and failures.

Written as PNG with matplotlib; nothing is computed here. Pictures from above show the depth as the
camera sees it; those from the side the same points along the depth.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from textwrap import fill
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from .looks import DPI, METHODS, TRUE

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Array = NDArray[np.float64]

_PANEL_INCH = 1.65
_LETTER_INCH = 0.07  # of a title
_NEAR = 0.55  # of the animal's length: half of the depth that pictures show
_BESIDE = 1.5  # of the truth's reach: what lies farther off is not of the animal
_GREY = "#8a8f94"
_ERROR = "#CC3311"


def draw_poses(animal: str, shown: Sequence[Mapping[str, Any]], path: Path, side: bool) -> Path:
    """Write a picture of example frames: a column a frame, a row a method, the truth in each.

    Args:
        animal: its name.
        shown: frames with `depth`, `camera`, `truth` and `poses` by method.
        path: the PNG to write.
        side: look from the side, along the picture's rows, instead of along the optical axis.

    Returns:
        `path`.
    """
    from matplotlib.figure import Figure

    names = [name for name in METHODS if any(name in one["poses"] for one in shown)]
    figure = Figure(
        figsize=(_PANEL_INCH * len(shown) + 1.3, (_PANEL_INCH + 0.2) * len(names) + 0.7),
        layout="constrained",
    )
    grid = figure.subplots(len(names), len(shown), squeeze=False)
    for line, name in zip(grid, names, strict=True):
        for panel, one in zip(line, shown, strict=True):
            _panel(panel, one, name, side)
        line[0].set_ylabel(METHODS[name][0].replace(", ", ",\n"), fontsize=8)
    for panel, one in zip(grid[0], shown, strict=True):
        panel.set_title(f"{one['split']}\n{panel.get_title()}", fontsize=8)
    where = "from the side" if side else "from the camera"
    _entitle(
        figure, f"{animal}, {where}: truth, blue; pose of each method, red; dot: base; error in mm"
    )
    figure.savefig(path, dpi=DPI)
    return path


def draw_failures(
    animal: str, failures: Mapping[str, Sequence[Mapping[str, Any]]], path: Path
) -> Path:
    """Write a picture of the worst frames of some methods, a row a method.

    Args:
        animal: its name.
        failures: by method frames with `depth`, `camera`, `truth` and `poses`.
        path: the PNG to write.

    Returns:
        `path`.
    """
    from matplotlib.figure import Figure

    n = max(len(some) for some in failures.values())
    figure = Figure(
        figsize=(_PANEL_INCH * n + 1.3, (_PANEL_INCH + 0.45) * len(failures) + 0.5),
        layout="constrained",
    )
    grid = figure.subplots(len(failures), n, squeeze=False)
    for line, (name, some) in zip(grid, failures.items(), strict=True):
        for panel in line[len(some) :]:
            panel.set_axis_off()
        for panel, one in zip(line, some, strict=False):
            _panel(panel, one, name, False)
            panel.set_title(f"{one['split']}\n{panel.get_title()}", fontsize=8)
        line[0].set_ylabel(METHODS[name][0].replace(", ", ",\n"), fontsize=8)
    _entitle(figure, f"{animal}, the largest errors: truth, blue; measured, red")
    figure.savefig(path, dpi=DPI)
    return path


def _entitle(figure: Figure, title: str) -> None:
    """A title above the panels, on as many lines as it takes: of few frames a figure is narrow."""
    figure.suptitle(fill(title, int(figure.get_figwidth() / _LETTER_INCH)), fontsize=9)


def _panel(panel: Axes, one: Mapping[str, Any], name: str, side: bool) -> None:
    """One frame with the truth and the pose of one method."""
    panel.set(xticks=[], yticks=[])
    (_from_the_side if side else _from_the_camera)(panel, one)
    _skeleton(panel, one, one["truth"], TRUE, side)
    if name not in one["poses"]:
        panel.set_title("not kept", fontsize=8)
        return
    pose = one["poses"][name]
    if pose is None:
        panel.set_title("nothing found", fontsize=8, color=_ERROR)
        return
    _skeleton(panel, one, pose, _ERROR, side)
    error = float(np.linalg.norm(pose - one["truth"], axis=-1).mean())
    panel.set_title(f"{error:.1f} mm", fontsize=8)


def _from_the_camera(panel: Axes, one: Mapping[str, Any]) -> None:
    """The depth, near dark and far light."""
    depth = one["depth"]
    middle = float(one["truth"][:, 2].mean())
    reach = _NEAR * one["spine_mm"]
    panel.imshow(
        np.where(depth > 0, depth, np.nan),
        cmap="gray",
        vmin=middle - 1.6 * reach,
        vmax=middle + reach,
        interpolation="nearest",
    )
    panel.set_facecolor("#dfe3e6")
    panel.set_xlim(-0.5, depth.shape[1] - 0.5)
    panel.set_ylim(depth.shape[0] - 0.5, -0.5)


def _from_the_side(panel: Axes, one: Mapping[str, Any]) -> None:
    """The points that the camera sees, along the picture's rows."""
    depth = one["depth"].astype(float)
    camera, truth = one["camera"], one["truth"]
    v, u = np.nonzero(depth > 0)
    z = depth[v, u]
    x, y = (u - camera.cx) / camera.fx * z, (v - camera.cy) / camera.fy * z
    low, high = truth.min(axis=0), truth.max(axis=0)
    half = 0.5 * max(float((high - low).max()), 1.0) * _BESIDE
    middle = 0.5 * (low + high)
    near = (abs(x - middle[0]) < half) & (abs(y - middle[1]) < half) & (abs(z - middle[2]) < half)
    panel.plot(x[near], z[near], ".", color=_GREY, ms=1.6, alpha=0.7)
    panel.set_xlim(middle[0] - half, middle[0] + half)
    panel.set_ylim(middle[2] + half, middle[2] - half)
    panel.set_aspect("equal")


def _skeleton(panel: Axes, one: Mapping[str, Any], joints: Array, colour: str, side: bool) -> None:
    at = joints[:, [0, 2]] if side else one["camera"].project(joints)
    for a, b in one["edges"]:
        panel.plot(at[[a, b], 0], at[[a, b], 1], "-", color=colour, lw=1.4, solid_capstyle="round")
    panel.plot(*at[0], "o", color=colour, ms=3.5)
