"""The last correction of the chosen pose: it helps where trees have not been, and keeps what it
cannot know.
"""

from dataclasses import replace
from functools import cache

import numpy as np

from liex_lab.body.skeleton import Skeleton
from liex_lab.estimation.estimator import PoseEstimator
from liex_lab.estimation.method import METHODS
from liex_lab.estimation.model import Model
from liex_lab.estimation.training import with_corrector
from tests.estimation.toy import SCENE, toy_mice, trained, training_set, unseen


def taught(n: int) -> Model:
    """The toy model with a correction learned from n mice that its trees have not seen."""
    model = trained("default").model
    usual = METHODS["default"].corrector
    assert usual is not None
    plan = usual._replace(n_trees=40, min_leaf=10, n_tests=60)
    method = replace(model.method, corrector=plan)
    model = replace(model, cascade=replace(model.cascade, method=method))
    return with_corrector(model, training_set(toy_mice(n, 11), method), np.random.default_rng(4))


@cache
def corrected_model() -> Model:
    return taught(400)


def errors(model: Model) -> np.ndarray:
    toy = unseen()
    found = PoseEstimator(model).estimate(toy.depths, SCENE, 1.0)
    true = SCENE.floor.T_arena_camera.inverse() @ toy.joints
    return np.linalg.norm(found.chosen.pose.joints(toy.skeleton) - true, axis=-1).mean(axis=1)


def test_chosen_poses_come_nearer_to_the_truth():
    before, after = errors(replace(corrected_model(), corrector=None)), errors(corrected_model())
    assert after.mean() < 0.97 * before.mean()
    assert np.median(after) < np.median(before)


def test_a_corrected_pose_keeps_the_proportions_of_the_bones():
    skeleton = corrected_model().skeleton
    pose = PoseEstimator(corrected_model()).estimate(unseen().depths[:20], SCENE, 1.0).chosen.pose
    bones = np.linalg.norm(np.diff(pose.joints(skeleton), axis=1), axis=-1)
    home = np.linalg.norm(skeleton.offsets[1:], axis=-1)
    np.testing.assert_allclose(
        bones / bones.sum(1, keepdims=True), np.tile(home / home.sum(), (20, 1)), atol=1e-9
    )


def test_equal_images_teach_equal_corrections():
    assert taught(60).to_bytes() == taught(60).to_bytes()


def test_an_animal_whose_skeleton_branches_has_none():
    model = corrected_model()
    assert model.skeleton.is_chain
    hand = Skeleton.load("hand")
    assert not hand.is_chain
    branching = replace(model, cascade=replace(model.cascade, skeleton=hand), corrector=None)
    assert with_corrector(branching, trained("default").data, np.random.default_rng(0)) is branching
