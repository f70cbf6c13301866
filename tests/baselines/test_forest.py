"""The paper's regression forest: its coordinates are a pose, its votes are counted, and it
learns.
"""

from dataclasses import replace

import numpy as np
import pytest

from liex_lab.baselines import _kernels as kernels
from liex_lab.baselines import baseline
from liex_lab.baselines.baseline import (
    ForestPlan,
    RegressionForest,
    coordinates,
    levers,
    load_baseline,
    train_forests,
    with_home_turn,
)
from liex_lab.body.pose import KinematicTree, Pose
from liex_lab.body.skeleton import Skeleton
from liex_lab.errors import ModelError
from liex_lab.estimation.estimator import PoseEstimator
from liex_lab.estimation.method import METHODS
from liex_lab.forests.grow import GrowthPlan
from liex_lab.geometry import SE3, so3
from tests.estimation.toy import FLOOR, SCENE, Toy, toy_mice, trained, training_set, unseen

PAPER = METHODS["paper"]
SMALL = ForestPlan(
    GrowthPlan(7, 20, 8, 60, 0.5, 0.0, 0.0, 0.63),
    GrowthPlan(12, 20, 5, 60, 0.5, 0.0, 0.0, 0.63),
    training_points=8,
)


@pytest.fixture(scope="module")
def grown() -> RegressionForest:
    toy = toy_mice(500, 1)
    return train_forests(
        training_set(toy, PAPER), toy.skeleton, SMALL, np.random.default_rng(0), lambda *_: None
    )


def true_joints(toy: Toy) -> np.ndarray:
    """(n, J, 3) mm in the camera frame."""
    return FLOOR.T_arena_camera.inverse() @ toy.joints


def test_the_true_coordinates_unfold_to_the_true_pose():
    toy = toy_mice(5, 8)
    data, skeleton = training_set(toy, PAPER), toy.skeleton
    rng = np.random.default_rng(0)
    places = data.truth.positions[:, 0] + rng.normal(0, 10, (5, 3))
    turn = so3.log(data.truth.rotations[:, 0])[:, 2]
    headings = np.arctan2(
        data.truth.rotations[:, 0, 1, 0], data.truth.rotations[:, 0, 0, 0]
    ) + rng.normal(0, 0.5, 5)
    assert np.abs(turn).max() > 1.0  # they look in all directions
    values = coordinates(data, skeleton, np.arange(5, dtype=np.int32), places, headings)
    for k in range(5):
        rotations, positions = np.empty((skeleton.n_joints, 3, 3)), np.empty((skeleton.n_joints, 3))
        scale = kernels.unfold(
            values[k],
            levers(skeleton),
            places[k],
            headings[k],
            KinematicTree.of(skeleton),
            rotations,
            positions,
        )
        np.testing.assert_allclose(positions, data.truth.positions[k], atol=1e-6)
        assert scale == pytest.approx(data.truth.scale[k])


def test_a_body_with_a_turned_home_has_the_same_poses():
    turn = (0.3, -0.2, 2.0)
    skeleton = Skeleton.load("hand")
    rng = np.random.default_rng(1)
    root = SE3.exp(rng.normal(0, 1, (6, 6)) * [1, 1, 1, 40, 40, 40])
    angles = rng.normal(0, 0.4, (6, skeleton.n_joints, 3)) * skeleton.axes
    angles[:, 0] = 0.0
    joints = Pose(root, angles, np.ones(6)).joints(skeleton)
    turned = SE3(root.rotation @ so3.exp(np.array(turn)).T, root.translation)
    again = Pose(turned, angles, np.ones(6)).joints(with_home_turn(skeleton, turn))
    np.testing.assert_allclose(again, joints, atol=1e-9)


@pytest.mark.parametrize(("n_points", "phase"), [(1, 0.0), (7, 0.5), (40, 0.99)])
def test_points_lie_on_the_animal_and_are_spread_over_all_of_it(n_points, phase):
    data = training_set(toy_mice(1, 3), PAPER)
    heights, look = data.images.heights[0], data.images.crop_cameras[0]
    points = np.full((n_points, 3), np.nan)
    kernels.animal_points(heights, look, phase, points)
    z = look[13] - points[:, 2]  # the paper's view is upright: y and z are turned over
    column = (look[0] * points[:, 0] / z + look[2] - look[14]) / look[16]
    row = (-look[1] * points[:, 1] / z + look[3] - look[15]) / look[16]
    at = np.rint(row).astype(int), np.rint(column).astype(int)
    np.testing.assert_allclose([row, column], at, atol=1e-6)
    np.testing.assert_allclose(heights[at] / 16, points[:, 2], atol=1e-6)
    assert (heights[at] > 0).all()
    ranks = np.cumsum(heights.ravel() > 0)[at[0] * heights.shape[1] + at[1]]
    assert np.abs(np.diff(ranks) - (heights > 0).sum() / n_points).max(initial=0.0) <= 1.0


@pytest.mark.parametrize(("heading", "n_wrong"), [(-3.1, 0), (0.4, 4), (3.14, 8)])
def test_the_heading_is_that_of_the_majority(heading, n_wrong):
    rng = np.random.default_rng(n_wrong)
    angles = np.concatenate(
        [heading + rng.normal(0, 0.1, 20), heading + np.pi + rng.normal(0, 0.1, n_wrong)]
    )
    votes = 30 * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    assert abs(np.angle(np.exp(1j * (kernels.heading_of(votes) - heading)))) < 0.15


@pytest.mark.nightly
def test_it_measures_unknown_mice(grown):
    toy = unseen()
    guesses = grown.estimate(toy.depths, SCENE, grown.find_size(toy.depths, SCENE))
    assert guesses.found.all()
    error = np.linalg.norm(guesses.joints - true_joints(toy), axis=-1).mean(axis=1)
    middle = np.linalg.norm(
        true_joints(toy) - true_joints(toy).mean(axis=1, keepdims=True), axis=-1
    ).mean()
    assert np.median(error) < 6.0 < middle  # far better than the animal's centre for every joint
    assert (error < 12.0).mean() > 0.75


@pytest.mark.nightly
def test_one_core_gives_what_two_give_and_a_second_training_the_same_forest(grown):
    toy = toy_mice(40, 4)
    one, two = (
        grown.estimate(toy.depths, SCENE, 1.0, parallel).joints for parallel in (False, True)
    )
    np.testing.assert_array_equal(one, two)
    few = toy_mice(60, 1)
    data = training_set(few, PAPER)
    a, b = (
        train_forests(data, few.skeleton, SMALL, np.random.default_rng(3), lambda *_: None)
        for _ in range(2)
    )
    assert a.to_bytes() == b.to_bytes()


@pytest.mark.nightly
def test_a_file_gives_the_forest_back_and_a_damaged_one_is_refused(grown, tmp_path):
    path, toy = tmp_path / "rf.npz", toy_mice(5, 4)
    toy.depths[1] = FLOOR.depth(*toy.depths.shape[:0:-1])  # no animal
    path.write_bytes(grown.to_bytes())
    again = load_baseline(path, grown.skeleton, grown.plan)
    np.testing.assert_array_equal(
        again.estimate(toy.depths, SCENE, 1.0).joints, grown.estimate(toy.depths, SCENE, 1.0).joints
    )
    found = again.estimate(toy.depths, SCENE, 1.0)
    assert found.found.tolist() == [True, False, True, True, True]
    assert np.isnan(found.joints[1]).all()
    path.write_bytes(path.read_bytes()[:1000])
    with pytest.raises(ModelError, match="train again"):
        load_baseline(path, grown.skeleton, grown.plan)


@pytest.mark.nightly
def test_the_plain_mean_is_the_mean_of_all_candidates():
    estimator = PoseEstimator(trained("paper").model)
    toy = toy_mice(8, 4)
    second = baseline.second_is_likelier(toy.depths, SCENE)
    cut = baseline.chosen(toy.depths, SCENE, 1.0, second, True)
    crops, crop_cameras = cut
    positions = estimator.candidates(crops, crop_cameras, 1.0).positions
    guesses = baseline.PlainMean(estimator).estimate(toy.depths, SCENE, 1.0)
    np.testing.assert_allclose(
        guesses.joints,
        (positions.mean(axis=1) - [0, 0, 1] * crop_cameras[:, None, 13:14]) * [1, -1, -1],
        atol=1e-9,
    )
    one = replace(estimator, n_candidates=1)
    alone = baseline.PlainMean(one).estimate(toy.depths, SCENE, 1.0).joints
    chosen = one.estimate(toy.depths, SCENE, 1.0).chosen.pose.joints(toy.skeleton)
    np.testing.assert_allclose(
        alone, chosen, atol=1e-6
    )  # of one candidate there is nothing to choose
