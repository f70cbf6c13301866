"""The association: which hypotheses are the animal."""

import numpy as np
import pytest

from liex_lab.tracking.association import NONE, HypothesisAssociation, backward_cost
from liex_lab.tracking.observations import Observations
from liex_lab.tracking.smoother import TrackingParameters
from tests.tracking.stories import MOUSE, lose, told, walk

CLOCK = np.arange(20) / 30.0
COSTS = TrackingParameters.of("mouse").chain
CHAIN = HypothesisAssociation(MOUSE, MOUSE.length, COSTS)


def path_of(
    chain: HypothesisAssociation, seen: Observations, decided: np.ndarray | None = None
) -> np.ndarray:
    joints = chain.joints(seen)
    return chain.path(seen, joints, chain.emission(seen, joints), decided)


def story(score: float) -> Observations:
    """One frame of twenty shows something, with this score."""
    seen = told(CLOCK, walk(CLOCK))
    lose(seen, np.arange(20) != 7)
    seen.score[7] = score
    return seen


def test_a_lone_frame_that_is_likelier_the_animal_is_taken():
    path = path_of(CHAIN, story(0.5 * COSTS.score_mm * COSTS.none))
    assert path[7] != NONE
    assert (np.delete(path, 7) == NONE).all()


def test_a_decision_that_was_given_out_stands():
    poor = story(2.0 * COSTS.score_mm * COSTS.none)
    decided = np.full(10, NONE)
    decided[7] = 1
    assert path_of(CHAIN, poor, decided)[7] == 1


def in_agreement(seen: Observations) -> Observations:
    """The rendered body lies where the animal is seen."""
    seen.covered[:, :2] = 0.8
    seen.beside[:, :2] = 0.1
    seen.residual_mm[:, :2] = 1.5
    seen.centroid_mm[:, :2] = CHAIN.joints(seen)[:, :2].mean(axis=2)
    return seen


def test_an_animal_that_the_metric_does_not_know_is_not_passed_by():
    seen = in_agreement(told(CLOCK, walk(CLOCK)))
    seen.score[:, :2] += 12.0  # of every pose: it is the build, not the pose
    assert (path_of(CHAIN, seen) == 0).all()


def test_what_the_picture_does_not_agree_with_is_passed_by_whatever_all_of_it_scores():
    seen = in_agreement(told(CLOCK, walk(CLOCK)))
    seen.score[:, :2] += 12.0
    seen.covered[:] = 0.2
    assert (path_of(CHAIN, seen) != NONE).sum() <= 1  # a path has one frame at least


def test_head_and_tail_of_an_animal_that_the_metric_does_not_know_are_told_by_the_way_it_goes():
    clock = np.arange(60) / 30.0
    wrong = np.random.default_rng(3).random(60) < 0.6  # the score alone would turn it round
    seen = in_agreement(told(clock, walk(clock), flipped=wrong))
    seen.score[:, 0] = 14.0
    seen.score[:, 1] = 24.0
    path = path_of(CHAIN, seen)
    ends = np.stack([seen.joints_as(h, [0, MOUSE.tip]) for h in (0, 1)], axis=1)
    ends = ends[np.arange(60), path].astype(float)
    true = walk(clock).joints(MOUSE)
    along = np.einsum("nd,nd->n", ends[:, 1] - ends[:, 0], true[:, MOUSE.tip] - true[:, 0])
    assert (along > 0).all()


@pytest.mark.parametrize("direction", [1.0, -1.0])
def test_going_tail_first_costs_by_the_second_and_backing_up_slowly_costs_nothing(direction):
    for rate in (15.0, 30.0, 120.0):
        clock = np.arange(0.0, 1.0, 1.0 / rate)
        seen = Observations.empty(MOUSE, np.round(1e9 * clock).astype(np.int64))
        seen.score[:, :2] = 1.0
        ahead = np.zeros((len(clock), 4, 3), np.float32)
        ahead[:, 0, 0] = direction
        ahead[:, 1, 0] = -direction
        for lengths_s, cost in ((0.5, 0.0), (-0.5, 0.0), (2.0, 60.0)):
            seen.centroid_mm[:, :2] = (lengths_s * MOUSE.length * clock[:, None] * [1, 0, 0])[
                :, None
            ]
            total = backward_cost(seen, ahead, MOUSE.length).sum(axis=0)
            wrong = int(direction * lengths_s > 0)
            assert total[wrong] == pytest.approx(cost, rel=0.1)
            assert total[1 - wrong] == 0.0


def test_a_second_in_which_the_metric_errs_alike_in_every_frame_does_not_turn_an_animal_round():
    """It takes head for tail by 1 nat in thirty frames that show the same; of three seconds more it
    is right. At 10 frames a second each of them counts for itself.
    """
    for rate in (30.0, 10.0):
        clock = np.arange(120) / rate
        seen = told(clock, walk(clock))
        seen.score[:30] = seen.score[:30, [1, 0, 3, 2]]
        seen.score[:30, :2] = [2.0 + COSTS.score_mm, 2.0]
        assert ((path_of(CHAIN, seen)[:30] == 0).all()) == (rate == 30.0)


def test_in_a_long_contact_the_smoother_fit_does_not_turn_an_animal_round():
    clock = np.arange(300) / 30.0
    seen = told(clock, walk(clock))
    touching = slice(30, 270)
    seen.score[touching] = 3.0  # of both directions: the metric does not know them
    rng = np.random.default_rng(2)
    seen.place[touching, 0] += rng.normal(0.0, 5.0, (240, 3))
    seen.error_mm[touching, 0] = rng.choice([3.0, 12.0], 240)
    joints = CHAIN.joints(seen)
    emission = CHAIN.emission(seen, joints)
    path = CHAIN.path(seen, joints, emission)
    found = joints[np.arange(300), path]
    ahead = np.einsum("nd,nd->n", found[:, -1] - found[:, 0], joints[:, 0, -1] - joints[:, 0, 0])
    assert (ahead[path != NONE] > 0.0).all()
    assert CHAIN.doubt(seen, path, joints, emission).max() < 0.5
