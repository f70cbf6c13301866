"""LZF decompression (Lehmann's LibLZF), in which PCL packs its pictures: numba kernel.

Its slow twin is tests/oracles/lzf.py.
"""

from __future__ import annotations

from numba import njit


@njit(cache=True)
def unpack_lzf(packed, out):
    """Decompress LZF data.

    A byte below 32 is followed by that many literal bytes and one more. Any other byte begins a
    copy from what is out already: its upper 3 bits are the length less 2 (7: the next byte adds to
    it), its lower 5 bits and the next byte the distance less 1.

    Args:
        packed: (m,) uint8.
        out: (n,) uint8, written.

    Returns:
        How many bytes were written; -1 where the data make no sense.
    """
    at = 0
    done = 0
    while at < packed.size:
        control = int(packed[at])
        at += 1
        if control < 32:
            n = control + 1
            if at + n > packed.size or done + n > out.size:
                return -1
            for k in range(n):
                out[done + k] = packed[at + k]
            at += n
            done += n
            continue
        n = (control >> 5) + 2
        if n == 9:
            if at >= packed.size:
                return -1
            n += int(packed[at])
            at += 1
        if at >= packed.size:
            return -1
        source = done - ((control & 31) << 8) - int(packed[at]) - 1
        at += 1
        if source < 0 or done + n > out.size:
            return -1
        for k in range(n):  # one by one: a copy may overlap what it makes
            out[done + k] = out[source + k]
        done += n
    return done
