"""MCAP with Foxglove's messages, whole and cut."""

import base64
import json
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import foxglove
import numpy as np
import pytest
from foxglove.channels import CameraCalibrationChannel, PointCloudChannel, RawImageChannel
from foxglove.mcap import MCAPCompression
from foxglove.messages import (
    CameraCalibration,
    PackedElementField,
    PackedElementFieldNumericType,
    PointCloud,
    Pose,
    Quaternion,
    RawImage,
    Timestamp,
    Vector3,
)
from mcap.writer import CompressionType, IndexType
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from liex_lab.errors import RecordingError
from liex_lab.recordings import Recording, open_recording
from liex_lab.recordings.formats.messages.mcap import McapFile
from liex_lab.recordings.formats.messages.rosbag import BagFile
from liex_lab.recordings.frame import DepthFrame
from liex_lab.recordings.writer import McapDepthWriter
from liex_lab.runtime.progress import silent
from tests.recordings.asking import depths_in, facts_in, opened_or_refused, refusal
from tests.recordings.ros_writers import points_of, write_bag, write_messages, write_ros_mcap
from tests.recordings.writers import (
    SMALL,
    START_NS,
    cut,
    depth_frames,
    even_times,
    write_camera,
    write_mcap,
)

STORED = depth_frames(20)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "r.mcap"


def test_floats_are_metres_and_nan_is_unread(path: Path) -> None:
    stored = STORED.astype(np.float32) / 1000
    stored[:, 0, :3] = [np.nan, np.inf, -1.0]
    depth = depths_in(write_mcap(path, stored, encoding="32FC1"))[5]
    np.testing.assert_array_equal(depth[0, :3], 0.0)
    np.testing.assert_allclose(depth[1:], STORED[5, 1:], atol=1e-4)


def test_a_sensor_clock_may_begin_at_zero(path: Path) -> None:
    times = even_times(20, start_ns=0)
    recording = facts_in(write_mcap(path, STORED, times_ns=times, log_delay_ns=START_NS))
    assert (recording.times_ns.tolist(), recording.metadata) == (times, {})


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


def test_colour_topics_are_not_depth(path: Path) -> None:
    context = foxglove.Context()
    writer = foxglove.open_mcap(path, context=context)
    channel = RawImageChannel("/colour", context=context)
    image = RawImage(encoding="rgb8", width=4, height=2, step=12, data=bytes(24))
    channel.log(image, log_time=5)
    writer.close()
    sentence = refusal(path)
    assert "no depth images" in sentence
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


# MCAP files opened by their index: as if they were walked, and what is damaged is told.


ONE = 1  # bytes of a chunk: every message closes its own

Write = Callable[[Path], Any]
KINDS: dict[str, Write] = {
    "zstd": lambda path: write_mcap(path, STORED, chunk_size=ONE),
    "lz4": lambda path: write_mcap(
        path,
        STORED,
        chunk_size=ONE,
        compression=MCAPCompression.Lz4,
        log_delay_ns=7_000_000,
    ),
    "none": lambda path: write_mcap(path, STORED, compression=None, log_delay_ns=7_000_000),
    "png": lambda path: write_mcap(path, STORED, encoding="png", compression=None),
    "two topics": lambda path: write_mcap(
        path, STORED, compression=None, topics=("/camera/depth", "/camera/ir")
    ),
    "out of order": lambda path: write_mcap(
        path,
        STORED,
        compression=None,
        times_ns=np.array(even_times(20))[[0, 2, 1, *range(3, 20)]].tolist(),
    ),
    "from zero": lambda path: write_mcap(
        path,
        STORED,
        compression=None,
        times_ns=even_times(20, start_ns=0),
        log_delay_ns=START_NS,
    ),
    "ros 1": lambda path: write_ros_mcap(
        path, STORED, 1, compression=CompressionType.NONE, log_delay_ns=3_000_000
    ),
    "ros 2": lambda path: write_ros_mcap(path, STORED, 2, chunk_size=ONE, log_delay_ns=3_000_000),
    "ros 2, a cloud": lambda path: write_ros_mcap(
        path, STORED, 2, kind="cloud", compression=CompressionType.LZ4, chunk_size=ONE
    ),
    "ros 2, big endian": lambda path: write_ros_mcap(
        path, STORED, 2, compression=CompressionType.NONE, big_endian=True
    ),
}
WALKED: dict[str, Write] = {
    "many to a packed chunk": lambda path: write_mcap(path, STORED),
    "before 1970": lambda path: written(path, times_ns=even_times(20, start_ns=-(10**9))),
    "no chunks": lambda path: write_mcap(path, STORED, use_chunks=False),
    "no stamps": lambda path: write_mcap(
        path, STORED, stamped=False, compression=None, log_delay_ns=7_000_000
    ),
}


def written(path: Path, times_ns: list[int]) -> None:
    """By this program's own writer."""
    with McapDepthWriter(path, SMALL) as writer:
        for k, (time_ns, depth) in enumerate(zip(times_ns, STORED, strict=True)):
            writer.add(DepthFrame(k, time_ns, depth.astype(np.float32)))


def facts(recording: Recording) -> dict[str, Any]:
    """All that a recording says of itself."""
    return {
        "times": recording.times_ns.tolist(),
        "faults": recording.stamp_faults.tolist(),
        "camera": recording.camera,
        "metadata": recording.metadata,
        "depth": [frame.depth.tobytes() for frame in recording],
        "problems": recording.problems,
    }


@pytest.mark.parametrize("kind", [*KINDS, *WALKED])
def test_a_file_says_by_its_index_what_it_says_when_it_is_walked(path: Path, kind: str) -> None:
    (KINDS | WALKED)[kind](path)
    with (
        open_recording(path) as walked,
        open_recording(path, strict=True) as indexed,
    ):
        assert facts(indexed) == facts(walked)


@pytest.mark.parametrize("share", [0.05, 0.5, 0.99])
@pytest.mark.parametrize("kind", ["zstd", "ros 2"])
def test_a_cut_file_is_refused_at_once(path: Path, kind: str, share: float) -> None:
    KINDS[kind](path)
    cut(path, share)
    assert "cut" in refusal(path, strict=True)


@pytest.mark.parametrize("kind", ["zstd", "none"])
def test_no_damage_anywhere_is_taken_for_depth(path: Path, kind: str) -> None:
    KINDS[kind](path)
    whole = path.read_bytes()
    with open_recording(path) as recording:
        stored = {(frame.time_ns, frame.depth.tobytes()) for frame in recording}
    rng = np.random.default_rng(5)
    told = []
    for at in np.linspace(10, len(whole) - 10, 24).astype(int):
        content = bytearray(whole)
        content[at : at + 8] = rng.integers(0, 256, 8).astype(np.uint8).tobytes()
        path.write_bytes(content)
        try:
            with open_recording(path, strict=True) as recording:
                seen = {(frame.time_ns, frame.depth.tobytes()) for frame in recording}
                assert seen <= stored or recording.problems
                assert len(seen) == len(stored)
        except RecordingError as error:
            told.append(str(error))
    assert len(told) > 12
    assert not any("\n" in sentence for sentence in told)


def test_a_damaged_chunk_is_told_of_when_it_is_read_and_says_what_to_do(
    path: Path,
) -> None:
    KINDS["none"](path)
    content = bytearray(path.read_bytes())
    at = content.find(STORED[11].astype("<u2").tobytes()[2000:2100])
    assert at > 0
    content[at] ^= 1
    path.write_bytes(content)
    with open_recording(path, strict=True) as recording:
        np.testing.assert_array_equal(recording.frame(0).depth, STORED[0])
        with pytest.raises(RecordingError, match="accept_truncated"):
            recording.frame(11)
    with open_recording(path) as recording:
        assert recording.truncated
        assert len(recording) < 20


# What damage to one chunk of an MCAP file or a ROS bag costs; 200 variants of each are in
# test_damage.py.


MESSAGE_DAMAGE_STORED = depth_frames(12)
FRAMES = [frame.astype(np.float32).tobytes() for frame in MESSAGE_DAMAGE_STORED]


def chunk_starts(path: Path) -> list[int]:
    """Where the records of a file's chunks begin, in order."""
    file = (McapFile if path.suffix == ".mcap" else BagFile)(path, path.open("rb"))
    list(file.walk(lambda channel: True, silent))
    file.close()
    return file.starts


@pytest.mark.parametrize("write", [write_mcap, write_bag])
@pytest.mark.parametrize("number", [0, 2, -1])
@pytest.mark.parametrize("where", ["length", "content"])
def test_a_damaged_chunk_costs_its_own_frames_only(
    tmp_path: Path, write: Callable[..., Path], number: int, where: str
) -> None:
    """Also the first one, which tells what the messages are, and one whose length is lost: the
    file's end tells.
    """
    path = write(tmp_path / ("r.mcap" if write is write_mcap else "r.bag"), MESSAGE_DAMAGE_STORED)
    write_camera(tmp_path)
    content = bytearray(path.read_bytes())
    starts = chunk_starts(path)
    assert len(starts) >= 4
    at = starts[number] + (0 if where == "length" else 400)
    content[at : at + 60] = b"\xff" * 60
    path.write_bytes(content)
    with open_recording(path) as recording:
        found = {frame.depth.tobytes() for frame in recording}
        assert recording.truncated
    assert len(MESSAGE_DAMAGE_STORED) - 4 <= len(found) < len(MESSAGE_DAMAGE_STORED)
    assert found < set(FRAMES)


# Foxglove's other ways to hold depth in an MCAP file: JSON, point clouds, few large chunks, no
# index.


FOXGLOVE_STORED = depth_frames(9)


def write_json(
    path: Path, schema: str, contents: list[Any], calibration: dict[str, Any] | None = None
) -> Path:
    """Foxglove's messages in JSON, with the least that an MCAP file may have: no chunk, no index,
    no summary.
    """
    written = [
        (topic, kind, "json", time_ns, time_ns, json.dumps(message).encode())
        for topic, kind, messages in (
            ("/camera/calibration", "foxglove.CameraCalibration", [calibration or {}]),
            ("/camera/depth", schema, contents),
        )
        for time_ns, message in zip(even_times(len(messages)), messages, strict=True)
    ]
    return write_messages(
        path,
        written,
        use_chunking=False,
        index_types=IndexType.NONE,
        repeat_channels=False,
        repeat_schemas=False,
        use_statistics=False,
        use_summary_offsets=False,
    )


def json_message(k: int, data: bytes, **more: Any) -> dict[str, Any]:
    sec, nsec = divmod(even_times(len(FOXGLOVE_STORED))[k], 10**9)
    content = base64.b64encode(data).decode()
    return {"timestamp": {"sec": sec, "nsec": nsec}, "frame_id": "camera", "data": content, **more}


CALIBRATION = {
    "frame_id": "camera",
    "width": 64,
    "height": 48,
    "D": [],
    "K": SMALL.matrix.ravel().tolist(),
}


@pytest.mark.parametrize("packed", [False, True])
def test_images_in_json(tmp_path: Path, packed: bool) -> None:
    messages = [
        json_message(k, cv2.imencode(".png", frame)[1].tobytes(), format="png")
        if packed
        else json_message(k, frame.tobytes(), width=64, height=48, step=128, encoding="16UC1")
        for k, frame in enumerate(FOXGLOVE_STORED)
    ]
    schema = f"foxglove.{'Compressed' if packed else 'Raw'}Image"
    path = write_json(tmp_path / "r.mcap", schema, messages, CALIBRATION)
    with open_recording(path) as recording:
        assert recording.times_ns.tolist() == even_times(len(FOXGLOVE_STORED))
        told = (recording.camera.fx, recording.problems, recording.truncated)
        assert told == (SMALL.fx, [], False)
        np.testing.assert_array_equal([frame.depth for frame in recording], FOXGLOVE_STORED)


@pytest.mark.parametrize(
    "message",
    [
        [],
        "text",
        {"width": "wide"},
        {"timestamp": 7},
        {"data": "%%%"},
        {"encoding": 5},
        {"width": 1e300},
        {"width": -64, "height": -48, "step": -128, "encoding": "16UC1"},
        {"width": float("nan")},
        {"timestamp": []},
    ],
)
@pytest.mark.parametrize(
    "schema", ["foxglove.RawImage", "foxglove.CompressedImage", "foxglove.PointCloud"]
)
def test_any_json_is_refused_in_a_sentence(tmp_path: Path, schema: str, message: Any) -> None:
    assert "no depth images" in refusal(
        write_json(tmp_path / "r.mcap", schema, [message], CALIBRATION)
    )
    assert "no depth images" in refusal(write_json(tmp_path / "r.mcap", schema, [message], message))


def write_clouds(path: Path, clouds: list[NDArray[np.float32]], pose: Pose | None = None) -> Path:
    """Foxglove's point clouds, (n, 3) m each."""
    context = foxglove.Context()
    writer = foxglove.open_mcap(path, context=context, allow_overwrite=True)
    k = [float(value) for value in SMALL.matrix.ravel()]
    lens = CameraCalibration(
        timestamp=Timestamp(sec=0, nsec=0), frame_id="camera", width=64, height=48, K=k
    )
    CameraCalibrationChannel("/camera/calibration", context=context).log(lens, log_time=START_NS)
    channel = PointCloudChannel("/camera/points", context=context)
    fields = [
        PackedElementField(name=name, offset=4 * i, type=PackedElementFieldNumericType.Float32)
        for i, name in enumerate("xyz")
    ]
    for time_ns, points in zip(even_times(len(clouds)), clouds, strict=True):
        stamp = Timestamp(sec=time_ns // 10**9, nsec=time_ns % 10**9)
        cloud = PointCloud(
            timestamp=stamp,
            frame_id="camera",
            pose=pose,
            point_stride=12,
            fields=fields,
            data=points.tobytes(),
        )
        channel.log(cloud, log_time=time_ns)
    writer.close()
    return path


@pytest.mark.parametrize("loose", [False, True])
def test_point_clouds(tmp_path: Path, loose: bool) -> None:
    clouds = [points_of(frame, SMALL).reshape(-1, 3) for frame in FOXGLOVE_STORED]
    clouds = [points[np.isfinite(points[:, 2])][::-1] if loose else points for points in clouds]
    with open_recording(write_clouds(tmp_path / "r.mcap", clouds)) as recording:
        assert recording.times_ns.tolist() == even_times(len(FOXGLOVE_STORED))
        np.testing.assert_allclose([frame.depth for frame in recording], FOXGLOVE_STORED, atol=1e-3)


def test_a_cloud_may_lie_in_a_frame_of_its_own(tmp_path: Path) -> None:
    """Points in a frame with x ahead, y left, z up; its pose takes them into the camera's."""
    T = np.array(
        [[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]
    )  # of the camera's axes in that frame's
    at = np.array([0.1, 0.0, 0.05])
    clouds = [
        ((points_of(f, SMALL).reshape(-1, 3) - at) @ T).astype(np.float32) for f in FOXGLOVE_STORED
    ]
    x, y, z, w = Rotation.from_matrix(T).as_quat().tolist()
    turn = Quaternion(x=x, y=y, z=z, w=w)
    pose = Pose(position=Vector3(x=0.1, y=0.0, z=0.05), orientation=turn)
    np.testing.assert_allclose(
        depths_in(write_clouds(tmp_path / "r.mcap", clouds, pose)), FOXGLOVE_STORED, atol=2e-3
    )


@pytest.mark.parametrize("compression", [MCAPCompression.Zstd, MCAPCompression.Lz4, None])
@pytest.mark.parametrize("share", [0.2, 0.6, 0.99])
def test_a_cut_chunk_gives_what_it_still_holds(
    tmp_path: Path, share: float, compression: MCAPCompression | None
) -> None:
    """All frames lie in one chunk; packed ones come in blocks, of which the last is lost: at most
    21 frames.
    """
    stored = depth_frames(80)
    path = write_mcap(tmp_path / "r.mcap", stored, compression=compression, chunk_size=1 << 24)
    cut(path, share)
    recording, sentence = opened_or_refused(path)
    if recording is None:
        assert "cut or damaged" in sentence
        assert share < 0.3
        return
    with recording:
        assert recording.truncated
        assert len(recording) >= int(share * 80) - (3 if compression is None else 23)
        np.testing.assert_array_equal(
            [frame.depth for frame in recording], stored[: len(recording)]
        )


def test_zeros_at_the_end_are_no_records(tmp_path: Path) -> None:
    """A file system that fills up with zeros; nine bytes at a time would take for ever."""
    path = write_mcap(tmp_path / "r.mcap", FOXGLOVE_STORED)
    content = path.read_bytes()
    path.write_bytes(content[: int(len(content) * 0.7)] + bytes(5_000_000))
    with open_recording(path) as recording:
        assert recording.truncated
        assert len(recording) >= 4


def test_a_chunk_that_promises_too_much_is_damaged(tmp_path: Path) -> None:
    """Its unpacked size is bounded before any memory is asked for."""
    path = write_mcap(tmp_path / "r.mcap", FOXGLOVE_STORED, chunk_size=1 << 20)
    content = bytearray(path.read_bytes())
    size_at = (
        content.index(b"zstd") - 16
    )  # before the name: the size (8), its checksum (4), the name's length (4)
    content[size_at : size_at + 8] = struct.pack("<Q", 1 << 60)
    path.write_bytes(content)
    assert "cut or damaged" in refusal(path)
