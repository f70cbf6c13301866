"""`liex evaluate actions --tracks`: our words beside people's, on points of animals kept apart."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from liex_lab.pipelines.evaluation import actions
from typer.testing import CliRunner

from liex_lab import cli
from liex_lab.errors import LiexError
from tests.sessions.walking_mouse import WalkingMouse

NAMES = ("tail_base", "chest", "neck", "nose")


def write(path: Path, seed: int, **changed: Any) -> None:
    """A mouse that walks and rears, labelled by what it did; a word is missing for a second."""
    rng = np.random.default_rng(seed)
    times = np.arange(500) / 20.0
    labels = np.full(500, "walking")
    joints = np.empty((500, 4, 3))
    for k in range(5):  # a rear every five seconds
        start = rng.uniform(1.0, 2.5)
        mouse = WalkingMouse(times[:100], 120.0, rear_s=(start, start + 1.5))
        part = slice(100 * k, 100 * (k + 1))
        joints[part] = mouse.track().joints_mm[:, [0, 2, 3, 4]]
        joints[part] += [300.0 * k, 0.0, 0.0]
        rears = (times[:100] > start) & (times[:100] < start + 1.5)
        labels[part][rears] = "rearing"
    labels[:20] = "na"
    held: dict[str, Any] = {
        "points_mm": joints,
        "points": NAMES,
        "time_s": times,
        "label": labels,
    } | changed
    np.savez(path, **{name: value for name, value in held.items() if value is not None})


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("tracks")
    for k, name in enumerate(("adult_1", "young_1", "adult_2")):
        write(folder / f"{name}.npz", k)
    return folder


@pytest.mark.slow
def test_rules_and_taught_words_are_scored_on_animals_kept_apart(folder, tmp_path, monkeypatch):
    monkeypatch.setattr(actions.learning, "_LEAST_STEPS", 100)
    told = tmp_path / "told.json"
    words = ["evaluate", "actions", "--tracks", str(folder), "--json", str(told)]
    result = CliRunner().invoke(cli.app, words)
    assert result.exit_code == 0, result.output
    scores = json.loads(told.read_text())
    assert (scores["n_recordings"], scores["n_animals"]) == (3, 2)
    assert scores["words"] == ["rearing", "walking"]
    for name in ("rearing_f1_rules", "rearing_f1_taught", "macro_f1_taught"):
        assert scores[name] > 0.9
        low, high = scores["interval95"][name]
        assert low <= scores[name] <= high
    assert set(scores["per_animal"]) == {"1", "2"}
    assert "3 recordings of 2 animals" in scores["protocol"]


def test_frames_without_a_word_count_for_nothing():
    (one, _), words = _people_of(np.array(["", "a", "a", "b"])), ["a", "b"]
    counts = actions._counted(one, np.array(["a", "a", "b", "b"]), words)
    np.testing.assert_array_equal(counts.sum(axis=0), [[1, 1, 2], [1, 2, 1]])


def _people_of(words: np.ndarray) -> tuple[actions.LabelledTrack, None]:
    track = WalkingMouse(np.arange(len(words)) / 20.0).track()
    return actions.LabelledTrack(track, words, "m", np.full(len(words), np.nan)), None


@pytest.mark.parametrize(
    ("changed", "sentence"),
    [
        ({"label": np.full(499, "rearing")}, "500 frames and 499 labels"),
        ({"label": None}, r"no file of labels .*a_2\.labels\.csv"),
        ({"label": np.full(500, "na")}, "with no word"),
    ],
)
def test_labels_that_cannot_be_used_are_one_sentence(changed, sentence, tmp_path):
    write(tmp_path / "a_2.npz", 1, **changed)
    if "label" in changed and changed["label"] is not None and len(changed["label"]) == 500:
        write(tmp_path / "a_3.npz", 2, **changed)
    with pytest.raises(LiexError, match=sentence):
        actions.evaluate_tracks(tmp_path)


def test_one_animal_is_not_enough(tmp_path):
    write(tmp_path / "adult_7.npz", 1)
    with pytest.raises(LiexError, match="at least two animals"):
        actions.evaluate_tracks(tmp_path)


def test_labels_may_lie_beside_the_points(folder, tmp_path):
    for k, name in enumerate(("adult_1", "adult_2")):
        write(tmp_path / f"{name}.npz", k, label=None)
        labels = tmp_path / f"{name}.labels.csv"
        labels.write_text("action,start_s,stop_s\nwalking,1.0,24.0\nrearing,2.0,3.0\n")
    one, _ = actions._people(tmp_path / "adult_1.npz", actions.PointNames())
    assert one.animal == "1"
    assert list(one.words[[0, 30, 50]]) == ["", "walking", "rearing"]
