"""Tracking against single frames, Fig. 18 of the Lie-X paper: error over time, worst moments.

Written as a PNG with matplotlib.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from liex_lab.evaluation.tracking import Followed
from liex_lab.simulation.tracking_sequences import TestSequence

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Array = NDArray[np.float64]

_LINES = {  # row: (name in the legend, colour, width)
    "single": ("single frames", "#999999", 1.0),
    "algorithm3": ("Algorithm 3 on our parts", "#4477AA", 0.8),
    "smoothed": ("smoothed", "#AA3377", 1.6),
}
_TRUTH = "#228833"
# pictures, and frames between two of them at least
_MOMENTS = 6
_APART = 12
_DPI = 110


def draw_tracking(sequence: TestSequence, rows: Mapping[str, Followed], path: Path) -> Path:
    """Write the figure of a test sequence and what was made of it.

    Args:
        sequence: the sequence with its truth.
        rows: what was made of it: single (frames by themselves), and where there are algorithm3 and
            smoothed.
        path: the PNG to write; its folder is made.

    Returns:
        `path`.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13.0, 6.4), layout="constrained")
    grid = figure.add_gridspec(2, _MOMENTS, height_ratios=(1.3, 1.0))
    _over_time(figure.add_subplot(grid[0, :]), sequence, rows)
    for k, frame in enumerate(worst_moments(rows["single"].error_mm)):
        _moment(figure.add_subplot(grid[1, k]), sequence, rows, frame)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=_DPI)
    return path


def worst_moments(error: Array) -> list[int]:
    """The frames with the largest errors, none near another, in order of time.

    Args:
        error: (n,) error of each frame, mm; NaN where there is none.

    Returns:
        At most six frames, none within twelve frames of another.
    """
    left = np.nan_to_num(error, nan=-1.0)
    chosen = []
    for _ in range(_MOMENTS):
        frame = int(np.argmax(left))
        if left[frame] < 0:
            break
        chosen.append(frame)
        left[max(0, frame - _APART) : frame + _APART] = -1.0
    return sorted(chosen)


def _over_time(panel: Axes, sequence: TestSequence, rows: Mapping[str, Followed]) -> None:
    seconds = (sequence.times_ns - sequence.times_ns[0]) * 1e-9
    for event in sequence.events:
        if event.kind not in ("hidden", "dropped"):
            panel.axvspan(
                seconds[event.start], seconds[event.stop - 1], color="#000000", alpha=0.05, lw=0
            )
            where = panel.get_xaxis_transform()
            panel.text(
                seconds[event.start], 0.98, event.kind, fontsize=7, va="top", transform=where
            )
    for name, (label, colour, width) in _LINES.items():
        if name not in rows:
            continue
        error = rows[name].error_mm
        mean = float(np.nanmean(error))
        panel.plot(seconds, error, color=colour, lw=width, label=f"{label}: mean {mean:.2f} mm")
        panel.axhline(mean, color=colour, lw=width, ls="--")
    panel.set_xlabel("time, s")
    panel.set_ylabel("mean joint error, mm")
    panel.set_yscale("log")
    panel.margins(x=0.0)
    panel.legend(loc="upper right", fontsize=8)


def _moment(panel: Axes, sequence: TestSequence, rows: Mapping[str, Followed], frame: int) -> None:
    """The depth around the animal with the true and the estimated skeletons."""
    camera = sequence.camera
    depth = sequence.depths(frame, frame + 1)[0]
    T_camera_arena = sequence.T_arena_camera.inverse()
    middle = sequence.joints_camera[frame].mean(axis=0)
    u, v = camera.project(middle)
    reach = 0.9 * sequence.spine_mm * camera.fx / middle[2]
    near = middle[2] - 0.6 * sequence.spine_mm
    panel.imshow(
        np.where(depth > 0, depth, np.nan),
        cmap="Greys",
        vmin=near,
        vmax=middle[2] + 0.6 * sequence.spine_mm,
    )
    skeletons = {"truth": (sequence.joints_arena[frame], _TRUTH)}
    skeletons |= {
        name: (rows[name].joints[frame], _LINES[name][1])
        for name in ("single", "smoothed")
        if name in rows
    }
    for joints, colour in skeletons.values():
        uv = camera.project(T_camera_arena @ joints)
        for a, b in sequence.skeleton.edges:
            panel.plot(uv[[a, b], 0], uv[[a, b], 1], color=colour, lw=2)
        panel.plot(*uv[-1], "o", color=colour, ms=5)
    panel.set_xlim(u - reach, u + reach)
    panel.set_ylim(v + reach, v - reach)
    panel.set_xticks([])
    panel.set_yticks([])
    alone = rows["single"].error_mm[frame]
    tracked = rows["smoothed"].error_mm[frame] if "smoothed" in rows else np.nan
    panel.set_title(f"frame {frame}: {alone:.0f} mm, smoothed {tracked:.0f} mm", fontsize=8)
