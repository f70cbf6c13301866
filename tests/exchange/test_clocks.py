"""Two trains of events give the map between their clocks, or are refused."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from liex_lab.exchange.clocks import SyncError, align, align_pairs

RNG = np.random.default_rng(5)
TRAIN = np.cumsum(RNG.uniform(0.5, 1.5, 300))
REGULAR = np.arange(300) * 0.5


def other_clock(times: Any) -> Any:
    return 7000.0 + 1.0001 * np.asarray(times)


def test_an_exact_train_is_recovered() -> None:
    found = align(TRAIN, other_clock(TRAIN))
    moments = np.linspace(-50.0, 400.0, 20)
    np.testing.assert_allclose(found.clock(moments), other_clock(moments), atol=1e-8)
    np.testing.assert_array_equal(found.pairs.T, np.tile(np.arange(300), (2, 1)))
    assert found.share == 1.0
    assert (found.clock.sd(moments) < 0.01).all()


@settings(max_examples=10)
@given(seed=st.integers(0, 2**31), shift=st.floats(-1e5, 1e5))
def test_lost_and_further_events_and_another_zero_do_not_move_the_map(
    seed: int, shift: float
) -> None:
    rng = np.random.default_rng(seed)
    ours, others = (np.delete(TRAIN, rng.choice(300, rng.integers(60), False)) for _ in range(2))
    ours = np.sort(np.append(ours, rng.uniform(0.0, TRAIN[-1], rng.integers(20))))
    others = np.sort(np.append(others, rng.uniform(0.0, TRAIN[-1], rng.integers(20))))
    found = align(ours, other_clock(others) + shift)
    assert np.abs(found.clock(TRAIN) - other_clock(TRAIN) - shift).max() < 1e-3
    again = align(ours + 40.0, other_clock(others))
    np.testing.assert_allclose(again.clock(TRAIN + 40.0) + shift, found.clock(TRAIN), atol=1e-4)


def test_a_drift_that_varies_is_followed() -> None:
    times = np.cumsum(RNG.uniform(0.5, 1.5, 3600))
    drift = 0.01 * np.sin(times / 400.0)  # up to 25 ppm
    found = align(times, times + drift + RNG.normal(0.0, 5e-4, len(times)))
    assert len(found.clock.own_s) > 3
    assert np.abs(found.clock(times) - times - drift).max() < 1e-3


def test_a_regular_train_is_refused_unless_a_pair_is_stated() -> None:
    lossy = np.delete(REGULAR, RNG.choice(300, 20, False))
    for ours, others in ((REGULAR, REGULAR), (lossy, REGULAR), (REGULAR[:-40], lossy)):
        with pytest.raises(SyncError, match=r"in more than one way: .* if shifted by"):
            align(ours, other_clock(others))
    found = align(REGULAR, other_clock(lossy), [(10.1, other_clock(10.0))])
    np.testing.assert_allclose(found.clock(REGULAR), other_clock(REGULAR), atol=1e-6)


def test_missing_events_that_both_sides_miss_decide_a_regular_train() -> None:
    kept = np.delete(REGULAR, RNG.choice(300, 40, False))
    found = align(kept, other_clock(kept[:200]))
    np.testing.assert_allclose(found.clock(kept), other_clock(kept), atol=1e-6)


def test_stated_pairs_alone_give_a_line() -> None:
    found = align_pairs([(0.0, 10.0), (100.0, 110.01), (200.0, 210.02)])
    np.testing.assert_allclose(found.clock([50.0, 150.0]), [60.005, 160.015])
    assert np.isnan(align_pairs([(0.0, 10.0), (100.0, 110.0)]).clock.sd_s).all()


JUMPED_BY_ONE = np.append(TRAIN[:200], TRAIN[-1] + REGULAR + 0.2)


@pytest.mark.parametrize("jump", [3.21, -0.4, 80.0])
@pytest.mark.parametrize("at", [60.0, 150.0, 240.0])
def test_a_clock_that_jumps_is_aligned_in_parts(at: float, jump: float) -> None:
    kept = np.delete(TRAIN, RNG.choice(300, 20, False))
    theirs = np.where(kept > at, kept + jump, kept) + RNG.normal(0.0, 3e-4, len(kept))
    found = align(TRAIN, np.unique(theirs))
    assert len(found.clock.breaks) == 1
    moments = np.linspace(0.0, 300.0, 3000)
    mapped = found.clock(moments)
    known = np.isfinite(mapped)
    wanted = np.where(moments > at, moments + jump, moments)
    np.testing.assert_allclose(mapped[known], wanted[known], atol=1e-3)
    assert 0 < (~known).mean() < 0.05
    assert np.abs(moments[~known] - at).max() < 12.0
    np.testing.assert_array_equal(np.isnan(found.clock.sd(moments)), ~known)


def test_two_jumps_and_lost_time_are_three_parts() -> None:
    times = np.cumsum(RNG.uniform(0.5, 1.5, 600))
    theirs = times + np.where(times > 150.0, 30.0, 0.0) - np.where(times > 400.0, 0.35, 0.0)
    clock = align(times, np.unique(theirs)).clock
    assert len(clock.breaks) == 2
    np.testing.assert_allclose(clock([100.0, 300.0, 500.0]), [100.0, 330.0, 529.65], atol=1e-6)


@pytest.mark.parametrize(
    ("ours", "others", "sentence"),
    [
        (TRAIN, np.cumsum(RNG.uniform(0.5, 1.5, 300)), "fit nowhere|more than one way"),
        (np.append(TRAIN[:200], TRAIN[-1] + REGULAR), JUMPED_BY_ONE, "in more than one way"),
        (TRAIN, [], "the other file holds no event"),
        (TRAIN, TRAIN * 1e3, "may be milliseconds: divide them by 1000"),
        (TRAIN, TRAIN * 3e4, "may be samples"),
        (TRAIN * 1e3, TRAIN, "advance 0.001 times as fast"),
        (TRAIN, np.append(TRAIN[:9], np.nan), r"event 10 of the other file has no time"),
        (TRAIN, TRAIN[::-1], "go back after event 1: the clock was set"),
        (TRAIN, TRAIN[:5], "by 8 events or more on both sides, got 300 and 5"),
    ],
)
def test_what_cannot_be_aligned_is_refused_in_one_sentence(
    ours: np.ndarray, others: np.ndarray, sentence: str
) -> None:
    with pytest.raises(SyncError, match=sentence) as found:
        align(ours, others)
    assert "\n" not in str(found.value)


@pytest.mark.parametrize(
    ("pairs", "sentence"),
    [
        ([(0.0, 1.0)], "two distinct moments or more"),
        ([(0.0, 1.0), (100.0, 102.0)], "rates differ by 1.0%"),
        ([(0.0, 1.0), (100.0, 1e5)], "may be milliseconds"),
        ([(0.0, 1.0), (np.nan, 2.0)], "event 2 of the pairs has no time"),
    ],
)
def test_pairs_that_give_no_clock_are_refused(
    pairs: list[tuple[float, float]], sentence: str
) -> None:
    with pytest.raises(SyncError, match=sentence):
        align_pairs(pairs)
