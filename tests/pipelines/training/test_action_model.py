"""From a session to labels and back: its track, BORIS, training on what people labelled, and the
bundled models.
"""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from liex_lab.pipelines.correct import edited_bouts
from liex_lab.pipelines.training.action_model import (
    labelled_sessions,
    read_any_labels,
    suggest,
    train_actions,
)

from liex_lab.actions.storage import SUFFIX, bundled_action_models, load_action_model
from liex_lab.catalog import MODELS
from liex_lab.errors import LiexError
from liex_lab.exchange import export
from liex_lab.exchange.boris import read_boris_project
from liex_lab.sessions import Session
from liex_lab.sessions.correcting import labelled_bouts
from liex_lab.sessions.evidence import track_of, wall_of
from liex_lab.simulation.agents import fish
from liex_lab.simulation.agents import mouse as mouse_acts
from tests.sessions.walking_mouse import WalkingMouse, write

LABELS = pd.DataFrame(
    {"action": ["stroll", "tower", "stroll"], "start_s": [0.0, 2.0, 3.5], "stop_s": [2.0, 3.5, 6.0]}
)


@pytest.fixture(scope="module")
def mouse() -> WalkingMouse:
    return WalkingMouse(np.arange(180) / 30.0, rear_s=(2.0, 3.5), lost=(20, 21))


@pytest.fixture(scope="module")
def session(mouse: WalkingMouse, tmp_path_factory: pytest.TempPathFactory) -> Session:
    return write(tmp_path_factory.mktemp("labelled") / "circle.liex", mouse)


@pytest.fixture(scope="module")
def labels(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("labels") / "labels.csv"
    LABELS.to_csv(path, index=False)
    return path


def test_a_session_gives_back_the_track_it_was_made_from(
    session: Session, mouse: WalkingMouse
) -> None:
    track, true = track_of(session), mouse.track()
    np.testing.assert_array_equal(track.times_ns, true.times_ns)
    np.testing.assert_allclose(track.joints_mm, true.joints_mm, atol=1e-9)
    np.testing.assert_allclose(track.root_rotation, true.root_rotation, atol=1e-9)
    np.testing.assert_allclose(track.angles_rad, true.angles_rad, atol=1e-9)
    np.testing.assert_allclose(track.cov_root, true.cov_root, rtol=1e-12)
    for name in (
        *("uv_px", "sd_mm", "sd_root", "sd_angles_rad", "centroid_mm", "residual_mm", "p_flip"),
        *("bridged", "flag"),
    ):
        np.testing.assert_array_equal(getattr(track, name), getattr(true, name), err_msg=name)
    assert wall_of(session).shape == (180,)


def test_an_ethogram_goes_to_boris_and_comes_back_as_a_humans(
    session: Session, tmp_path: Path
) -> None:
    project = export(session, "boris", tmp_path / "walk.boris")
    assert session.name in read_boris_project(project)["observations"]
    back = edited_bouts(
        session.bouts, labelled_bouts(session, read_any_labels(project)), session.frames
    )
    own = session.bouts
    assert list(back["action"]) == list(own["action"])
    assert np.abs(back["start_s"].to_numpy() - own["start_s"].to_numpy()).max() < 0.034
    assert set(back["source"]) == {"human"}
    assert list(back.columns) == list(own.columns)[: len(back.columns)]


def test_labels_of_several_other_recordings_are_not_taken(session: Session, tmp_path: Path) -> None:
    path = tmp_path / "labels.csv"
    path.write_text("session_id,action,start_s,stop_s\n007,dig,0.5,1.0\n07,rest,1.5,2.0\n")
    labels = read_any_labels(path)
    assert list(labels["session_id"]) == ["007", "07"]
    with pytest.raises(LiexError, match=f"of 007, 07 and of none named {session.name}"):
        labelled_bouts(session, labels)
    assert labelled_bouts(session, labels.assign(session_id=[session.name, "07"]))


def test_a_recogniser_learns_new_words_from_labelled_sessions(
    session: Session, labels: Path, tmp_path: Path
) -> None:
    path, report = train_actions(tmp_path / "own", sessions=[session.path], labels=[labels])
    assert path.suffix == ".skops"
    assert "note" in report  # one animal tells nothing of another
    model = load_action_model(path)
    assert model.words == ("", "stroll", "tower")
    (one,) = labelled_sessions([session.path], [labels])
    found = model.recognise(one.track).ethogram.words(one.track.times_ns)
    assert (found == one.words)[one.track.observed].mean() > 0.85
    assert {"start_s", "stop_s", "guess", "or_else", "uncertainty"} == set(
        suggest(session.path, model=path, n=3)
    )


def test_sessions_without_labels_are_one_sentence(session: Session) -> None:
    with pytest.raises(LiexError, match="no bout that a person labelled"):
        labelled_sessions([session.path], [])
    with pytest.raises(LiexError, match="no file of labels"):
        read_any_labels("absent.csv")


@pytest.mark.parametrize(
    ("animal", "words"), [("fish", fish.ACTIONS), ("mouse", mouse_acts.ACTIONS)]
)
def test_the_bundled_models_know_their_words_and_are_small(
    animal: str, words: tuple[str, ...]
) -> None:
    assert animal in bundled_action_models()
    assert (MODELS / f"{animal}{SUFFIX}").stat().st_size < 2_000_000
    model = load_action_model(animal)
    assert model.skeleton == animal
    assert set(model.words) == {"", *words} == {"", *model.definitions}
    told = {
        rate: model.unresolved((np.arange(9) / rate * 1e9).astype(np.int64))
        for rate in (15.0, 30.0, 300.0)
    }
    quick = {"fish": "c_turn", "mouse": "sniff"}[animal]
    assert {quick} <= set(told[30.0]) <= set(told[15.0]) <= set(words)
    assert "at 30 per second" in told[30.0][quick]
    assert told[300.0] == {}
    if animal == "fish":
        assert "0.02 s, 0.6 frames at 30 per second" in told[30.0]["c_turn"]
