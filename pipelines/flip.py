"""The job `liex flip`: a human says that head and tail are exchanged in a span, and everything follows."""

from __future__ import annotations

import shutil
import tempfile
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from liex_lab.pipelines.session import conclude
from liex_lab.pipelines.stretches import CHUNK

from liex_lab.errors import SessionError
from liex_lab.plan import Plan
from liex_lab.progress import Progress, silent
from liex_lab.tracking.track import Flip

if TYPE_CHECKING:
    from liex_lab.sessions import Session
    from liex_lab.sessions.writer import BlueprintMaker, ReportMaker

_ROUNDED_S = 5e-4  # times are typed with three decimals
ORIGINAL = "as_tracked"  # the folder in which the tables stay that no human has touched


def flip_span(
    session: str | Path,
    start_s: float,
    stop_s: float,
    *,
    undo: bool = False,
    blueprint: BlueprintMaker | None = None,
    report: ReportMaker | None = None,
    progress: Progress = silent,
) -> Path:
    """Exchange head and tail from start_s to stop_s (exclusive) in a session, or take such a correction back.

    The track is made again from what the single frames said, then every table, the replays and the report. The tables
    as they were tracked stay in the folder `as_tracked`; flips.parquet lists every correction, also those taken back.
    """
    from liex_lab.recordings import open_recording
    from liex_lab.recordings.frame import DepthFrame
    from liex_lab.sessions import Session
    from liex_lab.sessions.evidence import provenance_of, read_corrections, read_evidence
    from liex_lab.tracking.curve import track_whole

    opened = Session.open(session)
    seen, subject = read_evidence(opened)
    span = _rows(opened, start_s, stop_s)
    corrections = _changed(read_corrections(opened), span, undo)
    tracked = track_whole(subject, seen, corrections)
    origin = provenance_of(opened, subject.skeleton)
    with tempfile.TemporaryDirectory(dir=opened.path.parent, prefix=".flip-") as room:
        original = _set_aside(opened, Path(room) / ORIGINAL)
        with (
            open_recording(opened.path / "session.mcap") as recording,
            Session.create(opened.path, origin, overwrite=True, blueprint=blueprint, report=report) as writer,
        ):
            index = opened.frames["frame_index"].to_numpy()
            for frames in recording.chunks(CHUNK):
                rows = [frame.index for frame in frames]
                writer.add([DepthFrame(int(index[i]), f.time_ns, f.depth) for i, f in zip(rows, frames, strict=True)])
                progress(rows[-1] + 1, len(recording), "writing the session anew")
            writer.take(tracked, seen, subject)
            writer.keep(original)
            conclude(writer, Plan.from_toml(opened.plan), {"track": 0.0})
    return opened.path


def _rows(session: Session, start_s: float, stop_s: float) -> tuple[int, int]:
    """The rows of a span given in seconds."""
    time_s = session.frames["time_s"].to_numpy()
    first, last = (int(np.searchsorted(time_s, at - _ROUNDED_S)) for at in (start_s, stop_s))
    if not (start_s < stop_s and first < last):
        raise SessionError(
            f"a span to flip is from a time to a later one, in seconds since the first frame, and holds a frame; got "
            f"{start_s:g} to {stop_s:g} in a session of 0 to {time_s[-1]:.3f} s"
        )
    return first, last


def _changed(corrections: list[Flip], span: tuple[int, int], undo: bool) -> list[Flip]:
    """The corrections with a new one, or with those that lie within the span taken back."""
    if not undo:
        return [*corrections, Flip(*span, 1.0, True, "human")]
    now = datetime.now(UTC).isoformat(timespec="seconds")
    within = [not f.undone_at and span[0] <= f.start and f.stop <= span[1] for f in corrections]
    if not any(within):
        raise SessionError("no correction that a human made lies within this span; flips.parquet lists them")
    return [replace(f, undone_at=now) if taken else f for f, taken in zip(corrections, within, strict=True)]


def _set_aside(session: Session, room: Path) -> Path:
    """A copy of the tables as they were tracked, before any human's correction."""
    before = session.path / ORIGINAL
    if before.is_dir():
        return Path(shutil.copytree(before, room))
    room.mkdir()
    for path in (*session.path.glob("*.parquet"), session.path / "summary.csv", session.path / "session.json"):
        if path.is_file():
            shutil.copy2(path, room)
    return room
