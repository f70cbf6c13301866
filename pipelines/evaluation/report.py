"""Benchmark of the report of a long session: time and peak memory of `liex report`.

`liex evaluate report` repeats a measured session end to end until it is an hour long, makes every
table from the repeated track as a run of that length would, and writes the report in a process of
its own. Numbers: seconds by the clock with the start of Python, peak memory and size, MB.
"""

from __future__ import annotations

import json
import shutil
import subprocess
import tempfile
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from liex_lab.errors import SessionError
from liex_lab.runtime.processes import own_python
from liex_lab.runtime.progress import Progress, silent

if TYPE_CHECKING:
    import pandas as pd

    from liex_lab.sessions import Session
    from liex_lab.tracking.track import Track

_COPIED = ("plan.toml", "session.rrd", "session.mcap")
# the peak is asked for by a process of its own, which has had no other child: the system counts
# them together
_MEASURE = """
import json, resource, subprocess, sys, time
from liex_lab.runtime.processes import own_python
began = time.perf_counter()
command = own_python("-m", "liex_lab", "report", sys.argv[1])
code = subprocess.run(command, stdout=subprocess.DEVNULL).returncode
unit = 1024.0 if sys.platform == "linux" else 1048576.0
peak = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / unit
print(json.dumps({"code": code, "seconds": time.perf_counter() - began, "peak_memory_mb": peak}))
"""


def evaluate_report(
    session: str | Path, minutes: float = 60.0, *, progress: Progress = silent
) -> dict[str, Any]:
    """Time and peak memory of `liex report` on a session repeated to a given length.

    Args:
        session: the session folder that is repeated.
        minutes: least length of the long session.
        progress: told the stage.

    Returns:
        `frames`, `minutes`, `seconds`, `peak_memory_mb` and `report_mb`.

    Raises:
        SessionError: the report could not be written.
    """
    from liex_lab.sessions import Session

    with tempfile.TemporaryDirectory(prefix="liex-long-") as scratch:
        progress(0, None, f"making a session of {minutes:g} minutes")
        folder = Path(scratch) / "long.liex"
        n_frames, seconds = repeat_session(Session.open(session, raw=True), folder, 60.0 * minutes)
        progress(0, None, "writing its report")
        ran = subprocess.run(
            own_python("-c", _MEASURE, str(folder)),
            capture_output=True,
            text=True,
            check=False,
        )
        if ran.returncode or json.loads(ran.stdout)["code"]:
            raise SessionError(
                f"the report of the long session could not be written: {ran.stderr.strip()[-500:]}"
            )
        found = json.loads(ran.stdout)
        size = (folder / "report.html").stat().st_size
    return {
        "frames": n_frames,
        "minutes": round(seconds / 60.0, 2),
        "seconds": round(found["seconds"], 2),
        "peak_memory_mb": round(found["peak_memory_mb"], 1),
        "report_mb": round(size / 1e6, 2),
    }


def repeat_session(session: Session, folder: Path, seconds: float) -> tuple[int, float]:
    """Write a session that repeats another one end to end; its depth is that of one round only.

    Args:
        session: the session as it was measured, without corrections.
        folder: the new session's folder, which must not exist.
        seconds: least length of the new session, s.

    Returns:
        Its number of frames, and its length in s.
    """
    from liex_lab.behaviour.summary import measure_rows, stated_by
    from liex_lab.sessions.evidence import provenance_of, track_of
    from liex_lab.sessions.track_tables import Results
    from liex_lab.tables.rows import Rows, stop_times

    time_s = session.frames["time_s"].to_numpy(float)
    round_ns = round(1e9 * float(stop_times(time_s)[-1]))
    n_rounds = max(1, int(np.ceil(seconds * 1e9 / round_ns)))
    track = _repeated(track_of(session), n_rounds, round_ns)
    origin = provenance_of(session, track.skeleton)
    rows = Rows(
        track,
        np.arange(track.n_frames),
        origin.name,
        origin.individual,
        (),
        origin.arena,
        origin.zones,
    )
    results, (rules, around) = Results(origin, rows), stated_by(session)
    bouts = _repeated_bouts(session.bouts, n_rounds, round_ns * 1e-9, len(time_s))
    behaviour = measure_rows(
        rows, rules, around, bouts=bouts, actions=session.metadata.get("actions") or {}
    )
    folder.mkdir()
    results.write_track(folder)
    results.write_measured(folder, behaviour.tables, behaviour.vocabulary.columns)
    for name in _COPIED:
        shutil.copyfile(session.path / name, folder / name)
    if (session.path / "thumbnails").is_dir():
        shutil.copytree(session.path / "thumbnails", folder / "thumbnails")
    about = {**session.metadata, "frames": results.counts(), "files": {}}
    (folder / "session.json").write_text(json.dumps(about, default=str), encoding="utf-8")
    return track.n_frames, n_rounds * round_ns * 1e-9


def _repeated(track: Track, n_rounds: int, round_ns: int) -> Track:
    """A track n_rounds times, one after the other."""
    columns = []
    for column in fields(track):
        if column.name == "skeleton":
            continue
        values = getattr(track, column.name)
        columns.append(np.concatenate([values] * n_rounds))
    columns[0] = columns[0] + np.repeat(
        np.arange(n_rounds, dtype=np.int64) * round_ns, track.n_frames
    )
    return type(track)(track.skeleton, *columns)


def _repeated_bouts(
    bouts: pd.DataFrame, n_rounds: int, round_s: float, n_frames: int
) -> pd.DataFrame:
    """The bouts of every round."""
    import pandas as pd

    rounds = []
    for k in range(n_rounds):
        one = bouts.copy()
        one[["start_s", "stop_s"]] += k * round_s
        one[["start_frame", "stop_frame"]] += k * n_frames
        rounds.append(one)
    return pd.concat(rounds, ignore_index=True)
