"""A session's own shape: kept where frames that it was not fitted to bear it out, not elsewhere."""

from dataclasses import replace

import numpy as np
import pytest

from liex_lab.body.shape import BodyShape, Surface
from liex_lab.estimation.estimator import Estimates, PoseEstimator
from liex_lab.estimation.session_shape import PLACES, ShapePrior, labels_of
from liex_lab.tracking.own_shape import (
    FEWEST_FRAMES,
    OwnShape,
    StatedShape,
    borne_out,
    fit_shape,
)
from liex_lab.tracking.residual import BodyResidual
from tests.estimation.test_session_shape import session_clues_of
from tests.estimation.toy import SCENE, Toy, rendered, toy_mice, trained

N = 60
HIGHER = 1.25  # than the average mouse's is the back of this one
LIFTED = 0.03  # of its length the estimated poses lie above the true ones


@pytest.fixture(scope="module")
def toy() -> Toy:
    return toy_mice(N, 21, noise_mm=0.0, size=(1.0, 1.0))


@pytest.fixture(scope="module")
def estimator() -> PoseEstimator:
    return PoseEstimator(trained("default").model)


@pytest.fixture(scope="module")
def estimates(toy: Toy, estimator: PoseEstimator) -> Estimates:
    """Of high mice, as if all poses were right but too high by as much everywhere."""
    usual = BodyShape.default(toy.skeleton).bare()
    depths = rendered(
        toy.skeleton, toy.pose, shape=replace(usual, half_height=HIGHER * usual.half_height)
    )
    found = estimator.estimate(depths, SCENE, 1.0)
    up = toy.pose.root.rotation[..., 2] * LIFTED * toy.skeleton.length
    pose = replace(
        toy.pose, root=replace(toy.pose.root, translation=toy.pose.root.translation + up)
    ).moved(SCENE.floor.T_arena_camera.inverse())
    chosen = replace(found.chosen, pose=pose, error_mm=np.full(N, 0.1))
    return Estimates(chosen, np.ones(N, bool), found.crops)


def certain(toy: Toy, estimator: PoseEstimator, lowered: float, higher: float) -> ShapePrior:
    """A regression that tells one build whatever it is shown."""
    n = len(session_clues_of(toy))
    offset = np.tile([0.0, 0.0, -lowered], (toy.skeleton.n_joints, 1))
    labels = labels_of(offset, np.ones(len(PLACES)), np.full(len(PLACES), higher))
    table = np.vstack([np.zeros((n, len(labels))), labels])
    spread = np.full(len(labels), 0.05)
    bounds = np.tile([[-9.0], [9.0]], n)
    return ShapePrior(bounds, table, spread, (0.01, 0.02), estimator.model.fingerprint)


def average(toy: Toy, estimates: Estimates) -> BodyResidual:
    pose = estimates.chosen.pose.moved(SCENE.floor.T_arena_camera)
    return BodyResidual.fit(Surface.of(toy.skeleton), pose, estimates.crops, SCENE)


def fitted(toy, estimator, estimates, prior) -> tuple[OwnShape | None, BodyResidual]:
    return fit_shape(prior, estimator, SCENE, estimates, 1.0, average(toy, estimates))


def lies_on_the_truth(toy, estimator, estimates, shape: OwnShape, body: BodyResidual) -> None:
    pose = shape.corrected(estimator, estimates.chosen.pose, 1.0).moved(SCENE.floor.T_arena_camera)
    np.testing.assert_allclose(pose.joints(toy.skeleton), toy.joints, atol=1e-6)
    assert np.median(body.of(pose, estimates.crops, SCENE)) < 0.5


def test_the_true_build_is_kept_and_takes_the_poses_to_the_truth(toy, estimator, estimates):
    prior = certain(toy, estimator, LIFTED, HIGHER)
    shape, body = fitted(toy, estimator, estimates, prior)
    assert shape is not None
    assert shape.build is not None
    assert shape.residual_mm < 0.7 * shape.average_residual_mm
    lies_on_the_truth(toy, estimator, estimates, shape, body)
    told = shape.to_dict()
    assert told["kept"]
    assert told["height"] == [HIGHER] * len(PLACES)
    assert told["n_frames"] == N


@pytest.mark.parametrize(("lowered", "higher"), [(-0.05, 0.8), (0.15, 1.0)])
def test_a_build_that_other_frames_contradict_is_not(toy, estimator, estimates, lowered, higher):
    prior = certain(toy, estimator, lowered, higher)
    shape, body = fitted(toy, estimator, estimates, prior)
    assert shape is not None
    assert shape.build is None
    assert "held out" in shape.why
    assert body.girth == average(toy, estimates).girth
    assert shape.corrected(estimator, estimates.chosen.pose, 1.0) is estimates.chosen.pose
    assert shape.to_dict()["why"] == shape.why


def test_the_height_of_an_unlike_body_is_assumed_and_the_user_is_cautioned(
    toy, estimator, estimates
):
    prior = certain(toy, estimator, LIFTED, HIGHER)
    unlike = replace(prior, bounds=prior.bounds + 50.0)
    shape, _ = fitted(toy, estimator, estimates, unlike)
    assert shape is not None
    assert shape.unlike
    assert shape.unseen is not None
    assert shape.unseen[0] > prior.unseen[0]
    assert "off by 3.3 mm" in shape.caution(100.0)
    assert shape.to_dict()["unlike"]
    if shape.build is not None:
        assert (shape.build.height < 0.9 * HIGHER).all()
        assert (shape.build.height_sd > 0.3).all()
    usual, _ = fitted(toy, estimator, estimates, prior)
    assert usual is not None
    assert usual.caution(100.0) == ""


def test_a_near_tie_of_medians_is_decided_frame_by_frame():
    before = np.array([1.0, 1.0, 1.0, 2.0, 3.0])
    assert borne_out(before, np.array([1.01, 1.01, 1.01, 1.0, 1.5])), "less in the mean"
    assert borne_out(before, np.array([0.9, 0.9, 0.9, 4.0, 5.0])), "less in the median"
    assert not borne_out(before, before + 0.01)
    assert not borne_out(before, before)
    unseen = np.where(np.arange(5) < 3, np.nan, before)  # what is not covered has no say
    assert borne_out(before, unseen - 0.1)
    assert not borne_out(before, unseen + 0.1)
    assert not borne_out(np.full(3, np.nan), np.ones(3)), "nothing speaks for it"


def test_a_build_that_is_told_a_little_too_stout_is_held_at_its_best_girth(
    toy, estimator, estimates
):
    prior = certain(toy, estimator, LIFTED, HIGHER)
    labels = prior.table[-1].copy()
    labels[-2 * len(PLACES) :] += np.log(1.15)
    stout = replace(prior, table=np.vstack([prior.table[:-1], labels]))
    shape, body = fitted(toy, estimator, estimates, stout)
    assert shape is not None
    assert shape.build is not None
    assert body.girth < 1.0
    assert shape.residual_mm < shape.average_residual_mm


def test_the_average_body_is_left_where_a_shape_cannot_be_fitted(toy, estimator, estimates):
    """Too few good frames, shapes learned for another model, or none at all."""
    prior = certain(toy, estimator, LIFTED, HIGHER)
    few = replace(estimates, found=np.arange(N) < FEWEST_FRAMES - 1)
    for own, sample, why in (
        (prior, few, "49 frames"),
        (replace(prior, model="another"), estimates, "model"),
    ):
        shape, _ = fitted(toy, estimator, sample, own)
        assert shape is not None
        assert shape.build is None
        assert why in shape.why
    assert fitted(toy, estimator, estimates, None)[0] is None


def test_a_shape_that_is_stated_is_used_whatever_the_frames_say(toy, estimator, estimates):
    prior = certain(toy, estimator, 0.0, 1.0)  # these frames would tell the average animal
    offset = np.tile([0.0, 0.0, -LIFTED], (toy.skeleton.n_joints, 1))
    labels = labels_of(offset, np.ones(len(PLACES)), np.full(len(PLACES), HIGHER))
    few = replace(estimates, found=np.arange(N) < 3)
    for seen, n in ((estimates, N), (few, 3)):
        shape, body = fit_shape(
            prior,
            estimator,
            SCENE,
            seen,
            1.0,
            average(toy, estimates),
            StatedShape(labels, None, "2 sessions of m07"),
        )
        assert shape is not None
        assert shape.build is not None
        lies_on_the_truth(toy, estimator, estimates, shape, body)
        told = shape.to_dict()
        assert (told["kept"], told["n_frames"], told["shared_by"]) == (True, n, "2 sessions of m07")


def test_sessions_that_share_the_average_shape_fit_none(toy, estimator, estimates):
    prior = certain(toy, estimator, LIFTED, HIGHER)
    before = average(toy, estimates)
    stated = StatedShape(None, 1.1, "3 sessions of m07")
    shape, body = fit_shape(prior, estimator, SCENE, estimates, 1.0, before, stated)
    assert shape is not None
    assert shape.build is None
    assert body is before
    assert "3 sessions of m07" in shape.to_dict()["why"]
