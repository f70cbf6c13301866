"""`liex doctor`: the facts of a recording, and what is wrong with it."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from liex_lab.pipelines.doctor import FINDINGS, examine, lines, print_report

from liex_lab.errors import RecordingError
from liex_lab.optics.camera import Camera, Distortion
from liex_lab.optics.refraction import Water
from liex_lab.plan import Plan
from liex_lab.scene.floor import Floor
from tests.oracles.plate import Plate, bent_down
from tests.oracles.refraction import seen
from tests.recordings.oni_files import depth_builder
from tests.recordings.ros_writers import write_bag
from tests.recordings.writers import (
    Frames,
    cut,
    depth_frames,
    even_times,
    write_camera,
    write_mcap,
    write_moseq_folder,
    write_oni_file,
    write_png_folder,
)

KEYS = [
    "format",
    "n_frames",
    "duration_s",
    "rate_hz",
    "jitter_ms",
    "n_gaps",
    "n_missing",
    "n_time_faults",
    "width",
    "height",
    "fx",
    "fy",
    "cx",
    "cy",
    "intrinsics_source",
    "distortion",
    "water",
    "depth_min_mm",
    "depth_max_mm",
    "unread_share",
    "floor_unread_share",
    "noise_mm",
    "floor_mm",
    "floor_tilt_rad",
    "water_depth_mm",
    "arena",
    "scene",
    "animal_length_mm",
    "animal_area_mm2",
    "animal_share",
    "animal_sits_still",
    "session_mb",
    "arenas",
    "plan",
    "plan_says",
    "n_animals",
    "missing",
    "problems",
    "next",
]
CAMERA = Camera(140.0, 141.0, 79.5, 59.5, 160, 120)


def frames(n: int = 12, floor_mm: int = 700) -> Frames:
    return depth_frames(n, 160, 120, floor_mm=floor_mm)


def examined(path: Path, *settings: str) -> dict[str, Any]:
    """The findings, which JSON must be able to hold as they are."""
    findings = examine(path, Plan().with_settings(settings))
    assert list(findings) == KEYS == list(FINDINGS)
    assert json.loads(json.dumps(findings, allow_nan=False)) == findings
    assert all("\n" not in problem for problem in findings["problems"])
    return findings


def problems(path: Path, *settings: str) -> str:
    return " | ".join(examined(path, *settings)["problems"])


def plates(
    folder: Path,
    plates: list[Plate],
    water: Water | None = None,
    camera: Camera = CAMERA,
    **more: Any,
) -> Path:
    """A recording of a square plate that goes from place to place, with a little noise."""
    rng = np.random.default_rng(0)
    pictures = [
        plate.depth(camera, water) + rng.normal(0, 0.7, (camera.height, camera.width))
        for plate in plates
    ]
    return write_png_folder(folder, np.rint(pictures).astype(np.uint16), camera, **more)


def walk(side_mm: float = 60.0, floor_mm: float = 600.0, n: int = 20) -> list[Plate]:
    return [Plate(floor_mm, side_mm, 25.0, (9.0 * k - 90.0, 40.0 * np.sin(k))) for k in range(n)]


def test_a_sound_recording_has_its_facts_told_and_no_problem(tmp_path: Path) -> None:
    findings = examined(write_mcap(tmp_path / "r.mcap", frames(), CAMERA))
    assert (
        findings["format"],
        findings["n_frames"],
        findings["n_gaps"],
        findings["n_missing"],
    ) == ("mcap", 12, 0, 0)
    assert (findings["width"], findings["height"], findings["fx"], findings["cy"]) == (
        160,
        120,
        140.0,
        59.5,
    )
    assert findings["rate_hz"] == pytest.approx(30, rel=1e-4)
    assert findings["duration_s"] == pytest.approx(11 / 30, rel=1e-4)
    assert findings["jitter_ms"] == pytest.approx(0, abs=1e-3)
    assert (findings["depth_min_mm"], findings["depth_max_mm"]) == (669.0, 701.0)
    assert findings["unread_share"] == pytest.approx(0.03, abs=0.005)
    assert findings["floor_mm"] == pytest.approx(700, abs=1)
    assert findings["floor_tilt_rad"] == pytest.approx(0, abs=0.01)
    assert findings["intrinsics_source"] == "CameraCalibration on /camera/calibration"
    assert (findings["distortion"], findings["water"], findings["water_depth_mm"]) == (
        None,
        None,
        None,
    )
    assert findings["arena"]["kind"] == "open"
    assert findings["problems"] == []


def test_the_animal_is_measured_without_a_model(tmp_path: Path) -> None:
    findings = examined(plates(tmp_path / "r", walk(60.0)))
    assert findings["animal_length_mm"] == pytest.approx(4 * 60 / np.sqrt(12), rel=0.03)
    assert findings["animal_area_mm2"] == pytest.approx(3600, rel=0.1)
    assert findings["animal_share"] == 1.0
    assert findings["animal_sits_still"] is False
    assert findings["noise_mm"] == pytest.approx(0.7, abs=0.1)
    assert findings["floor_unread_share"] == 0.0
    assert findings["problems"] == []


def test_an_animal_that_sits_still_is_told(tmp_path: Path) -> None:
    findings = examined(plates(tmp_path / "r", walk(60.0)[:1] * 20))
    assert findings["animal_sits_still"] is True
    assert findings["animal_length_mm"] == pytest.approx(4 * 60 / np.sqrt(12), rel=0.05)
    assert "hardly leaves its place" in findings["problems"][0]


def test_millimetres_that_do_not_fit_the_animal_are_told_with_their_factor(tmp_path: Path) -> None:
    """Focal lengths ten times too short make everything ten times as large."""
    path = plates(tmp_path / "r", walk(60.0))
    told = problems(path, "camera.fx=14", "camera.fy=14.1")
    assert "what moves is about 6" in told
    assert "wrong by a factor of about 10" in told
    assert "--plan" in told


def test_an_empty_arena_is_told(tmp_path: Path) -> None:
    findings = examined(plates(tmp_path / "r", [Plate(600.0, 60.0, 0.0)] * 12))
    assert findings["animal_length_mm"] is None
    assert any("no animal was found" in problem for problem in findings["problems"])


def test_a_slip_in_the_zones_is_told(tmp_path: Path) -> None:
    (tmp_path / "zones.toml").write_text(
        '[[zones]]\nname = "a"\ncircle = { centre = [0, 0], radius = -1 }'
    )
    path = plates(tmp_path / "r", walk(60.0))
    assert "a positive number, got -1" in problems(path, f"arena.zones={tmp_path / 'zones.toml'}")
    assert "there is no file" in problems(path, "arena.zones=none.toml")


def test_jitter_and_missing_frames_are_told_apart(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    times = np.array(even_times(20)) + rng.integers(-3_000_000, 3_000_000, 20)
    times[10:] += 3 * 33_333_333
    findings = examined(write_png_folder(tmp_path / "r", frames(20), CAMERA, times.tolist()))
    assert (findings["n_gaps"], findings["n_missing"]) == (1, 3)
    assert findings["jitter_ms"] == pytest.approx(np.sqrt(2) * 6 / np.sqrt(12), rel=0.4)


def test_what_the_clock_did_is_told(tmp_path: Path) -> None:
    times = even_times(30)
    times[7] = times[6]
    times[15:] = [t + 3600 * 10**9 for t in times[15:]]
    findings = examined(write_png_folder(tmp_path, frames(30), CAMERA, times))
    assert (findings["n_gaps"], findings["n_time_faults"]) == (0, 2)
    told = " ".join(findings["problems"])
    assert "1 of 30 are repeated or out of order" in told
    assert (
        "the camera was stopped, or its clock set, in 1 places, the first before frame 15" in told
    )


def test_a_primesense_recording_says_where_its_intrinsics_come_from(tmp_path: Path) -> None:
    findings = examined(write_oni_file(tmp_path / "r.oni", frames(), CAMERA))
    assert (findings["format"], findings["n_frames"], findings["problems"]) == ("oni", 12, [])
    assert findings["rate_hz"] == pytest.approx(30, rel=1e-4)
    assert findings["floor_mm"] == pytest.approx(700, abs=1)
    assert findings["intrinsics_source"] == "intrinsics in the .oni file (liexIntrinsics)"
    # as another program writes it
    payloads = [frame.tobytes() for frame in frames()]
    findings = examined(depth_builder(payloads, "NONE", 160, 120).write(tmp_path / "theirs.oni"))
    assert findings["intrinsics_source"] == "field of view in the .oni file (xnFOV)"
    assert findings["fx"] == pytest.approx(80 / np.tan(0.5))
    cut(tmp_path / "theirs.oni", 0.5)
    assert "cut or damaged" in problems(tmp_path / "theirs.oni")


def test_dropped_frames_are_counted(tmp_path: Path) -> None:
    times = even_times(15)
    del times[5:8]
    path = write_png_folder(tmp_path / "r", frames(), CAMERA, times)
    findings = examined(path)
    assert findings["n_gaps"] == 1
    assert (
        "dropped about 3 frames (20.0%) in 1 gap; the longest time between two frames is 0.13 s"
        in problems(path)
    )


def test_guesses_are_told(tmp_path: Path) -> None:
    path = write_moseq_folder(tmp_path / "s", depth_frames(3, 512, 424))
    (path / "depth_ts.txt").unlink()
    findings = examined(path)
    assert findings["intrinsics_source"] == "typical Kinect v2"
    told = problems(path)
    assert "typical Kinect v2" in told
    assert "30 frames/s was assumed" in told


@pytest.mark.parametrize(("unit_mm", "median"), [(0.001, "0.7 mm"), (100.0, "7e+04 mm")])
def test_a_wrong_unit_is_noticed(tmp_path: Path, unit_mm: float, median: str) -> None:
    told = problems(write_png_folder(tmp_path / "r", frames(), CAMERA, unit_mm=unit_mm))
    assert f"the median depth is {median}" in told
    assert "unit_mm" in told


def test_unread_pixels_count_where_the_animal_can_be(tmp_path: Path) -> None:
    beside, among = frames(), frames()
    beside[:, :60] = 0
    among[np.random.default_rng(0).random(among.shape) < 0.3] = 0
    assert "unread" not in problems(write_png_folder(tmp_path / "r", beside, CAMERA))
    assert "of the pixels on the floor are unread" in problems(
        write_png_folder(tmp_path / "s", among, CAMERA)
    )


def test_a_lens_that_is_bent_is_told_and_undone(tmp_path: Path) -> None:
    bent = replace(CAMERA, distortion=Distortion.of("plumb_bob", [-0.15, 0.02]))
    findings = examined(plates(tmp_path / "r", walk(), None, bent, distortion=[-0.15, 0.02]))
    assert findings["distortion"]["coefficients"][:2] == [-0.15, 0.02]
    assert findings["floor_mm"] == pytest.approx(600, abs=1)
    assert findings["problems"] == []


def test_water_is_told_and_undone(tmp_path: Path) -> None:
    water = Water(400.0, 1.333)
    path = plates(tmp_path / "r", walk(), water)
    findings = examined(path, "water.height_mm=400")
    assert findings["water"] == water.to_dict()
    assert findings["water_depth_mm"] == pytest.approx(200, abs=2)
    assert findings["floor_mm"] == pytest.approx(600, abs=2)
    assert findings["fx"] == CAMERA.fx
    assert findings["problems"] == []
    assert "the floor is not below it" in problems(path, "water.height_mm=700")


def test_a_camera_tilted_against_the_water_is_told_how_to_say_so(tmp_path: Path) -> None:
    """A level tank under a tilted camera: the floor comes out tilted against the surface until the
    plan says it.
    """
    water = Water(400.0, 1.333, 0.1, -0.06)
    n = water.normal
    v, u = np.mgrid[0:120, 0:160].astype(float)
    start, way = bent_down(CAMERA.unproject(np.stack([u, v], -1), 1.0), water)
    floor = start + way * ((560.0 - start @ n) / (way @ n))[..., None]
    depth = seen(floor, n, 400.0, 1.333, "light_field", 0.01)[1]
    rng = np.random.default_rng(0)
    path = write_png_folder(
        tmp_path / "r", np.rint(depth + rng.normal(0, 0.5, (8, 120, 160))).astype(np.uint16), CAMERA
    )
    told = problems(path, "water.height_mm=400")
    x, y = re.findall(r"water\.tilt_[xy]_rad=(-?\d\.\d+)", told)
    assert float(x) == pytest.approx(0.1, abs=0.04)
    assert float(y) == pytest.approx(-0.06, abs=0.03)
    settings = ("water.height_mm=400", f"water.tilt_x_rad={x}", f"water.tilt_y_rad={y}")
    assert "against the water's surface" not in problems(path, *settings)


def test_a_camera_that_looks_from_the_side_is_told(tmp_path: Path) -> None:
    floor = Floor.from_plane(np.array([np.sin(0.4), 0.0, np.cos(0.4)]), 600.0, CAMERA)
    pictures = np.repeat(np.rint(floor.depth(160, 120))[None], 6, axis=0).astype(np.uint16)
    findings = examined(write_png_folder(tmp_path / "r", pictures, CAMERA))
    assert findings["floor_tilt_rad"] == pytest.approx(0.4, abs=0.01)
    assert any(
        "looks down at 23 degrees from straight" in problem for problem in findings["problems"]
    )


def test_a_noisy_camera_is_told(tmp_path: Path) -> None:
    noisy = np.rint(700 + np.random.default_rng(0).normal(0, 6.0, (40, 120, 160))).astype(np.uint16)
    findings = examined(write_png_folder(tmp_path / "r", noisy, CAMERA))
    assert findings["noise_mm"] == pytest.approx(6.0, rel=0.1)
    assert any("from frame to frame" in problem for problem in findings["problems"])


def test_a_recording_of_nothing_has_no_numbers_but_a_sentence(tmp_path: Path) -> None:
    findings = examined(
        write_png_folder(tmp_path / "r", np.zeros((3, 120, 160), np.uint16), CAMERA)
    )
    assert (findings["depth_min_mm"], findings["depth_max_mm"], findings["floor_mm"]) == (
        None,
        None,
        None,
    )
    assert any("none of the 3 frames" in problem for problem in findings["problems"])


def test_empty_frames_are_counted_apart_from_unread_pixels(tmp_path: Path) -> None:
    stored = frames()
    stored[::2] = 0
    told = problems(write_png_folder(tmp_path / "r", stored, CAMERA))
    assert "6 of the 12 frames looked at hold no depth" in told
    assert "of the pixels are unread" not in told


def test_where_no_floor_is_it_says_so(tmp_path: Path) -> None:
    rough = (
        np.random.default_rng(0)
        .integers(400, 4000, (1, 120, 160))
        .repeat(4, axis=0)
        .astype(np.uint16)
    )
    findings = examined(write_png_folder(tmp_path / "r", rough, CAMERA))
    assert findings["floor_mm"] is None
    assert any("no floor" in problem for problem in findings["problems"])


def test_one_frame_has_no_rate(tmp_path: Path) -> None:
    path = write_png_folder(tmp_path / "r", frames(1), CAMERA)
    findings = examined(path)
    assert (findings["n_frames"], findings["rate_hz"], findings["duration_s"]) == (1, None, 0.0)
    assert "single frame" in problems(path)


def test_a_cut_recording_is_looked_at_as_far_as_it_goes(tmp_path: Path) -> None:
    path = write_moseq_folder(tmp_path / "s", frames())
    write_camera(path, CAMERA)
    cut(path / "depth.dat", 0.55)
    assert examined(path)["n_frames"] == 6
    told = problems(path)
    assert "ends in the middle of frame 6" in told
    assert "12 time stamps" in told


def test_what_cannot_be_opened_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="empty folder"):
        examine(tmp_path)


def test_the_report_names_everything_in_lines_that_can_be_read(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    findings = examine(write_png_folder(tmp_path / "r", frames(1), CAMERA))
    print_report(findings)
    printed = capsys.readouterr().out
    assert len(printed.splitlines()) < 24, "one screen"
    for name, value in lines(findings):
        assert name in printed
        assert value[:40] in printed
    assert "unknown" in printed  # the rate of a single frame
    assert "nan" not in printed.lower().split()
    assert "- a single frame has no rate" in printed
    print_report(findings | {"problems": []})
    assert "no problems found" in capsys.readouterr().out


def test_a_real_session(reference_data: Path) -> None:
    findings = examined(reference_data / "mouse_kinect2" / "session_20170125.tar.gz")
    assert (findings["n_frames"], findings["n_gaps"]) == (300, 3)
    assert findings["floor_mm"] == pytest.approx(673.5, abs=10)
    assert findings["arena"]["kind"] == "round"
    assert 40 < findings["animal_length_mm"] < 110
    assert (findings["animal_share"], findings["animal_sits_still"]) == (1.0, False)


@pytest.mark.parametrize("write", ["folder", "foxglove", "ros"])
def test_a_principal_point_at_the_edge_is_reported_from_every_source(
    tmp_path: Path, write: str
) -> None:
    edge = replace(CAMERA, cx=159.5, cy=119.5)
    path = {
        "folder": lambda: write_png_folder(tmp_path / "r", frames(), edge),
        "foxglove": lambda: write_mcap(tmp_path / "r.mcap", frames(), edge),
        "ros": lambda: write_bag(tmp_path / "r.bag", frames(), camera=edge),
    }[write]()
    problems = examined(path)["problems"]
    assert any("the principal point (159.5, 119.5) is far" in problem for problem in problems)


@pytest.mark.parametrize("kind", ["16UC1", "32FC1"])
def test_the_unit_that_doctor_asks_for_is_used(tmp_path: Path, kind: str) -> None:
    """Depth in tenths of a millimetre, or floats in millimetres."""
    stored, unit_mm = (frames() * 25, 0.04) if kind == "16UC1" else (frames().astype("f4"), 1.0)
    path = write_bag(tmp_path / "r.bag", stored, camera=CAMERA, kind=kind)
    assert any("state the true unit_mm" in problem for problem in examined(path)["problems"])
    (tmp_path / "camera.toml").write_text(f"[camera]\nunit_mm = {unit_mm}\n")
    found = examined(path)
    assert not any("unit_mm" in problem for problem in found["problems"])
    assert found["depth_max_mm"] == pytest.approx(701.0, abs=0.01)
