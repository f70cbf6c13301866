"""Robust Kalman filter and RTS smoother of whole poses: Student-t errors by iterated reweighting.

Four passes of the smoother of `_kalman_kernels` over all coordinates at once. After each, a frame t
at the mean joint distance δ_t from the curve, in predicted errors, gets the weight w_t = (ν + 1) /
(ν + δ_t^2), by which its measurement variance is divided (EM for the t distribution, Lange et al.
1989), and is left out where δ_t is beyond the gate. Positions are those of the joints' middle, with
an error ellipsoid aligned with the animal; the root is put where the middle requires it. In the
code `degrees_of_freedom` is ν, `gate` the gate and `correlated_share` the correlated share, whose
square is left out of the variance.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from liex_lab.body._kernels import place_joints
from liex_lab.tracking._kalman_kernels import (
    axis_gains,
    blank_covariances,
    blank_gains,
    gains,
    smooth_positions,
    smooth_rotations,
    smooth_values,
)

_PASSES = 4


class Moves(NamedTuple):
    """A `Motion` for the kernels; rows are (error, process variance, decay time).

    Attributes:
        position_error: (3,) along the animal, to its side, up; over the predicted mean joint error.
        position_variance: (3,) process variance along the arena's axes, lengths^2/s^3.
        position_decay_s: decay time of the middle's velocity, s.
        turn: (3, 3) a row for each axis of the base's rotation.
        bend: (3, 3) a row for each axis of the joint angles.
        size: (3,) of the log scale.
        degrees_of_freedom: degrees of freedom ν of the errors' t distribution.
        gate: gate, predicted errors.
        correlated_share: correlated share of an error.
    """

    position_error: NDArray[np.float64]
    position_variance: NDArray[np.float64]
    position_decay_s: float
    turn: NDArray[np.float64]
    bend: NDArray[np.float64]
    size: NDArray[np.float64]
    degrees_of_freedom: float
    gate: float
    correlated_share: float


class Poses(NamedTuple):
    """Poses of n frames as arrays.

    Attributes:
        rotation: (n, 3, 3) of the root.
        place: (n, 3) position of the root, mm.
        angles: (n, J, 3) rad.
        log_scale: (n,) logarithm of the bones' scale.
        joints: (n, J, 3) mm.
    """

    rotation: NDArray[np.float64]
    place: NDArray[np.float64]
    angles: NDArray[np.float64]
    log_scale: NDArray[np.float64]
    joints: NDArray[np.float64]


class Spread(NamedTuple):
    """Posterior spread of n frames.

    Attributes:
        middle: (n, 3, 3) covariance of the joints' middle, mm^2.
        turn: (n, 3) variance of the base's rotation about its own axes, rad^2.
        bend: (n, 3) variance of the other joints' angles about theirs, rad^2.
    """

    middle: NDArray[np.float64]
    turn: NDArray[np.float64]
    bend: NDArray[np.float64]


@njit(cache=True)
def smooth_poses(times, seen, error, known, body, length, moves, made, spread, used):
    """Fill `made` and `spread` with the smoothed curve, and `used` with the frames that it goes by.

    Where the gate leaves no frame at all, every measured one is used again. At least one frame must
    be measured.

    Args:
        times: (n,) s.
        seen: measured poses of n frames, arena frame.
        error: (n,) predicted mean joint error, mm.
        known: (n,) bool, measured.
        body: `KinematicTree` of the skeleton.
        length: spine length of the animal, mm.
        moves: motion and error parameters.
        made: output, smoothed poses.
        spread: output, their posterior spread; without the correlated share.
        used: (n,) bool output, frames within the gate.
    """
    n = error.size
    n_joints = body.parents.size
    weight = np.ones(n)
    middle = np.empty((n, 3))
    frame = np.empty((n, 3, 3))
    for t in range(n):
        used[t] = known[t]
        for k in range(3):
            total = 0.0
            for j in range(n_joints):
                total += seen.joints[t, j, k]
            middle[t, k] = total / n_joints
        if known[t]:
            _own_frame(seen.joints[t, body.tip] - seen.joints[t, 0], frame[t])
    for again in range(_PASSES):
        if again:
            n_used = 0
            for t in range(n):
                if known[t]:
                    off = 0.0
                    for j in range(n_joints):
                        apart = 0.0
                        for k in range(3):
                            apart += (seen.joints[t, j, k] - made.joints[t, j, k]) ** 2
                        off += np.sqrt(apart) / n_joints
                    off /= error[t]
                    weight[t] = (moves.degrees_of_freedom + 1.0) / (
                        moves.degrees_of_freedom + off * off
                    )
                    used[t] = off <= moves.gate
                    n_used += used[t]
            if n_used == 0:
                used[:] = known
        _pass(times, seen, middle, frame, error, weight, body, length, moves, made, spread, used)


@njit(cache=True)
def _pass(times, seen, middle, frame, error, weight, body, length, moves, made, spread, used):
    """One filter and smoother pass, each measurement's variance divided by its weight."""
    n = error.size
    m = body.free.shape[0]
    start = 0
    while not used[start]:
        start += 1
    variance = np.full(n, np.inf)
    r = np.zeros((n, 3, 3))
    for t in range(n):
        if used[t]:
            variance[t] = (1.0 - moves.correlated_share**2) * error[t] ** 2 / weight[t]
            for i in range(3):
                for k in range(3):
                    for a in range(3):
                        r[t, i, k] += (
                            frame[t, i, a]
                            * frame[t, k, a]
                            * variance[t]
                            * moves.position_error[a] ** 2
                        )
    out = np.empty((n, 3))
    process_variance = moves.position_variance * length**2
    smooth_positions(
        times, middle, r, used, start, process_variance, moves.position_decay_s, out, spread.middle
    )
    gain = blank_gains(n)
    first = axis_gains(gain, 0)
    covariances = blank_covariances(n)
    rate = np.zeros(n)
    value = np.zeros(n)
    for a in range(3):
        of_axis = axis_gains(gain, a)
        left = spread.turn[:, a]
        _gains_of(times, variance, moves.turn[a], length, start, of_axis, covariances, left)
    smooth_rotations(seen.rotation, used, start, gain, made.rotation, np.zeros((n, 3)))
    for a in range(3):
        of_axis = axis_gains(gain, a)
        left = spread.bend[:, a]
        _gains_of(times, variance, moves.bend[a], length, start, of_axis, covariances, left)
    for i in range(m):
        j, a = body.free[i]
        measured = seen.angles[:, j, a].copy()
        smooth_values(measured, used, start, axis_gains(gain, a), value, rate)
        made.angles[:, j, a] = value
    _gains_of(times, variance, moves.size, length, start, first, covariances, rate)
    smooth_values(seen.log_scale, used, start, first, made.log_scale, rate)
    _place(body, out, made)


@njit(cache=True)
def _gains_of(times, variance, moves, length, start, gain, covariances, left):
    """The gains of a group with these `moves`, and its posterior variance (n,) into `left`."""
    measured = (moves[0] / length) ** 2 * variance
    gains(times, measured, moves[1], moves[2], start, gain, covariances)
    for t in range(times.size):
        left[t] = covariances.smoothed[max(t, start), 0, 0]


@njit(cache=True)
def _place(body, middle, made):
    """Put the poses where their joints' middles (n, 3) are."""
    n_joints = body.parents.size
    made.place[:] = 0.0
    place_joints(
        body,
        made.rotation,
        made.place,
        made.angles,
        np.exp(made.log_scale),
        made.joints,
    )
    for t in range(middle.shape[0]):
        for k in range(3):
            mean = 0.0
            for j in range(n_joints):
                mean += made.joints[t, j, k] / n_joints
            made.place[t, k] = middle[t, k] - mean
            for j in range(n_joints):
                made.joints[t, j, k] += made.place[t, k]


@njit(cache=True)
def _own_frame(along, out):
    """A frame (3, 3), as columns: along the animal, to its side, and as far up as that leaves."""
    length = np.sqrt(along[0] ** 2 + along[1] ** 2 + along[2] ** 2)
    a = along / max(length, 1e-9)
    side = np.array([-a[1], a[0], 0.0])
    level = np.sqrt(side[0] ** 2 + side[1] ** 2)
    if level < 1e-6:
        side[0] = 0.0
        side[1] = 1.0
        level = 1.0
        a[0], a[1], a[2] = 0.0, 0.0, 1.0 if a[2] >= 0 else -1.0
    side /= level
    out[:, 0] = a
    out[:, 1] = side
    out[0, 2] = a[1] * side[2] - a[2] * side[1]
    out[1, 2] = a[2] * side[0] - a[0] * side[2]
    out[2, 2] = a[0] * side[1] - a[1] * side[0]
