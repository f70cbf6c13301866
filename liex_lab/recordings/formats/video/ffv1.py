"""FFV1 decoding (RFC 9043) of 16-bit grey pictures with PyAV; the slices' CRC-32 is checked.

The decoder does not look at the check sums, so damage would come out as depth. Slow twin:
tests/oracles/ffv1.py.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import av
import numpy as np
from numba import njit
from numpy.typing import NDArray

from liex_lab.errors import RecordingError
from liex_lab.recordings.formats.images.stack import not_depth_error

# a picture that needs none before it begins with at least this: its first coded bit is 1
_KEY = 0x7F80


@njit(cache=True)
def crc_table():
    """Table of CRC-32 remainders of every byte, polynomial 0x04C11DB7, high bit first (FFV1).

    Returns:
        (256,) uint32.
    """
    table = np.empty(256, np.uint32)
    for byte in range(256):
        rest = byte << 24
        for _ in range(8):
            rest = ((rest << 1) ^ 0x04C11DB7 if rest & 0x80000000 else rest << 1) & 0xFFFFFFFF
        table[byte] = rest
    return table


@njit(cache=True)
def slices_agree(data, table):
    """Whether the slices of a picture, found from its last byte backwards, agree with their CRC-32.

    Each slice ends in its length (3 bytes), an error flag (1) and a check sum (4) that makes the
    whole slice's CRC 0.

    Args:
        data: (m,) uint8 bytes of the picture.
        table: (256,) uint32 of `crc_table`.

    Returns:
        True where all agree.
    """
    end = data.size
    while end > 8:
        size = (int(data[end - 8]) << 16) + (int(data[end - 7]) << 8) + int(data[end - 6])
        start = end - 8 - size
        if start < 0:
            return False
        rest = 0
        for k in range(start, end):
            rest = ((rest << 8) & 0xFFFFFFFF) ^ int(table[(rest >> 24) ^ int(data[k])])
        if rest != 0:
            return False
        end = start
    return end == 0


def is_key(head: bytes) -> bool:
    """Whether a picture can be decoded by itself: its first coded bit is 1.

    Args:
        head: its first two bytes.

    Returns:
        True for a key picture.
    """
    return int.from_bytes(head[:2], "big") >= _KEY


class Ffv1:
    """Decoder of one FFV1 stream of 16-bit grey pictures, fed in order from a key picture on."""

    def __init__(self, width: int, height: int, private: bytes) -> None:
        """Start the decoder.

        Args:
            width: columns of the pictures, px.
            height: rows of the pictures, px.
            private: the codec's own header from the container; empty for none.
        """
        self._size = (width, height)
        self._private = private
        self._table = crc_table()
        self._summed = False  # whether this stream has check sums; its pictures tell
        self._codec = self.fresh()

    def fresh(self) -> Any:
        """A decoder that has been given no picture."""
        codec: Any = av.CodecContext.create("ffv1", "r")
        codec.width, codec.height = self._size
        codec.extradata = self._private or None
        return codec

    def decode(self, data: bytes) -> NDArray[np.uint16] | None:
        """Decode one picture; after a damaged one, the next must be a key picture.

        Args:
            data: the bytes of the picture.

        Returns:
            (H, W) uint16 stored values; None where it is damaged or not 16-bit grey.
        """
        agree = slices_agree(np.frombuffer(data, np.uint8), self._table)
        self._summed = self._summed or agree  # chance agrees once in four thousand million times
        if self._summed and not agree:
            return None
        try:
            frames = self._codec.decode(av.Packet(data))
        except av.FFmpegError:
            self._codec = self.fresh()
            return None
        if len(frames) != 1:
            return None
        if not frames[0].format.name.startswith("gray1"):
            return None
        picture: NDArray[Any] = frames[0].to_ndarray()
        return picture.astype(np.uint16, copy=False)


def require_depth(stream: Ffv1, keys: Iterable[bytes], where: str) -> None:
    """Refuse a stream that does not decode to 16-bit grey.

    Args:
        stream: its decoder, which is not changed.
        keys: bytes of some key pictures; the first that decodes decides.
        where: the file, for the sentence.

    Raises:
        RecordingError: none of the keys decodes, or one is something else than 16-bit grey.
    """
    for data in keys:
        try:
            frames = stream.fresh().decode(av.Packet(data))
        except av.FFmpegError:
            continue
        for frame in frames:
            if frame.format.name.startswith("gray1"):
                return
            found = f"{frame.format.components[0].bits}-bit {frame.format.name}"
            raise not_depth_error(where, found, frame.width, frame.height)
    raise RecordingError(f"none of the first pictures of {where} can be decoded; copy it again")
