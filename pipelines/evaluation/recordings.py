"""Benchmarks of recording formats: reading speed, and the cost of a whole run.

`liex evaluate speed --recordings` writes a rendered mouse (640 x 480, PrimeSense noise) in several
formats and reads each in a separate process on one thread. `liex evaluate scale` runs a mouse of
each kind as `liex run` does, in a separate process, with all files written, and reads the recording
before and after: the mean of both rates is one core's decoding rate.
"""

from __future__ import annotations

import json
import os
import platform
import shutil
import tarfile
import tempfile
import time
from collections.abc import Callable, Iterable
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from liex_lab.optics.camera import Camera
from liex_lab.plan import Plan
from liex_lab.recordings import open_recording
from liex_lab.recordings.frame import DepthFrame
from liex_lab.recordings.recording import Recording
from liex_lab.recordings.writer import McapDepthWriter, PictureFolderWriter, RecordingWriter
from liex_lab.runtime.progress import Progress, silent
from liex_lab.sessions import Session
from liex_lab.sessions.folder import folder_bytes

from ..convert import convert
from .speed import FPS, STEP_NS, isolated, looped

_HOUR = 3600 * FPS  # frames
_SMALL = Camera(60.0, 60.0, 31.5, 23.5, 64, 48)
_VIRTUAL = "synthetic:walk?seed=5&frames={frames}&sensor={sensor}"
_PROTOCOL = (
    "rendered depth images of a mouse with a PrimeSense camera's noise ({width} x {height}, {n} "
    "frames), written by liex_lab and read in a process of its own on one thread; frames a "
    "second: every frame decoded to float32 millimetres in order, best of {repeats}; opening: "
    "finding every frame and its time, once; peak memory: of the whole process. An hour's peak is "
    "that of the full-sized images plus what {hour} frames of 64 x 48 pixels take more than {n} "
    "of them, because what grows with length is kept per frame, whatever its size"
)
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


class MoseqWriter(RecordingWriter):
    """A MoSeq session: depth.dat, depth_ts.txt in milliseconds and metadata.json."""

    def __init__(self, path: Path, camera: Camera) -> None:
        """Make the folder `path`, which must not exist."""
        super().__init__(path, camera)
        path.mkdir()
        size = [camera.width, camera.height]
        (path / "metadata.json").write_text(json.dumps({"DepthResolution": size}), encoding="utf-8")
        lens = "".join(f"{name} = {getattr(camera, name)}\n" for name in ("fx", "fy", "cx", "cy"))
        (path / "camera.toml").write_text(f"[camera]\n{lens}", encoding="utf-8")
        self._depth = (path / "depth.dat").open("wb")
        self._stamps = (path / "depth_ts.txt").open("w", encoding="utf-8")

    def add(self, frame: DepthFrame) -> None:
        """Append a frame: depth as little-endian uint16 mm, its time in ms."""
        self._depth.write(frame.depth.astype("<u2").tobytes())
        self._stamps.write(f"{frame.time_ns / 1e6:.6f} 0\n")

    def finish(self) -> None:
        """Nothing to write at the end."""

    def release(self) -> None:
        """Close both files; may be called twice."""
        self._depth.close()
        self._stamps.close()


def _png_mcap(path: Path, camera: Camera) -> RecordingWriter:
    return McapDepthWriter(path, camera, packing="png")


# name: file, writer, and the factor by which an hour is longer than what is written. Ten minutes of
# images in a folder are 18,000 files, and the other fifty would be like them.
FORMATS: dict[str, tuple[str, Callable[[Path, Camera], RecordingWriter], int]] = {
    "mcap_zstd_raw": ("r.mcap", McapDepthWriter, 1),
    "mcap_zstd_png": ("r.mcap", _png_mcap, 1),
    "png_folder": ("r", PictureFolderWriter, 6),
    "moseq_dat": ("r", MoseqWriter, 1),
}


def evaluate_recordings(
    *, n_frames: int = 150, n_hour: int = _HOUR, n_repeats: int = 5, progress: Progress = silent
) -> dict[str, Any]:
    """Decoding speed and peak memory of every written format, as the protocol states.

    Args:
        n_frames: frames of each full-sized recording.
        n_hour: frames of an hour's recording.
        n_repeats: number of readings of each recording; the best counts.
        progress: called format by format.

    Returns:
        By format: `frames_per_s_1core`, `open_ms_per_frame`, `peak_mb`, `peak_mb_of_an_hour`;
            machine and protocol.

    Raises:
        LiexError: the process that reads a recording failed.
    """
    camera, images = _rendered(progress)
    size = (16, _SMALL.height, _SMALL.width)
    small = np.random.default_rng(7).integers(690, 711, size).astype(np.float32)
    found: dict[str, Any] = {}
    for k, (name, (file, writer, share)) in enumerate(FORMATS.items()):
        progress(k, len(FORMATS), f"timing {name}")
        with tempfile.TemporaryDirectory(prefix="liex-") as scratch:
            path = Path(scratch) / file
            full, short, long = (
                read_alone(_write(writer, path, lens, some, n), repeats)
                for lens, some, n, repeats in (
                    (camera, images, n_frames, n_repeats),
                    (_SMALL, small, n_frames, 1),
                    (_SMALL, small, n_hour // share, 1),
                )
            )
        grows = max(0.0, long["peak_mb"] - short["peak_mb"]) * share
        for key, value in {
            "frames_per_s_1core": full["frames_per_s"],
            "open_ms_per_frame": full["open_ms_per_frame"],
            "peak_mb": full["peak_mb"],
            "peak_mb_of_an_hour": full["peak_mb"] + grows,
        }.items():
            found.setdefault(key, {})[name] = value
    machine = f"{platform.processor() or platform.machine()}, one of {os.cpu_count()} cores"
    facts = {"width": camera.width, "height": camera.height, "n": n_frames, "hour": n_hour}
    return {**found, "machine": machine, "protocol": _PROTOCOL.format(repeats=n_repeats, **facts)}


def _rendered(progress: Progress) -> tuple[Camera, NDArray[np.float32]]:
    """Depth (n, H, W) mm of a rendered recording of 640 x 480 pixels."""
    from liex_lab.simulation.address import open_synthetic

    recording = open_synthetic(_VIRTUAL.format(frames=30, sensor="primesense"))
    progress(0, None, "rendering frames")
    return recording.camera, np.stack([np.round(frame.depth) for frame in recording])


def _write(
    writer: Callable[[Path, Camera], RecordingWriter],
    path: Path,
    camera: Camera,
    images: NDArray[np.float32],
    n_frames: int,
) -> Path:
    """Write the images repeatedly, in place of an existing file or folder."""
    if path.exists():
        (shutil.rmtree if path.is_dir() else os.unlink)(path)
    with writer(path, camera) as out:
        for k in range(n_frames):
            out.add(DepthFrame(k, (k + 1) * STEP_NS, images[k % len(images)]))
    return path


def read_alone(path: Path, n_repeats: int = 1) -> dict[str, float]:
    """Read a recording in a separate process on one thread; the best of `n_repeats` counts.

    Returns:
        `frames_per_s`, `open_ms_per_frame` and `peak_mb`.

    Raises:
        LiexError: the process failed.
    """
    found = isolated(f"{__name__}:read_all", path, n_repeats, one_thread=True)
    return {**found, "peak_mb": found["peak_memory_mb"]}


def read_all(path: str, n_repeats: int) -> dict[str, float]:
    """Open a recording and read every frame in order: `frames_per_s` and `open_ms_per_frame`."""
    began = time.perf_counter()
    with open_recording(path, strict=True) as recording:
        opened_s = time.perf_counter() - began
        seconds = []
        recording.frame(0)  # loading and compilation for the first frame do not count
        for _ in range(n_repeats):
            began = time.perf_counter()
            for _frame in recording:
                pass
            seconds.append(time.perf_counter() - began)
        return {
            "frames_per_s": len(recording) / min(seconds),
            "open_ms_per_frame": 1000.0 * opened_s / len(recording),
        }


def evaluate_kinds(n_frames: int, folder: Path) -> dict[str, Any]:
    """The cost of a whole run of each kind of recording, after a first run has compiled everything.

    The recordings are written into an empty folder.

    Returns:
        By kind, the numbers defined in `DEFINITIONS`.

    Raises:
        LiexError: a run failed.
    """
    found: dict[str, Any] = {}
    for kind, (sensor, write) in KINDS.items():
        place = folder / kind
        place.mkdir()
        with open_recording(_VIRTUAL.format(frames=150, sensor=sensor)) as short:
            recording = write(looped(short, n_frames), place)
        if not found:
            isolated(f"{__name__}:run_mouse", recording, place / "first")
        found[kind] = _measured(recording, place / "results")
        shutil.rmtree(place)
    return found


def run_mouse(recording: str, out: str) -> None:
    """Run a recording with the plan of the mouse, as `liex run` does."""
    # by name: jobs do not import the public API, of which this process is a user
    import_module("liex_lab.api").run_session(recording, Plan.load("mouse"), out)


def _measured(recording: Path, out: Path) -> dict[str, float]:
    """The numbers of one recording and its run."""
    before = read_alone(recording)
    ran = isolated(f"{__name__}:run_mouse", recording, out)
    reads = (before, read_alone(recording))
    (path,) = out.glob("*.liex")
    facts = Session.open(path).metadata
    n, spent = facts["frames"]["n_frames"], facts["timings_s"]
    decoding, open_ms = (
        sum(one[name] for one in reads) / 2.0 for name in ("frames_per_s", "open_ms_per_frame")
    )
    read_bytes, written_bytes = recording.stat().st_size, folder_bytes(path)
    return {
        "frames_per_s": n / ran["seconds"],
        "frames_per_s_with_start": n / ran["seconds_with_start"],
        "decoding_frames_per_s_1core": decoding,
        "times_decoding": n / ran["seconds"] / decoding,
        "prepare_s": spent["prepare"],
        "report_s": ran["seconds"] - spent["prepare"] - spent["total"],
        "opening_s": n * open_ms / 1000.0,
        "recording_mb": read_bytes / 1e6,
        "session_mb": written_bytes / 1e6,
        "session_share": written_bytes / read_bytes,
        "peak_memory_mb": facts["peak_memory_mb"],
    }


def as_mcap(recording: Recording, place: Path) -> Path:
    """Write a recording as raw MCAP."""
    return convert(recording, place / f"{recording.name}.mcap").path


def as_moseq(recording: Recording, place: Path) -> Path:
    """Write a recording like a session packed by MoSeq's extract, as a .tar.gz."""
    folder = place / "session_walk"
    frames: Iterable[DepthFrame] = recording
    with MoseqWriter(folder, recording.camera) as writer:
        for frame in frames:
            writer.add(frame)
    (folder / "camera.toml").rename(place / "camera.toml")
    packed = place / "session_walk.tar.gz"
    with tarfile.open(packed, "w:gz", compresslevel=6) as archive:  # as tar does
        for file in sorted(folder.iterdir()):
            archive.add(file, file.name)
    shutil.rmtree(folder)
    return packed


KINDS: dict[str, tuple[str, Callable[[Recording, Path], Path]]] = {
    "mcap_raw_640x480": ("primesense", as_mcap),
    "moseq_gz_512x424": ("kinect-v2", as_moseq),
}
