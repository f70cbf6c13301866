"""The association: which hypotheses are the animal."""

from __future__ import annotations

import numpy as np
import pytest

from liex_lab.tracking.association import NONE, HypothesisAssociation
from liex_lab.tracking.motion_model import TrackingParameters
from liex_lab.tracking.observations import Observations
from tests.tracking.stories import MOUSE, lose, told, walk

CLOCK = np.arange(20) / 30.0
COSTS = TrackingParameters.of("mouse").chain
CHAIN = HypothesisAssociation(MOUSE, MOUSE.length, COSTS)


def story(score: float) -> Observations:
    """One frame of twenty shows something, with this score."""
    seen = told(CLOCK, walk(CLOCK))
    lose(seen, np.arange(20) != 7)
    seen.score[7] = score
    return seen


def test_a_lone_frame_that_is_likelier_the_animal_is_taken():
    path = CHAIN.path(story(0.5 * COSTS.score_mm * COSTS.none))
    assert path[7] != NONE
    assert (np.delete(path, 7) == NONE).all()


def test_a_decision_that_was_given_out_stands():
    poor = story(2.0 * COSTS.score_mm * COSTS.none)
    decided = np.full(10, NONE)
    decided[7] = 1
    assert CHAIN.path(poor, decided)[7] == 1


def test_a_path_through_good_frames_is_as_ever():
    seen = told(CLOCK, walk(CLOCK))
    assert (CHAIN.path(seen) == 0).all()


def test_joints_of_another_number_are_refused():
    seen = story(1.0)
    with pytest.raises(ValueError, match="joints of hypotheses"):
        CHAIN.path(seen, joints=CHAIN.joints(seen)[:, :, :3])
    with pytest.raises(ValueError, match="path of hypotheses"):
        CHAIN.doubt(seen, np.zeros(3, np.int64))
