"""The replay holds what the tables say, on both timelines."""

from __future__ import annotations

import struct

import numpy as np
import pytest

import liex_lab.sessions.rrd as replay
from liex_lab.recordings.times import find_gaps, median_step
from liex_lab.recordings.walls import Arena
from liex_lab.recordings.zones import Zone
from tests.oracles.rvl import unpack_rvl
from tests.sessions.walking_mouse import WalkingMouse, steady, write

MOUSE = WalkingMouse(np.delete(steady(4.0), slice(40, 46)), rear_s=(2.0, 3.0), lost=(20, 21))


@pytest.fixture(scope="module")
def strict():
    """Rerun only warns of what it does not understand, unless told to be strict."""
    import rerun

    rerun.set_strict_mode(True)
    yield
    rerun.set_strict_mode(False)


def columns_of(session, entity):
    """The rows of an entity: column name -> list over rows, static columns included."""
    from rerun.chunk import RrdReader

    found: dict[str, list] = {}
    for chunk in RrdReader(session.path / "session.rrd").stream().filter(content=f"/{entity}"):
        batch = chunk.to_record_batch()
        for name in batch.schema.names:
            found.setdefault(name, []).extend(batch.column(name).to_pylist())
    return found


@pytest.fixture(scope="module")
def session(tmp_path_factory, strict):
    gaps = find_gaps(MOUSE.times_ns, median_step(MOUSE.times_ns))
    return write(tmp_path_factory.mktemp("rrd") / "circle.liex", MOUSE, gaps=gaps, problems=["It was dark."])


def test_the_expected_entities_are_there_on_both_timelines(session):
    for entity in (
        replay.DEPTH, f"{replay.SKELETON}/joints", f"{replay.SKELETON}/bones", f"{replay.OVERLAY}/joints", replay.ROOT,
        f"{replay.OVERLAY}/bones", "kinematics/speed_mm_s", "kinematics/nose_height_mm", "error/predicted",
        replay.ACTIONS, replay.TRACKING,
    ):  # fmt: skip
        columns = columns_of(session, entity)
        assert columns.get("frame"), entity
        assert len(columns["frame"]) == len(columns["time"]), entity
    assert columns_of(session, "log")["TextLog:text"] == [["It was dark."]]


def test_spheres_hold_the_joints_with_95_per_cent(session):
    columns = columns_of(session, replay.UNCERTAINTY)
    assert len(columns["frame"]) == len(MOUSE.times_s)
    sizes, centres = columns["Ellipsoids3D:half_sizes"], columns["Ellipsoids3D:centers"]
    assert len(sizes[0]) == len(centres[0]) == 5
    assert len(sizes[20]) == 0  # the mouse is lost
    assert sizes[0][0][0] == pytest.approx(2.795 * MOUSE.sd_mm / 1000)
    draws = np.random.default_rng(0).normal(size=(20_000, 3))
    assert np.mean(np.linalg.norm(draws, axis=1) < 2.795) == pytest.approx(0.95, abs=0.005)


def test_walls_and_zones_are_drawn_on_the_floor_and_in_the_picture(tmp_path, strict):
    nest = Zone("nest a/b", polygon_mm=((0.0, 0.0), (50.0, 0.0), (50.0, 50.0)))
    bowl = Arena("round", (10.0, 0.0), 150.0)
    session = write(tmp_path / "c.liex", WalkingMouse(steady(0.5)), arena=bowl, zones=(nest,))
    (ring,) = columns_of(session, f"{replay.FLOOR}/walls")["LineStrips3D:strips"][0]
    np.testing.assert_allclose(np.hypot(np.array(ring)[:, 0] - 0.01, np.array(ring)[:, 1]), 0.15, atol=1e-6)
    (zone,) = columns_of(session, replay.FLOOR + "/zones/nest\\ a\\/b")["LineStrips3D:strips"][0]
    np.testing.assert_allclose(np.array(zone)[:, :2] * 1000, [[0, 0], [50, 0], [50, 50], [0, 0]], atol=1e-4)
    (seen,) = columns_of(session, replay.OVERLAY + "/zones/nest\\ a\\/b")["LineStrips2D:strips"][0]
    camera = session.camera
    np.testing.assert_allclose(seen[0], [camera.cx + 0.5, camera.cy + 0.5], atol=1e-3)  # the foot of the camera


def test_the_worst_frames_can_be_jumped_to(session):
    columns = columns_of(session, "log/worst")
    error = session.frames.set_index("frame_index")["predicted_error_mm"]
    assert len(columns["frame"]) == 12
    assert error.loc[columns["frame"]].min() >= error.drop(columns["frame"]).max()


def test_short_recordings_hold_the_depth_as_it_is(session):
    columns = columns_of(session, replay.DEPTH)
    assert columns["frame"] == list(range(len(MOUSE.times_s)))
    assert columns["DepthImage:meter"] == [[1000.0]]
    for row in (0, 50):
        pixels = np.asarray(columns["DepthImage:buffer"][row], np.uint8).view("<u2").ravel()
        np.testing.assert_array_equal(pixels, MOUSE.frame(row).depth.ravel())


def test_long_recordings_hold_the_depth_as_rvl(tmp_path, strict, monkeypatch):
    monkeypatch.setattr(replay, "RAW_UP_TO", 10)
    session = write(tmp_path / "long.liex", WalkingMouse(steady(0.5)))
    columns = columns_of(session, replay.DEPTH)
    assert len(columns["EncodedDepthImage:blob"]) == 15
    assert columns["EncodedDepthImage:media_type"] == [["application/rvl"]]
    blob = np.asarray(columns["EncodedDepthImage:blob"][7][0], np.uint8).tobytes()
    width, height = struct.unpack("<II", blob[12:20])
    depth = MOUSE.frame(7).depth
    assert (height, width) == depth.shape
    np.testing.assert_array_equal(unpack_rvl(np.frombuffer(blob[20:], "<u4"), depth.size), depth.ravel())


def test_joints_are_metres_in_the_arena_and_vanish_with_the_animal(session):
    columns = columns_of(session, f"{replay.SKELETON}/joints")
    positions = [row for row in columns["Points3D:positions"] if row is not None]
    track = MOUSE.track()
    np.testing.assert_allclose(positions[0], track.joints_mm[0] / 1000.0, atol=1e-6)
    assert [len(row) for row in positions] == [5 if seen else 0 for seen in track.observed]


def test_the_overlay_counts_from_the_corner_of_the_picture(session):
    positions = columns_of(session, f"{replay.OVERLAY}/joints")["Points2D:positions"]
    np.testing.assert_allclose(positions[0], MOUSE.track().uv_px[0] + 0.5, atol=1e-4)


def test_the_action_lane_changes_where_the_bouts_do_and_ends_empty(session):
    columns = columns_of(session, replay.ACTIONS)
    words = [row[0] for row in columns["StateChange:state"] if row]
    assert words == ["walk", "", "walk", "", "walk", "rear", "walk", ""]  # "" in the gaps, and at the end
    assert columns["frame"][0] == 0
    assert columns["frame"][-1] == len(MOUSE.times_s)
    bouts = session.bouts
    starts = [frame for frame, word in zip(columns["frame"], words, strict=True) if word]
    assert starts == list(bouts["start_frame"])
    flags = [row[0] for row in columns_of(session, replay.TRACKING)["StateChange:state"] if row]
    assert flags == ["not_found", ""]


def test_the_colours_spread_over_the_floor_and_an_animal_on_it():
    depth = np.full((40, 40), 700, np.uint16)
    depth[10:14, 10:20] = 660
    near, far = replay.colour_range(depth, 700.0)
    assert near < 640
    assert 700 < far < 730
    assert replay.colour_range(np.zeros((4, 4), np.uint16), 700.0)[1] > 700


def test_a_blueprint_travels_inside(tmp_path, strict):
    from liex_lab.dashboards.blueprint import replay_blueprint
    from rerun.chunk import RrdReader

    session = write(tmp_path / "laid_out.liex", WalkingMouse(steady(0.5)), blueprint=replay_blueprint)
    assert len(RrdReader(session.path / "session.rrd").blueprints()) == 1
