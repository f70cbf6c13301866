"""PNG pictures: 16-bit grey or 8-bit colour, with size, completeness and chunk CRCs checked.

OpenCV decodes the pixels, after all CRCs agree: it would find damage too, but write about it into
the terminal.
"""

from __future__ import annotations

import struct
import zlib
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from liex_lab.errors import RecordingError
from liex_lab.recordings.formats.images.stack import (
    DAMAGED,
    FileStack,
    Look,
    not_depth_error,
    open_files,
    something_else,
    too_large,
)
from liex_lab.runtime.progress import Progress

_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_END = struct.pack(">I", 0) + b"IEND\xaeB`\x82"  # the last chunk: no data, its name, its CRC
_HEAD_BYTES = 33  # signature and the whole header chunk with its CRC
_SIZE_BYTES = 26  # what of it says size and kind
_COLOURS = {
    0: "grey",
    2: "colour",
    3: "palette colour",
    4: "grey with transparency",
    6: "colour with transparency",
}


def decode_png(data: NDArray[np.uint8], colour: bool = False) -> NDArray[Any] | None:
    """Pixels of a PNG.

    Args:
        data: (m,) uint8 bytes of the file.
        colour: 8-bit colour is expected instead of 16-bit grey.

    Returns:
        (H, W) uint16, or with colour (H, W, 3) uint8 (blue, green, red); None where it does not
        decode to that.
    """
    import cv2

    if not _sums_agree(data):  # the decoder would find it too, and write about it into the terminal
        return None
    try:
        picture: NDArray[Any] | None = cv2.imdecode(data, cv2.IMREAD_UNCHANGED)
    except cv2.error:  # of an empty buffer, and of sizes beyond OpenCV's own limits
        return None
    kind = (3, np.dtype(np.uint8)) if colour else (2, np.dtype(np.uint16))
    return picture if picture is not None and (picture.ndim, picture.dtype) == kind else None


def _sums_agree(data: NDArray[np.uint8]) -> bool:
    """Whether every chunk up to the last agrees with its check sum."""
    view = data.data
    at = len(_SIGNATURE)
    while at + 12 <= len(view):
        (length,) = struct.unpack_from(">I", view, at)
        end = at + 12 + length
        if end > len(view) or zlib.crc32(view[at + 4 : end - 4]) != int.from_bytes(
            view[end - 4 : end], "big"
        ):
            return False
        if bytes(view[at + 4 : at + 8]) == b"IEND":
            return True
        at = end
    return False


def open_pngs(files: list[Path], progress: Progress, colour: bool = False) -> FileStack:
    """Open PNG pictures: the head and the tail of every file are checked, and none is decoded.

    Args:
        files: the pictures, in order.
        progress: told how many were looked at.
        colour: 8-bit colour is expected instead of 16-bit grey.

    Returns:
        The pictures as a stack.

    Raises:
        RecordingError: none is whole, one is of another kind, or their sizes differ.
    """
    return open_files(
        files, "PNG", partial(_look, colour=colour), partial(_decode, colour=colour), progress
    )


def _decode(path: Path, colour: bool) -> NDArray[Any] | None:
    return decode_png(np.fromfile(path, np.uint8), colour)


def _look(path: Path, colour: bool) -> Look:
    with path.open("rb") as file:
        head = file.read(_HEAD_BYTES)
        file.seek(max(0, path.stat().st_size - len(_END)))
        tail = file.read(len(_END))
    if not head.startswith(_SIGNATURE[: len(head)]):
        return something_else(path, "PNG")
    damaged = len(head) < _HEAD_BYTES or zlib.crc32(head[12:29]) != int.from_bytes(
        head[29:33], "big"
    )
    if damaged or tail != _END:
        # a header that is whole still says whether this was depth at all
        if not damaged:
            png_size(head, str(path), colour)
        return DAMAGED
    return Look(png_size(head, str(path), colour))


def png_size(head: bytes, where: str, colour: bool = False) -> tuple[int, int] | None:
    """Width and height that a PNG states in its header.

    Args:
        head: the first bytes of the file; 26 are needed.
        where: the file, for the sentence.
        colour: 8-bit colour is expected instead of 16-bit grey.

    Returns:
        (width, height), px; None where the header is cut off.

    Raises:
        RecordingError: it is no PNG, its header makes no sense, or it is of another kind.
    """
    if not head.startswith(_SIGNATURE[: len(head)]):
        raise RecordingError(
            f"{where} is named like a PNG picture but holds something else; remove it or give it "
            "its name"
        )
    if len(head) < _SIZE_BYTES:
        return None
    width, height, bits, kind = struct.unpack(">IIBB", head[16:26])
    if (
        head[12:16] != b"IHDR"
        or kind not in _COLOURS
        or not (width and height)
        or too_large((width, height))
    ):
        raise RecordingError(
            f"{where} begins like a PNG picture but its header makes no sense; remove it or copy "
            "it again"
        )
    if (bits, kind) != ((8, 2) if colour else (16, 0)):
        raise not_depth_error(where, f"{bits}-bit {_COLOURS[kind]}", width, height)
    return width, height
