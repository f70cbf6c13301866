"""Which way an animal faces: the picture that is laid along it, and what a network's word does to
the scores.
"""

from dataclasses import replace

import numpy as np
import pytest

from liex_lab.estimation.estimator import PoseEstimator
from liex_lab.estimation.method import METHODS
from liex_lab.estimation.refine import UNSURE_MM, HeadTailClassifier, both_directions, laid_along
from liex_lab.mlp import Network
from tests.estimation.toy import SCENE, toy_mice, trained, training_set

N = 240


@pytest.fixture(scope="module")
def mice():
    """Toy mice's height maps, and their joints pointing the right way (n, J, 3) and the
    wrong way.
    """
    data = training_set(toy_mice(N, seed=5), METHODS["default"])
    joints = data.truth.positions
    return data.images, joints, np.ascontiguousarray(joints[:, ::-1]), data.size


@pytest.fixture(scope="module")
def network(mice) -> Network:
    images, right, wrong, size = mice
    skeleton = toy_mice(1, seed=0).skeleton
    pictures = np.concatenate(
        [laid_along(skeleton, images, joints, size) for joints in (right, wrong)]
    )
    return HeadTailClassifier.fit(pictures, np.repeat([True, False], N), seed=3)


def facing(network: Network) -> HeadTailClassifier:
    return HeadTailClassifier(toy_mice(1, seed=0).skeleton, network)


def test_who_looks_the_other_way_sees_the_picture_turned_round(mice):
    images, right, wrong, size = mice
    skeleton = toy_mice(1, seed=0).skeleton
    one, other = (laid_along(skeleton, images, joints, size) for joints in (right, wrong))
    assert (one > 0).any(axis=(1, 2)).all()
    # a reading falls to the pixel beside it now and then
    np.testing.assert_allclose(other, one[:, ::-1, ::-1], atol=0.4)
    assert np.mean(other == one[:, ::-1, ::-1]) > 0.97


def test_the_picture_lies_along_the_animal_whatever_its_heading_and_size(mice):
    images, right, _, size = mice
    skeleton = toy_mice(1, seed=0).skeleton
    shown = laid_along(skeleton, images, right, size) > 0
    straight = np.flatnonzero(
        np.ptp(np.arctan2(*np.diff(right, axis=1)[..., 1::-1].transpose(2, 0, 1)), axis=1) < 0.3
    )
    length = shown[straight].any(axis=2).sum(axis=1)
    width = shown[straight].any(axis=1).sum(axis=1)
    assert np.median(length) > 1.8 * np.median(width)
    assert length.std() < 0.12 * length.mean()


def test_a_network_tells_mice_that_it_has_not_seen(network):
    data = training_set(toy_mice(100, seed=77), METHODS["default"])
    right = data.truth.positions
    said = [
        facing(network).logits(data.images, np.ascontiguousarray(j), 1.0)
        for j in (right, right[:, ::-1])
    ]
    assert np.mean(said[0] > said[1]) > 0.97


def test_what_is_said_of_a_frame_does_not_depend_on_the_others(mice, network):
    images, right, _, _ = mice
    whole = facing(network).logits(images, right, 1.0)
    for n in (1, 2, 3, 5, 17, 64):
        few = type(images)(*(values[:n] for values in vars(images).values()))
        np.testing.assert_array_equal(facing(network).logits(few, right[:n], 1.0), whole[:n])


def test_the_word_counts_where_scores_are_near_and_only_there(mice, network):
    images, right, wrong, size = mice
    skeleton = toy_mice(1, seed=0).skeleton
    one = int(np.argmin(np.abs(size - 1.0)))
    seen = type(images)(*(np.repeat(v[one : one + 1], 4, axis=0) for v in vars(images).values()))
    # two candidates for each way; the wrong way is ahead by a little, by much, not at all, and
    # alone
    positions = np.repeat(
        np.stack([wrong[one], wrong[one], right[one], right[one]])[None], 4, axis=0
    )
    scores = np.array(
        [
            [3.0, 4.0, 5.0, 6.0],
            [3.0, 4.0, 3.0 + 1.1 * UNSURE_MM, 40.0],
            [5.0, 6.0, 3.0, 4.0],
            [3.0, 4.0, np.inf, np.inf],
        ]
    )
    judged = facing(network).judged(seen, positions, scores, 1.0)
    assert judged[0].argmin() == 2
    np.testing.assert_array_equal(judged[0, 2:], scores[0, 2:])
    np.testing.assert_allclose(judged[0, 1] - judged[0, 0], 1.0)  # who falls behind keeps his order
    np.testing.assert_array_equal(judged[1:], scores[1:])
    assert both_directions(positions, judged, skeleton.tip)[0].tolist() == [2, 0, 2, 0]


def test_an_estimator_with_it_measures_as_before_where_it_was_sure(network):
    model = trained("default").model
    toy = toy_mice(24, seed=91)
    plain = PoseEstimator(model)
    told = PoseEstimator(replace(model, facing=network))
    before, after = (
        e.estimate(toy.depths, SCENE, 1.0).chosen.pose.joints(e.skeleton) for e in (plain, told)
    )
    sight = plain.detect(toy.depths, SCENE, 1.0)[0]
    sure = ~(both_directions(sight.positions, sight.scores, plain.skeleton.tip)[2] < UNSURE_MM)
    assert sure.any()
    np.testing.assert_array_equal(after[sure], before[sure])
    true = SCENE.floor.T_arena_camera.inverse() @ toy.joints.reshape(-1, 3)
    along = [j[:, -1] - j[:, 0] for j in (true.reshape(toy.joints.shape), before, after)]
    flips = [np.mean(np.einsum("nd,nd->n", along[0], other) < 0) for other in along[1:]]
    assert flips[1] <= flips[0]


def test_it_is_learned_again_with_the_same_bits(mice, network):
    images, right, wrong, size = mice
    skeleton = toy_mice(1, seed=0).skeleton
    pictures = np.concatenate(
        [laid_along(skeleton, images, joints, size) for joints in (right, wrong)]
    )
    again = HeadTailClassifier.fit(pictures, np.repeat([True, False], N), seed=3)
    assert all(
        np.array_equal(a, b)
        for one, other in zip(again.layers, network.layers, strict=True)
        for a, b in zip(one, other, strict=True)
    )
