"""`liex doctor`: the facts of a recording, and what is wrong with it."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from liex_lab.pipelines.doctor import FINDINGS, examine, print_report

from liex_lab.camera import Camera
from liex_lab.errors import RecordingError
from tests.recordings.oni_files import depth_builder
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
    "format", "n_frames", "duration_s", "rate_hz", "n_gaps", "width", "height", "fx", "fy", "cx", "cy",
    "intrinsics_source", "depth_min_mm", "depth_max_mm", "floor_mm", "problems",
]  # fmt: skip
CAMERA = Camera(140.0, 141.0, 79.5, 59.5, 160, 120)


def frames(n: int = 12, floor_mm: int = 700) -> Frames:
    return depth_frames(n, 160, 120, floor_mm=floor_mm)


def examined(path: Path) -> dict[str, object]:
    """The findings, which JSON must be able to hold as they are."""
    findings = examine(path)
    assert list(findings) == KEYS == list(FINDINGS)
    assert json.loads(json.dumps(findings, allow_nan=False)) == findings
    return findings


def problems(path: Path) -> str:
    return " | ".join(examine(path)["problems"])


def test_a_sound_recording_has_its_facts_told_and_no_problem(tmp_path: Path) -> None:
    findings = examined(write_mcap(tmp_path / "r.mcap", frames(), CAMERA))
    assert (findings["format"], findings["n_frames"], findings["n_gaps"]) == ("mcap", 12, 0)
    assert (findings["width"], findings["height"], findings["fx"], findings["cy"]) == (160, 120, 140.0, 59.5)
    assert findings["rate_hz"] == pytest.approx(30, rel=1e-4)
    assert findings["duration_s"] == pytest.approx(11 / 30, rel=1e-4)
    assert (findings["depth_min_mm"], findings["depth_max_mm"]) == (669.0, 701.0)
    assert findings["floor_mm"] == pytest.approx(700, abs=1)
    assert findings["intrinsics_source"] == "CameraCalibration on /camera/calibration"
    assert findings["problems"] == []


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
    assert "left out about 3 frames (20.0%) in 1 gap; the longest time between two frames is 0.13 s" in problems(path)


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


def test_much_unread_is_told(tmp_path: Path) -> None:
    stored = frames()
    stored[:, :60] = 0
    assert "of the pixels are unread" in problems(write_png_folder(tmp_path / "r", stored, CAMERA))


def test_a_recording_of_nothing_has_no_numbers_but_a_sentence(tmp_path: Path) -> None:
    findings = examined(write_png_folder(tmp_path / "r", np.zeros((3, 120, 160), np.uint16), CAMERA))
    assert (findings["depth_min_mm"], findings["depth_max_mm"], findings["floor_mm"]) == (None, None, None)
    assert any("none of the 3 frames" in str(p) for p in findings["problems"])  # type: ignore[attr-defined]


def test_empty_frames_are_counted_apart_from_unread_pixels(tmp_path: Path) -> None:
    stored = frames()
    stored[::2] = 0
    told = problems(write_png_folder(tmp_path / "r", stored, CAMERA))
    assert "6 of the 12 frames looked at hold no depth" in told
    assert "of the pixels are unread" not in told


def test_where_no_floor_is_it_says_so(tmp_path: Path) -> None:
    rough = np.random.default_rng(0).integers(400, 4000, (1, 120, 160)).repeat(4, axis=0).astype(np.uint16)
    findings = examined(write_png_folder(tmp_path / "r", rough, CAMERA))
    assert findings["floor_mm"] is None
    assert any("floor" in str(p) for p in findings["problems"])  # type: ignore[attr-defined]


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
    for name, _ in list(FINDINGS.values())[:-1]:
        assert name in printed
    assert "unknown" in printed  # the rate of a single frame
    assert "nan" not in printed.lower().split()
    assert "- a single frame has no rate" in printed
    print_report(findings | {"problems": []})
    assert "no problems found" in capsys.readouterr().out


def test_a_real_session(reference_data: Path) -> None:
    findings = examined(reference_data / "mouse_kinect2" / "session_20170125.tar.gz")
    assert (findings["n_frames"], findings["n_gaps"]) == (300, 3)
    assert findings["floor_mm"] == pytest.approx(673.5, abs=10)
