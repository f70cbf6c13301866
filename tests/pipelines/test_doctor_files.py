"""Doctor refuses nothing that it can read: what is missing is guessed and told, and cameras have
names.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
from liex_lab.pipelines import choice
from liex_lab.pipelines.build import open_planned
from liex_lab.pipelines.choice import PlanFit, Proposal, propose_plan
from liex_lab.pipelines.doctor import examine, next_command, open_anyhow

from liex_lab.errors import LiexError, RecordingError
from liex_lab.optics.camera import PRESETS, Camera, of_size, preset, unusual_centre, unusual_lens
from liex_lab.plan import Plan
from liex_lab.plan.sections import CameraName
from tests.pipelines.test_choice import FISH, GOOD, RECORDING
from tests.recordings.writers import depth_frames, write_png_folder


def pictures(folder: Path, width: int = 512, height: int = 424, n: int = 6) -> Path:
    """A folder of pictures and nothing else."""
    write_png_folder(folder, depth_frames(n, width, height, floor_mm=700))
    for more in ("camera.toml", "timestamps.csv"):
        (folder / more).unlink(missing_ok=True)
    return folder


def test_pictures_alone_get_a_diagnosis_and_the_lines_to_write(tmp_path: Path) -> None:
    found = examine(pictures(tmp_path / "p"))
    camera, times = found["missing"]
    assert "the camera is not known" in camera
    assert "--set camera.preset=kinect-v2" in camera
    assert "fx = 365" in camera
    assert "fps = 30" in times
    assert found["intrinsics_source"] == "assumed: not stated"
    assert found["fx"] == 365.0
    assert found["floor_mm"] == pytest.approx(700, abs=2)


def test_a_picture_of_an_unusual_size_is_looked_at_with_a_usual_field_of_view(
    tmp_path: Path,
) -> None:
    recording, missing = open_anyhow(pictures(tmp_path / "p", 200, 150), Plan())
    with recording:
        assert recording.camera.fx == 180.0
        assert (recording.camera.cx, recording.camera.cy) == (99.5, 74.5)
    assert "preset" not in missing[0]


def test_a_run_still_refuses_what_a_diagnosis_guesses(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="the camera is not known"):
        open_planned(pictures(tmp_path / "p"), Plan())


def test_a_named_camera_makes_pictures_readable_and_its_size_is_checked(tmp_path: Path) -> None:
    folder = pictures(tmp_path / "p")
    named = Plan().with_settings(["camera.preset=kinect-v2", "recording.fps=30.0"])
    with open_planned(folder, named) as recording:
        assert recording.camera.fx == 365.0
        assert recording.camera.source == "preset kinect-v2"
    with open_planned(folder, named.with_settings(["camera.fx=364.0"])) as recording:
        assert recording.camera.fx == 364.0, "what is stated goes before the preset"
    wrong = named.with_settings(["camera.preset=azure-nfov"])
    with pytest.raises(LiexError, match="has images of 640 x 576 px, but these have 512 x 424"):
        open_planned(folder, wrong)


def test_every_camera_that_a_plan_may_name_is_there_and_sees_as_wide_as_it_should() -> None:
    assert set(get_args(CameraName)) == set(PRESETS)
    for name, cameras in PRESETS.items():
        for camera in cameras:
            found = preset(name, camera.width, camera.height)
            assert replace(found, source=camera.source) == camera
            assert name in of_size(camera.width, camera.height)
            view = np.degrees(2 * np.arctan(camera.width / 2 / camera.fx))
            assert 20 < view < 95
            corner = camera.unproject([0.0, 0.0], 1000.0)
            np.testing.assert_allclose(camera.project(corner), [0.0, 0.0], atol=0.05)


def test_a_camera_that_has_no_preset_is_told() -> None:
    with pytest.raises(LiexError, match=r"camera\.preset is one of kinect-v2"):
        preset("kodak", 640, 480)


@pytest.mark.parametrize("factor", [1.3, 1 / 1.3])
def test_a_focal_length_that_no_known_camera_has_is_told(tmp_path: Path, factor: float) -> None:
    for name in ("kinect-v2", "primesense", "azure-nfov"):
        for camera in PRESETS[name]:
            for scale in (0.92, 1.0, 1.08):
                usual = replace(camera, fx=scale * camera.fx, fy=scale * camera.fy)
                assert not unusual_lens(usual)
            wrong = replace(camera, fx=factor * camera.fx, fy=factor * camera.fy)
            assert f"{name} {camera.fx:.0f}" in unusual_lens(wrong)
    assert not unusual_lens(Camera(2000.0, 2000.0, 700.0, 500.0, 1400, 1000)), "not known at all"

    lens = {"fx": 365.0 * factor, "fy": 365.0 * factor, "cx": 255.5, "cy": 211.5}
    stated = [*(f"camera.{name}={value!r}" for name, value in lens.items()), "recording.fps=30.0"]
    found = examine(pictures(tmp_path / "p"), Plan().with_settings(stated))
    assert any("differs from all preset cameras" in one for one in found["problems"])


def test_doctor_proposes_the_plan_and_says_what_to_run_next(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    long = PlanFit("mouse", replace(GOOD, spine_mm=300.0), ("it is 300 mm long",))
    fits = {
        "mouse": long,
        "fish": PlanFit("fish", FISH),
        "hand": PlanFit("hand", None, ("no hand",)),
    }

    def try_plan(_: object, plan: Plan | str) -> PlanFit:
        return fits[plan if isinstance(plan, str) else plan.animal.name]

    monkeypatch.setattr(choice, "try_plan", try_plan)
    unnamed = propose_plan(RECORDING)
    assert (unnamed.plan, unnamed.problems) == ("fish", ())
    assert next_command("a b.mcap", unnamed, []) == "liex run 'a b.mcap' --plan fish"
    assert next_command("a.mcap", unnamed, ["x"]).startswith("write what is missing")
    named = propose_plan(RECORDING, Plan.load("mouse"))
    assert "it is 300 mm long; say --plan fish" in named.problems[0]
    fits["fish"] = PlanFit("fish", None, ("no fish",))
    none = propose_plan(RECORDING)
    assert none.plan is None
    assert none.says == "none fits. mouse: it is 300 mm long. fish: no fish. hand: no hand"
    fits["mouse"] = PlanFit("mouse", replace(GOOD, n_animals=2))
    two = propose_plan(RECORDING)
    assert "2 animals are in view" in two.problems[0]
    assert next_command("a.mcap", two, []) == "liex run a.mcap"
    assert next_command("a.mcap", Proposal(None, ""), []) == ""


def test_the_next_command_keeps_the_plan_and_the_options_that_were_given(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    fits = {"mouse": PlanFit("mouse", GOOD), "fish": PlanFit("fish", None, ("no fish",))}
    fits["hand"] = PlanFit("hand", None, ("no hand",))
    monkeypatch.setattr(
        choice,
        "try_plan",
        lambda _, plan: fits[plan if isinstance(plan, str) else plan.animal.name],
    )
    typed = ("my plans/plan.toml", ["--topic", "/depth", "--set", "recording.fps=30.0"])
    right = propose_plan(RECORDING, Plan.load("mouse"))
    assert next_command("a.mcap", right, [], 0, *typed) == (
        "liex run a.mcap --plan 'my plans/plan.toml' --topic /depth --set recording.fps=30.0"
    )
    assert next_command("a.mcap", right, [], 0, "mouse") == "liex run a.mcap --plan mouse"
    assert next_command("a.mcap", right, ["x"], 0, *typed) == (
        "write what is missing, then liex doctor a.mcap --plan 'my plans/plan.toml' --topic /depth "
        "--set recording.fps=30.0"
    )
    wrong = propose_plan(RECORDING, Plan.load("fish"))
    assert "say --plan mouse" in wrong.problems[0]
    assert next_command("a.mcap", wrong, [], 0, "fish") == "liex run a.mcap --plan mouse"
    fits["mouse"] = PlanFit("mouse", None, ("no mouse",))
    none = propose_plan(RECORDING, Plan.load("fish"))
    assert next_command("a.mcap", none, [], 0, "fish").startswith("liex doctor a.mcap --plan fish")


DEPTH = (
    "hand_kinect2",
    "depth_files/primesense_pcl",
    "depth_files/realsense_bag/single_depth_color_640x480.bag",
    "depth_files/xtion_open3d",
    "depth_files/other_formats",
    "depth_files/other_formats/NYU_depth.pgm",
    "depth_files/other_formats/SUN_depth.png",
    "depth_files/other_formats/TUM_depth.png",
    "mouse_kinect2/first_frame.png",
    "mouse_kinect2/background.png",
    "hand_nyu",
    "hand_nyu/depth_1_0000001.png",
)


@pytest.mark.parametrize("name", DEPTH)
def test_every_genuine_file_that_holds_depth_gets_a_diagnosis(
    reference_data: Path, name: str
) -> None:
    found = examine(reference_data / name)
    assert found["n_frames"] >= 1
    assert found["depth_max_mm"] is not None
    assert all("write" in sentence or "choose" in sentence for sentence in found["missing"])


@pytest.mark.parametrize(
    ("cx", "cy", "said", "at_edge"),
    [
        (159.5, 119.5, False, False),
        (97.0, 165.0, False, False),
        (95.0, 119.5, True, False),
        (159.5, 170.0, True, False),
        (319.5, 119.5, True, True),
        (159.5, -0.5, True, True),
        (600.0, 400.0, True, True),
    ],
)
def test_a_principal_point_far_from_the_middle_is_reported(
    cx: float, cy: float, said: bool, at_edge: bool
) -> None:
    sentence, edge = unusual_centre(Camera(287.9, 287.9, cx, cy, 320, 240))
    assert (f"({cx:.1f}, {cy:.1f})" in sentence, edge) == (said, at_edge)


def test_every_known_camera_looks_through_its_middle() -> None:
    for cameras in PRESETS.values():
        for camera in cameras:
            assert unusual_centre(camera) == ("", False)
