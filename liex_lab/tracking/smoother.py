"""Robust smoothing of poses on SE(3) x R^d: Kalman filter and RTS smoother with Student-t weights.

Every coordinate (the joints' mean, mm; the base's rotation on SO(3); joint angles; log scale) is an
integrated Ornstein-Uhlenbeck process: dx = v dt, dv = -v / τ dt + sqrt(q) dW (Johnson et al. 2008).
Measurement errors follow a t distribution of ν degrees of freedom, fitted by iteratively reweighted
smoothing: w = (ν + 1) / (ν + δ^2) with δ the distance from the curve over the predicted error, and
a gate beyond which a measurement is excluded. A share c^2 of the error variance is correlated over
neighbouring frames: smoothing cannot reduce it, so it is excluded from the filter and added to the
posterior. Calibration factors then scale the posterior spread to the errors observed on rendered
sequences. The kernels are in `_smoother_kernels`.

The smoother also moves the frames around corrected poses (`let_follow`), which are measurements to
it: conditioning of a Gaussian process (Rauch, Tung and Striebel 1965). It is affine in its
measurements, and an additional measurement that agrees with the curve changes nothing. So a pose
placed off the curve by δ at frame k moves the curve by the smoother's response to the measurements

  y_k = δ  with (almost) no error,    y_t = 0  with the error of frame t elsewhere,

coordinate by coordinate: the joints' mean (mm), the base's rotation log(R^T R') and the joints'
angles (rad). Frames that differ from the correction by more than their predicted errors weigh less,
with the same weights in four passes, and the curve stays smooth. A frame follows only until one of
its joints reaches the floor.

Motion and association parameters of each animal are stored in `tunings.toml` next to this module:
how it moves (integrated Ornstein-Uhlenbeck processes), how single frames err, and the costs of a
chain of hypotheses. `liex train tracking` fits them on rendered sequences whose seeds are not those
of any test.
"""

from __future__ import annotations

import tomllib
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter

from liex_lab.body.pose import KinematicTree, Pose
from liex_lab.body.skeleton import Skeleton
from liex_lab.geometry import SE3, so3
from liex_lab.runtime import memory
from liex_lab.tracking import _smoother_kernels as kernels
from liex_lab.tracking.observations import Array, joints_of
from liex_lab.tracking.track import Track

TUNINGS = Path(__file__).with_name("tunings.toml")
# fields of `MotionParameters` with another name in the file, kept for compatibility
_STORED_AS = {
    "position_error": "place_error",
    "position_variance": "place_drive",
    "position_decay_s": "place_fade",
    "degrees_of_freedom": "freedom",
    "gate": "reject",
    "correlated_share": "lasting",
    "calibration": "honest",
    "root_calibration": "honest_root",
    "bend_calibration": "honest_bend",
    "joint_calibration": "honest_joints",
}
_USUAL = "mouse"  # used for animals without parameters of their own


@dataclass(frozen=True)
class AssociationCosts:
    """Costs of a chain of hypotheses, nats; lengths are those of an animal of the reference length.

    Attributes:
        score_mm: the score of the learned metric, mm, that costs one nat.
        score_most: the largest cost of a score, nats.
        none: missed-detection cost, for skipping a frame.
        ceiling: the largest cost of a transition.
        error_factor: standard deviation of a measurement over its predicted error.
        shift: random speed of the middle, lengths a second (standard deviation).
        bend: random change of the posture about the middle, lengths a second.
        tail: above this many nats, a transition cost grows logarithmically.
    """

    score_mm: float
    score_most: float
    none: float
    ceiling: float
    error_factor: float
    shift: float
    bend: float
    tail: float


class OrnsteinUhlenbeck(NamedTuple):
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
class MotionParameters:
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
        unseen_height: standard deviation, over the length, of the height of each joint, or one for
            all: a camera observes the animal's back, and the depth of the midline below it depends
            on the animal's build.
        unseen_shift: the same for the position of the joints along the body.
        root_calibration: remaining calibration factors of the root's rotation about (3) and
            position along (3) its own axes.
        bend_calibration: likewise, of the other joints' angles about their x, y and z axis.
        joint_calibration: factors of the joints' standard deviations along each axis, one per
            joint; () leaves them unchanged.
        expected_share: share of the stretch and of the unseen part in the predicted error. Their
            spreads are those of the family of bodies with the largest errors.
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
    unseen_height: tuple[float, ...] = (0.0,)
    unseen_shift: float = 0.0
    root_calibration: tuple[float, float, float, float, float, float] = (1.0,) * 6
    bend_calibration: tuple[float, float, float] = (1.0,) * 3
    joint_calibration: tuple[float, ...] = ()
    expected_share: float = 1.0

    def stretch_sd(self, blur: float, size_spread: float) -> float:
        """Standard deviation of the relative error of an animal's lengths, see `Subject`.

        Args:
            blur: usual residual of its body over its length.
            size_spread: standard deviation of the logarithm of single-frame size estimates.
        """
        per_blur, per_spread = self.stretch
        return float(np.hypot(per_blur * blur, per_spread * size_spread))

    def angle_sd(self, error_mm: Array, length_mm: float) -> list[Array]:
        """Standard deviations (n, 3) of the base's rotation and of the other joints' angles, rad.

        Args:
            error_mm: (n,) predicted mean joint errors, mm.
            length_mm: spine length of the animal, mm.
        """
        return [
            np.array([move.error for move in moves]) * error_mm[:, None] / length_mm
            for moves in (self.turn, self.bend)
        ]


@dataclass(frozen=True)
class TrackingParameters:
    """The parameters of one animal.

    Attributes:
        chain: costs of the association by Viterbi.
        motion: motion and error parameters of the smoother.
    """

    chain: AssociationCosts
    motion: MotionParameters

    @staticmethod
    @cache
    def of(name: str) -> TrackingParameters:
        """The parameters of an animal, or the mouse's if it has none of its own.

        Args:
            name: name of the skeleton, such as 'fish'.

        Returns:
            The parameters, cached by name.
        """
        known = tomllib.loads(TUNINGS.read_text(encoding="utf-8"))
        if name in known:
            return TrackingParameters.from_table(known[name])
        usual = TrackingParameters.from_table(known[_USUAL])
        # the joints differ
        height = (float(np.mean(usual.motion.unseen_height)),)
        return replace(
            usual, motion=replace(usual.motion, joint_calibration=(), unseen_height=height)
        )

    @staticmethod
    def from_table(table: dict[str, Any]) -> TrackingParameters:
        """The parameters from their TOML table.

        Args:
            table: the tables `chain` and `motion` as read by `tomllib`; the three numbers of a
                coordinate are error, drive (process variance) and fade (decay time).
        """
        field_of = {stored: name for name, stored in _STORED_AS.items()}
        motion = {field_of.get(key, key): value for key, value in table["motion"].items()}
        return TypeAdapter(TrackingParameters).validate_python(
            {"chain": table["chain"], "motion": motion}
        )

    def to_toml(self, name: str) -> str:
        """The parameters as TOML tables, numbers to four significant digits.

        Args:
            name: the animal, as the tables' prefix.

        Returns:
            The text of `[name.chain]` and `[name.motion]`.
        """
        chain = (f"{key} = {_text(value)}" for key, value in vars(self.chain).items())
        motion = (
            f"{_STORED_AS.get(key, key)} = {_text(value)}"
            for key, value in vars(self.motion).items()
        )
        return "\n".join([f"[{name}.chain]", *chain, "", f"[{name}.motion]", *motion, ""])


def tunings_with(name: str, tuning: TrackingParameters) -> str:
    """The text of `tunings.toml` with an animal's tables added or replaced.

    Args:
        name: name of the animal's skeleton.
        tuning: its parameters.

    Returns:
        The whole file, including its leading comment.
    """
    text = TUNINGS.read_text(encoding="utf-8")
    head = text[: text.index("\n[")]
    known = {
        animal: TrackingParameters.from_table(table)
        for animal, table in tomllib.loads(text).items()
    } | {name: tuning}
    return "\n".join(
        [head.rstrip("\n") + "\n", *(each.to_toml(animal) for animal, each in known.items())]
    )


def _text(value: Any) -> str:
    """A number, or lists of them, in TOML."""
    return (
        f"[{', '.join(map(_text, value))}]"
        if isinstance(value, list | tuple)
        else repr(float(f"{value:.4g}"))
    )


Rows = NDArray[np.int64]

_PASSES = 4


@dataclass(frozen=True)
class SmoothedCurve(memory.Rows):
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

    @staticmethod
    def unknown(n: int, n_joints: int) -> SmoothedCurve:
        """A curve without measurements: all NaN, none used."""
        nan = np.full((n, n_joints, 3, 3), np.nan)
        axes = nan[:, 0, 0]
        none = nan[:, 0, 0, 0]
        pose = Pose(SE3(nan[:, 0], axes), nan[..., 0], none)
        return SmoothedCurve(pose, nan[..., 0], none, nan[:, 0], axes, axes, np.zeros(n, np.bool_))


def smooth(
    skeleton: Skeleton,
    seconds: Array,
    pose: Pose,
    error_mm: Array,
    length_mm: float,
    motion: MotionParameters,
) -> SmoothedCurve:
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
    known = np.isfinite(pose.scale) & np.isfinite(error_mm)
    if not known.any():
        return SmoothedCurve.unknown(n, skeleton.n_joints)
    measured = kernels.TrackPoses(
        pose.root.rotation,
        pose.root.translation,
        pose.angles,
        np.log(pose.scale),
        joints_of(skeleton, pose),
    )
    made = kernels.TrackPoses(*(np.zeros(values.shape) for values in measured))
    spread = kernels.Spread(np.zeros((n, 3, 3)), np.zeros((n, 3)), np.zeros((n, 3)))
    body = KinematicTree.of(skeleton)
    middle, frame, weight = np.empty((n, 3)), np.empty((n, 3, 3)), np.ones(n)
    used = known.copy()
    kernels.middles(measured.joints, known, body.tip, middle, frame)
    for again in range(_PASSES):
        if again and not kernels.weigh(
            measured.joints,
            made.joints,
            error_mm,
            known,
            motion.degrees_of_freedom,
            motion.gate,
            weight,
            used,
        ):
            used[:] = known  # the gate excluded all frames
        variance, r = np.full(n, np.inf), np.zeros((n, 3, 3))
        kernels.measured_spread(
            frame,
            error_mm,
            weight,
            used,
            np.array(motion.position_error),
            motion.correlated_share,
            variance,
            r,
        )
        _smooth_once(
            seconds,
            measured,
            used,
            middle,
            r,
            variance,
            float(length_mm),
            body,
            motion,
            made,
            spread,
        )
    return _curve(seconds, error_mm, length_mm, motion, made, spread, used)


def _smooth_once(
    seconds: Array,
    measured: kernels.TrackPoses,
    used: NDArray[np.bool_],
    middle: Array,
    r: Array,
    variance: Array,
    length: float,
    body: KinematicTree,
    motion: MotionParameters,
    made: kernels.TrackPoses,
    spread: kernels.Spread,
) -> None:
    """One filter and smoother pass: fills `made`, and `spread` without the correlated share.

    The measurements that are used have variances (n,), and their middles (n, 3) covariances r (n,
    3, 3).
    """
    n = len(used)
    start = int(used.argmax())
    out = np.empty((n, 3))
    level, up = motion.position_variance
    kernels.smooth_positions(
        seconds,
        middle,
        r,
        used,
        start,
        np.array([level, level, up]) * (length * length),
        motion.position_decay_s,
        out,
        spread.middle,
    )
    gain, covariances = kernels.Gains.blank(n), kernels.Covariances.blank(n)
    later = np.maximum(np.arange(n), start)

    def fill(a: int, group: OrnsteinUhlenbeck, left: Array | None = None) -> kernels.Gains:
        """The gains of an axis with these parameters; its posterior variance goes to `left`."""
        relative, axis = group.error / length, gain.axis(a)
        r = relative * relative * variance
        kernels.gains(seconds, r, group.process_variance, group.decay_s, start, axis, covariances)
        if left is not None:
            left[:] = covariances.smoothed[later, 0, 0]
        return axis

    for a in range(3):
        fill(a, motion.turn[a], spread.turn[:, a])
    kernels.smooth_rotations(measured.rotation, used, start, gain, made.rotation, np.zeros((n, 3)))
    bend = [fill(a, motion.bend[a], spread.bend[:, a]) for a in range(3)]
    value, rate = np.zeros(n), np.zeros(n)
    for j, a in body.free:
        kernels.smooth_values(measured.angles[:, j, a].copy(), used, start, bend[a], value, rate)
        made.angles[:, j, a] = value
    kernels.smooth_values(
        measured.log_scale, used, start, fill(0, motion.size), made.log_scale, rate
    )
    kernels.place_middles(body, out, made)


def _curve(
    seconds: Array,
    error_mm: Array,
    length_mm: float,
    motion: MotionParameters,
    made: kernels.TrackPoses,
    spread: kernels.Spread,
    used: NDArray[np.bool_],
) -> SmoothedCurve:
    """The kernels' output as a `SmoothedCurve`: posterior and correlated share, calibrated."""
    correlated_mm = motion.correlated_share * np.interp(seconds, seconds[used], error_mm[used])
    middle = np.trace(spread.middle, axis1=1, axis2=2)
    place = np.array(motion.position_error)
    # parts of the predicted error due to the joints' mean and to the bends
    relative = 0.5 * middle / (place**2).sum()
    bends = spread.bend / np.array([move.error for move in motion.bend]) ** 2
    relative += 0.5 * bends.mean(axis=1) * length_mm**2
    cov_middle = spread.middle + (place**2).mean() * np.eye(3) * correlated_mm[:, None, None] ** 2
    turn, bend = (
        np.sqrt(left + sd**2)
        for left, sd in zip(
            (spread.turn, spread.bend), motion.angle_sd(correlated_mm, length_mm), strict=True
        )
    )
    pose = Pose(SE3(made.rotation, made.place), made.angles, np.exp(made.log_scale))
    error = np.sqrt(correlated_mm**2 + relative)
    stated, factor = np.array(motion.calibration).T
    calibration = np.interp(np.log(error / length_mm), np.log(stated), factor)
    each = calibration[:, None]
    cov_middle *= each[:, None] ** 2
    return SmoothedCurve(
        pose, made.joints, calibration * error, cov_middle, each * turn, each * bend, used
    )


# Frames around corrected poses follow them.


_REACH = 160  # frames on either side that may move
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
    # differences between current and previous poses (n, 6 + 3 J): mean, rotation, angles
    middle = (track.joints_mm[rows] - joints_were).mean(axis=1)
    turn = so3.log(np.swapaxes(was.root.rotation[rows], 1, 2) @ track.root_rotation[rows])
    bend = track.angles_rad[rows] - was.angles[rows]
    off = np.hstack([middle, turn, bend.reshape(len(rows), -1)])
    off[~placed] = 0.0
    error = np.nan_to_num(track.predicted_error_mm[rows], nan=np.inf)
    error = np.maximum(error, _LEAST_ERROR * length)
    error[track.bridged[rows] & ~placed] = np.inf
    error[placed] = 1e-3 * _LEAST_ERROR * length
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
    for _ in range(10):  # bisection
        joints = _moved(track, was, rows, share * moved).joints(skeleton)
        above = (joints[..., 2] >= lowest).all(axis=1, keepdims=True)
        low, high = np.where(above, share, low), np.where(above, high, share)
        share = 0.5 * (low + high)
    pose = _moved(track, was, rows, low * moved)
    # poses that would move less are unchanged
    far = np.linalg.norm(pose.joints(skeleton) - joints_were, axis=-1).max(axis=1) > 0.02
    chosen = np.flatnonzero(far & ~placed)
    track.put_pose(rows[chosen], pose[chosen])
    return rows[chosen]


def _smoothed(
    seconds: Array, off: Array, error: Array, length: float, motion: MotionParameters
) -> Array:
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
    made = np.zeros(off.shape, order="F")
    for group, (share, drive, decay_s) in enumerate(groups):
        gain = kernels.Gains.blank(n).axis(0)
        covariances = kernels.Covariances.blank(n)
        kernels.gains(seconds, share * variance, drive, decay_s, start, gain, covariances)
        for column in [group] if group < 6 else range(group, n_coordinates, 3):
            kernels.smooth_values(
                np.ascontiguousarray(off[:, column]),
                known,
                start,
                gain,
                made[:, column],
                np.zeros(n),
            )
    return made


def _moved(track: Track, was: Pose, rows: Rows, moved: Array) -> Pose:
    """The poses as they were, moved by middle, turn and angles (n, 6 + 3 J)."""
    skeleton = track.skeleton
    before = was[rows]
    angles = before.angles + moved[:, 6:].reshape(before.angles.shape)
    inside = np.clip(angles, skeleton.limits[..., 0], skeleton.limits[..., 1])
    angles = np.where(angles == before.angles, angles, inside)
    rotation = before.root.rotation @ so3.exp(moved[:, 3:6])
    pose = Pose(SE3(rotation, before.root.translation), angles, before.scale)
    middle = before.joints(skeleton).mean(axis=1) + moved[:, :3]
    shift = middle - pose.joints(skeleton).mean(axis=1)
    return replace(pose, root=SE3(rotation, before.root.translation + shift))
