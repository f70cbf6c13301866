"""Folders of PNG and TIFF pictures."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import tifffile

from liex_lab.optics.camera import Camera
from liex_lab.recordings import open_recording
from liex_lab.recordings.formats.images.folder import natural_key
from tests.recordings.asking import refusal
from tests.recordings.writers import (
    SMALL,
    cut,
    depth_frames,
    even_times,
    write_camera,
    write_png_folder,
    write_tiff_stack,
    write_times,
)

STORED = depth_frames(12)


def test_pictures_are_in_the_order_a_person_would_count_them(tmp_path: Path) -> None:
    names = ["f_10.png", "f_9.png", "f_1.png", "f_010.png", "g.png", "f²_1.png"]
    assert sorted(names, key=natural_key)[:3] == ["f_1.png", "f_9.png", "f_10.png"]
    with open_recording(write_png_folder(tmp_path / "r", STORED)) as recording:
        assert len(recording) == 12  # frame_10 comes after frame_9, not after frame_1
        for frame in recording:
            np.testing.assert_array_equal(frame.depth, STORED[frame.index])
        assert recording.problems == []


def test_stamps_are_exact_in_nanoseconds_and_in_seconds(tmp_path: Path) -> None:
    times = even_times(12)
    folder = write_png_folder(tmp_path / "r", STORED, times_ns=times)
    with open_recording(folder) as recording:
        assert recording.times_ns.tolist() == times
        assert recording.metadata["session_start_time"].startswith("2025-10-09T08:53:20")
    write_times(folder, times, seconds=True)
    with open_recording(folder) as recording:
        assert recording.times_ns.tolist() == times


def test_units_and_unread_values_are_as_stated(tmp_path: Path) -> None:
    stored = np.full((2, 48, 64), 5000, np.uint16)
    stored[:, 0, 0], stored[:, 0, 1] = 65535, 0
    with open_recording(
        write_png_folder(tmp_path / "r", stored, unit_mm=0.2, unread=[0, 65535])
    ) as recording:
        depth = recording.frame(0).depth
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
    with open_recording(folder) as recording:
        assert recording.rate_hz == pytest.approx(50)
    assert "fps = -1" in refusal(folder, fps=-1)
    assert "fps = nan" in refusal(folder, fps=float("nan"))


def test_a_stated_camera_needs_no_camera_file(tmp_path: Path) -> None:
    folder = write_png_folder(tmp_path / "r", STORED)
    (folder / "camera.toml").unlink()
    sentence = refusal(folder)
    for word in ("camera.toml", "fx", "fy", "cx", "cy", "unit_mm"):
        assert word in sentence
    with open_recording(folder, camera=SMALL) as recording:
        assert recording.camera == SMALL
    assert "640 x 480" in refusal(folder, camera=Camera(500, 500, 320, 240, 640, 480))


def test_counts_that_differ_are_told_and_the_smaller_is_used(tmp_path: Path) -> None:
    folder = write_png_folder(tmp_path / "r", STORED, times_ns=even_times(9))
    with open_recording(folder) as recording:
        assert (len(recording), recording.truncated) == (9, False)
        assert any("12 frames" in p and "9 time stamps" in p for p in recording.problems)
    write_times(folder, even_times(15))
    with open_recording(folder) as recording:
        assert len(recording) == 12
    write_times(folder, [])
    assert "no time stamp" in refusal(folder)


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
            "1 of 12 pictures" in problem and "frame_4.png" in problem
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
    ("picture", "kind"),
    [
        (np.zeros((48, 64), np.uint8), "an 8-bit grey image of 64 x 48"),
        (np.zeros((48, 64, 3), np.uint8), "an 8-bit colour image of 64 x 48"),
        (np.zeros((48, 64, 4), np.uint8), "an 8-bit colour with transparency image"),
        (np.zeros((48, 64, 3), np.uint16), "a 16-bit colour image of 64 x 48"),
    ],
)
@pytest.mark.parametrize("suffix", [".png", ".tif"])
def test_pictures_for_people_are_refused(
    tmp_path: Path, picture: np.ndarray, kind: str, suffix: str
) -> None:
    folder = tmp_path / "r"
    write_camera_folder = write_png_folder(folder, STORED[:0])
    path = folder / f"a{suffix}"
    if suffix == ".png":
        cv2.imwrite(str(path), picture)
    else:
        tifffile.imwrite(path, picture, photometric="minisblack" if picture.ndim == 2 else "rgb")
        kind = kind.replace(" with transparency", "").replace(
            "a 16-bit", "a 16-bit unsigned integer"
        )
    for given in (write_camera_folder, path):
        sentence = refusal(given)
        assert f"expected 16-bit depth, got {kind}" in sentence
        assert str(path) in sentence


def test_one_colour_picture_among_many_is_found_on_opening(tmp_path: Path) -> None:
    folder = write_png_folder(tmp_path / "r", STORED)
    cv2.imwrite(str(folder / "frame_7_colour.png"), np.zeros((48, 64, 3), np.uint8))
    assert "frame_7_colour.png" in refusal(folder)
    write_camera(folder, SMALL, pattern="frame_?.png")
    with open_recording(folder) as recording:
        assert len(recording) == 10
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


def test_other_files_beside_the_pictures_do_not_matter(tmp_path: Path) -> None:
    folder = write_png_folder(tmp_path / "r", STORED)
    (folder / "._frame_3.png").write_bytes(b"resource fork")
    (folder / "notes.txt").write_text("hello")
    (folder / "more").mkdir()
    with open_recording(folder) as recording:
        assert len(recording) == 12


@pytest.mark.parametrize("suffix", [".png", ".tif"])
def test_a_text_that_is_named_like_a_picture_is_refused(tmp_path: Path, suffix: str) -> None:
    folder = write_png_folder(tmp_path / "r", STORED[:0])
    (folder / f"a{suffix}").write_text("this is not a picture at all, whatever its name may say")
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
        ("[camera]\nfx = 5\nfy = 1\ncx = 1\ncy = 1\nunread = ['x']", "unread = 'x'"),
        ("[camera]\nfx = 5\nfy = 1\ncx = 1\ncy = 1\nfps = 0", "fps = 0"),
        ("[camera]\nfx = 5\nfy = 1\ncx = 1\ncy = 1\ntimestamps = 3", "timestamps = 3"),
        ("[camera\nfx = 5", "does not parse"),
        ("", "camera.toml"),
        ("camera = 5", "camera.toml"),
        ("[camera]\nfx = 60\ndistortion = 0.1", "a list of coefficients"),
        ("[camera]\nfx = 60\ndistortion = [0.1, 'k2']", "where a number was expected"),
        (
            "[camera]\nfx = 60\ndistortion = [0.1]\ndistortion_model = 'mei'",
            "'mei' is not supported",
        ),
        ("[camera]\nfx = 60\ndistortion_model = 5", "a text in quotation marks"),
        ("\x00\x01", "does not parse"),
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
    with open_recording(folder) as recording:
        camera = recording.camera
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
    for given in (path, tmp_path):
        with open_recording(given, strict=True) as recording:
            assert len(recording) == 12
            for index in (11, 0, 7):
                np.testing.assert_array_equal(recording.frame(index).depth, STORED[index])


def test_compressed_tiffs_that_tifffile_leaves_to_others_are_read_too(tmp_path: Path) -> None:
    folder = write_png_folder(tmp_path / "r", STORED[:0])
    for k, frame in enumerate(STORED):  # OpenCV writes LZW
        cv2.imwrite(str(folder / f"f{k}.tiff"), frame, [cv2.IMWRITE_TIFF_COMPRESSION, 5])
    write_times(folder, even_times(12))
    with open_recording(folder) as recording:
        for frame in recording:
            np.testing.assert_array_equal(frame.depth, STORED[frame.index])


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
    with open_recording(path) as recording:
        assert len(recording) == 12
        np.testing.assert_array_equal(recording.frame(11).depth, STORED[11])


def test_float_tiffs_are_millimetres_and_may_point_the_other_way(tmp_path: Path) -> None:
    stored = -STORED.astype(np.float32) - 0.25
    stored[:, 0, 0], stored[:, 0, 1] = np.nan, 0.0
    path = write_tiff_stack(tmp_path / "depth.tif", stored)
    assert "unit_mm = -1" in refusal(path)
    write_camera(tmp_path, SMALL, unit_mm=-1.0)
    with open_recording(path) as recording:
        depth = recording.frame(3).depth
    np.testing.assert_array_equal(depth[0, :2], [0.0, 0.0])
    np.testing.assert_array_equal(depth[1:], -stored[3, 1:])


def test_a_cut_tiff_among_whole_ones_is_wholly_unread(tmp_path: Path) -> None:
    folder = write_png_folder(tmp_path / "r", STORED[:0])
    for k, frame in enumerate(STORED):
        tifffile.imwrite(folder / f"f{k}.tif", frame)
    cut(folder / "f3.tif", 0.6)
    cut(folder / "f5.tif", 0.0)
    write_times(folder, even_times(12))
    with open_recording(folder) as recording:
        assert (len(recording), recording.n_whole, recording.truncated) == (12, 10, True)
        for frame in recording:
            expected = np.zeros_like(STORED[0]) if frame.index in (3, 5) else STORED[frame.index]
            np.testing.assert_array_equal(frame.depth, expected)


def test_a_camera_toml_written_from_a_camera_reads_back(tmp_path: Path) -> None:
    folder = write_png_folder(tmp_path / "r", STORED[:2])
    lines = [
        f"{key} = {json.dumps(value)}" for key, value in SMALL.to_dict().items() if key != "source"
    ]
    (folder / "camera.toml").write_text("\n".join(["[camera]", *lines]))
    with open_recording(folder) as recording:
        assert recording.camera.to_dict() | {"source": "stated"} == SMALL.to_dict()
        assert recording.problems == []
