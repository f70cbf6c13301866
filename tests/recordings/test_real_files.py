"""Genuine files of other people's cameras, against values that independent readers found in
them.
"""

import hashlib
import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from liex_lab.optics.camera import Camera
from liex_lab.recordings import open_recording
from tests.recordings.asking import refusal
from tests.recordings.picture_writers import write_raytrix, write_tiff
from tests.recordings.writers import cut, write_camera

XTION = Camera(525.0, 525.0, 319.5, 239.5, 640, 480)


@pytest.fixture(scope="module")
def expected(reference_data: Path) -> dict[str, Any]:
    """What is in every genuine depth file."""
    return json.loads((reference_data / "depth_files" / "expected.json").read_text())


def assert_as_expected(depth: np.ndarray, facts: dict[str, Any]) -> None:
    pixels = depth.astype("<u2")
    np.testing.assert_array_equal(pixels, depth)
    assert hashlib.sha256(pixels.tobytes()).hexdigest() == facts["sha256_of_little_endian_pixels"]
    assert (int(pixels.max()), int((pixels == 0).sum())) == (facts["max"], facts["zeros"])


def copy_of(files: list[Path], folder: Path) -> list[Path]:
    """The files in a folder of their own."""
    folder.mkdir(exist_ok=True)
    return [Path(shutil.copy(path, folder)) for path in files]


def test_pictures_hold_what_independent_readers_found(
    reference_data: Path, expected: dict[str, Any]
) -> None:
    files = sorted((reference_data / "depth_files" / "xtion_open3d").glob("*.png"))
    with open_recording(files[0].parent, camera=XTION, fps=30, strict=True) as recording:
        for frame, path in zip(recording, files, strict=True):
            assert_as_expected(frame.depth, expected[f"xtion_open3d/{path.name}"])
    assert "camera.toml" in refusal(files[0].parent)


@pytest.mark.parametrize("kind", ["tiff", "pclzf"])
def test_pcl_recordings_hold_their_times_and_their_camera(
    reference_data: Path, expected: dict[str, Any], tmp_path: Path, kind: str
) -> None:
    folder = reference_data / "depth_files" / "primesense_pcl"
    assert "both TIFF and PCLZF" in refusal(folder)
    files = copy_of(sorted(folder.glob(f"*.{kind}")), tmp_path)
    copy_of(list(folder.glob("*.xml")), tmp_path)
    with open_recording(
        tmp_path, camera=None if kind == "pclzf" else XTION, strict=True
    ) as recording:
        for frame, path in zip(recording, files, strict=True):
            assert_as_expected(frame.depth, expected[f"primesense_pcl/{path.name}"])
        assert np.diff(recording.times_ns).tolist() == [254_471_000]
        if kind == "pclzf":
            lens = recording.camera
            assert (lens.fx, lens.fy, lens.cx, lens.cy, lens.width, lens.height) == (
                525,
                525,
                320,
                240,
                640,
                480,
            )
            assert lens.source == "the XML files beside the images"


def test_the_encodings_of_data_sets_come_out_as_millimetres(
    reference_data: Path, expected: dict[str, Any], tmp_path: Path
) -> None:
    depth = {}
    for name, encoding in (
        ("TUM_depth.png", "tum"),
        ("SUN_depth.png", "sun"),
        ("NYU_depth.pgm", "kinect1-disparity"),
    ):
        folder = tmp_path / encoding
        (path,) = copy_of([reference_data / "depth_files" / "other_formats" / name], folder)
        with open_recording(path, camera=XTION, fps=30) as recording:
            assert_as_expected(recording.frame(0).depth, expected[f"other_formats/{name}"])
            assert any(
                "low byte first" in problem for problem in recording.problems
            ) == name.endswith(".pgm")
        write_camera(folder, XTION, encoding=encoding)
        with open_recording(path, fps=30, strict=True) as recording:
            depth[encoding] = recording.frame(0).depth.astype(float)
    facts = expected["other_formats/TUM_depth.png"]
    assert depth["tum"].sum() == pytest.approx(facts["sum"] / 5, rel=1e-6)
    assert depth["tum"].max() == pytest.approx(facts["max"] / 5, rel=1e-6)
    facts = expected["other_formats/SUN_depth.png (as mm)"]
    sun = depth["sun"][depth["sun"] > 0]
    assert (sun.sum(), sun.min(), sun.max()) == (facts["sum"], facts["min_valid"], facts["max"])
    facts = expected["other_formats/NYU_depth.pgm (as metres)"]
    kinect = depth["kinect1-disparity"]
    assert int((kinect == 0).sum()) == facts["no_return"]
    read = kinect[kinect > 0] / 1000
    stated = [facts["min"], facts["max"], facts["mean"]]
    np.testing.assert_allclose([read.min(), read.max(), read.mean()], stated, rtol=1e-5)


def test_a_real_nyu_frame_lies_before_its_joints(reference_data: Path) -> None:
    folder = reference_data / "hand_nyu"
    truth = np.load(folder / "nyu_test_14joints.npz")
    with open_recording(folder, strict=True) as recording:
        assert (recording.format, len(recording), recording.width, recording.height) == (
            "nyu",
            1,
            640,
            480,
        )
        depth = recording.frame(0).depth
        assert (depth.min(), depth.max()) == (731, 2001)
        lens = recording.camera
        stated = np.abs(truth["camera_fx_fy_cx_cy"])
        np.testing.assert_allclose([lens.fx, lens.fy, lens.cx, lens.cy], stated, atol=0.01)
    u, v, d = truth["groundtruth_uvd"][0].T
    before = d - depth[np.round(v).astype(int), np.round(u).astype(int)]
    assert before.min() > 0  # skin before bone
    assert before.max() < 40


def test_the_vendors_calibration_holds_no_metric_scale(
    reference_data: Path, tmp_path: Path
) -> None:
    path = reference_data / "depth_files" / "raytrix" / "tree_Calibration.xml"
    assert "raytrix.toml" in refusal(path.parent)
    copy_of([path], tmp_path)
    write_raytrix(
        tmp_path, np.full((1, 48, 64), 2.5, np.float32), "raytrix-virtual", ".tif", write_tiff
    )
    assert "no focal length and no metric scale" in refusal(tmp_path)


def test_an_mcap_without_depth_says_what_it_holds(reference_data: Path) -> None:
    sentence = refusal(reference_data / "depth_files" / "mcap_camera" / "custom-camera-model.mcap")
    assert "no depth images" in sentence
    assert "/image/compressed (foxglove.CompressedImage, json)" in sentence


def test_a_realsense_bag_holds_what_independent_readers_found(
    reference_data: Path, expected: dict[str, Any], tmp_path: Path
) -> None:
    path = reference_data / "depth_files" / "realsense_bag" / "single_depth_color_640x480.bag"
    with open_recording(path, strict=True) as recording:
        assert (len(recording), recording.width, recording.height, recording.problems) == (
            2,
            640,
            480,
            [],
        )
        camera = recording.camera
        np.testing.assert_allclose(
            [camera.fx, camera.fy, camera.cx, camera.cy],
            [390.43, 390.43, 331.39, 242.19],
            atol=0.01,
        )
        assert recording.times_ns.tolist() == [360_815_089_000, 360_981_765_000]
        assert recording.metadata["session_start_time"].startswith("2018-08-14T07:41:59.732935")
        for frame in recording:
            assert_as_expected(
                frame.depth, expected[f"realsense_bag/{path.name} message {frame.index}"]
            )
        with open_recording(cut(path, 0.97, tmp_path / "cut.bag")) as part:
            assert part.truncated
            np.testing.assert_array_equal(part.frame(0).depth, recording.frame(0).depth)


def test_a_real_kinect_session_is_read_as_it_was_recorded(reference_data: Path) -> None:
    with open_recording(
        reference_data / "mouse_kinect2" / "session_20170125.tar.gz", strict=True
    ) as recording:
        assert (len(recording), recording.width, recording.height) == (300, 512, 424)
        assert recording.metadata["session_start_time"] == "2017-01-25T10:42:07.173469-05:00"
        assert recording.duration_s == pytest.approx(10.30, abs=0.005)
        lengths_ms = [
            int(recording.times_ns[g.stop_frame] - recording.times_ns[g.stop_frame - 1]) / 1e6
            for g in recording.gaps
        ]
        assert np.round(lengths_ms).tolist() == [200.0, 134.0, 100.0]
        assert [gap.n_frames_missing for gap in recording.gaps] == [5, 3, 2]
        depth = recording.frame(150).depth
        assert np.median(depth[depth > 0]) == pytest.approx(673.5, abs=10)


def test_a_real_session_that_is_cut_gives_the_same_frames(
    reference_data: Path, tmp_path: Path
) -> None:
    whole = reference_data / "mouse_kinect2" / "session_20170125.tar.gz"
    with (
        open_recording(whole) as recording,
        open_recording(cut(whole, 0.2, tmp_path / whole.name)) as part,
    ):
        assert part.truncated
        assert 20 < len(part) < 100
        for index in (0, len(part) // 2, len(part) - 1):
            np.testing.assert_array_equal(part.frame(index).depth, recording.frame(index).depth)
