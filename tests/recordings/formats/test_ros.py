"""Depth in ROS's messages: in MCAP files, in ROS 1 bags and in ROS 2 bags, which read alike."""

import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.highlevel import AnyReader

from liex_lab.optics.camera import Camera, Distortion, Lens
from liex_lab.recordings import open_recording
from liex_lab.recordings.formats.messages.messages import (
    DepthMessage,
    PackedDepthImage,
    PointCloud,
    RawDepthImage,
)
from liex_lab.recordings.formats.messages.parsers import (
    MOST_PIXELS,
    decode_message,
    image_size,
)
from tests.recordings.asking import depths_in, facts_in, refusal
from tests.recordings.ros_writers import (
    How,
    ros_messages,
    serialised,
    write_bag,
    write_db3,
    write_messages,
    write_ros_mcap,
)
from tests.recordings.writers import SMALL, START_NS, depth_frames, even_times

STORED = depth_frames(9)
FLOATS = STORED.astype(np.float32) / 1000
Writer = Callable[..., Path]
WRITERS: dict[str, Writer] = {
    "mcap, ROS 1": lambda folder, frames, **how: write_ros_mcap(
        folder / "r.mcap", frames, 1, **how
    ),
    "mcap, ROS 2": lambda folder, frames, **how: write_ros_mcap(
        folder / "r.mcap", frames, 2, **how
    ),
    "bag": lambda folder, frames, **how: write_bag(folder / "r.bag", frames, **how),
    "db3": lambda folder, frames, **how: write_db3(folder / "r", frames, **how),
}


@pytest.fixture(params=WRITERS)
def write(request: pytest.FixtureRequest, tmp_path: Path) -> Writer:
    writer = WRITERS[request.param]
    return lambda frames=STORED, **how: writer(tmp_path, frames, **how)


@pytest.mark.parametrize("kind", ["16UC1", "mono16", "png", "rvl", "plain png"])
def test_sixteen_bits_are_millimetres(write: Writer, kind: str) -> None:
    with open_recording(write(kind=kind), strict=True) as recording:
        assert recording.times_ns.tolist() == even_times(len(STORED))
        for frame in recording:
            np.testing.assert_array_equal(frame.depth, STORED[frame.index])
        assert recording.problems == []
        assert recording.camera.matrix.tolist() == SMALL.matrix.tolist()
        assert recording.camera.source == "CameraInfo on /camera/depth/camera_info"


@pytest.mark.parametrize("big_endian", [False, True])
@pytest.mark.parametrize("padding", [0, 6])
@pytest.mark.parametrize("frames", [STORED, FLOATS])
def test_either_byte_order_and_padded_rows(
    write: Writer, frames: Any, big_endian: bool, padding: int
) -> None:
    kind = "16UC1" if frames is STORED else "32FC1"
    np.testing.assert_allclose(
        depths_in(write(frames, kind=kind, big_endian=big_endian, padding=padding)),
        STORED,
        atol=1e-4,
    )


@pytest.mark.parametrize("kind", ["32FC1 png", "32FC1 rvl"])
def test_quantised_inverse_depth_is_metres_again(write: Writer, kind: str) -> None:
    """A step of ROS's own quantisation is 0.05 mm wide at 0.7 m."""
    with open_recording(write(FLOATS, kind=kind)) as recording:
        np.testing.assert_allclose([frame.depth for frame in recording], STORED, atol=0.06)
        np.testing.assert_array_equal(recording.frame(3).depth == 0, STORED[3] == 0)


@pytest.mark.parametrize("big_endian", [False, True])
def test_points_in_rows_are_a_depth_picture(write: Writer, big_endian: bool) -> None:
    np.testing.assert_allclose(
        depths_in(write(kind="cloud", big_endian=big_endian, padding=8)), STORED, atol=1e-3
    )


def test_of_two_points_on_a_pixel_the_nearer_is_seen(tmp_path: Path) -> None:
    far = np.full((1, 96, 128), 900, np.uint16)
    far[0, ::2, ::2] = 600
    fine = Camera(120.0, 122.0, 63.25, 47.25, 128, 96)
    path = write_ros_mcap(tmp_path / "r.mcap", far, kind="loose cloud", camera=fine)
    depth = depths_in(path, camera=Camera(60.0, 61.0, 31.5, 23.5, 64, 48))[0]
    assert set(np.unique(depth.round())) <= {0.0, 600.0, 900.0}
    assert (depth.round() == 600).mean() > 0.9


def test_loose_points_need_a_picture_to_be_seen_in(write: Writer) -> None:
    path = write(kind="loose cloud", calibrated=False)
    assert "write a camera.toml" in refusal(path)
    assert "lie in no image" in refusal(path, camera=Lens(60.0, 61.0, 31.5, 23.5))
    np.testing.assert_allclose(depths_in(path, camera=SMALL)[0], STORED[0], atol=1e-3)


def test_images_come_before_the_clouds_made_of_them(tmp_path: Path) -> None:
    clouds, images = How(kind="cloud", topics=("/camera/points",)), How(topics=("/camera/depth",))
    messages = (
        (topic, message.__msgtype__, "cdr", log_ns, log_ns, serialised(2, message))
        for how in (clouds, images)
        for topic, log_ns, message in ros_messages(2, STORED, how)
    )
    path = write_messages(tmp_path / "r.mcap", messages)
    np.testing.assert_array_equal(depths_in(path)[2], STORED[2])
    np.testing.assert_allclose(depths_in(path, topic="/camera/points")[2], STORED[2], atol=1e-3)


def test_infrared_is_not_taken_for_depth(write: Writer) -> None:
    path = write(
        kind="mono16", topics=("/camera/infra1/image_rect_raw", "/camera/depth/image_rect_raw")
    )
    assert facts_in(path).camera.source.endswith("/camera/depth/camera_info")
    assert facts_in(path, topic="/camera/infra1/image_rect_raw").camera.source.endswith(
        "/camera/infra1/camera_info"
    )


def test_several_depth_topics_are_named_and_one_is_chosen(write: Writer) -> None:
    path = write(topics=("/left/depth", "/right/depth"))
    sentence = refusal(path)
    assert "/left/depth, /right/depth; choose one with --topic /left/depth" in sentence
    assert "/left/depth, /right/depth" in refusal(path, topic="/depth")
    with open_recording(path, topic="/right/depth") as recording:
        assert len(recording) == len(STORED)
        assert recording.camera.source == "CameraInfo on /right/camera_info"


def test_a_file_without_stamps_has_the_times_of_logging(write: Writer) -> None:
    with open_recording(write(stamped=False)) as recording:
        assert recording.times_ns.tolist() == even_times(len(STORED))
        assert any("no stamp" in problem for problem in recording.problems)


def test_distortion_belongs_to_the_camera_unless_the_picture_is_straightened(write: Writer) -> None:
    path = write(
        distortion=(0.1, 0.0, 0.0, 0.0, 0.0), topics=("/d/image_raw", "/straight/image_rect_raw")
    )
    assert facts_in(path, topic="/d/image_raw").camera.distortion == Distortion.of(
        "plumb_bob", [0.1]
    )
    assert facts_in(path, topic="/straight/image_rect_raw").camera.distortion is None


def test_loose_points_are_seen_through_the_lens_and_straight_already(write: Writer) -> None:
    path = write(kind="loose cloud", distortion=(0.1, 0.0, 0.0, 0.0, 0.0))
    assert facts_in(path).camera.distortion is None
    np.testing.assert_allclose(depths_in(path), STORED, atol=1e-3)


def test_a_distortion_that_is_not_known_is_told(write: Writer) -> None:
    with open_recording(
        write(model="Inverse Brown Conrady", distortion=(0.1, 0.0, 0.0, 0.0, 0.0))
    ) as recording:
        assert recording.camera.distortion is None
        assert "Inverse Brown Conrady" in recording.problems[0]


@pytest.mark.parametrize("writer", ["bag", "db3"])
def test_it_agrees_with_the_reader_of_rosbags(tmp_path: Path, writer: str) -> None:
    path = WRITERS[writer](tmp_path, STORED, log_delay_ns=5_000_000)
    with AnyReader([path]) as reader, open_recording(path) as recording:
        depth = [c for c in reader.connections if c.msgtype.endswith("/Image")]
        messages: list[Any] = [
            reader.deserialize(data, c.msgtype) for c, _, data in reader.messages(depth)
        ]
        assert len(messages) == len(recording)
        for frame, message in zip(recording, messages, strict=True):
            assert frame.time_ns == message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
            np.testing.assert_array_equal(frame.depth.ravel(), message.data.view("<u2"))


@pytest.mark.parametrize(("unit_m", "step_mm"), [(0.001, 1.0), (0.00025, 0.25), (0.0001, 0.1)])
def test_a_realsense_recording_states_its_unit(
    tmp_path: Path, unit_m: float, step_mm: float
) -> None:
    topic = "/device_0/sensor_0/Depth_0/image/data"
    path = write_bag(tmp_path / "r.bag", STORED, kind="mono16", topics=(topic,), unit_m=unit_m)
    np.testing.assert_allclose(depths_in(path)[1], STORED[1] * step_mm, rtol=1e-6)


@pytest.mark.parametrize(
    ("name", "content", "says"),
    [
        ("r.bag", b"hello", "something else"),
        ("r.bag", b"#ROSBAG V1.2\n" + bytes(99), "old ROS"),
        ("r.bag", b"#ROSBAG V2.0\n", "holds no depth images"),
        ("r.db3", b"", "is empty"),
        ("r.db3", b"SQLite format 3\0" + bytes(5000), "holds no depth images"),
    ],
)
def test_what_is_no_bag_is_told_in_a_sentence(
    tmp_path: Path, name: str, content: bytes, says: str
) -> None:
    (tmp_path / name).write_bytes(content)
    assert says in refusal(tmp_path / name)


def test_an_encrypted_bag_is_told(tmp_path: Path) -> None:
    fields = [b"op=\x03", b"index_pos=" + bytes(8), b"encryptor=rosbag/AesCbcEncryptor"]
    header = b"".join(len(field).to_bytes(4, "little") + field for field in fields)
    path = tmp_path / "r.bag"
    path.write_bytes(b"#ROSBAG V2.0\n" + len(header).to_bytes(4, "little") + header + bytes(4))
    assert "encrypted" in refusal(path)


def test_log_times_are_whole_nanoseconds(write: Writer) -> None:
    times = [START_NS + k * 33_333_333 + (k % 3) for k in range(len(STORED))]
    assert facts_in(write(times_ns=times)).times_ns.tolist() == times


# Sizes that cannot be, in every kind of message: no image, and no memory asked for.


PIXELS = bytes(2 * 64 * 48)
COLUMNS = {"x": (0, "<f4"), "y": (4, "<f4"), "z": (8, "<f4")}
HUGE = 1 << 31


def png_head(width: int, height: int) -> bytes:
    return b"\x89PNG\r\n\x1a\n" + struct.pack(
        ">I4sIIBBBBB", 13, b"IHDR", width, height, 16, 0, 0, 0, 0
    )


def rvl(width: int, height: int) -> bytes:
    return bytes(12) + struct.pack("<II", width, height) + bytes(64)


@pytest.mark.parametrize(
    "message",
    [
        RawDepthImage(1, "", HUGE, HUGE, "16UC1", 128, False, PIXELS),
        RawDepthImage(1, "", 0, 48, "16UC1", 128, False, PIXELS),
        RawDepthImage(1, "", -64, -48, "16UC1", 128, False, PIXELS),
        RawDepthImage(1, "", 64, 48, "rgb8", 192, False, PIXELS),
        PackedDepthImage(1, "", "png", png_head(HUGE - 1, HUGE - 1)),
        PackedDepthImage(1, "", "png", png_head(MOST_PIXELS, 2)),
        PackedDepthImage(1, "", "png", b""),
        PackedDepthImage(1, "", "jpeg", b"\xff\xd8\xff" + bytes(99)),
        PackedDepthImage(1, "", "16UC1; compressedDepth rvl", rvl(HUGE, HUGE)),
        PackedDepthImage(1, "", "16UC1; compressedDepth rvl", b"short"),
        PackedDepthImage(1, "", "16UC1; compressedDepth", b"short"),
        PointCloud(1, "", HUGE, 1, COLUMNS, 12, 0, PIXELS),
        PointCloud(1, "", 0, 0, COLUMNS, 12, 0, PIXELS),
        PointCloud(1, "", 64, 48, {"x": (0, "<f4")}, 12, 0, PIXELS),
    ],
    ids=str,
)
def test_what_cannot_be_a_depth_picture_is_none(message: DepthMessage) -> None:
    assert image_size(message) is None
    assert decode_message(message, SMALL, 1.0, 1.0) is None


@pytest.mark.parametrize(
    "message",
    [
        RawDepthImage(1, "", 64, 48, "16UC1", 128, False, PIXELS[:-1]),
        RawDepthImage(1, "", 64, 48, "16UC1", 126, False, PIXELS),
        RawDepthImage(1, "", 64, 48, "16UC1", HUGE, False, PIXELS),
        RawDepthImage(1, "", 48, 64, "16UC1", 96, False, PIXELS),
        PackedDepthImage(1, "", "png", png_head(64, 48)),
        PackedDepthImage(1, "", "16UC1; compressedDepth rvl", rvl(64, 48)[:24]),
        PointCloud(1, "", 64, 48, COLUMNS, 12, 768, PIXELS),
        PointCloud(1, "", 64, 48, COLUMNS, 8, 512, bytes(64 * 48 * 8)),
        PointCloud(1, "", 9, 1, COLUMNS, 12, 0, bytes(100)),
    ],
    ids=str,
)
def test_a_picture_that_is_not_all_there_is_none(message: DepthMessage) -> None:
    assert decode_message(message, SMALL, 1.0, 1.0) is None


def test_the_padding_of_the_last_row_may_be_left_out() -> None:
    rows = np.zeros((48, 70), np.uint16)
    rows[:, :64] = np.arange(48 * 64).reshape(48, 64)
    message = RawDepthImage(1, "", 64, 48, "16UC1", 140, False, rows.tobytes()[:-12])
    np.testing.assert_array_equal(decode_message(message, SMALL, 1.0, 1.0), rows[:, :64])
