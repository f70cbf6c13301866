"""Rules of triggers: what is read, what is refused, and when an event is in a series of frames."""

from contextlib import suppress

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from liex_lab.behaviour.triggers import Agreement, Onsets, Rule, usable_names, words_in
from liex_lab.body.skeleton import Skeleton
from liex_lab.errors import PlanError

WORDS = ("", "walk", "rear_supported", "rear_unsupported")
KNOWN = usable_names(Skeleton.load("mouse"), WORDS, ["nest", "centre"])
NAN = float("nan")


def _holds(text: str, **values: list[float]) -> tuple[list[bool], list[bool]]:
    rule = Rule.of_text(text, KNOWN)
    on, off = rule.holds({name: np.array(values[name]) for name in rule.names})
    return on.tolist(), off.tolist()


def test_a_rule_names_actions_zones_and_columns() -> None:
    assert _holds("rear", rear=[0, 1, NAN]) == ([False, True, False], [True, False, False])
    assert _holds("in centre and not walk", in_centre=[1, 1, 0], walk=[0, 1, 0])[0] == [1, 0, 0]
    on, off = _holds("speed_mm_s > 200 until speed_mm_s < 150", speed_mm_s=[210, 180, 140])
    assert (on, off) == ([True, False, False], [False, False, True])
    text = "not (20 < nose_z_mm <= 60) or yaw_rate_rad_s < -2"
    values = {"nose_z_mm": [30.0, 30.0, 70.0, NAN], "yaw_rate_rad_s": [-2.5, 1.0, 0.0, 9.0]}
    assert _holds(text, **values)[0] == [True, False, True, False]
    assert words_in("rear", WORDS) == ["rear_supported", "rear_unsupported"]


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("sped_mm_s > 200", "nearest names are speed_mm_s"),
        ("freeze", "the actions walk, rear_supported, rear_unsupported, rear"),
        ("in corner", "there is no zone corner: the zones are nest, centre"),
        ("speed_mm_s", "compares nothing"),
        ("speed_mm_s > 200 mm/s", "in the column's own unit"),
        ("speed_mm_s > 5 until walk until rear", "more than one until"),
        ("heading_rad > 90", "90 degrees are 1.571"),
        ("speed_mm_s > 20000", "nothing is measured"),
        ("abs(heading_rad) > 1", "may not be in a trigger"),
        ("speed_mm_s > nose_z_mm", "compares mm with mm/s"),
        ("walk > 1", "without a comparison"),
        ("walk + rear", "may not be in a trigger"),
        ("1 < 2", "names no column"),
        ("tail_beat_hz > 5", "known only when the tail has turned back"),
        ("__import__('os').system('true')", "may not be in a trigger"),
        ("speed_mm_s ** 9 > 1", "may not be in a trigger"),
        ("'a' < speed_mm_s", "may not be in a trigger"),
        ("not speed_mm_s", "neither true nor false"),
        ("(" * 400, "is no condition"),
        ("", "is no condition"),
    ],
)
def test_a_rule_that_cannot_be_meant_is_refused_in_a_sentence(text: str, why: str) -> None:
    with pytest.raises(PlanError) as refused:
        Rule.of_text(text, KNOWN)
    assert why in str(refused.value)


@given(st.text(alphabet="abs()<>=+-*/. 0123456789\\'\"[]{}:,@%&|~^_\n\0", max_size=40))
def test_any_text_is_a_rule_or_refused(text: str) -> None:
    with suppress(PlanError):
        assert Rule.of_text(text, KNOWN).names


def test_an_event_needs_its_duration_and_the_refractory_time() -> None:
    time_s = np.linspace(0.0, 0.9, 10, dtype=np.float64)
    on = np.array([0, 1, 1, 1, 0, 1, 1, 1, 0, 0], bool)
    assert Onsets().of_frames(time_s, on, ~on).tolist() == pytest.approx(
        np.array([[0.1, 0.4], [0.5, 0.8]])
    )
    assert Onsets(duration_s=0.2).of_frames(time_s, on, ~on)[:, 0] == pytest.approx([0.3, 0.7])
    assert Onsets(duration_s=0.3).of_frames(time_s, on, ~on).size == 0
    assert Onsets(refractory_s=0.5).of_frames(time_s, on, ~on)[:, 0] == pytest.approx([0.1])
    unknown = np.zeros(10, bool)  # neither holds nor ends in a gap: the event goes on
    gap = (time_s > 0.35) & (time_s < 0.45)
    assert Onsets().of_frames(time_s, on & ~gap, ~on & ~gap).tolist() == pytest.approx(
        np.array([[0.1, 0.8]])
    )
    assert Onsets().of_frames(time_s, unknown, unknown).size == 0


def test_live_events_match_those_of_the_session_one_to_one() -> None:
    session = np.array([[1.0, 2.0], [5.0, 5.0], [9.0, 9.5]])
    found = Agreement.of(np.array([0.7, 1.5, 5.6, 9.9]), session)
    assert (found.precision, found.recall) == (0.5, 2 / 3)
    assert found.offset_s == pytest.approx([-0.3, np.nan, np.nan, 0.9], nan_ok=True)
    assert found.missed_s.tolist() == [5.0]
    assert Agreement.of(np.zeros(0), session[:0]).precision is None
