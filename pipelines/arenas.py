"""Measurement of several arenas in one recording: a session per arena, in one pass.

Each frame is decoded once; every arena's pipeline gets it with all pixels outside the arena's
region unread. The arenas are otherwise independent: each has its own background, floor, size,
track, checkpoint and folder, NAME-ARENA.liex, and its tables are byte-identical to those of a run
with that region alone. If one arena fails, the others continue.
"""

from __future__ import annotations

import json
import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from liex_lab.errors import LiexError, RecordingError
from liex_lab.plan import Plan
from liex_lab.plan.plan import toml_value
from liex_lab.plan.sections import SeveralArenas
from liex_lab.recordings.frame import DepthFrame
from liex_lab.recordings.recording import Recording
from liex_lab.recordings.timestamps import unwritable_times
from liex_lab.runtime.places import inside
from liex_lab.runtime.progress import Progress, silent
from liex_lab.scene.zones import Corners, masks_apart

from .build import build_recording
from .choice import USUAL, fit_plan
from .compiling import compile_ahead
from .regions import arenas_of, stated_corners
from .session import Prepared, check_unused, prepare, read_ahead
from .shards import MEASURING
from .workers import WorkerPool

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from liex_lab.sessions import SessionWriter
    from liex_lab.sessions.writer import BlueprintMaker, ReportMaker

_FACTS = ("individual", "subject_id", "group", "cage", "sex", "batch", "species", "age")
_REMEMBERED_BYTES = 256 * 2**20  # memory for frames that the arenas share to learn their scenes


@dataclass(frozen=True)
class ArenaOutcome:
    """Result of one arena.

    Attributes:
        name: of the arena.
        session: its session folder; None if it could not be measured.
        error: why it could not be measured; None if it was.
    """

    name: str
    session: Path | None = None
    error: LiexError | None = None


@dataclass
class _Work:
    """One arena in progress: its settings and its result."""

    arena: SeveralArenas
    settings: tuple[str, ...]
    region_px: Corners
    inside: NDArray[np.bool_]
    folder: Path
    prepared: Prepared | None = None
    writer: SessionWriter | None = None
    error: LiexError | None = None
    session: Path | None = None

    def view(self, frames: Sequence[DepthFrame], first: int) -> list[DepthFrame]:
        """The frames from index `first` on, with all but the arena's region unread."""
        import numpy as np

        return [
            DepthFrame(
                frame.index, frame.time_ns, np.where(self.inside, frame.depth, np.float32(0))
            )
            for frame in frames
            if frame.index >= first
        ]


def measure_arenas(
    recording: str | Path | Recording,
    plan: Plan | None,
    out: str | Path,
    *,
    settings: Sequence[str] = (),
    overwrite: bool = False,
    notes: Mapping[str, Any] | None = None,
    blueprint: BlueprintMaker | None = None,
    report: ReportMaker | None = None,
    pool: WorkerPool | None = None,
    progress: Progress = silent,
) -> list[ArenaOutcome]:
    """Measure every arena of a recording, each into its own session folder.

    Unfinished sessions resume. With a worker pool the arenas are measured one after the other, each
    in shards, and the recording is decoded once per arena.

    Args:
        recording: a path or address, or an open recording.
        plan: lists the arenas, or states 'auto'; None uses, for each arena, the bundled plan that
            fits, with the arenas that `settings` state.
        out: folder of the sessions.
        settings: changes to the plan if none was named.
        overwrite: replace existing sessions.
        notes: additional contents of each session.json.
        blueprint: makes the layout of a replay.
        report: makes the report in a folder.
        pool: workers for the shards of a long recording.
        progress: called frame by frame.

    Returns:
        The result of each arena, in the plan's order.

    Raises:
        RecordingError: the recording cannot be opened or read.
        PlanError: a region lies outside the image, two overlap, or no arena is found.
        SessionError: a session exists already, or another process writes it.
    """
    first = plan or Plan.load(USUAL).with_settings(settings)
    with build_recording(recording, first, progress) as opened:
        if told := unwritable_times(opened.times_ns):
            raise RecordingError(f"of {opened.name} {told}")
        compile_ahead(first.animal.skeleton, progress)
        shared = opened.remembering(_REMEMBERED_BYTES)
        arenas = arenas_of(shared, first)
        corners = {one.name: stated_corners(shared, first, one.region) for one in arenas}
        within = masks_apart(corners, opened.width, opened.height)
        base = first.session.name or opened.name
        works = []
        for one in arenas:
            name = f"{base}-{one.name}"
            folder = inside(Path(out), name, ".liex")
            check_unused(folder, overwrite)
            chosen = arena_settings(one, name)
            works.append(_Work(one, chosen, corners[one.name], within[one.name], folder))
        for work in works:
            named = plan.with_settings(work.settings) if plan else None
            try:
                work.prepared = _prepare(work, named, settings, shared, progress)
                if pool is not None and isinstance(recording, str | Path):
                    work.prepared.measure_by(pool, recording, progress)
            except LiexError as error:
                work.error = error
        going = [work for work in works if work.prepared is not None and work.error is None]
        _measure(going, shared, recording, overwrite, notes, blueprint, report, progress)
    return [ArenaOutcome(work.arena.name, work.session, work.error) for work in works]


def arena_settings(arena: SeveralArenas, name: str) -> tuple[str, ...]:
    """The settings that turn a plan of several arenas into that of one arena's session, `name`."""
    told = ["arenas=", f"arena.region={toml_value(arena.region)}", f"session.name={_text(name)}"]
    for fact in _FACTS:
        if (value := getattr(arena, fact)) is not None:
            told.append(f"session.{fact}={_text(value)}")
    if arena.zones is not None:
        told.append(f"arena.zones={_text(arena.zones)}")
    if arena.spine_mm is not None:
        told.append(f"animal.spine_mm={arena.spine_mm!r}")
    return tuple(told)


def _text(value: str) -> str:
    return json.dumps(value, ensure_ascii=False)


def _prepare(
    work: _Work,
    named: Plan | None,
    settings: Sequence[str],
    shared: Recording,
    progress: Progress,
) -> Prepared:
    """Learn the arena's scene with the named plan, or with the one that fits."""
    started = time.perf_counter()
    progress(0, None, f"learning the background and the animal's size in {work.arena.name}")
    chosen = [*settings, *work.settings]
    first = named or Plan.load(USUAL).with_settings(chosen)
    seen = shared.masked(work.region_px, lent=True)
    fitted = fit_plan(seen, first, settings=None if named else chosen, progress=progress)
    return prepare(fitted, work.folder, started, progress)


def _measure(
    works: Sequence[_Work],
    shared: Recording,
    source: str | Path | Recording,
    overwrite: bool,
    notes: Mapping[str, Any] | None,
    blueprint: BlueprintMaker | None,
    report: ReportMaker | None,
    progress: Progress,
) -> None:
    """Measure all frames from the end of the shortest session on, then finish the sessions."""
    from liex_lab.sessions import SessionWriter

    if not works:
        return
    with ExitStack() as stack:
        for work in works:
            assert work.prepared is not None
            work.writer = stack.enter_context(
                SessionWriter(
                    work.folder,
                    work.prepared.origin,
                    overwrite=overwrite,
                    blueprint=blueprint,
                    report=report,
                )
            )
            work.writer.resume(partial(_depth, work.prepared.recording))
        done = [(work, work.writer.n_frames) for work in works if work.writer is not None]
        with closing(read_ahead(shared, min(n for _, n in done))) as chunks:
            for frames in chunks:
                for work, first in done:
                    own = work.view(frames, first)
                    if own and work.prepared is not None and work.writer is not None:
                        work.prepared.measure(own, work.writer)
                progress(frames[-1].index + 1, len(shared), MEASURING)
        for work in works:
            if work.prepared is not None and work.writer is not None:
                work.session = work.prepared.finish(work.writer, source, notes).path


def _depth(recording: Recording, row: int) -> NDArray[np.float32]:
    return recording.frame(row).depth
