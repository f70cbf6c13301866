"""Confusion matrices of action recognition by recogniser (Fig. 20 of the Lie-X paper), as PNG."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_PANELS = {
    "tangent": "paper's, tangent vectors",
    "joints": "paper's, joint positions",
    "default": "default",
}
_DPI = 110


def draw_confusions(result: Mapping[str, Any], path: Path) -> Path:
    """Write the confusion matrices of cut-out actions, rows what it was, shares in per cent.

    Args:
        result: what `evaluate_actions` found: confusion, accuracies and their 95 % intervals.
        path: the PNG to write; its folder is made.

    Returns:
        `path`.
    """
    from matplotlib.figure import Figure

    words = [str(word).replace("_", " ") for word in result["confusion"]["words"]]
    side = 1.6 + 0.42 * len(words)
    figure = Figure(figsize=(3 * side, side + 0.4), layout="constrained")
    panels = figure.subplots(1, len(_PANELS))
    shares = [result[f"{name}_accuracy"] for name in ("tangent", "joint", "default")]
    for k, ((name, title), share) in enumerate(zip(_PANELS.items(), shares, strict=True)):
        low, high = result["accuracy_interval95"][name]
        panels[k].set_title(
            f"{title}: {share:.1%} ({100 * low:.1f} to {100 * high:.1f})", fontsize=9
        )
        _matrix(panels[k], np.asarray(result["confusion"][name], float), words, first=k == 0)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=_DPI, bbox_inches="tight")
    return path


def _matrix(panel: Axes, counts: np.ndarray, words: list[str], first: bool) -> None:
    """One matrix; a cell of nothing is left empty."""
    share = 100.0 * counts / np.maximum(counts.sum(axis=1, keepdims=True), 1.0)
    panel.imshow(share, cmap="Blues", vmin=0.0, vmax=100.0)
    for row, column in zip(*np.nonzero(counts), strict=True):
        value = share[row, column]
        panel.text(
            column,
            row,
            f"{value:.0f}",
            ha="center",
            va="center",
            fontsize=7,
            color="white" if value > 55.0 else "black",
        )
    panel.set_xticks(
        range(len(words)), words, rotation=60, ha="right", rotation_mode="anchor", fontsize=7
    )
    panel.set_yticks(range(len(words)), words if first else [""] * len(words), fontsize=7)
    panel.set_xlabel("taken for", fontsize=8)
    if first:
        panel.set_ylabel("what it was", fontsize=8)
