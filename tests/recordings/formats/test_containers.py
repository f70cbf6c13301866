"""What containers of messages state, compared by value: the calibration of another lens, parts and
bins of an image, the RealSense programs' text, packed messages, units, and orders of recording.
"""

import base64
import json
import sqlite3
import struct
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import lz4.frame
import numpy as np
import pytest
import zstandard
from mcap.writer import CompressionType
from numpy.typing import NDArray

from liex_lab.optics.camera import Camera, Lens
from liex_lab.recordings import Recording, open_recording
from liex_lab.recordings.formats.messages.mcap import McapFile
from tests.recordings.asking import depths_in, facts_in, refusal
from tests.recordings.ros_writers import (
    Info,
    realsense_messages,
    serialised,
    store,
    write_bag,
    write_db3,
    write_messages,
    write_ros_mcap,
)
from tests.recordings.writers import (
    START_NS,
    STEP_NS,
    depth_frames,
    even_times,
    write_camera,
    write_moseq_folder,
    write_png_folder,
)

QVGA = Camera(287.9, 287.9, 159.5, 119.5, 320, 240)
WIDE = Camera(575.8, 575.8, 319.5, 239.5, 640, 480)  # of which QVGA sees every second pixel
WHOLE = Camera(287.9, 287.9, 319.5, 239.5, 640, 480)  # of which QVGA is the middle
STORED = depth_frames(8, 320, 240)
TIMES = even_times(len(STORED))
Writer = Callable[..., Path]
WRITERS: dict[str, Writer] = {
    "mcap": lambda folder, **how: write_ros_mcap(folder / "r.mcap", STORED, **how),
    "bag": lambda folder, **how: write_bag(folder / "r.bag", STORED, **how),
    "db3": lambda folder, **how: write_db3(folder / "r", STORED, **how),
}


# what is calibrated and where is decided after the containers are read
_OTHERS = [pytest.param(name, marks=pytest.mark.nightly) for name in ("bag", "db3")]


@pytest.fixture(params=["mcap", *_OTHERS])
def write(request: pytest.FixtureRequest, tmp_path: Path) -> Writer:
    def written(**how: Any) -> Path:
        return WRITERS[request.param](tmp_path, **{"camera": QVGA, **how})

    return written


def numbers(lens: Lens) -> tuple[float, ...]:
    return (lens.fx, lens.fy, lens.cx, lens.cy)


def exact(path: Path, step_mm: float = 1.0, **how: Any) -> Recording:
    """A recording whose times are right within 1 us and depths to the last step, closed again."""
    with open_recording(path, **how) as recording:
        assert np.abs(recording.times_ns - np.array(TIMES)).max() <= 1000
        for frame, stored in zip(recording, STORED, strict=True):
            expected = stored.astype(np.float32) * np.float32(step_mm)
            np.testing.assert_array_equal(frame.depth, expected)
        return recording


def copy_to_mcap(path: Path, db3: Path) -> Path:
    """The messages of a ROS 2 bag as an MCAP file in small chunks, as converters write it."""
    base = sqlite3.connect(next(db3.glob("*.db3")))
    rows = base.execute(
        "SELECT name, type, timestamp, data FROM messages, topics WHERE topics.id = topic_id "
        "ORDER BY messages.id"
    )
    messages = ((topic, kind, "cdr", log_ns, log_ns, data) for topic, kind, log_ns, data in rows)
    return write_messages(path, messages, chunk_size=64 * 1024, compression=CompressionType.ZSTD)


# what the RealSense programs state


@pytest.mark.parametrize(
    ("unit", "stated_by", "kind", "container"),
    [
        *[
            (unit, by, "mono16", "db3")
            for unit in ("0.001000", "0.000500", "0.000250", "0.000100")
            for by in ("option", "metadata", "both")
        ],
        *[
            ("0.000500", "both", kind, container)
            for kind in ("mono16", "png")
            for container in ("packed db3", "mcap", "mcap by index")
        ],
        ("0.000250", "both", "png", "db3"),
    ],
)
def test_a_realsense_recording_needs_no_file_of_ones_own(
    tmp_path: Path, unit: str, stated_by: str, kind: str, container: str
) -> None:
    rng = np.random.default_rng(3)
    late = [(k + 1) * STEP_NS + int(rng.integers(0, 14_000_000)) for k in range(len(STORED))]
    messages = realsense_messages(
        STORED,
        QVGA,
        TIMES,
        option_m=None if stated_by == "metadata" else unit,
        metadata_m=None if stated_by == "option" else unit,
        arrival_ns=late,
        kind=kind,
    )
    path = write_db3(tmp_path / "r", STORED, messages=messages, packed=container == "packed db3")
    if container.startswith("mcap"):
        path = copy_to_mcap(tmp_path / "r.mcap", path)
    recording = exact(path, float(unit) * 1000, strict=container == "mcap by index")
    assert numbers(recording.camera) == numbers(QVGA)
    assert recording.camera.distortion is None
    assert recording.problems == []
    assert recording.metadata["session_start_time"].startswith("2025-10-09")


def test_a_hardware_clock_starts_when_the_computer_says(tmp_path: Path) -> None:
    uptime = [360 * 10**9 + k * STEP_NS for k in range(len(STORED))]
    path = write_db3(tmp_path / "r", STORED, messages=realsense_messages(STORED, QVGA, uptime))
    with open_recording(path) as recording:
        np.testing.assert_array_equal(recording.times_ns, uptime)
        assert recording.metadata["session_start_time"] == "2025-10-09T08:53:20.123456+00:00"


def test_frames_without_metadata_have_their_time_of_arrival_and_that_is_said(
    tmp_path: Path,
) -> None:
    messages = realsense_messages(STORED, QVGA, TIMES, without_metadata=(2, 5))
    problems = exact(write_db3(tmp_path / "r", STORED, messages=messages), 0.5).problems
    assert any("2 of 8 depth images have no metadata" in problem for problem in problems)


def test_units_that_disagree_are_doubted_until_one_is_stated(tmp_path: Path) -> None:
    messages = realsense_messages(STORED, QVGA, TIMES, option_m="0.001000", metadata_m="0.000250")
    path = write_db3(tmp_path / "r", STORED, messages=messages)
    assert "depth units of 0.25 and 1 mm" in exact(path, 0.25).doubts[0]
    (tmp_path / "r" / "camera.toml").write_text("[camera]\nunit_mm = 1.0\n")
    assert exact(path, 1.0).doubts == []


def test_a_unit_that_nothing_states_is_said_to_be_assumed(tmp_path: Path) -> None:
    messages = realsense_messages(STORED, QVGA, TIMES, option_m=None, metadata_m=None)
    path = write_db3(tmp_path / "r", STORED, messages=messages)
    assert "states no depth unit" in facts_in(path).problems[0]
    (tmp_path / "r" / "camera.toml").write_text("[camera]\nunit_mm = 0.5\n")
    exact(path, 0.5)


def test_a_copied_unit_of_one_does_not_change_what_the_recording_states(tmp_path: Path) -> None:
    """Such a camera.toml beside a recording with its unit was read rightly before, too."""
    path = write_db3(tmp_path / "r", STORED, messages=realsense_messages(STORED, QVGA, TIMES))
    write_camera(tmp_path / "r", QVGA, unit_mm=1.0)
    problems = exact(path, 0.5).problems
    assert any("unit_mm = 1 in camera.toml is not used" in problem for problem in problems)


# calibrations


def zeros(at: int = 0, **more: Any) -> Info:
    return Info(None, at=at, **more)


@pytest.mark.parametrize("strict", [False, True])
@pytest.mark.parametrize(
    "first",
    [
        zeros(),
        zeros(size=(320, 240)),
        Info(WIDE),
        Info(replace(QVGA, fx=300.0, width=160, height=120)),
    ],
    ids=["zero", "zero with a size", "of another size", "of another size and lens"],
)
def test_right_calibrations_after_a_wrong_one_are_used(
    write: Writer, first: Info, strict: bool
) -> None:
    later = [Info(QVGA, at=k) for k in range(1, len(STORED))]
    recording = exact(write(infos=[first, *later]), strict=strict)
    assert numbers(recording.camera) == numbers(QVGA)
    assert recording.doubts == []


def test_calibrations_without_numbers_are_called_so(write: Writer) -> None:
    path = write(infos=[zeros(at=k) for k in range(4)])
    assert "/camera/depth/camera_info, which are empty (uncalibrated" in refusal(path)


def test_two_calibrations_of_nothing_are_named(write: Writer) -> None:
    infos = [
        Info(QVGA, "/left/camera_info", "left"),
        Info(replace(QVGA, fx=300.0), "/right/camera_info", "right"),
    ]
    assert "calibrations on /left/camera_info, /right/camera_info" in refusal(write(infos=infos))


@pytest.mark.parametrize("strict", [False, True])
@pytest.mark.parametrize(
    ("change", "doubted"),
    [({"fx": 330.0, "fy": 330.0}, True), ({"cx": 170.0}, True), ({"fx": 288.0}, False)],
)
def test_a_calibration_that_changes_is_doubted(
    write: Writer, change: dict[str, Any], doubted: bool, strict: bool
) -> None:
    """Also where the file is opened by its index."""
    later = replace(QVGA, **change)
    infos = [Info(QVGA if k < 4 else later, at=k) for k in range(len(STORED))]
    with open_recording(write(infos=infos), strict=strict) as recording:
        assert numbers(recording.camera) == numbers(QVGA)
        said = recording.doubts if doubted else recording.problems
        assert "changes 0.13 s after its first" in said[0]
        assert bool(recording.doubts) == doubted


COLOUR = "camera_color_optical_frame"
DEPTH = "camera_depth_optical_frame"
RAW = "/camera/depth/image_raw"


@pytest.mark.parametrize(
    ("topic", "frame_id", "info", "doubted"),
    [
        (RAW, DEPTH, ("/camera/color/camera_info", COLOUR), True),
        (RAW, "", ("/camera/color/camera_info", ""), True),
        (RAW, DEPTH, ("/camera/color/camera_info", ""), True),
        ("/cam0/depth", "", ("/cam1/camera_info", ""), True),
        (RAW, DEPTH, ("/camera/depth/camera_info", DEPTH), False),
        (RAW, "/" + DEPTH, ("/camera/depth/camera_info", DEPTH), False),
        (RAW, "", ("/camera/depth/camera_info", ""), False),
        (RAW, "", ("/camera/camera_info", ""), False),
        (RAW, "", ("/calibration", ""), False),
        ("/camera/depth_registered/image_raw", COLOUR, ("/camera/rgb/camera_info", COLOUR), False),
        (
            "/camera/aligned_depth_to_color/image_raw",
            COLOUR,
            ("/camera/color/camera_info", COLOUR),
            False,
        ),
    ],
)
def test_the_calibration_of_another_lens_is_doubted(
    write: Writer, topic: str, frame_id: str, info: tuple[str, str], doubted: bool
) -> None:
    path = write(topics=(topic,), frame_id=frame_id, infos=[Info(QVGA, *info)])
    doubts = [doubt[:40] for doubt in exact(path).doubts]
    assert doubts == ["the calibration is that of another lens "] * doubted
    assert facts_in(path, camera=Lens(280.0, 280.0, 159.0, 119.0)).doubts == []


@pytest.mark.parametrize(
    "info",
    [
        Info(WIDE, binning=(2, 2)),
        Info(WHOLE, roi=(160, 120, 320, 240)),
        Info(WHOLE, roi=(160, 120, 320, 240), binning=(1, 1)),
        Info(WHOLE, size=(320, 240), roi=(160, 120, 320, 240)),
        Info(WIDE, size=(320, 240), binning=(2, 2)),
        Info(replace(WHOLE, cx=159.5, cy=119.5), roi=(160, 120, 320, 240)),
        Info(QVGA, binning=(2, 2)),
        Info(QVGA, roi=(0, 0, 320, 240)),
        Info(
            Camera(575.8, 575.8, 639.5, 479.5, 1280, 960), roi=(320, 240, 640, 480), binning=(2, 2)
        ),
    ],
    ids=[
        "binned",
        "part",
        "part, binning 1",
        "part with the size of the part",
        "binned with the size of the bins",
        "part with the intrinsics of the part",
        "binned with the intrinsics of the bins",
        "whole as a part",
        "binned part",
    ],
)
@pytest.mark.parametrize("topic", [RAW, "/camera/depth/image_rect_raw"])
def test_parts_and_bins_of_a_picture_are_mapped(write: Writer, info: Info, topic: str) -> None:
    distortion = (0.1, -0.05, 0.001, 0.002, 0.0)
    path = write(topics=(topic,), frame_id="", infos=[info], distortion=distortion)
    recording = exact(path)
    assert numbers(recording.camera) == pytest.approx(numbers(QVGA))
    assert (recording.camera.distortion is None) == ("rect" in topic)
    assert recording.doubts == []


# units


@pytest.mark.parametrize(
    ("scale", "unit_mm"), [(1.0, 1.0), (0.1, 10.0), (0.001, 1000.0), (0.001, 1.0), (0.001, None)]
)
def test_floats_have_the_unit_that_is_stated(
    tmp_path: Path, scale: float, unit_mm: float | None
) -> None:
    """Metres with a copied unit_mm = 1.0 were read rightly before, too."""
    floats = (STORED * np.float32(scale)).astype(np.float32)
    for path in (
        write_ros_mcap(tmp_path / "r.mcap", floats, kind="32FC1", camera=QVGA),
        write_bag(tmp_path / "r.bag", floats, kind="32FC1", camera=QVGA),
        write_db3(tmp_path / "r", floats, kind="32FC1", camera=QVGA),
    ):
        beside = path if path.is_dir() else path.parent
        if unit_mm is not None:
            (beside / "camera.toml").write_text(f"[camera]\nunit_mm = {unit_mm}\n")
        np.testing.assert_allclose(depths_in(path)[1], STORED[1], rtol=1e-6)


def test_a_converted_recording_beside_its_folder_is_not_scaled_twice(tmp_path: Path) -> None:
    from liex_lab.pipelines.convert import convert

    folder = write_png_folder(tmp_path / "r", STORED, QVGA, unit_mm=0.25)
    for name in ("r.mcap", "ros.mcap"):
        convert(folder, folder / name, ros=name == "ros.mcap")
        exact(folder / name, 0.25)


# packed and differently encoded messages


@pytest.mark.parametrize("strict", [False, True])
@pytest.mark.parametrize(
    "pack", [zstandard.ZstdCompressor().compress, lz4.frame.compress], ids=["zstd", "lz4"]
)
def test_messages_that_are_packed_one_by_one_are_read(
    tmp_path: Path, pack: Callable[[bytes], bytes], strict: bool
) -> None:
    path = write_ros_mcap(tmp_path / "r.mcap", STORED, camera=QVGA, pack_message=pack)
    recording = exact(path, strict=strict)
    assert (recording.truncated, recording.problems) == (False, [])


def test_a_message_that_unpacks_to_gigabytes_is_not_unpacked(tmp_path: Path) -> None:
    bomb = zstandard.ZstdCompressor().compressobj()
    zeros_of = b"".join(bomb.compress(bytes(1 << 22)) for _ in range(64)) + bomb.flush()
    path = write_ros_mcap(
        tmp_path / "r.mcap", STORED[:1], camera=QVGA, pack_message=lambda data: zeros_of
    )
    assert "no depth images" in refusal(path)


def test_a_bag_that_is_packed_as_a_whole_names_the_command(tmp_path: Path) -> None:
    folder = write_db3(tmp_path / "r", STORED, camera=QVGA)
    plain = next(folder.glob("*.db3"))
    packed = plain.with_name(plain.name + ".zstd")
    packed.write_bytes(zstandard.ZstdCompressor().compress(plain.read_bytes()))
    content = plain.read_bytes()
    plain.unlink()
    for given in (packed, folder):
        assert "unpack it with `zstd -d`" in refusal(given)
    plain.write_bytes(content)  # which `zstd -d` does, and keeps the packed one
    exact(folder)


def to_second_version(data: bytes, kind: int = 7) -> bytes:
    return bytes([0, kind, 0, 0]) + data[4:]


def test_the_second_version_of_cdr_is_read(tmp_path: Path) -> None:
    """Also from a writer that states it and aligns the numbers of its CameraInfo as before."""
    for topic in ("/camera/depth/image_raw", "/d/image", "/de/image", "/dep/image", "/dept/image"):
        path = write_ros_mcap(
            tmp_path / "r.mcap",
            STORED,
            camera=QVGA,
            topics=(topic,),
            pack_message=to_second_version,
        )
        recording = exact(path)
        assert numbers(recording.camera) == numbers(QVGA)
        assert (recording.truncated, recording.problems) == (False, [])


def test_numbers_of_the_second_version_are_aligned_to_four_bytes(tmp_path: Path) -> None:
    """A CameraInfo of it, written out by hand."""
    from liex_lab.recordings.formats.messages.messages import Calibration, Channel
    from liex_lab.recordings.formats.messages.parsers import parser_of

    def text(value: str) -> bytes:
        return struct.pack("<I", len(value) + 1) + value.encode() + b"\0"

    for model in ("plumb_bob", "plumb_bobs"):
        data = bytes([0, 7, 0, 0]) + struct.pack("<iI", 5, 0) + text("abc")
        data += struct.pack("<II", 240, 320) + text(model)
        data += bytes(-(len(data) - 4) % 4) + struct.pack("<I", 0)
        data += struct.pack("<30d", *range(1, 31)) + struct.pack("<6IB", 1, 1, 0, 0, 0, 0, 0)
        parse = parser_of(Channel("/info", "sensor_msgs/CameraInfo", "cdr"))
        assert parse is not None
        found = parse(memoryview(data))
        assert isinstance(found, Calibration)
        assert found.k == tuple(range(1, 10))
        assert found.p == tuple(range(19, 31))


def test_an_encapsulation_that_is_not_read_is_named(tmp_path: Path) -> None:
    path = write_ros_mcap(
        tmp_path / "r.mcap", STORED, pack_message=lambda data: to_second_version(data, 9)
    )
    said = refusal(path)
    assert "begins with 00 09, which is no plain CDR" in said
    assert "damaged" not in said


def test_a_calibration_that_cannot_be_read_is_named(tmp_path: Path) -> None:
    def only_infos(data: bytes) -> bytes:
        return to_second_version(data, 9) if len(data) < 1000 else data

    path = write_ros_mcap(tmp_path / "r.mcap", STORED, camera=QVGA, pack_message=only_infos)
    said = refusal(path)
    assert (
        "/camera/depth/camera_info: its messages cannot be read: a message begins with 00 09"
        in said
    )
    write_camera(tmp_path, QVGA)
    assert not exact(path).truncated


def test_rows_whose_step_counts_pixels_are_read(tmp_path: Path) -> None:
    pixels = struct.pack("<I", 640)
    path = write_ros_mcap(
        tmp_path / "r.mcap",
        STORED,
        camera=QVGA,
        pack_message=lambda data: data.replace(pixels, struct.pack("<I", 320), 1),
    )
    exact(path)


def test_a_picture_that_lacks_rows_says_what_it_states(tmp_path: Path) -> None:
    short = struct.pack("<I", 600)
    path = write_ros_mcap(
        tmp_path / "r.mcap",
        STORED,
        camera=QVGA,
        pack_message=lambda data: data.replace(struct.pack("<I", 640), short, 1),
    )
    with open_recording(path) as recording:
        assert not recording.frame(0).depth.any()
        assert "320 x 240 pixels in rows of 600 bytes, 153600 bytes in all" in recording.problems[0]


def test_jpeg_is_called_jpeg(tmp_path: Path) -> None:
    types = store(2).types
    header = types["std_msgs/msg/Header"](types["builtin_interfaces/msg/Time"](1, 0), "")
    content = np.frombuffer(b"\xff\xd8\xff\xe0", np.uint8)
    image = types["sensor_msgs/msg/CompressedImage"](header, "16UC1; jpeg compressed ", content)
    written = ("/depth/compressed", image.__msgtype__, "cdr", 5, 5, serialised(2, image))
    assert "JPEG does not keep depth" in refusal(write_messages(tmp_path / "r.mcap", [written]))


def write_json(
    path: Path,
    stamps: dict[int, Any],
    log_ns: Sequence[int] = TIMES,
    sent_ns: Sequence[int] = TIMES,
) -> Path:
    """Foxglove's RawImage and CameraCalibration in JSON."""
    lens = {"frame_id": "", "width": 320, "height": 240, "K": QVGA.matrix.ravel().tolist()}
    written: list[tuple[str, dict[str, Any], int, int]] = [("CameraCalibration", lens, 0, 0)]
    for n, frame in enumerate(STORED):
        data = base64.b64encode(frame.astype("<u2").tobytes()).decode()
        image = {"encoding": "16UC1", "width": 320, "height": 240, "step": 640, "data": data}
        image |= {"timestamp": stamps[n]} if n in stamps else {}
        written.append(("RawImage", image, log_ns[n], sent_ns[n]))
    return write_messages(
        path,
        (
            (f"/depth/{kind}", f"foxglove.{kind}", "json", log, sent, json.dumps(content).encode())
            for kind, content, log, sent in written
        ),
        chunk_size=1 << 20,
    )


def test_dates_in_json_are_stamps(tmp_path: Path) -> None:
    from google.protobuf.timestamp_pb2 import Timestamp

    stamps = {}
    for n, ns in enumerate(TIMES):
        stamp = Timestamp()
        stamp.FromNanoseconds(ns)
        stamps[n] = stamp.ToJsonString()
    stamps[1] = stamps[1].replace("Z", "+00:00")
    late = [ns + 5_000_000 * (n % 3) for n, ns in enumerate(TIMES)]
    recording = exact(write_json(tmp_path / "r.mcap", stamps, log_ns=late))
    assert (recording.truncated, recording.problems) == (False, [])


# clocks and orders


@pytest.mark.parametrize("strict", [False, True])
def test_pictures_without_stamps_have_the_times_of_sending_where_logging_is_bursty(
    tmp_path: Path, strict: bool
) -> None:
    bursts = [START_NS + (k // 4 * 4 + 4) * STEP_NS + k for k in range(len(STORED))]
    ros = write_ros_mcap(
        tmp_path / "r.mcap", STORED, camera=QVGA, stamped=False, log_ns=bursts, sent_ns=TIMES
    )
    for path in (ros, write_json(tmp_path / "j.mcap", {}, log_ns=bursts)):
        assert "so the times of sending are used" in exact(path, strict=strict).problems[0]
    steady = write_json(tmp_path / "j.mcap", {}, sent_ns=bursts)
    assert "so the times of logging are used" in exact(steady, strict=strict).problems[0]


MANY = depth_frames(60)
MANY_TIMES = even_times(60)


def in_wrong_order(pairs: Sequence[int]) -> tuple[NDArray[Any], list[int]]:
    order = np.arange(60)
    for k in pairs:
        order[[k, k + 1]] = order[[k + 1, k]]
    return MANY[order], [MANY_TIMES[k] for k in order]


@pytest.mark.parametrize("strict", [False, True])
@pytest.mark.parametrize("container", ["mcap", "bag", "db3"])
def test_pictures_recorded_in_the_wrong_order_are_sorted(
    tmp_path: Path, container: str, strict: bool
) -> None:
    frames, times = in_wrong_order([10, 20, 30, 40])
    how: dict[str, Any] = {"times_ns": times, "log_ns": [ns + 10**6 for ns in MANY_TIMES]}
    path = {
        "mcap": lambda: write_ros_mcap(tmp_path / "r.mcap", frames, **how),
        "bag": lambda: write_bag(tmp_path / "r.bag", frames, **how),
        "db3": lambda: write_db3(tmp_path / "r", frames, **how),
    }[container]()
    with open_recording(path, strict=strict) as recording:
        assert recording.times_ns.tolist() == MANY_TIMES
        assert (recording.gaps, recording.faults) == ([], [])
        assert "4 pairs were recorded in the wrong order" in recording.problems[0]
        for _ in range(2):
            np.testing.assert_array_equal([frame.depth for frame in recording], MANY)
        part = recording[9:42:2]
        np.testing.assert_array_equal([frame.depth for frame in part], MANY[9:42:2])


def test_rows_that_were_handed_out_stay_while_a_recording_grows(tmp_path: Path) -> None:
    frames, times = in_wrong_order([10, 29, 40])
    path = write_ros_mcap(tmp_path / "r.mcap", frames, times_ns=times, log_ns=MANY_TIMES)
    content = path.read_bytes()
    file = McapFile(path, path.open("rb"))
    list(file.walk(lambda channel: True, lambda *said: None))
    starts = file.starts
    file.close()
    path.write_bytes(content[: starts[len(starts) // 2]])
    recording = open_recording(path)
    before = [frame.depth.copy() for frame in recording]
    assert 15 < len(before) < 40
    path.write_bytes(content)
    more = recording.grown()
    assert more is not None
    assert len(more) == 60
    np.testing.assert_array_equal([frame.depth for frame in more][: len(before)], before)
    np.testing.assert_array_equal(more.frame(40).depth, MANY[40])
    more.close()


@pytest.mark.parametrize("kind", ["images", "moseq"])
def test_other_recordings_with_a_stamp_for_each_picture_are_sorted_too(
    tmp_path: Path, kind: str
) -> None:
    frames, times = in_wrong_order([10, 20, 30, 40])
    if kind == "images":
        path = write_png_folder(tmp_path / "r", frames, times_ns=times)
    else:
        path = write_moseq_folder(tmp_path / "r", frames, [ns / 1e6 for ns in times])
        write_camera(path)
    with open_recording(path) as recording:
        assert np.abs(recording.times_ns - np.array(MANY_TIMES)).max() <= 1000
        assert any("4 pairs" in said for said in recording.problems)
        np.testing.assert_array_equal([frame.depth for frame in recording], MANY)
