"""Infrared looks like depth to a reader of 16-bit images: no container lets it pass for depth."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from liex_lab.recordings.camera_file import is_infrared
from tests.recordings.asking import depths_in, facts_in, refusal
from tests.recordings.video_writers import write_avi, write_mkv
from tests.recordings.writers import SMALL, depth_frames, even_times, write_png_folder

STORED = depth_frames(6)


@pytest.mark.parametrize(
    "name",
    [
        "ir",
        "IR",
        "Infrared",
        "PASSIVE_IR",
        "mouse_ir",
        "ir-2",
        "infra1",
        "/camera/ir/image_raw",
        "IRImage",
        "m07.InfraRed",
        "/device_0/sensor_0/Infrared_1/image/data",
        "passiveIR",
    ],
)
def test_a_word_for_infrared_is_recognised_in_a_name(name: str) -> None:
    assert is_infrared(name)


@pytest.mark.parametrize(
    "name",
    [
        "circle",
        "mirror",
        "first",
        "birdie",
        "Irene",
        "iris",
        "air",
        "mouse_third",
        "infrastructure",
        "depth",
        "depth_to_ir/image_raw",
        "/camera/depth/image_rect_raw",
        "ir_depth",
        "",
    ],
)
def test_letters_that_are_no_word_for_infrared_do_not_count(name: str) -> None:
    assert not is_infrared(name)


@pytest.mark.parametrize("write", [write_avi, write_mkv])
@pytest.mark.parametrize("name", ["ir", "infrared", "mouse_IR"])
def test_a_video_called_infrared_is_refused_also_alone_in_a_folder(
    tmp_path: Path, name: str, write: Callable[..., Path]
) -> None:
    suffix = ".avi" if write is write_avi else ".mkv"
    # the writer halves what is not DEPTH
    path = write(tmp_path / "session" / f"{name}{suffix}", 2 * STORED, titles=("",))
    for given in (path, path.parent):
        assert "holds infrared" in refusal(given, camera=SMALL)
    for other in ("circle", "first", "birdie"):
        path = path.rename(path.with_stem(other))
        np.testing.assert_array_equal(depths_in(path, camera=SMALL)[2], STORED[2])


@pytest.mark.parametrize("title", ["IR", "INFRARED", "PASSIVE_IR", "Infrared 1"])
def test_a_track_titled_infrared_is_no_depth(tmp_path: Path, title: str) -> None:
    for path in (
        write_mkv(tmp_path / "a.mkv", STORED, titles=(title,)),
        write_avi(tmp_path / "a.avi", STORED, titles=(title,)),
    ):
        assert "infrared" in refusal(path, camera=SMALL)


@pytest.mark.parametrize("titles", [("IR", "DEPTH"), ("DEPTH", "IR"), ("INFRARED", "DEPTH")])
def test_depth_is_taken_wherever_it_stands(tmp_path: Path, titles: tuple[str, ...]) -> None:
    for path in (
        write_mkv(tmp_path / "mouse_ir.mkv", STORED, titles=titles),
        write_avi(tmp_path / "mouse.avi", STORED, titles=titles),
    ):
        np.testing.assert_array_equal(depths_in(path, camera=SMALL)[2], STORED[2])


def test_of_untitled_tracks_the_first_is_taken_as_the_azure_recorder_writes_them(
    tmp_path: Path,
) -> None:
    path = write_mkv(tmp_path / "a.mkv", 2 * STORED, titles=("", ""))
    np.testing.assert_array_equal(depths_in(path, camera=SMALL)[2], STORED[2])


def test_a_folder_of_infrared_images_is_refused_and_depth_beside_infrared_is_read(
    tmp_path: Path,
) -> None:
    times = even_times(len(STORED))
    for name in ("ir", "Infrared", "m07_IR"):
        folder = write_png_folder(tmp_path / name, STORED, SMALL, times)
        assert "holds infrared" in refusal(folder)
    for name in ("circle", "mirror"):
        assert len(facts_in(write_png_folder(tmp_path / name, STORED, SMALL, times))) == len(STORED)
    both = write_png_folder(tmp_path / "both", STORED, SMALL, times)
    for k, picture in enumerate(sorted(both.glob("*.png"))):
        picture.with_name(f"ir_{k:04d}.png").write_bytes(picture.read_bytes())
    assert len(facts_in(both)) == len(STORED)
    for picture in both.glob("*.png"):
        if not picture.name.startswith("ir"):
            picture.unlink()
    assert "holds infrared" in refusal(both)


def test_a_raw_file_called_infrared_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "ir.dat"
    path.write_bytes(STORED.astype("<u2").tobytes())
    assert "holds infrared" in refusal(path, camera=SMALL)
