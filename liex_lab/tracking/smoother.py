"""The curve itself: poses between and beside the measured ones, by a smoother on the manifold, with their spread."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from liex_lab.body.pose import Pose
from liex_lab.body.skeleton import Skeleton
from liex_lab.geometry import SE3
from liex_lab.tracking import _filter as kernels
from liex_lab.tracking.observations import joints_of

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Motion:
    """How an animal moves and how single frames err; lengths over the animal's, errors over the predicted one.

    middle_error, turn_error: standard deviation along one axis of the joints' middle, and of rotations times the
    animal's length, over the predicted mean joint error; middle_jerk (lengths^2/s^3) and turn_jerk (rad^2/s^3):
    densities of the accelerations; scale_rate (1/s^3) of the logarithm of the size; freedom of the t distribution of
    errors; reject: off by more than this many predicted errors is not measured at all; lasting: the share of an error
    that neighbouring frames have in common and no smoother takes away.
    """

    middle_error: float = 0.7
    turn_error: float = 2.4
    middle_jerk: float = 10.0
    turn_jerk: float = 60.0
    scale_jerk: float = 1.0
    freedom: float = 6.0
    reject: float = 4.0
    lasting: float = 0.7


MOTION = Motion()
_PASSES = 3


@dataclass(frozen=True)
class Curve:
    """A smoothed curve of n frames.

    pose (n), arena frame; joints (n, J, 3) mm; error_mm (n,): expected mean joint error; sd_middle_mm and sd_turn (n,):
    along one axis, of the joints' middle and of rotations; used (n,): frames whose measurement it goes by.
    """

    pose: Pose
    joints: Array
    error_mm: Array
    sd_middle_mm: Array
    sd_turn: Array
    used: NDArray[np.bool_]

    def __getitem__(self, rows: slice) -> Curve:
        """Some consecutive frames."""
        return Curve(self.pose[rows], *(getattr(self, name)[rows] for name in _ROWS))

    @staticmethod
    def join(parts: Sequence[Curve]) -> Curve:
        """Consecutive parts as one."""
        poses = [part.pose for part in parts]
        turns, places = [p.root.rotation for p in poses], [p.root.translation for p in poses]
        root = SE3(np.concatenate(turns), np.concatenate(places))
        pose = Pose(root, np.concatenate([p.angles for p in poses]), np.concatenate([p.scale for p in poses]))
        return Curve(pose, *(np.concatenate([getattr(part, name) for part in parts]) for name in _ROWS))

    @staticmethod
    def unknown(n: int, n_joints: int) -> Curve:
        """A curve of frames in which nothing was measured."""
        nan = np.full((n, n_joints, 3, 3), np.nan)
        pose = Pose(SE3(nan[:, 0], nan[:, 0, 0]), nan[..., 0], nan[:, 0, 0, 0])
        none = nan[:, 0, 0, 0]
        return Curve(pose, nan[..., 0], none, none, none, np.zeros(n, np.bool_))


_ROWS = ("joints", "error_mm", "sd_middle_mm", "sd_turn", "used")


def smooth(
    skeleton: Skeleton, seconds: Array, pose: Pose, error_mm: Array, length_mm: float, motion: Motion = MOTION
) -> Curve:  # fmt: skip
    """The curve through measured poses (n), NaN where none is, with predicted errors error_mm (n,) at times (n,) s.

    Errors have heavy tails: measurements far off the curve weigh less (iterated weights of a t distribution) and those
    very far off nothing. Before the first measurement the curve stands still.
    """
    known = np.isfinite(pose.scale) & np.isfinite(error_mm)
    if not known.any():
        return Curve.unknown(len(seconds), skeleton.n_joints)
    joints = joints_of(skeleton, pose)
    weight, used = np.ones(len(seconds)), known.copy()
    curve = _run(skeleton, seconds, pose, joints, error_mm, length_mm, motion, weight, used)
    for _ in range(_PASSES):
        off = np.linalg.norm(joints - curve.joints, axis=-1).mean(axis=1) / error_mm
        weight = np.where(known, (motion.freedom + 1.0) / (motion.freedom + np.nan_to_num(off) ** 2), 1.0)
        used = known & ~(off > motion.reject)
        if not used.any():
            used = known
        curve = _run(skeleton, seconds, pose, joints, error_mm, length_mm, motion, weight, used)
    return curve


def _run(
    skeleton: Skeleton, seconds: Array, pose: Pose, joints: Array, error_mm: Array, length_mm: float, motion: Motion,
    weight: Array, used: NDArray[np.bool_],
) -> Curve:  # fmt: skip
    """One pass of the smoother, with each measurement's variance divided by its weight."""
    n = len(seconds)
    start = int(np.argmax(used))
    variance = np.where(used, error_mm**2 / weight, np.inf)
    fast = 1.0 - motion.lasting**2
    middle = _Group(seconds, motion.middle_error**2 * fast * variance, motion.middle_jerk * length_mm**2, start)
    turn = _Group(seconds, (motion.turn_error / length_mm) ** 2 * fast * variance, motion.turn_jerk, start)
    size = _Group(seconds, (motion.turn_error / length_mm) ** 2 * fast * variance, motion.scale_jerk, start)
    centre, _ = middle.vectors(joints.mean(axis=1), used)
    rotation = turn.rotations(pose.root.rotation, used)
    angles, _ = turn.vectors(pose.angles.reshape(n, -1), used)
    scale = np.exp(size.vectors(np.log(pose.scale)[:, None], used)[0][:, 0])
    made = Pose(SE3(rotation, np.zeros((n, 3))), angles.reshape(pose.angles.shape), scale)
    made.root.translation[:] = centre - joints_of(skeleton, made).mean(axis=1)
    lasting = motion.lasting * np.interp(seconds, seconds[used], error_mm[used])
    relative = 0.5 * middle.variance / motion.middle_error**2
    relative += 0.5 * turn.variance * (length_mm / motion.turn_error) ** 2
    return Curve(
        made, joints_of(skeleton, made), np.sqrt(lasting**2 + relative),
        np.sqrt(middle.variance + (motion.middle_error * lasting) ** 2),
        np.sqrt(turn.variance + (motion.turn_error * lasting / length_mm) ** 2), used,
    )  # fmt: skip


class _Group:
    """Coordinates that share their gains; see `_filter`."""

    def __init__(self, seconds: Array, r: Array, q: float, start: int) -> None:
        n = len(seconds)
        self._times, self._start = seconds, start
        self._forward, self._back = np.zeros((n, 2)), np.zeros((n, 2, 2))
        filtered, predicted, smoothed = np.zeros((3, n, 2, 2))
        kernels.gains(seconds, r, q, start, self._forward, self._back, filtered, predicted, smoothed)
        smoothed[:start] = smoothed[start]
        self.variance = smoothed[:, 0, 0]

    def vectors(self, y: Array, used: NDArray[np.bool_]) -> tuple[Array, Array]:
        """Smoothed vectors (n, m) and their rates."""
        ahead, out, rate = np.zeros((3, *y.shape))
        args = self._times, y, used, self._start, self._forward, self._back, ahead, out, rate
        kernels.run_vectors(*args)
        out[: self._start], rate[: self._start] = out[self._start], 0.0
        return out, rate

    def rotations(self, y: Array, used: NDArray[np.bool_]) -> Array:
        """Smoothed rotations (n, 3, 3)."""
        ahead, out, rate = np.zeros(y.shape), np.zeros(y.shape), np.zeros((len(y), 3))
        args = self._times, y, used, self._start, self._forward, self._back, ahead, out, rate
        kernels.run_rotations(*args)
        out[: self._start] = out[self._start]
        return out
