"""CRC-32 of FFV1 slices (RFC 9043), numba kernels. Slow twin: tests/oracles/ffv1.py."""

from __future__ import annotations

import numpy as np
from numba import njit


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
