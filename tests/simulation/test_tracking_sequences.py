"""The sequences on which tracking is measured: what happens in them happens, and the truth goes
with it.
"""

from itertools import pairwise

import numpy as np
import pytest

from liex_lab.body.skeleton import Skeleton
from liex_lab.errors import RecordingError
from liex_lab.recordings import open_recording
from liex_lab.simulation.corruptions import EVENTS, draw_script
from liex_lab.simulation.recording import RenderedRecording
from liex_lab.simulation.simulator import SEQUENCES, tracking_sequence, world_of

STEP_NS = 33_333_333


@pytest.fixture(scope="module")
def hard() -> RenderedRecording:
    return tracking_sequence(world_of(Skeleton.load("mouse")), "hard", seed=3)


def spans(sequence: RenderedRecording, kind: str) -> list[slice]:
    return [slice(event.start, event.stop) for event in sequence.events if event.kind == kind]


def beside(sequence: RenderedRecording, frame: int, radius_mm: float) -> np.ndarray:
    """The readings around the animal's middle."""
    depth = sequence.frame(frame).depth
    middle = sequence.joints_camera[frame].mean(axis=0)
    u, v = np.round(sequence.camera.project(middle)).astype(int)
    r = round(radius_mm * sequence.camera.fx / middle[2])
    return depth[max(v - r, 0) : v + r + 1, max(u - r, 0) : u + r + 1]


def test_the_fixed_sequences_are_as_long_as_the_papers():
    assert [SEQUENCES[name][0] for name in ("easy", "hard")] == [511, 300]
    with pytest.raises(RecordingError, match="known are easy, hard"):
        tracking_sequence(world_of(Skeleton.load("mouse")), "harder")


def test_ten_seconds_hold_at_least_one_event_of_every_kind():
    events, steps = draw_script(np.random.default_rng(3), 330, STEP_NS * 1e-9)
    assert {event.kind for event in events} == set(EVENTS)
    assert all(a.stop <= b.start for a, b in pairwise(events))
    dropped = [event.start for event in events if event.kind == "dropped"]
    assert (steps[dropped] >= 3).all()
    assert steps.min() == 1


def test_time_goes_on_while_frames_are_dropped_and_the_truth_moves_with_it(hard):
    steps = np.diff(hard.times_ns) / STEP_NS
    np.testing.assert_array_equal(steps, np.round(steps))
    assert steps.max() >= 3
    moved = np.linalg.norm(np.diff(hard.joints_arena.mean(axis=1), axis=0), axis=1) / steps
    fast = np.zeros(len(moved), bool)
    for span in spans(hard, "fast"):
        fast[span.start : span.stop - 1] = True
    still = moved[~fast]
    assert moved[fast].max() > np.quantile(still, 0.9)
    assert hard.gaps, "the recording itself notices the missing frames"


def test_holes_are_unread_and_an_occluder_is_nearer_than_the_animal(hard):
    (span, *_) = spans(hard, "holes")
    share = [
        np.mean(beside(hard, i, 0.6 * hard.spine_mm) == 0) for i in range(span.start, span.stop)
    ]
    calm = [np.mean(beside(hard, i, 0.6 * hard.spine_mm) == 0) for i in range(10)]
    assert np.median(share) > 2 * np.median(calm)
    (hidden, *_) = spans(hard, "hidden")
    middle = (hidden.start + hidden.stop) // 2
    seen = beside(hard, middle, 0.3 * hard.spine_mm)
    animal = hard.joints_camera[middle, :, 2].min()
    assert np.mean((seen > 0) & (seen < animal - hard.spine_mm)) > 0.4


def test_sequences_are_recordings_by_address_and_the_same_every_time(hard):
    again = open_recording("synthetic:track-hard?animal=mouse&seed=3&frames=20")
    assert isinstance(again, RenderedRecording)
    assert len(again) == 20
    fixed = open_recording("synthetic:track-easy?frames=3")
    assert fixed.name == "track-easy-mouse-75001"
    np.testing.assert_array_equal(hard.frame(33).depth, hard.depths(32, 35)[1])


def test_other_animals_have_them_too():
    fish = tracking_sequence(world_of(Skeleton.load("fish")), "hard", seed=1, n_frames=120)
    assert fish.skeleton.name == "fish"
    assert np.median(np.diff(fish.times_ns)) == 20_000_000


def test_a_hand_goes_from_gesture_to_gesture_behind_a_bar_that_passes():
    hand = tracking_sequence(world_of(Skeleton.load("hand")), "hard", seed=2, n_frames=150)
    assert {event.kind for event in hand.events} >= {"occluder", "hidden"}
    steps = np.diff(hand.times_ns) * 1e-9
    speed = np.linalg.norm(np.diff(hand.joints_camera, axis=0), axis=-1) / steps[:, None]
    assert (
        100.0 < np.quantile(speed, 0.9) < 1500.0
    )  # mm/s, three times as fast as people gesture at the most
    (hidden, *_) = spans(hand, "hidden")
    middle = (hidden.start + hidden.stop) // 2
    seen = beside(hand, middle, 0.2 * hand.spine_mm)
    assert np.mean((seen > 0) & (seen < hand.joints_camera[middle, :, 2].min() - 20.0)) > 0.4
