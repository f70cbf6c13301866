"""What the writers write, their own readers and other people's read again."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory
from numpy.typing import NDArray
from rosbags.highlevel import AnyReader

from liex_lab.errors import RecordingError
from liex_lab.optics.camera import Distortion
from liex_lab.recordings import open_recording
from liex_lab.recordings.frame import DepthFrame, depth_mm, metres, nearest_steps, whole_steps
from liex_lab.recordings.writer import ImageFolderWriter, McapDepthWriter, RecordingWriter
from tests.recordings.asking import depths_in, exact
from tests.recordings.writers import SMALL, START_NS, depth_frames, even_times

STORED = depth_frames(40).astype(np.float32)


def fill(writer: RecordingWriter, depths: Any = STORED, start_ns: int = START_NS) -> list[str]:
    with writer:
        for k, time_ns in enumerate(even_times(len(depths), start_ns)):
            writer.add(DepthFrame(k, time_ns, depths[k]))
    return writer.notes


WRITERS: dict[str, Any] = {
    "raw": lambda folder: McapDepthWriter(folder / "r.mcap", SMALL),
    "png": lambda folder: McapDepthWriter(folder / "r.mcap", SMALL, packing="png"),
    "ros": lambda folder: McapDepthWriter(folder / "r.mcap", SMALL, messages="ros"),
    "ros png": lambda folder: McapDepthWriter(
        folder / "r.mcap", SMALL, messages="ros", packing="png"
    ),
    "images": lambda folder: ImageFolderWriter(folder / "r", SMALL),
}


@pytest.mark.parametrize("kind", WRITERS)
@pytest.mark.parametrize("start_ns", [START_NS, 0, -5_000_000_000, -5 * 33_333_333])
def test_what_is_written_is_read_again(tmp_path: Path, kind: str, start_ns: int) -> None:
    writer = WRITERS[kind](tmp_path)
    assert fill(writer, start_ns=start_ns) == []
    recording = exact(writer.path, STORED, strict=True)
    assert recording.problems == []
    assert recording.times_ns.tolist() == even_times(len(STORED), start_ns)
    assert recording.camera.matrix.tolist() == SMALL.matrix.tolist()


BENT = [
    Distortion.of("plumb_bob", [0.1, -0.02, 0.001, 0.002, 0.03]),
    Distortion.of("rational_polynomial", [0.1, -0.02, 0.001, 0.002, 0.03, 0.4, 0.05, 0.06]),
    Distortion.of("equidistant", [0.1, -0.02, 0.01, 0.001]),
]


@pytest.mark.parametrize("kind", WRITERS)
@pytest.mark.parametrize("distortion", BENT, ids=str)
def test_a_bent_lens_stays_bent(
    tmp_path: Path, kind: str, distortion: Distortion, monkeypatch: Any
) -> None:
    monkeypatch.setattr("tests.recordings.test_writer.SMALL", replace(SMALL, distortion=distortion))
    writer = WRITERS[kind](tmp_path)
    assert fill(writer, STORED[:2]) == []
    with open_recording(writer.path) as recording:
        assert recording.camera.distortion == distortion
        np.testing.assert_array_equal(recording.frame(0).depth, STORED[0])


@pytest.mark.parametrize("packing", ["raw", "png"])
def test_the_reader_of_mcap_itself_reads_what_we_write(tmp_path: Path, packing: Any) -> None:
    path = tmp_path / "r.mcap"
    fill(McapDepthWriter(path, SMALL, packing=packing, metadata={"subject_id": "m01"}))
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()], validate_crcs=True)
        summary = reader.get_summary()
        messages = list(reader.iter_decoded_messages())
        (note,) = list(reader.iter_metadata())
    assert summary is not None
    assert summary.statistics is not None
    assert summary.statistics.message_count == len(messages) == 40 + 2  # a calibration a second
    assert note.metadata == {"subject_id": "m01", "camera_source": "stated"}
    depth = [m for m in messages if m.channel.topic == "/camera/depth"]
    assert [m.message.log_time for m in depth] == even_times(40)
    assert [m.decoded_message.timestamp.ToNanoseconds() for m in depth] == even_times(40)
    lens = next(m.decoded_message for m in messages if m.channel.topic == "/camera/calibration")
    assert list(lens.K) == SMALL.matrix.ravel().tolist()
    assert (lens.width, lens.height, depth[0].decoded_message.frame_id) == (64, 48, lens.frame_id)
    if packing == "raw":
        for message, frame in zip(depth, STORED, strict=True):
            np.testing.assert_array_equal(
                np.frombuffer(message.decoded_message.data, "<u2"), frame.ravel()
            )


@pytest.mark.parametrize("packing", ["raw", "png"])
def test_rosbags_opens_what_we_write(tmp_path: Path, packing: Any) -> None:
    path = tmp_path / "r.mcap"
    fill(McapDepthWriter(path, SMALL, messages="ros", packing=packing))
    with AnyReader([path]) as reader:
        read: dict[str, list[Any]] = {"/camera/depth": [], "/camera/camera_info": []}
        for connection, time_ns, data in reader.messages():
            message: Any = reader.deserialize(data, connection.msgtype)
            stamp = message.header.stamp
            assert stamp.sec * 10**9 + stamp.nanosec == time_ns
            assert message.header.frame_id == "camera"
            read[connection.topic].append(message)
    (lens, _), depth = read["/camera/camera_info"], read["/camera/depth"]
    np.testing.assert_array_equal(lens.k, SMALL.matrix.ravel())
    np.testing.assert_array_equal(lens.p.reshape(3, 4)[:, :3], SMALL.matrix)
    assert (lens.width, lens.height, lens.distortion_model, lens.d.tolist()) == (
        64,
        48,
        "plumb_bob",
        [0.0] * 5,
    )
    if packing == "raw":
        assert {(m.width, m.height, m.step, m.encoding, m.is_bigendian) for m in depth} == {
            (64, 48, 128, "16UC1", 0)
        }
        pictures = [m.data.view("<u2").reshape(48, 64) for m in depth]
    else:
        pictures = [cv2.imdecode(m.data, cv2.IMREAD_UNCHANGED) for m in depth]
    np.testing.assert_array_equal(pictures, STORED)


def test_equal_recordings_are_equal_bytes(tmp_path: Path) -> None:
    for name in "ab":
        fill(McapDepthWriter(tmp_path / name, SMALL))
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


def test_depth_between_millimetres_is_metres_in_32_bits(tmp_path: Path) -> None:
    depths = STORED.copy()
    depths[7:] += np.where(STORED[7:] > 0, np.float32(0.25), np.float32(0.0))
    writer = McapDepthWriter(tmp_path / "r.mcap", SMALL)
    (note,) = fill(writer, depths)
    assert "not in whole millimetres" in note
    np.testing.assert_array_equal(depths_in(writer.path, strict=True), depths)


@given(st.lists(st.floats(0, 70_000, width=32), min_size=1, max_size=20))
def test_metres_are_the_nearest_there_are(values: list[float]) -> None:
    depth = np.array([values], np.float32)
    scaled, n_off = metres(depth)
    again = scaled * np.float32(1000.0)
    assert n_off == np.sum(again != depth)
    off = np.abs(again.astype(float) - depth)
    assert np.all(off <= np.spacing(np.maximum(depth, np.float32(1e-30))))


@given(
    st.lists(st.integers(0, 65535), min_size=1, max_size=20),
    st.sampled_from([1.0, 0.5, 0.25, 0.1, 0.05, 0.01]),
)
def test_whole_steps_are_read_back_exactly(values: list[int], step_mm: float) -> None:
    stored = np.array([values], np.uint16)
    depth = depth_mm(stored, step_mm)
    found = whole_steps(depth, step_mm)
    assert found is not None
    np.testing.assert_array_equal(found, stored)


def test_what_is_between_steps_has_no_whole_ones() -> None:
    depth = np.array([[0.0, 700.0, 700.3]], np.float32)
    assert whole_steps(depth, 1.0) is None
    np.testing.assert_array_equal(nearest_steps(depth, 1.0), [[0, 700, 700]])
    np.testing.assert_array_equal(nearest_steps(depth, 0.1), [[0, 7000, 7003]])
    assert whole_steps(np.array([[70_000.0]], np.float32), 1.0) is None
    assert nearest_steps(np.array([[70_000.0]], np.float32), 1.0) is None


def exact_and_not(folder: Path, depths: NDArray[np.float32], **how: Any) -> list[str]:
    return fill(ImageFolderWriter(folder / "r", SMALL, **how), depths)


def test_pictures_refuse_what_they_do_not_keep_unless_told_to_round(tmp_path: Path) -> None:
    depths = STORED[:3] + np.float32(0.3)
    with pytest.raises(RecordingError, match="between whole steps of 1 mm"):
        exact_and_not(tmp_path, depths)
    (tmp_path / "b").mkdir()
    (note,) = exact_and_not(tmp_path / "b", depths, step_mm=0.5, exact=False)
    assert note == "depth was rounded to whole steps of 0.5 mm"
    np.testing.assert_allclose(depths_in(tmp_path / "b" / "r"), depths, atol=0.25)
    (tmp_path / "c").mkdir()
    with pytest.raises(RecordingError, match="up to 70000 mm"):
        exact_and_not(tmp_path / "c", np.full((1, 48, 64), 70_000, np.float32))
