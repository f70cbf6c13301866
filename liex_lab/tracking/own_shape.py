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

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from liex_lab.body.pose import Pose
from liex_lab.estimation.estimator import Estimates, PoseEstimator
from liex_lab.estimation.session_shape import (
    PLACES,
    Build,
    ShapePrior,
    built,
    outline_labels,
    session_clues,
)
from liex_lab.scene.height_maps import Segmenter, view_of
from liex_lab.tracking.residual import Array, BodyResidual
from liex_lab.tracking.trust import finite_median

FEWEST_FRAMES = 50


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
        unlike: whether the body is unlike those that shapes were learned from.
        unseen: see `Build.unseen`; None if the animal's usual values apply.
    """

    build: Build | None
    n_frames: int
    average_residual_mm: float = float("nan")
    residual_mm: float = float("nan")
    why: str = ""
    shared_by: str = ""
    unlike: bool = False
    unseen: tuple[float, float] | None = None

    def caution(self, length_mm: float) -> str:
        """A sentence for the user if the body is unlike those of the training, else empty."""
        if not self.unlike:
            return ""
        return (
            "the body is unlike those that shapes were learned from: its height is assumed, not "
            "measured, and the depth of all joints may be off by "
            f"{self.shared_error_mm(length_mm):.1f} mm"
        )

    def shared_error_mm(self, length_mm: float) -> float:
        """Deviation in depth that all frames share, mm, if the body is unlike those of the
        training, else 0: it cautions against the session, and makes no frame doubtful.
        """
        return self.unseen[0] * length_mm if self.unlike and self.unseen else 0.0

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
        build = self.build
        average, own = (
            round(mm, 4) if np.isfinite(mm) else None
            for mm in (self.average_residual_mm, self.residual_mm)
        )
        table: dict[str, Any] = {
            "kept": build is not None,
            "n_frames": self.n_frames,
            "average_residual_mm": average,
            "residual_mm": own,
            **({"shared_by": self.shared_by} if self.shared_by else {}),
            **({"unlike": True} if self.unlike else {}),
        }
        if build is None:
            return {**table, "why": self.why}
        return {
            **table,
            "places": list(PLACES),
            "width": build.width.round(3).tolist(),
            "width_sd": build.width_sd.round(3).tolist(),
            "height": build.height.round(3).tolist(),
            "height_sd": build.height_sd.round(3).tolist(),
            "joints_moved": build.offset.round(4).tolist(),
        }


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
    why = ""
    if prior.model != estimator.model.fingerprint:
        why = f"shapes were learned for the bundled model of the {skeleton.name} alone"
        stated = None
    elif stated is not None and stated.labels is None:
        why = f"too few of the {stated.by} support another shape, so all use the average one"
    elif stated is None and len(good) < FEWEST_FRAMES:
        why = (
            f"{len(good)} frames of the sample show the animal well, and a shape of its own is "
            f"fitted to {FEWEST_FRAMES} or more"
        )
    by = "" if stated is None else stated.by
    if why:
        return OwnShape(None, len(good), why=why, shared_by=by), average
    camera_view = average.camera_view

    def poses(rows: NDArray[np.int64], build: Build | None = None) -> Pose:
        """Poses (n), arena frame, corrected for a build if there is one."""
        pose = estimates.chosen.pose[rows]
        pose = pose if build is None else build.corrected(skeleton, pose, size)
        return pose.moved(scene.floor.T_arena_camera)

    # every third frame is held out from the fit
    held_out, fitted = (good[::3], np.delete(good, np.s_[::3])) if stated is None else (good, good)
    cameras = scene.crop_cameras(estimates.crops, camera_view)[fitted]
    pose = estimates.chosen.pose[fitted].moved(view_of(cameras))
    clues = session_clues(skeleton, pose, estimates.crops.heights[fitted], cameras, size)
    unlike = prior.is_unlike(clues)
    if stated is not None and stated.labels is not None:
        labels = stated.labels
    else:
        labels = outline_labels(skeleton, clues) if unlike else prior.predict(clues)
    build = Build.of(prior, labels, unlike)
    own = BodyResidual.fit(
        built(skeleton, build.width, build.height),
        poses(fitted, build),
        estimates.crops[fitted],
        scene,
        camera_view,
        size,
    )
    crops = estimates.crops[held_out]
    before = average.of(poses(held_out), crops, scene)
    after = own.of(poses(held_out, build), crops, scene)
    mm = finite_median(before, np.nan), finite_median(after, np.nan)
    if stated is None and not borne_out(before, after):
        why = (
            "on frames that were held out a body of its own leaves "
            f"{mm[1]:.2f} mm to the depth and the average one {mm[0]:.2f} mm"
        )
        return OwnShape(
            None, len(good), *mm, why, "", unlike, prior.unseen_of(unlike) if unlike else None
        ), average
    return OwnShape(build, len(good), *mm, "", by, unlike, build.unseen), own


def borne_out(before: Array, after: Array) -> bool:
    """Whether held-out frames support the fitted body.

    Args:
        before: (n,) residuals of the average body, mm; NaN if too little is covered.
        after: (n,) of the fitted body.

    Returns:
        True if the median decreases, or if the mean decrease per frame is above zero.
    """
    if finite_median(after, np.nan) < finite_median(before, np.nan):
        return True
    fallen = before - after
    fallen = fallen[np.isfinite(fallen)]
    return bool(len(fallen)) and float(fallen.mean()) > 0.0
