"""Benchmark of pose estimation: frames per second, time by stage, and what makes a frame dearer.

`liex evaluate speed` times rendered frames of the split `clean`, in memory, from foreground to
final pose (Lie-X Table 3), the best of 5 repeats after one that compiles. Numbers: frames/s of the
default on one and on two cores; the ratio to the paper's variant on our engine, to Algorithm 1 as
it is written (every candidate walks down every tree by itself), and to baselines trained on this
machine; ms a frame on one core of foreground, candidates and choice, and against the number of
joints, of candidates and of pixels.
"""

from __future__ import annotations

import platform
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from numpy.typing import NDArray

from liex_lab.errors import MissingPackageError
from liex_lab.runtime.progress import Progress, silent

if TYPE_CHECKING:
    from liex_lab.baselines.baseline import Baseline
    from liex_lab.estimation.estimator import PoseEstimator
    from liex_lab.scene.segmenter import Segmenter

Array = NDArray[Any]
N_FRAMES = 128
N_REPEATS = 5
_CANDIDATES = (5, 10, 20, 40)
_SHRINK = (2, 1)  # every second pixel, every pixel


@dataclass(frozen=True)
class _Footage:
    """Frames in memory of a rendered recording, its segmentation and the animal's size.

    Attributes:
        name: of the recording.
        frames: (n, H, W) float32 depth, mm.
        scene: the learned segmentation.
        size: the animal's size over home size.
    """

    name: str
    frames: NDArray[np.float32]
    scene: Segmenter
    size: float

    @property
    def pixels(self) -> str:
        """Size of the pictures in words, such as `640 x 480`."""
        return f"{self.scene.camera.width} x {self.scene.camera.height}"


def best_seconds(job: Callable[[], Any], n_repeats: int | None = None) -> float:
    """Shortest time of several runs after one that compiles: the least disturbed by other programs.

    Args:
        job: what is timed.
        n_repeats: number of runs; None takes `N_REPEATS`.

    Returns:
        Seconds.
    """
    job()
    times = []
    for _ in range(n_repeats or N_REPEATS):
        began = time.perf_counter()
        job()
        times.append(time.perf_counter() - began)
    return min(times)


def evaluate_speed(animal: str = "mouse", *, progress: Progress = silent) -> dict[str, Any]:
    """Frames per second from frames in memory to poses, foreground included; `liex evaluate speed`.

    The paper's variant is trained where it has not been; baselines are timed where they have been.

    Args:
        animal: a bundled animal's name, or the path of a skeleton's TOML.
        progress: told the stage, of five.

    Returns:
        `frames_per_s_1core`, `frames_per_s_2cores`, `ratio_to_paper`, `ratio_to` by rival,
        `stages_ms` and `cost_ms` a frame, machine and protocol.
    """
    import numba

    from .pose import estimator_of

    progress(0, 5, "rendering frames")
    default = estimator_of(animal, "default")
    footage = _footage(animal, default)
    rivals = _rivals(animal, progress)
    cores = min(2, numba.config.NUMBA_NUM_THREADS)
    before = numba.get_num_threads()
    numba.set_num_threads(cores)
    try:
        progress(1, 5, "timing the default")
        one, two = (_frames_per_s(default, footage, parallel) for parallel in (False, True))
        progress(2, 5, "timing the others")
        ratios = {name: two / _frames_per_s(rival, footage, True) for name, rival in rivals.items()}
        paper = cast("PoseEstimator", rivals["paper"])
        ratios["paper_one_by_one"] = (
            two * best_seconds(partial(_one_by_one, paper, footage)) / N_FRAMES
        )
        progress(3, 5, "timing the stages")
        stages = _stages(default, footage)
        progress(4, 5, "timing what makes a frame dearer")
        costs = _costs(default, footage)
    finally:
        numba.set_num_threads(before)
    return {
        "animal": animal,
        "frames_per_s_1core": one,
        "frames_per_s_2cores": two,
        "ratio_to_paper": ratios["paper"],
        "ratio_to": ratios,
        "stages_ms": stages,
        "cost_ms": costs,
        "machine": (
            f"{platform.processor() or platform.machine()}, {cores} of "
            f"{numba.config.NUMBA_NUM_THREADS} cores"
        ),
        "protocol": (
            f"{N_FRAMES} rendered {footage.pixels} frames in memory, foreground to final pose, "
            f"best of {N_REPEATS}; ratios on {cores} cores in the same run, `paper` on our "
            "engine, `paper_one_by_one` compiled but as published: every candidate walks down "
            "every tree by itself, and leaves are averaged; stages and costs in ms a frame on "
            "one core: `joints` is the whole with that many joints' regressors, `candidates` "
            "unpruned, `pixels` the foreground alone"
        ),
    }


def _footage(animal: str, estimator: PoseEstimator) -> _Footage:
    """Frames of a rendered recording, as many as are timed, and the scene learned from it."""
    from liex_lab.body.skeleton import Skeleton
    from liex_lab.simulation.simulator import world_of

    from ..build import build_scene, plan_of

    sessions = world_of(Skeleton.load(animal)).test_split("clean", n_sessions=2)
    recording = max(
        sessions, key=lambda session: session.width
    )  # of the sensors, the one with the most pixels
    plan = plan_of(animal)
    scene, sample = build_scene(recording, plan, estimator.skeleton, 96)
    frames = recording.depths(
        0, min(len(recording), N_FRAMES)
    )  # whole ones, which those of the sample need not be
    frames = frames[np.arange(N_FRAMES) % len(frames)]
    return _Footage(recording.name, frames, scene, estimator.find_size(sample, scene))


def _rivals(animal: str, progress: Progress) -> dict[str, PoseEstimator | Baseline]:
    """The paper's variant, and the baselines that have been trained on this machine."""
    from liex_lab.body.skeleton import Skeleton

    from ..training.baselines import BASELINES, cached_baseline, trained_baseline, training_of
    from .pose import estimator_of

    rivals: dict[str, PoseEstimator | Baseline] = {"paper": estimator_of(animal, "paper", progress)}
    skeleton = Skeleton.load(animal)
    for name in BASELINES:
        if cached_baseline(name, skeleton, training_of(name, skeleton)).is_file():
            with suppress(MissingPackageError):  # the CNN's, which does not run without it
                rivals[name] = trained_baseline(animal, name)
    return rivals


def _frames_per_s(subject: PoseEstimator | Baseline, footage: _Footage, parallel: bool) -> float:
    """Frames per second of a subject on the frames, on one core or on those that numba may use."""
    job = partial(subject.estimate, footage.frames, footage.scene, footage.size, parallel)
    return len(footage.frames) / best_seconds(job)


def _one_by_one(paper: PoseEstimator, footage: _Footage) -> Array:
    """Algorithm 1 as it is written, from frames to candidate scores; none share a step."""
    from liex_lab.estimation.cascade import Candidates, ImageSet
    from liex_lab.estimation.initial import draw_starts, start_poses
    from liex_lab.estimation.training import base_at_front

    method = paper.model.method
    skeleton = paper.skeleton
    cascade = paper.model.cascade
    crops = footage.scene.extract(footage.frames, 1.0, camera_view=method.camera_view)
    images = ImageSet(
        crops.heights, footage.scene.crop_cameras(crops, method.camera_view), crops.moments
    )
    n = len(crops.heights)
    k = method.n_candidates
    rotation, position, scale = start_poses(
        crops.moments,
        draw_starts(np.random.default_rng(0), 1, k),
        np.ones((n, k)),
        skeleton.length,
        base_at_front(skeleton),
        method.axis_start,
        method.camera_view,
        method.home_turn,
    )
    image = np.repeat(np.arange(n, dtype=np.int32), k)
    poses = Candidates.start(
        skeleton,
        image,
        rotation.reshape(-1, 3, 3),
        position.reshape(-1, 3),
        scale.ravel(),
        np.ones(n * k),
    )
    for _ in cascade.steps(images, poses):
        pass
    return cascade.predict(paper.model.metric, cascade.metric_samples(images, poses))


def _ms(job: Callable[[], Any]) -> float:
    """Milliseconds a frame."""
    return 1000.0 * best_seconds(job) / N_FRAMES


def _stages(default: PoseEstimator, footage: _Footage) -> dict[str, float]:
    """Milliseconds a frame on one core of what a frame goes through."""
    from liex_lab.estimation.cascade import ImageSet

    frames = footage.frames
    scene = footage.scene
    size = footage.size
    crops = scene.extract(frames, size, camera_view=default.model.method.camera_view)
    crop_cameras = scene.crop_cameras(crops, default.model.method.camera_view)
    rotations, positions, _, scores = default.candidates(crops, crop_cameras, size)
    images = ImageSet(crops.heights, crop_cameras, crops.moments)
    return {
        "foreground": _ms(
            lambda: scene.extract(frames, size, False, default.model.method.camera_view)
        ),
        "candidates": _ms(lambda: default.candidates(crops, crop_cameras, size, False)),
        "choice": _ms(lambda: default.pick(images, size, rotations, positions, scores, False)),
    }


def _costs(default: PoseEstimator, footage: _Footage) -> dict[str, dict[str, float]]:
    """Milliseconds a frame on one core against the number of joints, of candidates, and of
    pixels.
    """
    frames = footage.frames
    scene = footage.scene
    size = footage.size
    n_joints = len(default.skeleton.solved)
    crops = scene.extract(frames, size, camera_view=default.model.method.camera_view)
    crop_cameras = scene.crop_cameras(crops, default.model.method.camera_view)

    def candidates(estimator: PoseEstimator) -> float:
        """Milliseconds a frame that an `estimator` takes for its candidates on one core."""
        return _ms(lambda: estimator.candidates(crops, crop_cameras, size, False))

    joints = sorted({1, (n_joints + 1) // 2, n_joints})
    return {
        "joints": {str(n): candidates(replace(default, n_joints=n)) for n in joints},
        "candidates": {
            str(n): candidates(replace(default, n_candidates=n, unpruned=True)) for n in _CANDIDATES
        },
        "pixels": {
            f"{f.scene.camera.width} x {f.scene.camera.height}": _ms(partial(_cut, f))
            for f in _sizes(footage)
        },
    }


def _cut(footage: _Footage) -> None:
    footage.scene.extract(footage.frames, footage.size, False)


def _sizes(footage: _Footage) -> list[_Footage]:
    """The same frames with every second pixel and with all of them."""
    out = []
    for step in _SHRINK:
        frames = np.ascontiguousarray(footage.frames[:, ::step, ::step])
        out.append(replace(footage, frames=frames, scene=footage.scene.every(step)))
    return out
