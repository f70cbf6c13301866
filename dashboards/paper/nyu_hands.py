"""Figure 12 of the Lie-X paper: NYU hands with published poses and ours; PNG by matplotlib.

The fourteen labelled points of each hand are joined to a skeleton and seen from the camera. The
pictures themselves are not drawn: they may not be passed on, and most users have few of them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from liex_lab.recordings.formats.images.nyu import POINTS

from .looks import DPI, TRUE

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Array = NDArray[np.float64]

_NAMES = {
    "liex_lab": "liex_lab",
    "liex": "Lie-X, palm on\nthe true palm",
    "v2v_posenet": "V2V-PoseNet",
    "generalized_feedback": "Generalized\nFeedback",
    "deepprior": "DeepPrior",
}
_BONES = (
    *((f"{finger}_tip", f"{finger}_mid") for finger in ("pinky", "ring", "middle", "index")),
    *((f"{finger}_mid", "palm") for finger in ("pinky", "ring", "middle", "index")),
    ("thumb_tip", "thumb_mid"),
    ("thumb_mid", "thumb_base"),
    ("thumb_base", "palm"),
    ("wrist_a", "palm"),
    ("wrist_b", "palm"),
)
_POSE = "#CC3311"
_PANEL_INCH = 1.15
_ROOM = 1.3  # of the reach of the true points


def draw_nyu_hands(hands: Sequence[Mapping[str, Any]], path: Path) -> Path:
    """Write a picture of NYU hands: a column a frame, a row a method, the truth in each.

    Args:
        hands: of each `frame`, `truth` (14, 3) mm, camera frame, and `answers` by method.
        path: the PNG to write.

    Returns:
        `path`.
    """
    from matplotlib.figure import Figure

    met = dict.fromkeys(name for one in hands for name in one["answers"])
    names = sorted(met, key=lambda name: [*_NAMES, name].index(name)) or ["labels"]
    figure = Figure(
        figsize=(_PANEL_INCH * len(hands) + 1.2, (_PANEL_INCH + 0.2) * len(names) + 0.7),
        layout="constrained",
    )
    grid = figure.subplots(len(names), len(hands), squeeze=False)
    for line, name in zip(grid, names, strict=True):
        for panel, one in zip(line, hands, strict=True):
            _panel(panel, one["truth"], one["answers"].get(name))
        line[0].set_ylabel(_NAMES.get(name, name), fontsize=8)
    for panel, one in zip(grid[0], hands, strict=True):
        panel.set_title(f"frame {one['frame']}\n{panel.get_title()}", fontsize=7)
    figure.suptitle(
        "NYU test frames, 14 points: labels, blue; answer, red; mean error in mm", fontsize=9
    )
    figure.savefig(path, dpi=DPI)
    return path


def _panel(panel: Axes, truth: Array, answer: Array | None) -> None:
    """One hand's true points and an answer, (14, 3) mm, seen from the camera."""
    panel.set(xticks=[], yticks=[])
    _skeleton(panel, truth, TRUE)
    middle = 0.5 * (truth.min(axis=0) + truth.max(axis=0))
    half = 0.5 * _ROOM * float(np.ptp(truth[:, :2], axis=0).max())
    panel.set_xlim(middle[0] - half, middle[0] + half)
    panel.set_ylim(middle[1] + half, middle[1] - half)
    panel.set_aspect("equal")
    if answer is None:
        panel.set_title("no picture", fontsize=7)
        return
    _skeleton(panel, answer, _POSE)
    error = float(np.linalg.norm(answer - truth, axis=-1).mean())
    panel.set_title(f"{error:.1f} mm", fontsize=7)


def _skeleton(panel: Axes, points: Array, colour: str) -> None:
    at = dict(zip(POINTS, points[:, :2], strict=True))
    for a, b in _BONES:
        (x, y), (u, v) = at[a], at[b]
        panel.plot([x, u], [y, v], "-", color=colour, lw=1.2, solid_capstyle="round")
