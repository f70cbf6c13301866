"""A session's times on the clock of another instrument: `liex sync`."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from liex_lab.arrays import Array
from liex_lab.errors import SessionError
from liex_lab.exchange.clocks import Alignment, align, align_pairs, check_times
from liex_lab.exchange.pulses import read_pulses, rises
from liex_lab.plan import Plan
from liex_lab.recordings.recording import Recording
from liex_lab.runtime import text_files
from liex_lab.runtime.progress import Progress, silent
from liex_lab.sessions import Session
from liex_lab.sessions.clock import ClockFit, fingerprint
from liex_lab.sessions.corrections import read_log

from .build import open_planned
from .correct import correct_session
from .drawing import recording_of

Patch = tuple[int, int, int, int]
_KEPT = 200  # parts of a session, of each of which two residuals are kept


def sync_session(
    session: str | Path,
    other: str | Path | None = None,
    *,
    channel: str = "",
    pulses: str | Path | None = None,
    patch: Patch | None = None,
    infrared: str | None = None,
    pairs: str | Path | None = None,
    first: bool = False,
    events: str | Path | None = None,
    author: str = "",
    report: bool = True,
    progress: Progress = silent,
) -> ClockFit:
    """Put a session's times on the clock of another instrument.

    The clocks are aligned by events that both recorded, see `liex_lab.exchange.clocks`. The tables
    `frames` and `bouts` get columns of the other clock. Again with other events, the last call
    counts; `liex correct undo` takes it back.

    Args:
        session: the session folder.
        other: the file of the other instrument, see `liex_lab.exchange.pulses`; None if the pairs
            alone count.
        channel: its channel; "" if it has one.
        pulses: file of the events on the session's clock, s since the first frame; None for `patch`
            or, without it, one event for each frame.
        patch: columns and rows (left, top, right, bottom) px of a part of the depth image in which
            an event lowers the mean depth, as an LED that blinds the camera does (unread is 0), or
            a flag; of the images as recorded, and the recording is read.
        infrared: topic of the recording with 16-bit infrared images, in which the patch is sought
            instead, and an event raises its mean; None for depth.
        pairs: table of moments known on both clocks, columns time_s and other_s.
        first: whether the first events of both sides are the same.
        events: table of events of the other instrument, columns event and time_s (on its clock, s);
            they become the table `events`.
        author: author of the change; "" uses the current account.
        report: whether to regenerate report and figures.
        progress: receives progress reports.

    Raises:
        SyncError: the events fit nowhere or in several ways, or a clock jumps.
        SessionError: nothing to align is stated, or another program is changing the session.
        LiexError: a file cannot be read.
    """
    raw = Session.open(session, raw=True)
    stated = _stated(pairs)
    frames = raw.table("frames", ["time_ns", "time_s"])
    first_ns = int(frames["time_ns"].iloc[0])
    if other is None:
        if not len(stated):
            raise SessionError(
                "nothing to align: name the other instrument's file (--with) or pairs (--pairs)"
            )
        found, source, name = align_pairs(stated), "stated pairs", Path(str(pairs)).name
        own_s = stated[:, 0]
    else:
        time_s = frames["time_s"].to_numpy(float)
        own_s, source = _own_events(raw, time_s, first_ns, pulses, patch, infrared, progress)
        own_s = check_times(own_s, source)
        other_s = check_times(read_pulses(other, channel), str(other))
        if first:
            stated = np.vstack([stated, [own_s[0], other_s[0]]])
        found, name = align(own_s, other_s, stated), Path(other).name
    fit = _record(found, own_s, frames["time_ns"], name, source)
    fit = replace(fit, events=_events_of(events))
    known = read_log(raw.path).clock == fit
    what = () if known else (fit,)
    correct_session(raw.path, what, author=author, report=report, progress=progress)
    return fit


def _stated(pairs: str | Path | None) -> Array:
    """Stated pairs (p, 2) s; none without a file."""
    if pairs is None:
        return np.zeros((0, 2))
    columns = [read_pulses(pairs, name) for name in ("time_s", "other_s")]
    return np.stack(columns, axis=-1)


def _events_of(path: str | Path | None) -> tuple[tuple[str, float], ...]:
    """Names and times, s, of a table of events; none without a file."""
    if path is None:
        return ()
    times = read_pulses(path, "time_s")
    names = text_files.read_texts(Path(path)).get("event")
    if names is None or not len(times) or not np.isfinite(times).all():
        raise SessionError(
            f"{path} should hold events, a row each, with their name (column event) and time in "
            "seconds (column time_s)"
        )
    return tuple(zip(map(str, names), times.tolist(), strict=True))


def _own_events(
    session: Session,
    time_s: Array,
    first_ns: int,
    pulses: str | Path | None,
    patch: Patch | None,
    infrared: str | None,
    progress: Progress,
) -> tuple[Array, str]:
    """Events on the session's clock, s since the first frame, and their source."""
    if pulses is not None:
        return read_pulses(pulses), Path(pulses).name
    if patch is None:
        if infrared is not None:
            raise SessionError("of infrared images the mean of a patch counts; state it (--patch)")
        return time_s, "one event per frame"

    def opened(where: str, plan: Plan, progress: Progress) -> Recording:
        stated = plan if infrared is None else plan.with_settings([f"recording.topic={infrared}"])
        return open_planned(where, stated, progress)

    left, top, right, bottom = patch
    stamps_ns: list[int] = []
    means: list[float] = []
    with recording_of(session, None, progress, opened) as images:
        height, width = images.camera.height, images.camera.width
        if not (0 <= left < right <= width and 0 <= top < bottom <= height):
            raise SessionError(
                f"a patch is LEFT,TOP,RIGHT,BOTTOM in pixels of the image of {width} x "
                f"{height}; got {','.join(map(str, patch))}"
            )
        for frames in images.chunks(32):
            stamps_ns += [frame.time_ns for frame in frames]
            means += [float(frame.depth[top:bottom, left:right].mean()) for frame in frames]
            progress(len(means), len(images), "reading the patch")
    times = (np.array(stamps_ns) - first_ns) * 1e-9
    rows = np.flatnonzero(rises(np.array(means) * (-1 if infrared is None else 1)))
    # the event was between two frames
    return 0.5 * (times[rows - 1] + times[rows]), f"pixels {','.join(map(str, patch))}"


def _record(found: Alignment, own_s: Array, time_ns: Any, name: str, source: str) -> ClockFit:
    """The record of an alignment in the log of a session with these time stamps."""
    clock, m = found.clock, len(found.pairs)
    sd_s = clock.sd_s.tolist() if np.isfinite(clock.sd_s).all() else None
    times = own_s[found.pairs[:, 0]]
    parts = np.array_split(np.arange(m), min(_KEPT, m))
    rows = sorted(
        {int(of(found.residual_s[p]) + p[0]) for p in parts for of in (np.argmin, np.argmax)}
    )
    alone = [n - m for n in found.n_overlapping]
    return ClockFit(
        name,
        source,
        tuple((int(time_ns.iloc[0]) + np.rint(1e9 * clock.own_s).astype(np.int64)).tolist()),
        tuple(clock.other_s.tolist()),
        None if sd_s is None else tuple(sd_s),
        fingerprint(time_ns),
        m,
        (alone[0], alone[1]),
        round(1e3 * found.rms_s, 4),
        tuple(
            (round(float(times[k]), 6), round(1e3 * float(found.residual_s[k]), 4)) for k in rows
        ),
        breaks=clock.breaks,
    )
