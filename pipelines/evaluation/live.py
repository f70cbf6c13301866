"""Evaluation of live tracking: latency from a whole frame received to its skeleton.

`liex evaluate live` renders up to 150 frames of a moving virtual animal, keeps them in memory and
sends them through a local socket at the camera's pace, forwards and backwards in turn. Numbers:
median and 95 % latency, ms, over every frame from the first on that came when all before it had
been answered, so that learning the background is not in it; frames measured and bridged. 60 frames
after the learning are followed beforehand, so that all is compiled.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from liex_lab.body.skeleton import Skeleton
from liex_lab.recordings.recording import Recording
from liex_lab.recordings.streaming import replayed
from liex_lab.runtime.progress import Progress, silent
from liex_lab.simulation.simulator import world_of

from ..build import plan_of
from ..live import follow_live

LIVE_PROTOCOL = (
    "Frames are rendered beforehand, kept in memory, and sent through a socket of this machine at "
    "the camera's pace, forwards and backwards in turn. latency: from when a whole frame had come "
    "to when its skeleton was told, without a viewer; counted from the first frame on that came "
    "when all before it had been told, so that learning the background is not in it, and from "
    "then on every frame. Some frames are followed beforehand, so that all is compiled."
)
_SEED = 78_001
_KEPT = 150  # frames rendered
# frames followed beforehand, and how many times as fast
_WARM = 60
_WARM_SPEED = 1000.0


def evaluate_live(
    animal: str = "fish",
    *,
    n_frames: int = 1500,
    learn_frames: int = 90,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Latencies of live tracking over n frames; `liex evaluate live`.

    Args:
        animal: a bundled animal's name, or the path of a skeleton's TOML.
        n_frames: frames that are sent.
        learn_frames: frames that background, floor and size are learned from.
        progress: told how far rendering and following are.

    Returns:
        `rate_hz`, the numbers of `follow_live`, and the protocol.
    """
    filmed = world_of(Skeleton.load(animal)).motion(_SEED, min(_KEPT, n_frames))
    kept = []
    for frame in filmed:
        kept.append(frame.depth)
        progress(frame.index + 1, len(filmed), "rendering frames")
    step_ns = int(np.median(np.diff(filmed.times_ns)))
    again = Recording(
        name=f"live-{animal}",
        format="synthetic",
        camera=filmed.camera,
        times_ns=step_ns * np.arange(n_frames, dtype=np.int64),
        read=lambda index: kept[_to_and_fro(index, len(kept))],
    )
    plan = plan_of(animal)
    follow_live(
        replayed(again[: learn_frames + _WARM], _WARM_SPEED), plan, learn_frames=learn_frames
    )
    numbers, _ = follow_live(replayed(again), plan, learn_frames=learn_frames, progress=progress)
    return {"animal": animal, "rate_hz": 1e9 / step_ns, **numbers, "protocol": LIVE_PROTOCOL}


def _to_and_fro(index: int, n: int) -> int:
    """The frame (0 to n - 1) shown at a count, when n frames go forwards and backwards in turn."""
    at = index % (2 * n)
    return at if at < n else 2 * n - 1 - at
