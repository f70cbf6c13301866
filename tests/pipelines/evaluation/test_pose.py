"""`liex evaluate pose`, `sizes`, `reference` and `speed`: their numbers have names that stay, and
known offsets are found.
"""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numba
import numpy as np
import pandas as pd
import pytest
from liex_lab.pipelines.evaluation import pose, speed
from typer.testing import CliRunner

from liex_lab import cli
from liex_lab.body.skeleton import Skeleton
from liex_lab.errors import LiexError
from liex_lab.estimation.estimator import PoseEstimator
from liex_lab.plan import Plan
from liex_lab.runtime.progress import Progress, silent
from liex_lab.simulation.recording import RenderedRecording
from liex_lab.simulation.sensors import PRIMESENSE_QVGA_SENSOR, PRIMESENSE_SENSOR
from liex_lab.simulation.simulator import world_of
from liex_lab.simulation.species import MouseSpecies, Species
from liex_lab.tracking.track import Track
from tests.estimation.toy import trained
from tests.sessions import walking_mouse
from tests.sessions.walking_mouse import FLOOR_MM, SMALL, SPINE_MM, WalkingMouse, steady

POSE_KEYS = [
    *("animal", "split", "variant", "n_frames", "mean_joint_error_mm", "median_joint_error_mm"),
    *("p95_joint_error_mm", "flip_rate", "lost_rate", "spearman_predicted_error"),
    *("interval90_coverage", "protocol"),
]
LEFT_OUT = (5, 17)  # frames of the hand-made session without a pose
TURNED = (10, 13)  # from when to when nose and rump are exchanged in it
MOUSE = Skeleton.load("mouse")


# rendered splits, measured with a toy model: the numbers are poor, their names are not


def toy_estimator(animal: str, variant: str, progress: Progress = silent) -> PoseEstimator:
    return PoseEstimator(trained(variant).model)


@pytest.fixture
def small_world(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two recordings of 10 small frames stand for every split, toy models for every variant."""

    def small_split(
        self: Species, name: str, spine_mm: float | None = None, n_sessions: int = 2, *_: Any
    ) -> list[RenderedRecording]:
        return [
            MouseSpecies().film(
                [5, k], 10, sensor=PRIMESENSE_QVGA_SENSOR, spine_mm=spine_mm, name=f"{name}-{k}"
            )
            for k in range(min(n_sessions, 2))
        ]

    monkeypatch.setattr(Species, "test_split", small_split)
    for module in (pose, speed):
        monkeypatch.setattr(module, "estimator_of", toy_estimator)


@pytest.mark.usefixtures("small_world")
def test_the_numbers_of_a_split_have_their_names_and_are_the_same_every_time():
    told: list[str] = []
    result = pose.evaluate_pose("mouse", "hard", progress=lambda *facts: told.append(facts[2]))
    assert list(result) == POSE_KEYS
    assert (result["animal"], result["split"], result["variant"]) == ("mouse", "hard", "default")
    assert told == ["measuring hard-0", "measuring hard-1"]
    assert np.isfinite([result[name] for name in POSE_KEYS[3:11]]).all()
    assert "nothing is handed over" in result["protocol"]
    assert json.loads(json.dumps(result, allow_nan=False)) == result
    assert pose.evaluate_pose("mouse", "hard") == result
    fewer = [pose.evaluate_pose("mouse", n_frames=n)["n_frames"] for n in (10, 11)]
    assert fewer == [10, 20]  # whole recordings


def test_a_split_or_variant_that_does_not_exist_is_refused(monkeypatch):
    monkeypatch.setattr(pose, "estimator_of", lambda animal, variant, progress: variant)
    with pytest.raises(LiexError, match="no split 'claen'"):
        pose.evaluate_pose("mouse", "claen", "paper")
    assert pose.subject_of("mouse", "paper") == "paper"
    with pytest.raises(LiexError, match=r"no variant 'papre'.*paper-no-metric, rf, cnn"):
        pose.evaluate_pose("mouse", "clean", "papre")


def test_errors_over_sizes_are_in_per_cent_of_the_spine(monkeypatch):
    def measured(animal: str, spine_mm: float, n_frames: int, **_: Any) -> dict[str, Any]:
        return {"mean_joint_error_mm": 0.04 * spine_mm + 1, "n_frames": n_frames, "protocol": ""}

    monkeypatch.setattr(pose, "evaluate_pose", measured)
    monkeypatch.setattr(pose, "sizes_of", lambda animal: (50.0, 100.0))
    result = pose.evaluate_sizes("mouse", n_frames=7)
    assert result["error_percent_of_spine"] == pytest.approx({"50": 6.0, "100": 5.0})
    assert result["ratio_to_best"] == pytest.approx({"50": 1.2, "100": 1.0})
    assert (result["worst_ratio"], result["n_frames"]) == (pytest.approx(1.2), 7)


@pytest.mark.usefixtures("small_world")
def test_the_numbers_of_evaluate_speed_have_their_names(monkeypatch):
    def one_of_640(self: Species, name: str, **how: Any) -> list[RenderedRecording]:
        return [MouseSpecies().film(3, 6, sensor=PRIMESENSE_SENSOR, name=name)]

    monkeypatch.setattr(Species, "test_split", one_of_640)
    monkeypatch.setattr(speed, "N_FRAMES", 8)
    monkeypatch.setattr(speed, "N_REPEATS", 1)
    result = speed.evaluate_speed("mouse")
    assert set(result) >= {"animal", "frames_per_s_1core", "frames_per_s_2cores", "machine"}
    assert set(result["stages_ms"]) == {"foreground", "candidates", "choice"}
    assert all(value > 0 for value in (*result["stages_ms"].values(), result["ratio_to_paper"]))
    assert set(result["cost_ms"]["joints"]) == {"1", "2", "4"}
    assert set(result["cost_ms"]["pixels"]) == {"320 x 240", "640 x 480"}
    assert json.loads(json.dumps(result, allow_nan=False)) == result


def test_a_clock_restores_the_threads_and_a_process_that_fails_says_so():
    before = numba.get_num_threads()
    with pytest.raises(MemoryError), speed.two_cores():
        raise MemoryError
    assert numba.get_num_threads() == before
    with pytest.raises(LiexError, match=r"os:abort_not_there failed.*report this"):
        speed.isolated("os:abort_not_there")


@pytest.mark.usefixtures("small_world")
def test_what_is_lost_in_a_rendered_recording_counts_as_lost(monkeypatch):
    drawn = RenderedRecording.depths

    def without_frame_4(self: RenderedRecording, start: int, stop: int) -> np.ndarray:
        depths = drawn(self, start, stop)
        depths[np.arange(start, stop) == 4] = 0.0
        return depths

    monkeypatch.setattr(RenderedRecording, "depths", without_frame_4)
    sessions = world_of(Skeleton.load("mouse")).test_split("clean", n_sessions=1)
    toy = toy_estimator("mouse", "default")
    errors = pose.errors_of(toy, sessions, Plan.load("mouse"), silent)
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


@pytest.mark.parametrize("off_deg", [7.0, -20.0])
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


def test_a_reference_that_cannot_be_used_is_refused_in_one_sentence(tmp_path, mouse, session):
    whole = reference_of(mouse, (0, 0), 0)
    path = tmp_path / "other.csv"
    for table, expected in (
        (whole.drop(columns="angle_rad"), "angle_rad"),
        (whole.assign(frame=whole["frame"] + 1000), "column frame counts"),
        (pd.DataFrame(), "other.csv should be a table"),
    ):
        table.to_csv(path, index=False)
        path.write_text("") if table.empty else None
        with pytest.raises(LiexError, match=expected) as error:
            pose.evaluate_reference(session, path)
        assert "\n" not in str(error.value)
    with pytest.raises(LiexError, match="absent"):
        pose.evaluate_reference(session, tmp_path / "absent.csv")


# axes and headings


@pytest.mark.parametrize(
    ("a", "b", "degrees"),
    [(0, 180, 0), (10, 350, 20), (10, 170, 20), (0, 90, 90), (5, 94, 89), (725, 7, 2)],
)
def test_two_axes_differ_by_a_right_angle_at_most(a, b, degrees):
    for pair in ((a, b), (b, a)):
        found = np.degrees(pose.angle_between_axes(*np.radians([pair]).T))
        assert found == pytest.approx(degrees, abs=1e-9)


@pytest.mark.parametrize(
    ("degrees", "expected"),
    [
        ([0, 10, 20, 30], 0),
        ([0, 180, 0, 0], 2),
        ([0, 89, 178, 267, 356], 0),
        ([0, 91, 91, 0], 2),
        ([170, -170, 175], 0),  # over the seam, not round
        ([0, np.nan, np.nan, 180, 180], 1),
        ([], 0),
    ],
)
def test_a_reversal_is_a_turn_of_more_than_a_right_angle_between_measured_frames(degrees, expected):
    assert pose.count_reversals(np.radians(np.array(degrees, float))) == expected


# animals of another build

N = 400
LENGTH_MM = 60.0


def made(seed: int, sd_mm: float = 1.0, up_mm: float = 0.0, told: float = 1.0) -> pose.Built:
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
    return pose.Built(track, truth, LENGTH_MM, 1.03 * LENGTH_MM, MOUSE.tip)


def test_honest_tracks_hold_nine_in_ten_and_others_fewer_or_more() -> None:
    honest = pose.build_figures([made(1), made(2)], MOUSE.names)
    assert honest["interval90"] == pytest.approx(0.9, abs=0.01)
    assert honest["interval90_least"] == min(honest["interval90_by_joint"].values()) > 0.85
    assert pose.build_figures([made(1, told=0.5)], MOUSE.names)["interval90"] < 0.65
    too_high = pose.build_figures([made(1, up_mm=3.0), made(2, up_mm=-3.0)], MOUSE.names)
    assert too_high["interval90_z"] < 0.3 < 0.85 < too_high["interval90_x_y"]
    assert too_high["height_off_mm"] == pytest.approx(3.0, abs=0.1)
    assert too_high["height_bias_mm"] == pytest.approx(0.0, abs=0.1)


def test_errors_are_of_the_length_with_an_interval_over_recordings() -> None:
    figures = pose.build_figures([made(k, sd_mm=1.0 + k) for k in range(4)], MOUSE.names)
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
    figures = pose.build_figures([row, made(4)], MOUSE.names)
    assert figures["longest_flip"] == 5
    assert figures["flips"] == pytest.approx(5 / (2 * N))
    assert [(c["n"], c["flipped"]) for c in figures["p_flip"]] == [
        (2 * N - 5, 0.0),
        (5, 1.0),
    ]
    assert figures["wrong_but_trusted"] == pytest.approx(5 / (2 * N))
    row.track.flag[turned] = "doubtful"
    assert pose.build_figures([row], MOUSE.names)["wrong_but_trusted"] == 0.0


def test_a_recording_in_which_nothing_was_found_counts_as_not_found() -> None:
    nothing = Track.empty(MOUSE, np.arange(N) * 33_000_000)
    lost = pose.Built(nothing, made(1).truth, LENGTH_MM, np.nan, MOUSE.tip)
    assert pose.build_figures([made(1), lost], MOUSE.names)["found"] == 0.5
    assert pose.build_figures([lost], MOUSE.names) == {
        "n_recordings": 1,
        "n_frames": N,
        "found": 0.0,
    }


@pytest.mark.slow
def test_a_mouse_of_another_build_stands_beside_a_usual_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pose, "N_FRAMES", 30)
    file = tmp_path / "pose.json"
    words = ["evaluate", "pose", "--split", "other-build", "--frames", "1", "--json", str(file)]
    result = CliRunner().invoke(cli.app, words)
    assert result.exit_code == 0, result.output
    told = json.loads(file.read_text())
    for name in ("other", "usual"):
        assert told[name]["n_frames"] == 30
        assert told[name]["found"] > 0.9
        assert told[name]["error_percent"] < 15.0
    assert told["ratio_to_usual"] == pytest.approx(
        told["other"]["error_percent"] / told["usual"]["error_percent"]
    )


def test_the_sealed_animals_are_others_than_those_of_development() -> None:
    assert not {*pose.SEEDS, *range(201, 230)} & {*pose.SEALED_SEEDS}


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["--animal", "hand"], "is of mouse and fish"),
        (["--variant", "paper"], "bundled model"),
        (["--frames", "99999"], "at most that many"),
    ],
)
def test_what_cannot_be_measured_is_told(words: list[str], told: str) -> None:
    result = CliRunner().invoke(cli.app, ["evaluate", "pose", "--split", "other-build", *words])
    assert isinstance(result.exception, LiexError)
    assert told in str(result.exception)
    result = CliRunner().invoke(cli.app, ["evaluate", "pose", "--sealed"])
    assert "leave it out" in str(result.exception)
