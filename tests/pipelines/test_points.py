"""3D points of another program become a session with our measures, and without what needs depth."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from liex_lab.dashboards.figures.animals import joints_in_image, session_animals
from liex_lab.pipelines.correct import correct_session
from liex_lab.pipelines.points import (
    check_track,
    import_animals,
    import_points,
    place_joints,
    track_of_points,
)

from liex_lab.body.skeleton import Skeleton
from liex_lab.errors import LiexError
from liex_lab.exchange.points import PointNames, Points, read_points
from liex_lab.plan import Plan
from liex_lab.sessions import Session
from liex_lab.sessions.correcting import add_bout
from tests.conftest import ABSENT
from tests.sessions.walking_mouse import WalkingMouse, steady

MOUSE = WalkingMouse(steady(6.0), rear_s=(2.0, 3.5))
TRUE = MOUSE.track().joints_mm
SKELETON = Skeleton.load("mouse")
ENDS = {"rump": ["tail_base"], "nose": ["nose"]}


def points(joints: np.ndarray = TRUE, **more: Any) -> Points:
    names = ("tail_base", "loin", "chest", "neck", "nose")
    return replace(Points(MOUSE.times_s, names, joints, None, "", 0.0, None), **more)


def written(folder: Path, joints: np.ndarray = TRUE, names: str = "tail_base nose") -> Path:
    np.savez(folder / "m01.npz", points_mm=joints, points=names.split(), time_s=MOUSE.times_s)
    return folder / "m01.npz"


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Session:
    folder = tmp_path_factory.mktemp("points")
    joints = TRUE.copy()
    joints[60:64, 0] = np.nan  # bridged
    joints[130:] = np.nan
    file = written(folder, joints[:, [0, 3, 4]] - [0.0, 0.0, 30.0], "tail_base neck nose")
    (folder / "names.toml").write_text("floor = -30.0\n")
    return Session.open(
        import_points(file, "mouse", folder, names=folder / "names.toml", report=True)
    )


def test_a_session_of_points_has_our_tables(session):
    poses = session.pose_arrays()
    np.testing.assert_allclose(poses.xyz_mm[:60, 0], TRUE[:60, 0], atol=1e-6)
    np.testing.assert_allclose(poses.xyz_mm[:60, 4], TRUE[:60, 4], atol=1e-6)
    speed = session.kinematics["speed_mm_s"].iloc[5:30]
    assert speed.median() == pytest.approx(200.0, rel=0.03)
    assert "rear" in set(session.bouts["action"])
    assert set(session.bouts["source"]) == {"rule"}
    assert session.summary["distance_m"].iloc[0] > 0.5
    assert session.metadata["subject"]["subject_id"] == "m01"


def test_gaps_are_bridged_or_left_empty(session):
    frames = session.frames
    assert frames["bridged"].iloc[60:64].all()
    assert (frames["flag"].iloc[131:] == "not_found").iloc[60:].all()
    lost = np.isnan(session.pose_arrays().xyz_mm[-1])
    assert lost.all()


def test_what_needs_depth_is_absent_and_the_report_begins_with_that(session):
    about = session.metadata
    assert about["imported"]["derived_joints"] == ["loin", "chest"]
    assert about["imported"]["floor_mm"] == -30.0
    assert "What needs depth is absent" in about["problems"][0]
    assert session.frames[["predicted_error_mm", "residual_mm"]].isna().all(axis=None)
    assert session.poses[["sd_mm", "u_px"]].isna().all(axis=None)
    page = (session.path / "report.html").read_text()
    assert page.index("What needs depth is absent") < page.index("How good it is")
    assert "3D points of one mouse" in page
    assert "Depth images of one" not in page
    assert not about["thumbnails"]
    json.loads((session.path / "session.json").read_text())


def test_the_dashboard_shows_the_points_from_above(session):
    (uv,) = joints_in_image(session_animals(session), len(session.frames))
    away = np.linalg.norm(np.diff(uv[:60, [0, 4]], axis=1), axis=2).ravel()
    level = np.linalg.norm(np.diff(TRUE[:60, [0, 4], :2], axis=1), axis=2).ravel()
    np.testing.assert_allclose(away, level, rtol=0.1)


def test_joints_without_points_lie_on_the_curve_through_the_others():
    found = place_joints(points(), SKELETON, ENDS)
    straight = (
        TRUE[:, :1] + (TRUE[:, -1:] - TRUE[:, :1]) * (SKELETON.reach / SKELETON.length)[:, None]
    )
    np.testing.assert_allclose(found, straight, atol=1e-9)
    whole = {name: [point] for name, point in zip(SKELETON.names, points().names, strict=True)}
    np.testing.assert_allclose(place_joints(points(), SKELETON, whole), TRUE)


def test_the_poses_of_points_are_those_of_the_body_that_moved():
    whole = {name: [point] for name, point in zip(SKELETON.names, points().names, strict=True)}
    track = track_of_points(points(), SKELETON, whole, 0.5)
    np.testing.assert_allclose(track.pose.joints(SKELETON), TRUE, atol=1e-6)


def test_frames_of_low_scores_are_doubtful():
    scores = np.full((len(TRUE), 5), 0.9)
    scores[3:5] = 0.2
    track = track_of_points(points(scores=scores), SKELETON, ENDS, 0.5)
    assert list(np.flatnonzero(track.flag == "doubtful")) == [3, 4]


@pytest.mark.parametrize(
    ("joints", "sentence"),
    [
        (TRUE * 4.0, "pixels are not millimetres"),
        (TRUE * 0.001, "pixels are not millimetres"),
        (TRUE[:, ::-1], "moves tail first"),
        (TRUE[..., [2, 1, 0]] + [0.0, 0.0, 300.0], "above the floor"),
        (TRUE[:, [0, 4, 1, 3, 2]], "do not follow each other along a body"),
    ],
    ids=["pixels", "metres", "exchanged", "upwards", "order"],
)
def test_points_that_are_no_mouse_are_refused(joints, sentence):
    whole = {name: [point] for name, point in zip(SKELETON.names, points().names, strict=True)}
    with pytest.raises(LiexError, match=sentence):
        check_track(track_of_points(points(joints), SKELETON, whole, 0.5), Plan.load("mouse"))


def test_a_refused_file_leaves_nothing(tmp_path):
    file = written(tmp_path, TRUE[:, [0, 4]] * 5.0)
    with pytest.raises(LiexError, match="pixels"):
        import_points(file, "mouse", tmp_path)
    with pytest.raises(LiexError, match="limbs"):
        import_points(file, "hand", tmp_path)
    nothing = TRUE[:, [0, 4]].copy()
    nothing[:62, 1] = nothing[67:, 1] = np.nan
    with pytest.raises(LiexError, match=r"5 of .* frames have points at both ends"):
        import_points(written(tmp_path, nothing), "mouse", tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["m01.npz"]


def several(folder: Path, second: np.ndarray) -> Path:
    """Two animals in one table, a row per frame, animal and keypoint."""
    rows = [
        {"time": t, "individual": name, "keypoint": point, "x": x, "y": y, "z": z}
        for name, joints in (("ada", TRUE), ("bob", second))
        for t, frame in zip(MOUSE.times_s, joints, strict=True)
        for point, (x, y, z) in zip(points().names, frame, strict=True)
    ]
    pd.DataFrame(rows).to_csv(folder / "pair.csv", index=False)
    return folder / "pair.csv"


def test_several_animals_of_a_file_become_sessions_with_their_interactions(tmp_path):
    behind = TRUE.copy()  # bob follows ada by 0.5 s
    behind[15:] = TRUE[:-15]
    behind[:15] = np.nan
    file = several(tmp_path, behind)
    with pytest.raises(LiexError, match="holds the animals ada, bob; choose one"):
        import_points(file, "mouse", tmp_path)
    folders = import_animals(file, "mouse", tmp_path)
    page = (folders[1] / "report.html").read_text()
    assert "ada → bob" in page
    assert "interaction_totals.parquet" in page
    assert [one.name for one in folders] == ["pair-ada.liex", "pair-bob.liex"]
    ada, bob = map(Session.open, folders)
    assert [ada.metadata["individual"], bob.metadata["individual"]] == ["ada", "bob"]
    assert bob.metadata["subject"]["subject_id"] == "pair-bob"
    found = ada.interactions
    pd.testing.assert_frame_equal(
        found.drop(columns="session_id"), bob.interactions.drop(columns="session_id")
    )
    follows = found[found["action"] == "follow"]
    assert set(follows["agent"]) == {"bob"}
    assert follows["start_s"].min() >= 0.5  # before, bob is not observed
    totals = ada.interaction_totals.set_index(["agent", "target", "action"])
    assert totals.loc[("bob", "ada", "follow"), "total_s"] == pytest.approx(
        follows["duration_s"].sum(), rel=0.02
    )
    described = set(ada.columns.loc[ada.columns["table"] == "interactions", "name"])
    assert described == set(found.columns)
    assert set(ada.metadata["interactions"]["definitions"]) >= set(found["action"])
    correct_session(folders[0], [add_bout(ada, "groom", 1.0, 2.0)], report=False)
    corrected = Session.open(folders[0])
    assert set(corrected.columns.loc[corrected.columns["table"] == "interactions", "name"]) == (
        described
    )
    pd.testing.assert_frame_equal(corrected.interactions, found)
    (alone,) = import_animals(file, "mouse", tmp_path / "one", individual="ada", report=False)
    assert alone.name == "pair.liex"
    assert not Session.open(alone).has("interactions.parquet")
    assert "interactions" not in set(Session.open(alone).columns["table"])


def test_no_session_is_written_if_one_of_several_animals_cannot_be_used(tmp_path):
    file = several(tmp_path, TRUE[:, ::-1])
    with pytest.raises(LiexError, match="of the animal bob the animal moves tail first"):
        import_animals(file, "mouse", tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["pair.csv"]


REAL = Path(__file__).parents[2].parent / "shared/data/mouse_actions_3d/adult_6112.npz"


@pytest.mark.skipif(not REAL.is_file(), reason=ABSENT)
def test_points_of_a_real_mouse_pass_the_checks():
    names = PointNames()
    found = read_points(REAL, names)
    mapped = names.of_joints(SKELETON.names, found.names)
    track = track_of_points(found, SKELETON, mapped, 0.5)
    check_track(track, Plan.load("mouse"))
    assert 50.0 < np.median(track.spine_mm) < 80.0
