"""A long recording looked at in stretches, side by side: what single frames say does not depend on
their neighbours.

The track is made of all frames at once afterwards, so there is no seam: the tables are those of one
process.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from liex_lab.plan import Plan
from liex_lab.runtime.progress import Progress

from .build import build_estimator, build_recording
from .workers import Crew

if TYPE_CHECKING:
    from liex_lab.recordings.recording import Recording
    from liex_lab.sessions import Provenance
    from liex_lab.tracking.tracker import FrameTracker

LENGTH = 500  # frames of a stretch: some seconds of work, which is what an interruption costs
CHUNK = 32  # frames in memory at a time
MEASURING = "measuring poses"


@dataclass(frozen=True)
class Stretch:
    """Frames start to stop (exclusive) of a recording, and all that a worker elsewhere has to know
    to look at them.

    folder: where the result will be.
    """

    recording: str
    plan: Plan
    tracker: FrameTracker
    origin: Provenance
    folder: Path
    start: int
    stop: int

    def __getstate__(self) -> dict[str, Any]:
        """To a worker goes all but the model, which is large: it has the file, and keeps what it
        loaded.
        """
        return {**vars(self), "tracker": replace(self.tracker, estimator=None)}  # type: ignore[arg-type]

    def __setstate__(self, state: dict[str, Any]) -> None:
        tracker = replace(state["tracker"], estimator=build_estimator(state["plan"]))
        vars(self).update({**state, "tracker": tracker})


def look_at(stretch: Stretch) -> Stretch:
    """Measure a stretch and write it; the task of a worker. Done twice it does the same."""
    from liex_lab.sessions.stretches import StretchWriter

    opened = _opened(stretch.recording, stretch.plan.to_toml(), stretch.origin.input_sha256)
    first_ns = int(opened.times_ns[0]) if stretch.start else None
    with StretchWriter(stretch.folder, stretch.origin, first_ns) as writer:
        for start in range(stretch.start, stretch.stop, CHUNK):
            frames = [opened.frame(row) for row in range(start, min(start + CHUNK, stretch.stop))]
            writer.add(frames, stretch.tracker.observe(frames))
    return stretch


@lru_cache(maxsize=1)
def _opened(recording: str, plan_toml: str, input_sha256: str) -> Recording:
    """The recording, open for this process's next stretches too. input_sha256: another content is
    another recording.
    """
    return build_recording(recording, Plan.from_toml(plan_toml))


def look_side_by_side(crew: Crew, whole: Stretch, path: Path, progress: Progress) -> None:
    """Look at all frames of a recording that the unfinished session of `path` does not have yet.

    whole: the recording as one stretch, its folder does not matter. Afterwards the session goes on
    as one that was interrupted after its last frame. Whatever happens, what is whole is kept.
    """
    from liex_lab.sessions.stretches import is_whole, stretch_folder, take_over
    from liex_lab.sessions.writer import unfinished

    held = unfinished(path, whole.origin)
    try:
        held.begin_to_take()
        began = time.monotonic()
        done = held.state.n_frames
        planned = [
            replace(whole, start=start, stop=stop, folder=stretch_folder(held.folder, start, stop))
            for start, stop in _cuts(done, whole.stop)
        ]
        waiting = list(planned)
        n_looked_at = whole.stop - done
        there = [stretch for stretch in planned if is_whole(stretch.folder)]
        for stretch in _all_of(there, crew, [one for one in planned if one not in there]):
            n_looked_at -= stretch.stop - stretch.start
            while waiting and is_whole(waiting[0].folder):
                one = waiting.pop(0)
                seconds = held.seconds_before + time.monotonic() - began
                take_over(held, one.folder, one.stop, seconds)
            progress(whole.stop - n_looked_at, whole.stop, MEASURING)
    finally:
        held.leave(keep=True)


def _all_of(there: list[Stretch], crew: Crew, others: list[Stretch]) -> Iterator[Stretch]:
    yield from there
    yield from crew.each(look_at, others)


def _cuts(first: int, stop: int) -> Iterator[tuple[int, int]]:
    """Frames first to stop cut at multiples of `LENGTH`, so that a run that goes on finds the
    stretches of the last.
    """
    while first < stop:
        last = min(stop, (first // LENGTH + 1) * LENGTH)
        yield first, last
        first = last
