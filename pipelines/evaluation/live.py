"""Latency of live tracking and of its triggers: `liex evaluate live`.

It renders up to 150 frames of a moving virtual animal, or 600 of several that interact, keeps them
in memory and sends them through a local socket at the camera's pace, forwards and backwards:
median, 95 % and largest latency, ms, of all frames since the first one that arrived after its
predecessors were processed, which excludes learning the background.

With rules, a message of each of them is sent for every frame, and another process receives it by
UDP: `message_p95_ms` is from the arrival of the frame to that of its message, of the same frames.
Their agreement with the finished session is measured on a second, uninterrupted recording of as
many frames, each of which is followed as soon as it is rendered.
"""

import multiprocessing
import socket
import tempfile
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing.connection import Connection
from threading import Barrier
from typing import Any

import numpy as np

from liex_lab.behaviour.triggers import Onsets, Rule
from liex_lab.body.skeleton import Skeleton
from liex_lab.errors import LiexError
from liex_lab.recordings import streaming
from liex_lab.runtime.progress import Progress, silent
from liex_lab.simulation.scenes.groups import KINDS, film_group
from liex_lab.simulation.simulator import world_of

from ..build import plan_of
from ..live import track_live
from ..session import run_session
from ..triggers import Triggers, TriggerWatch
from .speed import looped

LIVE_PROTOCOL = (
    "Frames are rendered beforehand, kept in memory, and sent through a socket of this machine at "
    "the camera's pace, forwards and backwards in turn. latency: from when a whole frame had come "
    "to when its skeleton was reported, without a viewer; counted from the first frame on that "
    "came when all before it had been reported, so that learning the background is not in it, and "
    "from then on every frame. Some frames are followed beforehand, so that all is compiled."
)
_SEED = 78_001


def evaluate_live(
    animal: str = "fish",
    *,
    n_frames: int = 1500,
    learn_frames: int = 90,
    rate_hz: float | None = None,
    n_cameras: int = 1,
    n_animals: int = 1,
    rules: Sequence[str] = (),
    progress: Progress = silent,
) -> dict[str, Any]:
    """Latencies of live tracking over n frames; `liex evaluate live`.

    Args:
        animal: a bundled animal's name, or the path of a skeleton's TOML.
        n_frames: frames that each camera sends.
        learn_frames: frames that background, floor and size are learned from.
        rate_hz: frames per second that are sent; None means the camera's own rate.
        n_cameras: number of simultaneous cameras, each in a separate process.
        n_animals: mice or fish in one arena that interact.
        rules: triggers of one camera, see `liex_lab.behaviour.triggers`.
        progress: called with the progress of rendering and tracking, if there is one camera.

    Returns:
        `rate_hz`, the numbers of `track_live`, and the protocol; of several cameras the largest
        latencies, and in `cameras` the numbers of each. With rules also `message_median_ms` and
        `message_p95_ms`, from the arrival of a frame to that of its message in another process,
        `n_messages`, and in `triggers` the agreement with the finished session.
    """
    if n_animals > 1 and (animal not in KINDS or rules):
        raise LiexError(
            "several animals are mice or fish without triggers in this evaluation; state --animal "
            "mouse or fish, and measure triggers of one animal"
        )
    if rules:
        film = partial(_film, animal, n_frames, learn_frames, rate_hz, _SEED, progress=progress)
        return {**_triggered(animal, n_frames, rules, film, progress), "protocol": LIVE_PROTOCOL}
    film = partial(_film, animal, n_frames, learn_frames, rate_hz, n_animals=n_animals)
    if n_cameras == 1:
        return {**film(_SEED, progress=progress), "protocol": LIVE_PROTOCOL}
    progress(0, None, f"filming with {n_cameras} cameras at once")
    spawn = multiprocessing.get_context("spawn")
    with spawn.Manager() as manager, ProcessPoolExecutor(n_cameras, spawn) as pool:
        cameras = list(
            pool.map(
                partial(film, ready=manager.Barrier(n_cameras)), range(_SEED, _SEED + n_cameras)
            )
        )
    numbers = {
        name: [one[name] for one in cameras]
        for name in ("latency_median_ms", "latency_p95_ms", "n_frames", "n_live", "n_measured")
    }
    latest = {
        name: max((one for one in numbers[name] if one is not None), default=None)
        for name in ("latency_median_ms", "latency_p95_ms")
    }
    return {
        "animal": animal,
        "rate_hz": cameras[0]["rate_hz"],
        **latest,
        "cameras": numbers,
        "protocol": LIVE_PROTOCOL,
    }


def _film(
    animal: str,
    n_frames: int,
    learn_frames: int,
    rate_hz: float | None,
    seed: int,
    n_animals: int = 1,
    ready: Barrier | None = None,
    watches: Callable[[], TriggerWatch] | None = None,
    progress: Progress = silent,
) -> dict[str, Any]:
    """The numbers of one camera, which starts when all cameras are ready."""
    try:
        # frames rendered
        progress(0, None, "rendering frames")
        filmed = (
            world_of(Skeleton.load(animal)).motion(seed, min(150, n_frames))
            if n_animals == 1
            else film_group(seed, min(600, n_frames), animal=animal, animals=n_animals)[0]
        )
        step_ns = round(1e9 / rate_hz) if rate_hz else int(np.median(np.diff(filmed.times_ns)))
        arriving = looped(filmed, n_frames, f"live-{animal}", step_ns)
        plan = plan_of(animal).with_settings([f"animal.count={n_animals}"])
        # 60 frames tracked beforehand, a thousand times as fast
        track_live(
            streaming.replayed(arriving[: learn_frames + 60], 1000.0),
            plan,
            learn_frames=learn_frames,
            watch=watches and watches(),
        )
        if ready is not None:
            ready.wait()
    except BaseException:
        if ready is not None:
            ready.abort()  # the others would wait forever
        raise
    numbers, _ = track_live(
        streaming.replayed(arriving),
        plan,
        learn_frames=learn_frames,
        watch=watches and watches(),
        progress=progress,
    )
    return {"animal": animal, "rate_hz": 1e9 / step_ns, **numbers}


def _triggered(
    animal: str,
    n_frames: int,
    rules: Sequence[str],
    film: Callable[..., dict[str, Any]],
    progress: Progress,
) -> dict[str, Any]:
    """The numbers of a camera whose messages another process receives, and the agreement."""
    plan = plan_of(animal)
    spawn = multiprocessing.get_context("spawn")
    here, there = spawn.Pipe()
    receiver = spawn.Process(target=_receive, args=(there,), daemon=True)
    receiver.start()
    port = here.recv()
    watches: list[TriggerWatch] = []

    def watch() -> TriggerWatch:
        watches.append(_EveryFrame(Triggers(tuple(rules), (f"udp://127.0.0.1:{port}",)), plan))
        return watches[-1]

    numbers = film(watches=watch)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as link:
        link.sendto(b"", ("127.0.0.1", port))
    received_ns = here.recv()
    receiver.join()
    sent = [one for each in watches for one in each.events if one["outcome"] == "sent"]
    every_ms = [
        event["latency_ms"] + 1e-6 * (at_ns - event["sent_time_ns"])
        for event, at_ns in zip(sent, received_ns, strict=True)
    ]
    ms = every_ms[len(every_ms) - numbers["n_live"] * len(rules) :]
    quantiles = np.quantile(ms, [0.5, 0.95]).tolist() if ms else [None, None]
    numbers |= dict(zip(("message_median_ms", "message_p95_ms"), quantiles, strict=True))
    whole = world_of(Skeleton.load(animal)).motion(_SEED + 1, n_frames)
    arrivals = (streaming.Arrival(frame, time.perf_counter()) for frame in whole)
    follower = TriggerWatch(Triggers(tuple(rules)), plan)
    arriving = streaming.Arriving(whole.name, whole.camera, arrivals)
    track_live(arriving, plan, watch=follower, progress=progress)
    follower.close()
    with tempfile.TemporaryDirectory() as folder:
        run_session(whole, plan, folder, further=follower, report=False, progress=progress)
    return {**numbers, "n_messages": len(ms), "triggers": follower.accounts}


class _EveryFrame(TriggerWatch):
    """Sends a message of every rule for each frame, whether the rule holds or not."""

    def _new_onsets(self, rule: Rule) -> Onsets:
        return _Always()


class _Always(Onsets):
    def add(self, time_s: float, on: bool, off: bool) -> bool:
        return True


def _receive(report: Connection) -> None:
    """Report a free port, and when an empty message has come the times of all others, ns."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as link:
        link.bind(("127.0.0.1", 0))
        report.send(link.getsockname()[1])
        times = []
        while link.recv(4096):
            times.append(time.time_ns())
        report.send(times)
