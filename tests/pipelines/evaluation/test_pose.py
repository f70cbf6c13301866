"""`liex evaluate`: the names of its numbers are an interface, and known offsets come out as they
went in.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from liex_lab.pipelines.evaluation import pose, speed

from liex_lab.errors import LiexError
from liex_lab.estimation.estimator import PoseEstimator
from liex_lab.plan import Plan
from liex_lab.runtime.progress import Progress, silent
from liex_lab.simulation import recording
from liex_lab.simulation.recording import SyntheticSession
from liex_lab.simulation.species import PRIMESENSE_QVGA_SENSOR, PRIMESENSE_SENSOR
from liex_lab.tracking.track import Track
from tests.estimation.toy import trained
from tests.sessions import walking_mouse
from tests.sessions.walking_mouse import FLOOR_MM, SMALL, SPINE_MM, WalkingMouse, steady

POSE_KEYS = [
    "animal",
    "split",
    "variant",
    "n_frames",
    "mean_joint_error_mm",
    "median_joint_error_mm",
    "p95_joint_error_mm",
    "flip_rate",
    "lost_rate",
    "spearman_predicted_error",
    "interval90_coverage",
    "protocol",
]
SPEED_KEYS = {
    "animal",
    "frames_per_s_1core",
    "frames_per_s_2cores",
    "ratio_to_paper",
    "stages_ms",
    "machine",
}
LEFT_OUT = (5, 17)  # frames of the hand-made session without a pose
TURNED = (10, 13)  # from when to when nose and rump are exchanged in it


# rendered splits, measured with a toy model: the numbers are poor, their names are not


def toy_estimator(animal: str, variant: str, progress: Progress = silent) -> PoseEstimator:
    return PoseEstimator(trained(variant).model)


@pytest.fixture
def small_world(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Two recordings of 10 small frames stand for every split, toy models for every variant; what
    was asked for.
    """
    asked: list[str] = []

    def small_split(
        name: str, spine_mm: float | None = None, n_sessions: int = 2, *_: Any
    ) -> list[SyntheticSession]:
        asked.append(f"{name} {spine_mm}")
        return [
            SyntheticSession.draw(
                [5, k], 10, sensor=PRIMESENSE_QVGA_SENSOR, spine_mm=spine_mm, name=f"{name}-{k}"
            )
            for k in range(min(n_sessions, 2))
        ]

    monkeypatch.setattr(recording, "test_split", small_split)
    monkeypatch.setattr(pose, "estimator_of", toy_estimator)
    return asked


@pytest.mark.parametrize(("split", "variant"), [("clean", "default"), ("hard", "paper")])
def test_the_numbers_of_evaluate_pose_are_called_as_they_have_always_been(
    small_world, split, variant
):
    told: list[str] = []
    result = pose.evaluate_pose(
        "mouse", split, variant, progress=lambda done, total, what: told.append(what)
    )
    assert list(result) == POSE_KEYS
    assert (result["animal"], result["split"], result["variant"]) == ("mouse", split, variant)
    assert result["n_frames"] == 20
    assert small_world == [f"{split} None"]
    assert told == [f"measuring {split}-0", f"measuring {split}-1"]
    for name in POSE_KEYS[4:11]:
        assert isinstance(result[name], float)
        assert np.isfinite(result[name])
    assert 0.0 < result["median_joint_error_mm"] <= result["p95_joint_error_mm"]
    for name in ("flip_rate", "lost_rate", "interval90_coverage"):
        assert 0.0 <= result[name] <= 1.0
    assert "nothing is handed over" in result["protocol"]
    assert json.loads(json.dumps(result, allow_nan=False)) == result


def test_evaluating_twice_gives_the_same_numbers_and_fewer_frames_take_whole_recordings(
    small_world,
):
    once, twice = (pose.evaluate_pose("mouse") for _ in range(2))
    assert once == twice
    assert pose.evaluate_pose("mouse", n_frames=10)["n_frames"] == 10
    assert pose.evaluate_pose("mouse", n_frames=11)["n_frames"] == 20


def test_a_split_that_does_not_exist_is_refused_before_a_model_is_trained(monkeypatch):
    monkeypatch.setattr(pose, "estimator_of", lambda *_: pytest.fail("a model was asked for"))
    with pytest.raises(LiexError, match="no split 'claen'"):
        pose.evaluate_pose("mouse", "claen", "paper")


def test_a_variant_that_does_not_exist_is_refused():
    with pytest.raises(LiexError, match="no variant 'papre'"):
        pose.evaluate_pose("mouse", "clean", "papre")


def test_errors_over_sizes_are_told_in_per_cent_of_the_spine(monkeypatch):
    asked: list[Any] = []

    def measured(animal: str, split: str, variant: str, **how: Any) -> dict[str, Any]:
        asked.append((animal, split, variant, how["spine_mm"], how["n_frames"]))
        error = {50.0: 2.0, 80.0: 2.4}[how["spine_mm"]]
        return {"mean_joint_error_mm": error, "n_frames": 7, "protocol": "as told"}

    monkeypatch.setattr(pose, "evaluate_pose", measured)
    result = pose.evaluate_sizes("mouse", (50.0, 80.0), n_frames=7)
    assert asked == [("mouse", "clean", "default", 50.0, 7), ("mouse", "clean", "default", 80.0, 7)]
    assert result["error_percent_of_spine"] == pytest.approx({"50": 4.0, "80": 3.0})
    assert result["ratio_to_best"] == pytest.approx({"50": 4 / 3, "80": 1.0})
    assert result["worst_ratio"] == pytest.approx(4 / 3)


def test_the_numbers_of_evaluate_speed_are_called_as_they_have_always_been(
    small_world, monkeypatch
):
    def one_of_640(name: str, *how: Any) -> list[SyntheticSession]:
        return [SyntheticSession.draw(3, 6, sensor=PRIMESENSE_SENSOR, name=name)]

    monkeypatch.setattr(recording, "test_split", one_of_640)
    monkeypatch.setattr(speed, "N_FRAMES", 8)
    monkeypatch.setattr(speed, "N_REPEATS", 1)
    result = speed.evaluate_speed("mouse")
    assert set(result) >= SPEED_KEYS
    assert set(result["stages_ms"]) == {"foreground", "candidates", "choice"}
    assert all(value > 0 for value in result["stages_ms"].values())
    assert set(result["cost_ms"]["joints"]) == {"1", "2", "4"}
    assert set(result["cost_ms"]["pixels"]) == {"320 x 240", "640 x 480"}
    assert result["ratio_to_paper"] > 0
    assert result["frames_per_s_1core"] > 0
    assert json.loads(json.dumps(result, allow_nan=False)) == result


def test_what_is_lost_in_a_rendered_recording_counts_as_lost(small_world, monkeypatch):
    drawn = SyntheticSession.depths

    def without_frame_4(self: SyntheticSession, start: int, stop: int) -> np.ndarray:
        depths = drawn(self, start, stop)
        depths[np.arange(start, stop) == 4] = 0.0
        return depths

    monkeypatch.setattr(SyntheticSession, "depths", without_frame_4)
    sessions = recording.test_split("clean", n_sessions=1)
    errors = pose.pose_errors(
        toy_estimator("mouse", "default"), sessions, Plan.load("mouse"), silent
    )
    assert np.flatnonzero(np.isnan(errors.error_mm)).tolist() == [4]
    assert errors.summary()["lost_rate"] == pytest.approx(0.1)


# a hand-made session against a hand-made reference


class TurnedMouse(WalkingMouse):
    """The walking mouse, taken the wrong way round for a while."""

    def track(self) -> Track:
        track = super().track()
        part = slice(*TURNED)
        track.joints_mm[part], track.uv_px[part] = (
            track.joints_mm[part, ::-1].copy(),
            track.uv_px[part, ::-1].copy(),
        )
        return track


@pytest.fixture(scope="module")
def mouse() -> WalkingMouse:
    return TurnedMouse(steady(1.0), lost=LEFT_OUT)


@pytest.fixture(scope="module")
def session(mouse: WalkingMouse, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return walking_mouse.write(tmp_path_factory.mktemp("reference") / "circle.liex", mouse).path


def reference_of(mouse: WalkingMouse, off_px: tuple[float, float], off_rad: float) -> pd.DataFrame:
    """What another program that is off by so much would have measured."""
    track = WalkingMouse.track(replace(mouse, lost=()))
    along = track.uv_px[:, -1] - track.uv_px[:, 0]
    n = track.n_frames
    angle = (
        np.arctan2(-along[:, 1], along[:, 0]) + off_rad + np.pi * (np.arange(n) % 3)
    )  # head and tail unknown
    centroid = track.centroid_px + off_px
    return pd.DataFrame(
        {
            "frame": np.arange(n),
            "centroid_x_px": centroid[:, 0],
            "centroid_y_px": centroid[:, 1],
            "angle_rad": angle,
        }
    )


@pytest.mark.parametrize("off_deg", [0.0, 7.0, -20.0])
def test_known_offsets_come_out_as_they_went_in(tmp_path, mouse, session, off_deg):
    reference_of(mouse, (3.0, -4.0), np.radians(off_deg)).to_csv(
        tmp_path / "other.csv", index=False
    )
    result = pose.evaluate_reference(session, tmp_path / "other.csv")
    assert result["n_frames"] == result["n_compared"] == 30
    assert result["n_lost"] == len(LEFT_OUT)
    assert result["n_lost_without_flag"] == 0
    assert result["spine_mm"] == SPINE_MM
    assert result["centroid_median_px"] == pytest.approx(5.0, abs=1e-3)
    assert result["centroid_median_mm"] == pytest.approx(5.0 * FLOOR_MM / SMALL.fx, rel=1e-3)
    assert result["heading_median_deg"] == pytest.approx(abs(off_deg), abs=1e-3)
    assert result["n_reversals"] == 2
    assert result["surface_median_mm"] == pytest.approx(1.5)
    assert json.loads(json.dumps(result, allow_nan=False)) == result


def test_rows_that_the_reference_does_not_trust_and_frames_that_do_not_exist_are_left_out(
    tmp_path, mouse, session
):
    table = reference_of(mouse, (3.0, -4.0), 0.1)
    table["reliable"] = 1
    table.loc[::2, "reliable"] = 0
    table.loc[::2, ["centroid_x_px", "angle_rad"]] += 1000.0
    beyond = table.iloc[:4].assign(frame=[-1, 30, 31, 500], reliable=1)
    pd.concat([table, beyond]).to_csv(tmp_path / "other.csv", index=False)
    result = pose.evaluate_reference(session, tmp_path / "other.csv")
    assert result["n_compared"] == 15
    assert result["centroid_median_px"] == pytest.approx(5.0, abs=1e-3)
    assert result["heading_median_deg"] == pytest.approx(np.degrees(0.1), abs=1e-3)


def test_a_reference_without_its_columns_is_refused(tmp_path, mouse, session):
    reference_of(mouse, (0, 0), 0).drop(columns="angle_rad").to_csv(
        tmp_path / "other.csv", index=False
    )
    with pytest.raises(LiexError, match="angle_rad") as error:
        pose.evaluate_reference(session, tmp_path / "other.csv")
    assert "\n" not in str(error.value)


def test_a_reference_that_is_missing_or_empty_is_refused(tmp_path, session):
    with pytest.raises(LiexError, match="absent"):
        pose.evaluate_reference(session, tmp_path / "absent.csv")
    (tmp_path / "empty.csv").write_text("")
    with pytest.raises(LiexError, match="empty"):
        pose.evaluate_reference(session, tmp_path / "empty.csv")


def test_a_reference_that_shares_no_frame_with_the_session_is_refused(tmp_path, mouse, session):
    reference_of(mouse, (0, 0), 0).assign(frame=lambda t: t["frame"] + 1000).to_csv(
        tmp_path / "o.csv", index=False
    )
    with pytest.raises(LiexError, match="frame"):
        pose.evaluate_reference(session, tmp_path / "o.csv")
