"""Rows of a track: values of the smoothed curve, validity and uncertainty.

A row is measured, bridged over a gap, or missing. It is doubtful if its predicted error is large or
its depth image contradicts it, and hidden if the animal is behind an object. Its spread is that of
the curve plus the systematic error of a body of a different build or size.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from liex_lab.geometry import so3
from liex_lab.tracking.association import NONE
from liex_lab.tracking.observations import Observations, joints_of
from liex_lab.tracking.smoother import SmoothedCurve, TrackingParameters
from liex_lab.tracking.track import Subject, Track, short_gaps
from liex_lab.tracking.trust import (
    MOST_ERROR,
    WHOLE,
    contradicted,
    lies_unknown,
    share_in_view,
    together,
    usual_pixels,
)

Array = NDArray[np.float64]

# mean 3D distance over the standard deviation along one axis: 1.6 for a Gaussian, but tails are
# heavier
ERROR_PER_SD = 1.4


# columns that describe the observed animal, not its pose
SIGHT = ("n_foreground_px", "centroid_mm", "centroid_px", "residual_mm")


def to_track(
    subject: Subject,
    observed: Observations,
    path: NDArray[np.int64],
    curve: SmoothedCurve,
    doubt: Array,
    ahead: bool = False,
    due: slice = slice(None),
    tuning: TrackingParameters | None = None,
    usual_px: float | None = None,
) -> Track:
    """The rows of a track that a smoothed curve gives: measured, bridged over a gap, or missing.

    Args:
        subject: the animal of the track.
        observed: hypotheses (n, H) of the frames that the curve covers.
        path: (n,) hypothesis of each frame, `NONE` if it was skipped.
        curve: smoothed poses of the n frames, arena frame.
        doubt: (n,) probability that head and tail are exchanged.
        ahead: extend the curve for up to `bridge_s` after the last measurement (prediction).
        due: rows to return; gaps are determined from all n.
        tuning: motion parameters with the calibration factors; None uses the animal's own.
        usual_px: the animal's usual number of pixels; None uses the median of these frames.

    Returns:
        A track of the rows `due`; NaN if nothing was measured or bridged, flagged as hidden if too
        little of the animal is visible next to a nearer object.
    """
    tuning = tuning or TrackingParameters.of(subject.skeleton.name)
    measured = curve.used & (path >= 0)
    bridged = short_gaps(observed.seconds, measured, subject.bridge_s, ahead)
    track = Track.empty(subject.skeleton, observed.times_ns[due])
    write_curve(subject, track, curve[due], tuning)
    usual_px = usual_pixels(observed, path) if usual_px is None else usual_px
    in_view = share_in_view(observed, path, usual_px)
    unknown = lies_unknown(in_view, doubt)
    masks = measured & ~unknown, bridged, doubted(subject, observed, path, in_view, usual_px)
    some = (mask[due] for mask in masks)
    mask_and_flag(subject, track, observed[due], path[due], doubt[due], *some)
    hide(track, (unknown & ~bridged)[due])
    return track


def hide(track: Track, hidden: NDArray[np.bool_]) -> None:
    """Flag rows (n,) of a track in which nothing was measured as hidden, in place.

    Args:
        track: n rows.
        hidden: frames with the animal behind or under an object; bridged poses there are removed.
    """
    hidden = hidden & (track.flag == "not_found")
    _mask(track, hidden)
    track.bridged[hidden] = False
    track.flag[hidden] = "hidden"


def _mask(track: Track, rows: NDArray[np.bool_]) -> None:
    """Remove the pose, with its spread and projection, from rows (n,) of a track."""
    for column in (
        track.joints_mm,
        track.uv_px,
        track.predicted_error_mm,
        track.root_rotation,
        track.root_mm,
        track.angles_rad,
        track.scale,
        track.sd_mm,
        track.sd_xy_mm,
        track.sd_z_mm,
        track.cov_root,
        track.sd_angles_rad,
        track.p_flip,
    ):
        column[rows] = np.nan


def write_curve(
    subject: Subject, track: Track, curve: SmoothedCurve, tuning: TrackingParameters
) -> None:
    """Write a curve into rows of a track, measured or not.

    Args:
        subject: the animal of the track.
        track: its n rows, filled in place.
        curve: smoothed poses of these n frames, arena frame.
        tuning: motion parameters with the calibration factors.
    """
    pose = curve.pose
    motion = tuning.motion
    track.joints_mm[:] = curve.joints
    track.root_rotation[:] = pose.root.rotation
    track.root_mm[:] = pose.root.translation
    track.angles_rad[:] = pose.angles
    track.scale[:] = pose.scale
    stretch = motion.usual_stretch if subject.stretch_sd is None else subject.stretch_sd
    away = stretch_of(stretch, curve.joints)
    # two of three axes: up, and along the body, at any heading
    unseen = subject.unseen or (motion.unseen_height, motion.unseen_shift)
    height, shift = (share * subject.length_mm for share in unseen)
    track.sd_mm[:] = np.hypot(
        (curve.error_mm / ERROR_PER_SD)[:, None] * np.array(subject.joint_share), away
    ) * (motion.joint_calibration or 1.0)
    # sd_mm applies to speeds and headings, which constant errors do not change
    track.sd_xy_mm[:] = np.hypot(track.sd_mm, np.sqrt(0.5) * shift)
    track.sd_z_mm[:] = np.hypot(track.sd_mm, height)
    # of |x| for a Gaussian x, 0.8 is the mean over the standard deviation, sqrt(2 / pi)
    constant = np.hypot(ERROR_PER_SD * away.mean(axis=1), 0.8 * np.hypot(height, shift))
    track.predicted_error_mm[:] = np.hypot(curve.error_mm, constant)
    calibration = np.array(motion.root_calibration)
    R = pose.root.rotation
    up = height * R[:, 2]  # of the arena, in the root's own frame
    along = curve.joints[:, 0] - curve.joints[:, subject.skeleton.tip]
    along *= shift / np.maximum(np.linalg.norm(along, axis=1), 1e-9)[:, None]
    along = np.einsum("nji,nj->ni", R, along)
    track.cov_root[:] = covariance_of_root(curve) * (calibration[:, None] * calibration)
    for constant_mm in (up, along):
        track.cov_root[:, 3:, 3:] += constant_mm[:, :, None] * constant_mm[:, None, :]
    sd_bend = curve.sd_bend * motion.bend_calibration
    track.sd_angles_rad[:] = sd_bend[:, None] * subject.skeleton.axes
    track.sd_angles_rad[:, 0] = 0.0


def mask_and_flag(
    subject: Subject,
    track: Track,
    observed: Observations,
    path: NDArray[np.int64],
    doubt: Array,
    measured: NDArray[np.bool_],
    bridged: NDArray[np.bool_],
    strayed: NDArray[np.bool_],
) -> None:
    """Mask rows of a track to those measured or bridged; add projections, flags and visibility.

    Args:
        subject: the animal of the track.
        track: its n rows, changed in place.
        observed: hypotheses (n, H) of these frames.
        path: (n,) hypothesis of each frame, `NONE` if it was skipped.
        doubt: (n,) probability that head and tail are exchanged.
        measured: (n,) bool, where a hypothesis was selected.
        bridged: (n,) bool, where the curve bridges a gap.
        strayed: (n,) bool, where the depth image contradicts the pose, which makes it doubtful
            like a large predicted error.
    """
    there = measured | bridged
    _mask(track, ~there)
    track.uv_px[there] = subject.camera.project(
        subject.T_arena_camera.inverse() @ track.joints_mm[there]
    )
    track.p_flip[there] = doubt[there]
    rows = np.flatnonzero(measured)
    columns = observed.n_px, observed.centroid_mm, observed.centroid_px, observed.residual_mm
    for name, values in zip(SIGHT, columns, strict=True):
        getattr(track, name)[rows] = values[rows, path[rows]]
    track.bridged[:] = bridged
    limit = min(subject.doubtful_mm, MOST_ERROR * subject.length_mm)
    doubtful = strayed | (track.predicted_error_mm > limit)
    track.flag[measured] = np.where(doubtful, "doubtful", "")[measured]
    track.flag[~measured & ~observed.has_depth] = "no_depth"
    track.flag[observed.copies] = "repeated"


def covariance_of_root(curve: SmoothedCurve) -> Array:
    """Covariance (n, 6, 6) of the root: rotation, rad, then translation, mm, in its own frame.

    First-order propagation: the joints' middle is off by `cov_middle_mm2`, and a small turn φ about
    that middle moves the root by φ x l, with l the lever from the middle to the root; hence the
    blocks Σ_φ, -[l] Σ_φ and R^T Σ_m R + [l] Σ_φ [l]^T, with [l] the skew matrix.

    Args:
        curve: smoothed poses of n frames with the spread of the middle and of the turn.

    Returns:
        (n, 6, 6) symmetric, rad^2, rad mm and mm^2.
    """
    root = curve.pose.root
    out = np.zeros((len(curve.joints), 6, 6))
    lever = np.einsum("nij,ni->nj", root.rotation, curve.joints[:, 0] - curve.joints.mean(axis=1))
    moved = -so3.hat(lever)  # for a small turn: the shift is its cross product with the lever
    turn = curve.sd_turn[:, :, None] ** 2 * np.eye(3)
    out[:, :3, :3] = turn
    out[:, 3:, :3] = moved @ turn
    out[:, :3, 3:] = np.swapaxes(out[:, 3:, :3], 1, 2)
    middle = np.swapaxes(root.rotation, 1, 2) @ curve.cov_middle_mm2 @ root.rotation
    out[:, 3:, 3:] = middle + moved @ turn @ np.swapaxes(moved, 1, 2)
    return np.asarray(0.5 * (out + np.swapaxes(out, 1, 2)))


def stretch_of(stretch_sd: float, joints: Array) -> Array:
    """Standard deviations (n, J) mm of joints from a common error of their distances to the base.

    Args:
        stretch_sd: relative error of the distances, as a standard deviation.
        joints: (n, J, 3) mm, the base first.

    Returns:
        (n, J) mm along one axis: stretch_sd times the distance from the base over sqrt(3).
    """
    return np.asarray(stretch_sd * np.linalg.norm(joints - joints[:, :1], axis=-1) / np.sqrt(3.0))


def single_frames(subject: Subject, observed: Observations) -> Track:
    """The track of single frames, without their neighbours: the first hypothesis of each.

    No association, no smoothing and no bridging; p_flip is 0 throughout. The spread is that of one
    measurement.

    Args:
        subject: the animal of the track; its `bridge_s` is not used.
        observed: hypotheses (n, H), arena frame.

    Returns:
        A track of n rows, NaN if a frame has no first hypothesis.
    """
    path = np.where(observed.known[:, 0], 0, NONE)
    pose = observed.pose(path)
    error = observed.along(observed.error_mm, path)
    motion = TrackingParameters.of(subject.skeleton.name).motion
    turn, bend = motion.angle_sd(error, subject.length_mm)
    middle = (np.array(motion.position_error) * error[:, None])[:, :, None] ** 2 * np.eye(3)
    curve = SmoothedCurve(
        pose, joints_of(subject.skeleton, pose), error, middle, turn, bend, path >= 0
    )
    return to_track(replace(subject, bridge_s=0.0), observed, path, curve, np.zeros(len(observed)))


def doubted(
    subject: Subject,
    observed: Observations,
    path: NDArray[np.int64],
    in_view: Array,
    usual_px: float,
) -> NDArray[np.bool_]:
    """Whether (n,) a pose is doubtful because of its depth image.

    The image contradicts the pose, the animal is partly hidden, or it touches another animal.

    Args:
        subject: the animal of the track.
        observed: hypotheses (n, H).
        path: (n,) hypothesis of each frame, `NONE` if it was skipped.
        in_view: (n,) visible share of the animal.
        usual_px: its usual number of pixels.
    """
    found = contradicted(observed, path, subject.length_mm) | (in_view < WHOLE)
    if subject.n_animals > 1:
        found |= together(observed, path, usual_px)
    return found
