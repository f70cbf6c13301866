"""Scores of tracks of animals of another build: errors, intervals joint by joint, flips, size.

Each recording is a moving animal whose build no forest was trained on. `BUILDS_PROTOCOL` states
every figure. Recordings, not frames, are drawn for the intervals (`evaluation.bootstrap`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from liex_lab.evaluation.bootstrap import interval95
from liex_lab.evaluation.pose import rank_correlation
from liex_lab.evaluation.scenes import FAR
from liex_lab.evaluation.tracking import Followed
from liex_lab.tracking.track import Track

Array = NDArray[np.float64]

BUILDS_PROTOCOL = (
    "Rendered recordings of one moving animal each, of a build that no forest was trained on "
    "(the tracker's calibration knows other animals of the same family of builds, and so does what "
    "is said to be left by a fish's own shape; that shape is learned of a wider family, which "
    "reaches about as far), seen by "
    "makes of camera of the training's and of focal lengths that it had not, in turn, with "
    "0.7, 1 and 1.5 times their noise; background, floor, animal and size are found by the "
    "product. Beside them the same of builds like the training's. found: share of frames with"
    " a pose. Error of a frame: mean over joints of the 3D distance between tracked and true "
    "joint in the arena; error_percent: of the true length, mean over all poses, "
    "error_percent95: its 95 % interval, recordings drawn with replacement. interval90: share"
    " of joint coordinates within 1.645 sd (sd_xy_mm, sd_z_mm) of the truth; interval90_x_y, "
    "interval90_z: of these alone; interval90_least: of the worst joint. spearman: rank "
    "correlation of predicted and true error, both of the length. flips: share of poses whose"
    " base-to-tip direction is more than 90 degrees off; longest_flip: most frames in a row. "
    "p_flip: by classes of the probability told, how many poses, the mean told, and the share"
    " that are. wrong_but_trusted: of the poses that are flagged as trusted, those whose "
    "error is beyond 15 % of the length. length_off: mean of |found / true length - 1|. "
    "height_off_mm: mean over recordings of |mean height error|, and height_bias_mm of the "
    "error itself."
)
_CLASSES = (0.0, 0.01, 0.05, 0.2, 0.5, 0.8, 1.0)  # of p_flip


@dataclass(frozen=True)
class Built:
    """A recording of one animal as it was tracked, with its truth.

    Attributes:
        track: (n) the track, without a pose where no animal was found.
        truth: (n, J, 3) true joints, mm, in the track's frame.
        length_mm: true length of the animal.
        found_mm: the length that was found; NaN where no animal was.
        tip: the joint that the base's heading points at.
    """

    track: Track
    truth: Array
    length_mm: float
    found_mm: float
    tip: int

    @property
    def followed(self) -> Followed:
        """Its errors, intervals and exchanged ends; how fast it was tracked is not known."""
        track = self.track
        return Followed(track.joints_mm, self.truth, track.sd_xyz_mm, np.nan, self.tip)


def build_figures(rows: Sequence[Built], joints: Sequence[str]) -> dict[str, Any]:
    """Figures over some recordings, under their names, see `BUILDS_PROTOCOL`.

    Args:
        rows: the recordings, at least one.
        joints: names of the joints.

    Returns:
        The figures; None for those that have no pose to be of.
    """
    followed = [row.followed for row in rows]
    error = np.concatenate(
        [one.error_mm / row.length_mm for one, row in zip(followed, rows, strict=True)]
    )
    recording = np.concatenate([np.full(len(row.truth), k) for k, row in enumerate(rows)])
    posed = np.isfinite(error)
    figures: dict[str, Any] = {
        "n_recordings": len(rows),
        "n_frames": len(error),
        "found": float(posed.mean()),
    }
    if not posed.any():
        return figures
    inside = np.concatenate([one.inside for one in followed])[posed]
    by_joint = inside.mean(axis=(0, 2))
    trusted = np.concatenate([row.track.observed & (row.track.flag == "") for row in rows])
    flipped = np.concatenate([one.flipped for one in followed])
    predicted = np.concatenate([row.track.predicted_error_mm / row.length_mm for row in rows])
    p_flip = np.concatenate([row.track.p_flip for row in rows])
    lengths_mm = np.array([row.length_mm for row in rows])[recording]
    off_mm = [(one.joints - one.truth)[..., 2] for one in followed]
    heights = np.array([np.nanmean(off) for off in off_mm if np.isfinite(off).any()])
    bounds = interval95(100.0 * error, recording.astype(np.int64), np.mean)
    return figures | {
        "mean_joint_error_mm": float((error * lengths_mm)[posed].mean()),
        "error_percent": float(100.0 * error[posed].mean()),
        "error_percent95": None if bounds is None else list(bounds),
        "interval90": float(inside.mean()),
        "interval90_x_y": float(inside[..., :2].mean()),
        "interval90_z": float(inside[..., 2].mean()),
        "interval90_least": float(by_joint.min()),
        "interval90_by_joint": dict(zip(joints, by_joint.tolist(), strict=True)),
        "spearman": rank_correlation(predicted[posed], error[posed]),
        "flips": float(flipped[posed].mean()),
        "longest_flip": max(one.longest_flip for one in followed),
        "p_flip": _reliability(p_flip[posed], flipped[posed]),
        "wrong_but_trusted": float((error > FAR)[trusted].mean()) if trusted.any() else 0.0,
        "trusted": float(trusted.mean()),
        "length_off": float(np.nanmean([abs(row.found_mm / row.length_mm - 1.0) for row in rows])),
        "height_bias_mm": float(heights.mean()),
        "height_off_mm": float(np.abs(heights).mean()),
    }


def _reliability(told: Array, flipped: NDArray[np.bool_]) -> list[dict[str, Any]]:
    """By classes of the probability told (m,), how many poses and the share that are flipped."""
    rows = []
    for low, high in pairwise(_CLASSES):
        some = (told >= low) & ((told < high) | (high == _CLASSES[-1]))
        if some.any():
            rows.append(
                {
                    "from": low,
                    "to": high,
                    "n": int(some.sum()),
                    "told": float(told[some].mean()),
                    "flipped": float(flipped[some].mean()),
                }
            )
    return rows
