"""Training of action recognisers, and active learning: `liex train actions`, `liex suggest`.

The recogniser (a network on windowed features under a semi-Markov model, `liex_lab.actions`) is
trained on manually labelled sessions and scored by leave-one-animal-out cross-validation; or,
without any, on generated recordings of a virtual animal at several frame rates. Labels come from
our tables, from CSV, from BORIS projects and from BORIS's exports. `suggest` is uncertainty
sampling: it ranks the segments to label next by the entropy of the recogniser's actions.
"""

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from liex_lab.actions import ethogram, learning, storage, vocabulary
from liex_lab.actions.labels import LabelledTrack, read_labels, sessions_named, words_of
from liex_lab.arrays import Array, NDArray
from liex_lab.body.pose import Pose
from liex_lab.body.shape import BodyShape
from liex_lab.errors import LiexError
from liex_lab.estimation.estimator import PoseEstimator
from liex_lab.exchange.boris import boris_export_labels, boris_labels, is_boris_export
from liex_lab.exchange.moseq import are_syllables, syllable_labels
from liex_lab.geometry import SE3
from liex_lab.optics.camera import Camera
from liex_lab.runtime.durable import replacing
from liex_lab.runtime.progress import Progress, silent
from liex_lab.scene.height_maps import Patches
from liex_lab.sessions import Session, evidence
from liex_lab.simulation import agents
from liex_lab.simulation.agents import agent
from liex_lab.simulation.agents import fish as fish_acts
from liex_lab.simulation.agents import mouse as mouse_acts
from liex_lab.simulation.rendering import Views
from liex_lab.simulation.species import FishSpecies, MouseSpecies
from liex_lab.simulation.training_patches import put_walls
from liex_lab.tracking.curve import track_whole
from liex_lab.tracking.observations import COLUMNS, Observations
from liex_lab.tracking.track import Subject
from liex_lab.tracking.tracker import PatchObserver

from .pose_model import cache_folder, estimator_of


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
        observations: hypotheses of all frames, arena frame.
        subject: the animal and its camera.
        words: (n,) true actions.
        animal: name of the individual.
        wall_mm: (n,) distance of its middle from the nearest wall, mm; NaN if unknown.
        truth: (n, J, 3) float32 true joints, mm, arena frame.
        cut: the cut-out action, which has some frames before and after it as well; '' for an uncut
            recording.
    """

    observations: Observations
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
        rows = (
            np.arange(len(self.words))
            if not rate_hz
            else thinned(self.observations.times_ns, rate_hz)
        )
        track = track_whole(self.subject, self.observations[rows]).track
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
        path = cache_folder() / "acted" / f"{animal}-tracks-{key}.npz"
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
    stage = staged(scenario, rng)
    motion, rows, pose, _, species, camera, _, wall_mm = stage
    window_px = 128 if scenario.animal == "fish" else 112
    tracker = PatchObserver(estimator)
    sizes = {} if sizes is None else sizes
    # frames in which an animal's size is measured
    n_sample = 1 if scenario.individual in sizes else min(128, len(rows))
    some = np.linspace(0, len(rows) - 1, n_sample).astype(int)
    (sample,) = rendered(rng, stage, some, window_px)
    if scenario.individual not in sizes:
        sizes[scenario.individual] = tracker.find_size(sample)
    size = sizes[scenario.individual]
    n = len(rows)
    if scenario.filmed_s:
        n = int(np.searchsorted(rows * agent.STEP_S, scenario.filmed_s))
    times = np.round(rows[:n] * agent.STEP_S * 1e9).astype(np.int64)
    whole = Camera(*camera.intrinsics[0], *(int(x) for x in camera.size_px[0]))
    return AgentTrack(
        tracker.observe(rendered(rng, stage, slice(n), window_px), times, size),
        tracker.subject(whole, sample.floor(0).T_arena_camera, size),
        motion.word[rows[:n]],
        f"{scenario.animal}-{scenario.individual}",
        wall_mm[:n],
        pose[:n].joints(species.skeleton).astype(np.float32),
        scenario.word,
    )


Staged = tuple[
    agent.ActedMotion,
    NDArray[np.int64],
    Pose,
    Array,
    FishSpecies | MouseSpecies,
    Views,
    BodyShape,
    Array,
]


def staged(scenario: Scenario, rng: np.random.Generator) -> Staged:
    """Generate a scenario, without rendering it.

    Args:
        scenario: the recording to generate.
        rng: random number generator, of the individual and the scenario.

    Returns:
        The motion on its 5 ms clock; its steps (n,) that are frames; poses (n), arena frame; girth
        (n,); species; camera and the wall that each frame shows (n); shape; distance (n,) from the
        nearest wall, mm, NaN if unknown.
    """
    return {"fish": _fish, "mouse": _mouse}[scenario.animal](scenario, rng)


def rendered(
    rng: np.random.Generator, stage: Staged, rows: slice | NDArray[np.int64], window_px: int
) -> Iterator[Patches]:
    """Depth around the animal in some frames of a generated scenario."""
    _, _, pose, girth, species, views, shape, _ = stage
    return agent.render_agent(rng, species, views[rows], shape, pose[rows], girth[rows], window_px)


def _fish(scenario: Scenario, rng: np.random.Generator) -> Staged:
    """A fish in a tank: its motion, poses and camera."""
    species = FishSpecies()
    own = np.random.default_rng([scenario.individual, 0])
    fish = agent.Individual.draw(own, (25.0 / 30.0, 34.0 / 30.0), scenario.novel)
    shape = species.shapes(own, "train", 1)
    assert isinstance(shape, BodyShape)
    height_mm = float(rng.uniform(300.0, 330.0))
    water = fish_acts.depth_of_water(species, shape, fish.size, height_mm)
    actor = fish_acts.FishActor(fish, fish.size * species.skeleton.length, water, height_mm)
    motion = actor.cut(rng, scenario.word) if scenario.word else actor.uncut(rng, scenario.seconds)
    rows = motion.at(scenario.rate_hz)
    pose = fish_acts.fish_poses(rng, species, motion, rows, fish.size)
    camera = agent.draw_camera(rng, species, species.sensors[0], shape.fur, height_mm, 4)
    girth, wall_mm = np.full(len(rows), fish.size), np.full(len(rows), np.nan)
    return motion, rows, pose, girth, species, camera[[0] * len(rows)], shape, wall_mm


def _mouse(scenario: Scenario, rng: np.random.Generator) -> Staged:
    """A mouse in a box: its motion, poses, girth, camera, and wall distances, mm."""
    species = MouseSpecies()
    own = np.random.default_rng([scenario.individual, 0])
    mouse = agent.Individual.draw(own, (0.95, 1.3), scenario.novel)
    shape = species.shapes(own, "train", 1)
    half = rng.uniform([290.0, 250.0], [400.0, 330.0])
    actor = mouse_acts.MouseActor.of(mouse, species.skeleton, shape, half)
    motion = actor.uncut(rng, scenario.seconds)
    rows = motion.at(scenario.rate_hz)
    pose, girth = mouse_acts.mouse_poses(rng, species, motion, rows, mouse.size, shape)
    middle = pose.joints(species.skeleton)[..., :2].mean(axis=1)
    sensor = species.sensors[int(rng.integers(len(species.sensors)))]
    camera = agent.draw_camera(rng, species, sensor, shape.fur, float(rng.uniform(650.0, 850.0)), 1)
    # error of the estimated arena, mm
    wall_mm = (half - np.abs(middle)).min(axis=1) + rng.normal(0.0, 4.0)
    # in some training recordings the walls are unknown
    if not scenario.novel and rng.random() >= 0.75:
        wall_mm = np.full(len(rows), np.nan)
    views = camera[[0] * len(rows)]
    # the wall nearest to the animal
    axis, each = np.argmin(half - np.abs(middle), axis=1), np.arange(len(rows))
    outward = np.zeros((len(rows), 2))
    outward[each, axis] = np.where(middle[each, axis] < 0, -1.0, 1.0)
    put_walls(views, outward, half[axis], *rng.uniform([100.0, 0.0, 6.0], [300.0, 8.0, 20.0]))
    return motion, rows, pose, girth, species, views, shape, wall_mm


def _generator(animal: str) -> bytes:
    """SHA-256 of the code that generates and renders the behaviour."""
    folder = Path(agents.__file__).parent
    return hashlib.sha256(
        b"".join((folder / name).read_bytes() for name in ("agent.py", f"{animal}.py"))
    ).digest()


def _save(path: Path, group: list[AgentTrack]) -> None:
    columns: dict[str, Any] = {}
    for k, one in enumerate(group):
        camera = one.subject.camera
        known = {name: getattr(one.observations, name) for name in COLUMNS} | {
            "truth": one.truth,
            "words": one.words,
            "wall_mm": one.wall_mm,
            "animal": one.animal,
            "lens": [camera.fx, camera.fy, camera.cx, camera.cy],
            "pixels": [camera.width, camera.height],
            "camera_turn": one.subject.T_arena_camera.rotation,
            "camera_shift": one.subject.T_arena_camera.translation,
            "size": one.subject.length_mm / one.observations.skeleton.length,
        }
        columns |= {f"{name} {k}": value for name, value in known.items()}
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as part:
        np.savez(part, **columns)


def _load(path: Path, estimator: PoseEstimator, group: Sequence[Scenario]) -> list[AgentTrack]:
    tracker = PatchObserver(estimator)
    found = []
    with np.load(path) as data:
        for k, scenario in enumerate(group):
            # without the hypotheses of a second object in view
            observed = (data[f"{name} {k}"] for name in COLUMNS)
            lens, pixels, turn, shift, size, words, animal, wall_mm, truth = (
                data[f"{name} {k}"]
                for name in (
                    *("lens", "pixels", "camera_turn", "camera_shift", "size"),
                    *("words", "animal", "wall_mm", "truth"),
                )
            )
            found.append(
                AgentTrack(
                    Observations(
                        estimator.skeleton,
                        *(values if values.ndim == 1 else values[:, :2] for values in observed),
                    ),
                    tracker.subject(Camera(*lens, *pixels.tolist()), SE3(turn, shift), float(size)),
                    words,
                    str(animal),
                    wall_mm,
                    truth,
                    scenario.word,
                )
            )
    return found


_SEED = 6


def learning_set(
    animal: str, estimator: PoseEstimator, progress: Progress = silent
) -> tuple[list[LabelledTrack], list[LabelledTrack]]:
    """Generated recordings of an animal for training, and cut-out sequences of single actions.

    Args:
        animal: `fish` or `mouse`.
        estimator: measures the rendered frames.
        progress: called with the progress of rendering and measuring.

    Returns:
        The labelled tracks of uncut recordings, a third of the usual camera's repeated at lower
        rates (15 Hz, and 30 Hz for fish); and the cut-out sequences, of fish only.

    Raises:
        LiexError: no actions are generated for this animal.
    """
    if animal not in WORDS:
        raise LiexError(
            f"actions are generated for {' and '.join(WORDS)}, not for {animal}; name labelled "
            "sessions"
        )
    recordings = acted(training_recordings(animal), estimator, progress)
    # lower frame rates at which some of the generated training recordings are repeated
    slower = [
        one.tracked(rate)
        for rate in (15.0, 30.0)
        if rate < RATE_HZ[animal]
        for one in recordings[:N_USUAL:3]
    ]
    cuts = (
        acted_tracks(cut_sequences(animal, False), estimator, progress) if animal == "fish" else []
    )
    return [*(one.tracked() for one in recordings), *slower], cuts


def train_actions(
    out: str | Path,
    *,
    animal: str = "mouse",
    sessions: Sequence[str | Path] = (),
    labels: Sequence[str | Path] = (),
    pose_model: str | Path | None = None,
    progress: Progress = silent,
) -> tuple[Path, dict[str, Any]]:
    """Train an action recogniser on labelled sessions or, without any, on generated recordings.

    Args:
        out: where the model is written.
        animal: `fish` or `mouse`, for generated recordings.
        sessions: labelled session folders.
        labels: tables of bouts, BORIS projects or BORIS exports; without any, the sessions' own
            bouts whose source is `human` are used.
        pose_model: measures the generated recordings, instead of the animal's own.
        progress: called with the progress of the job.

    Returns:
        The model's path and, for sessions, its scores on each animal when trained on the others
        only; an empty dict for generated recordings.

    Raises:
        LiexError: the animal has no generated actions, or labels and sessions do not fit.
    """
    if sessions:
        tracks = labelled_sessions(sessions, labels)
        report = learning.leave_one_animal_out(tracks, seed=_SEED, progress=progress)
        model = learning.learn(tracks, seed=_SEED, progress=progress)
        model = learning.with_card(
            model, made_by="liex train actions", labels="people's", n_recordings=len(tracks)
        )
        return storage.save_action_model(model, out), report

    estimator = estimator_of(animal, "default", progress, pose_model)
    tracks, cuts = learning_set(animal, estimator, progress)
    model = learning.learn(
        tracks,
        seed=_SEED,
        definitions=vocabulary.DEFINITIONS.get(animal),
        sequences=cuts,
        progress=progress,
    )
    model = learning.with_card(
        model,
        made_by="liex train actions",
        labels="those of generated recordings; no recording of an animal was used",
        n_recordings=len(tracks),
        n_sequences=len(cuts),
        pose_model=estimator.model.digest(),
    )
    return storage.save_action_model(model, out), {}


def labelled_sessions(
    sessions: Sequence[str | Path], labels: Sequence[str | Path]
) -> list[LabelledTrack]:
    """The tracks of sessions with the manual label of each frame.

    Args:
        sessions: session folders.
        labels: files of labels; () uses the sessions' own human bouts. If there are several
            sessions, `session_id` in the labels assigns bouts to sessions.

    Returns:
        One labelled track per session, named by its subject, else by the session.

    Raises:
        LiexError: the labels do not name a session, or a session has no label at all.
    """
    table = pd.concat([read_any_labels(path) for path in labels]) if labels else None
    tracks = []
    for path in sessions:
        session = Session.open(path)
        own = session.bouts[session.bouts["source"] == "human"] if table is None else table
        track = evidence.track_of(session)
        named = session.name if table is not None and session.name in sessions_named(table) else ""
        if table is not None and not named and len(sessions) > 1:
            raise LiexError(
                f"the labels name no recording {session.name}; give each session's name as "
                "session_id (in BORIS: the observation's name)"
            )
        words = words_of(own, (track.times_ns - track.times_ns[0]) * 1e-9, named)
        if (words == ethogram.UNLABELLED).all():
            raise LiexError(
                f"the session {session.path} has no bout that a person labelled; give them with "
                "--labels, or correct them in BORIS (`liex export --to boris`)"
            )
        about = session.table("sessions").iloc[0]
        tracks.append(
            LabelledTrack(
                track, words, str(about["subject_id"]) or session.name, evidence.wall_of(session)
            )
        )
    return tracks


def read_any_labels(path: str | Path, session: Session | None = None) -> pd.DataFrame:
    """Labels from our table, a CSV, BORIS (project, or aggregated events), or syllables of MoSeq.

    Args:
        path: the file; `.boris` and `.boris.gz` are projects; the format of a `.csv` or `.tsv` is
            detected from its content.
        session: the session to label, which syllables need: they are of its frames.

    Returns:
        One row per bout.

    Raises:
        LiexError: there is no such file.
    """
    source = Path(path)
    if not source.is_file():
        raise LiexError(f"there is no file of labels {source}; check the path")
    if session is not None and are_syllables(source):
        return syllable_labels(source, session)
    if source.name.endswith((".boris", ".boris.gz")):
        return boris_labels(source)
    if source.suffix in (".tsv", ".csv") and is_boris_export(source):
        return boris_export_labels(source)
    return read_labels(source)


def suggest(
    session: str | Path, *, model: str | Path | None = None, n: int = 10, least_s: float = 0.5
) -> pd.DataFrame:
    """The segments of a session most worth labelling next: where the recogniser is least certain.

    Segments are ranked by mean entropy, but the worst of every pair of confused actions comes
    first, so that no single confusion fills the list.

    Args:
        session: the session folder.
        model: an action model's name or path; None uses that of the session's animal.
        n: maximum number of segments.
        least_s: length of a segment, s.

    Returns:
        Columns `start_s`, `stop_s`, `guess`, `or_else` (the two likeliest actions) and
        `uncertainty` (entropy over its largest value, 0 to 1).

    Raises:
        LiexError: the model is of another animal.
    """
    opened = Session.open(session)
    skeleton = str(opened.metadata["animal"]["name"])
    recogniser = storage.load_action_model(model or skeleton)
    if recogniser.skeleton != skeleton:
        raise LiexError(
            f"the action model is for a {recogniser.skeleton}, the session for a {skeleton}; use "
            "another"
        )
    track = evidence.track_of(opened)
    rows = learning.doubtful_segments(
        recogniser.recognise(track, evidence.wall_of(opened)), track.times_ns, n, least_s
    )
    return pd.DataFrame(rows, columns=["start_s", "stop_s", "guess", "or_else", "uncertainty"])


# Training and test splits of generated behaviour for action recognition.


WORDS = {"fish": fish_acts.ACTIONS, "mouse": mouse_acts.ACTIONS}
RATE_HZ = {"fish": 50.0, "mouse": 30.0}  # of their cameras
FAST_HZ = 100.0
_TRAIN_SET = tuple(range(201, 225))
_TEST_SET = tuple(range(301, 307))
N_USUAL = len(_TRAIN_SET)  # the first training recordings are of the usual camera


def cut_sequences(animal: str, test: bool) -> list[Scenario]:
    """Cut-out sequences of single actions, the actions in turn: the paper's experiment.

    426 training sequences of five individuals, or 173 test sequences of two.
    """
    # as in the paper, of 5 and 2 fish
    individuals, n = ((106, 107), 173) if test else ((101, 102, 103, 104, 105), 426)
    words = WORDS[animal]
    return [
        Scenario(
            animal,
            individuals[k % len(individuals)],
            1000 + k,
            RATE_HZ[animal],
            word=words[k % len(words)],
        )
        for k in range(n)
    ]


def training_recordings(animal: str) -> list[Scenario]:
    """Uncut training recordings, 24 of 40 s each; for fish also 8 of 20 s each at 100 Hz."""
    usual = [Scenario(animal, one, 1, RATE_HZ[animal], 40.0) for one in _TRAIN_SET]
    return usual + [
        Scenario(animal, one, 2, FAST_HZ, 20.0)
        for one in (range(225, 233) if animal == "fish" else ())
    ]


def test_recordings(animal: str, fast: bool, minutes: float) -> list[Scenario]:
    """Uncut test recordings of individuals whose traits are outside the training's.

    Args:
        animal: `fish` or `mouse`.
        fast: the first sixth of the same recordings by a 100 Hz camera, instead of all of them by
            the usual one.
        minutes: total length; about 5 minutes come from each of at most 6 individuals.
    """
    # a test recording has about 300 s; fewer minutes use fewer recordings
    n = int(np.clip(round(60.0 * minutes / 300.0), 1, len(_TEST_SET)))
    seconds = 60.0 * minutes / n
    usual = [
        Scenario(animal, one, 3, RATE_HZ[animal], seconds, novel=True) for one in _TEST_SET[:n]
    ]
    # the share of every test recording that is also filmed by a faster camera
    return (
        [replace(one, rate_hz=FAST_HZ, filmed_s=(1.0 / 6.0) * seconds) for one in usual]
        if fast
        else usual
    )


test_recordings.__test__ = False  # type: ignore[attr-defined]  # its name is not a test's
