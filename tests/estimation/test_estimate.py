"""Estimation: the fast kernels agree with the page of the paper, however the frames are dealt out;
then the choice.
"""

from dataclasses import fields, replace

import numpy as np
import pytest

from liex_lab.body.pose import Pose
from liex_lab.body.skeleton import Skeleton
from liex_lab.estimation._cascade_kernels import choose_survivors, mode_of_votes
from liex_lab.estimation.estimator import Estimates, PoseEstimator
from liex_lab.estimation.method import METHODS
from liex_lab.estimation.model import ErrorCalibration
from liex_lab.estimation.scoring import Chosen, choose
from liex_lab.estimation.training import train_pruner
from liex_lab.geometry import SE3, so3
from tests.estimation.toy import CAMERA, FLOOR, SCENE, toy_mice, trained, unseen, with_box
from tests.oracles import algorithm1

VARIANTS = ["default", "paper"]


def columns(estimates: Estimates) -> dict[str, np.ndarray]:
    """All numbers of some estimates, by name."""
    chosen = {f.name: getattr(estimates.chosen, f.name) for f in fields(Chosen) if f.name != "pose"}
    pose = estimates.chosen.pose
    crops = {f.name: getattr(estimates.crops, f.name) for f in fields(estimates.crops)}
    return {
        **chosen,
        **crops,
        "found": estimates.found,
        "rotation": pose.root.rotation,
        "translation": pose.root.translation,
        "angles": pose.angles,
        "scale": pose.scale,
    }


@pytest.mark.parametrize("variant", [*VARIANTS, pytest.param("seen", marks=pytest.mark.nightly)])
def test_all_candidates_agree_with_the_slow_twin_of_algorithm_1(variant):
    model, size = trained(variant).model, 1.0 if variant == "paper" else 1.07
    estimator = PoseEstimator(model)
    crops = SCENE.extract(unseen().depths[:4], size, camera_view=model.method.camera_view)
    crop_cameras = SCENE.crop_cameras(crops, model.method.camera_view)
    found = estimator.candidates(crops, crop_cameras, size)
    for i in range(4):
        picture = algorithm1.Picture(
            crops.heights[i], crop_cameras[i], crops.moments[i], size, model.method.reach_mm
        )
        for k in range(found.scores.shape[1]):
            drawn = estimator._starts[0, k]
            begun = (
                algorithm1.seen_start(model, picture, k, size)
                if variant == "seen"
                else algorithm1.start(model, crops.moments[i], k, drawn, size)
            )
            twin = algorithm1.solve(model, picture, begun)
            np.testing.assert_allclose(
                found.rotations[i, k], [joint[:3, :3] for joint in twin.joints], atol=1e-9
            )
            np.testing.assert_allclose(
                found.positions[i, k], [joint[:3, 3] for joint in twin.joints], atol=1e-7
            )
            assert found.scores[i, k] == pytest.approx(twin.score, rel=1e-9)


def test_the_mode_of_votes_agrees_with_the_slow_twin_and_ignores_an_outlier():
    rng = np.random.default_rng(1)
    for n_values in (1, 2, 6):
        votes = rng.normal(0, 8, (10, n_values)).astype(np.float32)
        out = votes.mean(axis=0, dtype=float)
        mode_of_votes(votes, 10.0, out)
        np.testing.assert_allclose(out, algorithm1.mode(votes.astype(float), 10.0), atol=1e-9)
    votes = np.array([[1.0], [1.2], [0.8], [1.0], [30.0]], np.float32)
    out = votes.mean(axis=0, dtype=float)
    mode_of_votes(votes, 5.0, out)
    assert out[0] == pytest.approx(1.0, abs=0.05)


@pytest.mark.parametrize("variant", [*VARIANTS, "seen"])
def test_one_thread_and_many_give_the_same_numbers(variant):
    estimator = PoseEstimator(trained(variant).model)
    depths = unseen().depths[:12]
    one, many = (
        columns(estimator.estimate(depths, SCENE, 1.0, parallel)) for parallel in (False, True)
    )
    for name, values in one.items():
        np.testing.assert_array_equal(values, many[name], err_msg=name)


@pytest.mark.parametrize("parts", [[1, 4, 7]])
def test_a_frame_does_not_know_with_which_others_it_came(parts):
    estimator = PoseEstimator(trained("default").model)
    depths = unseen().depths[:12].copy()
    depths[3] = 0.0
    whole = columns(estimator.estimate(depths, SCENE, 1.0))
    stops = np.cumsum(parts)
    pieces = [
        columns(estimator.estimate(depths[stop - n : stop], SCENE, 1.0))
        for n, stop in zip(parts, stops, strict=True)
    ]
    for name, values in whole.items():
        np.testing.assert_array_equal(
            values, np.concatenate([piece[name] for piece in pieces]), err_msg=name
        )


def test_frames_without_an_animal_are_rows_of_nan_among_the_others():
    estimator = PoseEstimator(trained("default").model)
    depths = unseen().depths[:6].copy()
    depths[1] = 0.0
    depths[4] = FLOOR.depth(CAMERA.width, CAMERA.height)
    whole = estimator.estimate(depths, SCENE, 1.0)
    assert whole.found.tolist() == [True, False, True, True, False, True]
    for name, values in columns(whole).items():
        if (
            values.size
            and values.dtype == np.float64
            and name not in ("moments", "distance", "objects")
        ):
            finite = np.isfinite(values).reshape(6, -1)
            np.testing.assert_array_equal(finite.all(axis=1), whole.found, err_msg=name)
            np.testing.assert_array_equal(finite.any(axis=1), whole.found, err_msg=name)


@pytest.mark.parametrize(("variant", "limit_mm"), [("default", 2.0), ("paper", 3.5)])
def test_poses_come_out_in_the_camera_frame_near_the_truth(variant, limit_mm):
    toy, estimator = unseen(), PoseEstimator(trained(variant).model)
    joints = estimator.estimate(toy.depths, SCENE, 1.0).chosen.pose.joints(toy.skeleton)
    true = FLOOR.T_arena_camera.inverse() @ toy.joints
    assert np.median(np.linalg.norm(joints - true, axis=-1).mean(axis=1)) < limit_mm
    length = np.linalg.norm(np.diff(joints, axis=1), axis=-1).sum(axis=1)
    off = length / (toy.pose.scale * toy.skeleton.length) - 1.0
    if variant == "default":  # the paper's bones are of the session's size
        assert np.median(np.abs(off)) < 0.04
        assert abs(np.median(off)) < 0.02


@pytest.mark.parametrize("true_size", [0.8, 1.25])
def test_the_size_of_an_animal_is_found_from_its_frames(true_size):
    toy = toy_mice(60, 5, size=(true_size, true_size))
    estimator = PoseEstimator(trained("default").model)
    area = float(np.median(SCENE.extract(toy.depths, 1.0).moments[:, 1]))
    assert estimator.find_size(toy.depths, replace(SCENE, area_mm2=area)) == pytest.approx(
        true_size, rel=0.06
    )


def pruned_model(survivors: int):
    """The toy model with a small metric that lets some candidates go on."""
    toy = trained("default")
    method = replace(toy.model.method, survivors=survivors, pruner=METHODS["default"].pruner)
    cascade = replace(toy.model.cascade, method=method)
    pruner = train_pruner(toy.data, cascade, toy.candidates, np.random.default_rng(3))
    return replace(toy.model, cascade=cascade, pruner=pruner)


def test_candidates_that_outlive_the_base_end_as_they_do_among_all():
    model, depths = pruned_model(3), unseen().depths[:30]
    crops = SCENE.extract(depths, 1.0)
    crop_cameras = SCENE.crop_cameras(crops)
    few = PoseEstimator(model).candidates(crops, crop_cameras, 1.0)
    all_of_them = PoseEstimator(model, unpruned=True).candidates(crops, crop_cameras, 1.0)
    assert few.scores.shape == (30, 3)
    assert all_of_them.scores.shape == (30, model.method.n_candidates)
    for i in range(30):
        same = (
            np.abs(few.positions[i][:, None] - all_of_them.positions[i][None]).max(axis=(2, 3))
            == 0.0
        )
        assert (same.sum(axis=1) == 1).all()
        np.testing.assert_array_equal(few.scores[i], all_of_them.scores[i][same.argmax(axis=1)])


def test_the_best_candidate_that_points_the_other_way_always_goes_on():
    heading = np.array([0.0, 0.1, -0.1, 0.2, 3.0, 3.1])
    rotations = so3.exp(np.stack([0 * heading, 0 * heading, heading], axis=1))
    chosen = np.zeros(3, np.int64)
    choose_survivors(rotations, np.array([1.0, 2.0, 1.5, 3.0, 9.0, 8.0]), chosen)
    assert chosen.tolist() == [0, 2, 5]
    choose_survivors(rotations, np.array([1.0, 2.0, 1.5, 3.0, 0.5, 8.0]), chosen)
    assert chosen.tolist() == [4, 0, 2]
    choose_survivors(rotations[:4], np.array([4.0, 2.0, 1.5, 3.0]), chosen)
    assert chosen.tolist() == [2, 1, 3]


def test_more_candidates_may_be_asked_for_than_the_model_was_made_with():
    model = trained("default").model
    depths = unseen().depths[:40]
    true = FLOOR.T_arena_camera.inverse() @ unseen().joints[:40]
    off = []
    for n in (2, 24):
        estimator = PoseEstimator(model, n)
        crops = SCENE.extract(depths, 1.0)
        found = estimator.candidates(crops, SCENE.crop_cameras(crops), 1.0)
        assert found.scores.shape == (40, n)
        joints = estimator.estimate(depths, SCENE, 1.0).chosen.pose.joints(model.skeleton)
        off.append(np.linalg.norm(joints - true, axis=-1).mean())
    assert off[1] < off[0]


def test_of_two_things_of_the_animals_size_the_one_that_looks_like_it_is_taken():
    toy, estimator = unseen(), PoseEstimator(trained("default").model)
    middle = toy.joints[:30, 2]
    box = np.where(middle[:, :1] > 0, [-75.0, 0.0], [75.0, 0.0])
    depths = np.stack(
        [with_box(depth, *place) for depth, place in zip(toy.depths, box, strict=False)]
    )
    bare = FLOOR.depth(CAMERA.width, CAMERA.height)
    box_area = SCENE.extract(with_box(bare, 75.0, 0.0)[None], 1.0).moments[0, 1]
    volume = float(np.median(SCENE.extract(toy.depths, 1.0).moments[:, 2]))
    scene = replace(
        SCENE, area_mm2=float(box_area), volume_mm3=volume
    )  # by area alone the box is the likelier one

    def off(moments: np.ndarray) -> np.ndarray:
        return np.linalg.norm(moments[:, 3:5] - middle[:, :2], axis=1)

    first = scene.extract(depths, 1.0)
    assert (first.n_blobs == 2).all()
    assert (off(first.moments) > 40.0).mean() > 0.3
    assert (off(estimator.estimate(depths, scene, 1.0).crops.moments) < 15.0).all()


# the choice among candidates


def drawn_candidates(n: int, k: int, seed: int) -> tuple[Skeleton, Pose, np.ndarray, np.ndarray]:
    """Poses (n, k) whose joints do not turn about their bones, with rotations and positions of all
    their joints.
    """
    rng = np.random.default_rng(seed)
    skeleton = Skeleton.load("mouse")
    angles = rng.normal(0, 0.3, (n, k, skeleton.n_joints, 3)) * skeleton.axes
    angles[:, :, 0] = 0.0
    root = SE3(so3.exp(rng.normal(0, 0.6, (n, k, 3))), rng.normal(0, 30, (n, k, 3)))
    pose = Pose(root, angles, rng.uniform(0.8, 1.2, (n, k)))
    frames = pose.frames(skeleton)
    return skeleton, pose, frames.rotation, frames.translation


def test_the_mean_weighs_by_score_and_leaves_out_what_lies_far_from_the_best():
    skeleton, _, rotations, positions = drawn_candidates(1, 1, seed=5)
    method = replace(METHODS["default"], top_k=3, top_tau=1.0, top_radius_mm=15.0)
    moved = np.zeros((1, 4, 1, 3))
    moved[0, :, 0, 0] = [0.0, 4.0, 60.0, 8.0]
    scores = np.array(
        [[2.0, 2.0 + np.log(3.0), 2.5, 9.0]]
    )  # the last one is not among the best three
    picked = choose(
        skeleton,
        method,
        ErrorCalibration(),
        1.0,
        np.repeat(rotations, 4, 1),
        np.repeat(positions, 4, 1) + moved,
        scores,
    )
    np.testing.assert_allclose(
        picked.pose.joints(skeleton)[0] - positions[0, 0], [[1.0, 0.0, 0.0]] * 5, atol=1e-9
    )
    assert picked.score[0] == pytest.approx(2.0 + 0.25 * np.log(3.0))
    assert picked.spread[0] == pytest.approx(np.sqrt(0.75 * 1.0 + 0.25 * 9.0))


def test_the_expected_error_is_a_straight_line_through_score_and_spread_and_grows_with_the_animal():
    skeleton, _, rotations, positions = drawn_candidates(6, 4, seed=6)
    scores = np.random.default_rng(7).uniform(1, 20, (6, 4))
    share = (0.5, 0.8, 1.0, 1.2, 1.5)
    calibration = ErrorCalibration(offset=0.3, slope=0.6, spread_slope=0.2, joint_share=share)
    for size in (1.0, 1.7):
        picked = choose(
            skeleton, METHODS["default"], calibration, size, rotations, positions, scores
        )
        expected = size * (0.3 + 0.6 * picked.score + 0.2 * picked.spread)
        np.testing.assert_allclose(picked.error_mm, expected)
        np.testing.assert_allclose(picked.sd_mm, expected[:, None] * share / np.sqrt(3.0))


def test_doubts_say_how_good_a_candidate_of_the_opposite_direction_is():
    skeleton, _, rotations, positions = drawn_candidates(1, 1, seed=8)
    backwards = positions[:, :, ::-1]
    both = np.concatenate([positions, backwards], axis=1)
    for order in ([0, 1], [0, 0]):
        picked = choose(
            skeleton,
            METHODS["paper"],
            ErrorCalibration(),
            1.0,
            np.repeat(rotations, 2, 1),
            both[:, order],
            np.array([[2.0, 3.5]]),
        )
        assert picked.doubts[0, 1] == (3.5 if order == [0, 1] else 40.0)
