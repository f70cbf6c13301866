"""The verdict on a session: what was measured, what to distrust, and when it needs review."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from liex_lab.sessions.corrections import read_verdict
from liex_lab.sessions.verdict import Verdict, verdict_in
from liex_lab.tracking.curve import track_whole
from liex_lab.tracking.observations import Observations
from tests.tracking.stories import SUBJECT, lose, told, walk

SECONDS = np.arange(200) / 30.0


def nothing(seen: Observations) -> None:
    """Leave the observations as they are."""


def gone_after(row: int) -> Callable[[Observations], None]:
    """Remove the animal from a row on."""

    def change(seen: Observations) -> None:
        lose(seen, slice(row, 200))
        seen.n_px[row:] = 0

    return change


def hardly_covered(seen: Observations) -> None:
    seen.covered[:120] = 0.1  # the body hardly covers the animal's pixels


@pytest.mark.parametrize(
    ("change", "more", "sentence"),
    [
        (nothing, {}, "^200 frames, 200 with a pose (100%), 200 of them trusted"),
        (nothing, {"doubts": ["the camera was pushed"]}, "needs review: the camera was pushed$"),
        (gone_after(90), {}, "^200 frames, 90 with a pose"),
        (gone_after(20), {}, "needs review: an animal is measured in"),
        (hardly_covered, {}, "needs review: only 80 of the 200 frames with an object"),
        (
            nothing,
            {"misfits": ["it is 743 mm long"], "cautions": ["a lens"], "accepted": True},
            "needs review (accepted): it is 743 mm long. note: a lens",
        ),
    ],
)
def test_a_sentence_states_the_quality_and_why_a_session_needs_review(
    change: Callable[[Observations], None], more: dict[str, Any], sentence: str
) -> None:
    seen = told(SECONDS, walk(SECONDS))
    change(seen)
    verdict = Verdict.of(track_whole(SUBJECT, seen), seen, **more)
    assert sentence.strip("^$") in verdict.sentence
    assert not sentence.startswith("^") or verdict.sentence.startswith(sentence[1:])
    assert verdict.needs_review == ("needs review" in sentence)
    assert ("needs review" in verdict.sentence) == verdict.needs_review
    assert "\n" not in verdict.sentence
    assert verdict.n_frames == 200
    if change is hardly_covered:
        assert verdict.n_posed == 200 > verdict.n_trusted


def test_a_verdict_is_json_and_sessions_without_one_have_nothing_to_say(tmp_path: Path) -> None:
    seen = told(SECONDS, walk(SECONDS))
    document = {"verdict": Verdict.of(track_whole(SUBJECT, seen), seen).to_dict()}
    (tmp_path / "session.json").write_text(json.dumps(document, allow_nan=False))
    assert read_verdict(tmp_path) == document["verdict"]
    for nothing in ({}, {"verdict": 3}):
        assert not verdict_in(nothing)["look_at_it"]
        assert verdict_in(nothing)["sentence"] == ""
    assert not read_verdict(tmp_path / "nowhere")["look_at_it"]


def test_of_no_pose_there_is_no_error_to_expect() -> None:
    seen = Observations.empty(SUBJECT.skeleton, np.round(1e9 * SECONDS).astype(np.int64))
    verdict = Verdict.of(track_whole(SUBJECT, seen), seen)
    assert verdict.expected_error_mm is None
    assert verdict.n_animals == 0
    assert verdict.needs_review
    assert pytest.approx(0) == verdict.n_trusted
