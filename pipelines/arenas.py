"""Measurement of several arenas in one picture: a session each, in one pass over the recording.

Each frame is decoded once and handed to every arena's pipeline with all but the arena's region
unread. From there on an arena knows nothing of the others: it has its own background, floor, size,
track, checkpoint and folder, NAME-ARENA.liex, and its tables are, byte for byte, those of a run
with that region alone. An arena that cannot be measured stops no other.
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
from liex_lab.scene.region import Corners, masks_apart

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
_REMEMBERED_BYTES = 256 * 2**20  # of frames that several arenas learn their scenes from


@dataclass(frozen=True)
class ArenaOutcome:
    """What became of one arena.

    Attributes:
        name: of the arena.
        session: its session folder; None where it could not be measured.
        error: why it could not; None where it was.
    """

    name: str
    session: Path | None = None
    error: LiexError | None = None


@dataclass
class _Work:
    """One arena on its way: what it is measured by, and what became of it."""

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
        """The frames from a row on, as this arena sees them."""
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
    """Measure every arena of a recording, each into a session folder of its own.

    Unfinished sessions go on where they were. With a pool of workers the shards of each arena are
    measured arena by arena, and the recording is decoded once for each.

    Args:
        recording: a path or address, or a recording that is open already.
        plan: lists the arenas, or says 'auto'; None takes, for each arena, the bundled plan that
            fits, with the arenas that `settings` say.
        out: folder of the sessions.
        settings: changes of a plan that was not named.
        overwrite: replace sessions that are there already.
        notes: what each session.json is to hold besides.
        blueprint: makes the layout of a replay.
        report: makes the report in a folder.
        pool: pool of workers for the shards of a long recording.
        progress: told frame by frame.

    Returns:
        What became of each arena, in the plan's order.

    Raises:
        RecordingError: the recording cannot be opened or read.
        PlanError: a region is none in the picture, two overlap, or none are seen.
        SessionError: a session is there already, or another process writes it.
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
    """The settings by which a plan of several arenas becomes that of one of them.

    Args:
        arena: the arena.
        name: of its session.
    """
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
    """The arena's scene learned, its plan the one that was named or the one that fits."""
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
    """All frames from where the shortest session ended, each decoded once; then the sessions."""
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
