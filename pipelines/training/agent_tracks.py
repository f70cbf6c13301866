"""Labelled tracks of acting virtual animals: behaviour generated, rendered, measured and tracked.

An agent strings actions together by their kinematic definitions; each frame is rendered in depth
and measured as in a recording. These single-frame observations are kept in the cache folder, one
recording after the other, by scenario, model and the generator's code, so that an interrupted job
resumes where it stopped. The track is always computed from them by the present tracker. Everything
is drawn from seeds.
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
from liex_lab.scene.height_maps import Patches
from liex_lab.simulation import agents
from liex_lab.simulation._render_kernels import WALL_COLUMNS
from liex_lab.simulation.agents import fish as fish_acts
from liex_lab.simulation.agents import mouse as mouse_acts
from liex_lab.simulation.agents.agent import STEP_S, CameraPath, Individual, Motion, render_agent
from liex_lab.simulation.fish import FishSpecies
from liex_lab.simulation.species import MouseSpecies
from liex_lab.tracking.observations import COLUMNS, Observations
from liex_lab.tracking.offline import track_whole
from liex_lab.tracking.track import Subject
from liex_lab.tracking.tracker import PatchObserver

from .pose_model import cache_folder

Array = NDArray[np.float64]

_SOURCES = ("agent.py",)  # and the animal's own agent
_WALL_ERROR_MM = 4.0  # error of the estimated arena
_FISH_STRIDE = 4
_FISH_WINDOW = 128
_MOUSE_WINDOW = 112
_SIZE_FRAMES = 128  # frames in which an animal's size is measured
_WAYS = 2  # hypotheses per frame: only the animal is in view
_CAMERA = ("fx", "fy", "cx", "cy", "width", "height")


@dataclass(frozen=True)
class Scenario:
    """A recording to generate.

    Attributes:
        animal: `fish` or `mouse`.
        individual: the animal's own seed: traits, size, shape.
        seed: of everything else in the recording.
        rate_hz: frames per second of the camera.
        seconds: length of an uncut recording, s; 0 for a cut-out action.
        word: the cut-out action, '' for an uncut recording.
        novel: the individual has traits outside the training's.
        filmed_s: length of the beginning that is filmed, s; 0 films all of it.
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
class AgentTrack:
    """The single-frame observations of a generated recording of n frames, with labels and truth.

    Attributes:
        seen: hypotheses of all frames, arena frame.
        subject: the animal and its camera.
        words: (n,) true actions.
        animal: name of the individual.
        wall_mm: (n,) distance of its middle from the nearest wall, mm; NaN if unknown.
        truth: (n, J, 3) float32 true joints, mm, arena frame.
        cut: the cut-out action, which has some frames before and after it as well; '' for an uncut
            recording.
    """

    seen: Observations
    subject: Subject
    words: NDArray[np.str_]
    animal: str
    wall_mm: Array
    truth: NDArray[np.float32]
    cut: str = ""

    def tracked(self, rate_hz: float = 0.0) -> LabelledTrack:
        """The labelled track of the recording; for a cut-out action, only its frames.

        Args:
            rate_hz: frame rate of a slower camera, simulated by the frames nearest to its times; 0
                uses all frames.
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
    """Unique rows (m,) of the frames at times (n,), ns, nearest to those of another frame rate."""
    times = (times_ns - times_ns[:1]) * 1e-9
    wanted = np.arange(0.0, times[-1] + 1e-9, 1.0 / rate_hz)
    after = np.clip(np.searchsorted(times, wanted), 1, len(times) - 1)
    return np.unique(np.where(wanted - times[after - 1] < times[after] - wanted, after - 1, after))


def acted_tracks(
    scenarios: Sequence[Scenario], estimator: PoseEstimator, progress: Progress = silent
) -> list[LabelledTrack]:
    """The labelled tracks of scenarios, by the present tracker; see `acted`."""
    return [one.tracked() for one in acted(scenarios, estimator, progress)]


def acted(
    scenarios: Sequence[Scenario], estimator: PoseEstimator, progress: Progress = silent
) -> list[AgentTrack]:
    """Single-frame observations of all scenarios, from the cache or measured now.

    Cut-outs of one individual share its measured size and one file of the cache.

    Args:
        scenarios: all uncut, or all cut-out actions, of one animal.
        estimator: measures the frames; its model's digest is part of the cache key.
        progress: called recording by recording, if any has to be measured.

    Returns:
        One for each scenario, in their order.
    """
    found: dict[int, AgentTrack] = {}
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
            measured: list[AgentTrack] = []
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
) -> AgentTrack:
    """Generate, render and measure one scenario frame by frame.

    Args:
        scenario: the recording to generate.
        estimator: measures the frames.
        sizes: cache of size over home size by individual; others are measured over up to 128 frames
            and added. None starts empty.
    """
    rng = np.random.default_rng([scenario.individual, scenario.seed])
    motion, rows, pose, girth, walls, species, camera, shape, wall_mm = staged(scenario, rng)
    window_px = _FISH_WINDOW if scenario.animal == "fish" else _MOUSE_WINDOW
    tracker = PatchObserver(estimator)
    sizes = {} if sizes is None else sizes
    n_sample = 1 if scenario.individual in sizes else min(_SIZE_FRAMES, len(rows))
    some = np.linspace(0, len(rows) - 1, n_sample).astype(int)
    near = None if walls is None else walls[some]
    (sample,) = render_agent(rng, species, camera, shape, pose[some], girth[some], near, window_px)
    if scenario.individual not in sizes:
        sizes[scenario.individual] = tracker.find_size(sample)
    size = sizes[scenario.individual]
    n = (
        len(rows)
        if not scenario.filmed_s
        else int(np.searchsorted(rows * STEP_S, scenario.filmed_s))
    )
    parts = render_agent(
        rng,
        species,
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
    wall = np.full(n, np.nan) if wall_mm is None else wall_mm[:n]
    return AgentTrack(
        seen,
        subject,
        motion.word[rows[:n]],
        f"{scenario.animal}-{scenario.individual}",
        wall,
        pose[:n].joints(species.skeleton).astype(np.float32),
        scenario.word,
    )


Staged = tuple[
    Motion,
    NDArray[np.int64],
    Pose,
    Array,
    Array | None,
    FishSpecies | MouseSpecies,
    CameraPath,
    BodyShape,
    Array | None,
]


def staged(scenario: Scenario, rng: np.random.Generator) -> Staged:
    """Generate a scenario, without rendering it.

    Args:
        scenario: the recording to generate.
        rng: random number generator, of the individual and the scenario.

    Returns:
        The motion on its 5 ms clock; its steps (n,) that are frames; poses (n), arena frame; girth
        (n,); the wall that each frame shows, or None; species, camera and shape; distance (n,) from
        the nearest wall, mm, or None.
    """
    return {"fish": _fish, "mouse": _mouse}[scenario.animal](scenario, rng)


def _fish(scenario: Scenario, rng: np.random.Generator) -> Staged:
    """A fish in a tank: its motion, poses and camera."""
    species = FishSpecies()
    own = np.random.default_rng([scenario.individual, 0])
    fish = Individual.draw(own, (25.0 / 30.0, 34.0 / 30.0), scenario.novel)
    shape = species.shapes(own, "train", 1)
    assert isinstance(shape, BodyShape)
    height_mm = float(rng.uniform(300.0, 330.0))
    water = fish_acts.depth_of_water(species, shape, fish.size, height_mm)
    actor = fish_acts.FishActor(fish, fish.size * species.skeleton.length, water, height_mm)
    motion = actor.cut(rng, scenario.word) if scenario.word else actor.uncut(rng, scenario.seconds)
    rows = motion.at(scenario.rate_hz)
    pose = fish_acts.fish_poses(rng, species, motion, rows, fish.size)
    camera = CameraPath.draw(rng, species, species.sensors[0], shape.fur, height_mm, _FISH_STRIDE)
    return motion, rows, pose, np.full(len(rows), fish.size), None, species, camera, shape, None


def _mouse(scenario: Scenario, rng: np.random.Generator) -> Staged:
    """A mouse in a box: its motion, poses, girth, camera, and wall distances, mm."""
    species = MouseSpecies()
    own = np.random.default_rng([scenario.individual, 0])
    mouse = Individual.draw(own, (0.95, 1.3), scenario.novel)
    shape = species.shapes(own, "train", 1)
    half = rng.uniform([290.0, 250.0], [400.0, 330.0])
    actor = mouse_acts.MouseActor.of(mouse, species.skeleton, shape, half)
    motion = actor.uncut(rng, scenario.seconds)
    rows = motion.at(scenario.rate_hz)
    pose, girth = mouse_acts.mouse_poses(rng, species, motion, rows, mouse.size, shape)
    middle = pose.joints(species.skeleton)[..., :2].mean(axis=1)
    sensor = species.sensors[int(rng.integers(len(species.sensors)))]
    camera = CameraPath.draw(rng, species, sensor, shape.fur, float(rng.uniform(650.0, 850.0)), 1)
    wall_mm = (half - np.abs(middle)).min(axis=1) + rng.normal(0.0, _WALL_ERROR_MM)
    # in some training recordings the walls are unknown
    known = scenario.novel or rng.random() < 0.75
    return (
        motion,
        rows,
        pose,
        girth,
        _walls(rng, middle, half),
        species,
        camera,
        shape,
        wall_mm if known else np.full(len(rows), np.nan),
    )


def _walls(rng: np.random.Generator, middle: Array, half: Array) -> Array:
    """The wall nearest to each position (n, 2) mm, as columns (n, WALL_COLUMNS) of the renderer."""
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
    """SHA-256 of the code that generates and renders the behaviour."""
    folder = Path(agents.__file__).parent
    names = (*_SOURCES, f"{animal}.py")
    return hashlib.sha256(b"".join((folder / name).read_bytes() for name in names)).digest()


def _save(path: Path, group: list[AgentTrack]) -> None:
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
    """A column of the observations without the hypotheses of a second object in view."""
    values = getattr(seen, name)
    return np.asarray(values if values.ndim == 1 else values[:, :_WAYS])


def _load(path: Path, estimator: PoseEstimator, group: Sequence[Scenario]) -> list[AgentTrack]:
    with np.load(path) as kept:
        data = {name: kept[name] for name in kept.files}
    tracker = PatchObserver(estimator)
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
            AgentTrack(
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


# A filmed cut-out action: poses of all its frames, and the visible points in some of them.


_WINDOW_PX = 128
_ABOVE_GROUND_MM = 4.0  # a pixel less far above the empty ground is noise
_NEAR = 0.25  # of the body's length: points farther from every joint are noise


@dataclass(frozen=True)
class Film:
    """A filmed action of n frames.

    Attributes:
        joints: (n, J, 3) true joints, mm, arena frame.
        rows: (k,) the key frames among them.
        points: for each key frame, the visible points (m, 3) of the animal, mm, arena frame.
        edges: pairs of joints that a bone connects.
    """

    joints: Array
    rows: NDArray[np.int64]
    points: list[Array]
    edges: list[tuple[int, int]]


def filmed_at(scenario: Scenario, n_key_frames: int) -> Film:
    """Generate an action, and render it at evenly spaced key frames.

    Args:
        scenario: a cut-out action; frames before and after it are left out.
        n_key_frames: number of key frames, including the first and the last frame.
    """
    rng = np.random.default_rng([scenario.individual, scenario.seed])
    motion, steps, pose, girth, walls, species, camera, shape, _ = staged(scenario, rng)
    inside = np.flatnonzero(motion.word[steps] == scenario.word)
    rows = np.linspace(0, len(inside) - 1, min(n_key_frames, len(inside))).round().astype(int)
    at = inside[rows]
    near = None if walls is None else walls[at]
    (seen,) = render_agent(rng, species, camera, shape, pose[at], girth[at], near, _WINDOW_PX)
    joints = pose[inside].joints(species.skeleton)
    reach = _NEAR * species.skeleton.length
    points = [
        _beside(_points(seen, k, camera.T_arena_camera), joints[row], reach)
        for k, row in enumerate(rows)
    ]
    return Film(joints, rows, points, list(species.skeleton.edges))


def _points(seen: Patches, k: int, T_arena_camera: SE3) -> Array:
    """Points of patch k above the ground, (m, 3) mm, arena frame."""
    depth = seen.depth[k].astype(float)
    v, u = np.nonzero((depth > 0) & (seen.background[k] - depth > _ABOVE_GROUND_MM))
    fx, fy, cx, cy = seen.intrinsics[k]
    z = depth[v, u]
    x = (u + seen.origin[k, 0] - cx) / fx * z
    y = (v + seen.origin[k, 1] - cy) / fy * z
    return np.asarray(T_arena_camera @ np.stack([x, y, z], axis=-1))


def _beside(points: Array, joints: Array, reach_mm: float) -> Array:
    """The points (m, 3) within `reach_mm` of a joint."""
    off = np.linalg.norm(points[:, None] - joints[None], axis=-1).min(axis=1)
    return np.asarray(points[off < reach_mm])
