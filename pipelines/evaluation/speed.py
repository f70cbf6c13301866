"""Speed of pose estimation, and the timers of all benchmarks.

`liex evaluate speed` times rendered frames of the split `clean`, in memory, from foreground to
final pose (Lie-X Table 3), the best of 5 repeats after one that compiles: frames/s of the default
on one and on two cores, the ratio to the paper's variant on our engine, to Algorithm 1 as
published, and to the baselines that were trained on this machine; and ms per frame on one core by
stage, and by number of joints, of candidates and of pixels.
"""

import json
import os
import platform
import shutil
import subprocess
import tarfile
import tempfile
import time
import timeit
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any, cast

import numba
import numpy as np
from numpy.typing import NDArray

from liex_lab.baselines.baseline import Baseline
from liex_lab.body.skeleton import Skeleton
from liex_lab.errors import LiexError, MissingPackageError
from liex_lab.estimation.cascade import Candidates, ImageSet, draw_starts, start_poses
from liex_lab.estimation.estimator import PoseEstimator
from liex_lab.optics.camera import Camera
from liex_lab.plan import Plan
from liex_lab.recordings import open_recording
from liex_lab.recordings.frame import DepthFrame
from liex_lab.recordings.recording import Recording
from liex_lab.recordings.writer import ImageFolderWriter, McapDepthWriter, RecordingWriter
from liex_lab.runtime.processes import own_python, threads
from liex_lab.runtime.progress import Progress, silent
from liex_lab.scene.height_maps import Segmenter
from liex_lab.sessions import Session
from liex_lab.sessions.folder import folder_bytes
from liex_lab.simulation.recording import RenderedRecording
from liex_lab.simulation.simulator import open_synthetic, world_of

from ..build import build_scene, plan_of
from ..convert import convert
from ..training.pose_model import (
    BASELINES,
    cached_baseline,
    estimator_of,
    trained_baseline,
    training_of,
)

N_FRAMES = 128
N_REPEATS = 5
_PROTOCOL = (
    "{n} rendered {pixels} frames in memory, foreground to final pose, best of {repeats}; ratios "
    "on {cores} cores in the same run, `paper` on our engine, `paper_one_by_one` compiled but as "
    "published: every candidate walks down every tree by itself, and leaves are averaged; stages "
    "and costs in ms a frame on one core: `joints` is the whole with that many joints' regressors, "
    "`candidates` unpruned, `pixels` the foreground alone"
)


FPS = 30
STEP_NS = int(1e9 / FPS)
_CHILD = """
import json, sys, time
from importlib import import_module
module, name = sys.argv[1].split(":")
job = getattr(import_module(module), name)
began = time.perf_counter()
found = job(*map(json.loads, sys.argv[2:]))
seconds = time.perf_counter() - began
from liex_lab.runtime.memory import peak_memory_mb
facts = {"seconds": seconds, "peak_memory_mb": peak_memory_mb() or 0.0}
print(json.dumps(facts | (found if isinstance(found, dict) else {})))
"""


def best_seconds(job: Callable[[], Any], n_repeats: int = 5) -> float:
    """Shortest time, s, of several runs after one that compiles: the least disturbed one."""
    job()
    return min(timeit.repeat(job, number=1, repeat=n_repeats))


def isolated(job: str, *arguments: object, one_thread: bool = False) -> dict[str, Any]:
    """Run a function in a separate Python process.

    Args:
        job: "module:function"; its result is kept if it is a dict of plain values.
        *arguments: of the function, numbers and texts; others are passed as texts.
        one_thread: one thread for kernels and image decoders.

    Returns:
        The function's result, with its `seconds` and the process's `peak_memory_mb`, unless these
        are in the result, and `seconds_with_start`, elapsed time including the start of Python.

    Raises:
        LiexError: the process failed.
    """
    words = [json.dumps(one if isinstance(one, int | float) else str(one)) for one in arguments]
    environment = os.environ | dict.fromkeys(
        (
            *("OMP_NUM_THREADS", "NUMBA_NUM_THREADS", "OPENBLAS_NUM_THREADS"),
            "OPENCV_FOR_THREADS_NUM",
        )
        if one_thread
        else (),
        "1",
    )
    began = time.perf_counter()
    ran = subprocess.run(
        own_python("-c", _CHILD, job, *words),
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    seconds = time.perf_counter() - began
    if ran.returncode:
        raise LiexError(
            f"{job} failed in a process of its own ({ran.stderr.strip()[-300:]}); report this"
        )
    return {**json.loads(ran.stdout.splitlines()[-1]), "seconds_with_start": seconds}


@contextmanager
def two_cores() -> Iterator[int]:
    """A context in which kernels run on at most two cores; yields their number."""
    cores = min(2, numba.config.NUMBA_NUM_THREADS)
    with threads(parallel=True):  # restores their number
        numba.set_num_threads(cores)
        yield cores


@dataclass(frozen=True)
class SpeedSample:
    """Frames in memory of a rendered recording, its segmentation and the animal's size.

    Attributes:
        frames: (n, H, W) float32 depth, mm.
        scene: the learned segmentation.
        sample: the frames that it was learned from.
        size: the animal's size over home size.
    """

    frames: NDArray[np.float32]
    scene: Segmenter
    sample: NDArray[np.float32]
    size: float

    @staticmethod
    def of(
        animal: str,
        recordings: Sequence[RenderedRecording],
        subject: PoseEstimator | Baseline,
        n_frames: int,
    ) -> "SpeedSample":
        """The first frames of the recording with the widest depth images, repeated as needed."""
        recording = max(recordings, key=lambda one: one.width)
        scene, sample = build_scene(recording, plan_of(animal), subject.skeleton, 96)
        frames = recording.depths(0, min(len(recording), n_frames))
        frames = frames[np.arange(n_frames) % len(frames)]
        return SpeedSample(frames, scene, sample, subject.find_size(sample, scene))

    @property
    def pixels(self) -> str:
        """Size of the depth images, such as `640 x 480`."""
        return f"{self.scene.camera.width} x {self.scene.camera.height}"

    def every(self, step: int) -> "SpeedSample":
        """The same frames with every so many-th pixel of rows and columns."""
        return replace(
            self,
            frames=np.ascontiguousarray(self.frames[:, ::step, ::step]),
            scene=self.scene.every(step),
        )

    def frames_per_s(
        self, subject: PoseEstimator | Baseline, parallel: bool, n_repeats: int
    ) -> float:
        """Frames per second of a subject, on one core or on those that numba may use."""
        return len(self.frames) / best_seconds(
            partial(subject.estimate, self.frames, self.scene, self.size, parallel), n_repeats
        )


def evaluate_speed(animal: str = "mouse", *, progress: Progress = silent) -> dict[str, Any]:
    """Frames per second from frames in memory to poses, foreground included; `liex evaluate speed`.

    The paper's variant is trained if needed; baselines are timed if they are trained already.

    Args:
        animal: a bundled animal's name, or the path of a skeleton's TOML.
        progress: called with the stage, of five.

    Returns:
        `frames_per_s_1core`, `frames_per_s_2cores`, `ratio_to_paper`, `ratio_to` by rival,
        `stages_ms` and `cost_ms` per frame, machine and protocol.
    """
    progress(0, 5, "rendering frames")
    default = estimator_of(animal, "default")
    footage = SpeedSample.of(
        animal, world_of(Skeleton.load(animal)).test_split("clean", n_sessions=2), default, N_FRAMES
    )
    rivals = _rivals(animal, progress)
    with two_cores() as cores:
        progress(1, 5, "timing the default")
        one, two = (footage.frames_per_s(default, several, N_REPEATS) for several in (False, True))
        progress(2, 5, "timing the others")
        ratios = {
            name: two / footage.frames_per_s(rival, True, N_REPEATS)
            for name, rival in rivals.items()
        }
        one_by_one = partial(_one_by_one, cast("PoseEstimator", rivals["paper"]), footage)
        ratios["paper_one_by_one"] = two * best_seconds(one_by_one, N_REPEATS) / N_FRAMES
        progress(3, 5, "timing the stages")
        stages, costs = _stages_and_costs(default, footage)
    return {
        "animal": animal,
        "frames_per_s_1core": one,
        "frames_per_s_2cores": two,
        "ratio_to_paper": ratios["paper"],
        "ratio_to": ratios,
        "stages_ms": stages,
        "cost_ms": costs,
        "machine": f"{_machine()}, {cores} of {numba.config.NUMBA_NUM_THREADS} cores",
        "protocol": _PROTOCOL.format(
            n=N_FRAMES, pixels=footage.pixels, repeats=N_REPEATS, cores=cores
        ),
    }


def _rivals(animal: str, progress: Progress) -> dict[str, PoseEstimator | Baseline]:
    """The paper's variant, and the baselines that have been trained on this machine."""
    rivals: dict[str, PoseEstimator | Baseline] = {"paper": estimator_of(animal, "paper", progress)}
    skeleton = Skeleton.load(animal)
    for name in BASELINES:
        if cached_baseline(name, skeleton, training_of(name, skeleton)).is_file():
            with suppress(MissingPackageError):  # the CNN needs torch
                rivals[name] = trained_baseline(animal, name)
    return rivals


def _one_by_one(paper: PoseEstimator, footage: SpeedSample) -> NDArray[Any]:
    """Algorithm 1 as published, from frames to candidate scores, without shared steps."""
    method, skeleton, cascade = paper.model.method, paper.skeleton, paper.model.cascade
    crops = footage.scene.extract(footage.frames, 1.0, camera_view=method.camera_view)
    images = ImageSet(
        crops.heights, footage.scene.crop_cameras(crops, method.camera_view), crops.moments
    )
    n, k = len(crops.heights), method.n_candidates
    rotation, position, scale = start_poses(
        crops.moments,
        draw_starts(np.random.default_rng(0), 1, k),
        np.ones((n, k)),
        skeleton,
        method,
    )
    poses = Candidates.start(
        skeleton,
        np.repeat(np.arange(n, dtype=np.int32), k),
        rotation.reshape(-1, 3, 3),
        position.reshape(-1, 3),
        scale.ravel(),
        np.ones(n * k),
    )
    deque(cascade.steps(images, poses), 0)
    return cascade.predict(paper.model.metric, cascade.metric_samples(images, poses))


def _stages_and_costs(
    default: PoseEstimator, footage: SpeedSample
) -> tuple[dict[str, float], dict[str, dict[str, float]]]:
    """Milliseconds per frame on one core by stage, and by number of joints, candidates, pixels."""
    scene, size = footage.scene, footage.size
    view = default.model.method.camera_view
    crops = scene.extract(footage.frames, size, camera_view=view)
    cameras = scene.crop_cameras(crops, view)
    detection = default.candidates(crops, cameras, size)

    def ms(job: Callable[..., Any], *arguments: Any) -> float:
        return 1000.0 * best_seconds(partial(job, *arguments), N_REPEATS) / N_FRAMES

    def candidates_ms(estimator: PoseEstimator) -> float:
        return ms(estimator.candidates, crops, cameras, size, False)

    stages = {
        "foreground": ms(scene.extract, footage.frames, size, False, view),
        "candidates": candidates_ms(default),
        "choice": ms(default.pick, detection, size, False),
    }
    n_joints = len(default.skeleton.solved)
    # every second pixel, and every pixel
    sizes = [footage.every(step) for step in (2, 1)]
    costs = {
        "joints": {
            str(n): candidates_ms(replace(default, n_joints=n))
            for n in sorted({1, (n_joints + 1) // 2, n_joints})
        },
        "candidates": {
            str(n): candidates_ms(replace(default, n_candidates=n, unpruned=True))
            for n in (5, 10, 20, 40)
        },
        "pixels": {one.pixels: ms(one.scene.extract, one.frames, size, False) for one in sizes},
    }
    return stages, costs


def looped(
    short: Recording, n_frames: int, name: str = "long", step_ns: int = STEP_NS
) -> Recording:
    """A recording of any length: a short one's frames, in memory, forwards and backwards."""
    depth = [short.frame(row).depth for row in range(len(short))]
    rows = to_and_fro(len(depth), n_frames)
    long = Recording(
        name=name,
        format="synthetic",
        camera=short.camera,
        times_ns=step_ns * np.arange(n_frames, dtype=np.int64),
        read=lambda row: depth[rows[row]],
    )
    long.files.known_digest = "0" * 64
    return long


def to_and_fro(n_short: int, n: int) -> NDArray[np.int64]:
    """(n,) index of each frame in the short recording, forwards and backwards."""
    return np.resize([*range(n_short), *range(n_short - 2, 0, -1)], n)


# Benchmarks of recording formats: reading speed, and the cost of a whole run.


_SMALL = Camera(60.0, 60.0, 31.5, 23.5, 64, 48)
_VIRTUAL = "synthetic:walk?seed=5&frames={frames}&sensor={sensor}"
_READING_PROTOCOL = (
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


def write_with(
    writer: Callable[[Path, Camera], RecordingWriter],
    path: Path,
    camera: Camera,
    frames: Iterable[DepthFrame],
) -> None:
    """Write frames by a recording writer."""
    with writer(path, camera) as out:
        for frame in frames:
            out.add(frame)


def write_moseq(path: Path, camera: Camera, frames: Iterable[DepthFrame]) -> None:
    """Write a MoSeq session: depth.dat, depth_ts.txt in milliseconds and metadata.json."""
    path.mkdir()
    (path / "metadata.json").write_text(
        json.dumps({"DepthResolution": [camera.width, camera.height]}), encoding="utf-8"
    )
    lens = "".join(f"{name} = {getattr(camera, name)}\n" for name in ("fx", "fy", "cx", "cy"))
    (path / "camera.toml").write_text(f"[camera]\n{lens}", encoding="utf-8")
    with (path / "depth.dat").open("wb") as depth, (path / "depth_ts.txt").open("w") as stamps:
        for frame in frames:
            depth.write(frame.depth.astype("<u2").tobytes())
            stamps.write(f"{frame.time_ns / 1e6:.6f} 0\n")


# name: file, how it is written, and the factor by which an hour is longer than what is written. Ten
# minutes of images in a folder are 18,000 files, and the other fifty would be like them.
FORMATS: dict[str, tuple[str, Callable[[Path, Camera, Iterable[DepthFrame]], None], int]] = {
    "mcap_zstd_raw": ("r.mcap", partial(write_with, McapDepthWriter), 1),
    "mcap_zstd_png": ("r.mcap", partial(write_with, partial(McapDepthWriter, packing="png")), 1),
    "png_folder": ("r", partial(write_with, ImageFolderWriter), 6),
    "moseq_dat": ("r", write_moseq, 1),
}


def evaluate_recordings(
    *,
    n_frames: int = 150,
    n_hour: int = 3600 * FPS,
    n_repeats: int = 5,
    progress: Progress = silent,
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
    for k, (name, (file, write, share)) in enumerate(FORMATS.items()):
        progress(k, len(FORMATS), f"timing {name}")
        read = []
        for lens, some, n, repeats in (
            (camera, images, n_frames, n_repeats),
            (_SMALL, small, n_frames, 1),
            (_SMALL, small, n_hour // share, 1),
        ):
            with tempfile.TemporaryDirectory(prefix="liex-") as scratch:
                write(
                    Path(scratch) / file,
                    lens,
                    (DepthFrame(k, (k + 1) * STEP_NS, some[k % len(some)]) for k in range(n)),
                )
                read.append(read_alone(Path(scratch) / file, repeats))
        full, short, long = read
        for key, value in {
            "frames_per_s_1core": full["frames_per_s"],
            "open_ms_per_frame": full["open_ms_per_frame"],
            "peak_mb": full["peak_mb"],
            "peak_mb_of_an_hour": full["peak_mb"]
            + max(0.0, long["peak_mb"] - short["peak_mb"]) * share,
        }.items():
            found.setdefault(key, {})[name] = value
    facts = {"width": camera.width, "height": camera.height, "n": n_frames, "hour": n_hour}
    return {
        **found,
        "machine": f"{_machine()}, one of {os.cpu_count()} cores",
        "protocol": _READING_PROTOCOL.format(repeats=n_repeats, **facts),
    }


def _machine() -> str:
    return platform.processor() or platform.machine()


def _rendered(progress: Progress) -> tuple[Camera, NDArray[np.float32]]:
    """Depth (n, H, W) mm of a rendered recording of 640 x 480 pixels."""
    recording = open_synthetic(_VIRTUAL.format(frames=30, sensor="primesense"))
    progress(0, None, "rendering frames")
    return recording.camera, np.stack([np.round(frame.depth) for frame in recording])


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
        recording.frame(0)  # loading and compilation for the first frame do not count
        seconds = timeit.repeat(lambda: deque(recording, 0), number=1, repeat=n_repeats)
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
        with open_recording(_VIRTUAL.format(frames=min(150, n_frames), sensor=sensor)) as short:
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
    folder, packed = place / "session_walk", place / "session_walk.tar.gz"
    write_moseq(folder, recording.camera, recording)
    (folder / "camera.toml").rename(place / "camera.toml")
    with tarfile.open(packed, "w:gz", compresslevel=6) as archive:  # as tar does
        for file in sorted(folder.iterdir()):
            archive.add(file, file.name)
    shutil.rmtree(folder)
    return packed


KINDS: dict[str, tuple[str, Callable[[Recording, Path], Path]]] = {
    "mcap_raw_640x480": ("primesense", as_mcap),
    "moseq_gz_512x424": ("kinect-v2", as_moseq),
}
