"""Of two animals that differ in size, the one that leaves a meeting is the one that came to it."""

from dataclasses import replace

import numpy as np
import pytest

from liex_lab.tracking.association import cost_of_the_other
from liex_lab.tracking.curve import track_whole
from liex_lab.tracking.observations import Observations, joints_of
from tests.tracking.stories import MOUSE, told, walk
from tests.tracking.test_offline import SUBJECT

SECONDS = np.arange(100) / 30.0
JOINED = slice(40, 60)
APART = np.r_[0:40, 60:100]
BESIDE_MM = 60.0
POSE = ("turn", "place", "angles", "scale", "error_mm", "score")


def meeting(first_px: int, second_px: int, seed: int = 0) -> Observations:
    """Two mice 60 mm apart that are one thing for 20 frames, whose pose is that of the first."""
    one, two = walk(SECONDS), walk(SECONDS)
    two.root.translation[:, 1] += BESIDE_MM
    seen, beside = told(SECONDS, one), told(SECONDS, two)
    for name in POSE:
        getattr(seen, name)[:, 2:] = getattr(beside, name)[:, :2]
        getattr(seen, name)[JOINED, 2:] = np.nan
    size = np.random.default_rng(seed).normal(1.0, 0.04, (len(SECONDS), 2))
    seen.n_px[:, :2] = np.round(first_px * size[:, :1])
    seen.n_px[:, 2:] = np.round(second_px * size[:, 1:])
    seen.n_px[JOINED] = [first_px + second_px] * 2 + [0, 0]
    return seen


def second_until(stop: int) -> np.ndarray:
    """A path of the second one that goes over to the first one at a frame."""
    path = np.where(np.arange(len(SECONDS)) < stop, 2, 0)
    path[JOINED] = -1
    return path


@pytest.mark.parametrize("sizes", [(600, 800), (800, 600)])
def test_what_costs_is_the_animal_that_most_frames_do_not_follow(sizes):
    path = second_until(60)
    path[85:] = -1
    cost = cost_of_the_other(meeting(*sizes), path)
    assert cost is not None
    assert (cost[APART, :2] > 0.2).mean() > 0.98
    assert (cost[APART, 2:] == 0.0).mean() > 0.98
    assert (cost[JOINED] == 0.0).all()


def test_sizes_that_are_equal_change_their_order_or_are_rarely_seen_tell_nothing():
    changing, few = meeting(600, 800), meeting(600, 800)
    changing.n_px[::2] = changing.n_px[::2, [2, 3, 0, 1]]
    for name in POSE:
        getattr(few, name)[11:, 2:] = np.nan
    for seen in (meeting(800, 800), changing, few):
        assert cost_of_the_other(seen, second_until(100)) is None


@pytest.mark.parametrize("sizes", [(800, 640), (640, 800), (720, 720)])
def test_the_track_leaves_a_meeting_with_the_animal_that_it_came_with(sizes):
    """The first one turns up where the second one was, and the other way round; of animals of one
    size nobody can tell.
    """
    seen = meeting(*sizes)
    for name in POSE:
        getattr(seen, name)[60:] = getattr(seen, name)[60:][:, [2, 3, 0, 1]]
    both = [joints_of(MOUSE, seen.pose(np.full(len(SECONDS), h))) for h in (0, 2)]
    track = track_whole(replace(SUBJECT, n_animals=2), seen).track
    off = [np.linalg.norm(track.joints_mm - one, axis=-1).mean(axis=1) for one in both]
    first = (off[0] < off[1])[[5, 20, 35, 70, 80, 95]]
    assert first[:3].all() or not first[:3].any()
    assert (first[:3] == first[3:]).all() == (sizes != (720, 720))


@pytest.mark.parametrize("fits", [0, 2])
def test_the_one_that_the_session_has_measured_is_followed(fits):
    """Its size and girth are those of one of two; the pose of the other one does not agree."""
    seen = meeting(600, 800)
    seen.residual_mm[:] = 6.0
    seen.residual_mm[:, fits : fits + 2] = 2.0
    cost = cost_of_the_other(seen, second_until(100))
    assert cost is not None
    assert cost[APART, fits].mean() < 0.1 < cost[APART, 2 - fits].mean()
