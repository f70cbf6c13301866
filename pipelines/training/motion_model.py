"""The job `liex train tracking`: what the tracker believes of an animal, found on rendered
sequences with the truth.

Sequences of the kinds that tracking is measured on, with other seeds, are measured frame by frame
once; what the filter says of its own errors is held against them. Before that, if it is asked for,
numbers of the chain and of the motion are changed at random, some at a time, and kept where the
tracks come nearer to the truth.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from itertools import product
from pathlib import Path
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from liex_lab.body.pose import Pose
from liex_lab.body.skeleton import Skeleton
from liex_lab.evaluation.tracking import Followed
from liex_lab.geometry import SE3, so3
from liex_lab.runtime.progress import Progress, silent
from liex_lab.simulation.corruptions import Event
from liex_lab.simulation.simulator import world_of
from liex_lab.simulation.tracking_sequences import tracking_sequence
from liex_lab.tracking.motion_model import Tuning, tunings_with
from liex_lab.tracking.observations import Observations
from liex_lab.tracking.offline import Subject, single_frames, stretch_of, track_whole
from liex_lab.tracking.track import Track
from liex_lab.tracking.tracker import FrameTracker

from ..build import build_scene, plan_of
from ..evaluation.pose import estimator_of

Array = NDArray[np.float64]
Knots = tuple[tuple[float, float], ...]

SEEDS = dict.fromkeys(("easy", "hard"), tuple(range(101, 109)))
_EASY_WEIGHT = 2.0  # never worse than single frames where these are good
_STEP = 0.5  # sd of the logarithm of a number that is changed
_BINS = 3
_Z90 = 1.645
_FACTORS = (0.3, 3.0)
_LEAST = 0.01
# how fast a session's stretch may grow with what it is told by, see `Motion.stretch`
_PER_BLUR = np.arange(0.0, 6.5, 0.5)
_PER_SPREAD = np.arange(0.0, 3.5, 0.5)
_FOUND_OTHERWISE = (
    "ceiling",
    "lasting",
    "honest",
    "stretch",
    "usual_stretch",
    "honest_root",
    "honest_bend",
)
_CHUNK = 32


@dataclass(frozen=True)
class Seen:
    """A sequence as it was measured: what frames say, of whom, and the true poses (n) and joints
    (n, J, 3) mm in the same arena. blur, size_spread: see `FrameTracker`.
    """

    kind: str
    seen: Observations
    subject: Subject
    pose: Pose
    truth: Array
    events: Sequence[Event]
    blur: float
    size_spread: float

    def errors(self, joints: Array) -> Array:
        """Errors over the animal's length of the frames in view, as `in_view_ratio` counts them."""
        length = self.subject.length_mm
        return (
            Followed(joints, self.truth, joints[..., 0], 1.0).in_view(self.events, length) / length
        )


def train_tracking(
    animal: str,
    out: Path,
    *,
    n_tries: int = 0,
    n_frames: int | None = None,
    seeds: Sequence[int] = (),
    workers: int = 0,
    progress: Progress = silent,
) -> Path:
    """Write `tunings.toml` with an animal's table found again, byte for byte the same whenever and
    however it is run.

    Chain and motion are those of the file, or the best of n_tries changes of them; how far off the
    track may be is measured. n_frames, seeds: of other sequences than `SEEDS`; workers: threads, 0
    for all.
    """
    if workers:
        numba.set_num_threads(min(workers, numba.config.NUMBA_NUM_THREADS))
    measured = [
        measure(animal, kind, seed, n_frames, progress)
        for kind, usual in SEEDS.items()
        for seed in seeds or usual
    ]
    tuning = search(measured, Tuning.of(animal), n_tries, np.random.default_rng(0), progress)
    tuning = honest_about_roots(measured, honest_about_joints(measured, tuning))
    out.write_text(tunings_with(animal, tuning), encoding="utf-8")
    return out


def measure(
    animal: str, kind: str, seed: int, n_frames: int | None, progress: Progress = silent
) -> Seen:
    """One sequence, frame by frame; scene and size are found by the product."""
    plan = plan_of(animal)
    estimator = estimator_of(animal, "default", progress)
    recording = tracking_sequence(
        world_of(Skeleton.load(animal)), kind, seed=seed, n_frames=n_frames
    )
    scene, sample = build_scene(
        recording, plan, estimator.skeleton, plan.foreground.n_background_frames
    )
    tracker = FrameTracker.prepare(estimator, scene, sample, bridge_s=plan.tracking.bridge_s)
    parts = []
    for frames in recording.chunks(_CHUNK):
        progress(frames[0].index, len(recording), f"measuring {recording.name}")
        parts.append(tracker.observe(frames))
    T = scene.floor.T_arena_camera @ recording.T_arena_camera.inverse()
    pose = recording.pose.moved(scene.floor.T_arena_camera)
    return Seen(
        kind,
        Observations.join(parts),
        tracker.subject,
        pose,
        T @ recording.joints_arena,
        recording.events,
        tracker.blur,
        tracker.size_spread,
    )


def search(
    measured: Sequence[Seen],
    tuning: Tuning,
    n_tries: int,
    rng: np.random.Generator,
    progress: Progress = silent,
) -> Tuning:
    """The best of n random changes in a row, each of up to three numbers."""
    alone = {kind: _of_kind(measured, kind, None) for kind in SEEDS}
    best = _cost(measured, alone, tuning)
    for tried in range(n_tries):
        progress(tried, n_tries, f"searching; the cost is {best:.3f}")
        other = tuning
        for _ in range(rng.integers(1, 4)):
            other = changed(other, rng)
        cost = _cost(measured, alone, other)
        if cost < best:
            best = cost
            tuning = other
    return tuning


def changed(tuning: Tuning, rng: np.random.Generator) -> Tuning:
    """The same with one number multiplied at random."""
    factor = float(np.exp(rng.normal(0.0, _STEP)))
    part = "chain" if rng.random() < 0.35 else "motion"
    values: Any = getattr(tuning, part)
    names = [field.name for field in fields(values) if field.name not in _FOUND_OTHERWISE]
    name = str(rng.choice(names))
    return replace(
        tuning, **{part: replace(values, **{name: _scaled(getattr(values, name), factor, rng)})}
    )


def _scaled(value: Any, factor: float, rng: np.random.Generator) -> Any:
    """A number times the factor, or one of several numbers."""
    if isinstance(value, tuple):
        at = int(rng.integers(len(value)))
        return tuple(
            _scaled(each, factor, rng) if k == at else each for k, each in enumerate(value)
        )
    if isinstance(value, float | int):
        return value * factor
    name = str(rng.choice([field.name for field in fields(value)]))
    return replace(value, **{name: getattr(value, name) * factor})


def _of_kind(measured: Sequence[Seen], kind: str, tuning: Tuning | None) -> Array:
    """Errors over all sequences of a kind: of single frames without a tuning."""
    found = []
    for each in measured:
        if each.kind == kind:
            alone = tuning is None
            track = single_frames(each.subject, each.seen) if alone else _track(each, tuning)
            found.append(each.errors(track.joints_mm))
    return np.concatenate(found)


def _track(each: Seen, tuning: Tuning | None) -> Track:
    return track_whole(each.subject, each.seen, (), tuning).track


def _cost(measured: Sequence[Seen], alone: dict[str, Array], tuning: Tuning) -> float:
    """Mean, median, third quartile and 95th percentile of the errors over those of single
    frames.
    """
    total = 0.0
    for kind, weight in (("easy", _EASY_WEIGHT), ("hard", 1.0)):
        error = _of_kind(measured, kind, tuning)
        others = alone[kind]
        of = [error.mean() / others.mean()]
        of += [float(np.quantile(error, q) / np.quantile(others, q)) for q in (0.5, 0.75, 0.95)]
        total += weight * float(np.sum(of))
    return total


def with_motion(tuning: Tuning, **changes: Any) -> Tuning:
    """The same with something else in its motion."""
    return replace(tuning, motion=replace(tuning.motion, **changes))


@dataclass(frozen=True)
class _Claim:
    """What the filter says of a sequence's frames that have a pose, over the animal's length: said
    (n,); sd (n, J) and away (n, J), see `stretch_of`, of a stretch of 1; off (n, J, 3): how far off
    the joints are.
    """

    blur: float
    size_spread: float
    said: Array
    sd: Array
    away: Array
    off: Array

    def stretch_sd(self, per_blur: float, per_spread: float) -> float:
        """The sequence's `Subject.stretch_sd`."""
        return float(np.hypot(per_blur * self.blur, per_spread * self.size_spread))

    def over(self, knots: Knots, stretch: tuple[float, float]) -> Array:
        """Errors (n, J, 3) over their standard deviations."""
        factor = np.interp(
            np.log(self.said), *np.array([(np.log(said), factor) for said, factor in knots]).T
        )
        sd = np.hypot(factor[:, None] * self.sd, self.stretch_sd(*stretch) * self.away)
        return np.asarray(self.off / sd[..., None])


def honest_about_joints(measured: Sequence[Seen], tuning: Tuning) -> Tuning:
    """The same with the `stretch` and `honest` by which nine errors in ten lie within their
    intervals in all sequences together, and as nearly as possible in each of them.
    """
    plain = with_motion(tuning, honest=((1.0, 1.0),), stretch=(0.0, 0.0), usual_stretch=0.0)
    claims = [_claim(each, plain) for each in measured]
    best = (0.0, 0.0)
    least = np.inf
    for stretch in product(_PER_BLUR.tolist(), _PER_SPREAD.tolist()):
        knots = honesty(claims, stretch)
        apart = float(
            np.mean([np.log(_nine_in_ten(claim.over(knots, stretch))) ** 2 for claim in claims])
        )
        if apart < least:
            best = stretch
            least = apart
    usual = float(np.median([claim.stretch_sd(*best) for claim in claims]))
    return with_motion(
        tuning, honest=honesty(claims, best), stretch=best, usual_stretch=round(usual, 4)
    )


def _claim(each: Seen, plain: Tuning) -> _Claim:
    """What the filter says of a sequence by itself."""
    length = each.subject.length_mm
    track = _track(replace(each, subject=replace(each.subject, stretch_sd=0.0)), plain)
    there = track.posed
    joints = track.joints_mm[there]
    return _Claim(
        each.blur,
        each.size_spread,
        track.predicted_error_mm[there] / length,
        track.sd_mm[there] / length,
        stretch_of(1.0, joints) / length,
        np.abs(joints - each.truth[there]) / length,
    )


def honesty(claims: Sequence[_Claim], stretch: tuple[float, float]) -> Knots:
    """How many times larger errors are than the filter says, by what it says, beside a stretch: see
    `Motion.honest`.
    """
    said, sd, off = (
        np.concatenate([getattr(claim, name) for claim in claims]) for name in ("said", "sd", "off")
    )
    away = np.concatenate([claim.stretch_sd(*stretch) * claim.away for claim in claims])
    knots = []
    for rows in np.array_split(np.argsort(said, kind="stable"), min(_BINS, len(said))):

        def too_wide(factor: float, rows: NDArray[np.int64] = rows) -> bool:
            inside = off[rows] <= _Z90 * np.hypot(factor * sd[rows], away[rows])[..., None]
            return bool(inside.mean() > 0.9)

        least, most = _FACTORS
        while too_wide(least) and least > _LEAST:
            least, most = 0.1 * least, least
        while most > 1.001 * least:
            factor = float(np.sqrt(least * most))
            least, most = (least, factor) if too_wide(factor) else (factor, most)
        knots.append((round(float(np.median(said[rows])), 5), round(float(most), 3)))
    return tuple(knots)


def honest_about_roots(measured: Sequence[Seen], tuning: Tuning) -> Tuning:
    """The same with the `honest_root` and `honest_bend` by which nine errors in ten lie within
    their intervals.
    """
    plain = with_motion(tuning, honest_root=(1.0,) * 6, honest_bend=(1.0,) * 3)
    roots = []
    bends = []
    for each in measured:
        track = _track(each, plain)
        there = track.posed
        true = each.pose
        off = SE3(track.root_rotation[there], track.root_mm[there]).inverse() @ SE3(
            true.root.rotation[there], true.root.translation[there]
        )
        roots.append(
            np.concatenate([so3.log(off.rotation), off.translation], axis=1) / track.sd_root[there]
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
    return with_motion(tuning, honest_root=tuple(root), honest_bend=tuple(bend))


def _nine_in_ten(z: Array) -> float:
    """By how much standard deviations are too small, from errors (...) over them."""
    return float(np.quantile(np.abs(z), 0.9)) / _Z90
