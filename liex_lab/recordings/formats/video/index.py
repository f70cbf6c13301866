"""Index of a depth track in a video file: where its pictures lie, before any of them is decoded."""

from __future__ import annotations

import struct
from dataclasses import dataclass, field
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

FFV1 = "ffv1"
RAW = {
    "b16g": ">u2",
    "Y16 ": "<u2",
    "Y16": "<u2",
}  # code of uncompressed 16-bit grey: how its numbers are stored
BITMAP_HEADER = struct.Struct(
    "<IiiHH4s5I"
)  # Windows' BITMAPINFOHEADER, in AVI and in Matroska alike


@dataclass
class DepthTrack:
    """What an AVI or a Matroska file states of its depth pictures.

    Attributes:
        codec: `FFV1`, a key of `RAW`, or the name of one that is not read.
        width: columns of the pictures, px.
        height: rows of the pictures, px.
        private: the codec's own header.
        offsets: (n,) positions of the pictures that lie whole in the file, bytes.
        sizes: (n,) their sizes, bytes.
        times_ns: (n,) their times, ns.
        even: True where the times are steps of a constant rate, for the container knows no others.
        whole: True where the file ends where it should and holds as many pictures as it says.
        title: title of the track.
        tags: tags of the whole file and of the track.
        attachments: bytes of attached files by name.
        session_start: ISO 8601 where the file states it.
    """

    codec: str = ""
    width: int = 0
    height: int = 0
    private: bytes = b""
    offsets: list[int] = field(default_factory=list)
    sizes: list[int] = field(default_factory=list)
    times_ns: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    even: bool = False
    whole: bool = True
    title: str = ""
    tags: dict[str, str] = field(default_factory=dict)
    attachments: dict[str, bytes] = field(default_factory=dict)
    session_start: str | None = None

    def take_bitmap_header(self, data: bytes) -> None:
        """Take size, codec and private data out of a BITMAPINFOHEADER and what follows it.

        Args:
            data: the bytes of the header; too few change nothing.
        """
        if len(data) < BITMAP_HEADER.size:
            return
        _, width, height, _, bits, code, *_ = BITMAP_HEADER.unpack_from(data)
        # negative: rows from the top, as ours are
        self.width = max(width, 0)
        self.height = abs(height)
        name = code.decode("ascii", "replace")
        self.codec = FFV1 if name.upper() == "FFV1" else name.strip("\0") or f"{bits}-bit bitmaps"
        self.private = data[BITMAP_HEADER.size :]


def even_times(slots: list[int], scale: int, rate: int) -> NDArray[np.int64]:
    """Stamps of pictures in some slots of a constant rate, exactly (as fractions).

    Args:
        slots: (n,) number of each picture's slot, from 0.
        scale: denominator of the rate.
        rate: numerator of the rate, so that it is rate / scale per second.

    Returns:
        (n,) int64 ns.
    """
    step = Fraction(10**9 * scale, rate)
    return np.array([round(slot * step) for slot in slots], np.int64)
