"""Training of action recognisers, and active learning: `liex train actions`, `liex suggest`.

The recogniser (a network on windowed features under a semi-Markov model, `liex_lab.actions`) is
trained on manually labelled sessions and scored by leave-one-animal-out cross-validation; or,
without any, on generated recordings of a virtual animal at several frame rates. Labels come from
our tables, from CSV, from BORIS projects and from BORIS's exports. `suggest` is uncertainty
sampling: it ranks the segments to label next by the entropy of the recogniser's actions.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from liex_lab.errors import LiexError
from liex_lab.runtime.progress import Progress, silent
from liex_lab.sessions.evidence import track_of, wall_of
from liex_lab.simulation.agents import fish, mouse

from .agent_tracks import Scenario

if TYPE_CHECKING:
    import pandas as pd

    from liex_lab.actions.labels import LabelledTrack
    from liex_lab.actions.timeline import TimelineModel
    from liex_lab.estimation.estimator import PoseEstimator
    from liex_lab.sessions import Session


Array = NDArray[np.float64]

_SEED = 6
# lower frame rates at which some of the generated training recordings are repeated
_SLOWER_HZ = (15.0, 30.0)


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
    from .agent_tracks import acted, acted_tracks

    if animal not in WORDS:
        raise LiexError(
            f"actions are generated for {' and '.join(WORDS)}, not for {animal}; name labelled "
            "sessions"
        )
    recordings = acted(training_recordings(animal), estimator, progress)
    usual = by_usual_camera(recordings)
    slower = [
        one.tracked(rate) for rate in _SLOWER_HZ if rate < RATE_HZ[animal] for one in usual[::3]
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
    from liex_lab.actions.learning import learn, leave_one_animal_out, with_card
    from liex_lab.actions.storage import save_action_model
    from liex_lab.actions.vocabulary import DEFINITIONS

    if sessions:
        tracks = labelled_sessions(sessions, labels)
        report = leave_one_animal_out(tracks, seed=_SEED, progress=progress)
        model = learn(tracks, seed=_SEED, progress=progress)
        model = with_card(
            model, made_by="liex train actions", labels="people's", n_recordings=len(tracks)
        )
        return save_action_model(model, out), report
    from .pose_model import estimator_of

    estimator = estimator_of(animal, "default", progress, pose_model)
    tracks, cuts = learning_set(animal, estimator, progress)
    model = learn(
        tracks, seed=_SEED, definitions=DEFINITIONS.get(animal), sequences=cuts, progress=progress
    )
    model = with_card(
        model,
        made_by="liex train actions",
        labels="those of generated recordings; no recording of an animal was used",
        n_recordings=len(tracks),
        n_sequences=len(cuts),
        pose_model=estimator.model.digest(),
    )
    return save_action_model(model, out), {}


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
    import pandas as pd

    from liex_lab.actions.ethogram import UNLABELLED
    from liex_lab.actions.labels import LabelledTrack, sessions_named, words_of
    from liex_lab.sessions import Session

    table = pd.concat([read_any_labels(path) for path in labels]) if labels else None
    tracks = []
    for path in sessions:
        session = Session.open(path)
        own = session.bouts[session.bouts["source"] == "human"] if table is None else table
        track = track_of(session)
        named = session.name if table is not None and session.name in sessions_named(table) else ""
        if table is not None and not named and len(sessions) > 1:
            raise LiexError(
                f"the labels name no recording {session.name}; give each session's name as "
                "session_id (in BORIS: the observation's name)"
            )
        words = words_of(own, (track.times_ns - track.times_ns[0]) * 1e-9, named)
        if (words == UNLABELLED).all():
            raise LiexError(
                f"the session {session.path} has no bout that a person labelled; give them with "
                "--labels, or correct them in BORIS (`liex export --to boris`)"
            )
        about = session.table("sessions").iloc[0]
        tracks.append(
            LabelledTrack(track, words, str(about["subject_id"]) or session.name, wall_of(session))
        )
    return tracks


def read_any_labels(path: str | Path) -> pd.DataFrame:
    """Labels from our table, a CSV, a BORIS project or BORIS's export of aggregated events.

    Args:
        path: the file; `.boris` and `.boris.gz` are projects; the format of a `.csv` or `.tsv` is
            detected from its content.

    Returns:
        One row per bout.

    Raises:
        LiexError: there is no such file.
    """
    from liex_lab.actions.labels import read_labels
    from liex_lab.exchange.boris import boris_export_labels, boris_labels, is_boris_export

    source = Path(path)
    if not source.is_file():
        raise LiexError(f"there is no file of labels {source}; check the path")
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
    import pandas as pd

    from liex_lab.actions.learning import doubtful_segments

    opened, recogniser = _session_and_model(session, model)
    track = track_of(opened)
    found = recogniser.recognise(track, wall_of(opened))
    rows = doubtful_segments(found, track.times_ns, n, least_s)
    return pd.DataFrame(rows, columns=["start_s", "stop_s", "guess", "or_else", "uncertainty"])


def _session_and_model(
    session: str | Path, model: str | Path | None
) -> tuple[Session, TimelineModel]:
    from liex_lab.actions.storage import load_action_model
    from liex_lab.sessions import Session

    opened = Session.open(session)
    skeleton = str(opened.metadata["animal"]["name"])
    recogniser = load_action_model(model or skeleton)
    if recogniser.skeleton != skeleton:
        raise LiexError(
            f"the action model is for a {recogniser.skeleton}, the session for a {skeleton}; use "
            "another"
        )
    return opened, recogniser


# Training and test splits of generated behaviour for action recognition.


Recorded = TypeVar("Recorded")

WORDS = {"fish": fish.ACTIONS, "mouse": mouse.ACTIONS}
RATE_HZ = {"fish": 50.0, "mouse": 30.0}  # of their cameras
FAST_HZ = 100.0
# cut-out sequences, as in the paper, of 5 and 2 fish
N_TRAIN = 426
N_TEST = 173
_TRAIN_FISH = (101, 102, 103, 104, 105)
_TEST_FISH = (106, 107)
_TRAIN_SET = tuple(range(201, 225))
_TEST_SET = tuple(range(301, 307))
_FAST_SET = {"fish": tuple(range(225, 233))}
_SECONDS = 40.0
_FAST_SECONDS = 20.0
_TEST_SECONDS = 300.0  # of a test recording, about; fewer minutes use fewer recordings
_FAST_SHARE = 1.0 / 6.0  # share of every test recording that is also filmed by a faster camera


def cut_sequences(animal: str, test: bool) -> list[Scenario]:
    """Cut-out sequences of single actions, the actions in turn: the paper's experiment.

    426 training sequences of five individuals, or 173 test sequences of two.
    """
    individuals, n = (_TEST_FISH, N_TEST) if test else (_TRAIN_FISH, N_TRAIN)
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
    usual = [Scenario(animal, one, 1, RATE_HZ[animal], _SECONDS) for one in _TRAIN_SET]
    return usual + [
        Scenario(animal, one, 2, FAST_HZ, _FAST_SECONDS) for one in _FAST_SET.get(animal, ())
    ]


def by_usual_camera(recordings: Sequence[Recorded]) -> list[Recorded]:
    """The entries of the animal's usual camera, the first 24 of `training_recordings`."""
    return list(recordings[: len(_TRAIN_SET)])


def test_recordings(animal: str, fast: bool, minutes: float) -> list[Scenario]:
    """Uncut test recordings of individuals whose traits are outside the training's.

    Args:
        animal: `fish` or `mouse`.
        fast: the first sixth of the same recordings by a 100 Hz camera, instead of all of them by
            the usual one.
        minutes: total length; about 5 minutes come from each of at most 6 individuals.
    """
    n = int(np.clip(round(60.0 * minutes / _TEST_SECONDS), 1, len(_TEST_SET)))
    seconds = 60.0 * minutes / n
    usual = [
        Scenario(animal, one, 3, RATE_HZ[animal], seconds, novel=True) for one in _TEST_SET[:n]
    ]
    return (
        [replace(one, rate_hz=FAST_HZ, filmed_s=_FAST_SHARE * seconds) for one in usual]
        if fast
        else usual
    )


test_recordings.__test__ = False  # type: ignore[attr-defined]  # its name is not a test's
