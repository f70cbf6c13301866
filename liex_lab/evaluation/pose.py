"""Pose error metrics: mean joint error, flip rate, rank correlation and interval coverage.

Lie-X section 5 judges a frame by its mean per-joint position error,

    e = 1/J sum_j |x_j - y_j|        (mm),

averaged over frames. Beside it stand the share of flipped poses, the share of lost frames, and how
well the predicted error tells the true one: Spearman's rank correlation, and the coverage of the
predicted 90 % interval. `POSE_PROTOCOL` states them all.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

POSE_PROTOCOL = (
    "Error of a frame: mean over joints of the 3D distance between measured and true joint, mm; "
    "mean, median and 95 % over the frames in which an animal was measured. lost_rate: share of "
    "frames with no measurement. flip_rate: share of the measured frames whose base-to-tip "
    "direction is more than 90 degrees from the true one. spearman_predicted_error: rank "
    "correlation of predicted and true error over frames. interval90_coverage: share of frames "
    "whose true error lies in the 90 % interval predicted for it."
)
_FIGURES = (
    "mean_joint_error_mm",
    "median_joint_error_mm",
    "p95_joint_error_mm",
    "flip_rate",
    "lost_rate",
    "spearman_predicted_error",
    "interval90_coverage",
)


@dataclass(frozen=True)
class PoseErrors:
    """Errors of measured against true poses in n frames.

    Attributes:
        error_mm: (n,) mean joint error, mm; NaN where the animal was lost.
        joint_mm: (n, J) error of each joint, mm.
        flipped: (n,) bool, the base-to-tip direction is more than 90 degrees off.
        predicted_mm: (n,) predicted error, mm; NaN where none is predicted.
        low_mm: (n,) lower bound of the predicted 90 % interval of the error, mm.
        high_mm: (n,) upper bound of that interval, mm.
    """

    error_mm: Array
    joint_mm: Array
    flipped: NDArray[np.bool_]
    predicted_mm: Array
    low_mm: Array
    high_mm: Array

    @staticmethod
    def compare(
        joints: Array, true_joints: Array, tip: int, predicted_mm: Array, quantiles: Array
    ) -> PoseErrors:
        """Compare measured with true joints.

        Args:
            joints: (n, J, 3) measured joints, mm; NaN where lost.
            true_joints: (n, J, 3) true joints, mm, in the same frame.
            tip: the joint that the base's heading points at.
            predicted_mm: (n,) predicted mean joint error, mm.
            quantiles: (2,) ratios of true to predicted error that bound the 90 % interval.
        """
        joint_mm = np.linalg.norm(joints - true_joints, axis=-1)
        measured = joints[:, tip] - joints[:, 0]
        true = true_joints[:, tip] - true_joints[:, 0]
        flipped = np.sum(measured * true, axis=-1) < 0
        return PoseErrors(
            joint_mm.mean(axis=1),
            joint_mm,
            flipped,
            predicted_mm,
            predicted_mm * quantiles[0],
            predicted_mm * quantiles[1],
        )

    @staticmethod
    def join(parts: list[PoseErrors]) -> PoseErrors:
        """Concatenate the errors of several recordings.

        Args:
            parts: the errors, in order.
        """
        return PoseErrors(
            *(
                np.concatenate([getattr(p, name) for p in parts])
                for name in PoseErrors.__annotations__
            )
        )

    def summary(self) -> dict[str, Any]:
        """The figures of `liex evaluate pose`, under their names.

        Figures of a prediction that was not made are None; where every frame is lost, all are None
        but the rate of lost frames.
        """
        seen = np.isfinite(self.error_mm)
        if not seen.any():
            return dict.fromkeys(_FIGURES) | {"lost_rate": 1.0}
        error = self.error_mm[seen]
        predicted = self.predicted_mm[seen]
        inside = (error >= self.low_mm[seen]) & (error <= self.high_mm[seen])
        predicts = bool(np.isfinite(predicted).all())
        return {
            "mean_joint_error_mm": float(error.mean()),
            "median_joint_error_mm": float(np.median(error)),
            "p95_joint_error_mm": float(np.quantile(error, 0.95)),
            "flip_rate": float(self.flipped[seen].mean()),
            "lost_rate": float(1.0 - seen.mean()),
            "spearman_predicted_error": rank_correlation(predicted, error) if predicts else None,
            "interval90_coverage": float(inside.mean()) if predicts else None,
        }


def rank_correlation(a: Array, b: Array) -> float:
    """Spearman's rank correlation of two series.

    Args:
        a: (n,) the first series.
        b: (n,) the second series.
    """
    from scipy.stats import spearmanr

    return float(spearmanr(a, b).statistic)


def angle_between_axes(a: Array, b: Array) -> Array:
    """Angle between undirected axes.

    Args:
        a: (n,) angles of the first axes, rad.
        b: (n,) angles of the second axes, rad.

    Returns:
        (n,) rad in [0, pi / 2].
    """
    difference = np.mod(a - b, np.pi)
    return np.minimum(difference, np.pi - difference)


def count_reversals(heading: Array) -> int:
    """Count how often a heading turns by more than a right angle between frames.

    Args:
        heading: (n,) rad; NaN frames are skipped.
    """
    seen = heading[np.isfinite(heading)]
    return int((np.cos(np.diff(seen)) < 0).sum())


def plain(value: Any) -> Any:
    """Convert to what JSON can hold.

    Args:
        value: any nesting of dicts, lists, tuples, NumPy arrays and numbers.

    Returns:
        The same with NumPy's numbers and arrays as Python's, and None for what is not a finite
        number.
    """
    if isinstance(value, dict):
        return {str(key): plain(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [plain(inner) for inner in value]
    value = value.tolist() if hasattr(value, "tolist") else value
    if isinstance(value, list):
        return plain(value)
    return None if isinstance(value, float) and not math.isfinite(value) else value
