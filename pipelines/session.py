"""The job `liex run`: a depth recording in, a session folder out. The whole line on one page."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING

from liex_lab.pipelines.build import build_provenance, build_recording, build_rules, build_surroundings, build_tracker

from liex_lab.plan import Plan
from liex_lab.progress import Progress, silent

if TYPE_CHECKING:
    from liex_lab.recordings.recording import Recording
    from liex_lab.sessions.writer import BlueprintMaker, ReportMaker

CHUNK = 32  # frames in memory at a time


def measure_session(
    recording: str | Path | Recording,
    plan: Plan,
    out: str | Path,
    *,
    overwrite: bool = False,
    blueprint: BlueprintMaker | None = None,
    report: ReportMaker | None = None,
    progress: Progress = silent,
) -> Path:
    """Measure every frame of a recording; returns the session folder `out/<recording's name>.liex`.

    blueprint and report make the views that lie in the folder; see `Session.create`.
    """
    from liex_lab.behaviour.summary import measure
    from liex_lab.sessions import Session
    from liex_lab.sessions.writer import check_place

    started = time.perf_counter()
    with build_recording(recording, plan, progress) as opened:
        folder = Path(out) / f"{opened.name}.liex"
        check_place(folder, overwrite)
        progress(0, None, "learning the background, the floor and the animal's size")
        tracker = build_tracker(opened, plan)
        provenance = build_provenance(opened, plan, tracker, progress)
        timings = {"prepare": time.perf_counter() - started, "track": 0.0}
        with Session.create(folder, provenance, overwrite=overwrite, blueprint=blueprint, report=report) as writer:
            for frames in opened.chunks(CHUNK):
                began = time.perf_counter()
                track = tracker.follow(frames)
                timings["track"] += time.perf_counter() - began
                writer.add(frames, track)
                progress(frames[-1].index + 1, len(opened), "measuring poses")
            writer.note(problems=opened.problems)
            around = build_surroundings(provenance)
            behaviour = measure(writer.frames, writer.poses, build_rules(plan), around, writer.gaps)
            session = writer.close(timings_s=timings, **behaviour.for_session())
    return session.path
