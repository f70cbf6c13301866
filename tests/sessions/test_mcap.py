"""The MCAP file reads back through the format's own reader, depth exactly."""

import json
from collections import defaultdict

import numpy as np
import pytest
from foxglove import messages as foxglove
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from liex_lab.geometry import so3
from liex_lab.sessions.mcap import _raw_image
from tests.sessions.walking_mouse import WalkingMouse, steady, write

MOUSE = WalkingMouse(steady(2.5), rear_s=(1.0, 2.0), lost=(20,))


@pytest.mark.parametrize("shape", [(1, 1), (7, 9), (8, 8), (90, 91), (424, 512)])
def test_a_raw_image_in_parts_is_the_message_that_foxglove_encodes(shape: tuple[int, int]) -> None:
    image = np.random.default_rng(8).integers(0, 5000, shape).astype(np.uint16)
    height, width = shape
    whole = foxglove.RawImage(
        timestamp=foxglove.Timestamp(sec=12, nsec=345),
        frame_id="camera",
        encoding="16UC1",
        width=width,
        height=height,
        step=2 * width,
        data=image.astype("<u2").tobytes(),
    )
    for told in (image, np.asfortranarray(image), np.repeat(image, 2, axis=1)[:, ::2]):
        assert b"".join(_raw_image(12_000_000_345, told)) == whole.encode()


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    return write(tmp_path_factory.mktemp("mcap") / "circle.liex", MOUSE, problems=["It was dark."])


@pytest.fixture(scope="module")
def messages(session):
    """Topic -> list of (log time, decoded message)."""
    found = defaultdict(list)
    with (session.path / "session.mcap").open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        for schema, channel, message in reader.iter_messages():
            if channel.message_encoding == "json":
                assert schema is not None
                assert schema.encoding == "jsonschema"
                found[channel.topic].append((message.log_time, json.loads(message.data)))
        summary = reader.get_summary()
        assert summary is not None
        topics = {channel.topic for channel in summary.channels.values()} - set(found)
        for _, channel, message, decoded in reader.iter_decoded_messages(topics=sorted(topics)):
            found[channel.topic].append((message.log_time, decoded))
    return found


def test_depth_comes_back_exactly_at_the_recording_s_times(messages):
    depth = messages["/camera/depth"]
    assert [time for time, _ in depth] == MOUSE.times_ns.tolist()
    for row in (0, 33, 74):
        image = depth[row][1]
        assert (image.encoding, image.step, image.frame_id) == ("16UC1", 2 * image.width, "camera")
        assert image.timestamp.seconds * 10**9 + image.timestamp.nanos == MOUSE.times_ns[row]
        pixels = np.frombuffer(image.data, "<u2").reshape(image.height, image.width)
        np.testing.assert_array_equal(pixels, MOUSE.frame(row).depth)


def test_transforms_place_the_camera_and_the_animal_in_the_arena_in_metres(messages):
    placed = defaultdict(list)
    for _, message in messages["/tf"]:
        for transform in message.transforms:
            assert transform.parent_frame_id == "arena"
            placed[transform.child_frame_id].append(transform)
    calibrations = messages["/camera/calibration"]
    assert len(placed["camera"]) == len(calibrations) == 3, "about once a second"
    assert list(calibrations[0][1].K) == MOUSE.camera.matrix.ravel().tolist()
    assert calibrations[0][1].width == MOUSE.camera.width
    assert len(placed["root"]) == 74
    assert placed["camera"][0].translation.z == pytest.approx(0.7)
    track, q = MOUSE.track(), placed["root"][10].rotation
    np.testing.assert_allclose(
        so3.quaternion(track.root_rotation[10]), [q.w, q.x, q.y, q.z], atol=1e-12
    )
    t = placed["root"][10].translation
    np.testing.assert_allclose([t.x, t.y, t.z], track.root_mm[10] / 1000.0)


def test_the_skeleton_is_drawn_in_metres_and_taken_away_when_lost(messages):
    track = MOUSE.track()
    assert len(messages["/skeleton/scene"]) == len(messages["/skeleton/joints"]) == 75
    drawn = messages["/skeleton/scene"][10][1].entities[0]
    assert len(drawn.spheres) == 5
    assert len(drawn.lines[0].points) == 8
    p = messages["/skeleton/joints"][10][1].poses[4].position
    np.testing.assert_allclose([p.x, p.y, p.z], track.joints_mm[10, 4] / 1000.0)
    lost = messages["/skeleton/scene"][20][1]
    assert not lost.entities
    assert lost.deletions[0].id == drawn.id
    assert not messages["/skeleton/joints"][20][1].poses


def test_actions_are_told_on_change_with_word_and_place(messages, session):
    states = messages["/actions"]
    words = [state["action"] for _, state in states]
    assert words == ["walk", "", "walk", "rear", "walk", ""]
    assert [state["index"] for _, state in states] == [3, -1, 3, 0, 3, -1]
    first = int(MOUSE.times_ns[0])
    starts = [round(start * 1e9) + first for start in session.bouts["start_s"]]
    assert [time for time, state in states if state["action"]] == starts
    assert [state["frame_index"] for _, state in states if state["action"]] == list(
        session.bouts["start_frame"]
    )


def test_the_predicted_error_is_that_of_the_table(messages, session):
    frames = session.frames[session.frames["predicted_error_mm"].notna()]
    stated = messages["/predicted_error"]
    assert [time for time, _ in stated] == frames["time_ns"].tolist()
    errors = [error["predicted_error_mm"] for _, error in stated]
    assert errors == frames["predicted_error_mm"].tolist()


def test_the_file_is_whole_and_its_chunks_are_small(session, messages):
    assert [note.message for _, note in messages["/log"]] == ["It was dark."]
    data = (session.path / "session.mcap").read_bytes()
    assert data.endswith(b"\x89MCAP0\r\n")
    with (session.path / "session.mcap").open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    assert all(chunk.compression == "zstd" for chunk in summary.chunk_indexes)
    assert max(chunk.uncompressed_size for chunk in summary.chunk_indexes) < 256 * 1024
