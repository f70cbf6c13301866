"""Benchmark of whole runs by kind of recording: frames a second, decoding beside it, size, memory.

A rendered mouse is written as raw MCAP of 640 x 480 pixels and as a MoSeq archive
(.tar.gz) of 512 x 424. Each is measured as by `liex run` in a process of its own, all files
written, and read in another on one thread before and after it: the mean of both rates is what one
core decodes in the same run. Numbers: frames/s, their ratio, bytes of session and recording, MB.
"""

from __future__ import annotations

import shutil
import subprocess
import tarfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from liex_lab.errors import LiexError
from liex_lab.runtime.processes import own_python
from liex_lab.runtime.progress import Progress, silent

from ..convert import convert
from .decoding import MoseqWriter, read_alone
from .long_sessions import looped

if TYPE_CHECKING:
    from liex_lab.recordings.recording import Recording

_VIRTUAL = "synthetic:walk?seed=5&frames=150&sensor={sensor}"
# what `liex run` does, timed; it ends as the command line does
_TIMED_RUN = """
import gc, sys, time
from liex_lab.api import run_session
from liex_lab.plan import Plan
began = time.perf_counter()
run_session(sys.argv[1], Plan.load("mouse"), sys.argv[2])
print(time.perf_counter() - began)
gc.freeze()
"""

DEFINITIONS = {
    "frames_per_s": (
        "frames over the seconds from opening the recording to the finished session, all logs, "
        "tables, figures and the report written; Python's start is in frames_per_s_with_start"
    ),
    "report_s": "of these seconds, those after the logs and tables: figures and report",
    "decoding_frames_per_s_1core": (
        "the same recording read to float32 millimetres in a process of its own on one thread, "
        "the mean of once before and once after the run"
    ),
    "times_decoding": "frames_per_s over decoding_frames_per_s_1core",
    "session_share": "bytes of the session's folder over bytes of the recording",
    "peak_memory_mb": "of the process that ran, everything in it",
}


def evaluate_kinds(n_frames: int, folder: Path, progress: Progress = silent) -> dict[str, Any]:
    """What a whole run costs of each kind of recording; a first run has compiled everything before.

    Args:
        n_frames: length of each recording.
        folder: an empty folder to write into.
        progress: told kind by kind.

    Returns:
        By kind, the numbers that `DEFINITIONS` explains.

    Raises:
        LiexError: a run failed.
    """
    found = {}
    for k, (kind, (sensor, write)) in enumerate(_KINDS.items()):
        progress(k, len(_KINDS), f"running {kind.replace('_', ' ')}")
        place = folder / kind
        place.mkdir()
        recording = _written(sensor, write, n_frames, place)
        if not k:
            _run(recording, place / "first")
        found[kind] = _measured(recording, place)
        shutil.rmtree(place)
    return found


def _written(
    sensor: str, write: Callable[[Recording, Path], Path], n_frames: int, place: Path
) -> Path:
    """A virtual mouse of this many frames as a kind of recording."""
    from liex_lab.recordings import open_recording

    with open_recording(_VIRTUAL.format(sensor=sensor)) as short:
        return write(looped(short, n_frames), place)


def _measured(recording: Path, place: Path) -> dict[str, float]:
    """The numbers of one recording."""
    from liex_lab.sessions import Session
    from liex_lab.sessions.folder import folder_bytes

    before = read_alone(recording, 1)
    with_start, whole = _run(recording, place / "results")
    after = read_alone(recording, 1)
    (path,) = (place / "results").glob("*.liex")
    facts = Session.open(path).metadata
    n = facts["frames"]["n_frames"]
    spent = facts["timings_s"]
    decoding = (before["frames_per_s"] + after["frames_per_s"]) / 2.0
    size = folder_bytes(path)
    return {
        "frames_per_s": n / whole,
        "frames_per_s_with_start": n / with_start,
        "decoding_frames_per_s_1core": decoding,
        "times_decoding": n / whole / decoding,
        "prepare_s": spent["prepare"],
        "report_s": whole - spent["prepare"] - spent["total"],
        "opening_s": n * (before["open_ms_per_frame"] + after["open_ms_per_frame"]) / 2000.0,
        "recording_mb": recording.stat().st_size / 1e6,
        "session_mb": size / 1e6,
        "session_share": size / recording.stat().st_size,
        "peak_memory_mb": facts["peak_memory_mb"],
    }


def _run(recording: Path, out: Path) -> tuple[float, float]:
    """Run a recording in a process of its own; seconds by the wall clock, with Python's start and
    without.
    """
    began = time.perf_counter()
    ran = subprocess.run(
        own_python("-c", _TIMED_RUN, str(recording), str(out)),
        capture_output=True,
        text=True,
        check=False,
    )
    seconds = time.perf_counter() - began
    if ran.returncode:
        raise LiexError(
            f"a run of {recording.name} failed ({ran.stderr.strip()[-300:]}); report this"
        )
    return seconds, float(ran.stdout.split()[-1])


def _as_mcap(recording: Recording, place: Path) -> Path:
    return convert(recording, place / "walk.mcap").path


def _as_moseq(recording: Recording, place: Path) -> Path:
    """As MoSeq's extract packs a session: its folder's files in a .tar.gz."""
    folder = place / "session_walk"
    with MoseqWriter(folder, recording.camera) as writer:
        for frame in recording:
            writer.add(frame)
    (folder / "camera.toml").rename(place / "camera.toml")
    packed = place / "session_walk.tar.gz"
    with tarfile.open(packed, "w:gz", compresslevel=6) as archive:  # as tar does
        for file in sorted(folder.iterdir()):
            archive.add(file, file.name)
    shutil.rmtree(folder)
    return packed


_KINDS: dict[str, tuple[str, Callable[[Recording, Path], Path]]] = {
    "mcap_raw_640x480": ("primesense", _as_mcap),
    "moseq_gz_512x424": ("kinect-v2", _as_moseq),
}
