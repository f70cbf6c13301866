"""Numbers that depth is stored in: signed, big endian, and the values that mean unread."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
import tifffile
from hypothesis import given
from hypothesis import strategies as st

from liex_lab.recordings import open_recording
from tests.recordings.asking import refusal
from tests.recordings.picture_writers import write_folder, write_pgm
from tests.recordings.writers import (
    depth_frames,
    write_camera,
    write_moseq_folder,
    write_png_folder,
    write_tiff_stack,
)


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
        with open_recording(path) as recording:
            np.testing.assert_array_equal([frame.depth for frame in recording], depth)


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
        with open_recording(folder) as recording:
            assert recording.frame(0).depth[0, 0] == pytest.approx(expected)


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
