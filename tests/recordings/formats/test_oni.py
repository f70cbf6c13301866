"""PrimeSense recordings (.oni), in every form in which OpenNI's programs have written them."""

import math
import struct
import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from liex_lab.optics.camera import Camera, Lens
from liex_lab.recordings import open_recording
from liex_lab.recordings.depth_kernels import unpack_16z
from tests.oracles.oni import unpack_frame
from tests.recordings.asking import depths_in, exact, facts_in, opened_or_refused, refusal
from tests.recordings.oni_files import (
    COLOUR,
    DEPTH,
    DEVICE,
    INFRARED,
    STEP_US,
    Codec,
    OniBuilder,
    cropping,
    depth_builder,
    mode,
    plain_payload,
)
from tests.recordings.openni2 import play, record
from tests.recordings.writers import SMALL, depth_frames, write_camera, write_oni_file

CODECS: tuple[Codec, ...] = ("16zT", "16zP", "NONE")
STORED = depth_frames(9)
ITSELF = np.arange(1 << 16, dtype=np.float32)  # what a stored number means, where it means itself


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """Where to write the recording."""
    return tmp_path / "r.oni"


def payloads(codec: str, frames: np.ndarray = STORED) -> list[bytes]:
    return [plain_payload(frame, codec) for frame in frames]


# the code


@given(
    seed=st.integers(0, 2**32),
    n=st.integers(1, 300),
    spread=st.sampled_from([0, 1, 3, 7, 40, 66, 30_000]),
)
@pytest.mark.parametrize("codec", ["16zT", "16zP"])
def test_packing_is_undone_and_read_alike_by_the_slow_twin(
    codec: str, seed: int, n: int, spread: int
) -> None:
    rng = np.random.default_rng(seed)
    changes = rng.integers(-spread, spread + 1, n) * (rng.random(n) < rng.random())
    pixels = np.clip(np.cumsum(changes) + rng.integers(0, 0x8000), 0, 0x7FFF).astype(np.uint16)
    packed = plain_payload(pixels, codec)
    assert unpack_frame(packed, codec) == pixels.tolist()
    unpacked = unpack_16z(np.frombuffer(packed, np.uint8), ITSELF, n, codec == "16zT")
    np.testing.assert_array_equal(unpacked, pixels)


@given(payload=st.binary(max_size=60), n=st.integers(1, 200))
@pytest.mark.parametrize("codec", ["16zT", "16zP"])
def test_any_bytes_are_read_as_the_slow_twin_reads_them_or_not_at_all(
    codec: str, payload: bytes, n: int
) -> None:
    if codec == "16zT":
        payload = struct.pack("<HHHH", 3, 500, 700, 900) + payload
    try:
        expected = unpack_frame(payload, codec)
    except IndexError:
        expected = []
    for n_pixels in {n, max(1, len(expected))}:
        unpacked = unpack_16z(np.frombuffer(payload, np.uint8), ITSELF, n_pixels, codec == "16zT")
        assert (unpacked is not None) == (n_pixels == len(expected))
        assert unpacked is None or unpacked.tolist() == expected


# the file


@pytest.mark.parametrize("codec", CODECS)
@pytest.mark.parametrize("table", [False, True])
@pytest.mark.parametrize(
    ("old", "record"), [(False, 0x0D), (True, 0x0D), (True, 0x0C), (True, 0x02)]
)
def test_files_of_every_version_are_read(
    path: Path, codec: str, old: bool, record: int, table: bool
) -> None:
    depth_builder(payloads(codec), codec, old=old, record=record, table=table).write(path)
    with open_recording(path, strict=True) as recording:
        assert (recording.name, recording.format, recording.problems) == ("r", "oni", [])
        assert recording.times_ns.tolist() == [k * STEP_US * 1000 for k in range(9)]
        np.testing.assert_array_equal([frame.depth for frame in recording[2:7:2]], STORED[2:7:2])
    exact(path, STORED)


def test_the_depth_node_is_chosen_by_its_kind_and_not_by_its_name(path: Path) -> None:
    made = OniBuilder()
    made.node(1, "Device", DEVICE, "NONE")
    made.node(2, "Depth", COLOUR, "JPEG")
    made.node(3, "IR", INFRARED, "NONE")
    made.node(4, "Image1", DEPTH, "16zP")
    for node in (2, 3, 4):
        made.depth_properties(node, 64, 48)
        made.begin(node)
    for k, payload in enumerate(payloads("16zP")):
        made.frame(2, 1000 * k, b"an image")
        made.frame(4, 1000 * k, payload)
        made.frame(3, 1000 * k, bytes(6144))
    made.write(path)
    assert exact(path, STORED, strict=True).problems == []


def test_of_two_depth_cameras_the_first_with_frames_is_read_and_it_is_told(path: Path) -> None:
    made = OniBuilder()
    for node, name in ((1, "Depth"), (2, "Depth1"), (3, "Depth2")):
        made.node(node, name, DEPTH, "NONE")
        made.depth_properties(node, 64, 48)
        made.begin(node)
    for k in range(9):
        made.frame(3, 1000 * k, bytes(6144))
        made.frame(2, 1000 * k, STORED[k].tobytes())
    made.write(path)
    assert exact(path, STORED).problems == [
        "r.oni holds frames of 2 depth cameras; those of the first, Depth1, are read"
    ]


# the camera


def lens_file(
    path: Path,
    *,
    fov: tuple[float, float] | None = None,
    size: tuple[int, int] = (64, 48),
    **more: bytes,
) -> Path:
    made = OniBuilder()
    made.node(1, "Depth", DEPTH, "NONE")
    made.depth_properties(1, *size, fov)
    made.properties(1, **more)
    made.begin(1)
    made.frame(1, 0, np.full(size[0] * size[1], 700, np.uint16).tobytes())
    return made.write(path)


def test_intrinsics_come_from_the_field_of_view(path: Path) -> None:
    with open_recording(lens_file(path, fov=(1.0, 0.8))) as recording:
        camera = recording.camera
        assert (camera.cx, camera.cy, camera.width, camera.height) == (32, 24, 64, 48)
        assert camera.source == "field of view in the .oni file (xnFOV)"
        # the angle between the image's edges, seen from the lens
        assert 2 * math.atan(32 / camera.fx) == pytest.approx(1.0)
        assert 2 * math.atan(24 / camera.fy) == pytest.approx(0.8)


@pytest.mark.parametrize(
    ("width", "stated"),
    [
        (640, {"xnRealWorldTranslationData": struct.pack("<ddd", 120.0, 0.1052, 2.0)}),
        (320, {"ZPD": struct.pack("<Q", 120), "ZPPS": struct.pack("<d", 0.1052)}),
    ],
)
def test_intrinsics_of_old_files_come_from_the_lens_itself(
    path: Path, width: int, stated: dict[str, Any]
) -> None:
    with open_recording(lens_file(path, size=(width, width * 3 // 4), **stated)) as recording:
        camera = recording.camera
        assert camera.fx == camera.fy == pytest.approx(570.342 * width / 640, abs=1e-3)
        assert next(iter(stated)) in camera.source
        assert recording.problems == []


def test_where_nothing_is_stated_a_typical_camera_is_taken_and_it_is_told(path: Path) -> None:
    assert "camera.toml" in refusal(lens_file(path))  # 64 x 48 is no size that such a camera has
    with open_recording(lens_file(path, size=(320, 240))) as recording:
        assert recording.camera == Camera(
            285.171, 285.171, 160, 120, 320, 240, source="typical PrimeSense"
        )
        assert "typical PrimeSense" in recording.problems[0]


@pytest.mark.parametrize(
    "fov", [(0.0, 0.8), (float("nan"), 0.8), (1.0, 9.0), (1e-9, 1e-9), (3.1, 3.1), (0.2, 1.5)]
)
def test_a_field_of_view_that_cannot_be_is_not_taken(path: Path, fov: tuple[float, float]) -> None:
    assert "camera.toml" in refusal(lens_file(path, fov=fov))
    assert facts_in(path, camera=SMALL).camera == SMALL


def test_a_stated_camera_and_a_camera_toml_come_before_the_file(path: Path) -> None:
    lens_file(path, fov=(1.0, 0.8))
    write_camera(path.parent)
    with open_recording(path) as recording:
        assert (recording.camera.fx, recording.camera.source) == (SMALL.fx, "camera.toml")
    assert facts_in(path, camera=Lens(50, 51, 31, 23)).camera == Camera(50, 51, 31, 23, 64, 48)
    assert "64 x 48" in refusal(path, camera=Camera(500, 500, 320, 240, 640, 480))


# how the camera looked


def looks_file(
    path: Path, frames: list[tuple[dict[str, bytes], dict[str, int], np.ndarray]], width: int = 64
) -> Path:
    """Frames, and the properties that change before each."""
    made = OniBuilder()
    made.node(1, "Depth", DEPTH, "16zT", len(frames))
    made.depth_properties(1, width, 48)
    made.begin(1)
    for k, (properties, integers, frame) in enumerate(frames):
        made.properties(1, **properties)
        made.integers(1, **integers)
        made.frame(1, k * STEP_US, plain_payload(frame, "16zT"))
    return made.write(path)


def test_a_mirror_image_is_put_right(path: Path) -> None:
    looks_file(path, [({}, {"xnMirror": 1}, frame) for frame in STORED])
    exact(path, STORED[:, :, ::-1])
    with open_recording(path) as recording:
        assert recording.frame(0).depth.flags.c_contiguous
        # column 32, on the axis, has become column 31
        assert (recording.camera.cx, recording.camera.cy) == (31, 24)
        assert "mirror" in recording.problems[0]


def test_a_cropped_frame_lies_in_its_place_of_the_whole_picture(path: Path) -> None:
    part = STORED[:, 10:30, 5:45]
    looks_file(path, [({"xnCropping": cropping(5, 10, 40, 20)}, {}, frame) for frame in part])
    expected = np.zeros_like(STORED)
    expected[:, 10:30, 5:45] = part
    recording = exact(path, expected)
    assert (recording.camera.cx, recording.camera.cy) == (32, 24)
    assert recording.problems == [
        "the camera recorded only 40 x 20 pixels at (5, 10) of its 64 x 48; the rest is unread"
    ]


def test_cropping_may_change_and_end(path: Path) -> None:
    looks_file(
        path,
        [
            ({}, {}, STORED[0]),
            ({"xnCropping": cropping(0, 0, 40, 20)}, {}, STORED[1, :20, :40]),
            ({"xnCropping": cropping(60, 0, 40, 20)}, {}, STORED[2, :20, :40]),
            ({"xnCropping": cropping(60, 0, 40, 20, on=0)}, {}, STORED[3]),
        ],
    )
    expected = STORED[:4].copy()
    expected[1, 20:], expected[1, :, 40:], expected[2] = 0, 0, 0
    assert exact(path, expected).problems == [
        "frame 2 is damaged or not of 64 x 48 pixels, and was taken as wholly unread"
    ]


def test_frames_of_another_size_or_unit_are_unread_and_told(path: Path) -> None:
    looks_file(
        path,
        [
            ({"xnMapOutputMode": mode(32, 24)}, {}, STORED[0, :24, :32]),
            *(({"xnMapOutputMode": mode(64, 48)}, {}, frame) for frame in STORED[1:4]),
            ({}, {"oniPixelFormat": 101}, STORED[4]),
        ],
    )
    assert (
        exact(path, np.stack([np.zeros((48, 64)), *STORED[1:4], np.zeros((48, 64))]))
        .problems[0]
        .startswith("2 of 5 frames have another size or unit than 64 x 48")
    )


def test_depth_in_tenths_of_a_millimetre(path: Path) -> None:
    looks_file(path, [({}, {"oniPixelFormat": 101}, frame) for frame in STORED])
    expected = STORED.astype(np.float32) * np.float32(0.1)
    np.testing.assert_array_equal(depths_in(path), expected)


def test_a_camera_toml_may_state_values_that_mean_no_reading(path: Path) -> None:
    depth_builder(payloads("16zT"), "16zT").write(path)
    write_camera(path.parent, unread=[700], unit_mm=2.0)
    expected = np.where(STORED == 700, 0, 2 * STORED.astype(np.float32))
    np.testing.assert_array_equal(depths_in(path), expected)


# time


def test_time_is_the_files_own_to_the_microsecond(path: Path) -> None:
    times = [0, 33_367, 66_734, 166_835, 200_202]
    depth_builder(payloads("NONE")[:5], "NONE", times_us=times).write(path)
    with open_recording(path) as recording:
        assert recording.times_ns.tolist() == [t * 1000 for t in times]
        assert [(gap.start_frame, gap.n_frames_missing) for gap in recording.gaps] == [(3, 2)]


@pytest.mark.parametrize(
    ("wild", "says"), [(3, "out of order"), (2**63, "later than any clock"), (2**64 - 1, "later")]
)
def test_a_stamp_that_cannot_be_is_told_and_does_not_drag_the_others(
    path: Path, wild: int, says: str
) -> None:
    times = [k * STEP_US for k in range(9)]
    depth_builder(payloads("NONE"), "NONE", times_us=[*times[:4], wild, *times[5:]]).write(path)
    with open_recording(path) as recording:
        assert np.delete(recording.times_ns, 4).tolist() == [
            t * 1000 for t in np.delete(times, 4).tolist()
        ]
        assert len(recording.problems) == 1
        assert "1 of 9" in recording.problems[0]
        assert says in recording.problems[0]


def test_damaged_stamps_at_both_ends(path: Path) -> None:
    wild, times = 2**64 - 1, [k * STEP_US for k in range(9)]
    depth_builder(payloads("NONE"), "NONE", times_us=[wild, *times[1:7], wild, wild]).write(path)
    with open_recording(path) as recording:
        assert recording.times_ns[1:7].tolist() == [t * 1000 for t in times[1:7]]
        assert recording.times_ns[0] < recording.times_ns[1]
        assert recording.times_ns[-1] == recording.times_ns[6] + 2


def test_a_clock_that_stood_still_gives_way_to_a_rate(path: Path) -> None:
    depth_builder(payloads("NONE"), "NONE", times_us=[5] * 9).write(path)
    with open_recording(path) as recording:
        assert recording.rate_hz == pytest.approx(30)
        assert "30 frames/s was assumed" in recording.problems[0]
    assert facts_in(path, fps=60).rate_hz == pytest.approx(60)


# what cannot be read


def test_a_file_that_was_never_closed_gives_its_frames(path: Path) -> None:
    depth_builder(payloads("16zT"), "16zT", closed=False).write(path, closed=False)
    recording = exact(path, STORED)
    assert (recording.truncated, recording.n_whole) == (True, 9)
    assert "9 whole frames" in refusal(path, strict=True)


def test_more_frames_promised_than_there_are(path: Path) -> None:
    made = depth_builder(payloads("16zT"), "16zT")
    at = made.content.index(b"16zT") + 4
    made.content = made.content[:at] + struct.pack("<I", 2**31) + made.content[at + 4 :]
    made.write(path)
    with open_recording(path) as recording:
        assert (len(recording), recording.truncated) == (9, True)
        assert recording.problems[0] == "r.oni promises 2147483648 frames of Depth, and 9 are in it"
    assert "cut short or damaged" in refusal(path, strict=True)


@pytest.mark.parametrize(
    ("size", "says"),
    [
        ((2**31, 2**31), f"{2**31} x {2**31}"),
        ((0, 48), "0 x 48"),
        ((2**32 - 1, 1), f"{2**32 - 1} x 1"),
        ((64, 49), "64 x 49 pixels, but its frames do not unpack to that"),
    ],
)
def test_a_size_that_no_camera_or_frame_has_is_refused(
    path: Path, size: tuple[int, int], says: str
) -> None:
    assert says in refusal(depth_builder(payloads("16zT"), "16zT", *size).write(path))


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ((b"16zT", b"JPEG"), "the code 'JPEG'"),
        ((b"xnMapOutputMode", b"xnMapOutputXxxx"), "does not state the size"),
        ((b"NI10", b"NI20"), "something else"),
        ((b"NI10\1\0\1\0", b"NI10\1\0\2\0"), "states version 1.0.2.0"),
        ((b"NI10\1\0\1\0\0", b"NI10\1\0\0\0\3"), "states version 1.0.0.3"),
        (
            (struct.pack("<i", DEPTH) + b"16zT", struct.pack("<i", COLOUR) + b"16zT"),
            "its nodes are Depth",
        ),
    ],
)
def test_what_cannot_be_read_is_told_in_a_sentence(
    path: Path, change: tuple[bytes, bytes], says: str
) -> None:
    made = depth_builder(payloads("16zT"), "16zT")
    assert change[0] in made.content
    made.content = made.content.replace(*change)
    assert says in refusal(made.write(path))


def test_what_holds_no_depth_is_refused_in_a_sentence(path: Path) -> None:
    for content in (b"", b"NI10", b"NI10" + bytes(20), b"hello" * 20):
        path.write_bytes(content)
        assert "r.oni" in refusal(path)
    assert "no depth frames" in refusal(depth_builder([], "16zT").write(path))
    for unit, why in ((102, "raw shifts"), (7, "the unit 7")):
        assert why in refusal(looks_file(path, [({}, {"oniPixelFormat": unit}, STORED[0])]))


# What damage to one frame of an .oni file costs, and files made to take memory; 200 variants are
# in test_damage.py.


ONI_DAMAGE_STORED = depth_frames(12, 32, 24)


@pytest.mark.parametrize("codec", CODECS)
def test_a_damaged_frame_costs_only_itself(tmp_path: Path, codec: str) -> None:
    made = depth_builder(
        [plain_payload(frame, codec) for frame in ONI_DAMAGE_STORED], codec, 32, 24, table=True
    )
    made.record(0x0B)
    path = tmp_path / "r.oni"
    head = made.frames[1][5][1]
    for field, value in [(0, 7), (4, 0x1A), (12, 2**20), (16, 2**31), (16, 3), (16, 2**16)]:
        content = (
            made.content[: head + field]
            + struct.pack("<I", value)
            + made.content[head + field + 4 :]
        )
        path.write_bytes(content)
        recording, sentence = opened_or_refused(path)
        assert recording is not None, sentence
        with recording:
            depths = [frame.depth for frame in recording]
            expected = ONI_DAMAGE_STORED.astype(np.float32)
            if len(depths) == len(ONI_DAMAGE_STORED) - 1:
                assert recording.truncated
                expected = np.delete(expected, 5, axis=0)
            elif field == 16 and value == 3:
                expected[5] = 0  # too short to be a frame
            np.testing.assert_array_equal(depths, expected)
            assert recording.problems


def test_records_without_end_take_no_memory(tmp_path: Path) -> None:
    made = depth_builder([], "16zP", 32, 24)
    frame = struct.pack("<IIIIIQQI", 0x0052494E, 0x0A, 1, 40, 2, 0, 0, 1) + b"\0\0"
    changes = b""
    for width in range(1, 500):
        one = OniBuilder()
        one.properties(1, xnMapOutputMode=mode(width, 24))
        changes += one.content[24:] + frame
    path = tmp_path / "r.oni"
    path.write_bytes(made.content + changes + 5_000 * frame)
    tracemalloc.start()
    try:
        recording, sentence = opened_or_refused(path)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert recording is None
    assert "r.oni" in sentence
    assert peak < 4 * path.stat().st_size + 30e6


# libOpenNI2 reads what we write, and we read what it writes, bit by bit.


QVGA = Camera(285.0, 287.0, 159.5, 119.5, 320, 240)


def noisy_frames(n: int = 6, seed: int = 0) -> np.ndarray:
    """(n, 240, 320) uint16: like a camera's, and one of plain noise; the last pixels of each
    change.
    """
    frames = depth_frames(n, 320, 240, seed)
    frames[1] = np.random.default_rng(seed).integers(0, 10_000, (240, 320))
    frames[2, -1, -40:] = frames[2, -1, -41] + 1
    return frames


@pytest.mark.parametrize(
    ("codec", "old", "table"),
    [("16zT", False, True), ("16zP", True, True), ("NONE", True, False)],
)
def test_openni2_and_we_read_the_same_from_files_of_any_version(
    tmp_path: Path, codec: str, old: bool, table: bool
) -> None:
    payloads = [plain_payload(frame, codec) for frame in depth_frames(3)]
    path = depth_builder(payloads, codec, old=old, table=table).write(tmp_path / "r.oni")
    played = play(path)
    with open_recording(path) as recording:
        np.testing.assert_array_equal([frame.depth for frame in recording], played.frames)
        assert recording.times_ns.tolist() == (played.times_us * 1000).tolist()
        fov = (2 * np.arctan(32 / recording.camera.fx), 2 * np.arctan(24 / recording.camera.fy))
        assert played.fov == pytest.approx(fov, abs=1e-6)


def test_we_read_what_openni2_records_of_its_dummy_device(tmp_path: Path) -> None:
    handed_out = record("Dummy", tmp_path / "r.oni", 5)
    with open_recording(tmp_path / "r.oni", strict=True) as recording:
        # the recorder may begin a frame late and end one later
        seen = [frame.tobytes() for frame in handed_out.frames]
        ours = [frame.depth.astype(np.uint16).tobytes() for frame in recording]
        first = seen.index(ours[0])
        shared = min(len(seen) - first, len(ours))
        assert shared >= 4
        assert ours[:shared] == seen[first : first + shared]
        assert set(np.diff(recording.times_ns).tolist()) == {33_000_000}
        # the device has no optics
        assert recording.camera.source == "typical PrimeSense"


@pytest.mark.parametrize("seed", [1, pytest.param(2, marks=pytest.mark.nightly)])
def test_we_read_what_openni2_packs_as_it_reads_it_itself(tmp_path: Path, seed: int) -> None:
    source = write_oni_file(tmp_path / "source.oni", noisy_frames(6, seed), QVGA, codec="NONE")
    handed_out = record(source, tmp_path / "r.oni", 6)
    np.testing.assert_array_equal(handed_out.frames, noisy_frames(6, seed))
    played = play(tmp_path / "r.oni")
    with open_recording(tmp_path / "r.oni", strict=True) as recording:
        assert recording.problems == []
        ours = np.stack([frame.depth for frame in recording])
        assert recording.camera.source == "field of view in the .oni file (xnFOV)"
        assert [recording.camera.fx, recording.camera.fy] == pytest.approx(
            [QVGA.fx, QVGA.fy], rel=1e-6
        )
    np.testing.assert_array_equal(ours, played.frames)
    # its encoder changes some of the last pixels of a frame, and only those
    np.testing.assert_array_equal(ours[:, :-1], handed_out.frames[:, :-1])
