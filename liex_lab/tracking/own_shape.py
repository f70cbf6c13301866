"""The session's shape: fitted over many frames, and used only if held-out frames support it.

The regression of `estimation.session_shape` estimates the animal's build from two thirds of the
sampled frames that show it well. The body of that build, at its best girth and in the corrected
poses, is then compared with the depth of the other third, as is the average body at its best girth
in the original poses (hold-out validation). The fitted body is used if it has the smaller median
residual or, paired by frame, the smaller mean: in a near tie the estimated build is the likelier.
With fewer than 50 such frames the average body is used.

A stated shape, as shared by the sessions of one animal, is used unchanged, and is only compared
with the depth of all frames that show the animal well.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from liex_lab.body.pose import Pose
from liex_lab.estimation.estimator import Estimates, PoseEstimator
from liex_lab.estimation.session_shape import PLACES, Build, ShapePrior, session_clues
from liex_lab.scene.height_maps import Segmenter, view_of
from liex_lab.tracking.residual import BodyResidual

Array = NDArray[np.float64]

FEWEST_FRAMES = 50
_HELD_OUT = 3  # every third frame is held out from the fit


@dataclass(frozen=True)
class StatedShape:
    """A stated shape, which is not fitted.

    Attributes:
        labels: (K,), see `session_shape.labels_of`; None for the average animal's.
        girth: of the average body; None fits it.
        by: the source, such as '4 sessions of m07'.
    """

    labels: Array | None
    girth: float | None
    by: str


@dataclass(frozen=True)
class OwnShape:
    """A session's shape: the animal's build, and the evidence for it.

    Attributes:
        build: the build; None if the average body was kept.
        n_frames: frames of the sample that show the animal well.
        average_residual_mm: median distance of the average body, at its best girth, from the depth
            of the held-out frames, mm; NaN if there are none.
        residual_mm: the same of the fitted body in the corrected poses.
        why: why the average body was kept; empty if it was not.
        shared_by: source of a stated shape; empty if it was estimated from the session's frames.
    """

    build: Build | None
    n_frames: int
    average_residual_mm: float = float("nan")
    residual_mm: float = float("nan")
    why: str = ""
    shared_by: str = ""

    def corrected(self, estimator: PoseEstimator, pose: Pose, size: float) -> Pose:
        """Poses minus the mean error of such a body; unchanged if it is unknown.

        Args:
            estimator: the animal's.
            pose: (n) poses in any frame, NaN if absent.
            size: the animal's size over home size.
        """
        return pose if self.build is None else self.build.corrected(estimator.skeleton, pose, size)

    def to_dict(self) -> dict[str, Any]:
        """The shape for session.json."""
        told: dict[str, Any] = {
            "kept": self.build is not None,
            "n_frames": self.n_frames,
            "average_residual_mm": _rounded(self.average_residual_mm),
            "residual_mm": _rounded(self.residual_mm),
            **({"shared_by": self.shared_by} if self.shared_by else {}),
        }
        if self.build is None:
            return {**told, "why": self.why}
        build = self.build
        return {
            **told,
            "places": list(PLACES),
            "width": build.width.round(3).tolist(),
            "width_sd": build.width_sd.round(3).tolist(),
            "height": build.height.round(3).tolist(),
            "height_sd": build.height_sd.round(3).tolist(),
            "joints_moved": build.offset.round(4).tolist(),
        }


def _rounded(value: float) -> float | None:
    return round(value, 4) if np.isfinite(value) else None


def fit_shape(
    prior: ShapePrior | None,
    estimator: PoseEstimator,
    scene: Segmenter,
    estimates: Estimates,
    size: float,
    average: BodyResidual,
    stated: StatedShape | None = None,
) -> tuple[OwnShape | None, BodyResidual]:
    """The session's shape from a sample of its frames, and the body for all its frames.

    Args:
        prior: of the animal, None if no shapes were learned.
        estimator: the animal's.
        scene: the segmenter of the recording's camera.
        estimates: of the sampled frames, camera frame.
        size: the animal's size over home size.
        average: the average body at its best girth.
        stated: a stated shape; None fits it.

    Returns:
        The shape, None if no shapes were learned; and `average` or the fitted body.
    """
    skeleton = estimator.skeleton
    if prior is None:
        return None, average
    limit = estimator.model.calibration.doubtful_mm * size
    good = np.flatnonzero(estimates.found & ~(estimates.chosen.error_mm > limit))
    if prior.model != estimator.model.fingerprint:
        why = f"shapes were learned for the bundled model of the {skeleton.name} alone"
        return OwnShape(None, len(good), why=why), average
    frames = _Frames(estimator, scene, estimates, size)
    if stated is not None:
        if stated.labels is None:
            why = f"of {stated.by} too few bear out another, and they share it"
            return OwnShape(None, len(good), why=why, shared_by=stated.by), average
        build = Build.of(prior, stated.labels)
        own = frames.at_best_girth(build, good, average.camera_view)
        before, after = frames.residuals(average, good), frames.residuals(own, good, build)
        mm = _median(before), _median(after)
        return OwnShape(build, len(good), *mm, shared_by=stated.by), own
    if len(good) < FEWEST_FRAMES:
        why = (
            f"{len(good)} frames of the sample show the animal well, and a shape of its own is "
            f"fitted to {FEWEST_FRAMES} or more"
        )
        return OwnShape(None, len(good), why=why), average
    held_out = good[::_HELD_OUT]
    fitted = np.setdiff1d(good, held_out)
    build = Build.from_clues(prior, frames.clues(fitted))
    own = frames.at_best_girth(build, fitted, average.camera_view)
    before, after = frames.residuals(average, held_out), frames.residuals(own, held_out, build)
    mm = _median(before), _median(after)
    if not borne_out(before, after):
        why = (
            "on frames that were held out a body of its own leaves "
            f"{mm[1]:.2f} mm to the depth and the average one {mm[0]:.2f} mm"
        )
        return OwnShape(None, len(good), *mm, why), average
    return OwnShape(build, len(good), *mm), own


def borne_out(before: Array, after: Array) -> bool:
    """Whether held-out frames support the fitted body.

    Args:
        before: (n,) residuals of the average body, mm; NaN if too little is covered.
        after: (n,) of the fitted body.

    Returns:
        True if the median decreases, or if the mean decrease per frame is above zero.
    """
    if _median(after) < _median(before):
        return True
    fallen = before - after
    fallen = fallen[np.isfinite(fallen)]
    return bool(len(fallen)) and float(fallen.mean()) > 0.0


@dataclass(frozen=True)
class _Frames:
    """The sampled frames, or some of them (`rows`); see `fit_shape`."""

    estimator: PoseEstimator
    scene: Segmenter
    estimates: Estimates
    size: float

    def clues(self, rows: NDArray[np.int64]) -> Array:
        """(F,) clues to the animal's build."""
        camera_view = self.estimator.model.method.camera_view
        cameras = self.scene.crop_cameras(self.estimates.crops, camera_view)[rows]
        pose = self.estimates.chosen.pose[rows].moved(view_of(cameras))
        heights = self.estimates.crops.heights[rows]
        return session_clues(self.estimator.skeleton, pose, heights, cameras, self.size)

    def at_best_girth(
        self, build: Build, rows: NDArray[np.int64], camera_view: bool
    ) -> BodyResidual:
        """The body of a build at its best girth, like the average body."""
        surface = build.surface(self.estimator.skeleton)
        crops = self.estimates.crops[rows]
        return BodyResidual.fit(
            surface, self._pose(rows, build), crops, self.scene, camera_view, self.size
        )

    def residuals(
        self, body: BodyResidual, rows: NDArray[np.int64], build: Build | None = None
    ) -> Array:
        """Residuals (n,) mm of a body, NaN unknown, in the poses that are corrected for a build."""
        return body.of(self._pose(rows, build), self.estimates.crops[rows], self.scene)

    def _pose(self, rows: NDArray[np.int64], build: Build | None) -> Pose:
        """Poses (n), arena frame, corrected for a build if there is one."""
        pose = self.estimates.chosen.pose[rows]
        if build is not None:
            pose = build.corrected(self.estimator.skeleton, pose, self.size)
        return pose.moved(self.scene.floor.T_arena_camera)


def _median(residual: Array) -> float:
    """Median over the frames, mm; NaN if nothing is covered."""
    known = residual[np.isfinite(residual)]
    return float(np.median(known)) if len(known) else float("nan")


# One body for the sessions of one animal: a random-effects mean of the individual estimates.


MOST_APART = 0.08  # of the median length: a larger difference means growth, or another animal
_LEAST_SD = 0.001  # of the length: smallest standard deviation of a session's estimate


@dataclass(frozen=True)
class Found:
    """The estimates of one session about its animal.

    Attributes:
        spine_mm: the animal's length, mm.
        stated: whether the plan states that length, so that it is not an estimate.
        log_sd: standard deviation of the logarithm of the length in single frames.
        n_frames: frames with a pose.
        girth: of the average body; unused if a shape was kept.
        shape: (K,) labels of the kept shape, see `session_shape.labels_of`; None if there is none.
        refused: whether held-out frames contradicted the fitted shape.
        n_well_seen: frames that show the animal well.
    """

    spine_mm: float
    stated: bool = False
    log_sd: float = 0.0
    n_frames: int = 1
    girth: float = 1.0
    shape: Array | None = None
    refused: bool = False
    n_well_seen: int = 0

    @property
    def variance(self) -> float:
        """Variance of the logarithm of the length, from the scatter of its own frames only."""
        return max(self.log_sd**2 / max(self.n_frames, 1), _LEAST_SD**2)


@dataclass(frozen=True)
class Agreed:
    """The shared values of the sessions of one animal.

    Attributes:
        spine_mm: the length, mm; None if every session's plan states its own.
        girth: of the average body; None if a shape is shared.
        shape: (K,) labels of the shape; None if too few sessions support one.
    """

    spine_mm: float | None
    girth: float | None
    shape: Array | None


def spread_of(found: Sequence[Found]) -> float:
    """The spread of the lengths: largest minus smallest, over the median.

    Args:
        found: of sessions of one animal, at least one.
    """
    lengths = [one.spine_mm for one in found]
    return (max(lengths) - min(lengths)) / float(np.median(lengths))


def agree(found: Sequence[Found]) -> Agreed:
    """The shared values of sessions, independent of their order.

    Args:
        found: of sessions of one animal whose lengths are at most `MOST_APART` apart.
    """
    measured = [one for one in found if not one.stated]
    shape = _shape(found)
    average = [one for one in found if one.shape is None]
    girth = None
    if shape is None and average:
        girth = _mean([one.girth for one in average], [float(one.n_frames) for one in average])
    return Agreed(_length(measured) if measured else None, girth, shape)


def _length(measured: Sequence[Found]) -> float:
    y = [math.log(one.spine_mm) for one in measured]
    variance = [one.variance for one in measured]
    between = _between(y, [1.0 / v for v in variance])
    return math.exp(_mean(y, [1.0 / (v + between) for v in variance]))


def _between(y: Sequence[float], v: Sequence[float]) -> float:
    """The variance between sessions, t^2, by the method of moments."""
    m = _mean(y, v)
    q = math.fsum(v_i * (y_i - m) ** 2 for y_i, v_i in zip(y, v, strict=True))
    whole = math.fsum(v)
    per = whole - math.fsum(v_i**2 for v_i in v) / whole
    return max(0.0, (q - (len(y) - 1)) / per) if len(y) > 1 else 0.0


def _shape(found: Sequence[Found]) -> Array | None:
    kept = [(one.shape, one.n_well_seen) for one in found if one.shape is not None]
    n_against = sum(one.n_well_seen for one in found if one.refused)
    if sum(n for _, n in kept) <= n_against:
        return None
    weights = [float(n) for _, n in kept]
    columns = zip(*(shape.tolist() for shape, _ in kept), strict=True)
    return np.array([_mean(column, weights) for column in columns])


def _mean(values: Sequence[float], weights: Sequence[float]) -> float:
    return math.fsum(w * x for w, x in zip(weights, values, strict=True)) / math.fsum(weights)
