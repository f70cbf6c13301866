"""Tracking metrics over a sequence with truth: error ratios, lost rate, flips, coverage, recovery.

The error of a frame is the mean per-joint position error of Lie-X section 5.3, e = 1/J sum_j |x_j -
y_j| (mm); the tracker's figures are set against those of single frames. Coverage is the share of
joint coordinates within 1.645 standard deviations of the truth (nominal 90 %). `TRACKING_PROTOCOL`
states every figure.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from liex_lab.simulation.corruptions import Event

Array = NDArray[np.float64]

TRACKING_PROTOCOL = (
    "Error of a frame: mean over joints of the 3D distance between measured and true joint, mm. "
    "single: what each frame says by itself; algorithm3: the paper's particle filter, 200 "
    "particles, on our regressors and metric; algorithm1_paper, algorithm3_paper and "
    "algorithm3_paper_base_round: the paper's single frames (the best-scored candidate) and its "
    "filter with the parts of its own variant, without and with a round of the base's regressors, "
    "set against each other by ratio_to_single, and the note says whether its process noise was "
    "searched; online: the default tracker, each row told some frames late (online_lag_frames); "
    "smoothed: the default tracker over the whole sequence. mean and p95: over the frames in which "
    "the row has a pose, bridged ones included; lost_rate: share of frames without one. "
    "ratio_to_single and p95_ratio_to_single: over the frames in which this row and the single "
    "frames both have a pose. in_view_ratio and in_view_p95_ratio: over all frames in which at "
    "least half of the animal is seen, where a frame without a pose counts as an error of half the "
    "animal's length, for both, so that nobody gains by giving up frames. longest_flip_frames: "
    "most frames in a row whose base-to-tip direction is more than 90 degrees from the true one. "
    "interval90_coverage: share of joint coordinates within 1.645 sd of the truth. "
    "recovery_frames: after the end of an occlusion (the bar has passed, or less than half of the "
    "animal is hidden again), frames until the error is below 0.12 of its length, the worst of "
    "them. frames_per_s: on this machine, reading excluded; speed: the smoothed row's, timed by "
    "itself over the first frames, the best of three times."
)
# of the animal's length
_NEAR = 0.12
_LOST = 0.5
_Z90 = 1.645


@dataclass(frozen=True)
class Followed:
    """One tracked sequence of n frames with its truth.

    Attributes:
        joints: (n, J, 3) estimated joints, mm; NaN where there is no pose.
        truth: (n, J, 3) true joints, mm, in the same frame.
        sd_mm: (n, J, 3) estimated standard deviation of each joint along x, y and z, mm.
        frames_per_s: speed of the tracker, reading excluded.
        tip: the joint that the base's heading points at.
    """

    joints: Array
    truth: Array
    sd_mm: Array
    frames_per_s: float
    tip: int = -1

    @property
    def error_mm(self) -> Array:
        """(n,) mean joint error, mm; NaN where there is no pose."""
        return np.asarray(np.linalg.norm(self.joints - self.truth, axis=-1).mean(axis=1))

    @property
    def flipped(self) -> NDArray[np.bool_]:
        """(n,) bool, whether the base-to-tip direction is more than 90 degrees off."""
        along, true = (j[:, self.tip] - j[:, 0] for j in (self.joints, self.truth))
        return np.asarray(np.einsum("nd,nd->n", along, true) < 0)

    @property
    def longest_flip(self) -> int:
        """Most frames in a row whose base-to-tip direction is more than 90 degrees off."""
        longest = run = 0
        for off in self.flipped:
            run = run + 1 if off else 0
            longest = max(longest, run)
        return longest

    @property
    def inside(self) -> NDArray[np.bool_]:
        """(n, J, 3) bool, whether a joint coordinate lies within its 90 % interval."""
        return np.asarray(np.abs(self.joints - self.truth) <= _Z90 * self.sd_mm)

    @property
    def covered(self) -> NDArray[np.bool_]:
        """(m,) bool, the same of the joint coordinates that are known."""
        return self.inside[np.isfinite(self.joints) & np.isfinite(self.sd_mm)]

    def in_view(self, events: Sequence[Event], length_mm: float) -> Array:
        """Errors of the frames in which at least half of the animal is seen.

        Args:
            events: what happens in the sequence; frames of kind 'hidden' are left out.
            length_mm: length of the animal, mm; a frame without a pose counts as an error of half
                of it.

        Returns:
            (m,) errors, mm.
        """
        seen = np.ones(len(self.joints), np.bool_)
        for event in events:
            if event.kind == "hidden":
                seen[event.start : event.stop] = False
        return np.nan_to_num(self.error_mm, nan=_LOST * length_mm)[seen]

    def recovery(self, events: Sequence[Event], length_mm: float) -> list[int]:
        """Frames until the animal is found again after each occlusion.

        Args:
            events: what happens in the sequence; those of kind 'hidden' and 'occluder' count.
            length_mm: length of the animal, mm; it is found where the error is below 0.12 of it.

        Returns:
            Frames from the end of each occlusion on; to the end of the sequence where it is not
            found.
        """
        near = self.error_mm < _NEAR * length_mm
        found = []
        for event in events:
            if event.kind in ("hidden", "occluder") and event.stop < len(near):
                again = np.flatnonzero(near[event.stop :])
                found.append(int(again[0]) if len(again) else len(near) - event.stop)
        return found


def figures(
    rows: Sequence[Followed],
    single: Sequence[Followed],
    events: Sequence[Sequence[Event]],
    length_mm: float,
) -> dict[str, Any]:
    """Figures of one tracker over some sequences.

    Args:
        rows: the tracked sequences.
        single: the same sequences, estimated frame by frame.
        events: what happens in each of them.
        length_mm: length of the animal, mm.

    Returns:
        The figures under their names, see `TRACKING_PROTOCOL`; only a lost_rate of 1 where no frame
        has a pose in both.
    """
    error, alone = (np.concatenate([row.error_mm for row in some]) for some in (rows, single))
    seen = np.isfinite(error)
    both = np.isfinite(error) & np.isfinite(alone)
    if not both.any():
        return {"lost_rate": 1.0}
    own, others = (
        np.concatenate(
            [row.in_view(happened, length_mm) for row, happened in zip(some, events, strict=True)]
        )
        for some in (rows, single)
    )
    recovery = [
        n
        for row, happened in zip(rows, events, strict=True)
        for n in row.recovery(happened, length_mm)
    ]
    return {
        "mean_joint_error_mm": float(error[seen].mean()),
        "p95_joint_error_mm": float(np.quantile(error[seen], 0.95)),
        "ratio_to_single": float(error[both].mean() / alone[both].mean()),
        "p95_ratio_to_single": float(
            np.quantile(error[both], 0.95) / np.quantile(alone[both], 0.95)
        ),
        "in_view_ratio": float(own.mean() / others.mean()),
        "in_view_p95_ratio": float(np.quantile(own, 0.95) / np.quantile(others, 0.95)),
        "lost_rate": float(1.0 - seen.mean()),
        "longest_flip_frames": max(row.longest_flip for row in rows),
        "interval90_coverage": float(np.concatenate([row.covered for row in rows]).mean()),
        "recovery_frames": max(recovery) if recovery else None,
        "frames_per_s": float(np.mean([row.frames_per_s for row in rows])),
    }
