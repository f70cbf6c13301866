"""Many workers, simulated from the times of few: laws that hold for any times."""

from __future__ import annotations

import pytest
from liex_lab.pipelines.evaluation.scale import simulate


def test_workers_gain_until_the_scheduler_is_the_limit() -> None:
    found = simulate([100.0, 120.0], scheduler_s=0.5, workers=(1, 2, 10, 1000))
    assert found["1"] == pytest.approx(3600 / 110.5, rel=0.02)
    assert found["2"] == pytest.approx(2 * found["1"], rel=0.02)
    assert found["10"] == pytest.approx(10 * found["1"], rel=0.05)
    assert found["1000"] <= 3600 / 0.5


def test_without_cost_of_handing_out_many_workers_are_as_good_as_they_are_many() -> None:
    found = simulate([60.0], scheduler_s=0.0, workers=(1, 1000))
    assert found["1000"] == pytest.approx(1000 * found["1"], rel=0.01)
