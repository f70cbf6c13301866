"""Evaluation of live tracking: latency from a whole frame received to its skeleton.

`liex evaluate live` renders up to 150 frames of a moving virtual animal, keeps them in memory and
sends them through a local socket at the camera's pace, forwards and backwards in turn. Numbers:
median and 95 % latency, ms, over every frame from the first on that came when all before it had
been answered, so that learning the background is not in it; frames measured and bridged. 60 frames
after the learning are followed beforehand, so that all is compiled. Several cameras have a process
and an animal each, as where a command is given for each of them, and begin to film together.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from liex_lab.body.skeleton import Skeleton
from liex_lab.recordings.recording import Recording
from liex_lab.recordings.streaming import replayed
from liex_lab.runtime.progress import Progress, silent
from liex_lab.simulation.simulator import world_of

from ..build import plan_of
from ..live import follow_live

if TYPE_CHECKING:
    from multiprocessing.synchronize import Barrier

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
_OF_EACH = ("latency_median_ms", "latency_p95_ms", "n_frames", "n_live", "n_measured")
_meeting: Barrier | None = None  # of a process that films beside others


def evaluate_live(
    animal: str = "fish",
    *,
    n_frames: int = 1500,
    learn_frames: int = 90,
    rate_hz: float | None = None,
    n_cameras: int = 1,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Latencies of live tracking over n frames; `liex evaluate live`.

    Args:
        animal: a bundled animal's name, or the path of a skeleton's TOML.
        n_frames: frames that each camera sends.
        learn_frames: frames that background, floor and size are learned from.
        rate_hz: frames per second that are sent, those of a motion filmed at the camera's own rate;
            None takes that.
        n_cameras: cameras that film at once.
        progress: told how far rendering and following are, where there is one camera.

    Returns:
        `rate_hz`, the numbers of `follow_live`, and the protocol; of several cameras the largest
        latencies, beside which `cameras` lists the numbers of each.
    """
    film = partial(_film, animal, n_frames, learn_frames, rate_hz)
    if n_cameras == 1:
        return {**film(_SEED, progress=progress), "protocol": LIVE_PROTOCOL}
    progress(0, None, f"filming with {n_cameras} cameras at once")
    cameras = _at_once(film, n_cameras)
    latest = {
        name: max((one[name] for one in cameras if one[name] is not None), default=None)
        for name in ("latency_median_ms", "latency_p95_ms")
    }
    told = {name: [one[name] for one in cameras] for name in _OF_EACH}
    about = {"animal": animal, "rate_hz": cameras[0]["rate_hz"], **latest}
    return {**about, "cameras": told, "protocol": LIVE_PROTOCOL}


def _film(
    animal: str,
    n_frames: int,
    learn_frames: int,
    rate_hz: float | None,
    seed: int,
    progress: Progress = silent,
) -> dict[str, Any]:
    """The numbers of one camera, which begins to film when those beside it are ready, too."""
    filmed = world_of(Skeleton.load(animal)).motion(seed, min(_KEPT, n_frames))
    kept = []
    for frame in filmed:
        kept.append(frame.depth)
        progress(frame.index + 1, len(filmed), "rendering frames")
    step_ns = round(1e9 / rate_hz) if rate_hz else int(np.median(np.diff(filmed.times_ns)))
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
    if _meeting is not None:
        _meeting.wait()
    numbers, _ = follow_live(replayed(again), plan, learn_frames=learn_frames, progress=progress)
    return {"animal": animal, "rate_hz": 1e9 / step_ns, **numbers}


def _at_once(film: Callable[..., dict[str, Any]], n: int) -> list[dict[str, Any]]:
    """The numbers of n cameras, each of which films in a process of its own."""
    import multiprocessing

    spawn = multiprocessing.get_context("spawn")
    together = (spawn.Barrier(n),)
    with ProcessPoolExecutor(n, spawn, initializer=_meet_at, initargs=together) as pool:
        return list(pool.map(partial(_film_together, film), range(_SEED, _SEED + n)))


def _film_together(film: Callable[..., dict[str, Any]], seed: int) -> dict[str, Any]:
    assert _meeting is not None
    try:
        return film(seed)
    except BaseException:
        _meeting.abort()  # the others would wait for ever
        raise


def _meet_at(barrier: Barrier) -> None:
    """Keep what the cameras' processes wait at for each other."""
    global _meeting
    _meeting = barrier


def _to_and_fro(index: int, n: int) -> int:
    """The frame (0 to n - 1) shown at a count, when n frames go forwards and backwards in turn."""
    at = index % (2 * n)
    return at if at < n else 2 * n - 1 - at
