"""Evaluation of tracking: single frames, Lie-X's particle filter, the default tracker.

`liex evaluate tracking` measures fixed rendered sequences, the counterpart of Lie-X's Fig 18:
`easy` (511 frames, as a sensor sees them) and `hard` (300 frames with noise, holes, dropped frames,
a bar before the animal, a second object, an animal lost in floor or glare, and fast motion). Rows:

- single: what each frame says by itself (Algorithm 1);
- algorithm3: the paper's particle filter, 200 particles (section 4.2, Algorithm 3), on our
  regressors and our metric;
- online: the default tracker (association by Viterbi, Kalman smoothing), `ONLINE_LAG` frames late;
- smoothed: the default tracker over the whole sequence;
- algorithm1_paper, algorithm3_paper, algorithm3_paper_base_round, if asked for: the paper's own
  comparison, with the parts of its variant, see `paper.algorithm3`.

Numbers: mean and 95 % of the mean joint error, mm, and their ratios to single frames; the same over
frames in view, where a missing pose counts as half the length; share of lost frames; longest run of
flipped frames; coverage of 90 % intervals; frames until recovery after an occlusion; frames/s.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from liex_lab.evaluation.tracking import TRACKING_PROTOCOL, Followed, figures
from liex_lab.runtime.progress import Progress, silent
from liex_lab.tracking.particles import ProcessNoise

from ..build import build_scene, plan_of
from .paper.algorithm3 import PAPER_ROWS, SINGLE, comparison, follow, paper_rows
from .pose import estimator_of

if TYPE_CHECKING:
    from liex_lab.estimation.estimator import PoseEstimator
    from liex_lab.plan import Plan
    from liex_lab.simulation.tracking_sequences import TestSequence
    from liex_lab.tracking.observations import Observations
    from liex_lab.tracking.track import Track
    from liex_lab.tracking.tracker import FrameTracker

Array = NDArray[np.float64]

ROWS = ("single", "algorithm3", "online", "smoothed")
ROW_NAMES = {
    "single": "single frames",
    "algorithm3": "Algorithm 3 on our parts",
    "online": "default tracker, online",
    "smoothed": "default tracker",
    "algorithm1_paper": "Algorithm 1 on the paper's parts",
    "algorithm3_paper": "Algorithm 3 on the paper's parts",
    "algorithm3_paper_base_round": "Algorithm 3 on the paper's parts, one base round",
}
ONLINE_LAG = 5  # frames
_CHUNK = 32
# chunks that the tracker is timed on, and how often
_TIMED = 3
_AGAIN = 3


@dataclass(frozen=True)
class Measured:
    """A sequence and what each row made of it.

    Attributes:
        sequence: the rendered frames with their truth.
        rows: by name; joints (n, J, 3) mm in the true arena frame, their truth and deviations.
        speed: frames per second on one core and on all, see `_speed`.
    """

    sequence: TestSequence
    rows: dict[str, Followed]
    speed: dict[str, float]


def evaluate_tracking(
    animal: str = "mouse",
    sequence: str = "hard",
    *,
    model: str | Path | None = None,
    rows: Sequence[str] = ROWS,
    paper: bool = False,
    seeds: Sequence[int] = (),
    n_frames: int | None = None,
    draw: Callable[[TestSequence, dict[str, Followed]], object] | None = None,
    progress: Progress = silent,
) -> dict[str, Any]:
    """The tracking errors of a fixed sequence; `liex evaluate tracking`.

    Args:
        animal: a bundled animal's name, or the path of a skeleton's TOML.
        sequence: `easy` or `hard`.
        model: another pose model than the animal's own.
        rows: only some of `ROWS`.
        paper: also measure the paper's own comparison, with the parts of its variant, which is
            trained where it has not been.
        seeds: of other sequences of the same kind, whose frames are taken together; () takes the
            fixed one.
        n_frames: length of each sequence; None takes the usual one.
        draw: is given the first sequence and what the rows made of it, for a picture.
        progress: told chunk by chunk.

    Returns:
        `rows` of figures by name, `row_names`, `speed`, `online_lag_frames`, the protocol, and
        `notes` where there are any.
    """
    from liex_lab.body.skeleton import Skeleton
    from liex_lab.simulation.simulator import world_of
    from liex_lab.simulation.tracking_sequences import tracking_sequence

    world = world_of(Skeleton.load(animal))
    plan = plan_of(animal)
    estimator = estimator_of(animal, "default", progress, *(() if model is None else (model,)))
    rival = estimator_of(animal, "paper", progress) if paper else None
    measured = []
    for seed in seeds or (None,):
        recording = tracking_sequence(world, sequence, seed=seed, n_frames=n_frames)
        found = follow_sequence(recording, estimator, plan, rows, progress)
        if rival is not None:
            found.rows.update(paper_rows(recording, rival, plan, progress))
        measured.append(found)
    events = [m.sequence.events for m in measured]
    length = float(np.mean([m.sequence.spine_mm for m in measured]))
    table = {
        name: figures(
            [m.rows[name] for m in measured],
            [m.rows[SINGLE if name in PAPER_ROWS else "single"] for m in measured],
            events,
            length,
        )
        for name in measured[0].rows
        if name in rows or name in PAPER_ROWS
    }
    result = {
        "animal": animal,
        "sequence": sequence,
        "n_frames": sum(len(m.sequence) for m in measured),
        "rows": table,
        "row_names": {name: ROW_NAMES[name] for name in table},
        "speed": measured[0].speed,
        "online_lag_frames": ONLINE_LAG,
        "protocol": TRACKING_PROTOCOL,
    }
    if paper:
        result["notes"] = [comparison(table, estimator.skeleton.name)]
    if draw is not None:
        draw(measured[0].sequence, measured[0].rows)
    return result


def follow_sequence(
    recording: TestSequence,
    estimator: PoseEstimator,
    plan: Plan,
    rows: Sequence[str],
    progress: Progress = silent,
) -> Measured:
    """What each row makes of a sequence; background, size and animal are found by the product.

    Args:
        recording: the rendered frames with their truth.
        estimator: measures single frames.
        plan: foreground and tracking settings, and the seed of Algorithm 3.
        rows: which of `ROWS` are wanted; `single` is always made.
        progress: told chunk by chunk.

    Returns:
        The rows, moved into the true arena frame, with the frames per second of each.
    """
    from liex_lab.tracking.observations import Observations
    from liex_lab.tracking.tracker import FrameTracker

    scene, sample = build_scene(
        recording, plan, estimator.skeleton, plan.foreground.n_background_frames
    )
    tracker = FrameTracker.prepare(estimator, scene, sample, bridge_s=plan.tracking.bridge_s)
    parts: list[Observations] = []
    seconds = dict.fromkeys(("single", "observe", "algorithm3"), 0.0)
    for frames in recording.chunks(_CHUNK):
        progress(frames[0].index, len(recording), f"measuring {recording.name}")
        depths = np.stack([frame.depth for frame in frames])
        began = time.perf_counter()
        estimator.estimate(depths, scene, tracker.size)
        between = time.perf_counter()
        parts.append(tracker.observe(frames))
        seconds["single"] += between - began
        seconds["observe"] += time.perf_counter() - between
    seen = Observations.join(parts)
    tracker.track(parts[0])  # compiled before the clock runs
    _online(tracker, parts[0])
    found: dict[str, Followed] = {}
    tip = estimator.skeleton.tip
    n = len(recording)
    T = recording.T_arena_camera @ scene.floor.T_arena_camera.inverse()

    def put(name: str, track: Track, spent: float) -> None:
        """Keep row `name`: its `track` of n frames in the true arena frame, made in `spent` s."""
        found[name] = Followed(
            T @ track.joints_mm, recording.joints_arena, track.sd_xyz_mm, n / spent, tip
        )

    began = time.perf_counter()
    single = tracker.follow_again(seen)
    put("single", single, seconds["single"])
    if "smoothed" in rows:
        began = time.perf_counter()
        tracked = tracker.track(seen)
        put("smoothed", tracked.track, seconds["observe"] + time.perf_counter() - began)
    if "online" in rows:
        began = time.perf_counter()
        track = _online(tracker, seen)
        put("online", track, seconds["observe"] + time.perf_counter() - began)
    if "algorithm3" in rows:
        progress(0, n, f"Algorithm 3 on {recording.name}")
        noise = ProcessNoise.of(estimator.skeleton.name)
        found["algorithm3"] = follow(
            recording, estimator, tracker.scene, tracker.size, noise, 0, plan.seed
        )
    progress(0, n, "timing the tracker")
    return Measured(
        recording, {name: found[name] for name in ROWS if name in found}, _speed(tracker, recording)
    )


def _speed(tracker: FrameTracker, recording: TestSequence) -> dict[str, float]:
    """Frames/s of the default tracker, from pictures in memory to the smoothed track, on one core
    and on all of them: the best of some tries in turn over the sequence's first frames.
    """
    import numba

    from liex_lab.runtime.threads import threads
    from liex_lab.tracking.observations import Observations

    chunks = [frames for frames, _ in zip(recording.chunks(_CHUNK), range(_TIMED), strict=False)]
    best = {"frames_per_s_1core": 0.0, "frames_per_s_all_cores": 0.0}
    for _ in range(_AGAIN):
        for name, parallel in zip(best, (False, True), strict=True):
            began = time.perf_counter()
            with threads(parallel):
                tracker.track(Observations.join([tracker.observe(frames) for frames in chunks]))
            best[name] = max(best[name], sum(map(len, chunks)) / (time.perf_counter() - began))
    return {**best, "cores": float(numba.get_num_threads())}


def _online(tracker: FrameTracker, seen: Observations) -> Track:
    """The track of the online tracker, which sees no more than `ONLINE_LAG` frames ahead."""
    from liex_lab.tracking.online import OnlineTracker
    from liex_lab.tracking.track import Track

    online = OnlineTracker(tracker.subject, ONLINE_LAG)
    return Track.join([part for part in (online.add(seen), online.close()) if part is not None])
