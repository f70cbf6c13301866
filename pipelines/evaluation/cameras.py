"""Evaluation of cameras that one can buy, at several distances: `liex evaluate cameras`.

One virtual mouse walks in one arena before each camera in turn, at each height above the floor;
the recording is tracked as a run does. Seeds are the same for all cameras, so that they record the
same animals, and no forest was trained with any of these cameras.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Final

import numpy as np

from liex_lab.errors import LiexError
from liex_lab.evaluation.scores import interval95
from liex_lab.runtime.progress import Progress, silent
from liex_lab.simulation.recording import RenderedRecording
from liex_lab.simulation.sensors import BY_NAME
from liex_lab.simulation.species import MouseSpecies

from ..build import plan_of
from ..training.pose_model import estimator_of
from .pose import build_figures, track

CAMERAS: Final = ("femto-bolt", "azure-nfov", "gemini-335", "d435", "d405")
DISTANCES_MM: Final = (500.0, 750.0, 1000.0)
_SEED = 610
_PROTOCOL = (
    "Rendered recordings of one walking mouse each, of builds like the training's, before an ideal "
    "lens with the intrinsics of the camera's first depth mode, at a height of distance_mm above "
    "the floor; background, floor, animal and size are found by the product. The same seeds for "
    "all cameras and distances. error_mm: mean over joints of the 3D distance between tracked and "
    "true joint, mean over all poses; error_mm_low, error_mm_high: its 95 % interval, recordings "
    "drawn with replacement. floor_noise_mm: 1.4826 times the median absolute difference between "
    "readings of the still scene and the truth. found, trusted: share of frames with a pose, and "
    "with one that "
    "is not flagged."
)


def evaluate_cameras(
    cameras: Sequence[str] = CAMERAS,
    distances_mm: Sequence[float] = DISTANCES_MM,
    *,
    n_frames: int = 120,
    n_recordings: int = 4,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Joint errors of a mouse by camera and distance, see `_PROTOCOL`.

    Args:
        cameras: names of sensors, keys of `simulation.sensors.BY_NAME`.
        distances_mm: heights above the floor, mm.
        n_frames: length of each recording.
        n_recordings: for each camera and distance.
        progress: called recording by recording.

    Returns:
        `rows` by camera and distance, and the protocol.

    Raises:
        LiexError: there is no such camera, or a distance out of 200 to 3000 mm.
    """
    unknown = [name for name in cameras if name not in BY_NAME]
    if unknown or not all(200.0 <= mm <= 3000.0 for mm in distances_mm):
        raise LiexError(
            f"cameras are of {', '.join(BY_NAME)} and distances 200 to 3000 mm, got "
            f"{', '.join(cameras)} and {', '.join(f'{mm:g}' for mm in distances_mm)}"
        )
    estimator = estimator_of("mouse", "default", progress)
    cells = [(name, mm) for name in cameras for mm in distances_mm]
    rows: dict[str, Any] = {}
    for number, (name, mm) in enumerate(cells):
        world = MouseSpecies()
        world = replace(world, setting=replace(world.setting, camera_mm=(mm, mm)))
        tracked, noise = [], []
        for k in range(n_recordings):
            title = f"{name} at {mm:g} mm, {k}"
            progress(number * n_recordings + k, len(cells) * n_recordings, f"measuring {title}")
            recording = world.motion([_SEED, k], n_frames, sensor=BY_NAME[name], name=title)
            tracked.append(track(estimator, recording, plan_of("mouse")))
            noise.append(floor_noise_mm(recording))
        figures = build_figures(tracked, estimator.skeleton.names)
        error = np.concatenate(
            [np.linalg.norm(one.track.joints_mm - one.truth, axis=-1).mean(-1) for one in tracked]
        )
        bounds = interval95(error, np.repeat(np.arange(n_recordings), n_frames), np.mean)
        rows[f"{name} {mm:g} mm"] = {
            "n_frames": figures["n_frames"],
            "n_recordings": n_recordings,
            "floor_noise_mm": float(np.mean(noise)),
            "found": figures["found"],
            "trusted": figures.get("trusted", 0.0),
            "error_mm": figures.get("mean_joint_error_mm"),
            "error_mm_low": None if bounds is None else bounds[0],
            "error_mm_high": None if bounds is None else bounds[1],
            "length_off": figures.get("length_off"),
            "flips": figures.get("flips"),
        }
    return {"rows": rows, "protocol": _PROTOCOL}


def floor_noise_mm(recording: RenderedRecording) -> float:
    """Spread of a recording's first image around the still scene, mm; NaN if nothing is read."""
    ideal, depth = recording.stage.scene.still, recording.frame(0).depth
    off = np.abs(depth - ideal)[(depth > 0) & (ideal > 0)]
    return float(1.4826 * np.median(off)) if off.size else float("nan")
