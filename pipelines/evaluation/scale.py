"""Benchmark of throughput and scaling: sessions per hour, memory by length, time by stage.

`liex evaluate scale` writes virtual mice as 640 x 480 MCAP files and measures `liex run` on them:
frames/s and ms per frame by stage, compared with opening, decoding and writing alone; one
recording's shards by one process and by two; a study by one Dask worker and by two (processes
restricted to as many cores); peak memory, MB, by length; and whole runs by kind of recording
(`recordings`). Sessions per hour with up to 1,000 workers are simulated (`ASSUMPTIONS`,
`DEFINITIONS`). `liex evaluate report` repeats a measured session until it is long and writes its
report.
"""

import heapq
import json
import os
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from liex_lab.dashboards.report.report import write_report

from liex_lab.behaviour.summary import measure_rows, stated_by
from liex_lab.body.skeleton import Skeleton
from liex_lab.plan import Plan
from liex_lab.plan.study import Study
from liex_lab.recordings import open_recording
from liex_lab.recordings.frame import DepthFrame
from liex_lab.runtime.memory import peak_memory_mb, release_memory
from liex_lab.runtime.processes import Done, Processes, Work
from liex_lab.runtime.progress import Progress, silent
from liex_lab.sessions import Provenance, Session, SessionWriter, cutouts, evidence, mcap, rrd
from liex_lab.tables.rows import Rows, stop_times
from liex_lab.tracking import curve, observations
from liex_lab.tracking.track import Subject

from ..build import build_provenance, build_recording, build_tracker, kept_estimator
from ..session import CHUNK, Shard, conclude, measure_shards, run_session
from ..study.cluster import crew_of
from ..study.status import standings
from . import speed
from .speed import FPS, STEP_NS, as_mcap, evaluate_kinds, isolated, looped, to_and_fro

_VIRTUAL = "synthetic:walk?seed={seed}&frames={n}&sensor={sensor}"
_CREWS = {  # name -> number of processes, and of cores for all of them
    "1": (1, 1),
    "2": (2, 2),
    "1, free": (1, 2),
}
_N_SIMULATED = 2000  # sessions
_COARSER = 8  # pixel stride of a long session's depth images, which go straight to disk
_BLOCK = 256  # frames
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


def run_scale(
    n_frames: int = 3000, minutes: Sequence[float] = (1.0, 10.0), *, progress: Progress = silent
) -> dict[str, Any]:
    """Measure the cost of a study: sessions per hour, memory, and time by step.

    Args:
        n_frames: frames of each virtual recording, 640 x 480; several shards long.
        minutes: lengths of recording whose memory is measured, minutes.
        progress: called with the stage, of six.

    Returns:
        The measured numbers, `kinds` (whole runs by kind of recording), `memory_mb_by_length`,
        `simulated_sessions_per_hour` by workers, `assumptions`, `definitions` and `n_frames`.
    """
    with tempfile.TemporaryDirectory(prefix="liex-scale-") as scratch:
        folder = Path(scratch)
        (folder / "kinds").mkdir()
        (folder / "rawdata").mkdir()
        progress(0, 6, "running kinds of recordings")
        kinds = evaluate_kinds(n_frames, folder / "kinds")
        progress(1, 6, "making recordings")
        walks = [_walk(folder / "rawdata", k, n_frames) for k in range(2)]
        progress(2, 6, "measuring the stages of a session")
        stages = _stages(walks[0], folder)
        progress(3, 6, "measuring one recording by one process and by two")
        shards = _side_by_side(walks[0], folder)
        progress(4, 6, "measuring a study by one worker and by two")
        study, seconds_each, scheduler_s = _workers(walks, folder)
        progress(5, 6, "measuring memory by length")
        memory = {
            f"{length:g} min": isolated(
                "liex_lab.api:write_long", length, folder / f"long-{length:g}"
            )["peak_memory_mb"]
            for length in minutes
        }
    an_hour = [seconds * 3600 * FPS / n_frames for seconds in seconds_each]
    return {
        **stages,
        **shards,
        **study,
        "kinds": kinds,
        "memory_mb_by_length": memory,
        "simulated_sessions_per_hour": simulate(an_hour, scheduler_s),
        "assumptions": ASSUMPTIONS,
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


def _workers(walks: list[Path], folder: Path) -> tuple[dict[str, Any], list[float], float]:
    """Elapsed time of the same sessions on one worker and on two.

    Returns:
        The study's numbers; seconds of each session on one worker; and the scheduler's time per
        session, s.
    """
    sessions = [
        {"animal": path.stem, "session": f"0{k}", "recording": f"rawdata/{path.name}"}
        for path in walks
        for k in range(2)
    ]
    table = {"animals": [{"id": path.stem} for path in walks], "sessions": sessions}
    wall: dict[str, float] = {}
    each: dict[str, list[float]] = {}
    for k, (name, (count, n_cores)) in enumerate(_CREWS.items()):
        study = Study.from_table({**table, "results": f"derivatives/w{k}"}, folder / "study.toml")
        began = time.perf_counter()
        todo = standings(study)
        with _on_cores(n_cores), crew_of(len(todo), workers=count, threads=1) as crew:
            results = crew.measure(todo, run_session)
        wall[name] = time.perf_counter() - began
        each[name] = [result["seconds"] for result in results]
        shutil.rmtree(folder / "derivatives" / f"w{k}")
    n = len(sessions)
    numbers = {
        "sessions_per_hour": {name: 3600 * n / seconds for name, seconds in wall.items()},
        "two_workers_over_one": wall["1"] / wall["2"],
        "two_workers_over_one_free": wall["1, free"] / wall["2"],
    }
    return numbers, each["1"], max(wall["1"] - sum(each["1"]), 0.0) / n


def simulate(
    session_s: list[float],
    scheduler_s: float,
    workers: tuple[int, ...] = (1, 2, 4, 8, 16, 32, 64, 128, 256, 512, 1000),
    seed: int = 0,
) -> dict[str, float]:
    """Sessions per hour by number of workers, a discrete-event simulation of 2,000 sessions.

    A session begins when a worker is free and the scheduler has assigned all sessions before it.

    Args:
        session_s: measured times of sessions, s, drawn with replacement (a bootstrap).
        scheduler_s: time to assign one session, s, one after the other.
        workers: numbers of workers.
        seed: of the draw.
    """
    lengths = np.random.default_rng(seed).choice(session_s, _N_SIMULATED)
    found = {}
    for count in workers:
        free = [0.0] * count
        scheduler = 0.0
        for length in lengths:
            scheduler = max(heapq.heappop(free), scheduler) + scheduler_s
            heapq.heappush(free, scheduler + float(length))
        found[str(count)] = 3600 * _N_SIMULATED / max(free)
    return found


def write_long(minutes: float, out: str | Path) -> dict[str, Any]:
    """Write a session of a virtual mouse of any length; returns its cost in memory and time.

    Frames of a short recording are repeated forwards and backwards. Every frame is written, tracked
    and measured as in `liex run`; only its observations are copied from the short recording's
    frame, because measuring it again would give the same. Depth images have every 8th pixel.

    Args:
        minutes: length of the session.
        out: folder in which `long.liex` is written.

    Returns:
        `peak_memory_mb` of the process and `seconds`.
    """
    plan = Plan.load("mouse")
    n = int(minutes * 60 * FPS)
    depth, observed, subject, origin = _measure_short(plan)
    origin = replace(origin, n_frames=n)
    release_memory()
    began = time.perf_counter()
    with SessionWriter(Path(out) / "long.liex", origin, report=write_report) as writer:
        for frames, part in _parts(depth, observed, n):
            writer.add(frames, observations=part)
        whole = writer.observations(observations.Observations)
        track = curve.track_whole(subject, whole, allocate=writer.allocate)
        writer.take(track, whole, subject)
        del whole, track
        conclude(writer, plan, {"prepare": 0.0, "track": 0.0})
    return {"peak_memory_mb": peak_memory_mb(), "seconds": time.perf_counter() - began}


def _measure_short(
    plan: Plan,
) -> tuple[list[np.ndarray[Any, Any]], observations.Observations, Subject, Provenance]:
    """Render and measure the short recording, without keeping its full depth images.

    Returns:
        Coarser depth images, observations in them, and their subject and provenance.
    """
    with open_recording(_VIRTUAL.format(seed=5, n=300, sensor="primesense-qvga")) as opened:
        short = looped(opened, len(opened))
    tracker = build_tracker(short, plan)
    observed = observations.Observations.join(
        [tracker.observe(frames) for frames in short.chunks(32)]
    )
    camera = short.camera.every(_COARSER)
    depth = [np.ascontiguousarray(frame.depth[::_COARSER, ::_COARSER]) for frame in short]
    return (
        depth,
        observed,
        replace(tracker.subject, camera=camera),
        replace(build_provenance(short, plan, tracker), camera=camera, gaps=()),
    )


def _parts(
    depth: list[np.ndarray[Any, Any]], observed: observations.Observations, n: int
) -> Iterator[tuple[list[DepthFrame], observations.Observations]]:
    """The frames of a long recording, coarser, and the observations in them."""
    all_rows = to_and_fro(len(depth), n)
    for start in range(0, n, _BLOCK):
        rows = all_rows[start : start + _BLOCK]
        times = (start + np.arange(len(rows), dtype=np.int64)) * STEP_NS
        part = observations.Observations(
            observed.skeleton,
            **{name: getattr(observed, name)[rows] for name in observations.COLUMNS}
            | {"times_ns": times},
        )
        yield (
            [DepthFrame(start + k, int(times[k]), depth[row]) for k, row in enumerate(rows)],
            part,
        )


def evaluate_report(
    session: str | Path, minutes: float = 60.0, *, progress: Progress = silent
) -> dict[str, Any]:
    """Time and peak memory of the report of a session repeated to a given length.

    Args:
        session: the session folder that is repeated.
        minutes: least length of the long session.
        progress: called with the stage.

    Returns:
        `frames`, `minutes`, elapsed `seconds` including the start of Python, `peak_memory_mb` and
        `report_mb`.

    Raises:
        LiexError: the report could not be written.
    """
    with tempfile.TemporaryDirectory(prefix="liex-long-") as scratch:
        folder = Path(scratch) / "long.liex"
        progress(0, None, f"making a session of {minutes:g} minutes")
        n_frames, seconds = repeat_session(Session.open(session, raw=True), folder, 60.0 * minutes)
        progress(0, None, "writing its report")
        found = isolated("liex_lab.dashboards.report.report:write_report", folder)
        size = (folder / "report.html").stat().st_size
    return {
        "frames": n_frames,
        "minutes": round(seconds / 60.0, 2),
        "seconds": round(found["seconds_with_start"], 2),
        "peak_memory_mb": round(found["peak_memory_mb"], 1),
        "report_mb": round(size / 1e6, 2),
    }


def repeat_session(session: Session, folder: Path, seconds: float) -> tuple[int, float]:
    """Write a session that repeats another one end to end; its depth covers one round only.

    Args:
        session: the session as it was measured, without corrections.
        folder: the new session's folder, which must not exist.
        seconds: least length of the new session, s.

    Returns:
        Its number of frames, and its length in s.
    """
    time_s = session.frames["time_s"].to_numpy(float)
    round_ns = round(1e9 * float(stop_times(time_s)[-1]))
    n_rounds = max(1, int(np.ceil(seconds * 1e9 / round_ns)))
    once = evidence.track_of(session)
    times_ns, *columns = (
        np.concatenate([getattr(once, column.name)] * n_rounds)
        for column in fields(once)
        if column.name != "skeleton"
    )
    times_ns += np.repeat(np.arange(n_rounds, dtype=np.int64) * round_ns, once.n_frames)
    track = type(once)(once.skeleton, times_ns, *columns)
    bouts = []
    for k in range(n_rounds):
        bouts.append(session.bouts.copy())
        bouts[k][["start_s", "stop_s"]] += k * round_ns * 1e-9
        bouts[k][["start_frame", "stop_frame"]] += k * len(time_s)
    origin = evidence.provenance_of(session, track.skeleton)
    whose = (origin.name, origin.individual, (), origin.arena, origin.zones)
    rows = Rows(track, np.arange(track.n_frames), *whose)
    results = evidence.Results(origin, rows)
    behaviour = measure_rows(
        rows,
        *stated_by(session),
        bouts=pd.concat(bouts, ignore_index=True),
        actions=session.metadata.get("actions") or {},
    )
    folder.mkdir()
    results.write_track(folder)
    results.write_measured(folder, behaviour.tables, behaviour.columns)
    for name in ("plan.toml", "session.rrd", "session.mcap"):
        shutil.copyfile(session.path / name, folder / name)
    if (session.path / "thumbnails").is_dir():
        shutil.copytree(session.path / "thumbnails", folder / "thumbnails")
    about = {**session.metadata, "frames": results.counts(), "files": {}}
    (folder / "session.json").write_text(json.dumps(about, default=str), encoding="utf-8")
    return track.n_frames, n_rounds * round_ns * 1e-9
