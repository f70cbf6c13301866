"""Cohen's kappa against published numbers, scikit-learn, and its own interval against samples."""

from __future__ import annotations

import math

import numpy as np
import pytest
from sklearn.metrics import cohen_kappa_score

from liex_lab.actions.scores import cohens_kappa


def raters(table: list[list[int]]) -> tuple[list[str], list[str]]:
    """Two raters whose words fall into a table of counts."""
    pairs = [
        ("abc"[i], "abc"[j])
        for i, row in enumerate(table)
        for j, count in enumerate(row)
        for _ in range(count)
    ]
    return [a for a, _ in pairs], [b for _, b in pairs]


def test_kappa_and_its_standard_error_are_those_of_fleiss_cohen_and_everitt() -> None:
    # the example of Fleiss, Levin and Paik (2003), section 18.1: kappa 0.676, standard error 0.087
    found = cohens_kappa(*raters([[75, 1, 4], [5, 4, 1], [0, 0, 10]]))
    assert found.observed == pytest.approx(0.89)
    assert found.expected == pytest.approx(0.66)
    assert found.kappa == pytest.approx(0.676, abs=5e-4)
    assert (found.high - found.low) / 2 / 1.96 == pytest.approx(0.087, abs=1e-3)


def test_kappa_is_that_of_scikit_learn_and_does_not_mind_who_comes_first() -> None:
    rng = np.random.default_rng(5)
    for _ in range(20):
        a = rng.choice(list("abcd"), 40).tolist()
        b = [one if rng.random() < 0.6 else str(rng.choice(list("abcd"))) for one in a]
        found = cohens_kappa(a, b)
        assert found.kappa == pytest.approx(cohen_kappa_score(a, b))
        assert cohens_kappa(b, a).kappa == pytest.approx(found.kappa)
        assert found.low < found.kappa < found.high


def test_its_interval_holds_the_true_kappa_as_often_as_it_says() -> None:
    rng = np.random.default_rng(6)
    truth = 0.6  # two words in equal shares; the second rater keeps 0.6 and guesses the rest
    held = 0
    for _ in range(400):
        a = rng.choice(["x", "y"], 80)
        b = np.where(rng.random(80) < truth, a, rng.choice(["x", "y"], 80))
        found = cohens_kappa(a.tolist(), b.tolist())
        held += found.low <= truth <= found.high
    assert 0.91 < held / 400 < 0.98


def test_where_there_is_nothing_to_agree_on_there_is_no_kappa() -> None:
    assert math.isnan(cohens_kappa(["a"] * 5, ["a"] * 5).kappa)
    assert math.isnan(cohens_kappa([], []).kappa)
    assert cohens_kappa(["a", "b"], ["a", "b"]).kappa == pytest.approx(1.0)
    with pytest.raises(ValueError, match="the same things"):
        cohens_kappa(["a"], [])
