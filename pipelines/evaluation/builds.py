"""Evaluation on animals of another build: `liex evaluate pose --split other-build`.

Moving animals of builds that no forest was trained on are rendered, tracked as a run does, and held
against the truth; beside them as many of builds like the training's. Development has seeds of its
own; the sealed split has others, which no test, no training and no development touches.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import numpy as np

from liex_lab.errors import EstimationError, LiexError
from liex_lab.evaluation.builds import BUILDS_PROTOCOL, Built, build_figures
from liex_lab.runtime.progress import Progress, silent
from liex_lab.tracking.offline import track_whole
from liex_lab.tracking.track import Track

from ..build import plan_of
from ..training.motion_model import observed
from .pose import estimator_of

if TYPE_CHECKING:
    from liex_lab.estimation.estimator import PoseEstimator
    from liex_lab.plan import Plan
    from liex_lab.simulation.recording import TrueRecording

SPLIT: Final = "other-build"
SEEDS: Final = tuple(range(500, 524))
SEALED_SEEDS: Final = tuple(range(953_200_417, 953_200_441))
N_FRAMES: Final = 120  # of a recording
_N_RECORDINGS: Final = 12
_NOISES = (0.7, 1.0, 1.5)


def evaluate_builds(
    animal: str = "mouse",
    *,
    n_frames: int | None = None,
    sealed: bool = False,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Errors and intervals of tracks of animals of another build, beside those of usual builds.

    Args:
        animal: `mouse` or `fish`.
        n_frames: frames of other builds, rounded up to whole recordings of 120; None takes 12.
        sealed: the split that is kept for the end.
        progress: told recording by recording.

    Returns:
        `other` and `usual`, see `evaluation.builds.BUILDS_PROTOCOL`, the ratio of their errors in
        per cent of the length, seeds and protocol.

    Raises:
        LiexError: the animal's simulator knows one build only, or there are not as many recordings.
    """
    n_recordings = _N_RECORDINGS if n_frames is None else max(1, -(-n_frames // N_FRAMES))
    seeds = SEALED_SEEDS if sealed else SEEDS
    if n_recordings > len(seeds):
        raise LiexError(
            f"of other builds there are {len(seeds) * N_FRAMES} frames, got {n_frames}; say at "
            "most so many"
        )
    seeds = seeds[:n_recordings]
    estimator = estimator_of(animal, "default", progress)
    rows: dict[str, list[Built]] = {"other": [], "usual": []}
    done = 0
    for k, seed in enumerate(seeds):
        for name, family in (("other", "other"), ("usual", "train")):
            recording = film(animal, seed, k, family)
            progress(done, 2 * len(seeds), f"measuring {recording.name}")
            rows[name].append(track(estimator, recording, plan_of(animal)))
            done += 1
    joints = estimator.skeleton.names
    figures = {name: build_figures(some, joints) for name, some in rows.items()}
    own, beside = (figures[name].get("error_percent") for name in ("other", "usual"))
    return {
        "animal": animal,
        "split": SPLIT,
        **figures,
        "ratio_to_usual": own / beside if own and beside else None,
        "seeds": "sealed" if sealed else list(seeds),
        "protocol": BUILDS_PROTOCOL,
    }


def film(animal: str, seed: int, k: int, family: str) -> TrueRecording:
    """Recording k of the split: its camera and its noise go in turn.

    Args:
        animal: `mouse` or `fish`.
        seed: that everything else is drawn from.
        k: number of the recording.
        family: of builds, `other` or `train`.

    Raises:
        LiexError: the animal's simulator knows one build only.
    """
    from liex_lab.body.skeleton import Skeleton
    from liex_lab.simulation.simulator import BodySimulator, world_of
    from liex_lab.simulation.species import unseen

    world = world_of(Skeleton.load(animal))
    if not isinstance(world, BodySimulator) or animal not in ("mouse", "fish"):
        raise LiexError(f"the split {SPLIT} is of mouse and fish, not of '{animal}'")
    sensors = (*world.species.sensors, *unseen(world.species.sensors))
    return world.motion(
        [seed],
        N_FRAMES,
        family=family,
        sensor=sensors[k % len(sensors)],
        noise=_NOISES[k % len(_NOISES)],
        name=f"{SPLIT}-{family}-{k:02d}",
    )


def track(estimator: PoseEstimator, recording: TrueRecording, plan: Plan) -> Built:
    """A recording as the product tracks it, with its truth.

    Args:
        estimator: the animal's.
        recording: with its truth.
        plan: thresholds of the foreground, and expected sizes.
    """
    skeleton = estimator.skeleton
    try:
        each = observed(estimator, plan, SPLIT, recording)
    except EstimationError:
        lost = Track.empty(skeleton, recording.times_ns)
        return Built(lost, recording.joints_arena, recording.spine_mm, np.nan, skeleton.tip)
    return Built(
        track_whole(each.subject, each.seen).track,
        each.truth,
        recording.spine_mm,
        each.subject.length_mm,
        skeleton.tip,
    )
