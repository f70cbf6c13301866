"""Shapes are learned from mini-sessions of known animals, the same whenever they are drawn."""

from types import SimpleNamespace

import numpy as np
import pytest
from liex_lab.pipelines.training import shape_model
from liex_lab.pipelines.training.shape_model import PER_SESSION, MiniSession, mini_sessions

from liex_lab.body.skeleton import Skeleton
from liex_lab.errors import LiexError
from liex_lab.estimation.estimator import PoseEstimator
from liex_lab.estimation.session_shape import PLACES, ShapePrior
from liex_lab.simulation import training_patches
from liex_lab.simulation.training_patches import BLOCK

N = BLOCK // PER_SESSION


@pytest.fixture(scope="module")
def others() -> list[MiniSession]:
    """Fish of builds that neither forests nor shapes were learned from, one block."""
    return list(mini_sessions(PoseEstimator.load("fish"), "other", N))


def test_mini_sessions_are_measured_the_same_every_time(monkeypatch):
    monkeypatch.setattr(training_patches, "BLOCK", 3 * PER_SESSION)
    one, two = (list(mini_sessions(PoseEstimator.load("fish"), "other", 3)) for _ in range(2))
    assert 1 <= len(one) <= 3
    for first, second in zip(one, two, strict=True):
        for part, again in zip(first, second, strict=True):
            assert np.isfinite(part).all()
            np.testing.assert_array_equal(part, again)


def test_a_prior_is_written_the_same_every_time(tmp_path, monkeypatch):
    rng = np.random.default_rng(0)
    labels = rng.normal(0.0, 0.1, (60, 3 * 21 + 2 * len(PLACES)))
    clues = labels[:, :14] + rng.normal(0.0, 0.01, (60, 14))
    rows = list(zip(clues, labels, strict=True))
    monkeypatch.setattr(shape_model, "mini_sessions", lambda *_: rows)
    one, two = (shape_model.train_shape("fish", tmp_path / f"{k}.npz") for k in (1, 2))
    assert one.read_bytes() == two.read_bytes()
    prior = ShapePrior.load(one)
    assert np.abs(labels - prior.predict(clues))[:, :14].mean() < 0.03
    assert max(prior.unseen) < 0.2


@pytest.mark.nightly
def test_a_mini_session_tells_the_build_of_the_animal_that_was_rendered(others):
    """The half width that is seen is the body's, but for what a sensor eats of an outline."""
    seen, labels = (np.stack(part) for part in zip(*others, strict=True))
    width = np.exp(labels[:, -2 * len(PLACES) : -len(PLACES)])
    assert len(others) > 0.8 * N
    assert np.corrcoef(seen[:, 9], width[:, 2])[0, 1] > 0.9  # near 0.4 of the length


@pytest.mark.nightly
def test_the_bundled_shapes_make_the_error_of_unseen_builds_smaller(others):
    prior = ShapePrior.of("fish")
    assert prior is not None
    clues, labels = (np.stack(part) for part in zip(*others, strict=True))
    left = labels - prior.predict(clues)
    before, after = (
        np.linalg.norm(one[:, : -2 * len(PLACES)].reshape(len(others), -1, 3), axis=-1).mean()
        for one in (labels, left)
    )
    assert after < 0.85 * before


def test_animals_that_are_no_tube_are_refused():
    with pytest.raises(LiexError, match="one chain with a tube"):
        list(mini_sessions(SimpleNamespace(skeleton=Skeleton.load("hand")), "wide", 1))
