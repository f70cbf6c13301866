"""The 16z depth codec of PrimeSense recordings: delta and run-length coding in half bytes (numba).

A stream begins with a whole number (u16) and goes on with bytes. 0xE1 to 0xEE: 2 to 28 pixels like
the last one (0xEF: 30); 0xFF: a wide step follows; any other byte is two steps down, each counted
from 6, where 15 in the low half says that a wide step follows and 13 that there is none. A wide
step is a byte from 0x80 on, counted from 192, or else a whole number of 15 bits, high byte first.
The numbers are depths (`16zP`) or indices into a table of the frame's own depths (`16zT`). What it
means is OpenNI's decoder; tests/oracles/oni.py is the slow twin.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

WORST_BYTES_A_PIXEL = 3  # a wide step for every pixel: its mark, and two bytes
_RUN = 0xE0
_WIDE = 0xFF
_LARGEST = 0x7FFF  # the largest whole number the code can hold after the first
_LONGEST_RUN = 15  # pairs


@njit(cache=True, nogil=True)
def _unpack(stream, table, out):
    """Decode a stream into table[number] for each of its numbers.

    Args:
        stream: (m,) uint8.
        table: (k,) float32 mm, the depth of each number.
        out: (n,) float32 mm, written.

    Returns:
        False where the stream and the number of pixels or the table do not fit one another.
    """
    n_bytes = len(stream)
    n_pixels = len(out)
    n_table = len(table)
    if n_bytes < 2 or n_pixels < 1:
        return False
    value = np.int64(stream[0]) | np.int64(stream[1]) << 8
    if value >= n_table:
        return False
    last = table[value]
    out[0] = last
    at = 2
    i = 1
    while at < n_bytes:
        byte = np.int64(stream[at])
        at += 1
        if _RUN <= byte < _WIDE:
            end = i + 2 * (byte - _RUN)
            if end > n_pixels:
                return False
            while i < end:
                out[i] = last
                i += 1
            continue
        low = 15
        if byte != _WIDE:
            value = (value - (byte >> 4) + 6) & 0xFFFF
            if i >= n_pixels or value >= n_table:
                return False
            last = table[value]
            out[i] = last
            i += 1
            low = int(byte & 15)
        if low == 13:
            continue
        if low != 15:
            value = (value - low + 6) & 0xFFFF
        elif at < n_bytes and stream[at] & 0x80:
            value = (value - np.int64(stream[at]) + 192) & 0xFFFF
            at += 1
        elif at + 1 < n_bytes:
            value = np.int64(stream[at]) << 8 | np.int64(stream[at + 1])
            at += 2
        else:
            return False
        if i >= n_pixels or value >= n_table:
            return False
        last = table[value]
        out[i] = last
        i += 1
    return i == n_pixels


@njit(cache=True, nogil=True)
def _pack(numbers, out):
    """Encode numbers; the inverse of `_unpack`.

    Args:
        numbers: (n,) uint16, depths or indices into a table.
        out: (3 n + 2,) uint8, written.

    Returns:
        How many bytes were used; 0 where a number is too large for the code.
    """
    value = np.int64(numbers[0])
    out[0] = value & 0xFF
    out[1] = value >> 8
    at = 2
    run = 0
    half = -1
    for i in range(1, len(numbers)):
        number = np.int64(numbers[i])
        step = value - number
        value = number
        near = -6 <= step <= 6
        if near and half < 0:
            half = int(step + 6)
            continue
        if near and half == 6 and step == 0:
            run += 1
            half = -1
            if run == _LONGEST_RUN:
                out[at] = _RUN + run
                at += 1
                run = 0
            continue
        if run:  # it came before whatever comes now
            out[at] = _RUN + run
            at += 1
            run = 0
        if near:
            out[at] = half << 4 | (step + 6)
            at += 1
            half = -1
            continue
        out[at] = _WIDE if half < 0 else half << 4 | 15
        half = -1
        if -64 <= step <= 62:
            out[at + 1] = step + 192
            at += 2
        elif number <= _LARGEST:
            out[at + 1] = number >> 8
            out[at + 2] = number & 0xFF
            at += 3
        else:
            return 0
    # the run was there before the half that waits for its other half: OpenNI2 has them the wrong
    # way round, and so loses the last pixels of a frame
    if run:
        out[at] = _RUN + run
        at += 1
    if half >= 0:
        out[at] = half << 4 | 13
        at += 1
    return at


@njit(cache=True, nogil=True)
def _tabulate(pixels, rank, table, numbers):
    """The depths that occur, sorted, and each pixel's index among them.

    Args:
        pixels: (n,) uint16 stored depths.
        rank: (65536,) uint16 zeros, and zeros again afterwards.
        table: (65536,) uint16, written: the depths that occur, ascending.
        numbers: (n,) uint16, written: index of each pixel's depth in the table.

    Returns:
        How many depths occur.
    """
    for pixel in pixels:
        rank[pixel] = 1
    n = 0
    for depth in range(len(rank)):
        if rank[depth]:
            table[n] = depth
            rank[depth] = n
            n += 1
    for i in range(len(pixels)):
        numbers[i] = rank[pixels[i]]
    for k in range(n):
        rank[table[k]] = 0
    return n


def unpack_16z(
    payload: NDArray[np.uint8], meaning: NDArray[np.float32], n_pixels: int, embedded_table: bool
) -> NDArray[np.float32] | None:
    """Decode a packed frame as depth.

    Args:
        payload: (m,) uint8 bytes of the frame, a table before them for `16zT`.
        meaning: (65536,) float32 mm, the depth that each stored value stands for.
        n_pixels: how many pixels the frame has.
        embedded_table: True for `16zT`, False for `16zP`.

    Returns:
        (n_pixels,) float32 mm; None where it is damaged or has another number of pixels.
    """
    table = meaning
    if embedded_table:
        n_table = int(payload[0]) | int(payload[1]) << 8 if len(payload) >= 2 else 0
        start = 2 + 2 * n_table
        if len(payload) < start:
            return None
        table = meaning[payload[2:start].view("<u2")]
        payload = payload[start:]
    depth = np.empty(n_pixels, np.float32)
    return depth if _unpack(payload, table, depth) else None


def pack_16z(pixels: NDArray[np.uint16], embedded_table: bool) -> bytes | None:
    """Encode pixels as one frame.

    Args:
        pixels: (n,) uint16 stored depths.
        embedded_table: True for `16zT`, False for `16zP`.

    Returns:
        The bytes; None where depths are too many or too large for the code.
    """
    if not embedded_table:
        stream = np.empty(WORST_BYTES_A_PIXEL * pixels.size + 2, np.uint8)
        return stream[:n].tobytes() if (n := _pack(pixels, stream)) else None
    table = np.empty(1 << 16, np.uint16)
    numbers = np.empty_like(pixels)
    n_table = _tabulate(pixels, np.zeros(1 << 16, np.uint16), table, numbers)
    stream = np.empty(WORST_BYTES_A_PIXEL * pixels.size + 2, np.uint8)
    if n_table > 0xFFFF or not (n := _pack(numbers, stream)):
        return None
    return np.uint16(n_table).tobytes() + table[:n_table].tobytes() + stream[:n].tobytes()
