"""The job `liex train tracking`: what the tracker believes of an animal, found on rendered sequences with the truth.

Sequences of the kinds that tracking is measured on, with other seeds, are measured frame by frame once; then numbers
are changed at random, some at a time, and kept where the tracks come nearer to the truth. At last what the filter says
of its own errors is held against them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from liex_lab.pipelines.build import build_scene, plan_of
from liex_lab.pipelines.evaluate import estimator_of
from numpy.typing import NDArray

from liex_lab.body.pose import Pose
from liex_lab.body.skeleton import Skeleton
from liex_lab.evaluation_tracking import Followed
from liex_lab.geometry import SE3, so3
from liex_lab.progress import Progress, silent
from liex_lab.recordings.hazards import Event
from liex_lab.recordings.sequences import tracking_sequence
from liex_lab.recordings.worlds import world_of
from liex_lab.tracking.curve import Subject, single_frames, track_whole
from liex_lab.tracking.observations import Observations
from liex_lab.tracking.track import Track
from liex_lab.tracking.tracker import FrameTracker
from liex_lab.tracking.tuning import Tuning

Array = NDArray[np.float64]

SEEDS = {"easy": (101, 102, 103, 104), "hard": (101, 102, 103, 104, 105, 106, 107, 108, 109)}
_EASY_WEIGHT = 2.0  # never worse than single frames where these are good
_STEP = 0.5  # sd of the logarithm of a number that is changed
_BINS, _Z90, _FACTORS = 6, 1.645, (0.6, 3.0)
_FOUND_OTHERWISE = ("ceiling", "lasting", "honest", "honest_root", "honest_bend")
_CHUNK = 32


@dataclass(frozen=True)
class Seen:
    """A sequence as it was measured: what frames say, of whom, and the true poses (n) and joints (n, J, 3) mm in the
    same arena.
    """

    kind: str
    seen: Observations
    subject: Subject
    pose: Pose
    truth: Array
    events: Sequence[Event]

    def errors(self, joints: Array) -> Array:
        """Errors over the animal's length of the frames in view, as `in_view_ratio` counts them."""
        length = self.subject.length_mm
        return Followed(joints, self.truth, joints[..., 0], 1.0).in_view(self.events, length) / length


def train_tracking(
    animal: str, out: Path, *, n_tries: int = 400, n_frames: int | None = None, progress: Progress = silent
) -> Path:
    """Write an animal's table for `tunings.toml`."""
    measured = [measure(animal, kind, seed, n_frames, progress) for kind, seeds in SEEDS.items() for seed in seeds]
    tuning = search(measured, Tuning.of(animal), n_tries, np.random.default_rng(0), progress)
    tuning = honest_about_roots(measured, with_motion(tuning, honest=honesty(measured, tuning)))
    out.write_text(tuning.to_toml(animal), encoding="utf-8")
    return out


def measure(animal: str, kind: str, seed: int, n_frames: int | None, progress: Progress = silent) -> Seen:
    """One sequence, frame by frame; scene and size are found by the product."""
    plan, estimator = plan_of(animal), estimator_of(animal, "default", progress)
    recording = tracking_sequence(world_of(Skeleton.load(animal)), kind, seed=seed, n_frames=n_frames)
    scene, sample = build_scene(recording, plan, estimator.skeleton, plan.foreground.n_background_frames)
    tracker = FrameTracker.prepare(estimator, scene, sample, bridge_s=plan.tracking.bridge_s)
    parts = []
    for frames in recording.chunks(_CHUNK):
        progress(frames[0].index, len(recording), f"measuring {recording.name}")
        parts.append(tracker.observe(frames))
    T = scene.floor.T_arena_camera @ recording.T_arena_camera.inverse()
    pose = recording.pose.moved(scene.floor.T_arena_camera)
    return Seen(kind, Observations.join(parts), tracker.subject, pose, T @ recording.joints_arena, recording.events)


def search(
    measured: Sequence[Seen], tuning: Tuning, n_tries: int, rng: np.random.Generator, progress: Progress = silent
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
            best, tuning = cost, other
    return tuning


def changed(tuning: Tuning, rng: np.random.Generator) -> Tuning:
    """The same with one number multiplied at random."""
    factor = float(np.exp(rng.normal(0.0, _STEP)))
    part = "chain" if rng.random() < 0.35 else "motion"
    values: Any = getattr(tuning, part)
    names = [field.name for field in fields(values) if field.name not in _FOUND_OTHERWISE]
    name = str(rng.choice(names))
    return replace(tuning, **{part: replace(values, **{name: _scaled(getattr(values, name), factor, rng)})})


def _scaled(value: Any, factor: float, rng: np.random.Generator) -> Any:
    """A number times the factor, or one of several numbers."""
    if isinstance(value, tuple):
        at = int(rng.integers(len(value)))
        return tuple(_scaled(each, factor, rng) if k == at else each for k, each in enumerate(value))
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
    """Mean, median, third quartile and 95th percentile of the errors over those of single frames."""
    total = 0.0
    for kind, weight in (("easy", _EASY_WEIGHT), ("hard", 1.0)):
        error, others = _of_kind(measured, kind, tuning), alone[kind]
        of = [error.mean() / others.mean()]
        of += [float(np.quantile(error, q) / np.quantile(others, q)) for q in (0.5, 0.75, 0.95)]
        total += weight * float(np.sum(of))
    return total


def with_motion(tuning: Tuning, **changes: Any) -> Tuning:
    """The same with something else in its motion."""
    return replace(tuning, motion=replace(tuning.motion, **changes))


def honesty(measured: Sequence[Seen], tuning: Tuning) -> tuple[tuple[float, float], ...]:
    """How many times larger errors are than the filter says, by what it says: see `Motion.honest`."""
    plain = with_motion(tuning, honest=((1.0, 1.0),))
    said, off = [], []
    for each in measured:
        track = _track(each, plain)
        there = track.posed
        said.append(track.predicted_error_mm[there] / each.subject.length_mm)
        off.append((np.abs(track.joints_mm - each.truth) / track.sd_mm[..., None])[there])
    x, z = np.concatenate(said), np.concatenate(off)
    edges = np.quantile(x, np.linspace(0.0, 1.0, _BINS + 1))
    knots, least = [], _FACTORS[0]
    for low, high in pairwise(edges):
        rows = (x >= low) & (x <= high)
        least = float(np.clip(np.quantile(z[rows], 0.9) / _Z90, least, _FACTORS[1]))  # larger errors err more
        knots.append((round(float(np.median(x[rows])), 5), round(least, 3)))
    return tuple(knots)


def honest_about_roots(measured: Sequence[Seen], tuning: Tuning) -> Tuning:
    """The same with the `honest_root` and `honest_bend` by which nine errors in ten lie within their intervals."""
    plain = with_motion(tuning, honest_root=(1.0,) * 6, honest_bend=(1.0,) * 3)
    roots, bends = [], []
    for each in measured:
        track = _track(each, plain)
        there, true = track.posed, each.pose
        off = SE3(track.root_rotation[there], track.root_mm[there]).inverse() @ SE3(
            true.root.rotation[there], true.root.translation[there]
        )
        roots.append(np.concatenate([so3.log(off.rotation), off.translation], axis=1) / track.sd_root[there])
        with np.errstate(invalid="ignore", divide="ignore"):
            bends.append((track.angles_rad - true.angles)[there, 1:] / track.sd_angles_rad[there, 1:])
    moves = each.subject.skeleton.axes[1:]
    root = _nine_in_ten(np.concatenate(roots))
    z = np.concatenate(bends)
    bend = [_nine_in_ten(z[:, moves[:, a], a].reshape(-1, 1))[0] if moves[:, a].any() else 1.0 for a in range(3)]
    return with_motion(tuning, honest_root=tuple(root), honest_bend=tuple(bend))


def _nine_in_ten(z: Array) -> list[float]:
    """By how much the standard deviations of columns (n, k) of errors over them are too small."""
    return np.round(np.quantile(np.abs(z), 0.9, axis=0) / _Z90, 3).tolist()
