"""What a body does from frame to frame: speed, heading, turning, heights. Pandas in, pandas out."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from liex_lab.behaviour.columns import KINEMATICS
from liex_lab.sessions.rows import gap_follows, stop_times
from liex_lab.sessions.tables import to_pandas

Array = NDArray[np.float64]

HALF_WINDOW_S = 0.034  # speed at t uses neighbours this far away, as Live Mouse Tracker does at 30 fps
IMPOSSIBLE_MM_S = 3000.0  # faster than any mouse: a tracking error
_STEEP_RAD = np.radians(75.0)  # beyond it the line from rump to neck has no reliable direction on the floor


@dataclass(frozen=True)
class BodyPoints:
    """Which joints play which part: the tail's base, the front of the trunk, the nose, and those of the back."""

    rump: str
    neck: str
    nose: str
    back: tuple[str, ...]

    @staticmethod
    def of(joints: list[str]) -> BodyPoints:
        """The parts by name, or along the chain: first joint, last but one, last; a chain may begin at the head."""
        if {"rump", "neck", "nose"} <= set(joints):
            back = tuple(name for name in joints if name not in ("rump", "nose"))
            return BodyPoints("rump", "neck", "nose", back)
        if joints[0] == "head":
            joints = joints[::-1]
        return BodyPoints(joints[0], joints[max(len(joints) - 2, 0)], joints[-1], tuple(joints[1:-1]) or (joints[0],))


def kinematics(
    frames: pd.DataFrame,
    poses: pd.DataFrame,
    half_window_s: float = HALF_WINDOW_S,
    impossible_above_mm_s: float = IMPOSSIBLE_MM_S,
) -> pd.DataFrame:
    """The table `kinematics` from the tables `frames` and `poses` of one animal: one row per recorded frame."""
    joints, xyz = joint_positions(frames, poses)
    points = BodyPoints.of(joints)
    at = {name: xyz[:, k] for k, name in enumerate(joints)}
    trunk = [name for name in joints if name != points.nose] or joints
    centre = np.mean([at[name] for name in trunk], axis=0)
    time_s = frames["time_s"].to_numpy(float)
    observed = np.isfinite(centre[:, 0])
    before, after = neighbours(time_s, observed, half_window_s)
    span = np.where(after > before, time_s[after] - time_s[before], np.nan)
    velocity = (centre[after] - centre[before]) / span[:, None]
    speed = np.hypot(velocity[:, 0], velocity[:, 1])
    speed = np.where(speed > impossible_above_mm_s, np.nan, speed)
    along = at[points.neck] - at[points.rump]
    pitch = np.arctan2(along[:, 2], np.hypot(along[:, 0], along[:, 1]))
    heading = np.where(np.abs(pitch) < _STEEP_RAD, np.arctan2(along[:, 1], along[:, 0]), np.nan)
    columns = {name: frames[name].to_numpy() for name in ("frame_index", "time_s", "dt_s")}
    return to_pandas(KINEMATICS, {
        "session_id": frames["session_id"].iloc[0], "individual": frames["individual"].iloc[0], **columns,
        "x_mm": centre[:, 0], "y_mm": centre[:, 1], "z_mm": centre[:, 2],
        "speed_mm_s": speed, "vertical_speed_mm_s": velocity[:, 2],
        "step_mm": speed * (stop_times(time_s) - time_s),
        "heading_rad": heading, "yaw_rate_rad_s": turning_speed(heading, before, after, span),
        "nose_height_mm": at[points.nose][:, 2],
        "back_height_mm": np.max([at[name][:, 2] for name in points.back], axis=0),
        "body_pitch_rad": pitch, "nose_over_rump_mm": at[points.nose][:, 2] - at[points.rump][:, 2],
    })  # fmt: skip


def joint_positions(frames: pd.DataFrame, poses: pd.DataFrame) -> tuple[list[str], Array]:
    """Joint names, and positions (n, J, 3) mm in the arena, NaN where unknown."""
    joints = [str(name) for name in pd.unique(poses["joint"])]
    xyz = poses[["x_mm", "y_mm", "z_mm"]].to_numpy(float).reshape(len(frames), len(joints), 3)
    return joints, xyz


def segments(time_s: Array, observed: NDArray[np.bool_]) -> NDArray[np.int64]:
    """(n,) the number of the unbroken stretch each frame belongs to: no missing frame, no lost animal inside."""
    broken = np.append(True, gap_follows(time_s)[:-1] | (observed[1:] != observed[:-1]))[: len(time_s)]
    return np.asarray(np.cumsum(broken) - 1)


def neighbours(
    time_s: Array, observed: NDArray[np.bool_], half_window_s: float = HALF_WINDOW_S
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """(n,) rows to difference between: about `half_window_s` before and after, never outside the frame's own stretch.

    At the ends of a stretch the difference is one-sided; a stretch of one frame has none (before == after).
    """
    n, rows = len(time_s), np.arange(len(time_s))
    reach = 0.75 * half_window_s  # at the camera's own rate the next frame counts, jitter of its clock or not
    before = np.searchsorted(time_s, time_s - reach, side="right") - 1
    after = np.searchsorted(time_s, time_s + reach, side="left")
    number = segments(time_s, observed)
    first = np.searchsorted(number, number, side="left")
    last = np.searchsorted(number, number, side="right") - 1
    before = np.clip(np.minimum(before, np.maximum(rows - 1, 0)), first, last)
    after = np.clip(np.maximum(after, np.minimum(rows + 1, n - 1)), first, last)
    lost = ~observed
    return np.where(lost, rows, before), np.where(lost, rows, after)


def turning_speed(heading: Array, before: NDArray[np.int64], after: NDArray[np.int64], span: Array) -> Array:
    """(n,) rad/s between the neighbours, adding the smallest turns from `before` over the frame itself to `after`."""
    return (smallest_turn(heading - heading[before]) + smallest_turn(heading[after] - heading)) / span


def smallest_turn(angle: Array) -> Array:
    """Angles brought into (-pi, pi]."""
    return np.asarray(np.pi - (np.pi - angle) % (2.0 * np.pi))
