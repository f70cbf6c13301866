"""From a plan to objects: the recording as the plan says."""

from pathlib import Path

import numpy as np
import pytest
from liex_lab.pipelines.build import (
    build_estimator,
    build_recogniser,
    build_recording,
    build_stated_shape,
    why_nameless,
)

from liex_lab.body import Skeleton
from liex_lab.catalog import MODELS
from liex_lab.errors import LiexError, PlanError
from liex_lab.optics.camera import Distortion
from liex_lab.plan import Plan
from liex_lab.recordings import open_recording
from tests.recordings.writers import (
    cut,
    depth_frames,
    write_archive,
    write_mcap,
    write_moseq_folder,
    write_png_folder,
)

STORED = depth_frames(5)
LENS = ["camera.fx=61", "camera.fy=62", "camera.cx=31", "camera.cy=24"]


def plan(*settings: str) -> Plan:
    return Plan.load("mouse").with_settings(settings)


def without_camera(kind: str, folder: Path) -> Path:
    """A recording that says nothing about its camera."""
    if kind == "mcap":
        return write_mcap(folder / "r.mcap", STORED, camera=None)
    if kind == "moseq":
        return write_moseq_folder(folder / "r", STORED)
    (write_png_folder(folder / "r", STORED) / "camera.toml").unlink()
    return folder / "r"


@pytest.mark.parametrize("kind", ["images", "moseq", "mcap"])
def test_a_plan_with_all_intrinsics_opens_a_recording_that_has_none(
    tmp_path: Path, kind: str
) -> None:
    path = without_camera(kind, tmp_path)
    with pytest.raises(LiexError, match=r"camera\.toml"):
        build_recording(path, plan(*LENS[:3]))
    with build_recording(path, plan(*LENS)) as recording:
        camera = recording.camera
        assert (camera.fx, camera.fy, camera.cx, camera.cy) == (61.0, 62.0, 31.0, 24.0)
        assert (camera.width, camera.height, camera.source) == (64, 48, "plan")
    with build_recording(path, plan(*LENS, "camera.source=own calibration")) as recording:
        assert recording.camera.source == "own calibration"


def test_a_plan_overrules_a_part_of_what_the_recording_states(tmp_path: Path) -> None:
    path = write_png_folder(tmp_path / "r", STORED)
    with build_recording(path, plan("camera.fx=70")) as recording:
        assert (recording.camera.fx, recording.camera.fy, recording.camera.source) == (
            70.0,
            61.0,
            "plan",
        )
    with open_recording(path) as opened, build_recording(opened, plan("camera.fx=70")) as recording:
        assert recording.camera.fx == 70.0


def test_what_is_typical_is_not_complained_of_once_the_plan_states_it(tmp_path: Path) -> None:
    path = write_moseq_folder(tmp_path / "r", depth_frames(2, 512, 424), metadata={})
    with build_recording(path, plan()) as recording:
        assert any("typical Kinect v2" in problem for problem in recording.problems)
    with build_recording(path, plan(*LENS)) as recording:
        assert not any("typical" in problem for problem in recording.problems)


def test_unpacking_an_archive_is_shown(tmp_path: Path) -> None:
    archive = write_archive(write_moseq_folder(tmp_path / "r", STORED), tmp_path / "r.tar.gz")
    told: list[str] = []
    with build_recording(archive, plan(*LENS), lambda done, total, what: told.append(what)):
        assert any("unpack" in what for what in told)


def test_a_recording_that_is_cut_short_needs_the_plans_consent(tmp_path: Path) -> None:
    path = write_moseq_folder(tmp_path / "r", STORED)
    cut(path / "depth.dat", 0.7)
    with pytest.raises(LiexError, match="accept_truncated=true"):
        build_recording(path, plan(*LENS))
    with build_recording(path, plan(*LENS, "recording.accept_truncated=true")) as recording:
        assert len(recording) == 3


BARREL = [-0.2, 0.04, 0.001, -0.001]


def test_what_a_file_says_of_its_lens_is_undone_and_the_plan_overrules_it(tmp_path: Path) -> None:
    path = write_png_folder(tmp_path / "r", STORED, distortion=BARREL)
    with open_recording(path) as raw:
        assert raw.camera.distortion == Distortion.of("plumb_bob", BARREL)
        original = raw.frame(0).depth
    with build_recording(path, plan()) as recording:
        assert recording.camera.distortion is None
        assert recording.optics["distortion"]["coefficients"][:4] == BARREL
        assert (
            recording.frame(0).depth.shape == (recording.height, recording.width) != original.shape
        )
    with build_recording(path, plan("camera.distortion=[0.1]")) as recording:
        assert (recording.frame(0).depth != original).any()
    with build_recording(path, plan("camera.distortion=[]")) as recording:
        assert recording.optics == {}
        assert (recording.frame(0).depth == original).all()
    with build_recording(
        path, plan(*LENS)
    ) as recording:  # a camera that is stated as a whole is the whole camera
        assert recording.optics == {}
    with pytest.raises(LiexError, match="'mei' is not supported"):
        build_recording(path, plan("camera.distortion=[0.1]", "camera.distortion_model=mei"))


def test_the_water_of_the_plan_is_undone(tmp_path: Path) -> None:
    path = write_png_folder(tmp_path / "r", STORED)
    with build_recording(path, plan("water.height_mm=500", "water.ranging=paraxial")) as recording:
        assert recording.optics["water"]["height_mm"] == 500.0
        # stored are 700 mm: 200 mm below the surface as it seems, and 500 mm above it
        assert recording.frame(0).depth[5, 30] == pytest.approx(1.333 * 700, abs=3)


def test_a_model_is_kept_until_another_one_is_in_its_place(tmp_path):
    own = tmp_path / "own.npz"
    own.write_bytes((MODELS / "mouse.npz").read_bytes())
    first = build_estimator(plan(f"estimation.model={own}"))
    assert build_estimator(plan(f"estimation.model={own}", "animal.spine_mm=70")) is first
    own.write_bytes((MODELS / "fish.npz").read_bytes())
    with pytest.raises(LiexError, match="made for the skeleton fish"):
        build_estimator(plan(f"estimation.model={own}"))


def test_no_actions_are_named_of_an_animal_that_no_vocabulary_was_made_for() -> None:
    hand = Skeleton.load("hand")
    plan = Plan.load("hand")
    assert build_recogniser(plan, hand) is None
    assert "no vocabulary was made for a hand" in why_nameless(plan, hand)
    assert why_nameless(plan.with_settings(["actions.model=rules"]), hand) == ""
    assert why_nameless(Plan.load("mouse"), Skeleton.load("mouse")) == ""


def test_a_shape_that_sessions_share_is_that_of_their_skeleton() -> None:
    skeleton = Skeleton.load("fish")
    moved = [[0.0, 0.001, -0.01]] * skeleton.n_joints
    table = Plan.load("fish").model_dump(exclude_none=True)

    def sharing(**more: object) -> Plan:
        shape = {"width": [1.1] * 5, "height": [0.9] * 5, "joints_moved": moved} | more
        body = {"subject": "z1", "n_sessions": 3, "shape": shape}
        return Plan.from_table({**table, "animal": {**table["animal"], "shared": body}})

    stated = build_stated_shape(sharing(), skeleton)
    assert stated is not None
    assert stated.labels is not None
    assert (len(stated.labels), stated.by) == (3 * skeleton.n_joints + 10, "3 sessions of z1")
    np.testing.assert_allclose(np.exp(stated.labels[-10:]), [1.1] * 5 + [0.9] * 5)
    with pytest.raises(PlanError, match="lists 5 joints, and the fish has 21"):
        build_stated_shape(sharing(joints_moved=moved[:5]), skeleton)
    assert build_stated_shape(Plan.load("fish"), skeleton) is None
