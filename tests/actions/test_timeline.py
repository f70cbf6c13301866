"""The default recogniser learns from labelled tracks, works at other frame rates, and is kept
without pickle.
"""

import zipfile
from collections.abc import Callable
from copy import deepcopy
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from skops import io
from threadpoolctl import threadpool_limits

from liex_lab.actions import storage
from liex_lab.actions.labels import LabelledTrack, read_labels, timeline_scores, words_of
from liex_lab.actions.learning import doubtful_segments, learn, leave_one_animal_out
from liex_lab.actions.storage import load_action_model, save_action_model
from liex_lab.actions.timeline import SemiMarkovModel, TimelineModel
from liex_lab.errors import LiexError, ModelError
from liex_lab.mlp import Network
from liex_lab.runtime.memory import on_disk
from tests.actions.toy import GO, STAY, few_steps, going_and_staying, trained
from tests.oracles.actions import every_path


@pytest.fixture(scope="module")
def model() -> TimelineModel:
    return trained()


def scores(model: TimelineModel, one: LabelledTrack) -> dict[str, float]:
    found = model.recognise(one.track).ethogram.words(one.track.times_ns)
    return timeline_scores([(one, found)], model.words)


@pytest.mark.parametrize("rate_hz", [15.0, 30.0, 100.0])
def test_it_recognises_what_it_learned_at_30_frames_a_second_at_any_rate(
    model: TimelineModel, rate_hz: float
) -> None:
    found = scores(model, going_and_staying(11, rate_hz))
    assert found["macro_f1"] > 0.9
    assert found["segment_f1_50"] > 0.9


def test_no_bout_crosses_a_gap_and_every_frame_with_a_pose_has_probabilities(
    model: TimelineModel,
) -> None:
    one = going_and_staying(12)
    one.track.joints_mm[300:360] = np.nan
    found = model.recognise(one.track)
    times = one.track.times_ns
    for bout in found.ethogram:
        assert not (bout.start_ns < times[300] and bout.stop_ns > times[310])
    assert np.isnan(found.probability[330]).all()
    np.testing.assert_allclose(np.nansum(found.probability, axis=1)[:300], 1.0, atol=1e-5)
    assert all(0.0 <= bout.score <= 1.0 for bout in found.ethogram)


def test_what_lies_on_disk_on_the_way_is_named_as_in_memory(
    model: TimelineModel, tmp_path: Path
) -> None:
    one = going_and_staying(14)
    in_memory, on_the_disk = (
        model.recognise(one.track),
        model.recognise(one.track, allocate=on_disk(tmp_path)),
    )
    assert on_the_disk.ethogram == in_memory.ethogram
    np.testing.assert_array_equal(on_the_disk.probability, in_memory.probability)


def test_what_a_frame_rate_cannot_resolve_is_told(model: TimelineModel) -> None:
    assert model.unresolved(np.arange(9) * 10**9 // 120) == {}
    assert set(model.unresolved(np.arange(9) * 10**9)) == {GO, STAY}


def test_a_network_says_the_same_bits_on_any_number_of_cores() -> None:
    rng = np.random.default_rng(0)

    def layer(n: int, m: int) -> tuple[np.ndarray, np.ndarray]:
        return rng.normal(0, 1, (n, m)).astype(np.float32), rng.normal(0, 1, m).astype(np.float32)

    network = Network(
        np.zeros(140, np.float32), np.ones(140, np.float32), (layer(140, 64), layer(64, 9))
    )
    features = rng.normal(0, 1, (4000, 140)).astype(np.float32)
    said = []
    for n_threads in (1, 2):
        with threadpool_limits(n_threads, user_api="blas"):
            said.append(network.logits(features))
    np.testing.assert_array_equal(said[0], said[1])


def test_a_cut_out_sequence_gets_one_word(model: TimelineModel) -> None:
    one = going_and_staying(13)
    start = int(np.flatnonzero(one.words == STAY)[0])
    assert model.name(one.track[start + 2 : start + 20]) == STAY


def test_a_model_read_back_says_the_same_and_its_file_holds_no_pickle(
    model: TimelineModel, tmp_path: Path
) -> None:
    path = save_action_model(model, tmp_path / "own.skops")
    again = load_action_model(path)
    one = going_and_staying(14)
    assert again.recognise(one.track).ethogram == model.recognise(one.track).ethogram
    assert again.definitions == model.definitions
    with zipfile.ZipFile(path) as archive:
        assert not [name for name in archive.namelist() if name.endswith((".pkl", ".pickle"))]


def test_equal_models_are_equal_bytes_that_skops_reads(
    model: TimelineModel, tmp_path: Path
) -> None:
    first, second = (
        save_action_model(m, tmp_path / f"{k}.skops")
        for k, m in enumerate([model, deepcopy(model)])
    )
    assert first.read_bytes() == second.read_bytes()
    np.testing.assert_array_equal(io.load(first)["networks"][0]["centre"], model.networks[0].centre)


def test_a_bout_that_is_never_as_fast_as_its_word_asks_for_gets_another_word(
    model: TimelineModel,
) -> None:
    least = dict(zip(model.words, model.peaks, strict=True))
    assert 2.0 < least[GO] < 3.2  # lengths a second: it goes at 3
    assert least[STAY] == least[""] == 0.0
    one, go = going_and_staying(15), model.words.index(GO)
    free = replace(model, peaks=np.zeros(len(model.words)))
    assert model.recognise(one.track).ethogram == free.recognise(one.track).ethogram
    asking = replace(model, peaks=np.where(np.arange(len(model.words)) == go, 6.0, 0.0))
    assert GO in {bout.action for bout in free.recognise(one.track).ethogram}
    assert GO not in {bout.action for bout in asking.recognise(one.track).ethogram}


def test_a_model_file_of_the_first_format_asks_for_no_speed(
    model: TimelineModel, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as earlier:
        earlier.setattr(storage, "_FORMAT", 1)
        path = save_action_model(model, tmp_path / "old.skops")
    assert not load_action_model(path).peaks.any()


@pytest.mark.parametrize(
    "change",
    [
        lambda m: {"words": m.words[:-1]},
        lambda m: {"words": (*m.words[:-1], m.words[0])},
        lambda m: {"share": m.share[:-1]},
        lambda m: {"speeds": m.speeds[:, :1]},
        lambda m: {"peaks": m.peaks * np.nan},
        lambda m: {"clock_hz": 1e12},
        lambda m: {"networks": ()},
        lambda m: {"chain": replace(m.chain, shortest_s=m.chain.shortest_s - 1e9)},
        lambda m: {"chain": replace(m.chain, shortest_s=m.chain.shortest_s + 1e9)},
        lambda m: {"chain": replace(m.chain, follow=m.chain.follow[:, :-1])},
        lambda m: {"networks": (replace(m.networks[0], layers=m.networks[0].layers[:-1]),)},
        lambda m: {"networks": (replace(m.networks[0], centre=m.networks[0].centre[:-1]),)},
    ],
)
def test_a_model_file_whose_parts_are_not_of_its_words_is_one_sentence(
    model: TimelineModel, tmp_path: Path, change: Callable[[TimelineModel], dict[str, Any]]
) -> None:
    path = save_action_model(replace(model, **change(model)), tmp_path / "other.skops")
    with pytest.raises(ModelError, match=r"other\.skops should be an action model"):
        load_action_model(path)


@pytest.mark.parametrize("content", [b"", b"not a model", b"PK\x03\x04" + bytes(40)])
def test_a_file_that_is_no_model_is_one_sentence(content: bytes, tmp_path: Path) -> None:
    path = tmp_path / "broken.skops"
    path.write_bytes(content)
    with pytest.raises(ModelError, match="made by `liex train actions`"):
        load_action_model(path)
    with pytest.raises(ModelError, match="no action model"):
        load_action_model(tmp_path / "absent.skops")


def test_each_animal_is_scored_by_a_model_that_has_not_seen_it() -> None:
    with few_steps():
        report = leave_one_animal_out([going_and_staying(seed, seconds=10.0) for seed in range(2)])
    assert set(report["macro_f1_by_animal"]) == {"mouse-0", "mouse-1"}
    assert report["macro_f1"] > 0.8
    assert "note" in leave_one_animal_out([going_and_staying(0)])


def test_labels_of_one_word_only_are_refused() -> None:
    one = going_and_staying(1)
    with pytest.raises(LiexError, match="at least two actions"):
        learn([replace(one, words=np.full(len(one), GO))])


def test_the_stretches_suggested_do_not_overlap_and_lie_in_the_recording(
    model: TimelineModel,
) -> None:
    one = going_and_staying(15)
    rows = doubtful_segments(model.recognise(one.track), one.track.times_ns, 6, 0.5)
    assert rows
    spans = sorted((row["start_s"], row["stop_s"]) for row in rows)
    assert all(a[1] <= b[0] + 1e-6 for a, b in pairwise(spans))


def test_labels_from_a_table_are_placed_on_frames_half_open(tmp_path: Path) -> None:
    path = tmp_path / "labels.csv"
    pd.DataFrame({"action": ["dig", "rest"], "start_s": [0.2, 0.5], "stop_s": [0.4, 0.7]}).to_csv(
        path, index=False
    )
    words = words_of(read_labels(path), np.linspace(0.0, 0.9, 10))
    assert list(words) == ["", "", "dig", "dig", "", "rest", "rest", "", "", ""]


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("a,b\n1,2\n", "lacks action"),
        ("action,start_s,stop_s\nx,2,1\n", "starts before it stops"),
        ("action,start_s,stop_s\nx,one,2\n", "starts before it stops"),
    ],
)
def test_a_table_that_holds_no_bouts_is_one_sentence(
    text: str, complaint: str, tmp_path: Path
) -> None:
    path = tmp_path / "labels.csv"
    path.write_text(text)
    with pytest.raises(LiexError, match=complaint):
        read_labels(path)


# The semi-Markov chain agrees with looking at every path, and keeps to shortest durations.


@pytest.mark.parametrize("seed", range(6))
def test_best_path_and_probabilities_agree_with_every_path(seed: int) -> None:
    rng = np.random.default_rng(seed)
    follow = rng.random((3, 3)) * (1 - np.eye(3))
    chain = SemiMarkovModel(
        np.array([1.0, 2.0, 1.0]), np.array([2.5, 3.0, 1.6]), follow / follow.sum(1, keepdims=True)
    )
    scores = rng.normal(0.0, 1.0, (6, 3))
    paths = list(every_path(scores, *chain._terms(1.0)))
    best = max(paths, key=lambda path: path[0])
    assert list(chain.decode(scores, 1.0)) == best[1]
    weights = np.exp(np.array([weight for weight, _ in paths]) - best[0])
    words = np.array([path for _, path in paths])
    expected = (
        np.stack([(weights[:, None] * (words == k)).sum(axis=0) for k in range(3)], axis=1)
        / weights.sum()
    )
    np.testing.assert_allclose(chain.probabilities(scores, 1.0), expected, atol=1e-5)


def test_durations_and_successions_are_learned_from_bouts() -> None:
    chain = SemiMarkovModel.learn([[(0, 1.0), (1, 2.0), (0, 1.2), (1, 2.2)]], 3)
    assert chain.mean_s[:2] == pytest.approx([1.1, 2.1])
    assert chain.follow[0, 1] > chain.follow[0, 2]
    np.testing.assert_allclose(chain.follow.sum(axis=1), 1.0)


def test_pieces_of_a_long_recording_have_the_probabilities_of_the_whole(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rng = np.random.default_rng(2)
    chain = SemiMarkovModel(
        np.array([0.1, 0.3]), np.array([0.6, 0.9]), np.array([[0.0, 1.0], [1.0, 0.0]])
    )
    scores = rng.normal(0.0, 1.0, (900, 2))
    whole = chain.probabilities(scores, 0.05)
    monkeypatch.setattr("liex_lab.actions.timeline._DECODED_PIECE", 100)
    monkeypatch.setattr("liex_lab.actions.timeline._MARGIN", 80)
    np.testing.assert_allclose(chain.probabilities(scores, 0.05), whole, atol=1e-4)
