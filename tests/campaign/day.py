"""A simulated day in 24 files or more: memory, time, a kill, and a session like any other.

A virtual mouse is rendered for some seconds. Its day repeats these images: while it is active, it
goes to and fro over eight frames and moves on every five seconds; at rest, over two frames. It is
active for most of the dark hours and little of the light ones. A chunk of a file holds five
seconds, so that repeated images cost next to nothing on disk.

`day-end` measures only the end of a session, so that 24 h fit into an hour: the files show one
image of every five seconds, and the unfinished session gets the poses of the whole day from those
of the short recording, as if a run had been killed after the last frame. `liex run` then goes on.
"""

import json
import resource
import subprocess
import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
from liex_lab.pipelines.evaluation.speed import FPS, STEP_NS, to_and_fro
from liex_lab.pipelines.session import Prepared, run_session
from numpy.typing import NDArray

from liex_lab.recordings import open_recording, writer
from liex_lab.recordings.depth_kernels import rvl_message
from liex_lab.recordings.frame import Depth, DepthFrame
from liex_lab.sessions import Session
from liex_lab.sessions.writer import SessionWriter, observation_rows
from liex_lab.tracking.observations import Observations
from tests.campaign.commands import ENDED, started

N_FILES = 24
_N_SHORT = 900
_VIRTUAL = f"synthetic:walk?seed=5&frames={_N_SHORT}&sensor=primesense-qvga"
_START_NS = 1_772_434_800_000_000_000  # 2 March 2026, 07:00 UTC
_STRETCH = 150  # frames
_KILL_AFTER_S = 30.0
_ACTIVE = {True: 0.15, False: 0.7}  # share of the stretches in light and in dark


def rows_of_day(minutes: float, seed: int) -> list[NDArray[np.int64]]:
    """The images (150,) of each stretch of a day of some minutes, by row of the short recording.

    Every file has the same number of stretches.
    """
    rng = np.random.default_rng(seed)
    n_stretches = N_FILES * max(1, round(minutes * 60 * FPS / N_FILES / _STRETCH))
    way = to_and_fro(_N_SHORT, 2 * _N_SHORT - 2)
    stretches = []
    at = 0
    for k in range(n_stretches):
        active = rng.random() < _ACTIVE[24.0 * k / n_stretches < 12.0]
        steps = to_and_fro(8 if active else 2, _STRETCH)
        if active:
            steps[126:] = np.arange(24)  # after nine rounds, on its way
        stretches.append(way[(at + steps) % len(way)])
        at += 24 * bool(active)
    return stretches


class _Repeating(writer.McapDepthWriter):
    """Writer that packs an image once for all frames that show it."""

    _packed: tuple[Depth | None, bytes] = (None, b"")

    def _image(self, frame: DepthFrame) -> bytes:
        assert isinstance(self._messages, writer.RosMessages)
        if frame.depth is not self._packed[0]:
            exact = writer.steps_of(frame, 1.0, exact=True)
            self._packed = frame.depth, rvl_message(exact).tobytes()
        how = "16UC1; compressedDepth rvl"
        return self._messages.packed_image(frame.time_ns, self._packed[1], how)


def make_day(folder: Path, minutes: float, seed: int, every_image: bool = True) -> int:
    """Write cam1_00.mcap ... of a day of some minutes from 07:00 on, light in its first half.

    If not `every_image`, a stretch repeats its first one. Returns the number of its frames.
    """
    folder.mkdir(parents=True, exist_ok=True)
    stretches = rows_of_day(minutes, seed)
    with open_recording(_VIRTUAL) as short:
        depth, camera = [frame.depth for frame in short], short.camera
    writer._CHUNK_BYTES = _STRETCH * 2 * camera.width * camera.height
    number = 0
    for k, of_file in enumerate(np.split(np.array(stretches), N_FILES)):
        path = folder / f"cam1_{k:02}.mcap"
        with (
            writer.McapDepthWriter(path, camera)
            if every_image
            else _Repeating(path, camera, messages="ros", packing="rvl")
        ) as file:
            for row in (of_file if every_image else of_file[:, :1].repeat(_STRETCH, 1)).ravel():
                file.add(DepthFrame(number, _START_NS + number * STEP_NS, depth[row]))
                number += 1
    return number


def measure_all_but_the_end(folder: Path, minutes: float, seed: int) -> None:
    """Leave the session of the day's files as a run that is killed after their last frame."""

    def repeated(prepared: Prepared, _: Any, session: SessionWriter, __: Any) -> None:
        """Write the poses of the day, those of the short recording's images."""
        with open_recording(_VIRTUAL) as short:
            frames = list(short)
        observe = prepared.fitted.tracker.observe
        short_seen = Observations.join(
            [observe(frames[k : k + 32]) for k in range(0, len(frames), 32)]
        )
        times_ns = prepared.recording.times_ns
        begin = 0
        for rows in rows_of_day(minutes, seed):
            index = range(begin, begin + len(rows))
            shown = [DepthFrame(k, int(times_ns[k]), frames[0].depth) for k in index]
            seen = replace(short_seen[rows], times_ns=times_ns[begin : index.stop])
            session._index.extend(index)
            session._times_ns.extend(times_ns[begin : index.stop].tolist())
            session._checkpoint.columns.append(observation_rows(shown, seen))
            begin = index.stop
        session._save_checkpoint()
        raise KeyboardInterrupt

    asked = ["replay.depth=none", *_light(minutes)]
    with patch.object(Prepared, "measure_all", repeated), suppress(KeyboardInterrupt):
        run_session(folder / "cam1_*.mcap", out=folder, settings=asked)


def _light(minutes: float) -> list[str]:
    """The plan's light in the first half of the day."""
    off_h, off_min = divmod(round(7 * 60 + minutes / 2), 60)
    return ["light.on=07:00", f"light.off={off_h:02}:{off_min:02}", "light.zone=UTC"]


def measure(folder: Path, minutes: float, kills_after_s: Sequence[float]) -> dict[str, Any]:
    """`liex run` on the day's files, killed and run again, with its memory every 5 s.

    A run is killed some seconds after its first checkpoint, for each of `kills_after_s`.
    """
    setting = [word for one in _light(minutes) for word in ("--set", one)]
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
    for patience_s in (*kills_after_s, float("inf")):
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
        # with the report, and pages of mapped files
        "peak_resident_mb": resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024.0,
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


def day(folder: Path, minutes: float, seed: int, only_end: bool = False) -> dict[str, Any]:
    """Make a day of some minutes, if it is not there, and measure it, or only its session's end."""
    if not (folder / f"cam1_{N_FILES - 1:02}.mcap").is_file():
        n = make_day(folder, minutes, seed, not only_end)
        print(json.dumps({"written_frames": n}), file=sys.stderr, flush=True)
    if only_end:
        measure_all_but_the_end(folder, minutes, seed)
    return measure(folder, minutes, () if only_end else (_KILL_AFTER_S,))
