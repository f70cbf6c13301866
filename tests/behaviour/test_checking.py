"""No bout that a model named contradicts its printed definition; a person's is only flagged."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from liex_lab.actions.timeline import TimelineModel
from liex_lab.actions.vocabulary import MEASURES, WORDS
from liex_lab.behaviour import kinematics, measure_bouts
from liex_lab.behaviour.kinematics import Joints
from liex_lab.behaviour.measures import _READ, BoutCheck, BoutReader, recognise
from liex_lab.tables.rows import Rows, bout_rows
from tests.actions.toy import going_and_staying, taught_to_lie
from tests.behaviour.test_kinematics import tables_of
from tests.behaviour.test_summary import named
from tests.sessions.walking_mouse import WalkingMouse, steady

PRINTED = {word: one.printed for word, one in WORDS["mouse"].items()}


def check_of(mouse: WalkingMouse) -> BoutCheck:
    return BoutCheck(BoutReader(kinematics(*tables_of(mouse))), PRINTED)


def test_every_measure_that_a_definition_bounds_can_be_read() -> None:
    assert set(_READ) == set(MEASURES)


@pytest.mark.parametrize(
    ("speed_mm_s", "kept", "broken"),
    [
        (20.0, {"pause", "stretch_attend", "sniff"}, {"walk", "run", "dart"}),
        (120.0, {"walk"}, {"pause", "stretch_attend", "sniff", "freeze", "run", "dart"}),
        (400.0, {"run"}, {"walk", "pause", "turn_left"}),
    ],
)
def test_speed_decides_as_the_definitions_say(
    speed_mm_s: float, kept: set[str], broken: set[str]
) -> None:
    check = check_of(WalkingMouse(steady(4.0), speed_mm_s=speed_mm_s))
    for word in kept:
        assert check.broken(10, 25, word) == "", word
    for word in broken:
        assert "cm/s" in check.broken(10, 25, word) or "duration" in check.broken(10, 25, word)


def test_a_turn_to_the_other_side_or_a_small_one_is_none() -> None:
    mouse = WalkingMouse(steady(4.0), speed_mm_s=140.0, radius_mm=80.0)  # 100 degrees/s to its left
    check = check_of(mouse)
    assert check.broken(10, 40, "turn_left") == ""
    assert "net turn to its right -" in check.broken(10, 40, "turn_right")
    assert "not at least 30 degrees" in check.broken(10, 16, "turn_left")


def test_a_rear_needs_a_raised_nose() -> None:
    check = check_of(WalkingMouse(steady(6.0), rear_s=(2.0, 4.0)))
    assert check.broken(66, 110, "rear_supported") == ""
    assert "nose" in check.broken(130, 160, "rear_unsupported")


def test_a_bout_that_a_person_named_stays_and_says_what_does_not_hold() -> None:
    mouse = WalkingMouse(steady(4.0), speed_mm_s=120.0)
    bouts = named(mouse, ("pause", 1.0, 2.0), ("walk", 2.0, 3.0)).assign(source="human")
    found = measure_bouts(bouts, kinematics(*tables_of(mouse)), PRINTED)
    assert list(found["action"]) == ["pause", "walk"]
    assert list(found["contradicts"]) == ["mean and median speed 12 cm/s, not at most 5 cm/s", ""]
    unchecked = measure_bouts(bouts, kinematics(*tables_of(mouse)))
    assert list(unchecked["contradicts"]) == ["", ""]


@pytest.fixture(scope="module")
def liar() -> TimelineModel:
    """A recogniser that was taught to call going a pause, and staying a freeze."""
    return taught_to_lie()


def test_a_recogniser_cannot_name_what_contradicts_its_words(liar: TimelineModel) -> None:
    one = going_and_staying(11)
    free = liar.recognise(one.track)
    assert "pause" in {bout.action for bout in free.ethogram}
    found = recognise(liar, one.track)
    assert {refusal.action for refusal in found.refused} >= {"pause"}
    assert all(refusal.why for refusal in found.refused)
    rows = Rows(one.track, np.arange(one.track.n_frames), "toy", "mouse_1")
    frames = rows.frames_table
    moved = kinematics(*tables_of_track(rows))
    bouts = measure_bouts(bout_rows(found.ethogram, frames, "abc"), moved, PRINTED)
    assert set(bouts["contradicts"]) <= {""}
    before = measure_bouts(bout_rows(free.ethogram, frames, "abc"), moved, PRINTED)
    assert (before["contradicts"] != "").any()


def tables_of_track(rows: Rows) -> tuple[pd.DataFrame, Joints]:
    return rows.frames_table, Joints.of_track(rows.track)


def test_words_of_ones_own_are_not_checked(liar: TimelineModel) -> None:
    own = replace(liar, definitions={"pause": "my pause", "freeze": ""})
    one = going_and_staying(12)
    assert recognise(own, one.track).refused == ()
    assert recognise(own, one.track).ethogram == own.recognise(one.track).ethogram
