"""MCAP with Foxglove's messages, whole and cut."""

from __future__ import annotations

from pathlib import Path

import foxglove
import numpy as np
import pytest
from foxglove.channels import RawImageChannel
from foxglove.mcap import MCAPCompression
from foxglove.messages import RawImage, Timestamp
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from liex_lab.optics.camera import Distortion
from liex_lab.recordings import open_recording
from tests.recordings.asking import refusal
from tests.recordings.writers import (
    SMALL,
    START_NS,
    depth_frames,
    even_times,
    write_camera,
    write_mcap,
)

STORED = depth_frames(20)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "r.mcap"


@pytest.mark.parametrize("encoding", ["16UC1", "mono16", "png"])
def test_sixteen_bits_are_millimetres(path: Path, encoding: str) -> None:
    with open_recording(write_mcap(path, STORED, encoding=encoding)) as recording:
        for frame in recording:
            np.testing.assert_array_equal(frame.depth, STORED[frame.index])
        assert recording.problems == []
        assert recording.camera.source == "CameraCalibration on /camera/calibration"
        assert (recording.camera.fx, recording.camera.cy) == (SMALL.fx, SMALL.cy)


def test_floats_are_metres_and_nan_is_unread(path: Path) -> None:
    stored = STORED.astype(np.float32) / 1000
    stored[:, 0, :3] = [np.nan, np.inf, -1.0]
    with open_recording(write_mcap(path, stored, encoding="32FC1")) as recording:
        depth = recording.frame(5).depth
    np.testing.assert_array_equal(depth[0, :3], 0.0)
    np.testing.assert_allclose(depth[1:], STORED[5, 1:], atol=1e-4)


@pytest.mark.parametrize("compression", [MCAPCompression.Zstd, MCAPCompression.Lz4, None])
@pytest.mark.parametrize("use_chunks", [True, False])
def test_every_packing_reads_alike(
    path: Path, compression: MCAPCompression | None, use_chunks: bool
) -> None:
    write_mcap(path, STORED, compression=compression, use_chunks=use_chunks, padding=6)
    with open_recording(path, strict=True) as recording:
        for index in (19, 3, 4, 0):
            np.testing.assert_array_equal(recording.frame(index).depth, STORED[index])


def test_it_agrees_with_the_reader_of_mcap_itself(path: Path) -> None:
    write_mcap(path, STORED, log_delay_ns=5_000_000)
    with path.open("rb") as file, open_recording(path) as recording:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        decoded = [
            message.decoded_message
            for message in reader.iter_decoded_messages(topics=["/camera/depth"])
        ]
        assert len(decoded) == len(recording)
        for frame, message in zip(recording, decoded, strict=True):
            assert frame.time_ns == message.timestamp.ToNanoseconds()
            np.testing.assert_array_equal(frame.depth.ravel(), np.frombuffer(message.data, "<u2"))


def test_the_sensors_stamp_comes_before_the_time_of_logging(path: Path) -> None:
    times = even_times(20)
    with open_recording(write_mcap(path, STORED, log_delay_ns=7_000_000)) as recording:
        assert recording.times_ns.tolist() == times
        assert recording.metadata["session_start_time"].startswith("2025-10-09T08:53:20")
    with open_recording(
        write_mcap(path, STORED, stamped=False, log_delay_ns=7_000_000)
    ) as recording:
        assert recording.times_ns.tolist() == [t + 7_000_000 for t in times]
        assert any("no stamp" in problem for problem in recording.problems)


def test_a_sensor_clock_may_begin_at_zero(path: Path) -> None:
    times = even_times(20, start_ns=0)
    with open_recording(
        write_mcap(path, STORED, times_ns=times, log_delay_ns=START_NS)
    ) as recording:
        assert recording.times_ns.tolist() == times
        assert recording.metadata == {}


def test_several_depth_topics_are_named_and_one_is_chosen(path: Path) -> None:
    write_mcap(path, STORED, topics=("/left/depth", "/right/depth"))
    sentence = refusal(path)
    assert "/left/depth, /right/depth" in sentence
    with open_recording(path, topic="/right/depth") as recording:
        assert len(recording) == 20
        assert recording.camera.source == "CameraCalibration on /right/calibration"
    assert "/left/depth, /right/depth" in refusal(path, topic="/depth")


def test_a_camera_may_be_stated_where_the_file_has_none(path: Path) -> None:
    write_mcap(path, STORED, camera=None)
    assert "camera.toml" in refusal(path)
    with open_recording(path, camera=SMALL) as recording:
        assert recording.camera == SMALL
    write_camera(path.parent)
    with open_recording(path) as recording:
        assert recording.camera.source == "camera.toml"


def test_distortion_belongs_to_the_camera(path: Path) -> None:
    with open_recording(write_mcap(path, STORED, distortion=[0.1, 0, 0, 0, 0])) as recording:
        assert recording.camera.distortion == Distortion.of("plumb_bob", [0.1])
        assert recording.problems == []


def test_a_picture_of_another_size_is_wholly_unread_and_told(path: Path) -> None:
    context = foxglove.Context()
    writer = foxglove.open_mcap(path, context=context)
    channel = RawImageChannel("/depth", context=context)
    for k, (width, height) in enumerate([(64, 48), (64, 48), (32, 48)]):
        image = RawImage(
            timestamp=Timestamp(sec=k + 1, nsec=0),
            encoding="16UC1",
            width=width,
            height=height,
            step=2 * width,
            data=np.full(width * height, 700, np.uint16).tobytes(),
        )
        channel.log(image, log_time=k + 1)
    writer.close()
    with open_recording(path, camera=SMALL) as recording:
        assert recording.frame(1).depth.all()
        assert not recording.frame(2).depth.any()
        assert not recording.frame(2).depth.any()
        (problem,) = recording.problems
        assert "frame 2" in problem


@pytest.mark.parametrize("content", [b"", b"hello", b"\x89MCAP0\r\n"])
def test_what_is_no_mcap_is_told_in_a_sentence(path: Path, content: bytes) -> None:
    path.write_bytes(content)
    assert "r.mcap" in refusal(path)


def test_colour_topics_are_not_depth(path: Path) -> None:
    context = foxglove.Context()
    writer = foxglove.open_mcap(path, context=context)
    channel = RawImageChannel("/colour", context=context)
    image = RawImage(encoding="rgb8", width=4, height=2, step=12, data=bytes(24))
    channel.log(image, log_time=5)
    writer.close()
    sentence = refusal(path)
    assert "no depth pictures" in sentence
    assert "/colour (foxglove.RawImage, protobuf)" in sentence


@pytest.mark.parametrize("use_chunks", [True, False])
def test_a_file_that_is_still_being_written_is_read_on_from_where_it_ended(
    path: Path, use_chunks: bool
) -> None:
    whole = write_mcap(path, STORED, use_chunks=use_chunks).read_bytes()
    growing = path.with_name("growing.mcap")
    growing.write_bytes(whole[: len(whole) // 3])
    recording = open_recording(growing)
    first = len(recording)
    for share in (0.5, 0.7, 1.0):
        with growing.open("ab") as file:
            file.write(whole[growing.stat().st_size : int(share * len(whole))])
        more = recording.grown()
        assert more is not None
        assert len(more) >= len(recording)
        recording = more
        for index in range(len(recording)):
            np.testing.assert_array_equal(recording.frame(index).depth, STORED[index])
    assert first < len(recording) == len(STORED)
    assert not recording.truncated
    growing.write_bytes(whole[: len(whole) // 2])
    assert recording.grown() is None, "another file in its place is opened anew"
    recording.close()
