"""Reviews: drawn and shuffled by a seed, kept with every answer, read back or refused in words."""

import json
from pathlib import Path

import numpy as np
import pytest

from liex_lab.errors import SessionError
from liex_lab.sessions import Session
from liex_lab.sessions.review import (
    Clip,
    Review,
    drawn_review,
    read_review,
    review_names,
    write_review,
)
from tests.sessions.walking_mouse import WalkingMouse, steady, write

WORDS = ("walk", "rear")
CLIPS = tuple(Clip(f"s{k}", 1.0, 0.0, 2.0, ("walk", "rear", "")[k % 3]) for k in range(9))


@pytest.fixture(scope="module")
def sessions(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Session]:
    folder = tmp_path_factory.mktemp("review")
    mouse = WalkingMouse(np.delete(steady(6.0), slice(40, 46)), rear_s=(2.0, 3.0))
    return {name: write(folder / f"{name}.liex", mouse, name=name) for name in ("a", "b")}


def test_the_same_seed_draws_the_same_clips_and_another_one_others(
    sessions: dict[str, Session],
) -> None:
    one, same, other = (drawn_review("x", sessions, 6, seed).clips for seed in (1, 1, 2))
    assert one == same
    assert one != other
    for clip in one:
        bouts = sessions[clip.session].bouts
        now = bouts[(bouts["start_s"] <= clip.at_s) & (clip.at_s < bouts["stop_s"])]
        assert now["action"].tolist() == ([clip.program] if clip.program else [])
        assert clip.start_s <= clip.at_s <= clip.stop_s <= clip.start_s + 2.0 + 1e-9
    assert {"rear", "walk"} <= {clip.program for clip in one}  # rare ones are seen


def test_raters_see_every_clip_once_in_orders_of_their_own() -> None:
    review = Review("x", 3, WORDS, CLIPS)
    orders = [review.order(name) for name in ("Ada", "Bob")]
    assert orders[0] != orders[1]
    assert orders[0] == review.order("Ada")
    assert all(sorted(order) == list(range(9)) for order in orders)


def test_answers_are_kept_and_agreement_waits_for_the_last(tmp_path: Path) -> None:
    review = Review("of <us>/../x", 3, WORDS, CLIPS, {}, "2026-01-01T00:00:00+00:00")
    for k, clip in enumerate(CLIPS):
        assert review.agreements() == []
        review = review.answered("Ada", k, clip.program)
        path = write_review(tmp_path / "reviews", review)
        assert path.parent == tmp_path / "reviews"
        review = read_review(tmp_path / "reviews", review.name)
    (found,) = review.agreements()
    assert found[:2] == ("Ada", "the program")
    assert found[2].kappa == pytest.approx(1.0)
    assert review_names(tmp_path / "reviews") == [review.name]
    assert review_names(tmp_path / "nowhere") == []


@pytest.mark.parametrize(
    ("rater", "clip", "word", "said"),
    [
        ("", 0, "walk", "a rater has a name"),
        ("x" * 61, 0, "walk", "a rater has a name"),
        ("a\nb", 0, "walk", "a rater has a name"),
        ("the program", 0, "walk", "rates already"),
        ("Ada", 9, "walk", "no clip 9"),
        ("Ada", 0, "swim", "no word 'swim'"),
    ],
)
def test_an_answer_that_cannot_be_is_a_sentence(
    rater: str, clip: int, word: str, said: str
) -> None:
    with pytest.raises(SessionError, match=said):
        Review("x", 3, WORDS, CLIPS).answered(rater, clip, word)


def test_a_damaged_review_is_a_sentence_and_not_listed(tmp_path: Path) -> None:
    path = write_review(tmp_path, Review("x", 3, WORDS, CLIPS))
    document = json.loads(path.read_text())
    assert document["seed"] == 3
    for damage in ("{", "[]", '{"schema_version": 99}', '{"clips": 3}', "\xff", "words", "answers"):
        changed = json.dumps({**document, damage: 3}) if damage in document else damage
        path.write_text(changed, encoding="latin-1")
        with pytest.raises(SessionError, match="is damaged"):
            read_review(tmp_path, "x")
        assert review_names(tmp_path) == []


def test_more_clips_than_bouts_are_refused(sessions: dict[str, Session]) -> None:
    with pytest.raises(SessionError, match="ask for fewer"):
        drawn_review("x", sessions, 300, 1)
    with pytest.raises(SessionError, match="1 to 500 clips"):
        drawn_review("x", sessions, 0, 1)
