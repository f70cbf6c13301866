"""What sessions of one animal agree on: a mean that no order of them changes."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from liex_lab.pipelines.study.shared_body import Inspection, agree, spread_of


def found(mm, *, stated=False, log_sd=0.0, n_frames=1, girth=1.0, factor=None, against=None, n=0):
    """A session; `factor` of a shape that it kept, `against` the residual of one it refused."""
    kept = factor is not None
    parts = {"width": [factor] * 5, "height": [factor] * 5, "joints_moved": [[factor] * 3]}
    shape = {"kept": kept, "n_frames": n, "residual_mm": against} | (parts if kept else {})
    animal = {"spine_mm": mm, "girth": girth, "shape": shape}
    about = {"log_sd": log_sd, "n_frames": n_frames, "stated": stated}
    return Inspection.model_validate({"animal": animal, **about})


FOUND = st.builds(
    found,
    st.floats(76.0, 82.0),
    log_sd=st.floats(0.0, 0.1),
    n_frames=st.integers(1, 100),
    girth=st.floats(0.75, 1.35),
    factor=st.none() | st.floats(0.5, 1.5),
    n=st.integers(50, 100),
)


@settings(max_examples=15)
@given(some=st.lists(FOUND, min_size=2, max_size=6), rng=st.randoms(use_true_random=False))
def test_the_order_of_the_sessions_changes_not_a_bit(some, rng):
    shuffled = list(some)
    rng.shuffle(shuffled)
    assert agree("m07", some) == agree("m07", shuffled)


@settings(max_examples=15)
@given(some=st.lists(FOUND, min_size=2, max_size=6))
def test_what_is_agreed_on_lies_between_what_was_found(some):
    agreed = agree("m07", some)
    lengths = [one.animal.spine_mm for one in some]
    assert min(lengths) - 1e-3 <= agreed.spine_mm <= max(lengths) + 1e-3
    kept = [one.animal.shape.width for one in some if one.animal.shape.kept]
    assert (agreed.shape is None) == (not kept)
    assert (agreed.girth is None) == bool(kept)
    if kept:
        assert np.all(agreed.shape.width >= np.min(kept, axis=0) - 1e-4)
        assert np.all(agreed.shape.width <= np.max(kept, axis=0) + 1e-4)


def by_hand(lengths: list[float], variances: list[float]) -> float:
    """The estimator of DerSimonian and Laird as a textbook prints it."""
    y, v = np.log(lengths), 1.0 / np.array(variances)
    q = np.sum(v * (y - np.sum(v * y) / np.sum(v)) ** 2)
    c = np.sum(v) - np.sum(v**2) / np.sum(v)
    between = max(0.0, (q - (len(y) - 1)) / c)
    w = 1.0 / (1.0 / v + between)
    return float(np.exp(np.sum(w * y) / np.sum(w)))


@settings(max_examples=15)
@given(some=st.lists(FOUND, min_size=2, max_size=6))
def test_the_length_is_the_random_effects_mean(some):
    variances = [max(one.log_sd**2 / one.n_frames, 1e-6) for one in some]
    wanted = by_hand([one.animal.spine_mm for one in some], variances)
    assert agree("m07", some).spine_mm == pytest.approx(wanted, abs=5.1e-4)


def test_a_length_that_is_stated_is_no_finding_and_the_shape_is_shared_all_the_same():
    stated = found(80.0, stated=True, factor=1.2, n=60)
    measured = found(82.0, factor=1.2, n=60)
    assert agree("m07", [stated, measured]).spine_mm == pytest.approx(82.0)
    agreed = agree("m07", [stated, stated])
    assert agreed.spine_mm is None
    assert agreed.shape.height == [1.2] * 5


@pytest.mark.parametrize(("n_for", "n_against", "is_shared"), [(60, 59, True), (60, 60, False)])
def test_a_shape_is_shared_where_more_frames_speak_for_one_than_against(
    n_for, n_against, is_shared
):
    own = found(80.0, factor=1.1, n=n_for)
    average = found(80.0, girth=1.2, against=2.0, n=n_against)
    unsure = found(80.0, girth=1.2, n=500)  # too few frames for a shape: no voice
    agreed = agree("m07", [own, average, unsure])
    assert (agreed.shape is not None) == is_shared
    assert agreed.girth == (None if is_shared else 1.2)


def test_shapes_count_by_the_frames_that_show_the_animal_well():
    shape = agree("m07", [found(80.0, factor=0.1, n=50), found(80.0, factor=0.4, n=100)]).shape
    assert (shape.width, shape.joints_moved) == ([0.3] * 5, [[0.3] * 3])


def test_the_spread_is_that_of_the_farthest_over_the_median():
    some = [found(mm) for mm in (79.0, 80.0, 86.0)]
    assert spread_of(some) == pytest.approx(7.0 / 80.0)
