"""Foxglove's other ways to hold depth in an MCAP file: JSON, point clouds, few large chunks, no
index.
"""

from __future__ import annotations

import base64
import json
import struct
from pathlib import Path
from typing import Any

import cv2
import foxglove
import numpy as np
import pytest
from foxglove.channels import CameraCalibrationChannel, PointCloudChannel
from foxglove.mcap import MCAPCompression
from foxglove.messages import (
    CameraCalibration,
    PackedElementField,
    PackedElementFieldNumericType,
    PointCloud,
    Pose,
    Quaternion,
    Timestamp,
    Vector3,
)
from mcap.writer import IndexType
from mcap.writer import Writer as McapWriter
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from liex_lab.recordings import open_recording
from tests.recordings.asking import opened_or_refused, refusal
from tests.recordings.ros_writers import points_of
from tests.recordings.writers import SMALL, START_NS, cut, depth_frames, even_times, write_mcap

STORED = depth_frames(9)


def write_json(
    path: Path, schema: str, contents: list[Any], calibration: dict[str, Any] | None = None
) -> Path:
    """Foxglove's messages in JSON, with the least that an MCAP file may have: no chunk, no index,
    no summary.
    """
    with path.open("wb") as file:
        writer = McapWriter(
            file,
            use_chunking=False,
            index_types=IndexType.NONE,
            repeat_channels=False,
            repeat_schemas=False,
            use_statistics=False,
            use_summary_offsets=False,
        )
        writer.start()
        for topic, kind, messages in (
            ("/camera/calibration", "foxglove.CameraCalibration", [calibration or {}]),
            ("/camera/depth", schema, contents),
        ):
            channel = writer.register_channel(
                topic, "json", writer.register_schema(kind, "jsonschema", b"{}")
            )
            for time_ns, message in zip(even_times(len(messages)), messages, strict=True):
                writer.add_message(channel, time_ns, json.dumps(message).encode(), time_ns)
        writer.finish()
    return path


def json_message(k: int, data: bytes, **more: Any) -> dict[str, Any]:
    sec, nsec = divmod(even_times(len(STORED))[k], 10**9)
    content = base64.b64encode(data).decode()
    return {"timestamp": {"sec": sec, "nsec": nsec}, "frame_id": "camera", "data": content, **more}


CALIBRATION = {
    "frame_id": "camera",
    "width": 64,
    "height": 48,
    "D": [],
    "K": SMALL.matrix.ravel().tolist(),
}


def test_raw_pictures_in_json(tmp_path: Path) -> None:
    shape = {"width": 64, "height": 48, "step": 128, "encoding": "16UC1"}
    messages = [json_message(k, frame.tobytes(), **shape) for k, frame in enumerate(STORED)]
    with open_recording(
        write_json(tmp_path / "r.mcap", "foxglove.RawImage", messages, CALIBRATION)
    ) as recording:
        assert recording.times_ns.tolist() == even_times(len(STORED))
        assert (recording.camera.fx, recording.problems, recording.truncated) == (
            SMALL.fx,
            [],
            False,
        )
        np.testing.assert_array_equal([frame.depth for frame in recording], STORED)


def test_packed_pictures_in_json(tmp_path: Path) -> None:
    messages = [
        json_message(k, cv2.imencode(".png", frame)[1].tobytes(), format="png")
        for k, frame in enumerate(STORED)
    ]
    with open_recording(
        write_json(tmp_path / "r.mcap", "foxglove.CompressedImage", messages, CALIBRATION)
    ) as recording:
        np.testing.assert_array_equal([frame.depth for frame in recording], STORED)


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
    assert "no depth pictures" in refusal(
        write_json(tmp_path / "r.mcap", schema, [message], CALIBRATION)
    )
    assert "no depth pictures" in refusal(
        write_json(tmp_path / "r.mcap", schema, [message], message)
    )


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
    clouds = [points_of(frame, SMALL).reshape(-1, 3) for frame in STORED]
    clouds = [points[np.isfinite(points[:, 2])][::-1] if loose else points for points in clouds]
    with open_recording(write_clouds(tmp_path / "r.mcap", clouds)) as recording:
        assert recording.times_ns.tolist() == even_times(len(STORED))
        np.testing.assert_allclose([frame.depth for frame in recording], STORED, atol=1e-3)


def test_a_cloud_may_lie_in_a_frame_of_its_own(tmp_path: Path) -> None:
    """Points in a frame with x ahead, y left, z up; its pose takes them into the camera's."""
    T = np.array(
        [[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]
    )  # of the camera's axes in that frame's
    at = np.array([0.1, 0.0, 0.05])
    clouds = [((points_of(f, SMALL).reshape(-1, 3) - at) @ T).astype(np.float32) for f in STORED]
    x, y, z, w = Rotation.from_matrix(T).as_quat().tolist()
    turn = Quaternion(x=x, y=y, z=z, w=w)
    pose = Pose(position=Vector3(x=0.1, y=0.0, z=0.05), orientation=turn)
    with open_recording(write_clouds(tmp_path / "r.mcap", clouds, pose)) as recording:
        np.testing.assert_allclose([frame.depth for frame in recording], STORED, atol=2e-3)


@pytest.mark.parametrize("compression", [MCAPCompression.Zstd, MCAPCompression.Lz4, None])
@pytest.mark.parametrize("share", np.linspace(0.2, 0.99, 9).round(3).tolist())
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
    path = write_mcap(tmp_path / "r.mcap", STORED)
    content = path.read_bytes()
    path.write_bytes(content[: int(len(content) * 0.7)] + bytes(50_000_000))
    with open_recording(path) as recording:
        assert recording.truncated
        assert len(recording) >= 4


def test_a_chunk_that_promises_too_much_is_damaged(tmp_path: Path) -> None:
    """Its unpacked size is bounded before any memory is asked for."""
    path = write_mcap(tmp_path / "r.mcap", STORED, chunk_size=1 << 20)
    content = bytearray(path.read_bytes())
    size_at = (
        content.index(b"zstd") - 16
    )  # before the name: the size (8), its checksum (4), the name's length (4)
    content[size_at : size_at + 8] = struct.pack("<Q", 1 << 60)
    path.write_bytes(content)
    assert "cut or damaged" in refusal(path)
