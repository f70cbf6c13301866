"""The replay holds what the tables say, on both timelines."""

import json
import re
import struct
from dataclasses import replace

import cv2
import numpy as np
import pytest

import liex_lab.sessions.rrd as replay
import liex_lab.sessions.rrd_scene as depth_of
import liex_lab.sessions.rrd_scene as scene_of
from liex_lab.body.pose import Pose
from liex_lab.body.shape import BodyShape, Surface
from liex_lab.geometry import SE3, so3
from liex_lab.recordings.timestamps import find_gaps, median_step
from liex_lab.scene.scene import Arena
from liex_lab.scene.zones import Zone
from liex_lab.sessions import SessionWriter
from liex_lab.sessions.rrd_scene import BODY, body_parts
from liex_lab.tracking.observations import Observations
from liex_lab.tracking.track import Subject, Tracked
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


def columns_of(session, entity, file="session.rrd"):
    """The rows of an entity: column name -> list over rows, static columns included."""
    from rerun.chunk import RrdReader

    found: dict[str, list] = {}
    for chunk in RrdReader(session.path / file).stream().filter(content=f"/{entity}"):
        batch = chunk.to_record_batch()
        for name in batch.schema.names:
            found.setdefault(name, []).extend(batch.column(name).to_pylist())
    return found


@pytest.fixture(scope="module")
def session(tmp_path_factory, strict):
    gaps = find_gaps(MOUSE.times_ns, median_step(MOUSE.times_ns))
    return write(
        tmp_path_factory.mktemp("rrd") / "circle.liex", MOUSE, gaps=gaps, problems=["It was dark."]
    )


def test_the_expected_entities_are_there_on_both_timelines(session):
    for entity in (
        depth_of.DEPTH,
        f"{replay.SKELETON}/joints",
        f"{replay.SKELETON}/bones",
        f"{replay.OVERLAY}/joints",
        replay.ROOT,
        f"{replay.OVERLAY}/bones",
        "kinematics/speed_cm_s",
        "kinematics/nose_height_mm",
        "error/predicted",
        replay.ACTIONS,
        replay.TRACKING,
    ):
        columns = columns_of(session, entity)
        assert columns.get("frame"), entity
        assert len(columns["frame"]) == len(columns["time"]), entity
    assert columns_of(session, "log")["TextLog:text"] == [["It was dark."]]
    worst = columns_of(session, "log/worst")["frame"]
    error = session.frames.set_index("frame_index")["predicted_error_mm"]
    assert len(worst) == 12
    assert error.loc[worst].min() >= error.drop(worst).max()


def test_joints_are_metres_and_pixels_from_the_corner_and_vanish_with_the_animal(session):
    columns = columns_of(session, f"{replay.SKELETON}/joints")
    positions = [row for row in columns["Points3D:positions"] if row is not None]
    track = MOUSE.track()
    np.testing.assert_allclose(positions[0], track.joints_mm[0] / 1000.0, atol=1e-6)
    assert [len(row) for row in positions] == [5 if found else 0 for found in track.observed]
    pixels = columns_of(session, f"{replay.OVERLAY}/joints")["Points2D:positions"]
    np.testing.assert_allclose(pixels[0], track.uv_px[0] + 0.5, atol=1e-4)


def test_ellipsoids_hold_the_joints_with_95_per_cent(session):
    columns = columns_of(session, replay.UNCERTAINTY)
    assert len(columns["frame"]) == len(MOUSE.times_s)
    sizes, centres = columns["Ellipsoids3D:half_sizes"], columns["Ellipsoids3D:centers"]
    assert len(sizes[0]) == len(centres[0]) == 5
    assert len(sizes[20]) == 0  # the mouse is lost
    table = session.poses.iloc[0]
    spread = [table["sd_xy_mm"], table["sd_xy_mm"], table["sd_z_mm"]]
    assert table["sd_z_mm"] > table["sd_xy_mm"] > table["sd_mm"]
    assert sizes[0][0] == pytest.approx(2.795 * np.array(spread) / 1000)
    draws = np.random.default_rng(0).normal(size=(20_000, 3))
    assert np.mean(np.linalg.norm(draws, axis=1) < 2.795) == pytest.approx(0.95, abs=0.005)


def test_walls_and_zones_are_drawn_on_the_floor_and_in_the_picture(tmp_path, strict):
    nest = Zone("nest a/b", polygon_mm=((0.0, 0.0), (50.0, 0.0), (50.0, 50.0)))
    bowl = Arena("round", (10.0, 0.0), 150.0)
    session = write(tmp_path / "c.liex", WalkingMouse(steady(0.5)), arena=bowl, zones=(nest,))
    (ring,) = columns_of(session, f"{scene_of.FLOOR}/walls")["LineStrips3D:strips"][0]
    np.testing.assert_allclose(
        np.hypot(np.array(ring)[:, 0] - 0.01, np.array(ring)[:, 1]), 0.15, atol=1e-6
    )
    (zone,) = columns_of(session, scene_of.FLOOR + "/zones/nest\\ a\\/b")["LineStrips3D:strips"][0]
    np.testing.assert_allclose(
        np.array(zone)[:, :2] * 1000, [[0, 0], [50, 0], [50, 50], [0, 0]], atol=1e-4
    )
    (seen,) = columns_of(session, replay.OVERLAY + "/zones/nest\\ a\\/b")["LineStrips2D:strips"][0]
    camera = session.camera
    np.testing.assert_allclose(
        seen[0], [camera.cx + 0.5, camera.cy + 0.5], atol=1e-3
    )  # the foot of the camera


def unpacked(blob, kind):
    """A depth picture by other people's code."""
    if kind == "image/png":
        return cv2.imdecode(blob, cv2.IMREAD_UNCHANGED)
    width, height = struct.unpack("<II", blob.tobytes()[12:20])
    return unpack_rvl(np.frombuffer(blob.tobytes()[20:], "<u4"), width * height).reshape(
        height, width
    )


def test_depth_is_held_as_it_is(session):
    columns = columns_of(session, depth_of.DEPTH)
    assert columns["frame"] == list(range(len(MOUSE.times_s)))
    assert columns["EncodedDepthImage:meter"] == [[1000.0]]
    (kind,) = columns["EncodedDepthImage:media_type"][0]  # once, for all times
    assert len(columns["EncodedDepthImage:media_type"]) == 1
    for row in (0, 50):
        blob = np.asarray(columns["EncodedDepthImage:blob"][row][0], np.uint8)
        np.testing.assert_array_equal(unpacked(blob, kind), MOUSE.frame(row).depth)


@pytest.mark.parametrize(
    ("sd_mm", "step_mm", "shape", "kind", "most"),
    [
        (0.5, 1, (120, 160), "application/rvl", 10_500),
        (6.0, 5, (120, 160), "image/png", 20_000),  # large steps everywhere
        (1.4, 1, (480, 640), "application/rvl", 180_000),
    ],
)
def test_whatever_the_noise_a_depth_image_is_small_and_unpacked_as_it_was(
    sd_mm, step_mm, shape, kind, most
):
    depth = 700.0 + np.random.default_rng(8).normal(0.0, sd_mm, shape)
    depth = (step_mm * np.rint(depth / step_mm)).astype(np.uint16)
    blob, found = depth_of.packed(depth)
    assert found == kind
    assert len(blob) < most
    np.testing.assert_array_equal(unpacked(blob, found), depth)


def test_the_body_moves_with_the_joints_that_carry_it(session):
    parts = body_parts(Surface.of(MOUSE.skeleton))
    assert {part.joint for part in parts} == {0, 1, 2, 3}
    surface, track = Surface.of(MOUSE.skeleton), MOUSE.track()
    for row in (0, 75):
        posed = Pose(track.root, track.angles_rad, track.scale)[np.array([row])]
        trunk = surface.vertices(posed, parallel=False)[0, : surface.n_trunk_vertices] / 1000.0
        for part in parts:
            columns = columns_of(session, f"{BODY}/{MOUSE.skeleton.names[part.joint]}")
            x, y, z, w = columns["Transform3D:quaternion"][row][0]
            rotation = so3.exp(
                2.0
                * np.arctan2(np.linalg.norm([x, y, z]), w)
                * np.array([x, y, z])
                / max(np.linalg.norm([x, y, z]), 1e-12)
            )
            local = part.vertices / 1000.0 * columns["Transform3D:scale"][row][0]
            placed = local @ rotation.T + columns["Transform3D:translation"][row][0]
            off = np.linalg.norm(placed[:, None] - trunk[None], axis=-1).min(axis=1)
            assert off.max() < 1e-5, "this mouse is straight, so its parts lie on its skin"
    lost = columns_of(session, f"{BODY}/rump")["Transform3D:scale"][20][0]
    assert lost == [0.0, 0.0, 0.0]


def trunk_drawn(session):
    """The vertices of every part of the body that the replay draws, mm, in order of joints."""
    drawn = [
        columns_of(session, f"{BODY}/{name}").get("Mesh3D:vertex_positions", [])
        for name in MOUSE.skeleton.names
    ]
    return [1000.0 * np.array(rows[0]) for rows in drawn if rows]


def test_the_body_is_that_of_the_shape_the_session_kept_or_of_its_girth(tmp_path, strict):
    mouse = WalkingMouse(steady(0.3))
    places = [0.1, 0.25, 0.4, 0.6, 0.8]
    shape = {
        "kept": True,
        "n_frames": 90,
        "average_residual_mm": 2.0,
        "residual_mm": 1.0,
        "places": places,
        "width": [1.3] * 5,
        "width_sd": [0.1] * 5,
        "height": [0.7] * 5,
        "height_sd": [0.1] * 5,
        "joints_moved": [[0.0, 0.0, 0.0]] * 5,
    }
    left = {"kept": False, "n_frames": 12, "why": "12 frames are too few"}
    usual = Surface.of(MOUSE.skeleton)
    assert isinstance(usual.body, BodyShape)
    own = replace(
        usual,
        body=replace(
            usual.body,
            half_width=1.3 * usual.body.half_width,
            half_height=0.7 * usual.body.half_height,
        ),
    )
    for name, animal, parts in (
        ("own", {"girth": 1.0, "shape": shape}, body_parts(own)),
        ("stout", {"girth": 1.15, "shape": left}, body_parts(usual, 1.15)),
    ):
        drawn = trunk_drawn(write(tmp_path / f"{name}.liex", mouse, animal_size=animal))
        assert len(drawn) == len(parts)
        for vertices, part in zip(drawn, parts, strict=True):
            np.testing.assert_allclose(vertices, part.vertices, atol=1e-3)


def test_every_candidate_is_there_when_it_is_asked_for(tmp_path, strict):
    mouse = WalkingMouse(steady(0.5))
    seen = Observations.empty(mouse.skeleton, mouse.times_ns)
    track = mouse.track()
    for h in (0, 2):
        seen.put_pose(
            h,
            Pose(SE3(track.root_rotation, track.root_mm + 10.0 * h), track.angles_rad, track.scale),
        )
        seen.score[:, h] = 1.0
    subject = Subject(
        mouse.skeleton, mouse.camera, mouse.T_arena_camera, 90.0, 9.0, 0.5, (1.0,) * 5
    )
    with SessionWriter(tmp_path / "c.liex", mouse.provenance(replay_candidates=True)) as writer:
        for frames, _ in mouse.chunks(15):
            writer.add(frames)
        writer.take(Tracked(track, ()), seen, subject)
        session = writer.close()
    for h, shown in enumerate([True, False, True, False]):
        strips = columns_of(session, f"{replay.CANDIDATES}/{h + 1}")["LineStrips3D:strips"]
        assert [len(row) for row in strips[:2]] == [4 * shown] * 2
    first = columns_of(session, f"{replay.CANDIDATES}/3")["LineStrips3D:strips"][0][0][0]
    np.testing.assert_allclose(first, (track.joints_mm[0, 0] + 20.0) / 1000.0, atol=1e-5)


def test_the_action_lane_changes_where_the_bouts_do_and_ends_empty(session):
    columns = columns_of(session, replay.ACTIONS)
    words = [row[0] for row in columns["StateChange:state"] if row]
    assert words == [
        "walk",
        "",
        "walk",
        "",
        "walk",
        "rear",
        "walk",
        "",
    ]  # "" in the gaps, and at the end
    assert columns["frame"][0] == 0
    assert columns["frame"][-1] == len(MOUSE.times_s)
    bouts = session.bouts
    starts = [frame for frame, word in zip(columns["frame"], words, strict=True) if word]
    assert starts == list(bouts["start_frame"])
    flags = [row[0] for row in columns_of(session, replay.TRACKING)["StateChange:state"] if row]
    assert flags == ["not_found", ""]


def test_a_blueprint_travels_inside_and_both_layouts_lie_beside(tmp_path, strict):
    from liex_lab.dashboards.replay.layouts import replay_blueprint
    from liex_lab.dashboards.report.report import write_views
    from mcap.reader import make_reader
    from rerun.chunk import RrdReader

    session = write(
        tmp_path / "laid_out.liex",
        WalkingMouse(steady(0.5)),
        blueprint=replay_blueprint,
        problems=["It was dark."],
    )
    assert len(RrdReader(session.path / "session.rrd").blueprints()) == 1
    write_views(session.path)
    assert len(RrdReader(session.path / "replay.rbl").blueprints()) == 1
    layout = json.loads((session.path / "foxglove.json").read_text())
    with (session.path / "session.mcap").open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    topics = {channel.topic for channel in summary.channels.values()}
    named = set(re.findall(r'"(/[a-z]+(?:/[a-z]+)?)', json.dumps(layout)))
    assert named, "the layout shows topics"
    assert named <= topics
    assert panels_of(layout["layout"]) == sorted(layout["configById"])


def panels_of(node):
    """The panels of a layout's tree, in order."""
    return (
        [node]
        if isinstance(node, str)
        else sorted(panels_of(node["first"]) + panels_of(node["second"]))
    )
