"""What `liex evaluate actions` says of bouts that contradict their printed definitions."""

from liex_lab.pipelines.evaluation.actions import contradictions

from tests.actions.toy import going_and_staying, taught_to_lie


def test_bouts_that_contradict_their_definitions_are_counted_before_and_after_the_check() -> None:
    told = contradictions(taught_to_lie(), [going_and_staying(seed) for seed in (11, 12)])
    unchecked, checked = told["unchecked"], told["checked"]
    assert unchecked["by_word"]["pause"] > 10  # it goes at three lengths a second
    assert unchecked["contradicting"] == sum(unchecked["by_word"].values()) <= unchecked["bouts"]
    assert checked["bouts"] > 0
    assert (checked["contradicting"], checked["by_word"]) == (0, {})
