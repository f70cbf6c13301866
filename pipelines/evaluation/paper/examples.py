"""Poses of every row in a few fixed test frames, and the worst frames, for Figs 9 to 12 and 17.

Of each split the middle frame of the first recording and of that halfway are examples, whatever a
row makes of them. The failures of a row are the worst frames of the two recordings of each split
in which it errs most. A row keeps the joints of its first run; the pictures are rendered anew where
they are drawn.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from liex_lab.optics.camera import Camera

if TYPE_CHECKING:
    from liex_lab.simulation.recording import TrueRecording

Array = NDArray[np.float64]

_FAILURES = 2  # of each split
_MARGIN = 0.35  # of the longest side of the true joints' rectangle
_LEAST_PX = 12
_DIGITS = 2  # of a joint's place, mm


def example_frames(recordings: Sequence[TrueRecording]) -> list[tuple[int, int]]:
    """Which frames of a split are examples: (recording, frame).

    Args:
        recordings: of the split.
    """
    chosen = dict.fromkeys((0, len(recordings) // 2))
    return [(k, len(recordings[k]) // 2) for k in chosen]


def pose_at(split: str, recording: int, frame: int, joints: Array) -> dict[str, Any]:
    """A measured pose as a row keeps it.

    Args:
        split: of the frame.
        recording: its number in the split.
        frame: its number in the recording.
        joints: (J, 3) mm, camera frame; NaN where nothing was found.

    Returns:
        `split`, `recording`, `frame` and `joints_mm`, which is None where nothing was found.
    """
    found = bool(np.isfinite(joints).all())
    return {
        "split": split,
        "recording": recording,
        "frame": frame,
        "joints_mm": np.round(joints, _DIGITS).tolist() if found else None,
    }


def examples_in(
    split: str, joints: Sequence[Array], recordings: Sequence[TrueRecording]
) -> list[dict[str, Any]]:
    """The examples of one row on one split.

    Args:
        split: its name.
        joints: of each recording (n, J, 3) mm, camera frame.
        recordings: with their truth.
    """
    return [pose_at(split, k, i, joints[k][i]) for k, i in example_frames(recordings)]


def failures_in(
    split: str, joints: Sequence[Array], recordings: Sequence[TrueRecording]
) -> list[dict[str, Any]]:
    """The worst frames of one row on one split, of different recordings, worst first.

    Args:
        split: its name.
        joints: of each recording (n, J, 3) mm, camera frame.
        recordings: with their truth.

    Returns:
        As `pose_at`, with `error_mm`.
    """
    worst = []
    for k, (found, recording) in enumerate(zip(joints, recordings, strict=True)):
        error = np.linalg.norm(found - recording.joints_camera, axis=-1).mean(axis=1)
        if np.isfinite(error).any():
            worst.append((float(np.nanmax(error)), k, int(np.nanargmax(error))))
    worst.sort(reverse=True)
    return [
        {**pose_at(split, k, i, joints[k][i]), "error_mm": round(error, _DIGITS)}
        for error, k, i in worst[:_FAILURES]
    ]


def shown_poses(
    places: Sequence[Mapping[str, Any]],
    rows: Mapping[str, Sequence[Mapping[str, Any]]],
    tests: Mapping[str, Sequence[TrueRecording]],
) -> list[dict[str, Any]]:
    """Pictures, truth and the poses of all rows in some frames, as they are drawn.

    Args:
        places: frames, by `split`, `recording` and `frame`.
        rows: poses by variant, see `pose_at`; a row without a pose in a frame is left out there.
        tests: recordings with their truth by split.

    Returns:
        For each frame `split`, `recording`, `frame`; `depth` (h, w) float32 mm around the animal,
        0 where unread; `camera` of that part of the picture; `edges`; `spine_mm`; `truth` (J, 3)
        mm, camera frame; and `poses` by variant, (J, 3) or None where nothing was found.
    """
    found = []
    for place in places:
        recording = tests[place["split"]][place["recording"]]
        frame = int(place["frame"])
        truth = recording.joints_camera[frame]
        poses = {
            name: None if one["joints_mm"] is None else np.array(one["joints_mm"])
            for name, some in rows.items()
            for one in some
            if all(one[key] == place[key] for key in ("split", "recording", "frame"))
        }
        depth, camera = _around(recording, frame)
        found.append(
            {
                **{key: place[key] for key in ("split", "recording", "frame")},
                "depth": depth,
                "camera": camera,
                "edges": recording.skeleton.edges,
                "spine_mm": recording.spine_mm,
                "truth": truth,
                "poses": poses,
            }
        )
    return found


def _around(recording: TrueRecording, frame: int) -> tuple[NDArray[np.float32], Camera]:
    """The part of a frame around the true pose, and the camera of that part."""
    camera = recording.camera
    true_px = camera.project(recording.joints_camera[frame])
    middle = 0.5 * (true_px.min(axis=0) + true_px.max(axis=0))
    reach = 0.5 * np.ptp(true_px, axis=0).max()
    half = int(np.ceil(max((1.0 + 2.0 * _MARGIN) * reach, _LEAST_PX)))
    low = np.floor(middle).astype(int) - half
    side = 2 * half + 1
    depth = np.zeros((side, side), np.float32)
    whole = recording.depths(frame, frame + 1)[0]
    u0, v0 = np.maximum(low, 0)
    u1 = min(low[0] + side, whole.shape[1])
    v1 = min(low[1] + side, whole.shape[0])
    if u1 > u0 and v1 > v0:
        depth[v0 - low[1] : v1 - low[1], u0 - low[0] : u1 - low[0]] = whole[v0:v1, u0:u1]
    part = replace(
        camera,
        cx=camera.cx - float(low[0]),
        cy=camera.cy - float(low[1]),
        width=side,
        height=side,
    )
    return depth, part
