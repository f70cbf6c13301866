"""Robust smoothing of poses on SE(3) x R^d: Kalman filter and RTS smoother with Student-t weights.

Every coordinate (the joints' mean, mm; the base's rotation on SO(3); joint angles; log scale) is an
integrated Ornstein-Uhlenbeck process: dx = v dt, dv = -v / τ dt + sqrt(q) dW (Johnson et al. 2008).
Measurement errors follow a t distribution of ν degrees of freedom, fitted by iteratively reweighted
smoothing: w = (ν + 1) / (ν + δ^2) with δ the distance from the curve over the predicted error, and
a gate beyond which a measurement is excluded. A share c^2 of the error variance is correlated over
neighbouring frames: smoothing cannot reduce it, so it is excluded from the filter and added to the
posterior. Calibration factors then scale the posterior spread to the errors observed on rendered
sequences. The kernels are in `_smoother_kernels`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from liex_lab.body.kinematics import KinematicTree
from liex_lab.body.pose import Pose
from liex_lab.body.skeleton import Skeleton
from liex_lab.geometry import SE3
from liex_lab.runtime.shapes import check_shapes
from liex_lab.tracking import _smoother_kernels as kernels
from liex_lab.tracking.observations import joints_of

Array = NDArray[np.float64]
_PASSES = 4


@dataclass(frozen=True)
class OrnsteinUhlenbeck:
    """Integrated Ornstein-Uhlenbeck and measurement-error parameters of one coordinate.

    Attributes:
        error: standard deviation of a measurement (rad, or of the log scale) times the animal's
            length over the predicted mean joint error.
        process_variance: process variance q, the density of the white noise that drives the
            velocity, rad^2/s^3 (1/s^3 of the log scale).
        decay_s: decay time τ of the velocity, s.
    """

    error: float
    process_variance: float
    decay_s: float


@dataclass(frozen=True)
class Motion:
    """Motion and error parameters of an animal; errors are over the predicted mean joint error.

    Attributes:
        position_error: standard deviation of the joints' mean along the animal, sideways and up.
        position_variance: process variance of the mean horizontally and up, lengths^2/s^3.
        position_decay_s: decay time of the mean's velocity, s.
        turn: the base's rotation about its own x, y and z axis.
        bend: the other joints' angles about their own x, y and z axis.
        size: the logarithm of the bones' scale.
        degrees_of_freedom: degrees of freedom of the t distribution of errors.
        gate: distance from the curve beyond which a measurement is excluded, predicted errors.
        correlated_share: share of an error that is common to neighbouring frames and cannot be
            smoothed away.
        calibration: calibration factors of the error, pairs (error over length, factor) in rising
            order, interpolated in the logarithm of the error: the ratio of observed to posterior
            error, without the effect of a wrong size.
        stretch: coefficients of the relative error of distances from the base (see `Subject`): for
            the residual between body and depth over the length, and for the standard deviation of
            the logarithm of the sizes estimated from single frames.
        usual_stretch: that relative error in a session for which neither is available.
        unseen_height: standard deviation, over the length, of the height of all joints together: a
            camera observes the animal's back, and the depth of the midline below it depends on the
            animal's build.
        unseen_shift: the same for the position of the joints along the body.
        root_calibration: remaining calibration factors of the root's rotation about (3) and
            position along (3) its own axes.
        bend_calibration: likewise, of the other joints' angles about their x, y and z axis.
        joint_calibration: factors of the joints' standard deviations along each axis, one per
            joint; () leaves them unchanged.
    """

    position_error: tuple[float, float, float]
    position_variance: tuple[float, float]
    position_decay_s: float
    turn: tuple[OrnsteinUhlenbeck, OrnsteinUhlenbeck, OrnsteinUhlenbeck]
    bend: tuple[OrnsteinUhlenbeck, OrnsteinUhlenbeck, OrnsteinUhlenbeck]
    size: OrnsteinUhlenbeck
    degrees_of_freedom: float
    gate: float
    correlated_share: float
    calibration: tuple[tuple[float, float], ...]
    stretch: tuple[float, float] = (0.0, 0.0)
    usual_stretch: float = 0.0
    unseen_height: float = 0.0
    unseen_shift: float = 0.0
    root_calibration: tuple[float, float, float, float, float, float] = (1.0,) * 6
    bend_calibration: tuple[float, float, float] = (1.0,) * 3
    joint_calibration: tuple[float, ...] = ()

    def stretch_sd(self, blur: float, size_spread: float) -> float:
        """Standard deviation of the relative error of an animal's lengths, see `Subject`.

        Args:
            blur: usual residual of its body over its length.
            size_spread: standard deviation of the logarithm of single-frame size estimates.
        """
        per_blur, per_spread = self.stretch
        return float(np.hypot(per_blur * blur, per_spread * size_spread))

    @property
    def packed(self) -> kernels.Moves:
        """The parameters as arrays for the numba kernels; position variance as (3,) x, y, z."""

        def rows(*moves: OrnsteinUhlenbeck) -> Array:
            """One row (error, process variance, decay time) per coordinate, (k, 3)."""
            return np.array([[m.error, m.process_variance, m.decay_s] for m in moves])

        level, up = self.position_variance
        return kernels.Moves(
            np.array(self.position_error),
            np.array([level, level, up]),
            self.position_decay_s,
            rows(*self.turn),
            rows(*self.bend),
            rows(self.size)[0],
            self.degrees_of_freedom,
            self.gate,
            self.correlated_share,
        )


@dataclass(frozen=True)
class Curve:
    """A smoothed curve of n frames, arena frame, with its posterior spread.

    Attributes:
        pose: (n) smoothed poses.
        joints: (n, J, 3) mm.
        error_mm: (n,) expected mean joint error, mm.
        cov_middle_mm2: (n, 3, 3) covariance of the joints' mean along the arena's axes, mm^2.
        sd_turn: (n, 3) standard deviation of the base's rotation about its own axes, rad.
        sd_bend: (n, 3) standard deviation of the other joints' angles about their axes, rad.
        used: (n,) frames whose measurement was used.
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
        """A curve without measurements: all NaN, none used."""
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
    """Smooth measured poses, and estimate the posterior spread.

    Errors have heavy tails: measurements far off the curve are down-weighted (iterated weights of a
    t distribution), and very distant ones are excluded. Before the first measurement the curve is
    constant.

    Args:
        skeleton: kinematic tree of the animal.
        seconds: (n,) s, increasing.
        pose: (n) measured poses, arena frame, NaN if absent.
        error_mm: (n,) predicted mean joint error of each, mm; NaN also counts as not measured.
        length_mm: spine length of the animal, mm.
        motion: motion and error parameters of the animal.

    Returns:
        A curve of n frames; all NaN if there are no measurements.
    """
    n = len(seconds)
    check_shapes(
        "a track",
        ("rotations", pose.root.rotation, (n, 3, 3)),
        ("angles", pose.angles, (n, skeleton.n_joints, 3)),
        ("scales", pose.scale, (n,)),
        ("error_mm", error_mm, (n,)),
    )
    known = np.isfinite(pose.scale) & np.isfinite(error_mm)
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
    smoother = _Smoother(seconds, seen, error_mm, known, KinematicTree.of(skeleton), motion.packed)
    used = smoother.smooth(float(length_mm), made, spread)
    return _curve(seconds, error_mm, length_mm, motion, made, spread, used)


@dataclass(frozen=True)
class _Smoother:
    """Measured poses of n frames, at least one of them measured, and their errors.

    Attributes:
        seconds: (n,) s.
        seen: the measured poses, arena frame.
        error: (n,) predicted mean joint error, mm.
        known: (n,) measured.
        body: kinematic tree of the skeleton.
        moves: motion and error parameters.
    """

    seconds: Array
    seen: kernels.Poses
    error: Array
    known: NDArray[np.bool_]
    body: KinematicTree
    moves: kernels.Moves

    def smooth(
        self, length: float, made: kernels.Poses, spread: kernels.Spread
    ) -> NDArray[np.bool_]:
        """Fill `made` with the smoothed curve, and `spread` without the correlated share.

        If the gate excludes all frames, every measured one is used again.

        Args:
            length: spine length of the animal, mm.
            made: output.
            spread: output.

        Returns:
            (n,) the frames used.
        """
        n = len(self.error)
        middle, frame, weight = np.empty((n, 3)), np.empty((n, 3, 3)), np.ones(n)
        used = self.known.copy()
        kernels.middles(self.seen.joints, self.known, self.body.tip, middle, frame)
        for again in range(_PASSES):
            if again and not kernels.weigh(
                self.seen.joints,
                made.joints,
                self.error,
                self.known,
                self.moves.degrees_of_freedom,
                self.moves.gate,
                weight,
                used,
            ):
                used[:] = self.known
            self._pass(middle, frame, weight, length, made, spread, used)
        return used

    def _pass(
        self,
        middle: Array,
        frame: Array,
        weight: Array,
        length: float,
        made: kernels.Poses,
        spread: kernels.Spread,
        used: NDArray[np.bool_],
    ) -> None:
        """One filter and smoother pass, each measurement's variance divided by its weight."""
        moves, seen, n = self.moves, self.seen, len(used)
        start = int(used.argmax())
        variance, r = np.full(n, np.inf), np.zeros((n, 3, 3))
        kernels.measured_spread(
            frame,
            self.error,
            weight,
            used,
            moves.position_error,
            moves.correlated_share,
            variance,
            r,
        )
        out = np.empty((n, 3))
        kernels.smooth_positions(
            self.seconds,
            middle,
            r,
            used,
            start,
            moves.position_variance * (length * length),
            moves.position_decay_s,
            out,
            spread.middle,
        )
        gain, covariances = kernels.Gains.blank(n), kernels.Covariances.blank(n)
        later = np.maximum(np.arange(n), start)

        def fill(a: int, group: Array, left: Array | None = None) -> kernels.Gains:
            """The gains of an axis with these parameters; its posterior variance goes to `left`."""
            relative, axis = group[0] / length, gain.axis(a)
            measured = relative * relative * variance
            kernels.gains(self.seconds, measured, group[1], group[2], start, axis, covariances)
            if left is not None:
                left[:] = covariances.smoothed[later, 0, 0]
            return axis

        for a in range(3):
            fill(a, moves.turn[a], spread.turn[:, a])
        kernels.smooth_rotations(seen.rotation, used, start, gain, made.rotation, np.zeros((n, 3)))
        bend = [fill(a, moves.bend[a], spread.bend[:, a]) for a in range(3)]
        value, rate = np.zeros(n), np.zeros(n)
        for j, a in self.body.free:
            kernels.smooth_values(seen.angles[:, j, a].copy(), used, start, bend[a], value, rate)
            made.angles[:, j, a] = value
        size = fill(0, moves.size)
        kernels.smooth_values(seen.log_scale, used, start, size, made.log_scale, rate)
        kernels.place_middles(self.body, out, made)


def _curve(
    seconds: Array,
    error_mm: Array,
    length_mm: float,
    motion: Motion,
    made: kernels.Poses,
    spread: kernels.Spread,
    used: NDArray[np.bool_],
) -> Curve:
    """The kernels' output as a `Curve`: posterior and correlated share, calibrated."""
    correlated_share = motion.correlated_share * np.interp(seconds, seconds[used], error_mm[used])
    middle = np.trace(spread.middle, axis1=1, axis2=2)
    place = np.array(motion.position_error)
    moves = motion.packed
    # parts of the predicted error due to the joints' mean and to the bends
    relative = 0.5 * middle / (place**2).sum()
    relative += 0.5 * (spread.bend / moves.bend[:, 0] ** 2).mean(axis=1) * length_mm**2
    cov_middle = (
        spread.middle + (place**2).mean() * np.eye(3) * correlated_share[:, None, None] ** 2
    )
    turn, bend = (
        np.sqrt(left + (group[:, 0] * correlated_share[:, None] / length_mm) ** 2)
        for left, group in ((spread.turn, moves.turn), (spread.bend, moves.bend))
    )
    pose = Pose(SE3(made.rotation, made.place), made.angles, np.exp(made.log_scale))
    error = np.sqrt(correlated_share**2 + relative)
    calibration = np.interp(
        np.log(error / length_mm),
        *np.array([(np.log(said), factor) for said, factor in motion.calibration]).T,
    )
    each = calibration[:, None]
    cov_middle *= each[:, None] ** 2
    return Curve(pose, made.joints, calibration * error, cov_middle, each * turn, each * bend, used)
