"""Genuine files of other people's cameras, against values that independent readers found in them."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from liex_lab.camera import Camera
from liex_lab.recordings import open_recording
from tests.recordings.asking import refusal
from tests.recordings.writers import cut, write_mcap

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


@pytest.mark.parametrize(("folder", "pattern"), [("xtion_open3d", "*.png"), ("primesense_pcl", "*.tiff")])
def test_pictures_hold_what_independent_readers_found(
    reference_data: Path, expected: dict[str, Any], folder: str, pattern: str
) -> None:
    files = sorted((reference_data / "depth_files" / folder).glob(pattern))
    with open_recording(files[0].parent, camera=XTION, fps=30, strict=True) as recording:
        for frame, path in zip(recording, files, strict=True):
            assert_as_expected(frame.depth, expected[f"{folder}/{path.name}"])
    assert "camera.toml" in refusal(files[0].parent)


def test_pictures_survive_a_way_through_mcap(reference_data: Path, expected: dict[str, Any], tmp_path: Path) -> None:
    with open_recording(reference_data / "depth_files" / "xtion_open3d", camera=XTION, fps=30) as pictures:
        stored = np.stack([frame.depth for frame in pictures]).astype(np.uint16)
    with open_recording(write_mcap(tmp_path / "transcoded.mcap", stored, XTION)) as recording:
        for frame in recording:
            assert_as_expected(frame.depth, expected[f"xtion_open3d/0000{frame.index}.png"])


def test_an_mcap_without_depth_says_what_it_holds(reference_data: Path) -> None:
    sentence = refusal(reference_data / "depth_files" / "mcap_camera" / "custom-camera-model.mcap")
    assert "no depth pictures" in sentence
    assert "/image/compressed (foxglove.CompressedImage, json)" in sentence


def test_a_realsense_bag_holds_what_independent_readers_found(
    reference_data: Path, expected: dict[str, Any], tmp_path: Path
) -> None:
    path = reference_data / "depth_files" / "realsense_bag" / "single_depth_color_640x480.bag"
    with open_recording(path, strict=True) as recording:
        assert (len(recording), recording.width, recording.height, recording.problems) == (2, 640, 480, [])
        camera = recording.camera
        np.testing.assert_allclose(
            [camera.fx, camera.fy, camera.cx, camera.cy], [390.43, 390.43, 331.39, 242.19], atol=0.01
        )
        assert recording.times_ns.tolist() == [360_815_089_000, 360_981_765_000]
        for frame in recording:
            assert_as_expected(frame.depth, expected[f"realsense_bag/{path.name} message {frame.index}"])
        with open_recording(cut(path, 0.97, tmp_path / "cut.bag")) as part:
            assert part.truncated
            np.testing.assert_array_equal(part.frame(0).depth, recording.frame(0).depth)


def test_a_real_kinect_session_is_read_as_it_was_recorded(reference_data: Path) -> None:
    with open_recording(reference_data / "mouse_kinect2" / "session_20170125.tar.gz", strict=True) as recording:
        assert (len(recording), recording.width, recording.height) == (300, 512, 424)
        assert recording.metadata["session_start_time"] == "2017-01-25T10:42:07.173469-05:00"
        assert recording.duration_s == pytest.approx(10.30, abs=0.005)
        lengths_ms = [
            int(recording.times_ns[g.stop_frame] - recording.times_ns[g.stop_frame - 1]) / 1e6 for g in recording.gaps
        ]
        assert np.round(lengths_ms).tolist() == [200.0, 134.0, 100.0]
        assert [gap.n_frames_missing for gap in recording.gaps] == [5, 3, 2]
        depth = recording.frame(150).depth
        assert np.median(depth[depth > 0]) == pytest.approx(673.5, abs=10)


def test_a_real_session_that_is_cut_gives_the_same_frames(reference_data: Path, tmp_path: Path) -> None:
    whole = reference_data / "mouse_kinect2" / "session_20170125.tar.gz"
    with open_recording(whole) as recording, open_recording(cut(whole, 0.2, tmp_path / whole.name)) as part:
        assert part.truncated
        assert 20 < len(part) < 100
        for index in (0, len(part) // 2, len(part) - 1):
            np.testing.assert_array_equal(part.frame(index).depth, recording.frame(index).depth)
