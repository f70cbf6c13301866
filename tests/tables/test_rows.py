"""What becomes of a track: rotations, scores, gaps."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from liex_lab.geometry import so3
from liex_lab.recordings.timestamps import find_faults, find_gaps, make_monotone, median_step
from liex_lab.tables.rows import Rows, nearness, stop_times
from liex_lab.tables.schema import GAPS, ROTATIONS, to_pandas
from tests.sessions.walking_mouse import SD_ROOT, WalkingMouse, steady


def rows_of(mouse: WalkingMouse) -> Rows:
    times = mouse.times_ns
    return Rows(
        mouse.track(), np.arange(len(times)), "s", "m", find_gaps(times, median_step(times))
    )


def test_a_dropped_and_a_lost_stretch_become_two_half_open_gaps():
    times = np.delete(steady(2.0), slice(20, 26))
    rows = rows_of(WalkingMouse(times, lost=(40, 41, 42)))
    gaps = to_pandas(GAPS, rows.gaps())
    assert list(gaps["reason"]) == ["camera_dropped", "tracker_lost"]
    assert list(gaps["n_frames_missing"]) == [6, 3]
    assert list(gaps["start_frame"]) == [20, 40]
    assert list(gaps["stop_frame"]) == [20, 43]
    np.testing.assert_allclose(gaps["stop_s"] - gaps["start_s"], [6 / 30, 3 / 30], atol=1e-8)
    assert rows.missing_before()[20] == 6
    assert rows.missing_before().sum() == 6
    frames = rows.frames_table
    assert frames["pulse_index"].tolist() == np.rint(30 * times).astype(int).tolist()
    assert frames["frame_index"].tolist() == list(range(54))


def test_stamps_that_were_moved_have_rows_of_their_own():
    mouse = WalkingMouse(steady(2.0))
    times = mouse.times_ns.copy()
    times[10] = times[9]
    times[40:] += 3600 * 10**9
    found = make_monotone(times)
    step = median_step(found.times_ns)
    track = replace(mouse.track(), times_ns=found.times_ns)
    faults = [*find_gaps(found.times_ns, step), *find_faults(found.times_ns, step, found.faults)]
    rows = Rows(track, np.arange(len(times)), "s", "m", faults)
    gaps = to_pandas(GAPS, rows.gaps())
    assert list(gaps["reason"]) == ["stamp_repeated", "clock_jumped"]
    assert list(gaps["n_frames_missing"]) == [0, 1]
    assert int(gaps["start_frame"].iloc[1]) == int(gaps["stop_frame"].iloc[1]) == 40
    assert (int(gaps["start_frame"].iloc[0]), int(gaps["stop_frame"].iloc[0])) == (10, 11)
    assert gaps["start_s"].iloc[0] == pytest.approx(1 / 3, abs=1e-6)
    assert rows.missing_before()[40] == 1


def test_a_stretch_without_a_pose_at_the_very_end_stops_one_step_after_the_last_frame():
    rows = rows_of(WalkingMouse(steady(1.0), lost=(28, 29)))
    gaps = to_pandas(GAPS, rows.gaps())
    assert int(gaps["stop_frame"].iloc[0]) == 30
    assert gaps["stop_s"].iloc[0] == pytest.approx(1.0, abs=1e-8)


def test_rotations_bring_the_root_s_transform_back():
    mouse = WalkingMouse(steady(0.5), rear_s=(0.1, 0.4), lost=(3,))
    rows = rows_of(mouse)
    table = pd.concat([to_pandas(ROTATIONS, block) for block in rows.rotations()])
    root = table[table["joint"] == "root"]
    back = so3.exp(root[["wx_rad", "wy_rad", "wz_rad"]].to_numpy())
    np.testing.assert_allclose(back, mouse.track().root_rotation, atol=1e-9)
    np.testing.assert_allclose(root[["tx_mm", "ty_mm", "tz_mm"]], mouse.track().root_mm)
    np.testing.assert_allclose(root["sd_tz_mm"].iloc[0], 2.0)
    np.testing.assert_allclose(root["cov_wx_wz_rad2"].iloc[0], 0.2 * SD_ROOT[0] * SD_ROOT[2])
    np.testing.assert_allclose(root["cov_wy_tx_rad_mm"].iloc[0], 0.2 * SD_ROOT[1] * SD_ROOT[3])
    np.testing.assert_allclose(root["cov_ty_tz_mm2"].iloc[0], 0.2 * SD_ROOT[4] * SD_ROOT[5])
    assert root["cov_ty_tz_mm2"].isna().sum() == 1
    assert table.loc[table["joint"] != "root", "cov_ty_tz_mm2"].isna().all()
    assert table.loc[table["joint"] != "root", "tx_mm"].isna().all()
    assert root["wx_rad"].isna().sum() == 1


def test_the_score_is_the_share_of_gaussian_points_within_the_radius():
    rng = np.random.default_rng(3)
    for sd, radius in ((2.0, 3.0), (4.0, 3.0), (1.0, 3.0)):
        points = rng.normal(0.0, sd, (200_000, 3))
        inside = np.mean(np.linalg.norm(points, axis=1) < radius)
        assert float(nearness(np.array(sd), np.array(radius))) == pytest.approx(inside, abs=0.004)


def test_a_frame_stands_for_the_time_to_the_next_one_but_not_for_a_gap():
    np.testing.assert_allclose(
        stop_times(np.array([0.0, 0.1, 0.2, 0.9, 1.0])), [0.1, 0.2, 0.3, 1.0, 1.1]
    )
    np.testing.assert_allclose(stop_times(np.array([0.0])), [0.0])
