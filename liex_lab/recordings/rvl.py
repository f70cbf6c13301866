"""RVL, lossless run-length and variable-length code for 16-bit depth (Wilson, ISS 2017).

A picture is pairs of counts (unread pixels, read pixels) followed by the read pixels as steps s
from the one read before, zigzag coded:

    z = (s << 1) ^ (s >> 63).

Every number is written in nibbles of three bits and one that says more follow; eight nibbles make a
32-bit word, the first in the highest bits.
"""

from __future__ import annotations

import struct

import numpy as np
from numba import njit
from numpy.typing import NDArray


@njit(cache=True, inline="always")
def _put(
    value: int, words: NDArray[np.uint32], word: np.uint32, at: int, held: int
) -> tuple[np.uint32, int, int]:
    """Append a number as nibbles of three bits and one that says more follow.

    Eight nibbles make a word. Returns the word that is being filled, where the next one goes, and
    how many nibbles the first holds.
    """
    while True:
        nibble = value & 7
        value >>= 3
        if value:
            nibble |= 8
        word = np.uint32(word << np.uint32(4)) | np.uint32(nibble)
        held += 1
        if held == 8:
            words[at] = word
            at = at + 1
            held = 0
            word = np.uint32(0)
        if value == 0:
            return word, at, held


@njit(cache=True, nogil=True)
def _pack(pixels: NDArray[np.uint16], words: NDArray[np.uint32]) -> int:
    """Encode pixels (n,) into words (at least n + 2) and return how many words were used."""
    n = len(pixels)
    i = 0
    at = 0
    held = 0
    last = np.int64(0)
    word = np.uint32(0)
    while i < n:
        start = i
        while i < n and pixels[i] == 0:
            i += 1
        word, at, held = _put(i - start, words, word, at, held)
        start = i
        while i < n and pixels[i] != 0:
            i += 1
        word, at, held = _put(i - start, words, word, at, held)
        for k in range(start, i):
            here = np.int64(pixels[k])
            step = here - last
            last = here
            word, at, held = _put((step << 1) ^ (step >> 63), words, word, at, held)
    if held:
        words[at] = word << np.uint32(4 * (8 - held))
        at += 1
    return at


def pack_rvl(depth: NDArray[np.uint16]) -> NDArray[np.uint32]:
    """Encode a depth image as RVL words.

    Args:
        depth: (H, W) uint16, 0 where unread.

    Returns:
        (m,) uint32 words.
    """
    pixels = np.ascontiguousarray(depth, np.uint16).ravel()
    # a pixel costs at most 6 nibbles, and every second pixel may add two counts of one nibble each
    words = np.empty(pixels.size + 8, np.uint32)
    return words[: _pack(pixels, words)]


def rvl_message(depth: NDArray[np.uint16]) -> NDArray[np.uint8]:
    """Payload of a compressedDepth RVL message, as ROS writes it and Rerun takes it.

    Rerun's name for it is `EncodedDepthImage`. Before the words stand the configuration (format,
    and two floats of a quantisation that is not used) and width and height.

    Args:
        depth: (H, W) uint16, 0 where unread.

    Returns:
        (m,) uint8 bytes of the payload.
    """
    height, width = depth.shape
    head = struct.pack("<iffII", 0, 0.0, 0.0, width, height)
    return np.concatenate([np.frombuffer(head, np.uint8), pack_rvl(depth).view(np.uint8)])


@njit(cache=True, inline="always")
def _take(
    words: NDArray[np.uint32], word: np.uint32, at: int, held: int
) -> tuple[int, np.uint32, int, int]:
    """The next number, and where it ends; -1 where the words end before it does."""
    value = 0
    shift = 0
    while shift < 33:
        if held == 0:
            if at >= len(words):
                return -1, word, at, held
            word = words[at]
            held = 8
            at += 1
        nibble = int(word >> np.uint32(28))
        word = np.uint32(word << np.uint32(4))
        held -= 1
        value |= (nibble & 7) << shift
        shift += 3
        if nibble < 8:
            return value, word, at, held
    return -1, word, at, held


@njit(cache=True, nogil=True)
def _unpack(words: NDArray[np.uint32], pixels: NDArray[np.uint16]) -> bool:
    """Decode words into pixels (n,), which are zero before; False where the words do not fit n."""
    n = len(pixels)
    i = 0
    at = 0
    held = 0
    last = np.int64(0)
    word = np.uint32(0)
    while i < n:
        count, word, at, held = _take(words, word, at, held)
        if count < 0 or count > n - i:
            return False
        i += count
        count, word, at, held = _take(words, word, at, held)
        if count < 0 or count > n - i:
            return False
        for k in range(i, i + count):
            step, word, at, held = _take(words, word, at, held)
            if step < 0:
                return False
            last += (step >> 1) ^ -(step & 1)
            pixels[k] = np.uint16(last)
        i += count
    return True


def unpack_rvl(data: bytes | memoryview, width: int, height: int) -> NDArray[np.uint16] | None:
    """Decode a depth image out of its RVL words.

    Args:
        data: the words, 32 bits each, little endian, without a header.
        width: columns of the image, px.
        height: rows of the image, px.

    Returns:
        (H, W) uint16; None where the words are cut short or damaged.
    """
    words = np.frombuffer(data, "<u4", len(data) // 4).astype(np.uint32, copy=False)
    pixels = np.zeros(width * height, np.uint16)
    return pixels.reshape(height, width) if _unpack(words, pixels) else None


@njit(cache=True, nogil=True)
def _to_millimetres(depth: NDArray[np.float32], out: NDArray[np.uint16]) -> None:
    for row in range(depth.shape[0]):
        for column in range(depth.shape[1]):
            value = depth[row, column] + np.float32(0.5)
            out[row, column] = np.uint16(value) if 0.0 < value < 65536.0 else np.uint16(0)


def to_millimetres(depth: NDArray[np.float32]) -> NDArray[np.uint16]:
    """Depth rounded to the nearest whole millimetre.

    Args:
        depth: (H, W) float32 mm, 0 where unread.

    Returns:
        (H, W) uint16 mm; 0 stays unread, and what is beyond 65535 mm becomes unread.
    """
    out = np.empty(depth.shape, np.uint16)
    _to_millimetres(np.ascontiguousarray(depth, np.float32), out)
    return out
