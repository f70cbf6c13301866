"""Shapes are learned from mini-sessions of known animals, the same whenever they are drawn."""

from __future__ import annotations

import numpy as np
import pytest
from liex_lab.pipelines.training.shape_model import PER_SESSION, MiniSession, mini_sessions

from liex_lab.body.shape import BodyShape
from liex_lab.errors import LiexError
from liex_lab.estimation.estimator import PoseEstimator
from liex_lab.estimation.session_shape import PLACES, ShapePrior
from liex_lab.simulation.fish import FishSpecies
from liex_lab.simulation.training_patches import BLOCK, drawn_bodies, training_blocks

N = BLOCK // PER_SESSION


@pytest.fixture(scope="module")
def others() -> list[MiniSession]:
    """Fish of builds that neither forests nor shapes were learned from, one block."""
    return list(mini_sessions(PoseEstimator.load("fish"), "other", N))


def test_a_mini_session_tells_the_build_of_the_animal_that_was_rendered(others):
    """The half width that is seen is the body's, but for what a sensor eats of an outline."""
    labels = np.stack([one.labels for one in others])
    width = np.exp(labels[:, -2 * len(PLACES) : -len(PLACES)])
    seen = np.stack([one.clues for one in others])[:, 9]  # near 0.4 of the length
    assert len(others) > 0.8 * N
    assert np.corrcoef(seen, width[:, 2])[0, 1] > 0.9


def test_bodies_are_drawn_again_as_the_block_shows_them():
    drawn = {"family": "wide", "per_session": PER_SESSION, "degraded_share": 0.5}
    species = FishSpecies()
    bodies = drawn_bodies(5, 0, species, **drawn)
    (block,) = training_blocks(5, 1, species, window_px=272, **drawn)
    assert isinstance(bodies, BodyShape)
    assert len(bodies) == N
    assert np.bincount(block.session).tolist() == [PER_SESSION] * N
    # what is read over a joint of the trunk is the skin of these very bodies, in the median
    j, skeleton = 6, species.skeleton
    joint = block.joints_mm[:, j]
    u, v = (
        np.rint(block.intrinsics[:, k] * joint[:, k] / joint[:, 2] + block.intrinsics[:, 2 + k])
        - block.origin[:, k]
        for k in range(2)
    )
    depth = block.depth[np.arange(BLOCK), v.astype(int), u.astype(int)] * block.unit_mm
    over = np.where((depth > 0) & (joint[:, 2] - depth < 12.0), joint[:, 2] - depth, np.nan)
    over = np.nanmedian(over.reshape(N, PER_SESSION), axis=1)
    stations = skeleton.surface["stations"]
    height = np.array([np.interp(j / 20, stations, one) for one in bodies.half_height])
    height *= block.spine_mm[::PER_SESSION] / skeleton.length
    assert np.corrcoef(over, height)[0, 1] > 0.9
    assert abs(np.median(over - height)) < 0.2


def test_the_bundled_shapes_make_the_error_of_unseen_builds_smaller(others):
    prior = ShapePrior.of("fish")
    assert prior is not None
    labels = np.stack([one.labels for one in others])
    left = labels - prior.predict(np.stack([one.clues for one in others]))
    before, after = (
        np.linalg.norm(one[:, : -2 * len(PLACES)].reshape(len(others), -1, 3), axis=-1).mean()
        for one in (labels, left)
    )
    assert after < 0.85 * before


def test_animals_that_are_no_tube_are_refused():
    with pytest.raises(LiexError, match="one chain with a tube"):
        list(mini_sessions(PoseEstimator.load("hand"), "wide", 1))
