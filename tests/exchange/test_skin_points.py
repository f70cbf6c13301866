"""Derived points lie on the rendered skin, left is left, and other programs' files hold them."""

import json
import shutil
import tomllib

import h5py
import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest
import xarray
from liex_lab.pipelines.correct import correct_session
from typer.testing import CliRunner

from liex_lab import cli
from liex_lab.body.pose import Pose
from liex_lab.body.shape import Surface, render_mesh
from liex_lab.body.skeleton import PRESETS, Skeleton
from liex_lab.body.skin_points import place_points, points_of
from liex_lab.errors import LiexError, SessionError
from liex_lab.exchange import export
from liex_lab.exchange.skin_points import derived_points
from liex_lab.geometry import SE3, so3
from liex_lab.optics.camera import Camera
from liex_lab.sessions import Session
from liex_lab.sessions.correcting import joint_move
from liex_lab.tables.schema import POINTS
from tests.sessions.walking_mouse import WalkingMouse, steady, write

MOUSE = Skeleton.load("mouse")
SKIN = Surface.of(MOUSE)
OURS = points_of(MOUSE)
NAMES = (
    *("nose", "left_ear_base", "right_ear_base", "neck", "left_side", "right_side"),
    *("body_centre", "left_hip", "right_hip", "tail_base"),
)


def bent(n: int, mirrored: bool = False) -> Pose:
    """Mice that walk and turn; mirrored: what a mirror along their walk shows of them."""
    rng = np.random.default_rng(11)
    angles = np.zeros((n, MOUSE.n_joints, 3))
    angles[:, 1:-1, 1] = rng.uniform(-0.15, 0.15, (n, MOUSE.n_joints - 2))
    angles[:, 1:-1, 2] = rng.uniform(-0.4, 0.4, (n, MOUSE.n_joints - 2))
    turn = np.stack([np.zeros(n), np.zeros(n), rng.uniform(-3, 3, n)], axis=-1)
    place = np.stack([*rng.uniform(-8, 8, (2, n)), np.full(n, 20.0)], axis=-1)
    if mirrored:
        angles[..., [0, 2]] *= -1.0
        turn *= -1.0
        place[:, 1] *= -1.0
    return Pose(SE3(so3.exp(turn), place), angles, rng.uniform(0.9, 1.2, n))


def placed(pose: Pose) -> tuple[np.ndarray, np.ndarray]:
    n = len(pose.scale)
    return place_points(OURS, SKIN, pose, 0.95 * pose.scale, np.full((n, MOUSE.n_joints, 3), 2.0))


def test_points_lie_on_the_rendered_skin_and_are_seen_from_above():
    pose = bent(3)
    points, _ = placed(pose)
    camera = Camera(1e4, 1e4, 600.0, 600.0, 1200, 1200)  # a tenth of a mm is a pixel
    above = SE3(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, 1000.0]))
    for mesh, own in zip(SKIN.vertices(pose, girth=0.95 * pose.scale), points, strict=True):
        depth = render_mesh(mesh, SKIN.faces, camera, T_camera_mesh=above)
        u, v = np.rint(camera.project(above @ own)).astype(int).T
        np.testing.assert_allclose(1000.0 - depth[v, u], own[:, 2], atol=0.6)


def test_left_is_left_and_a_mirrored_mouse_has_mirrored_points():
    pose = bent(20)
    points, spread = placed(pose)
    left = [k for k, name in enumerate(NAMES) if name.startswith("left")]
    right = [NAMES.index(NAMES[k].replace("left", "right")) for k in left]
    to_the_left = pose.frames(MOUSE).rotation[:, 1, :, 1]
    apart = np.einsum("nmd,nd->nm", points[:, left] - points[:, right], to_the_left)
    assert (apart > 5.0).all()
    swapped = np.arange(len(NAMES))
    swapped[[*left, *right]] = [*right, *left]
    others, other_spread = placed(bent(20, mirrored=True))
    # the triangles of the two sides are not each other's mirror images
    np.testing.assert_allclose(others[:, swapped] * [1.0, -1.0, 1.0], points, atol=0.15)
    np.testing.assert_allclose(other_spread[:, swapped], spread, atol=1e-9)


def test_deviations_are_those_of_the_pose_and_of_the_place():
    pose = Pose.home(MOUSE, 1)
    _, spread = placed(pose)
    stated = np.array([one.sd_mm for one in OURS])
    np.testing.assert_allclose(spread[0], np.sqrt(4.0 + stated**2))
    assert (stated[[1, 2]] >= 3.0).all()  # the base of an ear is a matter of anatomy
    turned = Pose(SE3(so3.exp([[0.0, 0.0, np.pi / 2]]), np.zeros((1, 3))), pose.angles, pose.scale)
    np.testing.assert_allclose(placed(turned)[1], spread[:, :, [1, 0, 2]])


def test_the_table_has_a_row_for_every_frame_and_point(session, tmp_path):
    folder = export(session, "points", tmp_path)
    table = pd.read_parquet(folder / "points.parquet")
    poses = session.poses
    assert list(table) == [column.name for column in POINTS]
    assert len(table) == 116 * 11
    assert tuple(table["point"][:11]) == (*NAMES, "tail_30mm")
    observed = table[~table["derived"]]
    assert len(observed) == 116
    assert observed["likelihood"].dropna().between(0.0, 1.0).all()
    np.testing.assert_array_equal(table["turn_rad"].notna(), table["lift_rad"].notna())
    np.testing.assert_array_equal(observed["turn_rad"].isna(), observed["x_mm"].isna())
    table = table[table["derived"]]
    lost = poses.groupby("frame_index")["x_mm"].apply(lambda x: x.isna().all())
    empty = table.set_index("frame_index")[["x_mm", "sd_z_mm", "u_px", "likelihood"]].isna()
    assert lost.sum() == 2
    for column in empty:
        np.testing.assert_array_equal(empty[column], np.repeat(lost.to_numpy(), 10))
    joint = poses.query("joint == 'nose'")[["x_mm", "y_mm", "z_mm"]].to_numpy()
    point = table.query("point == 'nose'")[["x_mm", "y_mm", "z_mm"]].to_numpy()
    assert np.nanmax(np.linalg.norm(joint - point, axis=1)) < 6.0
    about = json.loads(pq.read_schema(folder / "points.parquet").metadata[b"liex_lab"])
    assert about["schema_version"] == session.metadata["schema_version"]
    assert "derived" in about["joints"]
    arena = table[["x_mm", "y_mm", "z_mm"]].to_numpy()
    pixels = session.camera.project(session.T_arena_camera.inverse() @ arena)
    np.testing.assert_allclose(table[["u_px", "v_px"]], pixels)


def test_mabe_s_table_has_its_columns_and_its_names(session, tmp_path):
    tracking = pd.read_csv(export(session, "points", tmp_path) / "mabe.csv")
    assert list(tracking) == ["video_frame", "mouse_id", "bodypart", "x", "y"]
    assert {"ear_left", "hip_right", "body_center", "lateral_left"} < set(tracking["bodypart"])
    wide = tracking.pivot(index="video_frame", columns="bodypart", values=["x", "y"])
    assert wide.shape == (116, 20)


def test_other_formats_hold_points_in_place_of_joints(session, tmp_path):
    points = derived_points(session)
    data = xarray.load_dataset(
        export(session, "movement", tmp_path, points=True), engine="h5netcdf"
    )
    assert tuple(data["keypoints"].values) == NAMES
    ear = data["position"].sel(keypoints="left_ear_base", individuals="mouse_1")
    np.testing.assert_array_equal(ear, points.xyz_mm[:, 1])
    assert data.attrs["keypoints"] == "derived, on the skin"
    words = ["export", str(session.path), "--to", "dlc", "--points", "--out", str(tmp_path)]
    ran = CliRunner().invoke(cli.app, words)
    assert ran.exit_code == 0, ran.output
    for name in ("poses_2d.csv", "poses_3d.csv"):
        read = pd.read_csv(tmp_path / "circle_points_dlc" / name, header=[0, 1, 2], index_col=0)
        assert read.shape == (116, 30)
        assert tuple(read.columns.get_level_values(1)[::3]) == NAMES
    with h5py.File(export(session, "sleap", tmp_path, points=True)) as file:
        assert file["tracks"].shape == (1, 2, 10, 116)
        assert tuple(file["node_names"].asstr()) == NAMES
    with pytest.raises(SessionError, match="dlc, movement, sleap, not to csv"):
        export(session, "csv", tmp_path, points=True)


def test_points_follow_a_correction(session, tmp_path):
    own = Session.open(shutil.copytree(session.path, tmp_path / "circle.liex"))
    nose = own.pose_arrays().xyz_mm[10, -1] + [0.0, 0.0, 20.0]
    correct_session(own.path, [joint_move(own, 10, "nose", nose)], author="ada", report=False)
    raised = derived_points(Session.open(own.path)).xyz_mm - derived_points(session).xyz_mm
    assert raised[10, NAMES.index("nose"), 2] > 12.0
    np.testing.assert_allclose(raised[60], 0.0, atol=1e-6)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (lambda points: points[0].pop("station"), "0.station Field required"),
        (lambda points: points[0].update(station=3.0), "nose needs a station from -0.08 to 1.0"),
        (
            lambda points: points[0].update(sd_mm=[1.0, 0.0, 1.0]),
            "0.sd_mm.1 should be greater than 0",
        ),
        (lambda points: points[0].update(angle=3.0), "0.angle Extra inputs are not permitted"),
        (lambda points: points[0].update(name="neck"), "neck is listed twice"),
        (lambda points: points.append("nose"), "10 should be a valid dictionary"),
        (lambda points: points.clear(), "need a skeleton that lists them"),
    ],
)
def test_a_mistake_in_the_points_is_a_sentence(change, sentence):
    table = tomllib.loads((PRESETS / "mouse.toml").read_text(encoding="utf-8"))
    change(table["points"])
    with pytest.raises(LiexError, match=sentence):
        points_of(Skeleton.from_table(table, "mine.toml"))


def test_an_animal_without_points_is_a_sentence_and_leaves_no_file(tmp_path):
    fish = WalkingMouse(steady(0.2), skeleton=Skeleton.load("fish"))
    session = write(tmp_path / "fish.liex", fish)
    with pytest.raises(LiexError, match="as the bundled mouse; 'fish' does not"):
        export(session, "points", tmp_path / "out")
    assert not list((tmp_path / "out").iterdir())


def test_a_session_of_imported_points_has_no_skin(session, tmp_path):
    imported = Session(session.path, {**session.metadata, "imported": {"joints": {}}})
    with pytest.raises(SessionError, match="imported without it; export the joints"):
        export(imported, "dlc", tmp_path, points=True)


def test_a_skeleton_stored_before_points_were_listed_has_those_of_its_preset():
    table = tomllib.loads((PRESETS / "mouse.toml").read_text(encoding="utf-8"))
    del table["points"]
    assert tuple(one.name for one in points_of(Skeleton.from_table(table, "old"))) == NAMES
