"""The curve itself: poses between and beside the measured ones, by a smoother on the manifold, with
their spread.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from liex_lab.body.pose import Pose
from liex_lab.body.skeleton import Skeleton
from liex_lab.geometry import SE3
from liex_lab.tracking import _smoother_kernels as kernels
from liex_lab.tracking.observations import joints_of

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Wandering:
    """How one coordinate moves and how frames err in it.

    error: standard deviation times the animal's length over the predicted mean joint error; drive:
    density of the noise that drives the velocity, rad^2/s^3; fade: seconds within which a velocity
    dies away by itself.
    """

    error: float
    drive: float
    fade: float


@dataclass(frozen=True)
class Motion:
    """How an animal moves and how single frames err; errors are over the predicted mean joint
    error.

    place_error: of the joints' middle, along the animal, to its side, and up; place_drive
    (lengths^2/s^3): in the level and up; place_fade s. turn: of the base's rotation, about its own
    x, y and z axis; bend: of the other joints' angles about theirs; size: of the logarithm of the
    bones' scale. freedom of the t distribution of errors; reject: off by more than this many
    predicted errors is not measured at all; lasting: the share of an error that neighbouring frames
    have in common and no smoother takes away; honest: what is left of an error over what the filter
    says is left, at some of the latter over the animal's length (pairs, in rising order; between
    them by the logarithm), beside what a wrong size does: stretch is what the share by which
    distances from the base may be off (see `Subject`) grows with, how far the body lies from the
    depth seen, over its length, and the standard deviation of the logarithm of the size that frames
    tell; usual_stretch: that share of a session of which neither is known. honest_root,
    honest_bend: the same of the base's rotation and place about and along its own axes, and of the
    other joints' angles about theirs, over what that leaves.
    """

    place_error: tuple[float, float, float]
    place_drive: tuple[float, float]
    place_fade: float
    turn: tuple[Wandering, Wandering, Wandering]
    bend: tuple[Wandering, Wandering, Wandering]
    size: Wandering
    freedom: float
    reject: float
    lasting: float
    honest: tuple[tuple[float, float], ...]
    stretch: tuple[float, float] = (0.0, 0.0)
    usual_stretch: float = 0.0
    honest_root: tuple[float, float, float, float, float, float] = (1.0,) * 6
    honest_bend: tuple[float, float, float] = (1.0,) * 3

    @property
    def packed(self) -> kernels.Moves:
        """For the kernels."""

        def rows(*moves: Wandering) -> Array:
            return np.array([[m.error, m.drive, m.fade] for m in moves])

        level, up = self.place_drive
        return kernels.Moves(
            np.array(self.place_error),
            np.array([level, level, up]),
            self.place_fade,
            rows(*self.turn),
            rows(*self.bend),
            rows(self.size)[0],
            self.freedom,
            self.reject,
            self.lasting,
        )


@dataclass(frozen=True)
class Curve:
    """A smoothed curve of n frames.

    pose (n), arena frame; joints (n, J, 3) mm; error_mm (n,): expected mean joint error;
    cov_middle_mm2 (n, 3, 3): of the joints' middle along the arena's axes; sd_turn (n, 3) of the
    base's rotation about its own axes and sd_bend (n, 3) of the other joints' about theirs, rad;
    used (n,): frames whose measurement it goes by.
    """

    pose: Pose
    joints: Array
    error_mm: Array
    cov_middle_mm2: Array
    sd_turn: Array
    sd_bend: Array
    used: NDArray[np.bool_]

    def __getitem__(self, rows: slice) -> Curve:
        """Some consecutive frames."""
        return Curve(self.pose[rows], *(getattr(self, name)[rows] for name in _ROWS))

    @staticmethod
    def unknown(n: int, n_joints: int) -> Curve:
        """A curve of frames in which nothing was measured."""
        nan = np.full((n, n_joints, 3, 3), np.nan)
        axes = nan[:, 0, 0]
        none = nan[:, 0, 0, 0]
        pose = Pose(SE3(nan[:, 0], axes), nan[..., 0], none)
        return Curve(pose, nan[..., 0], none, nan[:, 0], axes, axes, np.zeros(n, np.bool_))


_ROWS = ("joints", "error_mm", "cov_middle_mm2", "sd_turn", "sd_bend", "used")


def smooth(
    skeleton: Skeleton,
    seconds: Array,
    pose: Pose,
    error_mm: Array,
    length_mm: float,
    motion: Motion,
) -> Curve:
    """The curve through measured poses (n), NaN where none is, with predicted errors error_mm (n,)
    at times (n,) s.

    Errors have heavy tails: measurements far off the curve weigh less (iterated weights of a t
    distribution) and those very far off nothing. Before the first measurement the curve stands
    still.
    """
    known = np.isfinite(pose.scale) & np.isfinite(error_mm)
    n = len(seconds)
    if not known.any():
        return Curve.unknown(n, skeleton.n_joints)
    seen = kernels.Poses(
        pose.root.rotation,
        pose.root.translation,
        pose.angles,
        np.log(pose.scale),
        joints_of(skeleton, pose),
    )
    made = kernels.Poses(*(np.zeros(values.shape) for values in seen))
    spread = kernels.Spread(np.zeros((n, 3, 3)), np.zeros((n, 3)), np.zeros((n, 3)))
    used = np.zeros(n, np.bool_)
    body = body_of(skeleton, length_mm)
    kernels.smooth_poses(seconds, seen, error_mm, known, body, motion.packed, made, spread, used)
    return _curve(seconds, error_mm, length_mm, motion, made, spread, used)


def body_of(skeleton: Skeleton, length_mm: float) -> kernels.Body:
    """A skeleton for the kernels."""
    free = np.argwhere(skeleton.axes)
    return kernels.Body(
        skeleton.parents,
        skeleton.offsets,
        skeleton.rest,
        np.asarray(skeleton.axes.any(axis=1)),
        free[free[:, 0] > 0],
        float(length_mm),
        skeleton.tip,
    )


def _curve(
    seconds: Array,
    error_mm: Array,
    length_mm: float,
    motion: Motion,
    made: kernels.Poses,
    spread: kernels.Spread,
    used: NDArray[np.bool_],
) -> Curve:
    """What the kernels made, and how far off it may be: what the filter leaves, and what lasts over
    many frames.
    """
    lasting = motion.lasting * np.interp(seconds, seconds[used], error_mm[used])
    middle = np.trace(spread.middle, axis1=1, axis2=2)
    place = np.array(motion.place_error)
    moves = motion.packed
    # of a frame's predicted error, what the middle's errors and what the bends' are of it
    relative = 0.5 * middle / (place**2).sum()
    relative += 0.5 * (spread.bend / moves.bend[:, 0] ** 2).mean(axis=1) * length_mm**2
    cov_middle = spread.middle + (place**2).mean() * np.eye(3) * lasting[:, None, None] ** 2
    turn, bend = (
        np.sqrt(left + (group[:, 0] * lasting[:, None] / length_mm) ** 2)
        for left, group in ((spread.turn, moves.turn), (spread.bend, moves.bend))
    )
    pose = Pose(SE3(made.rotation, made.place), made.angles, np.exp(made.log_scale))
    error = np.sqrt(lasting**2 + relative)
    honest = np.interp(
        np.log(error / length_mm),
        *np.array([(np.log(said), factor) for said, factor in motion.honest]).T,
    )
    each = honest[:, None]
    cov_middle *= each[:, None] ** 2
    return Curve(pose, made.joints, honest * error, cov_middle, each * turn, each * bend, used)
