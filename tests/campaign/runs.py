"""Runs in processes of their own that may be killed, and what has to be equal afterwards."""

import json
import multiprocessing
import os
import tempfile
import time
from multiprocessing.process import BaseProcess
from pathlib import Path

from liex_lab.catalog import find_sample
from liex_lab.errors import LiexError
from liex_lab.plan import Plan
from liex_lab.recordings import open_recording
from liex_lab.recordings.recording import Recording

SAMPLE = find_sample("mouse_walk.mcap")
_PRELOADED = [
    "pandas",
    "rerun",
    "foxglove",
    "cv2",
    "pyarrow.parquet",
    "scipy.spatial",
    "liex_lab.pipelines.session",
    "liex_lab.dashboards.report.report",
    "liex_lab.behaviour",
    "liex_lab.sessions.mcap",
    "liex_lab.tracking.tracker",
    "liex_lab.pipelines.evaluation.speed",
]
_KINDS = {".parquet", ".csv", ".toml"}


def long_sample(n_frames: int, broken_at: int = -1) -> Recording:
    """The bundled sample over and over, so that measuring it takes a while."""
    from liex_lab.pipelines.evaluation.speed import looped

    with open_recording(SAMPLE) as short:
        recording = looped(short, n_frames)
    if broken_at >= 0:
        read = recording._read

        def breaks(row: int) -> object:
            if row == broken_at:
                raise OSError(5, "Input/output error", str(SAMPLE))
            return read(row)

        recording._read = breaks
    return recording


def run_here(out: str, told: str, n_frames: int, broken_at: int, jumping: bool) -> None:
    """What `liex run` does, in a process forked off one with everything imported; stages and
    refusals are told.
    """
    from liex_lab.api import run_session

    if jumping:
        _let_the_clock_jump()
    folder, last = Path(out), ""
    folder.mkdir(exist_ok=True)
    real = time.monotonic

    def tell(done: int, total: int | None, what: str) -> None:
        nonlocal last
        if what != last:
            last = what
            (folder / "stage.json").write_text(json.dumps([what, real()]))

    try:
        run_session(
            long_sample(n_frames, broken_at), Plan.load("mouse"), out, overwrite=True, progress=tell
        )
    except (LiexError, OSError) as error:
        Path(told).write_text(json.dumps(str(error)))
        raise SystemExit(1) from None


def _let_the_clock_jump() -> None:
    import random

    rng = random.Random()
    time.time = lambda: rng.uniform(-1e9, 1e10)
    time.time_ns = lambda: int(rng.uniform(-1e18, 1e19))


def begin(out: Path, n_frames: int, broken_at: int = -1, jumping: bool = False) -> BaseProcess:
    """Start such a process; every one uses both cores."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(_PRELOADED)
    process = context.Process(
        target=run_here, args=(str(out), str(_refusal_of(out)), n_frames, broken_at, jumping)
    )
    process.start()
    return process


def refusal(out: Path) -> str:
    """What the last run said against going on; empty where it said nothing."""
    path = _refusal_of(out)
    said = str(json.loads(path.read_text())) if path.is_file() else ""
    path.unlink(missing_ok=True)
    return said


def _refusal_of(out: Path) -> Path:
    """Where a run tells what it says against going on: not on its own disk, which may be full."""
    return Path(tempfile.gettempdir()) / f"refused-{os.getpid()}-{'-'.join(out.parts[-2:])}.json"


def tables_of(folder: Path) -> dict[str, bytes]:
    """Everything that has to be equal."""
    return {
        path.name: path.read_bytes() for path in sorted(folder.iterdir()) if path.suffix in _KINDS
    }


def whole_sessions(folder: Path) -> dict[str, dict[str, bytes]]:
    """The tables of every whole session below a folder, by its place in it."""
    return {
        str(path.parent.relative_to(folder)): tables_of(path.parent)
        for path in sorted(folder.rglob("session.json"))
        if not path.parent.name.endswith(".part")
    }


def undisturbed(scratch: Path, n_frames: int) -> tuple[float, dict[str, bytes]]:
    """Seconds that a run takes that nobody disturbs, and its tables."""
    began = time.monotonic()
    process = begin(scratch / "undisturbed", n_frames)
    process.join()
    assert process.exitcode == 0, refusal(scratch / "undisturbed")
    return time.monotonic() - began, tables_of(next((scratch / "undisturbed").glob("*.liex")))
