"""Benchmark of throughput and scaling: sessions per hour, memory, time by stage.

`liex evaluate scale` writes virtual mice as 640 x 480 MCAP files and measures `liex run` on them:
frames/s and ms per frame by stage, compared with opening, decoding and writing alone; one
recording's shards by one process and by two; a study by one Dask worker and by two (processes
restricted to as many cores); peak memory, MB; and whole runs by kind of recording (`recordings`).
"""

import os
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from liex_lab.body.skeleton import Skeleton
from liex_lab.plan import Plan
from liex_lab.plan.study import Study
from liex_lab.recordings import open_recording
from liex_lab.runtime.processes import Done, Processes, Work
from liex_lab.runtime.progress import Progress, silent
from liex_lab.sessions import Provenance, Session, cutouts, mcap, rrd

from ..build import build_provenance, build_recording, build_tracker, kept_estimator
from ..session import CHUNK, Shard, measure_shards, run_session
from ..study.cluster import crew_of
from ..study.status import standings
from . import speed
from .speed import as_mcap, evaluate_kinds, looped

_VIRTUAL = "synthetic:walk?seed={seed}&frames={n}&sensor={sensor}"
_CREWS = {  # name -> number of processes, and of cores for all of them
    "1": (1, 1),
    "2": (2, 2),
    "1, free": (1, 2),
}
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
        "from the first frame that is measured to the finished session, over decoding and writing "
        "alone"
    ),
    "looking": (
        "frames that processes with one thread for kernels read, measure and write, once each has "
        "done its first stretch; two on two cores, one on one; free: one that may use both, as its "
        "logs are packed beside it"
    ),
    "two_workers_over_one": (
        "sessions an hour of a study, the workers' start included; two workers on two cores over "
        "one on one; free: over one that may use both, which reads ahead and packs its logs beside "
        "its work"
    ),
}


def run_scale(n_frames: int = 3000, *, progress: Progress = silent) -> dict[str, Any]:
    """Measure the cost of a study: sessions per hour, memory, and time by step.

    Args:
        n_frames: frames of each virtual recording, 640 x 480; several shards long.
        progress: called with the stage, of five.

    Returns:
        The measured numbers, `kinds` (whole runs by kind of recording), `definitions` and
        `n_frames`.
    """
    with tempfile.TemporaryDirectory(prefix="liex-scale-") as scratch:
        folder = Path(scratch)
        (folder / "kinds").mkdir()
        (folder / "rawdata").mkdir()
        progress(0, 5, "running kinds of recordings")
        kinds = evaluate_kinds(n_frames, folder / "kinds")
        progress(1, 5, "making recordings")
        walks = [_walk(folder / "rawdata", k, n_frames) for k in range(2)]
        progress(2, 5, "measuring the stages of a session")
        stages = _stages(walks[0], folder)
        progress(3, 5, "measuring one recording by one process and by two")
        shards = _side_by_side(walks[0], folder)
        progress(4, 5, "measuring a study by one worker and by two")
        study = _workers(walks, folder)
    return {
        **stages,
        **shards,
        **study,
        "kinds": kinds,
        "definitions": {**DEFINITIONS, "kinds": speed.DEFINITIONS},
        "n_frames": n_frames,
    }


def _walk(folder: Path, seed: int, n_frames: int) -> Path:
    """A virtual mouse as an MCAP file, which costs as much to read as any recording."""
    with open_recording(_VIRTUAL.format(seed=5 + seed, n=150, sensor="primesense")) as short:
        return as_mcap(looped(short, n_frames, f"walk{seed}"), folder)


def _stages(recording: Path, folder: Path) -> dict[str, Any]:
    """Time of each stage of a session, after a first session has compiled everything."""
    plan = Plan.load("mouse")
    run_session(recording, plan, folder / "warm")
    kept_estimator.cache_clear()  # a single run has to load its model
    began = time.perf_counter()
    session = Session.open(run_session(recording, plan, folder / "measured"))
    whole = time.perf_counter() - began
    n = session.metadata["frames"]["n_frames"]
    spent = session.metadata["timings_s"]
    begun = whole - spent["prepare"]
    bound = _decode_and_write(session, recording, plan, folder / "bound.liex")
    by_frame = {"decode": bound["decode"], **spent}
    return {
        "frames_per_s": n / whole,
        "frames_per_s_once_begun": n / begun,
        "frames_per_s_to_the_logs": n / (spent["prepare"] + spent["total"]),
        "prepare_s": spent["prepare"],
        "ms_per_frame": {k: 1e3 * value / n for k, value in by_frame.items() if k != "prepare"},
        "times_decode_and_write": whole / (bound["opening"] + bound["bound"]),
        "times_decode_and_write_without_opening": whole / bound["bound"],
        "times_decode_and_write_once_begun": begun / bound["bound"],
        "peak_memory_mb": session.metadata["peak_memory_mb"],
    }


def _decode_and_write(
    session: Session, recording: Path, plan: Plan, folder: Path
) -> dict[str, float]:
    """Time of the minimum work of any program that reads a recording and writes both logs.

    Returns:
        Seconds of `opening` the recording; of opening it and reading all frames (`decode`); and,
        once it is open, of reading them and writing the session's own cut-outs (`bound`).
    """
    began = time.perf_counter()
    with build_recording(recording, plan) as opened:
        opening = time.perf_counter() - began
        for _ in opened.chunks(CHUNK):
            pass
        decode = time.perf_counter() - began
        folder.mkdir()
        origin = Provenance(
            "bound",
            Skeleton.load("mouse"),
            opened.camera,
            session.T_arena_camera,
            1000.0,
            "0",
            n_frames=len(opened),
            replay_depth=plan.replay.depth,
            background=cutouts.still_scene(opened),
        )
        boxes, background = cutouts.Kept(session).boxes, origin.background
        assert boxes is not None
        assert background is not None
        replay = rrd.ReplayWriter(folder / "session.rrd", origin)
        messages = mcap.McapWriter(folder / "session.mcap", origin)
        began = time.perf_counter()
        for frames in opened.chunks(CHUNK):
            times = [frame.time_ns for frame in frames]
            rows = [frame.index for frame in frames]
            cuts = boxes[rows[0] : rows[-1] + 1]
            depth = [
                cutouts.composed(frame.depth, cut, background)
                for frame, cut in zip(frames, cuts, strict=True)
            ]
            replay.add(rows, times, depth, cuts)
            messages.add(times, depth)
        replay.flushed()
        replay.abandon()
        messages.abandon()
    return {"opening": opening, "decode": decode, "bound": time.perf_counter() - began}


@dataclass(frozen=True)
class _Timed(Processes):
    """A worker pool that records the completion time and number of frames of each shard."""

    came: list[tuple[float, int]] = field(default_factory=list)

    def each(self, do: Callable[[Work], Done], works: Sequence[Work]) -> Iterator[Done]:
        """Results of the pool; see `WorkerPool`."""
        for done in super().each(do, works):
            n = done.stop - done.start if isinstance(done, Shard) else 0
            self.came.append((time.perf_counter(), n))
            yield done


def _side_by_side(recording: Path, folder: Path) -> dict[str, Any]:
    """Frames per second read, measured and written by one process and by two.

    The clock starts once each process has done its first shard, as starting takes some seconds.
    """
    plan = Plan.load("mouse")
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
    found = {}
    for name, (count, n_cores) in _CREWS.items():
        pool = _Timed(count, threads=1)
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
    """Restrict processes that are started in the block to `n` cores, if the system supports it."""
    before = os.sched_getaffinity(0) if hasattr(os, "sched_setaffinity") else set()
    if before:
        os.sched_setaffinity(0, sorted(before)[:n])
    try:
        yield
    finally:
        if before:
            os.sched_setaffinity(0, before)


def _workers(walks: list[Path], folder: Path) -> dict[str, Any]:
    """Elapsed time of the same sessions on one worker and on two."""
    sessions = [
        {"animal": path.stem, "session": f"0{k}", "recording": f"rawdata/{path.name}"}
        for path in walks
        for k in range(2)
    ]
    table = {"animals": [{"id": path.stem} for path in walks], "sessions": sessions}
    wall: dict[str, float] = {}
    for k, (name, (count, n_cores)) in enumerate(_CREWS.items()):
        study = Study.from_table({**table, "results": f"derivatives/w{k}"}, folder / "study.toml")
        began = time.perf_counter()
        todo = standings(study)
        with _on_cores(n_cores), crew_of(len(todo), workers=count, threads=1) as crew:
            crew.measure(todo, run_session)
        wall[name] = time.perf_counter() - began
        shutil.rmtree(folder / "derivatives" / f"w{k}")
    n = len(sessions)
    return {
        "sessions_per_hour": {name: 3600 * n / seconds for name, seconds in wall.items()},
        "two_workers_over_one": wall["1"] / wall["2"],
        "two_workers_over_one_free": wall["1, free"] / wall["2"],
    }
