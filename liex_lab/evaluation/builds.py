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
from liex_lab.tracking.track import Track

Array = NDArray[np.float64]

BUILDS_PROTOCOL = (
    "Rendered recordings of one moving animal each, of a build that no forest was trained on "
    "(the tracker's calibration knows other animals of the same family of builds), seen by "
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
_Z90 = 1.645
_FAR = 0.15  # of the length
_CLASSES = (0.0, 0.01, 0.05, 0.2, 0.5, 0.8, 1.0)  # of p_flip


@dataclass(frozen=True)
class Built:
    """A recording of one animal as it was tracked, with its truth.

    Attributes:
        track: (n) the track; None where no animal was found.
        truth: (n, J, 3) true joints, mm, in the track's frame.
        length_mm: true length of the animal.
        found_mm: the length that was found; NaN where no animal was.
        tip: the joint that the base's heading points at.
    """

    track: Track | None
    truth: Array
    length_mm: float
    found_mm: float
    tip: int

    @property
    def off_mm(self) -> Array:
        """(n, J, 3) tracked minus true joints, mm; NaN where there is no pose."""
        return np.full(self.truth.shape, np.nan) if self.track is None else self._off(self.track)

    def _off(self, track: Track) -> Array:
        return track.joints_mm - self.truth

    @property
    def error(self) -> Array:
        """(n,) mean joint error over the length; NaN where there is no pose."""
        return np.asarray(np.linalg.norm(self.off_mm, axis=-1).mean(axis=1) / self.length_mm)

    @property
    def predicted(self) -> Array:
        """(n,) the error that was predicted, over the length."""
        if self.track is None:
            return np.full(len(self.truth), np.nan)
        return self.track.predicted_error_mm / self.length_mm

    @property
    def trusted(self) -> NDArray[np.bool_]:
        """(n,) poses that are flagged as trusted."""
        if self.track is None:
            return np.zeros(len(self.truth), np.bool_)
        return np.asarray(self.track.observed & (self.track.flag == ""))

    @property
    def p_flip(self) -> Array:
        """(n,) the probability told that head and tail are exchanged."""
        return np.full(len(self.truth), np.nan) if self.track is None else self.track.p_flip

    @property
    def flipped(self) -> NDArray[np.bool_]:
        """(n,) poses whose base-to-tip direction is more than 90 degrees off."""
        if self.track is None:
            return np.zeros(len(self.truth), np.bool_)
        own, true = (j[:, self.tip] - j[:, 0] for j in (self.track.joints_mm, self.truth))
        return np.asarray(np.einsum("nd,nd->n", own, true) < 0)

    @property
    def inside(self) -> Array:
        """(m, J, 3) of the m poses, 1 where a coordinate lies within its 90 % interval, else 0."""
        if self.track is None:
            return np.zeros((0, *self.truth.shape[1:]))
        posed = self.track.posed
        within = np.abs(self.off_mm[posed]) <= _Z90 * self.track.sd_xyz_mm[posed]
        return within.astype(np.float64)


def build_figures(rows: Sequence[Built], joints: Sequence[str]) -> dict[str, Any]:
    """Figures over some recordings, under their names, see `BUILDS_PROTOCOL`.

    Args:
        rows: the recordings, at least one.
        joints: names of the joints.

    Returns:
        The figures; None for those that have no pose to be of.
    """
    error = np.concatenate([row.error for row in rows])
    recording = np.concatenate([np.full(len(row.truth), k) for k, row in enumerate(rows)])
    posed = np.isfinite(error)
    figures: dict[str, Any] = {
        "n_recordings": len(rows),
        "n_frames": len(error),
        "found": float(posed.mean()),
    }
    if not posed.any():
        return figures
    inside = np.concatenate([row.inside for row in rows])
    by_joint = inside.mean(axis=(0, 2))
    trusted = np.concatenate([row.trusted for row in rows])
    flipped = np.concatenate([row.flipped for row in rows]) & posed
    predicted = np.concatenate([row.predicted for row in rows])
    lengths_mm = np.array([row.length_mm for row in rows])[recording]
    heights = np.array([np.nanmean(row.off_mm[..., 2]) for row in rows if row.track is not None])
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
        "longest_flip": max(_longest(row.flipped) for row in rows),
        "p_flip": _reliability(np.concatenate([row.p_flip for row in rows])[posed], flipped[posed]),
        "wrong_but_trusted": float((error > _FAR)[trusted].mean()) if trusted.any() else 0.0,
        "trusted": float(trusted.mean()),
        "length_off": float(np.nanmean([abs(row.found_mm / row.length_mm - 1.0) for row in rows])),
        "height_bias_mm": float(heights.mean()),
        "height_off_mm": float(np.abs(heights).mean()),
    }


def _longest(flipped: NDArray[np.bool_]) -> int:
    """Most frames in a row that are (n,) flipped."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flipped, [False]]).astype(np.int8)))
    return int((edges[1::2] - edges[::2]).max(initial=0))


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
