"""Two stretches are looked at side by side: the same is told, in the same order, and errors too."""

import threading
import time
from contextlib import closing
from typing import Any

import numba
import numpy as np
import pytest
from liex_lab.pipelines import session
from liex_lab.pipelines.build import build_tracker, plan_of
from liex_lab.pipelines.session import observed

from liex_lab.body.skeleton import Skeleton
from liex_lab.errors import RecordingError
from liex_lab.recordings.recording import Recording
from liex_lab.runtime.processes import threads
from liex_lab.simulation.simulator import world_of
from liex_lab.tracking.observations import COLUMNS

TWO = numba.config.NUMBA_NUM_THREADS >= 2
needs_two = pytest.mark.skipif(not TWO, reason="one core: nothing is looked at side by side")


class Slow:
    """A tracker that takes longer for some stretches than for others, and fails at one."""

    def __init__(self, fails_at: int = -1) -> None:
        self.fails_at = fails_at
        self.at_once = self.most = 0
        self.seen: list[int] = []
        self._lock = threading.Lock()

    def observe(self, frames: list[int]) -> list[int]:
        with self._lock:
            self.at_once += 1
            self.most = max(self.most, self.at_once)
            self.seen.append(frames[0])
        time.sleep(0.02 if frames[0] % 3 else 0.06)
        with self._lock:
            self.at_once -= 1
        if frames[0] == self.fails_at:
            raise RecordingError("this stretch cannot be looked at")
        return [10 * frame for frame in frames]


@pytest.fixture(autouse=True)
def _shared(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(session, "_may_share", lambda: True)


def told(tracker: Any, n: int) -> list[Any]:
    return list(observed(tracker, [[k, k + 100] for k in range(n)]))


@needs_two
def test_stretches_come_in_their_order_and_two_are_under_way() -> None:
    tracker = Slow()
    assert told(tracker, 12) == [([k, k + 100], [10 * k, 10 * k + 1000]) for k in range(12)]
    assert tracker.most == 2
    assert told(tracker, 0) == []


def test_on_one_thread_or_where_threads_may_not_share_each_is_looked_at_alone(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    tracker = Slow()
    with threads(False):
        assert [seen[0] for _, seen in told(tracker, 3)] == [0, 10, 20]
    monkeypatch.setattr(session, "_may_share", lambda: False)
    assert [seen[0] for _, seen in told(tracker, 3)] == [0, 10, 20]
    assert tracker.most == 1


@needs_two
def test_what_goes_wrong_is_raised_in_its_turn_and_nothing_is_begun_after_it() -> None:
    tracker = Slow(fails_at=3)
    whole = []
    coming = observed(tracker, [[k] for k in range(50)])
    for _ in range(3):
        whole.append(next(coming)[0][0])
    with pytest.raises(RecordingError, match="cannot be looked at"):
        next(coming)
    assert whole == [0, 1, 2]
    assert max(tracker.seen) <= 6


@needs_two
def test_who_stops_early_waits_for_no_more_than_what_is_under_way() -> None:
    tracker = Slow()
    with closing(observed(tracker, [[k] for k in range(50)])) as coming:
        next(coming)
    n = len(tracker.seen)
    time.sleep(0.2)
    assert n == len(tracker.seen) <= 4
    assert tracker.at_once == 0


@pytest.mark.nightly
def test_observations_are_those_of_one_stretch_after_the_other_bit_for_bit() -> None:
    filmed = world_of(Skeleton.load("mouse")).motion(5, 40)
    frames = list(filmed)
    recording = Recording(
        name="walk",
        format="live",
        camera=filmed.camera,
        times_ns=(33_333_333 * np.arange(40)).astype(np.int64),
        read=lambda row: frames[row].depth,
    )
    tracker = build_tracker(recording, plan_of("mouse"))
    for own, seen in observed(tracker, [frames[k : k + 8] for k in range(0, 40, 8)]):
        alone = tracker.observe(own)
        for name in COLUMNS:
            np.testing.assert_array_equal(getattr(seen, name), getattr(alone, name))
