"""Stories of a mouse whose speed, heading and heights are known."""

from importlib import import_module

import numpy as np
import pandas as pd
import pytest

from liex_lab.behaviour.body import STANDS, SWIMS, BodyAxis
from liex_lab.behaviour.kinematics import Joints, kinematics, neighbours, segments
from liex_lab.recordings.timestamps import find_gaps, median_step
from liex_lab.runtime.memory import on_disk, release_memory
from liex_lab.tables import schema
from liex_lab.tables.rows import Rows
from tests.behaviour.swimming_fish import SwimmingFish
from tests.sessions.walking_mouse import WalkingMouse, steady


def tables_of(mouse: WalkingMouse) -> tuple[pd.DataFrame, pd.DataFrame]:
    """The tables `frames` and `poses` of a mouse."""
    times = mouse.times_ns
    rows = Rows(
        mouse.track(), np.arange(len(times)), "s", "m", find_gaps(times, median_step(times))
    )
    poses = pd.concat(
        [schema.to_pandas(schema.POSES, block) for block in rows.poses()], ignore_index=True
    )
    return rows.frames_table, poses


def test_an_animal_on_a_circle_has_the_speed_and_the_turn_it_walks_with():
    moved = kinematics(*tables_of(WalkingMouse(steady(4.0), speed_mm_s=200.0, radius_mm=150.0)))
    np.testing.assert_allclose(moved["speed_mm_s"], 200.0, rtol=1e-3)
    np.testing.assert_allclose(moved["yaw_rate_rad_s"], 200.0 / 150.0, rtol=1e-5)
    np.testing.assert_allclose(moved["vertical_speed_mm_s"], 0.0, atol=1e-6)
    assert moved["heading_rad"].iloc[0] == pytest.approx(np.pi / 2)
    assert moved["step_mm"].sum() == pytest.approx(800.0, rel=1e-3)


@pytest.mark.parametrize("fps", [10.0, 200.0])
def test_the_speed_does_not_depend_on_the_frame_rate(fps):
    moved = kinematics(
        *tables_of(WalkingMouse(steady(3.0, fps), speed_mm_s=150.0, radius_mm=300.0))
    )
    np.testing.assert_allclose(moved["speed_mm_s"], 150.0, rtol=2e-3)


@pytest.mark.parametrize("swims", [False, True])
def test_a_table_on_disk_made_in_blocks_is_the_one_in_memory(swims, tmp_path, monkeypatch):
    fish = SwimmingFish(np.delete(steady(3.0), [30, 31, 60]), beat_hz=4.0, lost=(10, 11, 25))
    mouse = WalkingMouse(
        np.delete(steady(3.0), [30, 31, 60]), radius_mm=100.0, rear_s=(1.0, 2.0), lost=(10, 11, 25)
    )
    told = fish.tables() if swims else tables_of(mouse)
    in_memory = kinematics(*told, surface_z_mm=90.0)
    monkeypatch.setattr(import_module("liex_lab.behaviour.kinematics"), "_BLOCK", 16)
    on_the_disk = kinematics(*told, surface_z_mm=90.0, allocate=on_disk(tmp_path))
    release_memory()
    pd.testing.assert_frame_equal(on_the_disk, in_memory, check_exact=True)
    if not swims:
        of_track = kinematics(told[0], Joints.of_track(mouse.track()))
        pd.testing.assert_frame_equal(of_track, in_memory, check_exact=True)


def test_no_difference_is_taken_across_a_gap():
    """Between two stretches the animal was carried to another place: nobody walked that far."""
    mouse = WalkingMouse(np.delete(steady(2.0), slice(30, 40)), speed_mm_s=100.0)
    frames, poses = tables_of(mouse)
    poses.loc[poses["frame_index"] >= 30, "x_mm"] += 500.0
    moved = kinematics(frames, poses)
    np.testing.assert_allclose(moved["speed_mm_s"], 100.0, rtol=1e-3)
    assert moved["step_mm"].sum() == pytest.approx(100.0 * 50 / 30, rel=1e-3)


def test_a_lost_animal_has_no_speed_and_its_neighbours_have_their_own():
    moved = kinematics(*tables_of(WalkingMouse(steady(2.0), lost=(10, 11, 25, 27))))
    assert list(np.flatnonzero(moved["speed_mm_s"].isna())) == [
        10,
        11,
        25,
        26,
        27,
    ]  # 26 stands alone
    np.testing.assert_allclose(moved["speed_mm_s"].dropna(), 200.0, rtol=1e-3)
    assert len(moved) == 60


def test_heights_and_pitch_follow_a_rear():
    moved = kinematics(*tables_of(WalkingMouse(steady(3.0), rear_s=(1.0, 2.0)))).set_index(
        "frame_index"
    )
    up, down = moved.loc[45], moved.loc[0]
    assert up["body_pitch_rad"] == pytest.approx(np.radians(55.0))
    assert up["nose_over_rump_mm"] == pytest.approx(90.0 * np.sin(np.radians(55.0)))
    assert down["nose_over_rump_mm"] == pytest.approx(0.0, abs=1e-9)
    assert up["nose_height_mm"] > up["back_height_mm"] > down["back_height_mm"]
    np.testing.assert_allclose(
        moved["speed_mm_s"], 200.0, rtol=1e-3
    )  # the body's centre goes on as before


def test_an_upright_animal_has_no_heading():
    frames, poses = tables_of(WalkingMouse(steady(0.5)))
    height = poses["joint"].map({"rump": 0, "loin": 20, "chest": 40, "neck": 60, "nose": 80})
    rump = poses.groupby("frame_index")[["x_mm", "y_mm"]].transform("first")
    upright = poses.assign(x_mm=rump["x_mm"], y_mm=rump["y_mm"], z_mm=10.0 + height)
    moved = kinematics(frames, upright)
    assert moved["heading_rad"].isna().all()
    assert moved["speed_mm_s"].notna().all()


def test_a_jump_that_no_animal_makes_is_left_empty():
    frames, poses = tables_of(WalkingMouse(steady(1.0)))
    poses.loc[poses["frame_index"] >= 15, "x_mm"] += 400.0
    moved = kinematics(frames, poses)
    assert list(np.flatnonzero(moved["speed_mm_s"].isna())) == [14, 15]


def test_neighbours_agree_with_the_search_a_reader_would_write():
    rng = np.random.default_rng(11)
    time = np.cumsum(rng.choice([0.01, 0.011, 0.012, 0.2], 300, p=[0.4, 0.3, 0.28, 0.02]))
    observed = rng.random(300) > 0.05
    before, after = neighbours(time, observed, 0.034)
    number = segments(time, observed)
    for i in np.flatnonzero(observed):
        same = [j for j in range(300) if number[j] == number[i]]
        earlier = [j for j in same if time[j] <= time[i] - 0.75 * 0.034]
        later = [j for j in same if time[j] >= time[i] + 0.75 * 0.034]
        assert before[i] == (max(earlier) if earlier else same[0])
        assert after[i] == (min(later) if later else same[-1])


def test_body_points_are_found_by_name_or_along_the_chain():
    named = BodyAxis.of(["neck", "loin", "chest", "rump", "nose"])
    assert (named.front, named.rear, named.axis, named.kind) == (4, 3, (3, 0), STANDS)
    chain = BodyAxis.of(["a", "b", "c", "d"])
    assert (chain.spine, chain.axis, chain.back, chain.trunk) == (
        (3, 2, 1, 0),
        (0, 2),
        (2, 1),
        (0, 1, 2),
    )
    fish = BodyAxis.of(["head", *(f"spine_{k}" for k in range(8)), "tail_tip"])
    assert (fish.front, fish.rear, fish.axis, fish.kind) == (0, 9, (2, 0), SWIMS)
    alone = BodyAxis.of(["a"])
    assert (alone.front, alone.rear, alone.back) == (0, 0, (0,))


def test_a_single_frame_has_a_row_and_no_speed():
    moved = kinematics(*tables_of(WalkingMouse(steady(1 / 30))))
    assert len(moved) == 1
    assert moved["speed_mm_s"].isna().all()
    assert moved["nose_height_mm"].iloc[0] == pytest.approx(18.0)
