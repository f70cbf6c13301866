"""The semi-Markov chain agrees with looking at every path, and keeps to shortest durations."""

from __future__ import annotations

import numpy as np
import pytest

from liex_lab.actions.semi_markov import SemiMarkovModel
from tests.oracles.actions import every_path


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


def test_no_action_is_shorter_than_its_shortest_but_at_the_ends() -> None:
    rng = np.random.default_rng(1)
    chain = SemiMarkovModel(
        np.array([0.1, 0.5]), np.array([0.6, 0.9]), np.array([[0.0, 1.0], [1.0, 0.0]])
    )
    label = chain.decode(rng.normal(0.0, 2.0, (2000, 2)), 0.05)
    edges = np.flatnonzero(np.diff(label)) + 1
    lengths = np.diff(edges)
    kinds = label[edges[:-1]]
    assert lengths[kinds == 1].min() >= 10
    assert lengths[kinds == 0].min() >= 2


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
    monkeypatch.setattr("liex_lab.actions.semi_markov._PIECE", 100)
    monkeypatch.setattr("liex_lab.actions.semi_markov._MARGIN", 80)
    np.testing.assert_allclose(chain.probabilities(scores, 0.05), whole, atol=1e-4)
