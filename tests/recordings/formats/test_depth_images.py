"""Sizes that cannot be, in every kind of message: no picture, and no memory asked for."""

from __future__ import annotations

import struct

import numpy as np
import pytest

from liex_lab.recordings.formats.messages.messages import (
    DepthMessage,
    PackedPicture,
    PointCloud,
    RawPicture,
)
from liex_lab.recordings.formats.messages.parsers import (
    LARGEST_PICTURE,
    decode_message,
    picture_size,
)
from tests.recordings.writers import SMALL

PIXELS = bytes(2 * 64 * 48)
COLUMNS = {"x": (0, "<f4"), "y": (4, "<f4"), "z": (8, "<f4")}
HUGE = 1 << 31


def png_head(width: int, height: int) -> bytes:
    return b"\x89PNG\r\n\x1a\n" + struct.pack(
        ">I4sIIBBBBB", 13, b"IHDR", width, height, 16, 0, 0, 0, 0
    )


def rvl(width: int, height: int) -> bytes:
    return bytes(12) + struct.pack("<II", width, height) + bytes(64)


@pytest.mark.parametrize(
    "message",
    [
        RawPicture(1, "", HUGE, HUGE, "16UC1", 128, False, PIXELS),
        RawPicture(1, "", 0, 48, "16UC1", 128, False, PIXELS),
        RawPicture(1, "", -64, -48, "16UC1", 128, False, PIXELS),
        RawPicture(1, "", 64, 48, "rgb8", 192, False, PIXELS),
        PackedPicture(1, "", "png", png_head(HUGE - 1, HUGE - 1)),
        PackedPicture(1, "", "png", png_head(LARGEST_PICTURE, 2)),
        PackedPicture(1, "", "png", b""),
        PackedPicture(1, "", "jpeg", b"\xff\xd8\xff" + bytes(99)),
        PackedPicture(1, "", "16UC1; compressedDepth rvl", rvl(HUGE, HUGE)),
        PackedPicture(1, "", "16UC1; compressedDepth rvl", b"short"),
        PackedPicture(1, "", "16UC1; compressedDepth", b"short"),
        PointCloud(1, "", HUGE, 1, COLUMNS, 12, 0, PIXELS),
        PointCloud(1, "", 0, 0, COLUMNS, 12, 0, PIXELS),
        PointCloud(1, "", 64, 48, {"x": (0, "<f4")}, 12, 0, PIXELS),
    ],
    ids=str,
)
def test_what_cannot_be_a_depth_picture_is_none(message: DepthMessage) -> None:
    assert picture_size(message) is None
    assert decode_message(message, SMALL, 1.0, 1.0) is None


@pytest.mark.parametrize(
    "message",
    [
        RawPicture(1, "", 64, 48, "16UC1", 128, False, PIXELS[:-1]),
        RawPicture(1, "", 64, 48, "16UC1", 126, False, PIXELS),
        RawPicture(1, "", 64, 48, "16UC1", HUGE, False, PIXELS),
        RawPicture(1, "", 48, 64, "16UC1", 96, False, PIXELS),
        PackedPicture(1, "", "png", png_head(64, 48)),
        PackedPicture(1, "", "16UC1; compressedDepth rvl", rvl(64, 48)[:24]),
        PointCloud(1, "", 64, 48, COLUMNS, 12, 768, PIXELS),
        PointCloud(1, "", 64, 48, COLUMNS, 8, 512, bytes(64 * 48 * 8)),
        PointCloud(1, "", 9, 1, COLUMNS, 12, 0, bytes(100)),
    ],
    ids=str,
)
def test_a_picture_that_is_not_all_there_is_none(message: DepthMessage) -> None:
    assert decode_message(message, SMALL, 1.0, 1.0) is None


def test_the_padding_of_the_last_row_may_be_left_out() -> None:
    rows = np.zeros((48, 70), np.uint16)
    rows[:, :64] = np.arange(48 * 64).reshape(48, 64)
    message = RawPicture(1, "", 64, 48, "16UC1", 140, False, rows.tobytes()[:-12])
    np.testing.assert_array_equal(decode_message(message, SMALL, 1.0, 1.0), rows[:, :64])
