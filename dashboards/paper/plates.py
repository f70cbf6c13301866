"""Figures 7 to 11 and 13 to 17 of the Lie-X paper, from what `liex evaluate tables` measured; PNG.

Sensitivity, cumulative error, error per joint, poses beside the truth, ranked pose candidates,
convergence, failures. Nothing is computed here.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from textwrap import fill
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from .looks import DPI, METHODS, TRUE
from .poses import draw_failures, draw_poses

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Array = NDArray[np.float64]

_POSE = "#EE6677"
_CHOSEN = "#DD2222"
_MOST_CANDIDATES = 40
_MOST_STAGES = 8


def draw_figures(results: Mapping[str, Mapping[str, Any]], folder: Path) -> list[Path]:
    """Write all figures of some animals; Fig. 7 where there are curves for it.

    Args:
        results: animal -> `vars` of its `Results`.
        folder: where the PNG files are written.

    Returns:
        Paths of the figures.
    """
    written = []
    if any(one["sensitivity"] for one in results.values()):
        written.append(_save(_sensitivity(results), folder / "fig07_sensitivity.png"))
    written += [
        _save(_cumulative(results), folder / "fig08_cumulative_error.png"),
        _save(_joint_errors(results), folder / "error_per_joint.png"),
    ]
    for animal, one in results.items():
        written.append(
            _save(_candidates(one["illustration"]), folder / f"fig13_candidates_{animal}.png")
        )
        written.append(
            _save(_convergence(one["illustration"]), folder / f"fig16_convergence_{animal}.png")
        )
        if examples := one.get("examples"):
            name = f"{'fig10' if animal == 'hand' else 'fig09'}_poses_{animal}.png"
            written.append(draw_poses(animal, examples, folder / name, False))
            name = f"{'fig11' if animal == 'hand' else 'fig09'}_poses_{animal}_side.png"
            written.append(draw_poses(animal, examples, folder / name, True))
        if failures := one.get("failures"):
            written.append(draw_failures(animal, failures, folder / f"fig17_failures_{animal}.png"))
    return written


def _save(figure: Figure, path: Path) -> Path:
    figure.savefig(path, dpi=DPI)
    return path


def _sheet(
    n_rows: int, n_columns: int, width: float, height: float
) -> tuple[Figure, list[list[Axes]]]:
    """A figure with a grid of panels, each `width` x `height` inches."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width * n_columns, height * n_rows), layout="constrained")
    return figure, figure.subplots(n_rows, n_columns, squeeze=False).tolist()


def _cumulative(results: Mapping[str, Mapping[str, Any]]) -> Figure:
    """Fig. 8: share of frames with a mean joint error within so many mm; lost ones never are."""
    n_splits = max(len(one["splits"]) for one in results.values())
    figure, grid = _sheet(len(results), n_splits, 4.2, 3.2)
    for line, (animal, one) in zip(grid, results.items(), strict=True):
        for panel, split in zip(line, one["splits"], strict=False):
            farthest = 0.0
            for variant, row in one["rows"].items():
                numbers = row["splits"][split]
                error = np.array(numbers["error_quantiles_mm"])
                if not len(error):
                    continue
                share = np.linspace(0, 100 * (1 - numbers["lost_rate"]), len(error))
                name, colour, style = METHODS[variant]
                panel.plot(error, share, style, color=colour, label=name, lw=1.6)
                farthest = max(farthest, float(error[round(0.85 * (len(error) - 1))]))
            panel.set(
                title=f"{animal}, {split}",
                xlabel="mean joint error within, mm",
                ylabel="frames, %",
                xlim=(0, farthest),
                ylim=(0, 100),
            )
            panel.grid(alpha=0.3)
    grid[0][0].legend(fontsize=7, loc="lower right")
    return figure


def _joint_errors(results: Mapping[str, Mapping[str, Any]]) -> Figure:
    """Mean error of every joint, by method."""
    n_splits = max(len(one["splits"]) for one in results.values())
    figure, grid = _sheet(len(results), n_splits, 4.6, 3.2)
    for line, (animal, one) in zip(grid, results.items(), strict=True):
        joints = np.arange(len(one["joints"]))
        for panel, split in zip(line, one["splits"], strict=False):
            for variant, row in one["rows"].items():
                if not row["splits"][split]["joint_mm"]:
                    continue
                name, colour, style = METHODS[variant]
                panel.plot(
                    joints,
                    row["splits"][split]["joint_mm"],
                    style,
                    marker=".",
                    color=colour,
                    label=name,
                )
            panel.set(title=f"{animal}, {split}", ylabel="mean error, mm")
            panel.set_xticks(
                joints, one["joints"], rotation=60 if len(joints) > 6 else 0, fontsize=7
            )
            panel.set_ylim(bottom=0)
            panel.grid(alpha=0.3)
    grid[0][0].legend(fontsize=7)
    return figure


def _sensitivity(results: Mapping[str, Mapping[str, Any]]) -> Figure:
    """Fig. 7: the error over each of the five parameters; a red dot marks the value in use."""
    all_curves = [curve for one in results.values() for curve in one["sensitivity"].values()]
    numbers = list(dict.fromkeys(number for curve in all_curves for number in curve["curves"]))
    figure, grid = _sheet(max(len(numbers), 1), len(results), 3.8, 2.4)
    for column, (animal, one) in enumerate(results.items()):
        for line, number in enumerate(numbers):
            panel = grid[line][column]
            for variant, curve in one["sensitivity"].items():
                points = curve["curves"].get(number, [])
                name, colour, _ = METHODS[variant]
                if number in curve.get("left_out", {}):
                    reason = f"{name} {curve['left_out'][number]}"
                    panel.text(0.04, 0.04, fill(reason, 48), fontsize=6, transform=panel.transAxes)
                    continue
                panel.plot(
                    [p["value"] for p in points],
                    [p["mean_mm"] for p in points],
                    ".-",
                    color=colour,
                    label=name,
                )
                used = [p for p in points if p["value"] == curve["chosen"][number]]
                panel.plot(
                    [p["value"] for p in used],
                    [p["mean_mm"] for p in used],
                    "o",
                    color=_CHOSEN,
                    ms=6,
                )
            panel.set(xlabel=number, ylabel="mm")
            panel.locator_params(axis="x", integer=True)
            panel.margins(y=0.1)
            panel.set_ylim(bottom=0)
            panel.grid(alpha=0.3)
        grid[0][column].set_title(animal)
    grid[0][0].legend(fontsize=7)
    return figure


def _animal(
    panel: Axes, heights: NDArray[np.int16], view: tuple[float, float, float, float]
) -> None:
    """The height map, grey, cut to a view (left, right, bottom, top) in its pixels."""
    shown = np.where(heights > 0, heights.astype(float), np.nan)
    darkest = np.nanmin(shown) - 0.5 * np.ptp(heights[heights > 0])
    panel.imshow(shown, cmap="gray", interpolation="nearest", vmin=darkest)
    panel.set(xlim=view[:2], ylim=view[2:], xticks=[], yticks=[])


def _skeleton(
    panel: Axes, joints_px: Array, edges: Sequence[tuple[int, int]], colour: str, width: float
) -> None:
    for a, b in edges:
        panel.plot(
            joints_px[[a, b], 0],
            joints_px[[a, b], 1],
            "-",
            color=colour,
            lw=width,
            solid_capstyle="round",
        )
    panel.plot(*joints_px[0], "o", color=colour, ms=3 * width)


def _view(illustration: Mapping[str, Any]) -> tuple[float, float, float, float]:
    """The part of the height map that holds the animal, with a margin, in pixels."""
    rows, columns = np.nonzero(illustration["heights"] > 0)
    half = 0.75 * max(np.ptp(rows), np.ptp(columns))
    x = 0.5 * (columns.min() + columns.max())
    y = 0.5 * (rows.min() + rows.max())
    return x - half, x + half, y + half, y - half


def _candidates(illustration: Mapping[str, Any]) -> Figure:
    """Fig. 13-15: candidates as the learned metric ranks them, estimated and true error."""
    ranked = illustration["ranked"]
    n = min(len(ranked["score_mm"]), _MOST_CANDIDATES)
    columns = min(n, 10 if n > 10 else 5)
    figure, grid = _sheet(-(-n // columns), columns, 1.7, 2.25)
    true_rank = np.argsort(np.argsort(ranked["error_mm"], kind="stable")) + 1
    for k, panel in enumerate(panel for line in grid for panel in line):
        if k >= n:
            panel.set_axis_off()
            continue
        _animal(panel, illustration["heights"], _view(illustration))
        _skeleton(panel, illustration["true_px"], illustration["edges"], TRUE, 1.0)
        _skeleton(panel, ranked["joints_px"][k], illustration["edges"], _POSE, 1.5)
        panel.set_title(f"{k + 1}: {ranked['score_mm'][k]:.2f} mm", color="#117733", fontsize=8)
        panel.set_xlabel(
            f"{true_rank[k]}: {ranked['error_mm'][k]:.2f} mm", color="#CC3311", fontsize=8
        )
    figure.suptitle(
        f"{illustration['animal']}: candidates of one picture, red; truth, blue. Above: rank and "
        "predicted error; below: true rank and error.\nRank correlation of the two, mean of "
        f"{illustration['n_images']} pictures: {illustration['rank_correlation']:.2f}",
        fontsize=8,
    )
    return figure


def _convergence(illustration: Mapping[str, Any]) -> Figure:
    """Fig. 16: one candidate from start to end, and all errors after every joint and round."""
    from matplotlib.figure import Figure

    steps = illustration["steps"]
    n = len(steps["names"])
    stages = np.unique(np.linspace(0, n - 1, min(_MOST_STAGES, n)).round().astype(int))
    figure = Figure(figsize=(1.7 * len(stages), 5.0), layout="constrained")
    grid = figure.add_gridspec(2, len(stages), height_ratios=[1, 1.6])
    for k, step in enumerate(stages):
        panel = figure.add_subplot(grid[0, k])
        _animal(panel, illustration["heights"], _view(illustration))
        _skeleton(panel, illustration["true_px"], illustration["edges"], TRUE, 1.0)
        _skeleton(panel, steps["joints_px"][step], illustration["edges"], _POSE, 1.5)
        panel.set_title(steps["names"][step], fontsize=8)
        panel.set_xlabel(f"{steps['example_mm'][step]:.1f} mm", fontsize=8)
    panel = figure.add_subplot(grid[1, :])
    at = np.arange(n)
    panel.fill_between(
        at,
        steps["low_mm"],
        steps["high_mm"],
        color=METHODS["paper"][1],
        alpha=0.2,
        lw=0,
        label="middle half of all candidates",
    )
    panel.plot(at, steps["median_mm"], color=METHODS["paper"][1], label="median of all candidates")
    panel.plot(
        at, steps["best_mm"], color=METHODS["default"][1], label="the candidate ranked first, mean"
    )
    shown = at if n <= 40 else at[:: -(-n // 40)]
    panel.set_xticks(shown, [steps["names"][k] for k in shown], rotation=60, fontsize=7, ha="right")
    panel.set(ylabel="mean joint error, mm", ylim=(0, None))
    panel.set_title(
        f"{illustration['animal']}: after every joint and round, {illustration['n_images']} "
        "pictures",
        fontsize=8,
    )
    panel.legend(fontsize=7)
    panel.grid(alpha=0.3)
    return figure
