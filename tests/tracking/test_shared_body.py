"""What sessions of one animal agree on: a mean that no order of them changes."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from liex_lab.tracking.own_shape import SessionBody, agree, spread_of

FOUND = st.builds(
    SessionBody,
    spine_mm=st.floats(76.0, 82.0),
    stated=st.just(False),
    log_sd=st.floats(0.0, 0.1),
    n_frames=st.integers(1, 100),
    girth=st.floats(0.75, 1.35),
    shape=st.none() | st.lists(st.floats(-0.5, 0.5), min_size=13, max_size=13).map(np.array),
    refused=st.just(False),
    n_good_frames=st.integers(50, 100),
)


@settings(max_examples=15)
@given(found=st.lists(FOUND, min_size=2, max_size=6), rng=st.randoms(use_true_random=False))
def test_the_order_of_the_sessions_changes_not_a_bit(found, rng):
    shuffled = list(found)
    rng.shuffle(shuffled)
    one, other = agree(found), agree(shuffled)
    assert (one.spine_mm, one.girth) == (other.spine_mm, other.girth)
    assert (one.shape is None) == (other.shape is None)
    if one.shape is not None and other.shape is not None:
        np.testing.assert_array_equal(one.shape, other.shape)


@settings(max_examples=15)
@given(found=st.lists(FOUND, min_size=2, max_size=6))
def test_what_is_agreed_on_lies_between_what_was_found(found):
    agreed = agree(found)
    lengths = [one.spine_mm for one in found]
    assert min(lengths) - 1e-9 <= agreed.spine_mm <= max(lengths) + 1e-9
    kept = [one.shape for one in found if one.shape is not None]
    assert (agreed.shape is None) == (not kept)
    assert (agreed.girth is None) == bool(kept)
    if kept:
        assert np.all(agreed.shape >= np.min(kept, axis=0) - 1e-12)
        assert np.all(agreed.shape <= np.max(kept, axis=0) + 1e-12)


def by_hand(lengths: list[float], variances: list[float]) -> float:
    """The estimator of DerSimonian and Laird as a textbook prints it."""
    y, v = np.log(lengths), 1.0 / np.array(variances)
    q = np.sum(v * (y - np.sum(v * y) / np.sum(v)) ** 2)
    c = np.sum(v) - np.sum(v**2) / np.sum(v)
    between = max(0.0, (q - (len(y) - 1)) / c)
    w = 1.0 / (1.0 / v + between)
    return float(np.exp(np.sum(w * y) / np.sum(w)))


@settings(max_examples=15)
@given(found=st.lists(FOUND, min_size=2, max_size=6))
def test_the_length_is_the_random_effects_mean(found):
    variances = [max(one.log_sd**2 / one.n_frames, 1e-6) for one in found]
    wanted = by_hand([one.spine_mm for one in found], variances)
    assert agree(found).spine_mm == pytest.approx(wanted, rel=1e-9)


def length_of(*found: SessionBody) -> float:
    length = agree(found).spine_mm
    assert length is not None
    return length


def shape_of(*found: SessionBody) -> np.ndarray:
    shape = agree(found).shape
    assert shape is not None
    return shape


@pytest.mark.parametrize(
    ("lengths", "log_sd", "frames", "shares"),
    [((80.0, 81.0), 0.1, (10, 90), (0.1, 0.9)), ((78.0, 82.0), 0.01, (10, 100), (0.5, 0.5))],
)
def test_sessions_count_by_their_frames_unless_they_differ_by_more_than_their_scatter(
    lengths, log_sd, frames, shares
):
    """Ten times the frames make a session no better witness of what differs between sessions."""
    few, many = (
        SessionBody(mm, log_sd=log_sd, n_frames=n) for mm, n in zip(lengths, frames, strict=True)
    )
    wanted = np.exp(np.dot(shares, np.log(lengths)))
    assert length_of(few, many) == pytest.approx(wanted, rel=1e-4)


def test_a_length_that_is_stated_is_no_finding_and_the_shape_is_shared_all_the_same():
    shape = np.full(13, 0.2)
    stated = SessionBody(80.0, stated=True, shape=shape, n_good_frames=60)
    measured = SessionBody(82.0, shape=shape, n_good_frames=60)
    assert length_of(stated, measured) == pytest.approx(82.0)
    assert agree([stated, stated]).spine_mm is None
    np.testing.assert_allclose(shape_of(stated, stated), shape)


@pytest.mark.parametrize(("n_for", "n_against", "is_shared"), [(60, 59, True), (60, 60, False)])
def test_a_shape_is_shared_where_more_frames_speak_for_one_than_against(
    n_for, n_against, is_shared
):
    own = SessionBody(80.0, shape=np.full(13, 0.1), n_good_frames=n_for)
    average = SessionBody(80.0, girth=1.2, refused=True, n_good_frames=n_against)
    unsure = SessionBody(80.0, girth=1.2, n_good_frames=500)  # too few frames for a shape: no voice
    agreed = agree([own, average, unsure])
    assert (agreed.shape is not None) == is_shared
    assert agreed.girth == (None if is_shared else pytest.approx(1.2))


def test_shapes_count_by_the_frames_that_show_the_animal_well():
    one = SessionBody(80.0, shape=np.full(13, 0.1), n_good_frames=50)
    other = replace(one, shape=np.full(13, 0.4), n_good_frames=100)
    np.testing.assert_allclose(shape_of(one, other), 0.3)


def test_the_spread_is_that_of_the_farthest_over_the_median():
    found = [SessionBody(mm) for mm in (79.0, 80.0, 86.0)]
    assert spread_of(found) == pytest.approx(7.0 / 80.0)
