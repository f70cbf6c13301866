"""Scores of poses and tracks against truth: `liex evaluate pose`, `tracking`, `scenes`.

Lie-X (section 5) scores a frame by its mean per-joint position error,

    e = 1/J sum_j |x_j - y_j|        (mm).

`POSE_PROTOCOL`, `TRACKING_PROTOCOL` and `SCENES_PROTOCOL` define every number.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from liex_lab.arrays import Array, Mask, NDArray
from liex_lab.runtime.memory import Rows
from liex_lab.tracking.track import spans

if TYPE_CHECKING:
    from liex_lab.simulation.corruptions import Event
    from liex_lab.simulation.recording import TrueAnimal


POSE_PROTOCOL = (
    "Error of a frame: mean over joints of the 3D distance between measured and true joint, mm; "
    "mean, median and 95 % over the frames in which an animal was measured. lost_rate: share of "
    "frames with no measurement. flip_rate: share of the measured frames whose base-to-tip "
    "direction is more than 90 degrees from the true one. spearman_predicted_error: rank "
    "correlation of predicted and true error over frames. interval90_coverage: share of frames "
    "whose true error lies in the 90 % interval predicted for it."
)
TRACKING_PROTOCOL = (
    "Error of a frame: mean over joints of the 3D distance between measured and true joint, mm. "
    "single: each frame by itself; algorithm3: the paper's particle filter, 200 "
    "particles, on our regressors and metric; algorithm1_paper, algorithm3_paper and "
    "algorithm3_paper_base_round: the paper's single frames (the best-scored candidate) and its "
    "filter with the parts of its own variant, without and with a round of the base's regressors, "
    "set against each other by ratio_to_single, and the note states whether its process noise was "
    "searched; online: the default tracker, each row some frames late (online_lag_frames); "
    "smoothed: the default tracker over the whole sequence. mean and p95: over the frames in which "
    "the row has a pose, bridged ones included; lost_rate: share of frames without one. "
    "ratio_to_single and p95_ratio_to_single: over the frames in which this row and the single "
    "frames both have a pose. in_view_ratio and in_view_p95_ratio: over all frames in which at "
    "least half of the animal is visible; a frame without a pose counts as an error of half the "
    "animal's length, for both, so that leaving out frames gains nothing. longest_flip_frames: "
    "most frames in a row whose base-to-tip direction is more than 90 degrees from the true one. "
    "interval90_coverage: share of joint coordinates within 1.645 sd of the truth. "
    "recovery_frames: after the end of an occlusion (the bar has passed, or less than half of the "
    "animal is hidden again), frames until the error is below 0.12 of its length, the worst of "
    "them. frames_per_s: on this machine, reading excluded; speed: the smoothed row's, timed by "
    "itself over the first frames, the best of three times."
)
SCENES_PROTOCOL = (
    "Each scene is rendered, measured as `liex run` does, and its tables read back; joints are "
    "compared in the camera frame. found: of the frames in which at least half of an animal is in "
    "view, all animals together, the share that have a pose. mean_joint_error_mm and "
    "median_joint_error_mm: over those poses, mean over joints of the 3D distance to the true one. "
    "flips: share of those poses whose base-to-tip direction is more than 90 degrees off. "
    "hidden_right: of the frames with an animal of which at most a quarter is visible, "
    "the share without a trusted pose; null where there are none. wrong_but_trusted: of the "
    "frames that the tables flag as trusted, the share whose error is beyond 15 % of the true "
    "spine; where there is no animal, or one of another kind than the plan's, or an individual "
    "that matches no animal, every trusted frame counts; 0 where none is trusted. trusted: "
    "share of all frames that are. ratio_to_plain: the mean error over that of the plain scene "
    "of the same animal. said: the problems that the session lists, or the sentence with which "
    "the run ended. exit_code: of the run."
)
FAR = 0.15  # of the spine: a larger error is wrong


def error_of(joints: Array, truth: Array) -> Array:
    """(n,) mean joint error, mm, of joints (n, J, 3); NaN where either is missing."""
    return np.asarray(np.linalg.norm(joints - truth, axis=-1).mean(axis=1))


def is_flipped(joints: Array, truth: Array, tip: int) -> Mask:
    """(n,) whether the direction from base to `tip` is more than 90 degrees off."""
    along, true = (one[:, tip] - one[:, 0] for one in (joints, truth))
    return np.asarray(np.einsum("nd,nd->n", along, true) < 0)


def along_body(joints: Array, truth: Array, rows: Mask) -> tuple[Array, Array, Array]:
    """Errors along the body, and their constant: where a joint lies along a body is a convention.

    Args:
        joints: (n, J, 3) measured joints, mm, in a frame whose xy is the plane of the floor, or
            the image of a camera above it.
        truth: (n, J, 3) true joints, mm, in the same frame.
        rows: (n,) bool, frames that determine the constant.

    Returns:
        Directions (n, J, 2) of the true spine, unit vectors from base to tip; errors (n, J) along
        them, mm; their medians (J,) over `rows`, mm.
    """
    way = np.gradient(truth[..., :2], axis=1)
    way /= np.maximum(np.linalg.norm(way, axis=-1, keepdims=True), 1e-9)
    along = ((joints - truth)[..., :2] * way).sum(axis=-1)
    return way, along, np.nanmedian(along[rows], axis=0)


@dataclass(frozen=True)
class PoseErrors(Rows):
    """Errors of measured against true poses in n frames.

    Attributes:
        error_mm: (n,) mean joint error, mm; NaN where the animal was lost.
        joint_mm: (n, J) error of each joint, mm.
        flipped: (n,) bool, the base-to-tip direction is more than 90 degrees off.
        predicted_mm: (n,) predicted error, mm; NaN if not predicted.
        low_mm: (n,) lower bound of the predicted 90 % interval of the error, mm.
        high_mm: (n,) upper bound of that interval, mm.
    """

    error_mm: Array
    joint_mm: Array
    flipped: Mask
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
            tip: the joint whose direction from the base is the heading.
            predicted_mm: (n,) predicted mean joint error, mm.
            quantiles: (2,) ratios of true to predicted error that bound the 90 % interval.
        """
        joint_mm = np.linalg.norm(joints - true_joints, axis=-1)
        flipped = is_flipped(joints, true_joints, tip)
        bounds = np.multiply.outer(quantiles, predicted_mm)
        return PoseErrors(joint_mm.mean(axis=1), joint_mm, flipped, predicted_mm, *bounds)

    def summary(self) -> dict[str, Any]:
        """The numbers of `liex evaluate pose` by name.

        Those of a missing prediction are None; if every frame is lost, all but lost_rate are None.
        """
        posed = np.isfinite(self.error_mm)
        some = bool(posed.any())
        error, predicted = self.error_mm[posed], self.predicted_mm[posed]
        inside = (error >= self.low_mm[posed]) & (error <= self.high_mm[posed])
        predicts = some and bool(np.isfinite(predicted).all())
        return {
            "mean_joint_error_mm": float(error.mean()) if some else None,
            "median_joint_error_mm": float(np.median(error)) if some else None,
            "p95_joint_error_mm": float(np.quantile(error, 0.95)) if some else None,
            "flip_rate": float(self.flipped[posed].mean()) if some else None,
            "lost_rate": float(1.0 - posed.mean()),
            "spearman_predicted_error": rank_correlation(predicted, error) if predicts else None,
            "interval90_coverage": float(inside.mean()) if predicts else None,
        }


def interval95(
    error: Array,
    recording: NDArray[np.int64],
    statistic: Callable[[Array], Any] = np.median,
    n_draws: int = 1_000,
) -> tuple[float, float] | None:
    """The 95 % interval of a statistic of frame errors, by resampling recordings with replacement.

    Frames of one recording share camera, arena and animal, so they are not independent: whole
    recordings are resampled (cluster bootstrap; Davison and Hinkley 1997, section 3.8).

    Args:
        error: (n,) errors of frames, mm; NaN frames are left out.
        recording: (n,) number of each frame's recording.
        statistic: of the errors, such as their median or mean.
        n_draws: number of bootstrap draws.

    Returns:
        Lower and upper bound, mm; None if fewer than two recordings have an error.
    """
    posed = np.isfinite(error)
    groups = [error[posed & (recording == k)] for k in np.unique(recording[posed])]
    if len(groups) < 2:
        return None
    rng = np.random.default_rng(20170703)
    drawn = [
        statistic(np.concatenate([groups[k] for k in rng.integers(len(groups), size=len(groups))]))
        for _ in range(n_draws)
    ]
    low, high = np.quantile(drawn, [0.025, 0.975])
    return float(low), float(high)


def rank_correlation(a: Array, b: Array) -> float:
    """Spearman's rank correlation of two series (n,)."""
    from scipy.stats import spearmanr

    return float(spearmanr(a, b).statistic)


def plain(value: Any) -> Any:
    """Convert nested dicts, lists, tuples, arrays and numbers to JSON's types.

    Non-finite numbers become None.
    """
    if isinstance(value, dict):
        return {str(key): plain(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [plain(inner) for inner in value]
    value = value.tolist() if hasattr(value, "tolist") else value
    if isinstance(value, list):
        return plain(value)
    return None if isinstance(value, float) and not math.isfinite(value) else value


@dataclass(frozen=True)
class Followed:
    """One tracked sequence of n frames with its truth.

    Attributes:
        joints: (n, J, 3) estimated joints, mm; NaN without a pose.
        truth: (n, J, 3) true joints, mm, in the same frame.
        sd_mm: (n, J, 3) estimated standard deviation of each joint along x, y and z, mm.
        frames_per_s: speed of the tracker, reading excluded.
        tip: the joint whose direction from the base is the heading.
    """

    joints: Array
    truth: Array
    sd_mm: Array
    frames_per_s: float
    tip: int = -1

    @property
    def error_mm(self) -> Array:
        """(n,) mean joint error, mm; NaN without a pose."""
        return error_of(self.joints, self.truth)

    @property
    def flipped(self) -> Mask:
        """(n,) bool, whether the base-to-tip direction is more than 90 degrees off."""
        return is_flipped(self.joints, self.truth, self.tip)

    @property
    def longest_flip(self) -> int:
        """Most flipped frames in a row."""
        return max((stop - start for start, stop in spans(self.flipped)), default=0)

    @property
    def inside(self) -> Mask:
        """(n, J, 3) bool, whether a joint coordinate lies within its 90 % interval."""
        return np.asarray(np.abs(self.joints - self.truth) <= 1.645 * self.sd_mm)

    def in_view(self, events: Sequence[Event], length_mm: float) -> Array:
        """Errors (m,) mm of the frames in which at least half of the animal is visible.

        Args:
            events: the sequence's events; frames of kind 'hidden' are left out.
            length_mm: length of the animal; a frame without a pose has an error of half of it.
        """
        visible = np.ones(len(self.joints), np.bool_)
        for event in events:
            if event.kind == "hidden":
                visible[event.start : event.stop] = False
        return np.nan_to_num(self.error_mm, nan=0.5 * length_mm)[visible]

    def recovery(self, events: Sequence[Event], length_mm: float) -> list[int]:
        """Frames from the end of each occlusion until the animal is found again.

        Args:
            events: the sequence's events; those of kind 'hidden' and 'occluder' count.
            length_mm: length of the animal; it is found once the error is below 0.12 of it.

        Returns:
            Counts; the rest of the sequence if the animal is not found.
        """
        near = self.error_mm < 0.12 * length_mm
        return [
            int(np.append(near[event.stop :], True).argmax())
            for event in events
            if event.kind in ("hidden", "occluder") and event.stop < len(near)
        ]


def tracking_figures(
    rows: Sequence[Followed],
    single: Sequence[Followed],
    events: Sequence[Sequence[Event]],
    length_mm: float,
) -> dict[str, Any]:
    """Results of one tracker over some sequences, see `TRACKING_PROTOCOL`.

    Args:
        rows: the tracked sequences.
        single: the same sequences, estimated frame by frame.
        events: events of each sequence.
        length_mm: length of the animal, mm.

    Returns:
        By name; only a lost_rate of 1 if no frame has a pose in both.
    """
    error, alone = (np.concatenate([row.error_mm for row in some]) for some in (rows, single))
    posed = np.isfinite(error)
    both = posed & np.isfinite(alone)
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
    p95, p95_alone = (np.quantile(some[both], 0.95) for some in (error, alone))
    return {
        "mean_joint_error_mm": float(error[posed].mean()),
        "p95_joint_error_mm": float(np.quantile(error[posed], 0.95)),
        "ratio_to_single": float(error[both].mean() / alone[both].mean()),
        "p95_ratio_to_single": float(p95 / p95_alone),
        "in_view_ratio": float(own.mean() / others.mean()),
        "in_view_p95_ratio": float(np.quantile(own, 0.95) / np.quantile(others, 0.95)),
        "lost_rate": float(1.0 - posed.mean()),
        "longest_flip_frames": max(row.longest_flip for row in rows),
        "interval90_coverage": float(
            np.concatenate(
                [row.inside[np.isfinite(row.joints) & np.isfinite(row.sd_mm)] for row in rows]
            ).mean()
        ),
        "recovery_frames": max(recovery) if recovery else None,
        "frames_per_s": float(np.mean([row.frames_per_s for row in rows])),
    }


@dataclass(frozen=True)
class MeasuredIndividual:
    """One individual of a session in n frames.

    Attributes:
        joints_camera: (n, J, 3) mm, camera frame; NaN without a pose.
        trusted: (n,) bool, whether the tables flag the pose as trusted.
        sd_mm: (n, J, 3) standard deviations along x, y and z of the arena, mm.
        expected_mm: (n,) predicted error, mm.
        R_arena_camera: (3, 3) from the axes of `joints_camera` to the arena's.
        crossings: (k, 3) first frame, frame after the last, and probability of an exchange, of the
            stretches in which it may have been exchanged with another one.
        interactions: the table of its arena; None if it was measured alone.
    """

    joints_camera: Array
    trusted: Mask
    sd_mm: Array = field(default_factory=lambda: np.zeros((0, 0, 3)))
    expected_mm: Array = field(default_factory=lambda: np.zeros(0))
    R_arena_camera: Array = field(default_factory=lambda: np.eye(3))
    crossings: Array = field(default_factory=lambda: np.zeros((0, 3)))
    interactions: pd.DataFrame | None = None


class Tally:
    """Counts over recordings of one scene, from which its results are computed."""

    def __init__(self) -> None:
        self._n: Counter[str] = Counter()  # frames, or pairs of frame and animal or individual
        # of the poses in view, an array for each animal
        self._errors_mm = [np.zeros(0)]
        self._flipped = [np.zeros(0, np.bool_)]

    def add(
        self,
        truths: Sequence[TrueAnimal],
        individuals: Sequence[MeasuredIndividual],
        n_frames: int,
        tip: int = -1,
        fits: bool = True,
    ) -> None:
        """Count one recording.

        Args:
            truths: its true animals.
            individuals: of the session; () if the run was refused.
            n_frames: length of the recording.
            tip: the joint whose direction from the base is the heading.
            fits: whether the animals are of the plan's kind; if not, every trusted frame is wrong
                and nothing else is counted.
        """
        pairs = matched(truths, individuals) if fits else {}
        trusted = [int(one.trusted.sum()) for one in individuals]
        alone = sum(n for k, n in enumerate(trusted) if k not in pairs.values())
        self._n += Counter(frames=n_frames, trusted=sum(trusted), wrong=alone)
        for t, truth in enumerate(truths if fits else ()):
            there = np.isfinite(truth.joints_camera).all(axis=(1, 2))
            view = there & (truth.visible >= 0.5)
            hidden = there & (truth.visible <= 0.25)
            self._n += Counter(in_view=int(view.sum()), hidden=int(hidden.sum()))
            if t not in pairs:
                self._n["hidden_right"] += int(hidden.sum())
                continue
            one = individuals[pairs[t]]
            error = error_of(one.joints_camera, truth.joints_camera)
            rows = view & np.isfinite(one.joints_camera).all(axis=(1, 2))
            self._n += Counter(
                found=int(rows.sum()),
                hidden_right=int((hidden & ~one.trusted).sum()),
                wrong=int((one.trusted & ~(error <= FAR * truth.spine_mm)).sum()),
            )
            self._errors_mm.append(error[rows])
            self._flipped.append(
                is_flipped(one.joints_camera[rows], truth.joints_camera[rows], tip)
            )

    def figures(self) -> dict[str, Any]:
        """Results of the scene, see `SCENES_PROTOCOL`; None for those without frames."""
        errors = np.concatenate(self._errors_mm)
        some = len(errors) > 0
        n = self._n
        return {
            "n_frames": n["frames"],
            "found": n["found"] / n["in_view"] if n["in_view"] else None,
            "mean_joint_error_mm": float(errors.mean()) if some else None,
            "median_joint_error_mm": float(np.median(errors)) if some else None,
            "flips": float(np.concatenate(self._flipped).mean()) if some else None,
            "hidden_right": n["hidden_right"] / n["hidden"] if n["hidden"] else None,
            "trusted": n["trusted"] / max(n["frames"], 1),
            "wrong_but_trusted": n["wrong"] / n["trusted"] if n["trusted"] else 0.0,
        }


def matched(
    truths: Sequence[TrueAnimal], individuals: Sequence[MeasuredIndividual]
) -> dict[int, int]:
    """Assign individuals to true animals by the least sum of errors (Hungarian method).

    An error is capped at a spine's length, which is also the error of a missing pose.

    Returns:
        The individual's index by the animal's index, for each animal that has one.
    """
    from scipy.optimize import linear_sum_assignment

    def cost(truth: TrueAnimal, one: MeasuredIndividual) -> float:
        error = np.nan_to_num(error_of(one.joints_camera, truth.joints_camera), nan=truth.spine_mm)
        return float(np.minimum(error, truth.spine_mm).mean())

    costs = np.array([[cost(truth, one) for one in individuals] for truth in truths])
    rows, columns = linear_sum_assignment(costs.reshape(len(truths), len(individuals)))
    return dict(zip(rows.tolist(), columns.tolist(), strict=True))
