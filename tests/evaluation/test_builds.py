"""Figures of tracks of other builds are what was put into made-up tracks."""

from __future__ import annotations

import numpy as np
import pytest

from liex_lab.body.skeleton import Skeleton
from liex_lab.evaluation.builds import Built, build_figures
from liex_lab.tracking.track import Track

MOUSE = Skeleton.load("mouse")
N = 400
LENGTH_MM = 60.0


def made(seed: int, sd_mm: float = 1.0, up_mm: float = 0.0, told: float = 1.0) -> Built:
    """A track whose errors are Gaussian and whose heights are off throughout."""
    rng = np.random.default_rng(seed)
    truth = np.cumsum(rng.normal(size=(N, MOUSE.n_joints, 3)), axis=0) * 0.1
    truth += np.arange(MOUSE.n_joints)[:, None] * [15.0, 0.0, 0.0]
    track = Track.empty(MOUSE, np.arange(N) * 33_000_000, "")
    track.joints_mm[:] = truth + rng.normal(0.0, sd_mm, truth.shape) + [0.0, 0.0, up_mm]
    for column in (track.sd_mm, track.sd_xy_mm, track.sd_z_mm):
        column[:] = told * sd_mm
    off = np.linalg.norm(track.joints_mm - truth, axis=-1).mean(axis=1)
    track.predicted_error_mm[:] = off + rng.normal(0.0, 0.1, N)
    track.p_flip[:] = 0.02
    return Built(track, truth, LENGTH_MM, 1.03 * LENGTH_MM, MOUSE.tip)


def test_honest_tracks_hold_nine_in_ten_and_others_fewer_or_more() -> None:
    honest = build_figures([made(1), made(2)], MOUSE.names)
    assert honest["interval90"] == pytest.approx(0.9, abs=0.01)
    assert honest["interval90_least"] == min(honest["interval90_by_joint"].values()) > 0.85
    assert build_figures([made(1, told=0.5)], MOUSE.names)["interval90"] < 0.65
    too_high = build_figures([made(1, up_mm=3.0), made(2, up_mm=-3.0)], MOUSE.names)
    assert too_high["interval90_z"] < 0.3 < 0.85 < too_high["interval90_x_y"]
    assert too_high["height_off_mm"] == pytest.approx(3.0, abs=0.1)
    assert too_high["height_bias_mm"] == pytest.approx(0.0, abs=0.1)


def test_errors_are_of_the_length_with_an_interval_over_recordings() -> None:
    figures = build_figures([made(k, sd_mm=1.0 + k) for k in range(4)], MOUSE.names)
    low, high = figures["error_percent95"]
    assert low < figures["error_percent"] < high
    assert figures["error_percent"] == pytest.approx(
        100.0 * figures["mean_joint_error_mm"] / LENGTH_MM
    )
    assert figures["spearman"] > 0.9
    assert figures["length_off"] == pytest.approx(0.03)
    assert figures["found"] == 1.0


def test_exchanged_ends_are_counted_in_a_row_and_by_what_was_told() -> None:
    row = made(3)
    turned = slice(100, 105)
    row.track.joints_mm[turned] = row.truth[turned][:, ::-1]
    row.track.p_flip[turned] = 0.9
    figures = build_figures([row, made(4)], MOUSE.names)
    assert figures["longest_flip"] == 5
    assert figures["flips"] == pytest.approx(5 / (2 * N))
    assert [(c["n"], c["flipped"]) for c in figures["p_flip"]] == [(2 * N - 5, 0.0), (5, 1.0)]
    assert figures["wrong_but_trusted"] == pytest.approx(5 / (2 * N))
    row.track.flag[turned] = "doubtful"
    assert build_figures([row], MOUSE.names)["wrong_but_trusted"] == 0.0


def test_a_recording_in_which_nothing_was_found_counts_as_not_found() -> None:
    nothing = Track.empty(MOUSE, np.arange(N) * 33_000_000)
    lost = Built(nothing, made(1).truth, LENGTH_MM, np.nan, MOUSE.tip)
    assert build_figures([made(1), lost], MOUSE.names)["found"] == 0.5
    assert build_figures([lost], MOUSE.names) == {"n_recordings": 1, "n_frames": N, "found": 0.0}
