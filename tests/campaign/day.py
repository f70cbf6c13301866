"""A simulated day in 24 files or more: memory, time, a kill, and a session like any other.

A virtual mouse is rendered for some seconds. Its day repeats these images: while it is active, it
goes to and fro over eight frames and moves on every five seconds; at rest, over two frames. It is
active for most of the dark hours and little of the light ones. A chunk of a file holds five
seconds, so that repeated images cost next to nothing on disk.
"""

import json
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
from liex_lab.pipelines.evaluation.speed import FPS, STEP_NS, to_and_fro

from liex_lab.recordings import open_recording, writer
from liex_lab.recordings.frame import DepthFrame
from liex_lab.sessions import Session
from tests.campaign.commands import ENDED, started

N_FILES = 24
_VIRTUAL = "synthetic:walk?seed=5&frames=900&sensor=primesense-qvga"
_START_NS = 1_772_434_800_000_000_000  # 2 March 2026, 07:00 UTC
_STRETCH = 150  # frames
_ACTIVE = {True: 0.15, False: 0.7}  # share of the stretches in light and in dark


def make_day(folder: Path, minutes: float, seed: int) -> int:
    """Write cam1_00.mcap ... of a day of some minutes from 07:00 on, light in its first half.

    Returns the number of its frames.
    """
    rng = np.random.default_rng(seed)
    folder.mkdir(parents=True, exist_ok=True)
    n_stretches = max(1, round(minutes * 60 * FPS / N_FILES / _STRETCH))
    with open_recording(_VIRTUAL) as short:
        depth, camera = [frame.depth for frame in short], short.camera
    writer._CHUNK_BYTES = _STRETCH * 2 * camera.width * camera.height
    way = to_and_fro(len(depth), 2 * len(depth) - 2)
    at = number = 0
    for k in range(N_FILES):
        path = folder / f"cam1_{k:02}.mcap"
        with writer.McapDepthWriter(path, camera) as file:
            for j in range(n_stretches):
                day_h = 24.0 * (k * n_stretches + j) / (N_FILES * n_stretches)
                active = rng.random() < _ACTIVE[day_h < 12.0]
                steps = to_and_fro(8 if active else 2, _STRETCH)
                if active:
                    steps[126:] = np.arange(24)  # after nine rounds, on its way
                for step in steps:
                    row = way[(at + step) % len(way)]
                    time_ns = _START_NS + number * STEP_NS
                    file.add(DepthFrame(number, time_ns, depth[row]))
                    number += 1
                at += 24 * bool(active)
    return number


def measure(folder: Path, minutes: float, kill_after_s: float) -> dict[str, Any]:
    """`liex run` on the day's files, killed once and run again, with its memory every 5 s.

    The first run is killed some seconds after its first checkpoint.
    """
    off_h, off_min = divmod(round(7 * 60 + minutes / 2), 60)
    light = ("light.on=07:00", f"light.off={off_h:02}:{off_min:02}", "light.zone=UTC")
    setting = [word for one in light for word in ("--set", one)]
    command: list[str | Path] = [
        "run",
        folder / "cam1_*.mcap",
        "--out",
        folder,
        "--no-depth",
        *setting,
    ]
    curve: list[tuple[float, float]] = []
    checkpoint = folder / "cam1.liex.part" / "checkpoint.json"
    began, codes = time.monotonic(), []
    for patience_s in (kill_after_s, float("inf")):
        process = started(*command, out=subprocess.DEVNULL)
        until = float("inf")
        while process.poll() is None and time.monotonic() < until:
            if until == float("inf") and checkpoint.is_file():
                until = time.monotonic() + patience_s
            curve.append((round(time.monotonic() - began), _memory_mb(process.pid)))
            time.sleep(5.0)
        process.kill()
        codes.append(process.wait())
    assert codes[-1] in ENDED, codes
    session = Session.open(folder / "cam1.liex")
    about = session.metadata
    row = session.rhythm.iloc[0]
    return {
        "frames": about["frames"]["n_frames"],
        "hours": about["frames"]["duration_s"] / 3600.0,
        "interruptions": about["interruptions"],
        "peak_memory_mb": about["peak_memory_mb"],
        "seconds": time.monotonic() - began,
        "frames_per_s_once_begun": about["frames_per_s"],
        "n_gaps": about["frames"]["n_gaps"],
        "dark_minus_light_mm_per_h": float(row["dark_minus_light_mm_per_h"]),
        "memory_mb_by_s": curve,
    }


def _memory_mb(pid: int) -> float:
    """Memory of a process that is its own: without pages of files."""
    try:
        status = Path(f"/proc/{pid}/status").read_text(encoding="utf-8")
    except OSError:
        return 0.0
    anonymous = [line.split()[1] for line in status.splitlines() if line.startswith("RssAnon")]
    return round(int(anonymous[0]) / 1024.0, 1) if anonymous else 0.0


def day(folder: Path, minutes: float, kill_after_s: float, seed: int) -> dict[str, Any]:
    """Make a day of some minutes, if it is not there, and measure it."""
    if not (folder / f"cam1_{N_FILES - 1:02}.mcap").is_file():
        n = make_day(folder, minutes, seed)
        print(json.dumps({"written_frames": n}), file=sys.stderr, flush=True)
    return measure(folder, minutes, kill_after_s)
