"""Cohen's kappa against published numbers, scikit-learn, and its own interval against samples."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from sklearn.metrics import cohen_kappa_score

from liex_lab.actions import Bout, Ethogram
from liex_lab.actions.labels import (
    cohens_kappa,
    confusion,
    interval95,
    match_bouts,
    timeline_scores,
)
from liex_lab.errors import LiexError
from tests.actions.toy import going_and_staying


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


# An ethogram is ordered, half open and without overlap, and frames and bouts say the same.


STEP_NS = 20_000_000


@given(st.lists(st.sampled_from(["", "scoot", "dive", "freeze"]), min_size=1, max_size=60))
def test_bouts_made_of_words_give_the_words_back(words: list[str]) -> None:
    times = np.arange(len(words)) * STEP_NS + 7
    ethogram = Ethogram.of_words(words, times)
    assert list(ethogram.words(times)) == words
    assert all(
        a.stop_ns <= b.start_ns for a, b in zip(ethogram.bouts, ethogram.bouts[1:], strict=False)
    )


def test_a_bout_ends_where_its_stretch_does_one_usual_step_after_its_last_frame() -> None:
    times = np.array([0, 1, 2, 10, 11]) * STEP_NS
    ethogram = Ethogram.of_words(["dive"] * 5, times, part=np.array([0, 0, 0, 1, 1]))
    assert [(bout.start_ns // STEP_NS, bout.stop_ns // STEP_NS) for bout in ethogram] == [
        (0, 3),
        (10, 12),
    ]


@pytest.mark.parametrize("bouts", [(Bout(0, 5, "a"), Bout(4, 9, "b")), (Bout(3, 3, "a"),)])
def test_bouts_that_overlap_or_have_no_length_are_refused(bouts: tuple[Bout, ...]) -> None:
    with pytest.raises(LiexError, match=r"overlap|after its start"):
        Ethogram(bouts)


def test_a_bout_counts_where_it_shares_half_of_what_either_covers() -> None:
    true = np.zeros(100, bool)
    true[10:30] = True
    for stop, hits in ((30, 1), (50, 1), (51, 0), (20, 1), (19, 0)):
        found = np.zeros(100, bool)
        found[10:stop] = True
        assert match_bouts(true, found) == (hits, 1, 1)


def test_scores_of_the_labels_themselves_are_perfect() -> None:
    one = going_and_staying(3)
    scores = timeline_scores([(one, one.words)], ["", "go", "stay"])
    assert (scores["macro_f1"], scores["segment_f1_50"]) == (1.0, 1.0)
    wrong = np.where(one.words == "go", "stay", "go")
    assert timeline_scores([(one, wrong)], ["", "go", "stay"])["macro_f1"] == 0.0


def test_confusion_and_interval_are_those_of_a_textbook() -> None:
    assert confusion(["a", "a", "b"], ["a", "b", "b"], ["a", "b"]) == [[1, 1], [0, 1]]
    low, high = interval95(158, 173)
    assert (round(low, 3), round(high, 3)) == (0.862, 0.947)  # Wilson's, of the paper's 91.33 %
