"""Transitions between actions: their test of chance is SciPy's exact binomial test."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
from scipy.stats import binomtest

from liex_lab.behaviour.activity import _binomial


@pytest.mark.parametrize("total", [1, 2, 7, 60, 3000])
def test_the_exact_binomial_test_is_that_of_scipy(total: int) -> None:
    rng = np.random.default_rng(total)
    for chance in (0.5, 0.02, 1.0 / 3.0, 0.97):
        for n in {0, total, *rng.integers(0, total + 1, 8).tolist()}:
            expected = binomtest(n, total, chance).pvalue
            assert _binomial(n, total, chance) == pytest.approx(expected, rel=1e-9, abs=1e-300)


def test_where_chance_leaves_no_choice_there_is_no_p() -> None:
    assert np.isnan(_binomial(0, 0, 0.5))
    assert np.isnan(_binomial(3, 5, 1.0))


def test_a_run_does_without_the_statistics_of_scipy() -> None:
    """They take longer to import than all poses of a second take to measure."""
    code = (
        "import sys, tempfile;"
        "from liex_lab.api import run_session;"
        "from liex_lab.plan import Plan;"
        "run_session('synthetic:walk?seed=3&frames=40&sensor=primesense-qvga&spine_mm=70',"
        " Plan.load('mouse'), tempfile.mkdtemp());"
        "assert 'scipy.stats' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=300)
