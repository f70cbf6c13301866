"""Acted recordings: measured once, kept by recording, tracked anew, and thinned out before they are
tracked.
"""

from pathlib import Path

import numpy as np
import pytest
from liex_lab.dashboards.paper.figures import draw_confusions
from liex_lab.pipelines.evaluation.actions import track_error_mm
from liex_lab.pipelines.training import action_model as module
from liex_lab.pipelines.training.action_model import AgentTrack, Scenario, acted, thinned

from liex_lab.estimation.estimator import PoseEstimator

CUT = Scenario("fish", 91, 5, 50.0, word="c_turn")
RECORDING = Scenario("mouse", 92, 5, 30.0, seconds=4.0, filmed_s=1.5)


@pytest.fixture(scope="module", autouse=True)
def cache(tmp_path_factory: pytest.TempPathFactory):
    with pytest.MonkeyPatch.context() as patched:
        patched.setenv("LIEX_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.fixture(scope="module")
def cut() -> AgentTrack:
    return acted([CUT], PoseEstimator.load("fish"))[0]


@pytest.fixture(scope="module")
def recording() -> AgentTrack:
    return acted([RECORDING], PoseEstimator.load("mouse"))[0]


def test_a_cut_out_action_is_tracked_with_what_lies_around_it(cut: AgentTrack) -> None:
    one = cut.tracked()
    assert set(one.words) == {"c_turn"}
    assert len(one) < len(cut.words)
    assert one.track.posed.mean() > 0.8
    assert track_error_mm([one]) < 3.0


@pytest.mark.nightly
def test_only_the_beginning_is_filmed_and_a_slower_camera_has_fewer_frames(
    recording: AgentTrack,
) -> None:
    usual, slower = recording.tracked(), recording.tracked(15.0)
    assert usual.track.times_ns[-1] == pytest.approx(1.5e9, abs=4e7)
    assert len(slower) == pytest.approx(len(usual) / 2, abs=1)
    assert set(slower.track.times_ns) <= set(usual.track.times_ns)
    assert track_error_mm([slower]) < 12.0


def test_what_was_measured_is_not_measured_again(
    cut: AgentTrack, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "act", None)
    again = acted([CUT], PoseEstimator.load("fish"))[0]
    np.testing.assert_array_equal(again.tracked().track.joints_mm, cut.tracked().track.joints_mm)


def test_a_slower_camera_sees_the_frames_nearest_to_its_times() -> None:
    times = np.round(np.arange(60) / 50.0 * 1e9).astype(np.int64)
    rows = thinned(times, 30.0)
    wanted = np.arange(0.0, times[-1] * 1e-9, 1.0 / 30.0)
    by_hand = sorted({min(range(60), key=lambda k: (abs(times[k] * 1e-9 - t), k)) for t in wanted})
    np.testing.assert_array_equal(rows, by_hand)


def test_the_confusions_are_drawn_as_a_picture(tmp_path: Path) -> None:
    matrix, shares = [[3, 1], [0, 4]], ("tangent", "joints", "default")
    result = {
        "confusion": {"words": ["c_turn", "scoot"], **dict.fromkeys(shares, matrix)},
        "accuracy_interval95": dict.fromkeys(shares, (0.5, 0.98)),
        "tangent_accuracy": 0.875,
        "joint_accuracy": 0.875,
        "default_accuracy": 0.875,
    }
    assert draw_confusions(result, tmp_path / "new" / "fig20.png").read_bytes()[:4] == b"\x89PNG"
