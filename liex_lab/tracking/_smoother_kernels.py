"""Robust Kalman filter and RTS smoother of whole poses: Student-t errors by iterated reweighting.

`smoother` makes four passes of the smoother of `_kalman_kernels` over all coordinates at once, and
these kernels do what lies between. After each pass a frame t at the mean joint distance δ_t from
the curve, in predicted errors, gets the weight w_t = (ν + 1) / (ν + δ_t^2), by which its
measurement variance is divided (EM for the t distribution, Lange et al. 1989), and is left out
where δ_t is beyond the gate. Positions are those of the joints' middle, with an error ellipsoid
aligned with the animal; the root is put where the middle requires it. In the code
`degrees_of_freedom` is ν, `gate` the gate and `correlated_share` the correlated share, whose square
is left out of the variance. A kernel that called all others would be compiled with each of them
once more, for half a minute.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from liex_lab.body._kernels import place_joints


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
def middles(joints, known, tip, middle, frame):
    """Fill the joints' middle of each frame, and the animal's own frame where it was measured.

    Args:
        joints: (n, J, 3) measured joints, mm.
        known: (n,) bool, measured.
        tip: the joint at the other end than the base.
        middle: (n, 3) output, mm.
        frame: (n, 3, 3) output, columns along the animal, to its side, and up.
    """
    n_joints = joints.shape[1]
    for t in range(known.size):
        for k in range(3):
            total = 0.0
            for j in range(n_joints):
                total += joints[t, j, k]
            middle[t, k] = total / n_joints
        if known[t]:
            _own_frame(joints[t, tip], joints[t, 0], frame[t])


@njit(cache=True)
def weigh(seen, made, error, known, degrees_of_freedom, gate, weight, used):
    """Fill the weights of measurements by their distances from the curve; returns how many count.

    Args:
        seen: (n, J, 3) measured joints, mm.
        made: (n, J, 3) joints of the curve, mm.
        error: (n,) predicted mean joint error, mm.
        known: (n,) bool, measured.
        degrees_of_freedom: of the errors' t distribution.
        gate: predicted errors beyond which a measurement does not count.
        weight: (n,) output where known.
        used: (n,) bool output where known, frames within the gate.
    """
    n_joints = seen.shape[1]
    n_used = 0
    for t in range(known.size):
        if known[t]:
            off = 0.0
            for j in range(n_joints):
                apart = 0.0
                for k in range(3):
                    apart += (seen[t, j, k] - made[t, j, k]) ** 2
                off += np.sqrt(apart) / n_joints
            off /= error[t]
            weight[t] = (degrees_of_freedom + 1.0) / (degrees_of_freedom + off * off)
            used[t] = off <= gate
            n_used += used[t]
    return n_used


@njit(cache=True)
def measured_spread(frame, error, weight, used, position_error, correlated_share, variance, r):
    """Fill the variance of each measurement, and the covariance of its joints' middle.

    Args:
        frame: (n, 3, 3) the animal's own frames.
        error: (n,) predicted mean joint error, mm.
        weight: (n,) by which the variance is divided.
        used: (n,) bool, frames within the gate.
        position_error: (3,) over the predicted error, along the animal, to its side, up.
        correlated_share: share of an error whose square is left out.
        variance: (n,) output where used, mm^2.
        r: (n, 3, 3) output, added to where used, mm^2.
    """
    for t in range(error.size):
        if used[t]:
            variance[t] = (1.0 - correlated_share**2) * error[t] ** 2 / weight[t]
            for i in range(3):
                for k in range(3):
                    for a in range(3):
                        r[t, i, k] += (
                            frame[t, i, a] * frame[t, k, a] * variance[t] * position_error[a] ** 2
                        )


@njit(cache=True)
def place_middles(body, middle, made):
    """Put the poses where their joints' middles are.

    Args:
        body: `KinematicTree` of the skeleton.
        middle: (n, 3) mm.
        made: `Poses` whose place and joints are filled.
    """
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
def _own_frame(tip, base, out):
    """A frame (3, 3), as columns: from base to tip (3,), to its side, and as far up as that
    leaves.
    """
    x = tip[0] - base[0]
    y = tip[1] - base[1]
    z = tip[2] - base[2]
    length = max(np.sqrt(x**2 + y**2 + z**2), 1e-9)
    x /= length
    y /= length
    z /= length
    side_x = -y
    side_y = x
    level = np.sqrt(side_x**2 + side_y**2)
    if level < 1e-6:
        side_x = 0.0
        side_y = 1.0
        level = 1.0
        x, y, z = 0.0, 0.0, 1.0 if z >= 0 else -1.0
    side_x /= level
    side_y /= level
    side_z = 0.0
    out[0, 0] = x
    out[1, 0] = y
    out[2, 0] = z
    out[0, 1] = side_x
    out[1, 1] = side_y
    out[2, 1] = side_z
    out[0, 2] = y * side_z - z * side_y
    out[1, 2] = z * side_x - x * side_z
    out[2, 2] = x * side_y - y * side_x
