"""The verdict on a session: what was measured, what is to be distrusted, and when to look at it."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from liex_lab.sessions.verdict import Verdict, read_verdict, verdict_in
from liex_lab.tracking.observations import Observations
from liex_lab.tracking.offline import track_whole
from liex_lab.tracking.track import Track
from tests.tracking.stories import SUBJECT, lose, told, walk

SECONDS = np.arange(200) / 30.0


def tracked(seen: Observations) -> Track:
    return track_whole(SUBJECT, seen).track


def test_an_animal_that_is_measured_throughout_needs_no_look() -> None:
    seen = told(SECONDS, walk(SECONDS))
    verdict = Verdict.of(tracked(seen), seen)
    assert (verdict.n_frames, verdict.n_in_view, verdict.n_posed) == (200, 200, 200)
    assert verdict.n_trusted == 200
    assert not verdict.look_at_it
    assert verdict.sentence.startswith("200 frames, 200 with a pose (100%), 200 of them trusted")
    assert "look at it" not in verdict.sentence


def test_a_scene_or_clock_that_is_not_to_be_relied_on_is_a_reason_to_look() -> None:
    seen = told(SECONDS, walk(SECONDS))
    verdict = Verdict.of(tracked(seen), seen, doubts=["the camera was pushed"])
    assert verdict.look_at_it
    assert verdict.sentence.endswith("look at it: the camera was pushed")


def test_an_animal_that_leaves_for_half_of_the_time_needs_none_either() -> None:
    seen = told(SECONDS, walk(SECONDS))
    lose(seen, slice(90, 200))
    seen.n_px[90:] = 0
    assert not Verdict.of(tracked(seen), seen).look_at_it


def test_a_recording_in_which_hardly_anything_is_found_is_to_be_looked_at() -> None:
    seen = told(SECONDS, walk(SECONDS))
    lose(seen, slice(20, 200))
    seen.n_px[20:] = 0
    verdict = Verdict.of(tracked(seen), seen)
    assert verdict.look_at_it
    assert "an animal is measured in" in verdict.reasons[0]


def test_poses_that_are_not_trusted_do_not_count_as_measured() -> None:
    seen = told(SECONDS, walk(SECONDS))
    seen.covered[:120] = 0.1  # the body hardly covers what is seen
    verdict = Verdict.of(tracked(seen), seen)
    assert verdict.n_posed == 200
    assert verdict.n_trusted < 100
    assert "are measured and trusted" in verdict.reasons[0]


def test_what_was_accepted_is_still_said_and_two_animals_are_counted() -> None:
    seen = told(SECONDS, walk(SECONDS))
    verdict = Verdict.of(
        tracked(seen), seen, misfits=["it is 743 mm long"], n_animals=2, accepted=True
    )
    assert verdict.look_at_it
    assert "look at it (accepted): it is 743 mm long" in verdict.sentence
    assert "2 animals are in view" in verdict.sentence
    assert "\n" not in verdict.sentence


def test_a_verdict_is_json_and_sessions_without_one_have_nothing_to_say(tmp_path: Path) -> None:
    seen = told(SECONDS, walk(SECONDS))
    document = {"verdict": Verdict.of(tracked(seen), seen).to_dict()}
    (tmp_path / "session.json").write_text(json.dumps(document, allow_nan=False))
    assert read_verdict(tmp_path) == document["verdict"]
    for nothing in ({}, {"verdict": 3}):
        assert not verdict_in(nothing)["look_at_it"]
        assert verdict_in(nothing)["sentence"] == ""
    assert not read_verdict(tmp_path / "nowhere")["look_at_it"]


def test_of_no_pose_there_is_no_error_to_expect() -> None:
    seen = Observations.empty(SUBJECT.skeleton, np.round(1e9 * SECONDS).astype(np.int64))
    verdict = Verdict.of(tracked(seen), seen)
    assert verdict.expected_error_mm is None
    assert verdict.n_animals == 0
    assert verdict.look_at_it
    assert pytest.approx(0) == verdict.n_trusted
