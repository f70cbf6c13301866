"""Numba kernels: rectification, and the codecs RVL, 16z (OpenNI) and LZF (PCL).

*Rectification* (table lookup, forward splatting with a z-buffer, hole closing) is serial and
releases the GIL: the output is scattered over the image, and two threads in parallel cost more than
they save (`gather` of 1024 x 1024 pixels takes about 2 ms, `lift` and `close` 6 ms).

*RVL* (Wilson, ISS 2017): pairs of counts (unread pixels, read pixels), followed by the read pixels
as steps s from the previous one, zigzag coded, z = (s << 1) ^ (s >> 63). Every number is written in
nibbles of three bits and a continuation bit; eight nibbles make a 32-bit word, the first in the
highest bits.

*16z*: a stream begins with a whole number (u16), followed by bytes. 0xE1 to 0xEE: 2 to 28 pixels
equal to the last one (0xEF: 30); 0xFF: a wide step follows; any other byte is two downward steps,
each counted from 6, where 15 in the low half means that a wide step follows and 13 that there is no
second step. A wide step is a byte from 0x80 on, counted from 192, or else a whole number of 15
bits, high byte first. The numbers are depths (`16zP`) or indices into a table of the frame's own
depths (`16zT`). OpenNI's decoder is the reference.

Slow twins: tests/oracles/oni.py and lzf.py.
"""

import struct

import numpy as np
from numpy.typing import NDArray

from liex_lab.runtime.kernels import kernel

UNREAD = np.float32(1e30)  # marks a pixel without a reading; any reading overrides it
_ONE = np.float32(1.0)
_HALF = np.float32(0.5)
_FOUR = np.float32(4.0)
# depths are finite; without infinities and signed zeros the compiler can process eight pixels
# at once
_FAST = {"nnan", "ninf", "nsz", "arcp", "contract", "afn", "reassoc"}


@kernel(nogil=True)
def gather(depth, source, out):
    """For every pixel of the rectified image, copy the depth of one pixel of the original image.

    Args:
        depth: (h, w) float32 mm.
        source: (H, W) int32, row * w + column in `depth`; -1 if absent.
        out: (H, W) float32 mm, written; 0 where source is -1.
    """
    stored = depth.ravel()
    for row in range(out.shape[0]):
        for column in range(out.shape[1]):
            k = source[row, column]
            out[row, column] = stored[k] if k >= 0 else np.float32(0.0)


@kernel(nogil=True, fastmath=_FAST)
def lift_row(depth, law, u, v, deep):
    """Pixels and depths of the readings of one row after correction for refraction.

    Where k z > 1 the ray meets the surface, and the depth d below it solves

        a d^2 + (b - c z) d = k z - 1,

    in the form of the quadratic formula without cancellation.

    Args:
        depth: (W,) float32 mm, as reported by the camera.
        law: (13, W) float32, see `rectify.pixel_laws`.
        u: (W,) int32, written: new column, px.
        v: (W,) int32, written: new row, px.
        deep: (W,) float32, written: new depth, mm.
    """
    for column in range(depth.size):
        along = law[3, column] * depth[column]  # 1 where the ray meets the water
        wet = max(along - _ONE, np.float32(0.0))
        b = law[1, column] - law[2, column] * depth[column]
        below = (wet + wet) / (b + np.sqrt(b * b + _FOUR * law[0, column] * wet))
        dry = min(along, _ONE)
        z = law[12, column] + dry * law[6, column] + below * law[9, column]
        deep[column] = z
        u[column] = int(
            np.floor((law[10, column] + dry * law[4, column] + below * law[7, column]) / z + _HALF)
        )
        v[column] = int(
            np.floor((law[11, column] + dry * law[5, column] + below * law[8, column]) / z + _HALF)
        )


@kernel(nogil=True)
def lift(depth, laws, out):
    """Splat every pixel of a depth image to its corrected position; the nearest reading wins.

    A pixel without a reading moves like the previous reading in its row, and writes `UNREAD`.

    Args:
        depth: (H, W) float32 mm, 0 where unread.
        laws: (H, 13, W) float32, see `rectify.pixel_laws`.
        out: (H, W) float32 mm, written; infinite where nothing was splatted.
    """
    n_rows, n_columns = depth.shape
    u = np.empty(n_columns, np.int32)
    v = np.empty(n_columns, np.int32)
    deep = np.empty(n_columns, np.float32)
    out[:] = np.inf
    for row in range(n_rows):
        lift_row(depth[row], laws[row], u, v, deep)
        right = 0
        down = 0
        for column in range(n_columns):
            z = deep[column]
            if depth[row, column] > 0:
                right = u[column] - column
                down = v[column] - row
            else:
                z = UNREAD
            i = row + down
            j = column + right
            if 0 <= i < n_rows and 0 <= j < n_columns and z < out[i, j]:
                out[i, j] = z


@kernel(nogil=True)
def close(lifted, out):
    """Fill holes between two readings, side by side or one above the other, with the farther one.

    Only pixels that received nothing are filled; unread pixels stay unread. The farther reading is
    used so that outlines do not grow.

    Args:
        lifted: (H, W) float32 mm, `UNREAD` where unread, infinite where nothing was splatted.
        out: (H, W) float32 mm, written; 0 where unread.
    """
    n_rows, n_columns = lifted.shape
    for row in range(n_rows):
        for column in range(n_columns):
            z = lifted[row, column]
            if z >= UNREAD:
                nothing_went = z > UNREAD
                z = np.float32(0.0)
                if nothing_went and 0 < column < n_columns - 1:
                    z = _between(lifted[row, column - 1], lifted[row, column + 1])
                if nothing_went and z == 0 and 0 < row < n_rows - 1:
                    z = _between(lifted[row - 1, column], lifted[row + 1, column])
            out[row, column] = z


@kernel(nogil=True)
def _between(one, other):
    """The farther of two readings, mm; 0 unless both are readings."""
    return max(one, other) if one < UNREAD and other < UNREAD else np.float32(0.0)


# RVL, lossless run-length and variable-length code for 16-bit depth (Wilson, ISS 2017).


@kernel(inline="always")
def _put(
    value: int, words: NDArray[np.uint32], word: np.uint32, at: int, held: int
) -> tuple[np.uint32, int, int]:
    """Append a number as nibbles of three bits and a continuation bit.

    Eight nibbles make a word. Returns the word being filled, the index of the next word, and the
    number of nibbles in the word being filled.
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


@kernel(nogil=True)
def _pack(pixels: NDArray[np.uint16], words: NDArray[np.uint32]) -> int:
    """Encode pixels (n,) into words (at least n + 2) and return the number of words used."""
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
    # a pixel needs at most 6 nibbles, and every second pixel may add two counts of one nibble each
    words = np.empty(pixels.size + 8, np.uint32)
    return words[: _pack(pixels, words)]


def rvl_message(depth: NDArray[np.uint16]) -> NDArray[np.uint8]:
    """Payload of a compressedDepth RVL message of ROS, which Rerun also accepts.

    Rerun's name for it is `EncodedDepthImage`. A header precedes the words: the format, two floats
    of an unused quantisation, width and height.

    Args:
        depth: (H, W) uint16, 0 where unread.

    Returns:
        (m,) uint8 bytes of the payload.
    """
    height, width = depth.shape
    head = struct.pack("<iffII", 0, 0.0, 0.0, width, height)
    return np.concatenate([np.frombuffer(head, np.uint8), pack_rvl(depth).view(np.uint8)])


@kernel(inline="always")
def _take(
    words: NDArray[np.uint32], word: np.uint32, at: int, held: int
) -> tuple[int, np.uint32, int, int]:
    """The next number and the state after it; -1 if the words end too early."""
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


@kernel(nogil=True)
def _unpack(words: NDArray[np.uint32], pixels: NDArray[np.uint16]) -> bool:
    """Decode words into pixels (n,), which must be zero; False if the words do not match n."""
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
    """Decode a depth image from its RVL words.

    Args:
        data: the words, 32 bits each, little endian, without a header.
        width: columns of the image, px.
        height: rows of the image, px.

    Returns:
        (H, W) uint16; None if the words are cut short or damaged.
    """
    words = np.frombuffer(data, "<u4", len(data) // 4).astype(np.uint32, copy=False)
    pixels = np.zeros(width * height, np.uint16)
    return pixels.reshape(height, width) if _unpack(words, pixels) else None


@kernel(nogil=True)
def _to_millimetres(depth: NDArray[np.float32], out: NDArray[np.uint16]) -> None:
    for row in range(depth.shape[0]):
        for column in range(depth.shape[1]):
            value = depth[row, column] + np.float32(0.5)
            out[row, column] = np.uint16(value) if 0.0 < value < 65536.0 else np.uint16(0)


def to_millimetres(depth: NDArray[np.float32]) -> NDArray[np.uint16]:
    """Round depth to the nearest whole millimetre.

    Args:
        depth: (H, W) float32 mm, 0 where unread.

    Returns:
        (H, W) uint16 mm; 0 stays unread, and depths beyond 65535 mm become unread.
    """
    out = np.empty(depth.shape, np.uint16)
    _to_millimetres(np.ascontiguousarray(depth, np.float32), out)
    return out


# The 16z depth codec of PrimeSense recordings: delta and run-length coding in half bytes (numba).


WORST_BYTES_A_PIXEL = 3  # a wide step for every pixel: its marker and two bytes
_RUN = 0xE0
_WIDE = 0xFF


@kernel(nogil=True)
def _oni_kernels_unpack(stream, table, out):
    """Decode a stream of numbers, and map each to its depth by a table.

    Args:
        stream: (m,) uint8.
        table: (k,) float32 mm, the depth of each number.
        out: (n,) float32 mm, written.

    Returns:
        False if the stream does not match the number of pixels or the table.
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
        payload: (m,) uint8 bytes of the frame, preceded by a table for `16zT`.
        meaning: (65536,) float32 mm, the depth of each stored value.
        n_pixels: number of pixels of the frame.
        embedded_table: True for `16zT`, False for `16zP`.

    Returns:
        (n_pixels,) float32 mm; None if it is damaged or has another number of pixels.
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
    return depth if _oni_kernels_unpack(payload, table, depth) else None


# LZF decompression (Lehmann's LibLZF), used by PCL for its images: numba kernel.


@kernel()
def unpack_lzf(packed, out):
    """Decompress LZF data.

    A byte below 32 is followed by that many literal bytes plus one. Any other byte begins a copy
    from earlier output: its upper 3 bits are the length minus 2 (7: the next byte is added), its
    lower 5 bits and the next byte the distance minus 1.

    Args:
        packed: (m,) uint8.
        out: (n,) uint8, written.

    Returns:
        Number of bytes written; -1 if the data are invalid.
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
        for k in range(n):  # one by one: a copy may overlap its own output
            out[done + k] = out[source + k]
        done += n
    return done
