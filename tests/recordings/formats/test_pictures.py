"""Pictures of the rarer kinds: PGM in both byte orders, PCLZF, and the encodings of depth that data
sets have.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from liex_lab.recordings import open_recording
from liex_lab.recordings.depth_kernels import unpack_lzf
from liex_lab.recordings.formats.images.files import read_pclzf_camera
from liex_lab.recordings.frame import ENCODINGS, decode
from tests.oracles import lzf
from tests.recordings.asking import refusal
from tests.recordings.picture_writers import pack_lzf, write_folder, write_pclzf, write_pgm
from tests.recordings.writers import SMALL, depth_frames, even_times, write_camera, write_times

STORED = depth_frames(4)


@pytest.mark.parametrize("order", [">u2", "<u2"])
@pytest.mark.parametrize("stated", [True, False])
def test_pgm_is_read_in_the_byte_order_stated_or_plain_to_see(
    tmp_path: Path, order: str, stated: bool
) -> None:
    name = "big" if order == ">u2" else "little"
    how = {"byte_order": name} if stated else {}
    folder = write_folder(tmp_path / "r", STORED, ".pgm", partial(write_pgm, order=order), **how)
    with open_recording(folder, strict=True) as recording:
        np.testing.assert_array_equal([frame.depth for frame in recording], STORED)
        told = any("low byte first" in problem for problem in recording.problems)
        assert told == (name == "little" and not stated)


def test_a_stated_byte_order_is_believed(tmp_path: Path) -> None:
    folder = write_folder(tmp_path / "r", STORED, ".pgm", write_pgm, byte_order="little")
    with open_recording(folder) as recording:
        np.testing.assert_array_equal(recording.frame(0).depth, STORED[0].byteswap())
    write_camera(folder, byte_order="middle")
    assert '"big", "little"' in refusal(folder)


@pytest.mark.parametrize(
    "head",
    ["P5 {w} {h} 65535\n", "P5\n# a comment\n{w}\n#\n {h}\n4095 ", "P5\r\n{w}\t{h}\r\n65535\n"],
)
def test_pgm_headers_are_loose(tmp_path: Path, head: str) -> None:
    folder = write_folder(tmp_path / "r", STORED, ".pgm", partial(write_pgm, head=head))
    with open_recording(folder, strict=True) as recording:
        np.testing.assert_array_equal(recording.frame(3).depth, STORED[3])


def test_eight_bit_pgm_is_a_picture_for_people(tmp_path: Path) -> None:
    folder = write_folder(tmp_path / "r", STORED[:0], ".pgm", write_pgm)
    cv2.imwrite(str(folder / "a.pgm"), np.zeros((48, 64), np.uint8))
    assert "expected 16-bit depth, got an 8-bit grey image of 64 x 48" in refusal(folder)


@given(st.binary(max_size=300), st.integers(0, 6))
def test_lzf_comes_back_as_its_slow_twin_has_it(data: bytes, doubled: int) -> None:
    for _ in range(doubled):
        data += data[: 400 - len(data)] if len(data) < 400 else b""
    packed = pack_lzf(data)
    assert lzf.unpack_lzf(packed) == data
    out = np.empty(len(data), np.uint8)
    assert unpack_lzf(np.frombuffer(packed, np.uint8), out) == len(data)
    assert out.tobytes() == data


@given(st.binary(max_size=60), st.integers(0, 200))
def test_lzf_noise_is_refused_where_the_slow_twin_refuses_it(packed: bytes, room: int) -> None:
    out = np.full(room + 8, 7, np.uint8)
    n = unpack_lzf(np.frombuffer(packed, np.uint8), out[:room])
    try:
        slow = lzf.unpack_lzf(packed)
    except (IndexError, ValueError):
        assert n == -1
    else:
        assert n == (len(slow) if len(slow) <= room else -1)
        assert n < 0 or out[:n].tobytes() == slow
    assert (out[room:] == 7).all()  # nothing is written beyond its end


XML = (
    '<?xml version="1.0" '
    'encoding="utf-8"?>\n<rgb>\n<focal_length_x>9</focal_length_x>\n</rgb>\n<depth>\n'
    "<focal_length_x>525.5</focal_length_x><focal_length_y>526</focal_length_y><principal_point_x>320</principal_point_x>"
    "<principal_point_y>240</principal_point_y>\n<z_multiplication_factor>{z}</z_multiplication_factor>\n</depth>\n"
)


def test_pclzf_takes_its_camera_and_unit_from_the_xml_and_its_times_from_the_names(
    tmp_path: Path,
) -> None:
    for k, second in enumerate(("55.814212", "56.068683", "56.100000")):
        write_pclzf(tmp_path / f"frame_20121214T1422{second}_depth.pclzf", STORED[k])
        write_pclzf(tmp_path / f"frame_20121214T1422{second}_rgb.pclzf", STORED[k], b"rgb24")
        (tmp_path / f"frame_20121214T1422{second}.xml").write_text(XML.format(z="0.0001"))
    with open_recording(tmp_path, strict=True) as recording:
        lens = recording.camera
        assert (lens.fx, lens.fy, lens.cx, lens.cy, lens.width) == (525.5, 526, 320, 240, 64)
        assert "XML" in lens.source
        assert np.diff(recording.times_ns).tolist() == [254_471_000, 31_317_000]
        assert "session_start_time" not in recording.metadata  # a date without a zone is no moment
        np.testing.assert_allclose(recording.frame(2).depth, STORED[2] * 0.1, rtol=1e-6)
    write_camera(tmp_path, SMALL, unit_mm=2.0)
    with open_recording(tmp_path) as recording:
        assert (recording.camera.fx, recording.camera.source) == (SMALL.fx, "camera.toml")
        np.testing.assert_array_equal(recording.frame(2).depth, STORED[2] * 2.0)
    assert "8-bit rgb24" in refusal(tmp_path / "frame_20121214T142256.100000_rgb.pclzf")


@pytest.mark.parametrize(
    "text", ["", "<depth>", XML.format(z="nan"), XML.format(z="x"), "<depth></depth>", "&&&"]
)
def test_an_xml_that_tells_nothing_leaves_the_camera_unknown(tmp_path: Path, text: str) -> None:
    write_pclzf(tmp_path / "a_depth.pclzf", STORED[0])
    (tmp_path / "a.xml").write_text(text)
    assert read_pclzf_camera(tmp_path / "a_depth.pclzf") is None
    assert "camera.toml" in refusal(tmp_path / "a_depth.pclzf")


def test_the_encodings_of_data_sets() -> None:
    mm = np.array([[0, 700, 1057, 8191]])
    np.testing.assert_allclose(decode((mm * 5).astype(np.uint16), "tum", ENCODINGS["tum"]), mm)
    turned = ((mm << 3) | (mm >> 13)).astype(np.uint16)
    np.testing.assert_array_equal(decode(turned, "sun", 1.0), mm)
    raw = np.array([[0, 839, 1000, 1092, 1093, 2047]], np.uint16)
    by_hand = [0.0, 351300 / 253.5, 351300 / 92.5, 351300 / 0.5, 0.0, 0.0]
    np.testing.assert_allclose(decode(raw, "kinect1-disparity", 1.0), [by_hand], rtol=1e-6)
    colour = np.stack([mm & 255, mm >> 8, 0 * mm], axis=-1).astype(np.uint8)
    np.testing.assert_array_equal(decode(colour, "nyu-hand", 1.0, (8191.0,)), [[0, 700, 1057, 0]])


def test_an_encoding_is_stated_in_camera_toml(tmp_path: Path) -> None:
    stored = (STORED * 5).astype(np.uint16)
    folder = write_folder(
        tmp_path / "r", stored, ".png", lambda p, f: cv2.imwrite(str(p), f), encoding="tum"
    )
    with open_recording(folder) as recording:
        np.testing.assert_allclose(recording.frame(1).depth, STORED[1], rtol=1e-6)
    write_camera(folder, encoding="nyu-hand")
    assert "got a 16-bit grey image" in refusal(folder)
    write_camera(folder, encoding="tumm")
    assert '"tum"' in refusal(folder)
    pgm = write_folder(tmp_path / "p", STORED, ".pgm", write_pgm, encoding="nyu-hand")
    assert "colour PNG" in refusal(pgm)


@pytest.mark.parametrize(
    ("header", "row", "how"),
    [
        ("frame;stamp", "{k};{ms}", {"time_column": "stamp", "time_unit": "ms"}),
        (
            "# timestamp filename",
            "{s} frame_{k}.png",
            {"time_column": "timestamp", "time_unit": "s"},
        ),
        (
            "# depth maps\n# timestamp filename",
            "{s} frame_{k}.png",
            {"time_column": 0, "time_unit": "s"},
        ),
        ("", "frame_{k}.png,{us}", {"time_column": 1, "time_unit": "us"}),
        ("time_us", "{us}", {}),
    ],
)
def test_a_stamp_file_of_another_program_is_read_as_stated(
    tmp_path: Path, header: str, row: str, how: dict[str, object]
) -> None:
    folder = write_folder(tmp_path / "r", STORED, ".pgm", write_pgm)
    write_camera(folder, SMALL, timestamps="stamps.txt", **how)
    times = [10**18 + k * 33_333_000 for k in range(4)]
    rows = [
        row.format(
            k=k, s=f"{t // 10**9}.{t % 10**9:09d}", ms=f"{t // 10**6}.{t % 10**6:06d}", us=t // 1000
        )
        for k, t in enumerate(times)
    ]
    (folder / "stamps.txt").write_text("\n".join([*header.splitlines(), *rows]))
    with open_recording(folder, strict=True) as recording:
        assert recording.times_ns.tolist() == times


@pytest.mark.parametrize(
    ("how", "says"),
    [
        ({"time_column": "stamp"}, 'time_unit = "s"'),
        ({"time_column": "stamps", "time_unit": "s"}, "a column stamps"),
        ({"time_column": 7, "time_unit": "s"}, "'' on line"),
        ({"time_column": -1}, "time_column = -1"),
        ({"time_column": True}, "time_column = True"),
        ({"time_unit": "min"}, '"ns", "us", "ms", "s"'),
    ],
)
def test_a_column_of_times_that_is_not_there_is_told(
    tmp_path: Path, how: dict[str, object], says: str
) -> None:
    folder = write_folder(tmp_path / "r", STORED, ".pgm", write_pgm)
    (folder / "timestamps.csv").write_text("frame,stamp\n0,1.5\n1,2.5\n")
    write_camera(folder, SMALL, **how)
    assert says in refusal(folder)


def test_the_stamps_of_a_file_come_before_those_in_names_and_a_rate(tmp_path: Path) -> None:
    folder = tmp_path / "r"
    write_folder(folder, STORED[:0], ".pgm", write_pgm, fps=99)
    (folder / "timestamps.csv").unlink()
    for k, frame in enumerate(STORED):
        write_pgm(folder / f"d-1305031102.{175304 + k * 33333}-7.pgm", frame)
    with open_recording(folder, strict=True) as recording:
        assert recording.times_ns.tolist() == [
            1305031102_175304000 + k * 33_333_000 for k in range(4)
        ]
        assert recording.metadata["session_start_time"].startswith("2011-05-10T12:38:22.175")
    write_times(folder, even_times(4))
    with open_recording(folder) as recording:
        assert recording.times_ns.tolist() == even_times(4)
