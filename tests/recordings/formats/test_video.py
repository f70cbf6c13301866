"""Depth videos of MoSeq sessions: FFV1 in AVI, raw images in Azure's Matroska, and the camera
each comes from.
"""

import json
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from liex_lab.recordings import open_recording
from liex_lab.recordings.formats.moseq import MODES, read_calibration
from liex_lab.recordings.formats.video import DepthVideo, slices_agree
from liex_lab.runtime.progress import silent
from tests.oracles import ffv1
from tests.recordings.asking import depths_in, facts_in, refusal
from tests.recordings.video_writers import (
    even_ms,
    factory_calibration,
    write_avi,
    write_mkv,
    write_video_session,
)
from tests.recordings.writers import SMALL, depth_frames, write_archive, write_camera

STORED = depth_frames(30)


@pytest.mark.parametrize(("gop", "level"), [(1, 3), (12, 3), (250, 3), (12, 1)])
def test_an_avi_gives_any_picture_at_any_time(tmp_path: Path, gop: int, level: int) -> None:
    folder = write_video_session(tmp_path, STORED, gop=gop, level=level)
    rng = np.random.default_rng(1)
    with open_recording(folder, strict=True) as recording:
        for index in [29, 0, 1, 2, 13, 12, 11, 28, 29, *rng.integers(0, 30, 40).tolist()]:
            np.testing.assert_array_equal(recording.frame(index).depth, STORED[index])


def test_pyav_finds_the_same_pictures_at_the_same_times(tmp_path: Path) -> None:
    write_avi(tmp_path / "a.avi", STORED, fps=25)
    write_mkv(tmp_path / "a.mkv", STORED, [k * 40 + 7 * (k > 9) for k in range(30)])
    for name in ("a.avi", "a.mkv"):
        ours = DepthVideo(tmp_path / name, silent)
        with av.open(str(tmp_path / name)) as container:
            titled = {stream.metadata.get("title"): stream for stream in container.streams.video}
            stream = titled.get("DEPTH", container.streams.video[0])
            theirs = list(container.decode(stream))
        assert len(theirs) == len(ours)
        for index, frame in enumerate(theirs):
            np.testing.assert_array_equal(ours.read(index), frame.to_ndarray())
            assert ours.times_ns[index] == round((frame.pts or 0) * (frame.time_base or 0) * 10**9)
        ours.close()


def test_opencv_writes_what_is_read(tmp_path: Path) -> None:
    size = (64, 48)
    writer = cv2.VideoWriter(
        str(tmp_path / "depth.avi"),
        cv2.CAP_FFMPEG,
        cv2.VideoWriter.fourcc(*"FFV1"),
        30.0,
        size,
        [cv2.VIDEOWRITER_PROP_DEPTH, cv2.CV_16U, cv2.VIDEOWRITER_PROP_IS_COLOR, 0],
    )
    assert writer.isOpened()
    for frame in STORED:
        writer.write(frame)
    writer.release()
    np.testing.assert_array_equal(depths_in(tmp_path, camera=SMALL), STORED)


@given(st.binary(min_size=1, max_size=200), st.booleans())
def test_check_sums_agree_with_their_slow_twin(data: bytes, sealed: bool) -> None:
    if sealed:  # length, no error, and the check sum that makes all of it 0
        body = data + len(data).to_bytes(3, "big") + b"\0"
        data = body + ffv1.remainder(body).to_bytes(4, "big")
    assert slices_agree(data) == ffv1.slices_agree(data) == sealed


def test_a_damaged_picture_costs_those_that_build_on_it_and_no_others(tmp_path: Path) -> None:
    folder = write_video_session(tmp_path, STORED, gop=10)
    video = DepthVideo(folder / "depth.avi", silent)
    at = video.frames[13] @ [2, 1] // 2
    video.close()
    content = bytearray((folder / "depth.avi").read_bytes())
    content[at] ^= 4
    (folder / "depth.avi").write_bytes(content)
    with open_recording(folder) as recording:
        for _ in range(2):
            for frame in recording:
                lost = 13 <= frame.index < 20
                np.testing.assert_array_equal(
                    frame.depth, np.zeros((48, 64)) if lost else STORED[frame.index]
                )
        assert len(recording.problems) == 7


def test_a_recorder_that_was_stopped_leaves_a_file_that_reads(tmp_path: Path) -> None:
    folder = write_video_session(tmp_path / "mkv", STORED, "depth.mkv", live=True, groups=True)
    np.testing.assert_array_equal(depths_in(folder, strict=True), STORED)
    content = bytearray(write_avi(tmp_path / "a.avi", STORED).read_bytes())
    for name in (b"RIFF", b"movi"):  # the lengths that are filled in at the end, and the index
        at = content.index(name) + (4 if name == b"RIFF" else -4)
        content[at : at + 4] = bytes(4)
    (tmp_path / "a.avi").write_bytes(content[: content.index(b"idx1")])
    np.testing.assert_array_equal(depths_in(tmp_path / "a.avi", camera=SMALL), STORED)


def test_an_avi_of_more_than_a_gigabyte_goes_on_in_a_second_part(tmp_path: Path) -> None:
    content = write_avi(tmp_path / "depth.avi", STORED).read_bytes()
    at = start = content.index(b"movi") + 4
    for _ in range(13):
        at += 8 + int.from_bytes(content[at + 4 : at + 8], "little")
        at += at % 2
    end = content.index(b"idx1")
    more = b"AVIX" + b"LIST" + (4 + end - at).to_bytes(4, "little") + b"movi" + content[at:end]
    first = content[: start - 8] + (4 + at - start).to_bytes(4, "little") + content[start - 4 : at]
    first = first[:4] + (len(first) - 8).to_bytes(4, "little") + first[8:]
    (tmp_path / "depth.avi").write_bytes(first + b"RIFF" + len(more).to_bytes(4, "little") + more)
    np.testing.assert_array_equal(depths_in(tmp_path, camera=SMALL, strict=True), STORED)


def test_stamps_beside_a_video_come_first_and_a_mkv_has_its_own(tmp_path: Path) -> None:
    times = [k * 33 + 100 * (k > 10) for k in range(30)]
    folder = write_video_session(tmp_path, STORED, "depth.mkv", times_ms=times)
    assert facts_in(folder).times_ns[0] == 1_000_000_000
    (folder / "depth_ts.txt").write_text("1.0 0\n2.0 0\n")
    with open_recording(folder) as recording:
        assert recording.times_ns.tolist() == [t * 10**6 for t in times]
        assert [gap.start_frame for gap in recording.gaps] == [11]
        assert any("30 frames" in p and "2 time stamps" in p for p in recording.problems)
    (folder / "depth_ts.txt").unlink()
    with open_recording(folder) as recording:
        assert (recording.times_ns.tolist(), recording.problems) == ([t * 10**6 for t in times], [])


def test_an_avi_without_stamps_has_a_constant_rate_and_says_so(tmp_path: Path) -> None:
    path = write_avi(tmp_path / "mouse.avi", STORED, fps=25)
    write_camera(tmp_path)
    for given_path in (path, tmp_path):
        with open_recording(given_path) as recording:
            assert (recording.name, recording.rate_hz) == ("mouse", 25.0)
            assert any("constant 25 frames/s" in problem for problem in recording.problems)
    assert facts_in(path, fps=50).rate_hz == 50.0


@pytest.mark.parametrize("size", MODES, ids=lambda size: MODES[size][0])
def test_azure_says_its_intrinsics_itself(tmp_path: Path, size: tuple[int, int]) -> None:
    width, height = size
    frames = np.full((2, height, width), 700, np.uint16)
    attached = {"calibration.json": factory_calibration()}
    path = write_mkv(
        tmp_path / "a.mkv",
        frames,
        titles=("DEPTH",),
        tags={"K4A_DEPTH_MODE": "X"},
        attachments=attached,
    )
    with open_recording(path) as recording:
        camera = recording.camera
        assert "factory calibration" in camera.source
        assert recording.problems == []
    if (width, height) == (
        640,
        576,
    ):  # as the camera's own software gives them for these factory numbers
        np.testing.assert_allclose([camera.cx, camera.cy], [332.064270, 325.880615], atol=1e-4)
        np.testing.assert_allclose([camera.fx, camera.fy], [503.927643, 503.978729], atol=1e-4)
    binned = 2 if width in (320, 512) else 1
    assert camera.fx == pytest.approx(503.9276 / binned, abs=1e-3)
    path = write_mkv(tmp_path / "b.mkv", frames, titles=("DEPTH",), tags={"K4A_DEPTH_MODE": "X"})
    with open_recording(path) as recording:
        assert recording.camera.fx == pytest.approx(camera.fx, rel=0.01)
        assert any("typical Azure Kinect" in problem for problem in recording.problems)


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"{",
        b"[]",
        b'{"CalibrationInformation": {"Cameras": [3]}}',
        b"\xff\xfe",
        b"[" * 100_000,
        factory_calibration().replace(b"0.5122697949409485", b"NaN"),
        factory_calibration().replace(b"0.492", b"-0.492"),
    ],
)
def test_a_calibration_that_makes_no_sense_is_none(data: bytes) -> None:
    assert read_calibration(data) is None


@pytest.mark.parametrize(
    ("size", "facts", "says"),
    [
        ((640, 576), {"DepthResolution": [640, 576]}, "a camera that is not known"),
        ((640, 576), {"CameraType": "k4a"}, "typical Azure Kinect, NFOV_UNBINNED"),
        ((640, 576), {"DepthResolution": [64, 48], "camera": "RealSense D435"}, "'RealSense D435'"),
        ((512, 424), {"Camera": "Kinect v2"}, "typical Kinect v2"),
        ((512, 424), {"Camera": "RealSense"}, "512 x 424"),
        ((512, 424), {"Camera": "azure"}, "512 x 424"),
    ],
)
def test_metadata_name_the_camera(
    tmp_path: Path, size: tuple[int, int], facts: dict[str, Any], says: str
) -> None:
    folder = write_video_session(tmp_path, depth_frames(2, *size), gop=1)
    (folder / "camera.toml").unlink()
    (folder / "metadata.json").write_text(json.dumps(facts))
    if says.startswith("typical"):
        assert facts_in(folder).camera.source == says
    else:
        assert says in refusal(folder)


def test_the_size_of_a_video_is_its_own(tmp_path: Path) -> None:
    folder = write_video_session(tmp_path, STORED)
    (folder / "metadata.json").write_text(json.dumps({"DepthResolution": [512, 424]}))
    with open_recording(folder) as recording:
        assert (recording.width, recording.height) == (64, 48)
        assert any("(512, 424)" in problem for problem in recording.problems)


def test_a_day_in_the_file_is_the_day_of_the_recording(tmp_path: Path) -> None:
    folder = write_video_session(tmp_path, STORED, "depth.mkv", date_ns=600_000_000_123_456_000)
    (folder / "metadata.json").unlink()
    assert facts_in(folder).metadata == {"session_start_time": "2020-01-06T10:40:00.123456+00:00"}


def test_a_video_may_lie_in_an_archive(tmp_path: Path) -> None:
    session = write_video_session(tmp_path / "s", STORED, "depth.mkv")
    np.testing.assert_array_equal(
        depths_in(write_archive(session, tmp_path / "s.tar.gz"), strict=True)[17], STORED[17]
    )


def test_videos_for_people_are_refused(tmp_path: Path) -> None:
    grey = write_avi(tmp_path / "grey.avi", (STORED >> 2).astype(np.uint8), pixels="gray")
    assert "got an 8-bit gray image of 64 x 48" in refusal(grey, camera=SMALL)
    writer = cv2.VideoWriter(
        str(tmp_path / "colour.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 30.0, (64, 48)
    )
    writer.write(np.zeros((48, 64, 3), np.uint8))
    writer.release()
    assert "packed with 'MJPG'" in refusal(tmp_path / "colour.avi", camera=SMALL)


def test_the_depth_is_the_track_that_says_so(tmp_path: Path) -> None:
    path = write_mkv(tmp_path / "a.mkv", STORED, even_ms(30), titles=("IR", "COLOR", "DEPTH"))
    np.testing.assert_array_equal(depths_in(path, camera=SMALL)[3], STORED[3])
    path = write_mkv(tmp_path / "b.mkv", STORED, titles=("first", "second"))
    np.testing.assert_array_equal(depths_in(path, camera=SMALL)[3], STORED[3] // 2)
    assert "no video track" in refusal(
        write_mkv(tmp_path / "c.mkv", STORED, titles=()), camera=SMALL
    )
