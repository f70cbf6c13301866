"""Stories of a fish whose circle, dive and tail's beat are known."""

import numpy as np
import pandas as pd
import pytest

from liex_lab.behaviour import Surroundings, measure, measure_bouts
from liex_lab.behaviour.kinematics import ERROR_LASTS_S, kinematics, turning_points
from liex_lab.tables.schema import BOUTS, to_pandas
from tests.behaviour.swimming_fish import LENGTH_MM, SwimmingFish, uneven


def one_bout(moved: pd.DataFrame, action: str = "scoot") -> pd.Series:
    """All frames as one bout of a person's making, measured."""
    step = float(moved["time_s"].diff().median())
    stop = moved["time_s"].iloc[-1] + step
    bouts = to_pandas(
        BOUTS,
        {
            "session_id": "swim",
            "individual": "fish_1",
            "action": [action],
            "start_s": [0.0],
            "stop_s": [stop],
            "duration_s": [stop],
            "start_frame": [0],
            "stop_frame": [len(moved)],
            "score": [1.0],
            "source": ["human"],
            "model_hash": [""],
        },
    )
    return measure_bouts(bouts, moved).iloc[0]


def test_a_fish_on_a_circle_of_10_mm_at_2_rad_a_second_before_an_uneven_clock():
    times = uneven(6.0, 50.0)
    moved = kinematics(
        *SwimmingFish(np.delete(times, [40, 90, 91, 92]), radius_mm=10.0, turn_rad_s=2.0).tables()
    )
    np.testing.assert_allclose(
        moved["speed_mm_s"], 20.0, rtol=2e-3
    )  # a chord is shorter than its arc by 0.1 %
    np.testing.assert_allclose(moved["yaw_rate_rad_s"], 2.0, rtol=1e-9)
    np.testing.assert_allclose(moved["acceleration_mm_s2"], 0.0, atol=1.0)
    np.testing.assert_allclose(moved["vertical_speed_mm_s"], 0.0, atol=1e-9)
    np.testing.assert_allclose(moved["body_pitch_rad"], 0.0, atol=1e-9)
    np.testing.assert_allclose(moved["bend_rad"], 0.0, atol=1e-9)
    np.testing.assert_allclose(moved["straightness"], 1.0)
    np.testing.assert_allclose(moved["length_mm"], LENGTH_MM)
    bout = one_bout(moved)
    seen_s = (
        6.0 - 4 * 0.02
    )  # three frames at once leave a gap; the one that is missing alone does, too
    assert bout["path_mm"] == pytest.approx(20.0 * seen_s, rel=1e-2)
    assert bout["net_turn_rad"] == pytest.approx(2.0 * times[-1], rel=1e-6)
    assert bout["heading_range_rad"] == pytest.approx(bout["net_turn_rad"])
    assert bout["mean_speed_mm_s"] == pytest.approx(20.0, rel=2e-3)
    assert bout["n_bends"] == 0


def lasting(rng: np.random.Generator, n: int, k: int, step_s: float) -> np.ndarray:
    """Errors (n, k) of standard deviation 1 that agree by exp(-time / ERROR_LASTS_S) from frame to
    frame.
    """
    shared = np.exp(-step_s / ERROR_LASTS_S)
    out = rng.normal(size=(n, k))
    for row in range(1, n):
        out[row] = shared * out[row - 1] + np.sqrt(1.0 - shared**2) * out[row]
    return out


def test_the_standard_deviations_are_those_of_simulated_errors():
    """Errors of 0.2 mm at each joint, common to a frame for its place, independent for its axis."""
    times: np.ndarray = np.arange(8000) / 50.0
    fish = SwimmingFish(times, radius_mm=200.0, turn_rad_s=0.2)
    rng = np.random.default_rng(0)
    frames, poses = fish.tables()
    shifted = poses.copy()
    common = fish.sd_mm * lasting(rng, 8000, 3, 0.02)
    shifted[["x_mm", "y_mm", "z_mm"]] += np.repeat(common, 21, axis=0)
    moved = kinematics(frames, shifted)
    assert moved["vertical_speed_mm_s"].std() == pytest.approx(
        moved["speed_sd_mm_s"].median(), rel=0.05
    )
    each = poses.copy()
    each[["x_mm", "y_mm", "z_mm"]] += fish.sd_mm * lasting(rng, 8000, 63, 0.02).reshape(-1, 3)
    moved, true = kinematics(frames, each), kinematics(frames, poses)
    off = np.angle(np.exp(1j * (moved["heading_rad"] - true["heading_rad"])))
    assert off.std() == pytest.approx(moved["heading_sd_rad"].median(), rel=0.05)
    assert (moved["yaw_rate_rad_s"] - 0.2).std() == pytest.approx(
        moved["yaw_rate_sd_rad_s"].median(), rel=0.05
    )
    assert moved["body_pitch_rad"].std() == pytest.approx(
        moved["body_pitch_sd_rad"].median(), rel=0.05
    )


@pytest.mark.parametrize(("hertz", "fps"), [(3.0, 30.0), (5.0, 60.0), (8.0, 100.0)])
def test_the_tail_s_beat_is_found_with_its_frequency(hertz, fps):
    fish = SwimmingFish(uneven(4.0, fps), turn_rad_s=0.0, beat_hz=hertz)
    moved = kinematics(*fish.tables())
    steady = moved["tail_beat_hz"].iloc[int(fps) : int(3 * fps)]
    assert steady.median() == pytest.approx(hertz, rel=0.01)
    assert steady.notna().all()
    reach = moved["tail_mm"].iloc[int(fps) :].abs().max()
    assert moved["tail_beat_mm"].median() == pytest.approx(reach, rel=0.15)
    assert moved["bend_rad"].abs().max() > 0.1
    bout = one_bout(moved)
    assert bout["n_oscillations"] == pytest.approx((4.0 - fish.wave_s) * hertz, abs=1.0)
    assert bout["tail_beat_median_hz"] == pytest.approx(hertz, rel=0.01)
    assert bout["tail_symmetry"] > 0.8
    assert bout["second_over_first"] < 0


def test_the_wave_runs_down_the_body_as_fast_as_it_was_made():
    fish = SwimmingFish(np.arange(400) / 100.0, turn_rad_s=0.0, beat_hz=4.0, wave_s=0.12)
    bout = one_bout(kinematics(*fish.tables()))
    assert bout["wave_speed_mm_s"] == pytest.approx(LENGTH_MM / 0.12, rel=0.15)


def test_a_beat_too_fast_for_the_camera_is_left_empty():
    moved = kinematics(
        *SwimmingFish(np.arange(120) / 30.0, turn_rad_s=0.0, beat_hz=9.0, sd_mm=0.02).tables()
    )
    assert moved["tail_beat_hz"].isna().all()  # 9 Hz at 30 frames/s: more than a quarter
    bout = one_bout(moved)
    assert np.isnan(bout["wave_speed_mm_s"])  # and a camera of 30 frames/s sees no wave
    assert np.isnan(bout["first_bend_s"])


def test_a_fish_that_glides_and_then_beats_has_its_bends_where_it_beats():
    fish = SwimmingFish(np.arange(300) / 100.0, turn_rad_s=0.0, beat_hz=4.0, still_until_s=1.0)
    moved = kinematics(*fish.tables())
    bends = moved.loc[moved["tail_extreme_rad"].notna(), "time_s"].to_numpy()
    assert bends.min() > 1.0
    np.testing.assert_allclose(np.diff(bends)[1:], 0.125, atol=0.011)
    assert moved.loc[moved["time_s"] < 1.0, "tail_beat_hz"].isna().all()


def test_a_tail_to_the_left_is_a_positive_bend():
    fish = SwimmingFish(np.arange(40) / 100.0, turn_rad_s=0.0)
    frames, poses = fish.tables()
    heading = np.array([0.0, 1.0, 0.0])  # at time 0 the fish swims along y, so that its left is -x
    tail = poses["joint"].isin(["spine_17", "spine_18", "spine_19", "tail_tip"])
    poses.loc[tail, "x_mm"] -= 3.0
    moved = kinematics(frames, poses)
    assert heading @ [
        np.cos(moved["heading_rad"][0]),
        np.sin(moved["heading_rad"][0]),
        0,
    ] == pytest.approx(1.0)
    assert (moved["tail_mm"] > 2.9).all()
    assert (moved["tail_angle_rad"] > 0).all()
    assert (moved["bend_middle_rad"].abs() < 1e-9).all()


def test_a_half_circle_is_bent_by_nearly_pi_and_as_straight_as_its_chord():
    angle = np.pi * (1 - np.arange(21) / 20.0)
    place = LENGTH_MM / np.pi * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    frames, poses = SwimmingFish(np.zeros(1)).tables()
    poses[["x_mm", "y_mm", "z_mm"]] = place
    moved = kinematics(frames, poses).iloc[0]
    assert abs(moved["bend_rad"]) == pytest.approx(np.pi * 19 / 20, rel=1e-6)
    assert moved["straightness"] == pytest.approx(2 / np.pi, rel=2e-3)


def test_speed_of_a_swimming_animal_has_its_vertical_part():
    moved = kinematics(
        *SwimmingFish(np.arange(100) / 50.0, turn_rad_s=0.0, climb_mm_s=-15.0).tables()
    )
    np.testing.assert_allclose(moved["speed_mm_s"], 15.0)
    np.testing.assert_allclose(moved["vertical_speed_mm_s"], -15.0)
    assert one_bout(moved, "dive")["rise_mm"] == pytest.approx(-15.0 * 99 / 50)


def test_depth_preference_is_of_the_water_s_thirds():
    """From 10 mm up at 2 mm/s in 90 mm of water: 10 s in the bottom third, 15 s in the middle, the
    rest at the top.
    """
    fish = SwimmingFish(np.arange(35 * 20) / 20.0, height_mm=10.0, climb_mm_s=2.0)
    frames, poses = fish.tables()
    row = measure(frames, poses, around=Surroundings(surface_z_mm=90.0)).summary.iloc[0]
    assert row["bottom_third_share"] == pytest.approx(10 / 35, abs=0.003)
    assert row["top_third_share"] == pytest.approx(10 / 35, abs=0.003)
    assert row["top_third_latency_s"] == pytest.approx(25.0, abs=0.06)
    assert row["mean_height_mm"] == pytest.approx(45.0, abs=0.1)
    moved = measure(frames, poses, around=Surroundings(surface_z_mm=90.0)).kinematics
    assert moved["below_surface_mm"].iloc[0] == pytest.approx(80.0)
    blind = measure(frames, poses)
    assert np.isnan(blind.summary["top_third_share"].iloc[0])
    assert blind.kinematics["below_surface_mm"].isna().all()


def test_turning_points_are_those_a_reader_would_mark():
    swing = np.array([0, 0.1, 0, 2, 4, 3.9, 4.1, 1, -3, -2.8, -3.2, 0, 2, 0.5, 0.4, 0.6])
    assert list(turning_points(swing, 1.0)) == [6, 10, 12]
    assert list(turning_points(-swing, 1.0)) == [6, 10, 12]
    assert list(turning_points(np.zeros(5), 1.0)) == []
