"""RVL as a reader of its description would write it: slow, and what the fast code is tested
against.
"""

from collections.abc import Iterable

import numpy as np


def unpack_rvl(words: Iterable[int], n_pixels: int) -> np.ndarray:
    """Nibbles from the high end of each u32; 3 bits of value and one that says more follow."""
    nibbles = (int(word) >> shift & 15 for word in words for shift in range(28, -1, -4))

    def number() -> int:
        value, shift, nibble = 0, 0, 8
        while nibble & 8:
            nibble = next(nibbles)
            value, shift = value | (nibble & 7) << shift, shift + 3
        return value

    out: list[int] = []
    last = 0
    while len(out) < n_pixels:
        out += [0] * number()
        for _ in range(number()):
            step = number()
            last += (step >> 1) ^ -(step & 1)
            out.append(last)
    return np.array(out, np.uint16)
