"""The jobs behind `liex train actions` and `liex suggest`, and labels that people made."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from liex_lab.errors import LiexError
from liex_lab.runtime.progress import Progress, silent
from liex_lab.sessions.tracks import track_of, wall_of

if TYPE_CHECKING:
    import pandas as pd

    from liex_lab.actions.labels import LabelledTrack
    from liex_lab.actions.timeline import TimelineModel
    from liex_lab.estimation.estimator import PoseEstimator
    from liex_lab.sessions import Session

Array = NDArray[np.float64]

_SEED = 6
_SLOWER_HZ = (
    15.0,
    30.0,
)  # of the generated recordings a model learns from, some as slower cameras see them


def learning_set(
    animal: str, estimator: PoseEstimator, progress: Progress = silent
) -> tuple[list[LabelledTrack], list[LabelledTrack]]:
    """Generated recordings of an animal to learn from, at several frame rates, and cut-out
    sequences.
    """
    from .agent_data import RATE_HZ, WORDS, by_usual_camera, cut_sequences, training_recordings
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
    """A recogniser learned from labelled sessions, or, without any, from generated recordings of an
    animal.

    labels: tables of bouts or BORIS's projects or exports; without any, the sessions' own bouts
    whose source is human. Returns the model's path and, for sessions, its scores on each animal
    when it learned from the others only.
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
    from ..evaluation.pose import estimator_of

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
    """The tracks of sessions with the words that people gave them."""
    import pandas as pd

    from liex_lab.actions.ethogram import UNLABELLED
    from liex_lab.actions.labels import LabelledTrack, words_of
    from liex_lab.sessions import Session

    table = pd.concat([read_any_labels(path) for path in labels]) if labels else None
    tracks = []
    for path in sessions:
        session = Session.open(path)
        own = session.bouts[session.bouts["source"] == "human"] if table is None else table
        track = track_of(session)
        named = session.name if table is not None and session.name in _sessions_named(table) else ""
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


def _sessions_named(table: pd.DataFrame) -> set[str]:
    return set(table["session_id"].astype(str)) if "session_id" in table else set()


def read_any_labels(path: str | Path) -> pd.DataFrame:
    """Labels from our table, a CSV, a BORIS project or BORIS's export of aggregated events."""
    from liex_lab.actions.labels import read_labels
    from liex_lab.exchange.boris_labels import boris_export_labels, boris_labels, is_boris_export

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
    """The stretches of a session most worth labelling next: where the recogniser is least sure, one
    per kind of doubt first. Columns start_s, stop_s, guess, or_else, uncertainty (0 to 1).
    """
    import pandas as pd

    from liex_lab.actions.suggestions import doubtful_stretches

    opened, recogniser = _session_and_model(session, model)
    track = track_of(opened)
    found = recogniser.recognise(track, wall_of(opened))
    rows = doubtful_stretches(found, track.times_ns, n, least_s)
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
