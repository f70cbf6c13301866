"""Corrected poses as measurements to the smoother: the frames around them follow.

Conditioning of a Gaussian process (Rauch, Tung and Striebel 1965): the smoother is affine in its
measurements, and an additional measurement that agrees with the curve changes nothing. So a pose
placed off the curve by δ at frame k moves the curve by the smoother's response to the measurements

  y_k = δ  with (almost) no error,    y_t = 0  with the error of frame t elsewhere,

coordinate by coordinate: the joints' mean (mm), the base's rotation log(R^T R') and the joints'
angles (rad), each an integrated Ornstein-Uhlenbeck process with the parameters of `smoother`. Here
too errors have heavy tails, w = (ν + 1) / (ν + δ^2) in four passes: frames that differ from the
correction by more than their predicted errors weigh less, and the curve stays smooth. A frame
follows only until one of its joints reaches the floor.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from liex_lab.body.pose import Pose
from liex_lab.geometry import SE3, so3
from liex_lab.tracking import _smoother_kernels as kernels
from liex_lab.tracking.motion_model import TrackingParameters
from liex_lab.tracking.smoother import Motion
from liex_lab.tracking.track import Track

Array = NDArray[np.float64]
Rows = NDArray[np.int64]

_REACH = 160  # frames on either side that may move
_CERTAIN = 1e-3  # error of a correction over a frame's predicted error
_PASSES = 4
_HALVINGS = 10  # bisection steps of the share by which a frame can move above the floor
_LEAST_MM = 0.02  # poses that would move less are unchanged
_LEAST_ERROR = 0.005  # smallest error of a frame, over the length


def let_follow(track: Track, was: Pose, placed: Rows) -> Rows:
    """Move the poses around corrected ones with them, in place; returns the moved rows.

    Args:
        track: the track, n rows, with the corrected poses already set; changed in place, except for
            `uv_px`, which belongs to the camera.
        was: the n poses before the correction.
        placed: (k,) rows of the corrected poses, ascending.

    Returns:
        (m,) moved rows, ascending, without the corrected ones.
    """
    near = np.zeros(len(track.times_ns), bool)
    for row in placed:
        near[max(0, row - _REACH) : row + _REACH + 1] = True
    rows = np.flatnonzero(near & np.isfinite(track.joints_mm).all(axis=(1, 2)))
    followed = []
    for run in np.split(rows, np.flatnonzero(np.diff(rows) > _REACH) + 1):
        if len(run):
            followed.append(_follow(track, was, run, np.isin(run, placed)))
    return np.concatenate(followed) if followed else np.zeros(0, np.int64)


def _follow(track: Track, was: Pose, rows: Rows, placed: NDArray[np.bool_]) -> Rows:
    """Move one stretch of rows; the mask marks the corrected ones."""
    skeleton = track.skeleton
    motion = TrackingParameters.of(skeleton.name).motion
    joints_were = was[rows].joints(skeleton)
    length = float(np.nanmedian(track.scale[rows])) * skeleton.length
    off = _departures(track, was, rows, joints_were)
    off[~placed] = 0.0
    error = np.nan_to_num(track.predicted_error_mm[rows], nan=np.inf)
    error = np.maximum(error, _LEAST_ERROR * length)
    error[track.bridged[rows] & ~placed] = np.inf
    error[placed] = _CERTAIN * _LEAST_ERROR * length
    seconds = (track.times_ns[rows] - track.times_ns[rows[0]]) * 1e-9
    weight = np.ones(len(rows))
    nu = motion.degrees_of_freedom
    for _ in range(_PASSES):
        moved = _smoothed(seconds, off, error / np.sqrt(weight), length, motion)
        pose = _moved(track, was, rows, moved)
        apart = np.linalg.norm(pose.joints(skeleton) - joints_were, axis=-1).mean(axis=1)
        weight = np.where(placed, 1.0, (nu + 1.0) / (nu + (apart / error) ** 2))
    lowest = np.minimum(joints_were[..., 2], 0.0)
    share = high = np.ones((len(rows), 1))
    low = np.zeros((len(rows), 1))  # the share of the move that keeps a frame above the floor
    for _ in range(_HALVINGS):
        joints = _moved(track, was, rows, share * moved).joints(skeleton)
        above = (joints[..., 2] >= lowest).all(axis=1, keepdims=True)
        low, high = np.where(above, share, low), np.where(above, high, share)
        share = 0.5 * (low + high)
    pose = _moved(track, was, rows, low * moved)
    far = np.linalg.norm(pose.joints(skeleton) - joints_were, axis=-1).max(axis=1) > _LEAST_MM
    chosen = np.flatnonzero(far & ~placed)
    track.put_pose(rows[chosen], pose[chosen])
    return rows[chosen]


def _departures(track: Track, was: Pose, rows: Rows, joints_were: Array) -> Array:
    """(n, 6 + 3 J) differences between current and previous poses: mean, rotation, angles."""
    middle = (track.joints_mm[rows] - joints_were).mean(axis=1)
    turn = so3.log(np.swapaxes(was.root.rotation[rows], 1, 2) @ track.root_rotation[rows])
    bend = track.angles_rad[rows] - was.angles[rows]
    return np.hstack([middle, turn, bend.reshape(len(rows), -1)])


def _smoothed(seconds: Array, off: Array, error: Array, length: float, motion: Motion) -> Array:
    """The smoother's response to the differences (n, c), coordinate by coordinate."""
    n, n_coordinates = off.shape
    known = np.isfinite(error)
    start = int(np.argmax(known))
    variance = (1.0 - motion.correlated_share**2) * error**2
    level, up = motion.position_variance
    place = float(np.mean(np.square(motion.position_error)))
    groups = [
        *((place, drive * length**2, motion.position_decay_s) for drive in (level, level, up)),
        *(
            ((move.error / length) ** 2, move.process_variance, move.decay_s)
            for move in (*motion.turn, *motion.bend)
        ),
    ]
    made = np.zeros_like(off)
    rate = np.zeros(n)
    for group, (share, drive, decay_s) in enumerate(groups):
        columns = [group] if group < 6 else range(group, n_coordinates, 3)
        if not off[:, columns].any():
            continue
        gain = kernels.Gains.blank(n).axis(0)
        covariances = kernels.Covariances.blank(n)
        kernels.gains(seconds, share * variance, drive, decay_s, start, gain, covariances)
        for column in columns:
            value = np.zeros(n)
            measured = np.ascontiguousarray(off[:, column])
            kernels.smooth_values(measured, known, start, gain, value, rate)
            made[:, column] = value
    return made


def _moved(track: Track, was: Pose, rows: Rows, moved: Array) -> Pose:
    """The poses as they were, moved by middle, turn and angles (n, 6 + 3 J)."""
    skeleton = track.skeleton
    limits = skeleton.limits
    angles = was.angles[rows] + moved[:, 6:].reshape(len(rows), -1, 3)
    angles = np.where(moved[:, 6:].reshape(angles.shape) == 0.0, was.angles[rows], angles)
    inside = np.clip(angles, limits[..., 0], limits[..., 1])
    angles = np.where(angles == was.angles[rows], angles, inside)
    rotation = was.root.rotation[rows] @ so3.exp(moved[:, 3:6])
    pose = Pose(SE3(rotation, was.root.translation[rows]), angles, was.scale[rows])
    middle = was[rows].joints(skeleton).mean(axis=1) + moved[:, :3]
    shift = middle - pose.joints(skeleton).mean(axis=1)
    return Pose(SE3(rotation, was.root.translation[rows] + shift), angles, was.scale[rows])
