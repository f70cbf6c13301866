"""An ethogram is ordered, half open and without overlap, and frames and bouts say the same."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from liex_lab.actions import Bout, Ethogram
from liex_lab.actions.scores import confusion, interval95, match_bouts, timeline_scores
from liex_lab.errors import LiexError
from tests.actions.toy import going_and_staying

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
