"""Sharded measurement of one long recording: spans of frames, measured in parallel.

Single-frame observations do not depend on neighbouring frames, and the track is made of all frames
at once afterwards; so there are no seams, and the tables are those of one process. Shards begin at
multiples of `LENGTH` frames and have folders of their own until they are appended in order, so an
interruption only costs the shards in progress.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any

from liex_lab.plan import Plan
from liex_lab.recordings.frame import FrameRooms
from liex_lab.runtime.progress import Progress

from .build import build_estimator, build_recording
from .workers import WorkerPool

if TYPE_CHECKING:
    from liex_lab.recordings.recording import Recording
    from liex_lab.sessions import Provenance
    from liex_lab.tracking.tracker import FrameTracker

LENGTH = 500  # frames per shard: some seconds of work, the cost of an interruption
CHUNK = 32  # frames in memory at a time
MEASURING = "measuring poses"


@dataclass(frozen=True)
class Shard:
    """A span of frames of a recording, with all that a remote worker needs to measure it.

    Attributes:
        recording: path or address of the recording.
        plan: how it is measured.
        tracker: the prepared tracker; a pickle omits its estimator, which is large.
        origin: provenance of the session.
        folder: folder of the result.
        start: first frame.
        stop: frame after the last one.
    """

    recording: str
    plan: Plan
    tracker: FrameTracker
    origin: Provenance
    folder: Path
    start: int
    stop: int

    def __getstate__(self) -> dict[str, Any]:
        """State without the large model: a worker loads it from the file and caches it."""
        return {**vars(self), "tracker": replace(self.tracker, estimator=None)}  # type: ignore[arg-type]

    def __setstate__(self, state: dict[str, Any]) -> None:
        tracker = replace(state["tracker"], estimator=build_estimator(state["plan"]))
        vars(self).update({**state, "tracker": tracker})


def measure_shard(shard: Shard) -> Shard:
    """Measure a shard and write it: the task of a worker. It may safely run twice.

    Returns:
        The same shard, once its folder is complete.
    """
    from liex_lab.sessions.writer import shard_writer

    opened = _opened(shard.recording, shard.plan.to_toml(), shard.origin.input_sha256)
    first_ns = int(opened.times_ns[0]) if shard.start else None
    rooms = FrameRooms()
    coming = opened.frames(shard.start, shard.stop)
    with shard_writer(shard.folder, shard.origin, first_ns) as add:
        while frames := rooms.filled(coming, CHUNK):
            add(frames, shard.tracker.observe(frames))
    return shard


@lru_cache(maxsize=1)
def _opened(recording: str, plan_toml: str, input_sha256: str) -> Recording:
    """The recording, kept open for this process's next shards; the hash distinguishes versions."""
    return build_recording(recording, Plan.from_toml(plan_toml))


def measure_shards(pool: WorkerPool, whole: Shard, path: Path, progress: Progress) -> None:
    """Measure all frames of a recording that its unfinished session lacks.

    Afterwards the session resumes as if interrupted after its last frame. Completed shards are
    kept, even after an error.

    Args:
        pool: the worker pool.
        whole: the recording as one shard; its folder is not used.
        path: the planned session folder; the unfinished session is next to it.
        progress: called shard by shard.

    Raises:
        SessionError: a worker died, or another process writes the session.
    """
    from liex_lab.sessions.writer import append_shard, is_whole, open_unfinished, shard_folder

    held = open_unfinished(path, whole.origin)
    try:
        held.begin_shards()
        began = time.monotonic()
        done = held.state.n_frames
        planned = [
            replace(whole, start=start, stop=stop, folder=shard_folder(held.folder, start, stop))
            for start, stop in _cuts(done, whole.stop)
        ]
        waiting = list(planned)
        n_left = whole.stop - done
        there = [shard for shard in planned if is_whole(shard.folder)]
        others = [shard for shard in planned if shard not in there]
        for shard in chain(there, pool.each(measure_shard, others)):
            n_left -= shard.stop - shard.start
            while waiting and is_whole(waiting[0].folder):
                one = waiting.pop(0)
                seconds = round(held.seconds_before + time.monotonic() - began, 3)
                append_shard(held, one.folder, one.stop, seconds)
            progress(whole.stop - n_left, whole.stop, MEASURING)
    finally:
        held.leave(keep=True)


def _cuts(first: int, stop: int) -> Iterator[tuple[int, int]]:
    """Frames first to stop cut at multiples of `LENGTH`, the same shards in every run."""
    while first < stop:
        last = min(stop, (first // LENGTH + 1) * LENGTH)
        yield first, last
        first = last
