"""Intervals by bootstrap over recordings."""

from __future__ import annotations

import numpy as np
import pytest

from liex_lab.evaluation.bootstrap import interval95


def test_the_interval_of_a_mean_holds_the_truth_about_as_often_as_it_says():
    held = 0
    rng = np.random.default_rng(4)
    for _ in range(60):
        of_recording = rng.normal(3.0, 0.8, 40)
        recording = np.repeat(np.arange(40), 20)
        error = of_recording[recording] + rng.normal(0.0, 0.3, len(recording))
        low, high = interval95(error, recording, np.mean, 300) or (0.0, 0.0)
        held += low <= 3.0 <= high
    assert held / 60 == pytest.approx(0.95, abs=0.08)


def test_frames_of_one_recording_do_not_count_as_many_animals():
    rng = np.random.default_rng(5)
    recording = np.repeat(np.arange(10), 100)
    error = rng.normal(0.0, 1.0, 10)[recording] + rng.normal(0.0, 0.01, 1000)
    low, high = interval95(error, recording, np.mean) or (0.0, 0.0)
    assert high - low > 0.6  # of 1000 independent frames it were 0.12


def test_lost_frames_are_left_out_and_one_recording_has_no_interval():
    recording = np.array([0, 0, 1, 1])
    error = np.array([1.0, np.nan, 2.0, np.nan])
    assert interval95(error, recording) == (1.0, 2.0)
    assert interval95(error[:2], recording[:2]) is None
