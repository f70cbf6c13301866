"""Benchmark of throughput and scaling: sessions per hour, memory by length, time by stage.

`liex evaluate scale` writes virtual mice as 640 x 480 MCAP files and measures `liex run` on them:
frames/s and ms a frame by stage, held against the bound of opening, decoding and writing alone; one
recording's shards by one process and by two; a study by one Dask worker and by two (processes held
on as many cores); peak memory, MB, by length; and whole runs by kind of recording (`kinds`).
Sessions per hour with up to 1,000 workers are simulated: measured times are drawn with replacement
(a bootstrap), and sessions handed out one by one by a scheduler that spends its measured time on
each (`ASSUMPTIONS`, `DEFINITIONS`).
"""

from __future__ import annotations

import heapq
import json
import os
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from liex_lab.plan import Plan
from liex_lab.plan.study import Study
from liex_lab.runtime.processes import own_python
from liex_lab.runtime.progress import Progress, silent

from ..build import build_recording, build_tracker, kept_estimator
from ..origin import build_provenance
from ..shards import CHUNK, Shard, measure_shards
from ..workers import Done, Processes, Work, WorkerPool
from . import kinds
from .long_sessions import looped

RunSession = Callable[..., Path]
_VIRTUAL = "synthetic:walk?seed={seed}&frames=150&sensor=primesense"
_WORKERS = (1, 2, 4, 8, 16, 32, 64, 128, 256, 512, 1000)
_CREWS = {
    "1": (1, 1),
    "2": (2, 2),
    "1, free": (1, 2),
}  # name -> processes, and the cores of all of them
_N_SIMULATED = 2000  # sessions
_FPS = 30
ASSUMPTIONS = (
    "simulated: every worker has the cores, the memory and the reading and writing speed that one "
    "has here; sessions take the measured times, drawn with replacement and stretched to an hour "
    "of recording; they are handed out one by one, and the scheduler spends its measured time on "
    "each, one after the other; starting workers is not counted"
)

DEFINITIONS = {
    "frames_per_s": "from opening the recording to the finished session, figures and report too",
    "frames_per_s_once_begun": "the same without the preparation",
    "frames_per_s_to_the_logs": "until logs and tables are written, without figures and report",
    "times_decode_and_write": (
        "all of `liex run` but Python's start and the loading of what it needs, over opening the "
        "recording, decoding every frame and writing depth into both logs"
    ),
    "times_decode_and_write_without_opening": "the same over decoding and writing alone",
    "times_decode_and_write_once_begun": (
        "from the first frame that is looked at to the finished session, over decoding and "
        "writing alone"
    ),
    "looking": (
        "frames that processes with one thread for kernels read, look at and write, once each "
        "has done its first stretch; two on two cores, one on one; free: one that may use both, "
        "as its logs are packed beside it"
    ),
    "two_workers_over_one": (
        "sessions an hour of a study, the workers' start included; two workers on two cores over "
        "one on one; free: over one that may use both, which reads ahead and packs its logs "
        "beside its work"
    ),
}


def evaluate_scale(
    run: RunSession,
    n_frames: int = 3000,
    minutes: tuple[float, ...] = (1.0, 10.0),
    progress: Progress = silent,
) -> dict[str, Any]:
    """Stages of a session, two workers against one, memory by length, and simulated many workers.

    Workers of one recording share its shards, those of a study its sessions.

    Args:
        run: measures a recording, `liex_lab.api.run_session`.
        n_frames: frames of each virtual recording, 640 x 480; some shards long.
        minutes: lengths of recording whose memory is measured, minutes.
        progress: told the stage, of six.

    Returns:
        The measured numbers, `kinds` (whole runs by kind of recording), `memory_mb_by_length`,
        `simulated_sessions_per_hour` by workers, `assumptions`, `definitions` and `n_frames`.
    """
    with tempfile.TemporaryDirectory(prefix="liex-scale-") as scratch:
        folder = Path(scratch)
        (folder / "kinds").mkdir()
        progress(0, 6, "running kinds of recordings")
        by_kind = kinds.evaluate_kinds(n_frames, folder / "kinds")
        progress(1, 6, "making recordings")
        recordings = [_recording(folder, k, n_frames) for k in range(2)]
        progress(2, 6, "measuring the stages of a session")
        stages = _stages(run, recordings[0], folder)
        progress(3, 6, "looking at one recording by one process and by two")
        looking = _side_by_side(recordings[0], folder)
        progress(4, 6, "measuring a study by one worker and by two")
        workers = _workers(run, recordings, folder)
        progress(5, 6, "measuring memory by length")
        memory = {f"{length:g} min": _memory(length, folder) for length in minutes}
    hour = [seconds * 3600 * _FPS / n_frames for seconds in workers["seconds_each"]]
    simulated = simulate(hour, workers["scheduler_s_per_session"])
    return {
        **stages,
        **looking,
        **workers["study"],
        "kinds": by_kind,
        "memory_mb_by_length": memory,
        "simulated_sessions_per_hour": simulated,
        "assumptions": ASSUMPTIONS,
        "definitions": {**DEFINITIONS, "kinds": kinds.DEFINITIONS},
        "n_frames": n_frames,
    }


def _recording(folder: Path, seed: int, n_frames: int) -> Path:
    """A virtual mouse, written as an MCAP file: reading it costs what reading a recording costs."""
    from liex_lab.recordings import open_recording

    from ..convert import convert

    path = folder / "rawdata" / f"walk{seed}.mcap"
    path.parent.mkdir(exist_ok=True)
    with open_recording(_VIRTUAL.format(seed=5 + seed)) as short:
        convert(looped(short, n_frames), path)
    return path


def _stages(run: RunSession, recording: Path, folder: Path) -> dict[str, Any]:
    """One session after a first one has compiled everything: where its time goes, and the bound it
    is held against.
    """
    from liex_lab.sessions import Session

    plan = Plan.load("mouse")
    run(recording, plan, folder / "warm")
    kept_estimator.cache_clear()  # whoever runs one session alone has to load its model
    began = time.perf_counter()
    session = Session.open(run(recording, plan, folder / "measured"))
    whole = time.perf_counter() - began
    n = session.metadata["frames"]["n_frames"]
    spent = session.metadata["timings_s"]
    begun = whole - spent["prepare"]
    bound = _decode_and_write(session, recording, plan, folder / "bound.liex")
    return {
        "frames_per_s": n / whole,
        "frames_per_s_once_begun": n / begun,
        "frames_per_s_to_the_logs": n / (spent["prepare"] + spent["total"]),
        "prepare_s": spent["prepare"],
        "ms_per_frame": {
            name: 1e3 * value / n
            for name, value in {**bound, **spent}.items()
            if name not in ("opening", "bound", "prepare")
        },
        "times_decode_and_write": whole / (bound["opening"] + bound["bound"]),
        "times_decode_and_write_without_opening": whole / bound["bound"],
        "times_decode_and_write_once_begun": begun / bound["bound"],
        "peak_memory_mb": session.metadata["peak_memory_mb"],
    }


class _Timed:
    """A worker pool that takes down when each shard came, and how many frames it has."""

    def __init__(self, pool: WorkerPool) -> None:
        self._crew = pool
        self.fewest, self.here = pool.fewest, pool.here
        self.came: list[tuple[float, int]] = []

    def each(self, do: Callable[[Work], Done], works: Sequence[Work]) -> Iterator[Done]:
        """Results of the pool, the time of each taken down; see `WorkerPool`.

        Args:
            do: the task.
            works: its arguments, one a task.
        """
        for done in self._crew.each(do, works):
            self.came.append(
                (time.perf_counter(), done.stop - done.start if isinstance(done, Shard) else 0)
            )
            yield done


def _side_by_side(recording: Path, folder: Path) -> dict[str, Any]:
    """Frames per second read, measured and written by one process and by two.

    Each process has done its first shard before the clock runs, as it takes some seconds to begin.
    """
    plan = Plan.load("mouse")
    found = {}
    with build_recording(recording, plan) as opened:
        tracker = build_tracker(opened, plan)
        whole = Shard(
            str(recording),
            plan,
            tracker,
            build_provenance(opened, plan, tracker),
            folder,
            0,
            len(opened),
        )
    for name, (count, n_cores) in _CREWS.items():
        pool = _Timed(Processes(count, threads=1))
        with _on_cores(n_cores):
            measure_shards(pool, whole, folder / f"stretches {name}.liex", silent)
        (begun, _), later = pool.came[count - 1], pool.came[count:]
        found[name] = sum(n for _, n in later) / (later[-1][0] - begun)
    return {
        "looking_frames_per_s": found,
        "looking_two_processes_over_one": found["2"] / found["1"],
        "looking_two_processes_over_one_free": found["2"] / found["1, free"],
    }


@contextmanager
def _on_cores(n: int) -> Iterator[None]:
    """Processes that are started in the block are kept on so many cores, where the system can do
    that.
    """
    if not hasattr(os, "sched_setaffinity"):
        yield
        return
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, sorted(before)[:n])
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)


def _decode_and_write(session: Any, recording: Path, plan: Plan, place: Path) -> dict[str, float]:
    """Seconds that opening the recording takes, opening it and reading all frames, and, once it is
    open, reading them and writing both logs with the session's own cut-outs: nothing that does this
    can be quicker.
    """
    from liex_lab.sessions.cutouts import Kept, composed, still_scene
    from liex_lab.sessions.mcap import McapWriter
    from liex_lab.sessions.provenance import Provenance
    from liex_lab.sessions.rrd import ReplayWriter

    began = time.perf_counter()
    with build_recording(recording, plan) as opened:
        opening = time.perf_counter() - began
        for _ in opened.chunks(CHUNK):
            pass
        decode = time.perf_counter() - began
        from liex_lab.body.skeleton import Skeleton

        place.mkdir()
        origin = Provenance(
            "bound",
            Skeleton.load("mouse"),
            opened.camera,
            session.T_arena_camera,
            1000.0,
            "0",
            n_frames=len(opened),
            replay_depth=plan.replay.depth,
            background=still_scene(opened),
        )
        boxes = Kept(session).boxes
        assert boxes is not None
        assert origin.background is not None
        replay = ReplayWriter(place / "session.rrd", origin)
        messages = McapWriter(place / "session.mcap", origin)
        began = time.perf_counter()
        for frames in opened.chunks(CHUNK):
            times = [frame.time_ns for frame in frames]
            rows = [frame.index for frame in frames]
            cuts = boxes[rows[0] : rows[-1] + 1]
            depth = [
                composed(frame.depth, cut, origin.background)
                for frame, cut in zip(frames, cuts, strict=True)
            ]
            replay.add(rows, times, depth, cuts)
            messages.add(times, depth)
        replay.flushed()
        replay.abandon()
        messages.abandon()
    return {"opening": opening, "decode": decode, "bound": time.perf_counter() - began}


def _workers(run: RunSession, recordings: list[Path], folder: Path) -> dict[str, Any]:
    """The same sessions on one worker and on two, by the wall clock."""
    from ..study.cluster import measure_cohort
    from ..study.status import standings

    table = {
        "animals": [{"id": path.stem} for path in recordings],
        "sessions": [
            {"animal": path.stem, "session": f"0{k}", "recording": f"rawdata/{path.name}"}
            for path in recordings
            for k in range(2)
        ],
    }
    wall: dict[str, float] = {}
    each: dict[str, list[float]] = {}
    for k, (name, (count, n_cores)) in enumerate(_CREWS.items()):
        study = Study.from_table({**table, "results": f"derivatives/w{k}"}, folder / "study.toml")
        began = time.perf_counter()
        with _on_cores(n_cores):
            results = measure_cohort(standings(study), run, workers=count, threads=1)
        wall[name] = time.perf_counter() - began
        each[name] = [result["seconds"] for result in results]
        shutil.rmtree(folder / "derivatives" / f"w{k}")
    n = len(table["sessions"])
    study_told = {
        "sessions_per_hour": {name: 3600 * n / seconds for name, seconds in wall.items()},
        "two_workers_over_one": wall["1"] / wall["2"],
        "two_workers_over_one_free": wall["1, free"] / wall["2"],
    }
    return {
        "study": study_told,
        "seconds_each": each["1"],
        "scheduler_s_per_session": max(wall["1"] - sum(each["1"]), 0.0) / n,
    }


def simulate(
    session_s: list[float], scheduler_s: float, workers: tuple[int, ...] = _WORKERS, seed: int = 0
) -> dict[str, float]:
    """Sessions per hour by number of workers, a discrete-event simulation of 2,000 sessions.

    A session begins when a worker is free and the scheduler has handed out all before it.

    Args:
        session_s: measured times of sessions, s, drawn with replacement.
        scheduler_s: what handing out one session costs, s, one after the other.
        workers: numbers of workers.
        seed: of the draw.

    Returns:
        Sessions per hour by number of workers, as text.
    """
    lengths = np.random.default_rng(seed).choice(session_s, _N_SIMULATED)
    found = {}
    for count in workers:
        free = [0.0] * count
        scheduler = 0.0
        for length in lengths:
            begins = max(heapq.heappop(free), scheduler)
            scheduler = begins + scheduler_s
            heapq.heappush(free, scheduler + float(length))
        found[str(count)] = 3600 * _N_SIMULATED / max(free)
    return found


_WRITE_LONG = """
import json, sys
import numpy as np
from liex_lab.api import write_long
print(json.dumps(write_long(float(sys.argv[1]), sys.argv[2])))
"""


def _memory(minutes: float, folder: Path) -> float:
    """Peak memory, MB, of a process that tracks and writes so many minutes of 30 frames a
    second.
    """
    done = subprocess.run(
        own_python("-c", _WRITE_LONG, str(minutes), str(folder / f"long-{minutes:g}")),
        capture_output=True,
        text=True,
        check=True,
    )
    return float(json.loads(done.stdout.splitlines()[-1])["peak_memory_mb"])
