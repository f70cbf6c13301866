"""The build of an animal from many frames: cross-sections as wide as the body, a map found again,
poses moved by what is known.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from liex_lab.body.shape import BodyShape
from liex_lab.catalog import find_model
from liex_lab.estimation.model import Model
from liex_lab.estimation.session_shape import (
    N_STATIONS,
    PLACES,
    Build,
    ShapePrior,
    built,
    cross_sections,
    outline_labels,
    session_clues,
)
from liex_lab.scene.height_maps import view_of
from tests.estimation.toy import SCENE, Toy, rendered, toy_mice

AT = np.linspace(-0.10, 1.10, N_STATIONS)
TRUNK = (AT > 0.1) & (AT < 0.9)


@pytest.fixture(scope="module")
def toy() -> Toy:
    return toy_mice(60, 11, noise_mm=0.0, size=(1.0, 1.0))


def across(toy: Toy, shape: BodyShape | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Half widths (S,) and heights (S, T) of the toy's mice with a body, in their true poses."""
    crops = SCENE.extract(rendered(toy.skeleton, toy.pose, shape=shape), 1.0)
    cameras = SCENE.crop_cameras(crops, False)
    T_view_arena = view_of(cameras) @ SCENE.floor.T_arena_camera.inverse()
    pose = toy.pose.moved(T_view_arena)
    covered, height, step = cross_sections(toy.skeleton, pose, crops.heights, cameras, 1.0)
    return covered.sum(axis=1) * step, height


def tall(toy: Toy, factor: float) -> BodyShape:
    """The default mouse, so many times as high, without ears, feet and tail."""
    usual = BodyShape.default(toy.skeleton).bare()
    return replace(usual, half_height=factor * usual.half_height)


def test_the_half_width_of_the_cross_sections_is_that_of_the_body(toy):
    stations = np.array(toy.skeleton.surface["stations"])
    true = np.interp(AT, stations, BodyShape.default(toy.skeleton).half_width)
    seen = across(toy)[0] * toy.skeleton.length
    np.testing.assert_allclose(seen[TRUNK], true[TRUNK], atol=1.2)  # a pixel is 2 mm


def test_the_back_of_a_higher_body_lies_higher_and_falls_farther(toy):
    (_, flat), (_, high) = (across(toy, tall(toy, factor)) for factor in (0.8, 1.2))
    middle = slice(8, 14)
    lies = (high - flat)[middle, 0] * toy.skeleton.length
    usual = np.interp(
        AT[middle], toy.skeleton.surface["stations"], BodyShape.default(toy.skeleton).half_height
    )
    np.testing.assert_allclose(lies, 0.4 * usual, rtol=0.12)
    falls = [one[middle, 0] - one[middle, 10] for one in (flat, high)]
    assert (falls[1] > 1.2 * falls[0]).all()


def test_a_linear_map_is_found_again_and_its_noise_is_told(tmp_path: Path):
    rng = np.random.default_rng(5)
    clues = rng.uniform(-1.0, 1.0, (800, 6))
    weights = rng.normal(size=(6, 4))
    labels = clues @ weights + [1.0, 2.0, 3.0, 4.0] + rng.normal(0, 0.2, (800, 4))
    prior = replace(ShapePrior.fit(clues, labels), unseen=(0.01, 0.02), model="m")
    new = rng.uniform(-0.9, 0.9, (50, 6))
    true = new @ weights + [1.0, 2.0, 3.0, 4.0]
    # ridge regression pulls by three per cent of the clues' variance
    assert np.abs(prior.predict(new) - true).mean() < 0.05 * np.abs(true).mean()
    pulled = 0.03 / 1.03 * np.linalg.norm(weights, axis=0) / np.sqrt(3.0)
    np.testing.assert_allclose(prior.spread, np.hypot(0.2, pulled), rtol=0.15)
    arrays: dict[str, Any] = prior.arrays()
    np.savez(tmp_path / "kept.npz", **arrays)
    again = ShapePrior.load(tmp_path / "kept.npz")
    np.testing.assert_allclose(again.predict(new), prior.predict(new), atol=1e-5)
    assert (again.unseen, again.model) == ((0.01, 0.02), "m")


def test_a_clue_beyond_all_that_was_seen_is_taken_for_the_last():
    clues = np.random.default_rng(6).uniform(-1, 1, (400, 2))
    prior = ShapePrior.fit(clues, clues @ [[1.0], [0.0]])
    far, edge = prior.predict(np.array([[50.0, 0.0], [1.0, 0.0]]))
    assert far == pytest.approx(edge, abs=0.02)


def test_clues_far_outside_the_training_are_of_an_unlike_body():
    prior = ShapePrior.fit(*(np.random.default_rng(7).uniform(-1, 1, (400, k)) for k in (2, 3)))
    assert [prior.is_unlike(np.array([0.0, value])) for value in (0.9, -1.2, 1.3, -2.0)] == [
        False,
        False,
        False,
        True,
    ]
    assert prior.unseen_of(True)[0] > prior.unseen_of(False)[0]


def test_an_unlike_body_is_as_high_as_usual_for_its_width_and_its_back_lies_where_it_is_visible(
    toy,
):
    clues = session_clues_of(toy)
    p = len(PLACES)

    def read(labels: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
        offset = labels[: -2 * p].reshape(-1, 3)
        assert np.ptp(offset, axis=0).max() == 0.0
        return offset[0, 2], np.exp(labels[-2 * p : -p]), np.exp(labels[-p:])

    up, width, height = read(outline_labels(toy.skeleton, clues))
    assert abs(up) < 0.03
    np.testing.assert_allclose(width, 1.0, atol=0.2)
    deeper = clues.copy()
    deeper[N_STATIONS : N_STATIONS + 8] += 0.05  # the back is farther above the estimated joints
    np.testing.assert_allclose(read(outline_labels(toy.skeleton, deeper))[0], up + 0.05)
    broad = clues.copy()
    broad[:N_STATIONS] *= 1.2
    lower, wider, higher = read(outline_labels(toy.skeleton, broad))
    np.testing.assert_allclose([wider / width, higher / height], 1.2)
    assert lower < up


def build(offset: np.ndarray) -> Build:
    ones = np.ones(len(PLACES))
    return Build(offset, ones, 1.2 * ones, 0.05 * ones, 0.1 * ones, (0.01, 0.01))


def test_poses_are_moved_in_their_own_frame_and_bones_keep_their_proportions(toy):
    """An offset that is the same for all joints moves the whole body by it."""
    offset = np.tile([0.02, 0.0, -0.03], (toy.skeleton.n_joints, 1))
    moved = build(offset).corrected(toy.skeleton, toy.pose, 1.1)
    step = 1.1 * toy.skeleton.length * toy.pose.root.rotation @ offset[0]
    np.testing.assert_allclose(moved.joints(toy.skeleton), toy.joints + step[:, None], atol=1e-6)
    np.testing.assert_allclose(moved.scale, toy.pose.scale)


def test_frames_without_a_pose_stay_without_one(toy):
    pose = toy.pose[np.arange(5)]
    pose.scale[3] = np.nan
    pose.root.translation[3] = np.nan
    moved = build(np.full((toy.skeleton.n_joints, 3), 0.01)).corrected(toy.skeleton, pose, 1.0)
    assert np.isnan(moved.joints(toy.skeleton)[3]).all()
    assert np.isfinite(moved.joints(toy.skeleton)[[2, 4]]).all()


def test_the_body_of_a_build_is_as_much_wider_and_higher(toy):
    own = build(np.zeros((toy.skeleton.n_joints, 3)))
    body = built(toy.skeleton, own.width, own.height).body
    usual = BodyShape.default(toy.skeleton)
    assert isinstance(body, BodyShape)
    np.testing.assert_allclose(body.half_width, usual.half_width)
    np.testing.assert_allclose(body.half_height, 1.2 * usual.half_height)


def test_the_bundled_shapes_were_learned_for_the_bundled_model():
    prior = ShapePrior.of("fish")
    model = Model.load(find_model("fish"))
    assert prior is not None
    assert prior.model == model.fingerprint
    assert prior.table.shape == (prior.bounds.shape[1] + 1, 3 * 21 + 2 * len(PLACES))
    assert ShapePrior.of("snake") is None


def session_clues_of(toy: Toy) -> np.ndarray:
    crops = SCENE.extract(toy.depths, 1.0)
    cameras = SCENE.crop_cameras(crops, False)
    pose = toy.pose.moved(view_of(cameras) @ SCENE.floor.T_arena_camera.inverse())
    return session_clues(toy.skeleton, pose, crops.heights, cameras, 1.0)
