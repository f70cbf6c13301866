"""What `liex evaluate live` measures: how late skeletons are while a virtual animal is filmed at
its camera's pace.
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
    """Latencies over n frames; `liex evaluate live`."""
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
    """The frame that is shown at a count, when n frames are shown forwards and backwards in
    turn.
    """
    at = index % (2 * n)
    return at if at < n else 2 * n - 1 - at
