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
