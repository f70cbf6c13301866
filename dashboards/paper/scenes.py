"""Frames of a scene with true and measured skeletons over the depth: the whole picture, and near.

Written as a PNG with matplotlib, one a scene.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from liex_lab.evaluation.scenes import Individual
from liex_lab.simulation.recording import TrueRecording
from liex_lab.simulation.scenes.recording import TrueAnimal

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Array = NDArray[np.float64]

_MOMENTS = (0.08, 0.4, 0.62, 0.95)  # of the recording
_TRUTH = "#228833"
_TRUSTED = "#AA3377"
_DOUBTFUL = "#EE7733"
_NEAR = 1.6  # of a spine: half of the near picture's side
_DPI = 90


def draw_scene(
    name: str,
    recording: TrueRecording,
    truths: Sequence[TrueAnimal],
    individuals: Sequence[Individual],
    folder: Path,
) -> Path:
    """Write the picture of a scene and of what was measured in it.

    Args:
        name: of the scene, which names the file.
        recording: its frames.
        truths: its animals, drawn in green.
        individuals: what was measured, in red where it is trusted, else in orange.
        folder: of the PNG; it is made.

    Returns:
        The file.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(15.0, 7.2), layout="constrained")
    panels = figure.subplots(2, len(_MOMENTS))
    for k, share in enumerate(_MOMENTS):
        frame = min(int(share * len(recording)), len(recording) - 1)
        depth = recording.depths(frame, frame + 1)[0]
        for panel in panels[:, k]:
            _picture(panel, recording, depth, truths, individuals, frame)
        seen = ", ".join(f"{100 * truth.visible[frame]:.0f} %" for truth in truths)
        panels[0, k].set_title(f"{name}, frame {frame}, in view: {seen or 'none'}", fontsize=8)
        _go_near(panels[1, k], recording, truths, frame)
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{name}.png"
    figure.savefig(path, dpi=_DPI)
    return path


def _picture(
    panel: Axes,
    recording: TrueRecording,
    depth: NDArray[np.float32],
    truths: Sequence[TrueAnimal],
    individuals: Sequence[Individual],
    frame: int,
) -> None:
    known = depth[depth > 0]
    low, high = np.quantile(known, [0.01, 0.99]) if len(known) else (0.0, 1.0)
    panel.imshow(np.where(depth > 0, depth, np.nan), cmap="viridis_r", vmin=low, vmax=high)
    panel.set_facecolor("black")
    for truth in truths:
        _skeleton(panel, recording, truth.joints_camera[frame], _TRUTH, 2.2)
    for one in individuals:
        colour = _TRUSTED if one.trusted[frame] else _DOUBTFUL
        _skeleton(panel, recording, one.joints_camera[frame], colour, 1.2)
    panel.set_xlim(-0.5, recording.width - 0.5)
    panel.set_ylim(recording.height - 0.5, -0.5)
    panel.set_xticks([])
    panel.set_yticks([])


def _skeleton(
    panel: Axes, recording: TrueRecording, joints: Array, colour: str, width: float
) -> None:
    """Bones where the joints are those of the recording's animal, else dots."""
    if not np.isfinite(joints).all():
        return
    uv = recording.camera.project(joints)
    if len(joints) == recording.skeleton.n_joints:
        for a, b in recording.skeleton.edges:
            panel.plot(uv[[a, b], 0], uv[[a, b], 1], color=colour, lw=width)
        tip = recording.skeleton.tip
        panel.plot(*uv[tip], "o", color=colour, ms=2.0 * width)
    else:
        panel.plot(uv[:, 0], uv[:, 1], ".", color=colour, ms=3.0)


def _go_near(
    panel: Axes,
    recording: TrueRecording,
    truths: Sequence[TrueAnimal],
    frame: int,
) -> None:
    """Show only what is around the first animal, where it is there."""
    if not truths or not np.isfinite(truths[0].joints_camera[frame]).all():
        return
    middle = truths[0].joints_camera[frame].mean(axis=0)
    u, v = recording.camera.project(middle)
    reach = _NEAR * truths[0].spine_mm * recording.camera.fx / middle[2]
    span = 0.8 * truths[0].spine_mm
    panel.images[0].set_clim(middle[2] - span, middle[2] + span)
    panel.set_xlim(u - reach, u + reach)
    panel.set_ylim(v + reach, v - reach)
