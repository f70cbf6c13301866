"""`liex evaluate tracking`: every row over a sequence, handled as a recording would be, and the
picture of it.
"""

from itertools import pairwise
from unittest.mock import patch

import numpy as np
import pytest
from liex_lab.dashboards.paper.figures import worst_moments
from liex_lab.pipelines.evaluation import tracking
from liex_lab.pipelines.evaluation.tracking import PAPER_ROWS, ROWS, _pattern_search, comparison

from liex_lab.estimation.estimator import PoseEstimator
from liex_lab.runtime.progress import silent
from liex_lab.tracking import particles
from liex_lab.tracking.particles import ProcessNoise
from tests.estimation.toy import trained


@pytest.mark.slow
def test_the_smoothed_track_is_better_than_its_frames_and_the_paper_s_algorithms_are_compared(
    tmp_path, monkeypatch
):
    """With a small model of the paper's variant: both readings of Algorithm 3, and a sentence."""
    paper, own = PoseEstimator(trained("paper").model), PoseEstimator.load("mouse")
    monkeypatch.setattr(
        tracking, "estimator_of", lambda animal, variant, *_: paper if variant == "paper" else own
    )
    monkeypatch.setattr(tracking, "_AGAIN", 1)
    figure = tmp_path / "figure.png"
    result = tracking.evaluate_tracking(
        "mouse", "hard", seed=21, n_frames=40, paper=True, figure=figure
    )
    rows = result["rows"]
    assert list(rows) == list(ROWS) == list(result["row_names"])
    single, smoothed = rows["single"], rows["smoothed"]
    for name in ("p95_joint_error_mm", "interval90_coverage", "recovery_frames", "frames_per_s"):
        assert name in smoothed
    assert single["ratio_to_single"] == rows["algorithm1_paper"]["ratio_to_single"] == 1.0
    assert smoothed["ratio_to_single"] < 1.0
    assert smoothed["longest_flip_frames"] <= 5
    assert result["speed"]["frames_per_s_1core"] > 0 < result["speed"]["frames_per_s_all_cores"]
    (note,) = result["notes"]
    assert "8.42 to 7.19 mm" in note
    for row in PAPER_ROWS:
        assert f"{rows[row]['mean_joint_error_mm']:.2f}" in note
    assert figure.read_bytes().startswith(b"\x89PNG")


def test_whether_the_paper_s_gain_is_seen_follows_from_the_numbers():
    def told(*errors: float) -> str:
        return comparison(
            {
                row: {"mean_joint_error_mm": error, "ratio_to_single": error / errors[0]}
                for row, error in zip(PAPER_ROWS, errors, strict=True)
            },
            "mouse",
        )

    assert "is not reproduced here" in told(4.0, 9.0, 4.4)
    assert "gain is reproduced here" in told(4.0, 9.0, 3.6)
    assert "9.00 mm with no base rounds (ratio 2.25)" in told(4.0, 9.0, 3.6)
    assert "3.60 mm with 1 base round (ratio 0.90)" in told(4.0, 9.0, 3.6)
    lost = {row: {"lost_rate": 1.0} for row in PAPER_ROWS}
    lost[PAPER_ROWS[0]] = {"mean_joint_error_mm": 4.0}
    assert "is not reproduced" in comparison(lost, "mouse")


def test_noise_that_nobody_searched_is_not_said_to_be_searched():
    rows = {row: {"mean_joint_error_mm": 4.0, "ratio_to_single": 1.0} for row in PAPER_ROWS}
    found = {("mouse", "paper", n): ProcessNoise(sigma_mm=3.0) for n in (0, 1)}
    for known in ({}, dict(list(found.items())[:1])):
        with patch.dict(particles.SEARCHED, known, clear=True):
            assert "set by hand and was not searched" in comparison(rows, "mouse")
    with patch.dict(particles.SEARCHED, found, clear=True):
        assert "was searched on other sequences" in comparison(rows, "mouse")
        assert ProcessNoise.of("mouse", "paper", 1) == ProcessNoise(sigma_mm=3.0)
        assert "set by hand" in comparison(rows, "fish")


def test_the_noise_is_searched_downhill_and_no_setting_is_tried_twice():
    asked: list[ProcessNoise] = []

    def error_of(noise: ProcessNoise) -> float:
        asked.append(noise)
        return abs(np.log(noise.turn_rad / 0.04)) + abs(np.log(noise.sigma_mm / 4.0))

    tried = _pattern_search(ProcessNoise(), error_of, "x", silent)
    best = min(tried, key=lambda noise: tried[noise])
    assert len(asked) == len(set(asked)) == len(tried)
    assert (best.turn_rad, best.shift_mm, best.sigma_mm) == (0.0375, 4.0, 4.0)


def test_the_worst_moments_lie_apart():
    error = np.ones(200)
    error[[50, 52, 120]] = [9.0, 8.0, 7.0]
    error[60] = np.nan
    moments = worst_moments(error)
    assert {50, 120} <= set(moments)
    assert 52 not in moments
    assert all(b - a >= 12 for a, b in pairwise(moments))
