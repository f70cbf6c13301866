"""Fit of the tracker's motion model and error calibration on rendered sequences with truth.

`liex train tracking` measures sequences of the kinds used for evaluation, with other seeds, once
frame by frame. These fits follow on the observations:

- Calibration factors of the joints (`calibration`) at three levels of the stated error, by
  bisection, together with the standard deviation of the body's stretch over a grid of two
  coefficients, so that nine errors in ten along the floor lie within the 90 % interval, over all
  families of bodies and in each of them.
- The same factors for the root's six coordinates and for the bend angles about three axes, and one
  for each joint.
- The unobservable part of a build: the spread of heights and of positions along the body
  (`unseen_height`, `unseen_shift`).
- The share of a build's part in the predicted error (`expected_share`), from unusual bodies.

The families are usual bodies on easy and on hard sequences, bodies of builds that no forest was
trained on, and foreign bodies, which another program renders (`simulation.foreign`). Each has the
same weight, however many frames it has: an animal in a laboratory is like none of them.

Everything starts from fixed seeds, so `tunings.toml` is byte-identical on every run.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from liex_lab.arrays import Array, NDArray
from liex_lab.body.pose import Pose
from liex_lab.body.skeleton import Skeleton
from liex_lab.estimation.estimator import PoseEstimator
from liex_lab.evaluation.scores import along_body
from liex_lab.geometry import SE3, so3
from liex_lab.plan import Plan
from liex_lab.runtime.progress import Progress, silent
from liex_lab.simulation import simulator
from liex_lab.simulation.foreign import KINDS, ForeignRecording
from liex_lab.simulation.recording import RenderedRecording
from liex_lab.tracking import curve, trust
from liex_lab.tracking.observations import Observations
from liex_lab.tracking.smoother import TrackingParameters, tunings_with
from liex_lab.tracking.track import Subject, Track
from liex_lab.tracking.tracker import FrameTracker

from ..build import build_scene, plan_of
from .pose_model import estimator_of, use_cores

Knots = tuple[tuple[float, float], ...]

BUILD_SEEDS = tuple(range(201, 230))  # of animals of other builds
FOREIGN_BODIES = tuple(range(100, 112))  # in no split
_Z90 = 1.645


@dataclass(frozen=True)
class Measured:
    """A measured rendered sequence: observations, subject and truth.

    Attributes:
        kind: its family of bodies: `easy`, `hard`, `other` or `foreign`.
        observations: hypotheses of all n frames, arena frame.
        subject: the animal and its camera.
        pose: (n) true poses, in the same arena frame; None of a foreign body.
        truth: (n, J, 3) true joints, mm, in the same arena frame; NaN where unknown.
        blur: median distance of body and depth over the body's length, see `FrameTracker`.
        size_spread: standard deviation of the log size estimated by frame, see `FrameTracker`.
    """

    kind: str
    observations: Observations
    subject: Subject
    pose: Pose | None
    truth: Array
    blur: float
    size_spread: float


def train_tracking(
    animal: str,
    out: Path,
    *,
    n_frames: int | None = None,
    seeds: Sequence[int] = (),
    workers: int = 0,
    progress: Progress = silent,
) -> Path:
    """Write `tunings.toml` with an animal's table fitted again; byte-identical on every run.

    Association and motion are those of the file; the calibration of errors is fitted again.

    Args:
        animal: a bundled animal's name, or the path of a skeleton's TOML.
        out: path of the file to write; the other animals' tables are copied unchanged.
        n_frames: frames of each sequence; None means its usual length.
        seeds: of the sequences, instead of the usual ones.
        workers: threads of the kernels; 0 means all.
        progress: called with the progress of the job.

    Returns:
        `out`.
    """
    use_cores(workers)
    measured = [
        measure(animal, kind, seed, n_frames, progress)
        for kind in ("easy", "hard")
        for seed in seeds or range(101, 109)
    ]
    builds = [
        *other_builds(animal, progress, seeds or BUILD_SEEDS),
        *foreign_bodies(animal, progress, seeds or FOREIGN_BODIES),
    ]
    families = [*measured, *builds]
    tuning = calibrate_joints(families, TrackingParameters.of(animal))
    tuning = calibrate_roots(measured, tuning)
    tuning = calibrate_builds(families, calibrate_each_joint(families, tuning))
    tuning = calibrate_expected(builds or measured, tuning)
    out.write_text(tunings_with(animal, tuning), encoding="utf-8")
    return out


def measure(
    animal: str, kind: str, seed: int, n_frames: int | None, progress: Progress = silent
) -> Measured:
    """Measure one rendered sequence frame by frame; background and size are estimated as in a run.

    Args:
        animal: a bundled animal's name, or the path of a skeleton's TOML.
        kind: `easy` or `hard`.
        seed: of the sequence.
        n_frames: its length; None means the usual one.
        progress: called frame by frame.

    Returns:
        Observations and truth in the estimated arena frame.
    """
    recording = simulator.tracking_sequence(
        simulator.world_of(Skeleton.load(animal)), kind, seed=seed, n_frames=n_frames
    )
    return _observed_all(animal, kind, [recording], progress)[0]


def other_builds(
    animal: str, progress: Progress = silent, seeds: Sequence[int] = BUILD_SEEDS
) -> list[Measured]:
    """Recordings of animals of builds that no forest was trained on, measured frame by frame.

    Args:
        animal: a bundled animal's name, or the path of a skeleton's TOML.
        progress: called frame by frame.
        seeds: of the recordings.

    Returns:
        One per seed; [] if the species is not calibrated on other builds.
    """
    world = simulator.world_of(Skeleton.load(animal))
    if not world.other_builds:
        return []
    recordings = [world.motion([seed], 120, family="other") for seed in seeds]
    return _observed_all(animal, "other", recordings, progress)


def foreign_bodies(
    animal: str, progress: Progress = silent, bodies: Sequence[int] = FOREIGN_BODIES
) -> list[Measured]:
    """Recordings of foreign bodies, measured frame by frame.

    Args:
        animal: a bundled animal's name, or the path of a skeleton's TOML.
        progress: called frame by frame.
        bodies: their numbers.

    Returns:
        One per body; [] if there are none of the animal.
    """
    if animal not in KINDS:
        return []
    recordings = [ForeignRecording(animal, body, body, 120) for body in bodies]
    return _observed_all(animal, "foreign", recordings, progress)


def _observed_all(
    animal: str,
    kind: str,
    recordings: Sequence[RenderedRecording | ForeignRecording],
    progress: Progress,
) -> list[Measured]:
    estimator, plan = estimator_of(animal, "default", progress), plan_of(animal)
    return [observed(estimator, plan, kind, one, progress) for one in recordings]


def observed(
    estimator: PoseEstimator,
    plan: Plan,
    kind: str,
    recording: RenderedRecording | ForeignRecording,
    progress: Progress = silent,
) -> Measured:
    """Measure a rendered recording frame by frame; background and size are estimated as in a run.

    Args:
        estimator: the animal's.
        plan: thresholds of the foreground, and expected sizes.
        kind: label of the recording, see `Measured`.
        recording: with its truth.
        progress: called frame by frame.

    Raises:
        EstimationError: no floor or no animal is found.
    """
    scene, sample = build_scene(
        recording, plan, estimator.skeleton, plan.foreground.n_background_frames
    )
    tracker = FrameTracker.prepare(estimator, scene, sample, bridge_s=plan.tracking.bridge_s)
    parts = []
    for frames in recording.chunks(32):
        progress(frames[0].index, len(recording), f"measuring {recording.name}")
        parts.append(tracker.observe(frames))
    T = scene.floor.T_arena_camera
    if isinstance(recording, RenderedRecording):
        pose = recording.pose.moved(T)
        truth = T @ recording.joints_camera
    else:
        pose = None
        skeleton = estimator.skeleton
        joints = recording.animal(skeleton.reach / skeleton.length).joints_camera
        depth = joints[..., 2]
        blind = np.isnan(depth)  # the ray misses a thin tail; its place on the floor is known
        depth[blind] = np.nanmedian(depth)
        truth = T @ joints
        truth[blind, 2] = np.nan
    return Measured(
        kind,
        Observations.join(parts),
        tracker.subject,
        pose,
        truth,
        tracker.blur,
        tracker.size_spread,
    )


def _track(each: Measured, tuning: TrackingParameters | None) -> Track:
    return curve.track_whole(each.subject, each.observations, (), tuning).track


def with_motion(tuning: TrackingParameters, **changes: Any) -> TrackingParameters:
    """The tuning with some fields of its `MotionParameters` replaced."""
    return replace(tuning, motion=replace(tuning.motion, **changes))


@dataclass(frozen=True)
class _Claim:
    """Stated and true errors of a sequence's frames that have a pose, over the animal's length.

    Attributes:
        kind: see `Measured`.
        blur: see `Measured`.
        size_spread: see `Measured`.
        stated: (n,) stated mean joint error.
        sd: (n, J) stated standard deviation of each joint.
        away: (n, J) standard deviation that a stretch of 1 gives each joint, see `stretch_of`.
        deviation: (n, J, 2) absolute errors of the joints along the floor.
    """

    kind: str
    blur: float
    size_spread: float
    stated: Array
    sd: Array
    away: Array
    deviation: Array

    def stretch_sd(self, per_blur: float, per_spread: float) -> float:
        """The sequence's `Subject.stretch_sd` at coefficients `per_blur` and `per_spread`."""
        return float(np.hypot(per_blur * self.blur, per_spread * self.size_spread))

    def over(self, knots: Knots, stretch: tuple[float, float]) -> Array:
        """Errors (n, J, 2) over their calibrated standard deviations.

        Args:
            knots: (stated error, factor) pairs, interpolated over the logarithm.
            stretch: coefficients of blur and of size spread.
        """
        factor = np.interp(
            np.log(self.stated), *np.array([(np.log(stated), factor) for stated, factor in knots]).T
        )
        return np.asarray(
            self.deviation
            / np.hypot(factor[:, None] * self.sd, self.stretch_sd(*stretch) * self.away)[..., None]
        )


def calibrate_joints(
    measured: Sequence[Measured], tuning: TrackingParameters
) -> TrackingParameters:
    """The tuning with factors and stretch for which the joints' 90 % intervals cover 90 %.

    Over a grid of both stretch coefficients the factors are fitted to all sequences together; the
    chosen pair minimises, over the sequences, the mean squared logarithm of the factor that each
    would still need. Families of bodies weigh the same in both.
    """
    plain = with_motion(
        tuning,
        calibration=((1.0, 1.0),),
        stretch=(0.0, 0.0),
        usual_stretch=0.0,
        unseen_height=(0.0,),
        unseen_shift=0.0,
        joint_calibration=(),
    )
    claims = [_claim(each, plain) for each in measured]
    weight = _weight_of([claim.kind for claim in claims])
    best = (0.0, 0.0)
    least = np.inf
    # grids of the stretch's coefficients, see `MotionParameters.stretch`
    for stretch in product(np.arange(0.0, 6.5, 0.5).tolist(), np.arange(0.0, 3.5, 0.5).tolist()):
        knots = calibration_knots(claims, stretch)
        needed = [_nine_in_ten(claim.over(knots, stretch)) for claim in claims]
        apart = float(np.average(np.log(needed) ** 2, weights=weight))
        if apart < least:
            best = stretch
            least = apart
    usual = float(np.median([claim.stretch_sd(*best) for claim in claims]))
    return with_motion(
        tuning,
        calibration=calibration_knots(claims, best),
        stretch=best,
        usual_stretch=round(usual, 4),
    )


def _claim(each: Measured, plain: TrackingParameters) -> _Claim:
    """Stated and true errors of a sequence tracked with factors of 1 and no stretch."""
    length = each.subject.length_mm
    track = _track(replace(each, subject=replace(each.subject, stretch_sd=0.0)), plain)
    there, off = _errors(each, track)
    joints = track.joints_mm[there]
    return _Claim(
        each.kind,
        each.blur,
        each.size_spread,
        track.predicted_error_mm[there] / length,
        track.sd_mm[there] / length,
        trust.stretch_of(1.0, joints) / length,
        np.abs(off[..., :2]) / length,
    )


def _errors(each: Measured, track: Track) -> tuple[NDArray[np.bool_], Array]:
    """Frames (n,) with a pose and a truth, and the errors (k, J, 3) mm of the joints in these.

    Where a foreign body's joints lie along it is a convention: the constant is subtracted.
    """
    there = track.posed & np.isfinite(each.truth[..., :2]).all(axis=(1, 2))
    joints, truth = track.joints_mm[there], each.truth[there]
    off = joints - truth
    if each.pose is None:
        way, _, constant = along_body(joints, truth, np.ones(len(off), np.bool_))
        off[..., :2] -= constant[:, None] * way
    return there, off


def _weight_of(kinds: Sequence[str]) -> Array:
    """Weights (n,), the same sum for each of the kinds (n,)."""
    _, kind, count = np.unique(kinds, return_inverse=True, return_counts=True)
    return np.asarray(1.0 / count[kind])


def _quantile(values: Array, share: float, weight: Array) -> float:
    """The quantile of weighted values (n,), those that are NaN left out."""
    order = np.argsort(values)[: np.isfinite(values).sum()]
    below = np.cumsum(weight[order])
    return float(np.interp(share * below[-1], below, values[order])) if len(order) else 0.0


def calibrate_builds(
    measured: Sequence[Measured], tuning: TrackingParameters
) -> TrackingParameters:
    """The tuning with the unobservable part of a build, `unseen_height` and `unseen_shift`.

    A joint whose error e, upwards or along the body, is more than 1.645 sd needs an additional
    spread of sqrt((e / 1.645)^2 - sd^2). The spread of each joint's height is the 90 % quantile in
    the family of bodies that needs most; the spread along the body is that over all joints.
    """
    plain = with_motion(tuning, unseen_height=(0.0,), unseen_shift=0.0)
    upwards: dict[str, list[Array]] = {}
    lengthways: dict[str, list[Array]] = {}
    for each in measured:
        track = _track(_stretched(each, plain), plain)
        there, off = _errors(each, track)
        along = each.truth[there, 0, :2] - each.truth[there, each.subject.skeleton.tip, :2]
        along /= np.linalg.norm(along, axis=1)[:, None]
        known = track.sd_mm[there] ** 2
        for needed, one in (
            (upwards, off[..., 2]),
            (lengthways, np.einsum("njk,nk->nj", off[..., :2], along)),
        ):
            variance = ((one / _Z90) ** 2 - known) / each.subject.length_mm**2
            needed.setdefault(each.kind, []).append(variance)
    if not upwards:
        return plain
    height = [np.nanquantile(np.concatenate(one), 0.9, axis=0) for one in upwards.values()]
    shift = [np.nanquantile(np.concatenate(one), 0.9) for one in lengthways.values()]
    return with_motion(
        tuning,
        unseen_height=tuple(np.sqrt(np.max(height, axis=0).clip(0.0)).round(4).tolist()),
        unseen_shift=round(float(np.sqrt(max(*shift, 0.0))), 4),
    )


def _stretched(each: Measured, tuning: TrackingParameters) -> Measured:
    """A sequence with the error of its lengths that a run would state."""
    stretch_sd = tuning.motion.stretch_sd(each.blur, each.size_spread)
    return replace(each, subject=replace(each.subject, stretch_sd=stretch_sd))


def calibrate_each_joint(
    measured: Sequence[Measured], tuning: TrackingParameters
) -> TrackingParameters:
    """The tuning with a factor for each joint (`joint_calibration`).

    The factors of `calibrate_joints` are common to all joints, and right in the mean over families
    of bodies. With a joint's own factor, its 90 % intervals cover 90 % of the coordinates along the
    floor in the family in which they cover least.
    """
    plain = with_motion(tuning, joint_calibration=(), unseen_height=(0.0,), unseen_shift=0.0)
    over: dict[str, list[Array]] = {}
    for each in measured:
        track = _track(_stretched(each, plain), plain)
        there, off = _errors(each, track)
        over.setdefault(each.kind, []).append(np.abs(off[..., :2]) / track.sd_mm[there][..., None])
    needed = [np.quantile(np.concatenate(z), 0.9, axis=(0, 2)) / _Z90 for z in over.values()]
    return with_motion(tuning, joint_calibration=tuple(np.max(needed, axis=0).round(3).tolist()))


def calibrate_expected(
    measured: Sequence[Measured], tuning: TrackingParameters
) -> TrackingParameters:
    """The tuning with the share of a build's part in the predicted error (`expected_share`).

    With it, the predicted error is right in the median over these sequences, which are of unusual
    bodies if there are any. Families of bodies weigh the same.
    """
    shares: list[Array] = []
    kinds: list[str] = []
    for each in measured:
        without, full = (
            _track(_stretched(each, one), one)
            for one in (with_motion(tuning, expected_share=share) for share in (0.0, 1.0))
        )
        there, off = _errors(each, full)
        error_mm = np.nanmean(np.linalg.norm(off, axis=-1), axis=1)
        least, most = (one.predicted_error_mm[there] for one in (without, full))
        shares.append(np.sqrt((error_mm**2 - least**2).clip(0.0) / (most**2 - least**2 + 1e-9)))
        kinds += [each.kind] * len(off)
    share = _quantile(np.concatenate(shares), 0.5, _weight_of(kinds))
    return with_motion(tuning, expected_share=round(share, 3))


def calibration_knots(claims: Sequence[_Claim], stretch: tuple[float, float]) -> Knots:
    """`MotionParameters.calibration`: factors at three levels of the stated error, by bisection.

    The frames are split into 3 groups of equal weight by their stated error. For each, f is the
    factor at which nine errors in ten lie within 1.645 sqrt((f sd)^2 + stretch^2). Larger errors
    than these are hardly calibrated, so the factor rises to 1 at an error of the animal's length.

    Args:
        claims: stated and true errors of all sequences.
        stretch: coefficients of blur and of size spread.

    Returns:
        (median stated error over the length, factor) for each group, in rising order, and for an
        error of 1.
    """
    stated, sd, deviation = (
        np.concatenate([getattr(claim, name) for claim in claims])
        for name in ("stated", "sd", "deviation")
    )
    away = np.concatenate([claim.stretch_sd(*stretch) * claim.away for claim in claims])
    weight = _weight_of([claim.kind for claim in claims for _ in claim.stated])
    order = np.argsort(stated, kind="stable")
    below = np.cumsum(weight[order]) / weight.sum()
    knots = []
    for rows in np.split(order, np.searchsorted(below, (1 / 3, 2 / 3))):

        def too_wide(factor: float, rows: NDArray[np.int64] = rows) -> bool:
            inside = deviation[rows] <= _Z90 * np.hypot(factor * sd[rows], away[rows])[..., None]
            return bool(np.average(inside.mean(axis=(1, 2)), weights=weight[rows]) > 0.9)

        least, most = (0.3, 3.0)
        while too_wide(least) and least > 0.01:
            least, most = 0.1 * least, least
        while most > 1.001 * least:
            factor = float(np.sqrt(least * most))
            least, most = (least, factor) if too_wide(factor) else (factor, most)
        knots.append((round(float(np.median(stated[rows])), 5), round(float(most), 3)))
    return (*knots, (1.0, max(1.0, knots[-1][1])))


def calibrate_roots(measured: Sequence[Measured], tuning: TrackingParameters) -> TrackingParameters:
    """The tuning with factors for which the 90 % intervals of root and bends cover 90 %.

    These are `root_calibration` (6,) and `bend_calibration` (3,). The root's error is the twist
    log(g_est^-1 g_true), rotation and then translation in its own frame.
    """
    plain = with_motion(
        tuning,
        root_calibration=(1.0,) * 6,
        bend_calibration=(1.0,) * 3,
        unseen_height=(0.0,),
        unseen_shift=0.0,
    )
    roots = []
    bends = []
    for each in measured:
        if (true := each.pose) is None:
            continue
        track = _track(each, plain)
        there = track.posed
        deviation = SE3(track.root_rotation[there], track.root_mm[there]).inverse() @ SE3(
            true.root.rotation[there], true.root.translation[there]
        )
        roots.append(
            np.concatenate([so3.log(deviation.rotation), deviation.translation], axis=1)
            / track.sd_root[there]
        )
        with np.errstate(invalid="ignore", divide="ignore"):
            bends.append(
                (track.angles_rad - true.angles)[there, 1:] / track.sd_angles_rad[there, 1:]
            )
    moves = each.subject.skeleton.axes[1:]
    root = [round(_nine_in_ten(column), 3) for column in np.concatenate(roots).T]
    z = np.concatenate(bends)
    bend = [
        round(_nine_in_ten(z[:, moves[:, a], a]), 3) if moves[:, a].any() else 1.0 for a in range(3)
    ]
    return with_motion(tuning, root_calibration=tuple(root), bend_calibration=tuple(bend))


def _nine_in_ten(z: Array) -> float:
    """The factor that standard deviations lack, from errors (...) over them."""
    return float(np.quantile(np.abs(z), 0.9)) / _Z90
