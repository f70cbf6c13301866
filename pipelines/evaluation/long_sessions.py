"""Sessions of any length made of a short rendered recording, to measure what grows with length.

Frames go to and fro at times that run on. What is seen in a frame is what was seen in the short
recording's frame, so hours are written, tracked and measured as in `liex run` without rendering and
segmenting them. Numbers: peak memory, MB, and seconds.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from liex_lab.plan import Plan
from liex_lab.runtime.memory import peak_memory_mb, rest

from ..build import build_tracker
from ..origin import build_provenance
from ..session import conclude

if TYPE_CHECKING:
    from liex_lab.recordings.frame import DepthFrame
    from liex_lab.recordings.recording import Recording
    from liex_lab.sessions import Provenance
    from liex_lab.sessions.writer import ReportMaker
    from liex_lab.tracking.observations import Observations
    from liex_lab.tracking.track import Subject

FPS = 30
_SHORT = "synthetic:walk?seed=5&frames=300&sensor=primesense-qvga"
# the pictures that are written: they go straight to disk, so their size does not matter here
_COARSER = 8
_CHUNK = 256  # frames

ReportStage = Callable[[str], None]


def looped(short: Recording, n_frames: int) -> Recording:
    """A recording of any length: a short one's frames, held in memory, to and fro at 30 frames/s.

    Args:
        short: the short recording.
        n_frames: length of the long one.
    """
    from liex_lab.recordings.recording import Recording

    depth = [short.frame(row).depth for row in range(len(short))]
    there = _to_and_fro(len(depth), n_frames)
    long = Recording(
        name="long",
        format="synthetic",
        camera=short.camera,
        times_ns=_times(n_frames),
        read=lambda row: depth[there[row]],
    )
    long.files.take_digest("0" * 64)
    return long


def write_long(
    minutes: float,
    out: str | Path,
    report: ReportMaker | None = None,
    told: ReportStage = lambda what: None,
) -> dict[str, Any]:
    """Write a session of so many minutes and return its cost.

    Every frame is written, tracked and measured as in `liex run`; only its observations are those
    of the short recording's frame, as measuring it again would say the same. Pictures are every 8th
    pixel.

    Args:
        minutes: length of the session.
        out: folder in which `long.liex` is written.
        report: makes the report, see `SessionWriter`.
        told: is told where the job is: `began`, `written`, `tracked`, `closed`.

    Returns:
        `peak_memory_mb` of the process and `seconds`.
    """
    from liex_lab.sessions import SessionWriter
    from liex_lab.tracking.observations import Observations
    from liex_lab.tracking.offline import track_whole

    plan = Plan.load("mouse")
    n = int(minutes * 60 * FPS)
    short = _look_at_short(plan)
    rest()
    told("began")
    began = time.perf_counter()
    with SessionWriter(
        Path(out) / "long.liex", replace(short.origin, n_frames=n), report=report
    ) as writer:
        for frames, part in _parts(short, n):
            writer.add(frames, seen=part)
        told("written")
        whole = writer.seen(Observations)
        writer.take(
            track_whole(short.subject, whole, allocate=writer.allocate), whole, short.subject
        )
        del whole
        told("tracked")
        conclude(writer, plan, {"prepare": 0.0, "track": 0.0})
    told("closed")
    return {"peak_memory_mb": peak_memory_mb(), "seconds": time.perf_counter() - began}


@dataclass(frozen=True)
class _Short:
    """A short recording: coarser pictures of its frames, what was seen in them, and of whom."""

    depth: list[np.ndarray[Any, Any]]
    seen: Observations
    subject: Subject
    origin: Provenance


def _look_at_short(plan: Plan) -> _Short:
    """Render and measure the short recording; its full pictures are not kept."""
    from liex_lab.recordings import open_recording
    from liex_lab.tracking.observations import Observations

    with open_recording(_SHORT) as opened:
        short = looped(opened, len(opened))
    tracker = build_tracker(short, plan)
    seen = Observations.join([tracker.observe(frames) for frames in short.chunks(32)])
    camera = short.camera.every(_COARSER)
    depth = [np.ascontiguousarray(frame.depth[::_COARSER, ::_COARSER]) for frame in short]
    origin = replace(build_provenance(short, plan, tracker), camera=camera, gaps=())
    return _Short(depth, seen, replace(tracker.subject, camera=camera), origin)


def _parts(short: _Short, n: int) -> Iterator[tuple[list[DepthFrame], Observations]]:
    """The frames of a long recording, coarser, and what is seen in them."""
    from liex_lab.recordings.frame import DepthFrame
    from liex_lab.tracking.observations import COLUMNS, Observations

    there = _to_and_fro(len(short.depth), n)
    times_ns = _times(n)
    for start in range(0, n, _CHUNK):
        rows = there[start : start + _CHUNK]
        times = times_ns[start : start + _CHUNK]
        columns = {name: getattr(short.seen, name)[rows] for name in COLUMNS} | {"times_ns": times}
        frames = [
            DepthFrame(start + k, int(times[k]), short.depth[row]) for k, row in enumerate(rows)
        ]
        yield frames, Observations(short.seen.skeleton, **columns)


def _to_and_fro(n_short: int, n: int) -> np.ndarray[Any, Any]:
    """(n,) which frame of the short recording each one is."""
    return np.resize([*range(n_short), *range(n_short - 2, 0, -1)], n)


def _times(n: int) -> np.ndarray[Any, Any]:
    return np.arange(n, dtype=np.int64) * int(1e9 / FPS)
