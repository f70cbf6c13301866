"""Training: forests that see a toy world learn to measure in it, and to say how well they do."""

from dataclasses import replace

import numpy as np
import pytest

from liex_lab.estimation.cascade import TrainingSet
from liex_lab.estimation.estimator import PoseEstimator
from liex_lab.estimation.scoring import with_expected_error
from liex_lab.estimation.training import (
    calibrate,
    joint_error,
    perturbed_truth,
    run_on,
    start_candidates,
    train_cascade,
    train_metric,
)
from liex_lab.evaluation.scores import rank_correlation
from tests.estimation.toy import (
    CAMERA,
    FLOOR,
    SCENE,
    Toy,
    tiny,
    toy_mice,
    trained,
    training_set,
    unseen,
    with_box,
)

VARIANTS = ["default", "paper"]


def easy_and_hard(n: int, seed: int) -> Toy:
    """Frames from hardly any noise to far more than the model was trained with."""
    return toy_mice(n, seed, noise_mm=np.linspace(0.5, 6.0, n))


@pytest.fixture(scope="module")
def held_out() -> Toy:
    return easy_and_hard(400, 11)


def all_candidates(variant: str, toy: Toy) -> tuple[np.ndarray, np.ndarray]:
    """Scores and true joint errors (n, K) of what the trained cascade makes of unseen mice."""
    model = trained(variant).model
    truth = training_set(toy, model.method).truth
    crops = SCENE.extract(toy.depths, 1.0, camera_view=model.method.camera_view)
    found = PoseEstimator(model).candidates(
        crops, SCENE.crop_cameras(crops, model.method.camera_view), 1.0
    )
    off = np.linalg.norm(found.positions - truth.positions[:, None], axis=-1)
    return found.scores, off.mean(axis=-1)


def initial_error(variant: str, toy: Toy) -> np.ndarray:
    """Joint errors of straight animals put where candidates start."""
    model = trained(variant).model
    data = training_set(toy, model.method)
    starts = start_candidates(data, toy.skeleton, model.method, np.random.default_rng(0))
    for joint in range(1, toy.skeleton.n_joints):
        model.cascade.place(starts, joint)
    return joint_error(starts, data.truth)


@pytest.mark.parametrize("variant", VARIANTS)
def test_the_chosen_pose_of_an_unseen_mouse_is_far_better_than_where_it_started(variant):
    trial = run_on(
        trained(variant).model, training_set(unseen(), tiny(variant)), np.random.default_rng(0)
    )
    started, ended = initial_error(variant, unseen()), trial.joint_error.mean(axis=1)
    assert np.median(started) > 20.0
    assert np.median(ended) < 0.1 * np.median(started)
    assert np.quantile(ended, 0.9) < 5.0


@pytest.mark.parametrize("variant", VARIANTS)
def test_the_learned_metric_ranks_candidates_by_their_true_error(variant):
    scores, error = all_candidates(variant, unseen())
    assert rank_correlation(scores.ravel(), error.ravel()) > 0.6
    chosen = error[np.arange(len(error)), scores.argmin(axis=1)]
    assert chosen.mean() < 0.6 * error.mean()
    assert np.median(chosen) < 2.0 * np.median(error.min(axis=1))


def test_training_starts_both_ways_along_the_animal_and_is_unsure_of_its_size():
    data, method = trained("default").data, replace(tiny("default"), training_candidates=8)
    skeleton = trained("default").model.skeleton
    starts = start_candidates(data, skeleton, method, np.random.default_rng(3))
    true_heading = (
        data.truth.positions[starts.image, -1, :2] - data.truth.positions[starts.image, 0, :2]
    )
    along = np.sum(true_heading * starts.rotations[:, 0, :2, 0], axis=1) / np.linalg.norm(
        true_heading, axis=1
    )
    assert (along > 0).mean() == pytest.approx(0.5, abs=0.02)
    assert np.median(np.abs(along)) > 0.9
    off = np.log(starts.size / data.size[starts.image])
    assert off.std() == pytest.approx(0.08, rel=0.1)
    np.testing.assert_array_equal(starts.scale, starts.size)


def test_the_papers_starts_point_anywhere_and_are_scaled_by_any_factor_up_to_a_tenth():
    data, skeleton = trained("paper").data, trained("paper").model.skeleton
    starts = start_candidates(data, skeleton, tiny("paper"), np.random.default_rng(3))
    heading = np.arctan2(starts.rotations[:, 0, 1, 0], starts.rotations[:, 0, 0, 0])
    counts, _ = np.histogram(heading, 8, (-np.pi, np.pi))
    assert counts.min() > 0.8 * counts.mean()
    factor = starts.scale / starts.size
    assert 0.9 <= factor.min() < 0.902 < 1.098 < factor.max() <= 1.1
    counts, _ = np.histogram(factor, 8, (0.9, 1.1))
    assert counts.min() > 0.8 * counts.mean()  # uniform: as many near the ends as in the middle


@pytest.mark.parametrize("variant", VARIANTS)
def test_perturbed_truth_is_a_pose_with_the_animals_own_bones_up_to_badly_off(variant):
    learned = trained(variant)
    examples = perturbed_truth(learned.data, learned.model.cascade, np.random.default_rng(1))
    skeleton = learned.model.skeleton
    assert np.bincount(examples.image).tolist() == [8] * len(learned.data.size)
    bones = np.linalg.norm(np.diff(examples.positions, axis=1), axis=-1)
    home = np.linalg.norm(skeleton.offsets[1:], axis=1)
    np.testing.assert_allclose(
        bones, learned.data.truth.scale[examples.image][:, None] * home, rtol=1e-9
    )
    error = joint_error(examples, learned.data.truth)
    assert np.quantile(error, 0.02) < 2.0
    assert np.quantile(error, 0.98) > 15.0


def test_what_is_no_animal_teaches_the_metric_and_not_the_regressors():
    method = tiny("default")
    mice, bare = training_set(toy_mice(200, 21), method), FLOOR.depth(CAMERA.width, CAMERA.height)
    rng = np.random.default_rng(4)
    frames = np.stack([with_box(bare, *rng.uniform([-70, -45], [70, 45])) for _ in range(160)])
    other = training_set(replace(toy_mice(160, 22), depths=frames), method)
    far = replace(
        other.truth, positions=other.truth.positions + 500.0
    )  # a box that was taken for an animal elsewhere
    boxes = replace(other, truth=far, animal=np.zeros(160, np.bool_))
    data = TrainingSet.join([mice, boxes])
    assert data.animal.tolist() == [True] * 200 + [False] * 160
    skeleton = trained("default").model.skeleton
    cascade, candidates = train_cascade(data, skeleton, method, rng, lambda share, what: None)
    for forest in cascade.forests[0]:
        assert np.abs(forest.leaves[:, 3:6]).max() < 60.0
    metric = train_metric(data, cascade, candidates, rng)
    estimator = PoseEstimator(replace(trained("default").model, cascade=cascade, metric=metric))
    best = []
    for depths in (
        unseen().depths[:60],
        frames[:60] + rng.normal(0, 1, frames[:60].shape).astype(np.float32),
    ):
        crops = SCENE.extract(depths, 1.0)
        best.append(estimator.candidates(crops, SCENE.crop_cameras(crops), 1.0).scores.min(axis=1))
    assert np.quantile(best[0], 0.95) < 10.0 < 20.0 < np.quantile(best[1], 0.05)


@pytest.mark.parametrize("variant", VARIANTS)
def test_calibrated_intervals_hold_nine_tenths_of_their_own_images_and_about_as_many_others(
    variant, held_out
):
    method, rng = tiny(variant), np.random.default_rng(0)
    model = calibrate(trained(variant).model, training_set(held_out, method), rng)
    low, high = model.calibration.quantiles
    assert 0.0 < low < 1.0 < high
    assert model.calibration.area_mm2 == trained(variant).model.calibration.area_mm2
    assert len(model.calibration.joint_share) == 5
    for toy, tolerance in ((held_out, 0.06), (easy_and_hard(200, 12), 0.1)):
        data = training_set(toy, method)
        crops = SCENE.extract(toy.depths, 1.0, camera_view=method.camera_view)
        estimator = PoseEstimator(model)
        picked = estimator.pick(estimator.candidates(crops, data.images.crop_cameras, 1.0), 1.0)
        expected = with_expected_error(picked, model, data.images, 1.0).error_mm
        joints = picked.pose.joints(model.skeleton)
        error = np.linalg.norm(joints - data.truth.positions, axis=-1).mean(axis=1)
        inside = (error >= low * expected) & (error <= high * expected)
        assert inside.mean() == pytest.approx(0.9, abs=tolerance)
        assert rank_correlation(expected, error) > 0.25
        assert (expected > model.calibration.doubtful_mm).mean() < 0.15
