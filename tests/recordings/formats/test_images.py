"""Folders of PNG and TIFF images."""

from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import cv2
import numpy as np
import pytest
import tifffile
from hypothesis import given
from hypothesis import strategies as st

from liex_lab.optics.camera import Camera
from liex_lab.recordings import open_recording
from liex_lab.recordings.depth_kernels import unpack_lzf
from liex_lab.recordings.formats.images.files import read_pclzf_camera
from liex_lab.recordings.formats.images.folder import natural_key
from liex_lab.recordings.frame import ENCODINGS, decode
from tests.oracles import lzf
from tests.recordings.asking import depths_in, exact, facts_in, refusal
from tests.recordings.picture_writers import pack_lzf, write_folder, write_pclzf, write_pgm
from tests.recordings.writers import (
    SMALL,
    cut,
    depth_frames,
    even_times,
    write_camera,
    write_moseq_folder,
    write_png_folder,
    write_tiff_stack,
    write_times,
)

STORED = depth_frames(12)


def test_pictures_are_in_the_order_a_person_would_count_them(tmp_path: Path) -> None:
    names = ["f_10.png", "f_9.png", "f_1.png", "f_010.png", "g.png", "f²_1.png"]
    assert sorted(names, key=natural_key)[:3] == ["f_1.png", "f_9.png", "f_10.png"]
    folder = write_png_folder(tmp_path / "r", STORED)
    (folder / "._frame_3.png").write_bytes(b"resource fork")  # beside them
    (folder / "more").mkdir()
    # frame_10 comes after frame_9, not after frame_1
    assert exact(folder, STORED).problems == []


def test_units_and_unread_values_are_as_stated(tmp_path: Path) -> None:
    stored = np.full((2, 48, 64), 5000, np.uint16)
    stored[:, 0, 0], stored[:, 0, 1] = 65535, 0
    depth = depths_in(write_png_folder(tmp_path / "r", stored, unit_mm=0.2, unread=[0, 65535]))[0]
    assert depth[1, 1] == 1000.0
    np.testing.assert_array_equal(depth[0, :3], [0.0, 0.0, 1000.0])


def test_an_animal_is_known_by_its_camera_file(tmp_path: Path) -> None:
    folder = write_png_folder(
        tmp_path / "r",
        STORED,
        subject_id="m7",
        session_start_time="2024-05-01T10:00:00+02:00",
        focal=3,
        unit_mn=2,
    )
    with open_recording(folder) as recording:
        assert recording.metadata == {
            "subject_id": "m7",
            "session_start_time": "2024-05-01T10:00:00+02:00",
        }
        assert any(
            "'unit_mn'" in problem and "'unit_mm'" in problem for problem in recording.problems
        )
        assert any("'focal'" in problem for problem in recording.problems)


def test_without_stamps_a_stated_rate_is_used_and_told(tmp_path: Path) -> None:
    folder = write_png_folder(tmp_path / "r", STORED)
    (folder / "timestamps.csv").unlink()
    sentence = refusal(folder)
    assert "timestamps.csv" in sentence
    assert "fps" in sentence
    with open_recording(folder, fps=25) as recording:
        assert recording.rate_hz == pytest.approx(25)
        assert any("25 frames/s was assumed" in problem for problem in recording.problems)
    write_camera(folder, SMALL, fps=50)
    assert facts_in(folder).rate_hz == pytest.approx(50)
    assert "fps = -1" in refusal(folder, fps=-1)
    assert "fps = nan" in refusal(folder, fps=float("nan"))


def test_a_stated_camera_needs_no_camera_file(tmp_path: Path) -> None:
    folder = write_png_folder(tmp_path / "r", STORED)
    (folder / "camera.toml").unlink()
    sentence = refusal(folder)
    for word in ("camera.toml", "fx", "fy", "cx", "cy", "unit_mm"):
        assert word in sentence
    assert facts_in(folder, camera=SMALL).camera == SMALL
    assert "640 x 480" in refusal(folder, camera=Camera(500, 500, 320, 240, 640, 480))


@pytest.mark.parametrize("share", [0.0, 0.02, 0.6, 0.999])
def test_a_cut_png_is_there_and_wholly_unread(tmp_path: Path, share: float) -> None:
    folder = write_png_folder(tmp_path / "r", STORED)
    cut(folder / "frame_4.png", share)
    with open_recording(folder) as recording:
        assert (len(recording), recording.truncated, recording.n_whole) == (12, True, 11)
        assert [recording[part].n_whole for part in (slice(6), slice(5, 12), slice(4, 5))] == [
            5,
            7,
            0,
        ]
        assert any(
            "1 of 12 images" in problem and "frame_4.png" in problem
            for problem in recording.problems
        )
        assert not recording.frame(4).depth.any()
        np.testing.assert_array_equal(recording.frame(5).depth, STORED[5])
    sentence = refusal(folder, strict=True)
    assert "11 whole frames" in sentence
    assert "--set recording.accept_truncated=true" in sentence


def test_a_png_damaged_inside_is_found_when_it_is_read(tmp_path: Path) -> None:
    folder = write_png_folder(tmp_path / "r", STORED)
    content = bytearray((folder / "frame_2.png").read_bytes())
    content[60:-20] = bytes(len(content) - 80)
    (folder / "frame_2.png").write_bytes(content)
    with open_recording(folder, strict=True) as recording:
        assert recording.problems == []
        for _ in range(2):
            assert not recording[1:4].frame(1).depth.any()
        (problem,) = recording.problems
        assert "frame 2 (frame_2.png)" in problem


def test_a_single_cut_picture_is_refused(tmp_path: Path) -> None:
    folder = write_png_folder(tmp_path / "r", STORED[:1], fps=30)
    cut(folder / "frame_0.png", 0.5)
    assert "cut short" in refusal(folder / "frame_0.png")
    assert "cut short" in refusal(folder)


@pytest.mark.parametrize(
    ("image", "kind"),
    [
        (np.zeros((48, 64), np.uint8), "an 8-bit grey image of 64 x 48"),
        (np.zeros((48, 64, 3), np.uint8), "an 8-bit colour image of 64 x 48"),
        (np.zeros((48, 64, 4), np.uint8), "an 8-bit colour with transparency image"),
        (np.zeros((48, 64, 3), np.uint16), "a 16-bit colour image of 64 x 48"),
    ],
)
@pytest.mark.parametrize("suffix", [".png", ".tif"])
def test_pictures_for_people_are_refused(
    tmp_path: Path, image: np.ndarray, kind: str, suffix: str
) -> None:
    folder = tmp_path / "r"
    write_camera_folder = write_png_folder(folder, STORED[:0])
    path = folder / f"a{suffix}"
    if suffix == ".png":
        cv2.imwrite(str(path), image)
    else:
        tifffile.imwrite(path, image, photometric="minisblack" if image.ndim == 2 else "rgb")
        kind = kind.replace(" with transparency", "").replace(
            "a 16-bit", "a 16-bit unsigned integer"
        )
    for opened in (write_camera_folder, path):
        sentence = refusal(opened)
        assert f"expected 16-bit depth, got {kind}" in sentence
        assert str(path) in sentence


def test_one_colour_picture_among_many_is_found_on_opening(tmp_path: Path) -> None:
    folder = write_png_folder(tmp_path / "r", STORED)
    cv2.imwrite(str(folder / "frame_7_colour.png"), np.zeros((48, 64, 3), np.uint8))
    assert "frame_7_colour.png" in refusal(folder)
    write_camera(folder, SMALL, pattern="frame_?.png")
    assert len(facts_in(folder)) == 10
    write_camera(folder, SMALL, pattern="depth*")
    assert "'depth*'" in refusal(folder)


def test_sizes_and_kinds_do_not_mix(tmp_path: Path) -> None:
    folder = write_png_folder(tmp_path / "r", STORED)
    cv2.imwrite(str(folder / "frame_3.png"), STORED[3][:40])
    sentence = refusal(folder)
    assert "frame_3.png" in sentence
    assert "64 x 40" in sentence
    tifffile.imwrite(folder / "frame_12.tif", STORED[3])
    assert "both PNG and TIFF" in refusal(folder)


@pytest.mark.parametrize("suffix", [".png", ".tif"])
def test_a_text_that_is_named_like_a_picture_is_refused(tmp_path: Path, suffix: str) -> None:
    folder = write_png_folder(tmp_path / "r", STORED[:0])
    (folder / f"a{suffix}").write_text("this is not an image at all, whatever its name may say")
    assert "holds something else" in refusal(folder)


@pytest.mark.parametrize(
    ("content", "says"),
    [
        ("[camera]\nfx = nan\nfy = 1\ncx = 1\ncy = 1", "fx = nan"),
        ("[camera]\nfx = 0\nfy = 1\ncx = 1\ncy = 1", "fx = 0"),
        ("[camera]\nfx = -5\nfy = 1\ncx = 1\ncy = 1", "fx = -5"),
        ("[camera]\nfx = '575'\nfy = 1\ncx = 1\ncy = 1", "fx = '575'"),
        ("[camera]\nfx = true\nfy = 1\ncx = 1\ncy = 1", "fx = True"),
        ("[camera]\nfx = 5\nfy = 1", "does not state cx, cy"),
        ("[camera]\nfx = 5\nfy = 1\ncx = 1\ncy = 1\nwidth = 640\nheight = 480", "640 x 480"),
        ("[camera]\nfx = 5\nfy = 1\ncx = 1\ncy = 1\nwidth = 64.5", "width = 64.5"),
        ("[camera]\nfx = 5\nfy = 1\ncx = 1\ncy = 1\nunit_mm = 0", "unit_mm = 0"),
        ("[camera]\nfx = 5\nfy = 1\ncx = 1\ncy = 1\nunit_mm = inf", "unit_mm = inf"),
        ("[camera]\nfx = 5\nfy = 1\ncx = 1\ncy = 1\nunread = ['x']", "unread = ['x']"),
        ("[camera]\nfx = 5\nfy = 1\ncx = 1\ncy = 1\nfps = 0", "fps = 0"),
        ("[camera]\nfx = 5\nfy = 1\ncx = 1\ncy = 1\ntimestamps = 3", "timestamps = 3"),
        ("[camera\nfx = 5", "should be a TOML file, but: "),
        ("", "camera.toml"),
        ("camera = 5", "camera.toml"),
        ("[camera]\nfx = 60\ndistortion = 0.1", "a list of coefficients"),
        ("[camera]\nfx = 60\ndistortion = [0.1, 'k2']", "a list of coefficients"),
        (
            "[camera]\nfx = 60\ndistortion = [0.1]\ndistortion_model = 'mei'",
            "'mei' is not supported",
        ),
        ("[camera]\nfx = 60\ndistortion_model = 5", "a text in quotation marks"),
        ("\x00\x01", "should be a TOML file, but: "),
    ],
)
def test_a_wrong_camera_file_is_told_in_a_sentence(tmp_path: Path, content: str, says: str) -> None:
    folder = write_png_folder(tmp_path / "r", STORED[:2])
    (folder / "camera.toml").write_text(content)
    sentence = refusal(folder)
    assert says in sentence
    assert "camera.toml" in sentence


def test_keys_may_stand_without_a_table_and_sizes_may_be_left_out(tmp_path: Path) -> None:
    folder = write_png_folder(tmp_path / "r", STORED[:2])
    (folder / "camera.toml").write_text("fx = 60\nfy = 61.0\ncx = 31.5\ncy = 23.5")
    camera = facts_in(folder).camera
    assert (camera.fx, camera.cy, camera.width, camera.height, camera.source) == (
        60.0,
        23.5,
        64,
        48,
        "camera.toml",
    )


@pytest.mark.parametrize(
    "how", [{}, {"compression": "zlib"}, {"bigtiff": True}, {"rowsperstrip": 5}]
)
def test_tiff_stacks_hold_many_frames(tmp_path: Path, how: dict[str, Any]) -> None:
    path = tmp_path / "depth.tif"
    write_tiff_stack(path, STORED, **{key: value for key, value in how.items() if key != "bigtiff"})
    if "bigtiff" in how:
        tifffile.imwrite(path, STORED, photometric="minisblack", bigtiff=True, byteorder=">")
    for opened in (path, tmp_path):
        with open_recording(opened, strict=True) as recording:
            assert len(recording) == 12
            for index in (11, 0, 7):
                np.testing.assert_array_equal(recording.frame(index).depth, STORED[index])


def test_compressed_tiffs_that_tifffile_leaves_to_others_are_read_too(tmp_path: Path) -> None:
    folder = write_png_folder(tmp_path / "r", STORED[:0])
    for k, frame in enumerate(STORED):  # OpenCV writes LZW
        cv2.imwrite(str(folder / f"f{k}.tiff"), frame, [cv2.IMWRITE_TIFF_COMPRESSION, 5])
    write_times(folder, even_times(12))
    exact(folder, STORED)


def test_an_imagej_stack_of_one_page_holds_all_its_pictures(tmp_path: Path) -> None:
    path = write_tiff_stack(tmp_path / "depth.tif", STORED)
    tifffile.imwrite(path, STORED, imagej=True)
    with tifffile.TiffFile(path) as tif:
        page_at, order = tif.pages.first.offset, "little" if tif.byteorder == "<" else "big"
    content = bytearray(path.read_bytes())
    n_tags = int.from_bytes(content[page_at : page_at + 2], order)  # type: ignore[arg-type]
    next_at = page_at + 2 + 12 * n_tags
    content[next_at : next_at + 4] = bytes(4)  # as ImageJ does beyond 4 GB: there is no second page
    path.write_bytes(content)
    exact(path, STORED)


def test_float_tiffs_are_millimetres_and_may_point_the_other_way(tmp_path: Path) -> None:
    stored = -STORED.astype(np.float32) - 0.25
    stored[:, 0, 0], stored[:, 0, 1] = np.nan, 0.0
    path = write_tiff_stack(tmp_path / "depth.tif", stored)
    assert "unit_mm = -1" in refusal(path)
    write_camera(tmp_path, SMALL, unit_mm=-1.0)
    depth = depths_in(path)[3]
    np.testing.assert_array_equal(depth[0, :2], [0.0, 0.0])
    np.testing.assert_array_equal(depth[1:], -stored[3, 1:])


def test_a_cut_tiff_among_whole_ones_is_wholly_unread(tmp_path: Path) -> None:
    folder = write_png_folder(tmp_path / "r", STORED[:0])
    for k, frame in enumerate(STORED):
        tifffile.imwrite(folder / f"f{k}.tif", frame)
    cut(folder / "f3.tif", 0.6)
    cut(folder / "f5.tif", 0.0)
    write_times(folder, even_times(12))
    expected = STORED.copy()
    expected[[3, 5]] = 0
    recording = exact(folder, expected)
    assert (recording.n_whole, recording.truncated) == (10, True)


# Images of the rarer kinds: PGM in both byte orders, PCLZF, and the encodings of depth that data
# sets have.


PICTURES_STORED = depth_frames(4)


@pytest.mark.parametrize("order", [">u2", "<u2"])
@pytest.mark.parametrize("stated", [True, False])
def test_pgm_is_read_in_the_byte_order_stated_or_plain_to_see(
    tmp_path: Path, order: str, stated: bool
) -> None:
    name = "big" if order == ">u2" else "little"
    how = {"byte_order": name} if stated else {}
    folder = write_folder(
        tmp_path / "r", PICTURES_STORED, ".pgm", partial(write_pgm, order=order), **how
    )
    problems = exact(folder, PICTURES_STORED, strict=True).problems
    told = any("low byte first" in problem for problem in problems)
    assert told == (name == "little" and not stated)


def test_a_stated_byte_order_is_believed(tmp_path: Path) -> None:
    folder = write_folder(tmp_path / "r", PICTURES_STORED, ".pgm", write_pgm, byte_order="little")
    np.testing.assert_array_equal(depths_in(folder)[0], PICTURES_STORED[0].byteswap())
    write_camera(folder, byte_order="middle")
    assert '"big", "little"' in refusal(folder)


@pytest.mark.parametrize(
    "head",
    ["P5 {w} {h} 65535\n", "P5\n# a comment\n{w}\n#\n {h}\n4095 ", "P5\r\n{w}\t{h}\r\n65535\n"],
)
def test_pgm_headers_are_loose(tmp_path: Path, head: str) -> None:
    folder = write_folder(tmp_path / "r", PICTURES_STORED, ".pgm", partial(write_pgm, head=head))
    np.testing.assert_array_equal(depths_in(folder, strict=True)[3], PICTURES_STORED[3])


def test_eight_bit_pgm_is_a_picture_for_people(tmp_path: Path) -> None:
    folder = write_folder(tmp_path / "r", PICTURES_STORED[:0], ".pgm", write_pgm)
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
        write_pclzf(tmp_path / f"frame_20121214T1422{second}_depth.pclzf", PICTURES_STORED[k])
        write_pclzf(
            tmp_path / f"frame_20121214T1422{second}_rgb.pclzf", PICTURES_STORED[k], b"rgb24"
        )
        (tmp_path / f"frame_20121214T1422{second}.xml").write_text(XML.format(z="0.0001"))
    with open_recording(tmp_path, strict=True) as recording:
        lens = recording.camera
        assert (lens.fx, lens.fy, lens.cx, lens.cy, lens.width) == (525.5, 526, 320, 240, 64)
        assert "XML" in lens.source
        assert np.diff(recording.times_ns).tolist() == [254_471_000, 31_317_000]
        assert "session_start_time" not in recording.metadata  # a date without a zone is no moment
        np.testing.assert_allclose(recording.frame(2).depth, PICTURES_STORED[2] * 0.1, rtol=1e-6)
    write_camera(tmp_path, SMALL, unit_mm=2.0)
    with open_recording(tmp_path) as recording:
        assert (recording.camera.fx, recording.camera.source) == (SMALL.fx, "camera.toml")
        np.testing.assert_array_equal(recording.frame(2).depth, PICTURES_STORED[2] * 2.0)
    assert "8-bit rgb24" in refusal(tmp_path / "frame_20121214T142256.100000_rgb.pclzf")


@pytest.mark.parametrize(
    "text", ["", "<depth>", XML.format(z="nan"), XML.format(z="x"), "<depth></depth>", "&&&"]
)
def test_an_xml_that_tells_nothing_leaves_the_camera_unknown(tmp_path: Path, text: str) -> None:
    write_pclzf(tmp_path / "a_depth.pclzf", PICTURES_STORED[0])
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
    stored = (PICTURES_STORED * 5).astype(np.uint16)
    folder = write_folder(
        tmp_path / "r", stored, ".png", lambda p, f: cv2.imwrite(str(p), f), encoding="tum"
    )
    np.testing.assert_allclose(depths_in(folder)[1], PICTURES_STORED[1], rtol=1e-6)
    write_camera(folder, encoding="nyu-hand")
    assert "got a 16-bit grey image" in refusal(folder)
    write_camera(folder, encoding="tumm")
    assert '"tum"' in refusal(folder)
    pgm = write_folder(tmp_path / "p", PICTURES_STORED, ".pgm", write_pgm, encoding="nyu-hand")
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
    folder = write_folder(tmp_path / "r", PICTURES_STORED, ".pgm", write_pgm)
    write_camera(folder, SMALL, timestamps="stamps.txt", **how)
    times = [10**18 + k * 33_333_000 for k in range(4)]
    rows = [
        row.format(
            k=k, s=f"{t // 10**9}.{t % 10**9:09d}", ms=f"{t // 10**6}.{t % 10**6:06d}", us=t // 1000
        )
        for k, t in enumerate(times)
    ]
    (folder / "stamps.txt").write_text("\n".join([*header.splitlines(), *rows]))
    assert facts_in(folder, strict=True).times_ns.tolist() == times


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
    folder = write_folder(tmp_path / "r", PICTURES_STORED, ".pgm", write_pgm)
    (folder / "timestamps.csv").write_text("frame,stamp\n0,1.5\n1,2.5\n")
    write_camera(folder, SMALL, **how)
    assert says in refusal(folder)


def test_the_stamps_of_a_file_come_before_those_in_names_and_a_rate(tmp_path: Path) -> None:
    folder = tmp_path / "r"
    write_folder(folder, PICTURES_STORED[:0], ".pgm", write_pgm, fps=99)
    (folder / "timestamps.csv").unlink()
    for k, frame in enumerate(PICTURES_STORED):
        write_pgm(folder / f"d-1305031102.{175304 + k * 33333}-7.pgm", frame)
    with open_recording(folder, strict=True) as recording:
        assert recording.times_ns.tolist() == [
            1305031102_175304000 + k * 33_333_000 for k in range(4)
        ]
        assert recording.metadata["session_start_time"].startswith("2011-05-10T12:38:22.175")
    write_times(folder, even_times(4))
    assert facts_in(folder).times_ns.tolist() == even_times(4)


# Numbers that depth is stored in: signed, big endian, and the values that mean unread.


@given(
    kind=st.sampled_from(["<u2", ">u2", "<i2", ">i2", "<f4", ">f4"]),
    compression=st.sampled_from([None, "zlib"]),
)
def test_tiff_of_every_kind_gives_the_same_depth(kind: str, compression: str | None) -> None:
    """Unread is 0, what is negative, and the largest value that the integers have."""
    depth = depth_frames(2).astype(np.float32)
    stored = depth.astype(kind)
    kinds: dict[str, list[float]] = {
        "u": [0, 65535],
        "i": [0, -1, -32768, 32767],
        "f": [0, -1, np.nan, np.inf, -np.inf],
    }
    unread = kinds[stored.dtype.kind]
    stored[:, 0, : len(unread)] = unread
    depth[:, 0, : len(unread)] = 0
    with TemporaryDirectory() as folder:
        path = write_tiff_stack(Path(folder) / "r" / "stack.tif", depth)  # and what lies beside it
        with tifffile.TiffWriter(path, byteorder=kind[0]) as tif:  # type: ignore[arg-type]
            for page in stored:
                tif.write(page, photometric="minisblack", compression=compression)
        np.testing.assert_array_equal(depths_in(path), depth)


@pytest.mark.parametrize(
    ("kind", "named"),
    [
        ("i4", "a 32-bit signed integer grey image"),
        ("u4", "a 32-bit unsigned integer grey image"),
        ("f8", "a 64-bit floating-point grey image"),
        ("i1", "an 8-bit signed integer grey image"),
        ("u1", "an 8-bit grey image"),
    ],
)
def test_tiff_of_other_numbers_is_refused_by_their_name(
    tmp_path: Path, kind: str, named: str
) -> None:
    path = write_tiff_stack(tmp_path / "r" / "stack.tif", np.ones((2, 48, 64), kind))
    assert f"expected 16-bit depth, got {named}" in refusal(path)


def test_the_largest_value_is_a_reading_where_a_step_is_small(tmp_path: Path) -> None:
    stored = depth_frames(2)
    stored[:, 0, 0] = 65535
    for unit_mm, expected in ((0.1, 6553.5), (1.0, 0.0)):
        folder = write_png_folder(tmp_path / f"{unit_mm}", stored, unit_mm=unit_mm)
        assert depths_in(folder)[0][0, 0] == pytest.approx(expected)


def test_signed_depths_that_are_all_negative_are_refused(tmp_path: Path) -> None:
    path = write_tiff_stack(tmp_path / "r" / "stack.tif", -depth_frames(2).astype("i2"))
    assert "unit_mm = -1" in refusal(path)


def test_the_largest_value_is_unread_in_every_kind_of_file(tmp_path: Path) -> None:
    stored = depth_frames(2)
    stored[:, 0, 0] = 65535
    for folder in (
        write_folder(tmp_path / "pgm", stored, ".pgm", write_pgm),
        write_png_folder(tmp_path / "png", stored),
        write_camera(write_moseq_folder(tmp_path / "raw", stored)).parent,
    ):
        with open_recording(folder) as recording:
            depth = recording.frame(1).depth
            assert depth[0, 0] == 0
            assert depth[0, 1] == stored[1, 0, 1]
