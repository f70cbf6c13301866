"""Tracks with known actions: acted by virtual animals, rendered, measured and tracked as recordings
are.

Everything is drawn from seeds. What single frames say is kept in the cache folder, recording by
recording, by seed, model and generator, so that a job that was stopped goes on where it was; what
the tracker makes of it is made anew.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from liex_lab.actions.labels import LabelledTrack
from liex_lab.body.pose import Pose
from liex_lab.body.shape import BodyShape
from liex_lab.estimation.estimator import PoseEstimator
from liex_lab.geometry import SE3
from liex_lab.optics.camera import Camera
from liex_lab.runtime.progress import Progress, silent
from liex_lab.simulation import agents
from liex_lab.simulation._render_kernels import WALL_COLUMNS
from liex_lab.simulation.agents import fish as fish_acts
from liex_lab.simulation.agents import mouse as mouse_acts
from liex_lab.simulation.agents.agent import STEP_S, Individual, Motion
from liex_lab.simulation.agents.render import Camerawork, film
from liex_lab.simulation.fish import FishHabits
from liex_lab.simulation.species import MouseHabits
from liex_lab.tracking.observations import COLUMNS, Observations
from liex_lab.tracking.offline import Subject, track_whole
from liex_lab.tracking.patch_observer import WindowTracker

from .pose_model import cache_folder

Array = NDArray[np.float64]

_SOURCES = ("agent.py", "render.py")  # and the animal's own agent
_WALL_ERROR_MM = 4.0  # of the arena as it was found
_FISH_STRIDE = 4
_FISH_WINDOW = 128
_MOUSE_WINDOW = 112
_SIZE_FRAMES = 128  # frames in which an animal's size is measured
_WAYS = 2  # hypotheses a frame: nothing but the animal is in view
_CAMERA = ("fx", "fy", "cx", "cy", "width", "height")


@dataclass(frozen=True)
class Scenario:
    """One recording to be acted. seed: of everything in it; individual: the animal's own seed;
    novel: an animal whose traits no other has; seconds long, or (word) one cut-out action;
    filmed_s: only so much of its beginning is filmed, 0 all of it.
    """

    animal: str
    individual: int
    seed: int
    rate_hz: float
    seconds: float = 0.0
    word: str = ""
    novel: bool = False
    filmed_s: float = 0.0


@dataclass(frozen=True)
class Acted:
    """An acted recording as its single frames saw it. words (n,): what the animal really did;
    animal: who it is; wall_mm (n,): from its middle to the nearest wall, NaN where nobody knows;
    truth (n, J, 3) mm: its true joints; cut: the word of a cut-out action, of which a little before
    and after is seen as well.
    """

    seen: Observations
    subject: Subject
    words: NDArray[np.str_]
    animal: str
    wall_mm: Array
    truth: NDArray[np.float32]
    cut: str = ""

    def tracked(self, rate_hz: float = 0.0) -> LabelledTrack:
        """Its track; rate_hz: as a camera of so many frames a second would have seen it, which has
        only the frames nearest to its times to go by; 0 all.
        """
        rows = np.arange(len(self.words)) if not rate_hz else thinned(self.seen.times_ns, rate_hz)
        seen = Observations(
            self.seen.skeleton, *(getattr(self.seen, name)[rows] for name in COLUMNS)
        )
        track = track_whole(self.subject, seen).track
        one = LabelledTrack(
            track, self.words[rows], self.animal, self.wall_mm[rows], self.truth[rows].astype(float)
        )
        return one[one.words == self.cut] if self.cut else one


def thinned(times_ns: NDArray[np.int64], rate_hz: float) -> NDArray[np.int64]:
    """The rows of frames at these times that lie nearest to those of a camera of another rate; none
    twice.
    """
    times = (times_ns - times_ns[:1]) * 1e-9
    wanted = np.arange(0.0, times[-1] + 1e-9, 1.0 / rate_hz)
    after = np.clip(np.searchsorted(times, wanted), 1, len(times) - 1)
    return np.unique(np.where(wanted - times[after - 1] < times[after] - wanted, after - 1, after))


def acted_tracks(
    scenarios: Sequence[Scenario], estimator: PoseEstimator, progress: Progress = silent
) -> list[LabelledTrack]:
    """The tracks of `acted`, by the present tracker."""
    return [one.tracked() for one in acted(scenarios, estimator, progress)]


def acted(
    scenarios: Sequence[Scenario], estimator: PoseEstimator, progress: Progress = silent
) -> list[Acted]:
    """All scenarios, kept from earlier or measured now. Cut-outs of one individual share its size
    and one file.
    """
    found: dict[int, Acted] = {}
    made_by = estimator.model.digest()
    whole = bool(scenarios[0].seconds)
    for name in dict.fromkeys((k if whole else one.individual) for k, one in enumerate(scenarios)):
        rows = [name] if whole else [k for k, one in enumerate(scenarios) if one.individual == name]
        group = [scenarios[k] for k in rows]
        animal = group[0].animal
        key = hashlib.sha256((repr(group) + made_by).encode() + _generator(animal)).hexdigest()[:16]
        path = cache_folder() / "acted" / f"{animal}-seen-{key}.npz"
        if not path.is_file():
            sizes: dict[int, float] = {}
            measured: list[Acted] = []
            for one in group:
                progress(
                    len(found) + len(measured), len(scenarios), "acting, rendering and measuring"
                )
                measured.append(act(one, estimator, sizes))
            _save(path, measured)
        found |= dict(zip(rows, _load(path, estimator, group), strict=True))
    return [found[k] for k in range(len(scenarios))]


def act(
    scenario: Scenario, estimator: PoseEstimator, sizes: dict[int, float] | None = None
) -> Acted:
    """One scenario acted, rendered and measured; sizes: of individuals that have been measured
    already.
    """
    stage = {"fish": _fish, "mouse": _mouse}[scenario.animal]
    rng = np.random.default_rng([scenario.individual, scenario.seed])
    motion, rows, pose, girth, walls, habits, camera, shape, room = stage(scenario, rng)
    window_px = _FISH_WINDOW if scenario.animal == "fish" else _MOUSE_WINDOW
    tracker = WindowTracker(estimator)
    sizes = {} if sizes is None else sizes
    n_sample = 1 if scenario.individual in sizes else min(_SIZE_FRAMES, len(rows))
    some = np.linspace(0, len(rows) - 1, n_sample).astype(int)
    near = None if walls is None else walls[some]
    (sample,) = film(rng, habits, camera, shape, pose[some], girth[some], near, window_px)
    if scenario.individual not in sizes:
        sizes[scenario.individual] = tracker.find_size(sample)
    size = sizes[scenario.individual]
    n = (
        len(rows)
        if not scenario.filmed_s
        else int(np.searchsorted(rows * STEP_S, scenario.filmed_s))
    )
    parts = film(
        rng,
        habits,
        camera,
        shape,
        pose[:n],
        girth[:n],
        None if walls is None else walls[:n],
        window_px,
    )
    times = np.round(rows[:n] * STEP_S * 1e9).astype(np.int64)
    seen = tracker.observe(parts, times, size)
    whole = Camera(*camera.intrinsics, *(int(x) for x in camera.picture))
    subject = tracker.subject(whole, sample.floor(0).T_arena_camera, size)
    wall = np.full(n, np.nan) if room is None else room[:n]
    return Acted(
        seen,
        subject,
        motion.word[rows[:n]],
        f"{scenario.animal}-{scenario.individual}",
        wall,
        pose[:n].joints(habits.skeleton).astype(np.float32),
        scenario.word,
    )


_Staged = tuple[
    Motion,
    NDArray[np.int64],
    Pose,
    Array,
    Array | None,
    FishHabits | MouseHabits,
    Camerawork,
    BodyShape,
    Array | None,
]


def _fish(scenario: Scenario, rng: np.random.Generator) -> _Staged:
    """A fish on its stage."""
    habits = FishHabits()
    own = np.random.default_rng([scenario.individual, 0])
    fish = Individual.draw(own, (25.0 / 30.0, 34.0 / 30.0), scenario.novel)
    shape = habits.shapes(own, "train", 1)
    assert isinstance(shape, BodyShape)
    height_mm = float(rng.uniform(300.0, 330.0))
    water = fish_acts.depth_of_water(habits, shape, fish.size, height_mm)
    actor = fish_acts.FishActor(fish, fish.size * habits.skeleton.length, water, height_mm)
    motion = actor.cut(rng, scenario.word) if scenario.word else actor.uncut(rng, scenario.seconds)
    rows = motion.at(scenario.rate_hz)
    pose = fish_acts.fish_poses(rng, habits, motion, rows, fish.size)
    camera = Camerawork.draw(rng, habits, habits.sensors[0], shape.fur, height_mm, _FISH_STRIDE)
    return motion, rows, pose, np.full(len(rows), fish.size), None, habits, camera, shape, None


def _mouse(scenario: Scenario, rng: np.random.Generator) -> _Staged:
    """A mouse in its box."""
    habits = MouseHabits()
    own = np.random.default_rng([scenario.individual, 0])
    mouse = Individual.draw(own, (0.95, 1.3), scenario.novel)
    shape = habits.shapes(own, "train", 1)
    half = rng.uniform([290.0, 250.0], [400.0, 330.0])
    actor = mouse_acts.MouseActor.of(mouse, habits.skeleton, shape, half)
    motion = actor.uncut(rng, scenario.seconds)
    rows = motion.at(scenario.rate_hz)
    pose, girth = mouse_acts.mouse_poses(rng, habits, motion, rows, mouse.size, shape)
    middle = pose.joints(habits.skeleton)[..., :2].mean(axis=1)
    sensor = habits.sensors[int(rng.integers(len(habits.sensors)))]
    camera = Camerawork.draw(rng, habits, sensor, shape.fur, float(rng.uniform(650.0, 850.0)), 1)
    room = (half - np.abs(middle)).min(axis=1) + rng.normal(0.0, _WALL_ERROR_MM)
    known = (
        scenario.novel or rng.random() < 0.75
    )  # of some to learn from nobody knows where the walls are
    return (
        motion,
        rows,
        pose,
        girth,
        _walls(rng, middle, half),
        habits,
        camera,
        shape,
        room if known else np.full(len(rows), np.nan),
    )


def _walls(rng: np.random.Generator, middle: Array, half: Array) -> Array:
    """The wall nearest to each place (n, 2) mm, as the renderer takes it."""
    walls = np.zeros((len(middle), WALL_COLUMNS))
    axis = np.argmin(half - np.abs(middle), axis=1)
    rows = np.arange(len(middle))
    walls[rows, axis] = np.where(middle[rows, axis] < 0, -1.0, 1.0)
    walls[:, 2] = half[axis]
    walls[:, 3] = rng.uniform(100.0, 300.0)
    walls[:, 4] = rng.uniform(0.0, 8.0)
    walls[:, 5] = rng.uniform(6.0, 20.0)
    return walls


def _generator(animal: str) -> bytes:
    """A hash of the code that acts."""
    folder = Path(agents.__file__).parent
    names = (*_SOURCES, f"{animal}.py")
    return hashlib.sha256(b"".join((folder / name).read_bytes() for name in names)).digest()


def _save(path: Path, group: list[Acted]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    columns: dict[str, Any] = {
        name: np.concatenate([_of_animal(one.seen, name) for one in group]) for name in COLUMNS
    }
    columns |= {
        name: np.concatenate([getattr(one, name) for one in group])
        for name in ("words", "wall_mm", "truth")
    }
    columns |= {
        "lengths": np.array([len(one.words) for one in group]),
        "animals": np.array([one.animal for one in group]),
        "camera": np.array(
            [[getattr(one.subject.camera, name) for name in _CAMERA] for one in group]
        ),
        "camera_turn": np.stack([one.subject.T_arena_camera.rotation for one in group]),
        "camera_shift": np.stack([one.subject.T_arena_camera.translation for one in group]),
        "sizes": np.array([one.subject.length_mm / one.seen.skeleton.length for one in group]),
    }
    unfinished = path.with_suffix(".part.npz")
    np.savez(unfinished, **columns)
    unfinished.replace(path)


def _of_animal(seen: Observations, name: str) -> NDArray[Any]:
    """A column of what was seen, without the hypotheses of a second thing in view."""
    values = getattr(seen, name)
    return np.asarray(values if values.ndim == 1 else values[:, :_WAYS])


def _load(path: Path, estimator: PoseEstimator, group: Sequence[Scenario]) -> list[Acted]:
    with np.load(path) as kept:
        data = {name: kept[name] for name in kept.files}
    tracker = WindowTracker(estimator)
    stops = np.cumsum(data["lengths"])
    found = []
    for k, (stop, length) in enumerate(zip(stops, data["lengths"], strict=True)):
        part = slice(stop - length, stop)
        seen = Observations(estimator.skeleton, *(data[name][part] for name in COLUMNS))
        camera = Camera(*data["camera"][k, :4], *(int(x) for x in data["camera"][k, 4:]))
        subject = tracker.subject(
            camera, SE3(data["camera_turn"][k], data["camera_shift"][k]), float(data["sizes"][k])
        )
        found.append(
            Acted(
                seen,
                subject,
                data["words"][part],
                str(data["animals"][k]),
                data["wall_mm"][part],
                data["truth"][part],
                group[k].word,
            )
        )
    return found
