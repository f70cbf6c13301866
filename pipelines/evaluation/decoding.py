"""Benchmark of recording formats: decoding speed, opening time, peak memory.

`liex evaluate speed --recordings` writes a rendered mouse (640 x 480, PrimeSense noise) as MCAP
with zstd, MCAP with PNG, a folder of PNG pictures, and MoSeq's .dat, and reads each in
a process of its own on one thread. Numbers: frames/s (every frame to float32 mm in order, best of
`n_repeats`), ms a frame to open, peak memory of the process, MB, and the peak extrapolated to an
hour from 64 x 48 pictures, since what grows with length does not depend on their size.
"""

from __future__ import annotations

import json
import os
import platform
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from liex_lab.errors import LiexError
from liex_lab.optics.camera import Camera
from liex_lab.recordings.formats.messages.mcap_writer import McapDepthWriter
from liex_lab.recordings.frame import Depth, DepthFrame
from liex_lab.recordings.writer import PictureFolderWriter, RecordingWriter
from liex_lab.runtime.processes import own_python
from liex_lab.runtime.progress import Progress, silent

_N_FRAMES = 150
_N_REPEATS = 5
_HOUR = 30 * 3600  # frames
_STEP_NS = 33_333_333
_SMALL = Camera(60.0, 60.0, 31.5, 23.5, 64, 48)
_ONE_CORE = (
    "OMP_NUM_THREADS",
    "NUMBA_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "OPENCV_FOR_THREADS_NUM",
)
_READ = "from liex_lab.pipelines.evaluation.decoding import read_aloud; read_aloud()"
_PROTOCOL = (
    "rendered pictures of a mouse with a PrimeSense camera's noise ({width} x {height}, {n} "
    "frames), written by liex_lab and read in a process of its own on one thread; frames a "
    "second: every frame decoded to float32 millimetres in order, best of {repeats}; opening: "
    "finding every frame and its time, once; peak memory: of the whole process. An hour's peak is "
    "that of the full-sized pictures plus what {hour} frames of 64 x 48 pixels take more than {n} "
    "of them, for what grows with length is what is kept of every frame, whatever its size"
)


class MoseqWriter(RecordingWriter):
    """A MoSeq session: depth.dat, depth_ts.txt in milliseconds and metadata.json."""

    def __init__(self, path: Path, camera: Camera) -> None:
        """Make the folder.

        Args:
            path: the folder, which must not exist.
            camera: the camera of the frames, for camera.toml.
        """
        super().__init__(path, camera)
        path.mkdir()
        size = [camera.width, camera.height]
        (path / "metadata.json").write_text(json.dumps({"DepthResolution": size}), encoding="utf-8")
        lens = "".join(f"{name} = {getattr(camera, name)}\n" for name in ("fx", "fy", "cx", "cy"))
        (path / "camera.toml").write_text(f"[camera]\n{lens}", encoding="utf-8")
        self._depth = (path / "depth.dat").open("wb")
        self._stamps = (path / "depth_ts.txt").open("w", encoding="utf-8")

    def add(self, frame: DepthFrame) -> None:
        """Append a frame: depth as little-endian uint16 mm, its time in ms.

        Args:
            frame: the frame, depth (H, W) float32 mm.
        """
        self._depth.write(frame.depth.astype("<u2").tobytes())
        self._stamps.write(f"{frame.time_ns / 1e6:.6f} 0\n")

    def finish(self) -> None:
        """Nothing belongs at the end."""

    def release(self) -> None:
        """Close both files; closing twice does no harm."""
        self._depth.close()
        self._stamps.close()


# what is measured: the name of a format, what writes it, and how many frames of it may be an hour.
# Ten minutes of pictures in a folder are 18,000 files, and the other fifty would be like them.
_FORMATS: dict[str, tuple[str, Callable[[Path, Camera], RecordingWriter], int]] = {
    "mcap_zstd_raw": ("r.mcap", McapDepthWriter, 1),
    "mcap_zstd_png": (
        "r.mcap",
        lambda path, camera: McapDepthWriter(path, camera, packing="png"),
        1,
    ),
    "png_folder": ("r", PictureFolderWriter, 6),
    "moseq_dat": ("r", MoseqWriter, 1),
}


def evaluate_recordings(
    *,
    n_frames: int = _N_FRAMES,
    n_hour: int = _HOUR,
    n_repeats: int = _N_REPEATS,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Decoding speed and peak memory of every format that is written; see the protocol in it.

    Args:
        n_frames: frames of each full-sized recording.
        n_hour: frames of an hour's recording, 30 frames/s; of a folder of pictures a sixth is
            written.
        n_repeats: how often each recording is read, the best counts.
        progress: told format by format.

    Returns:
        By format: `frames_per_s_1core`, `open_ms_per_frame`, `peak_mb`, `peak_mb_of_an_hour`;
        machine and protocol.

    Raises:
        LiexError: the process that reads a recording failed.
    """
    camera, pictures = _rendered(progress)
    small = (
        np.random.default_rng(7)
        .integers(690, 711, (16, _SMALL.height, _SMALL.width))
        .astype(np.float32)
    )
    rate: dict[str, float] = {}
    opening: dict[str, float] = {}
    peak: dict[str, float] = {}
    hour: dict[str, float] = {}
    for k, (name, (file, writer, share)) in enumerate(_FORMATS.items()):
        progress(k, len(_FORMATS), f"timing {name}")
        full = _measure(file, writer, camera, pictures, n_frames, n_repeats)
        short = _measure(file, writer, _SMALL, small, n_frames, 1)
        long = _measure(file, writer, _SMALL, small, n_hour // share, 1)
        rate[name] = full["frames_per_s"]
        opening[name] = full["open_ms_per_frame"]
        peak[name] = full["peak_mb"]
        hour[name] = full["peak_mb"] + max(0.0, long["peak_mb"] - short["peak_mb"]) * share
    return {
        "frames_per_s_1core": rate,
        "open_ms_per_frame": opening,
        "peak_mb": peak,
        "peak_mb_of_an_hour": hour,
        "machine": f"{platform.processor() or platform.machine()}, one of {os.cpu_count()} cores",
        "protocol": _PROTOCOL.format(
            width=camera.width, height=camera.height, n=n_frames, repeats=n_repeats, hour=n_hour
        ),
    }


def _rendered(progress: Progress) -> tuple[Camera, NDArray[np.float32]]:
    """Depth (n, H, W) mm of a rendered recording of 640 x 480 pixels."""
    from liex_lab.simulation.address import open_synthetic

    recording = open_synthetic("synthetic:walk?seed=5&frames=30&sensor=primesense")
    frames = []
    for frame in recording:
        progress(frame.index, len(recording), "rendering pictures")
        frames.append(np.round(frame.depth))
    return recording.camera, np.stack(frames)


def _measure(
    file: str,
    writer: Callable[[Path, Camera], RecordingWriter],
    camera: Camera,
    pictures: NDArray[np.float32],
    n_frames: int,
    n_repeats: int,
) -> dict[str, float]:
    """Write the pictures over and over up to `n_frames`, and read them in a process of its own."""
    with tempfile.TemporaryDirectory(prefix="liex-") as folder:
        path = Path(folder) / file
        with writer(path, camera) as out:
            for frame in _repeated(pictures, n_frames):
                out.add(frame)
        return read_alone(path, n_repeats)


def read_alone(path: Path, n_repeats: int) -> dict[str, float]:
    """Read a recording in a process of its own on one thread.

    Args:
        path: the recording.
        n_repeats: how often it is read, the best counts.

    Returns:
        `frames_per_s`, `open_ms_per_frame` and `peak_mb`.

    Raises:
        LiexError: the process failed.
    """
    environment = os.environ | dict.fromkeys(_ONE_CORE, "1")
    command = own_python("-c", _READ, str(path), str(n_repeats))
    ran = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    if ran.returncode:
        raise LiexError(
            f"reading {path.name} in a process of its own failed ({ran.stderr.strip()[-300:]}); "
            "report this"
        )
    numbers: dict[str, float] = json.loads(ran.stdout)
    return numbers


def _repeated(pictures: NDArray[np.float32], n_frames: int) -> Iterator[DepthFrame]:
    for k in range(n_frames):
        depth: Depth = pictures[k % len(pictures)]
        yield DepthFrame(k, (k + 1) * _STEP_NS, depth)


def read_aloud() -> None:
    """Read the recording named on the command line, and print the numbers as JSON."""
    from liex_lab.recordings import open_recording
    from liex_lab.runtime.memory import peak_memory_mb

    path = sys.argv[1]
    n_repeats = int(sys.argv[2])
    began = time.perf_counter()
    with open_recording(path, strict=True) as recording:
        opened_s = time.perf_counter() - began
        seconds = []
        recording.frame(0)  # what is loaded or compiled for the first frame is no part of the speed
        for _ in range(n_repeats):
            began = time.perf_counter()
            for _frame in recording:
                pass
            seconds.append(time.perf_counter() - began)
        numbers = {
            "frames_per_s": len(recording) / min(seconds),
            "open_ms_per_frame": 1000.0 * opened_s / len(recording),
            "peak_mb": peak_memory_mb() or 0.0,
        }
    print(json.dumps(numbers))
