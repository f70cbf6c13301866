"""Tracks with known actions: acted by virtual animals, rendered, and measured as recordings are.

Everything is drawn from seeds; what has been measured is kept in the cache folder, by seed, model and generator.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from liex_lab.pipelines.train import cache_folder
from numpy.typing import NDArray

from liex_lab import recordings as recordings_package
from liex_lab.actions.labelled import LabelledTrack
from liex_lab.body.pose import Pose
from liex_lab.body.shape import BodyShape
from liex_lab.estimation.estimator import PoseEstimator
from liex_lab.progress import Progress, silent
from liex_lab.recordings import fish_acts, mouse_acts
from liex_lab.recordings._stage import WALL_COLUMNS
from liex_lab.recordings.acting import STEP_S, Individual, Motion
from liex_lab.recordings.filming import Camerawork, film
from liex_lab.recordings.fish import FishHabits
from liex_lab.recordings.habits import MouseHabits
from liex_lab.tracking.track import Track
from liex_lab.tracking.windowed import WindowTracker

Array = NDArray[np.float64]

_SOURCES = ("acting.py", "filming.py")  # and the animal's own acts
_WALL_ERROR_MM = 4.0  # of the arena as it was found
_FISH_STRIDE, _FISH_WINDOW, _MOUSE_WINDOW = 4, 128, 112
_SIZE_FRAMES = 128  # frames in which an animal's size is measured


@dataclass(frozen=True)
class Scenario:
    """One recording to be acted. seed: of everything in it; individual: the animal's own seed; novel: an animal whose
    traits no other has; seconds long, or (word) one cut-out action.
    """

    animal: str
    individual: int
    seed: int
    rate_hz: float
    seconds: float = 0.0
    word: str = ""
    novel: bool = False


def acted_tracks(
    scenarios: list[Scenario], estimator: PoseEstimator, progress: Progress = silent
) -> list[LabelledTrack]:
    """The tracks of all scenarios, kept from earlier or measured now. Cut-outs of one individual share its size."""
    model, tracks = estimator.model.digest(), []
    groups = [[one] for one in scenarios] if scenarios[0].seconds else [scenarios]
    for k, group in enumerate(groups):
        animal = group[0].animal
        key = hashlib.sha256((repr(group) + model).encode() + _generator(animal)).hexdigest()[:16]
        path = cache_folder() / "acted" / f"{animal}-{key}.npz"
        if not path.is_file():
            sizes: dict[int, float] = {}
            measured = []
            for n, one in enumerate(group):
                progress(k + n, max(len(groups), len(group)), "acting, rendering and measuring")
                measured.append(act(one, estimator, sizes))
            _save(path, measured)
        tracks += _load(path, estimator)
    return tracks


def act(scenario: Scenario, estimator: PoseEstimator, sizes: dict[int, float] | None = None) -> LabelledTrack:
    """One scenario acted, rendered and measured; sizes: of individuals that have been measured already."""
    stage = {"fish": _fish, "mouse": _mouse}[scenario.animal]
    rng = np.random.default_rng([scenario.individual, scenario.seed])
    motion, rows, pose, girth, walls, habits, camera, shape, room = stage(scenario, rng)
    window_px = _FISH_WINDOW if scenario.animal == "fish" else _MOUSE_WINDOW
    tracker = WindowTracker(estimator, estimator.skeleton.view.min_height_mm)
    sizes = {} if sizes is None else sizes
    if scenario.individual not in sizes:
        some = np.linspace(0, len(rows) - 1, min(_SIZE_FRAMES, len(rows))).astype(int)
        near = None if walls is None else walls[some]
        (sample,) = film(rng, habits, camera, shape, pose[some], girth[some], near, window_px)
        sizes[scenario.individual] = tracker.find_size(sample)
    parts = film(rng, habits, camera, shape, pose, girth, walls, window_px)
    track = tracker.follow(parts, np.round(rows * STEP_S * 1e9).astype(np.int64), sizes[scenario.individual])
    name = f"{scenario.animal}-{scenario.individual}"
    return LabelledTrack(track, motion.word[rows], name, room, truth=pose.joints(habits.skeleton))


_Staged = tuple[Motion, NDArray[np.int64], Pose, Array, Array | None, FishHabits | MouseHabits, Camerawork, BodyShape,
                Array | None]  # fmt: skip


def _seen(motion: Motion, scenario: Scenario) -> NDArray[np.int64]:
    """The steps that the camera sees; of a cut-out only those of its action."""
    rows = motion.at(scenario.rate_hz)
    return rows[motion.word[rows] == scenario.word] if scenario.word else rows


def _fish(scenario: Scenario, rng: np.random.Generator) -> _Staged:
    """A fish on its stage."""
    habits, own = FishHabits(), np.random.default_rng([scenario.individual, 0])
    fish = Individual.draw(own, (25.0 / 30.0, 34.0 / 30.0), scenario.novel)
    shape = habits.shapes(own, "train", 1)
    assert isinstance(shape, BodyShape)
    height_mm = float(rng.uniform(300.0, 330.0))
    water = fish_acts.depth_of_water(habits, shape, fish.size, height_mm)
    actor = fish_acts.FishActor(fish, fish.size * habits.skeleton.length, water, height_mm)
    motion = actor.cut(rng, scenario.word) if scenario.word else actor.uncut(rng, scenario.seconds)
    rows = _seen(motion, scenario)
    pose = fish_acts.fish_poses(rng, habits, motion, rows, fish.size)
    camera = Camerawork.draw(rng, habits, habits.sensors[0], shape.fur, height_mm, _FISH_STRIDE)
    return motion, rows, pose, np.full(len(rows), fish.size), None, habits, camera, shape, None


def _mouse(scenario: Scenario, rng: np.random.Generator) -> _Staged:
    """A mouse in its box."""
    habits, own = MouseHabits(), np.random.default_rng([scenario.individual, 0])
    mouse = Individual.draw(own, (0.95, 1.3), scenario.novel)
    shape = habits.shapes(own, "train", 1)
    half = rng.uniform([290.0, 250.0], [400.0, 330.0])
    actor = mouse_acts.MouseActor.of(mouse, habits.skeleton, shape, half)
    motion = actor.uncut(rng, scenario.seconds)
    rows = _seen(motion, scenario)
    pose, girth = mouse_acts.mouse_poses(rng, habits, motion, rows, mouse.size, shape)
    middle = pose.joints(habits.skeleton)[..., :2].mean(axis=1)
    sensor = habits.sensors[int(rng.integers(len(habits.sensors)))]
    camera = Camerawork.draw(rng, habits, sensor, shape.fur, float(rng.uniform(650.0, 850.0)), 1)
    room = (half - np.abs(middle)).min(axis=1) + rng.normal(0.0, _WALL_ERROR_MM)
    known = scenario.novel or rng.random() < 0.75  # of some to learn from nobody knows where the walls are
    return (motion, rows, pose, girth, _walls(rng, middle, half), habits, camera, shape,
            room if known else np.full(len(rows), np.nan))  # fmt: skip


def _walls(rng: np.random.Generator, middle: Array, half: Array) -> Array:
    """The wall nearest to each place (n, 2) mm, as the renderer takes it."""
    walls = np.zeros((len(middle), WALL_COLUMNS))
    axis = np.argmin(half - np.abs(middle), axis=1)
    rows = np.arange(len(middle))
    walls[rows, axis] = np.where(middle[rows, axis] < 0, -1.0, 1.0)
    walls[:, 2], walls[:, 3] = half[axis], rng.uniform(100.0, 300.0)
    walls[:, 4], walls[:, 5] = rng.uniform(0.0, 8.0), rng.uniform(6.0, 20.0)
    return walls


def _generator(animal: str) -> bytes:
    """A hash of the code that acts."""
    folder = Path(recordings_package.__file__).parent
    names = (*_SOURCES, f"{animal}_acts.py")
    return hashlib.sha256(b"".join((folder / name).read_bytes() for name in names)).digest()


def _save(path: Path, tracks: list[LabelledTrack]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    columns: dict[str, Any] = {
        f.name: np.concatenate([getattr(t.track, f.name) for t in tracks]) for f in fields(Track)[1:]
    }
    columns["truth"] = np.concatenate([np.asarray(t.truth) for t in tracks])
    small = {name: v.astype(np.float32) if v.dtype == np.float64 else v for name, v in columns.items()}
    small |= {"lengths": np.array([len(t) for t in tracks]), "animals": np.array([t.animal for t in tracks]),
              "words": np.concatenate([t.words for t in tracks]),
              "wall_mm": np.concatenate([np.asarray(t.wall_mm) for t in tracks])}  # fmt: skip
    unfinished = path.with_suffix(".part.npz")
    np.savez(unfinished, **small)
    unfinished.replace(path)


def _load(path: Path, estimator: PoseEstimator) -> list[LabelledTrack]:
    with np.load(path) as kept:
        data = {name: kept[name] for name in kept.files}
    stops = np.cumsum(data["lengths"])
    names = [f.name for f in fields(Track)[1:]]
    columns = {n: v.astype(np.float64) if (v := data[n]).dtype == np.float32 else v for n in names}
    tracks = []
    for k, (stop, length) in enumerate(zip(stops, data["lengths"], strict=True)):
        part = slice(stop - length, stop)
        track = Track(estimator.skeleton, *(columns[name][part] for name in names))
        tracks.append(LabelledTrack(track, data["words"][part], str(data["animals"][k]), data["wall_mm"][part],
                                    data["truth"][part].astype(np.float64)))  # fmt: skip
    return tracks
