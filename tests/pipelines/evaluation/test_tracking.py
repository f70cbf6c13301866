"""`liex evaluate tracking`: every row over a sequence, handled as a recording would be, and the
picture of it.
"""

from __future__ import annotations

from functools import partial
from itertools import pairwise

import numpy as np
import pytest
from liex_lab.dashboards.paper.tracking import draw_tracking, worst_moments
from liex_lab.pipelines.evaluation.tracking import evaluate_tracking

ROWS = ("single", "online", "smoothed")
FIGURES = {
    "mean_joint_error_mm",
    "p95_joint_error_mm",
    "longest_flip_frames",
    "interval90_coverage",
    "recovery_frames",
    "frames_per_s",
}


@pytest.mark.slow
def test_the_smoothed_track_is_better_than_its_frames(tmp_path):
    picture = tmp_path / "figure.png"
    draw = partial(draw_tracking, path=picture)
    result = evaluate_tracking("mouse", "hard", rows=ROWS, seeds=(21,), n_frames=120, draw=draw)
    assert list(result["rows"]) == list(ROWS)
    for row in result["rows"].values():
        assert set(row) >= FIGURES
    single, smoothed = result["rows"]["single"], result["rows"]["smoothed"]
    assert single["ratio_to_single"] == 1.0
    assert smoothed["ratio_to_single"] < 0.9
    assert smoothed["longest_flip_frames"] <= 5
    assert result["speed"]["frames_per_s_1core"] > 0 < result["speed"]["frames_per_s_all_cores"]
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_the_worst_moments_lie_apart():
    error = np.ones(200)
    error[[50, 52, 120]] = [9.0, 8.0, 7.0]
    error[60] = np.nan
    moments = worst_moments(error)
    assert {50, 120} <= set(moments)
    assert 52 not in moments
    assert all(b - a >= 12 for a, b in pairwise(moments))
