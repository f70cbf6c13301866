"""Live tracking: skeletons of a recording that goes on, and its smoothed track in the end.

`liex live` learns background, floor and size from the first frames that arrive, then measures each
frame and passes it to the online tracker, which has no lag; frames that have waited are measured in
batches. When the recording is over, the offline tracker makes the track of the whole.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from itertools import chain, islice, tee
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from liex_lab.errors import RecordingError
from liex_lab.plan import Plan
from liex_lab.recordings.frame import marked
from liex_lab.runtime.progress import Progress, silent

from .build import build_recording, build_tracker

if TYPE_CHECKING:
    from liex_lab.recordings.recording import Recording
    from liex_lab.recordings.streaming import Arrival, Arriving
    from liex_lab.tracking.track import Track, Tracked
    from liex_lab.tracking.tracker import FrameTracker

# that are waited for: the background, the floor and the animal's size are learned from them
LEARN_FRAMES = 90
_AT_ONCE = 16
_LONG_S = 0.2
Viewer = Callable[["FrameTracker", "Arriving"], Any]


def open_live(
    source: str, plan: Plan, *, replay: bool = False, patience_s: float = 3.0
) -> Arriving:
    """What arrives at a source: a growing file, a network address, or a replayed recording.

    Args:
        source: path of a file or folder that is being written, or HOST:PORT.
        plan: how recordings are opened; one that is cut short is accepted.
        replay: send the recording at `source` at its own pace instead.
        patience_s: a growing file is over when nothing has come for so long, s.
    """
    from liex_lab.recordings.streaming import growing, received, replayed

    partial = plan.with_settings(["recording.accept_truncated=true"])
    if replay:
        return replayed(build_recording(source, plan))
    host, colon, port = source.rpartition(":")
    if colon and port.isdigit() and not Path(source).exists():
        return received(host, int(port))
    return growing(lambda: build_recording(source, partial), patience_s)


def follow_live(
    arriving: Arriving,
    plan: Plan,
    *,
    learn_frames: int = LEARN_FRAMES,
    viewer: Viewer | None = None,
    progress: Progress = silent,
) -> tuple[dict[str, Any], Tracked]:
    """Latencies and the smoothed track of a recording whose skeletons are shown as its frames come.

    Latency is from when a frame was there to when its skeleton was known, of every frame from the
    first on that came when all before it had been answered: until then what was missed while
    learning is made up for.

    Args:
        arriving: name, camera and frames as they come.
        plan: how the recording is measured.
        learn_frames: frames that background, floor and size are learned from.
        viewer: makes a viewer from tracker and source, which is shown each frame with its row.
        progress: reports frame by frame.

    Returns:
        `name`, `n_frames`, `n_live`, `latency_median_ms`, `latency_p95_ms` (None without live
        frames), `n_measured` and `n_bridged`; and the track with its head-tail flips.

    Raises:
        RecordingError: the recording was over before it had a frame.
        EstimationError: no animal is found in the frames that are learned from.
    """
    from liex_lab.tracking.observations import Observations
    from liex_lab.tracking.online import OnlineTracker

    frames = arriving.frames
    held = list(islice(frames, learn_frames))
    if not held:
        raise RecordingError("the recording was over before it had a frame")
    progress(0, None, "learning the background, the floor and the animal's size")
    tracker = build_tracker(_as_recording(arriving, held), plan)
    online = OnlineTracker(tracker.subject)
    view = viewer(tracker, arriving) if viewer else None
    seen = []
    latency = list[float]()
    worked_until = time.perf_counter()
    keeping_up = False
    for some in _together(_chained(held, frames)):
        keeping_up = keeping_up or some[0].at_s >= worked_until
        estimates = tracker.observe([arrival.frame for arrival in some])
        for k, arrival in enumerate(some):
            seen.append(estimates[k : k + 1])
            row: Track | None = online.add(seen[-1])
            if view is not None and row is not None:
                view.show(arrival.frame, row)
            worked_until = time.perf_counter()
            if keeping_up:
                latency.append(worked_until - arrival.at_s)
            progress(len(seen), None, "following")
    if view is not None:
        view.close()
    tracked = tracker.track(Observations.join(seen))
    quantiles = (np.quantile(latency, [0.5, 0.95]) * 1e3).tolist() if latency else [None, None]
    numbers = {
        "name": arriving.name,
        "n_frames": len(seen),
        "n_live": len(latency),
        "latency_median_ms": quantiles[0],
        "latency_p95_ms": quantiles[1],
        "n_measured": int(tracked.track.observed.sum()),
        "n_bridged": int(tracked.track.bridged.sum()),
    }
    return numbers, tracked


def _chained(held: list[Arrival], frames: Iterator[Arrival]) -> Iterator[Arrival]:
    """All arrivals, their frames marked where they repeat the one before."""
    arrivals, again = tee(chain(held, frames))
    for frame, arrival in zip(marked(one.frame for one in again), arrivals, strict=True):
        yield arrival._replace(frame=frame)


def _together(arrivals: Iterator[Arrival]) -> Iterator[list[Arrival]]:
    """Frames in batches of up to 16 where they have waited, each alone where they are fresh.

    Together each costs half.
    """
    some: list[Arrival] = []
    for arrival in arrivals:
        some.append(arrival)
        if len(some) == _AT_ONCE or time.perf_counter() - arrival.at_s < _LONG_S:
            yield some
            some = []
    if some:
        yield some


def _as_recording(arriving: Arriving, held: list[Arrival]) -> Recording:
    """The frames that have come, as a recording."""
    from liex_lab.recordings.recording import Recording

    times = np.array([arrival.frame.time_ns for arrival in held], np.int64)
    return Recording(
        name=arriving.name,
        format="live",
        camera=arriving.camera,
        times_ns=times,
        read=lambda index: held[index].frame.depth,
    )
