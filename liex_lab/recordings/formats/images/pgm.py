"""PGM pictures (Netpbm P5, 16 bits), in the byte order of the standard or in the reverse one.

Netpbm has the high byte first; some programs write the low byte first. The order in which
neighbouring pixels are at least twice as alike tells: depth is smooth, and its low byte is not.
"""

from __future__ import annotations

import re
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

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

_DTYPES = {"big": np.dtype(">u2"), "little": np.dtype("<u2")}
_GAP = rb"(?:\s|#[^\n]*\n)+"
_HEADER = re.compile(rb"P5" + _GAP + rb"(\d{1,9})" + _GAP + rb"(\d{1,9})" + _GAP + rb"(\d{1,5})\s")
_HEAD_BYTES = 1024  # comments included
_N_ASKED = 5  # pictures, spread over the recording, that tell the byte order


class _Header(NamedTuple):
    width: int
    height: int
    largest: int
    n_bytes: int


def open_pgms(files: list[Path], progress: Progress, byte_order: str | None = None) -> FileStack:
    """Open PGM pictures: the header and the length of every file are checked, and none is decoded.

    Args:
        files: the pictures, in order.
        progress: told how many were looked at.
        byte_order: "big", as the format's definition has it, or "little"; None for big, unless most
            pictures are plainly the other way round, which `problems` then say.

    Returns:
        The pictures as a stack.

    Raises:
        RecordingError: none is whole, one is no depth, or their sizes differ.
    """
    stack = open_files(
        files, "PGM", _look, partial(_decode, dtype=_DTYPES[byte_order or "big"]), progress
    )
    if byte_order is not None:
        return stack
    whole = [path for path, good in zip(files, stack.whole, strict=True) if good]
    asked = whole[:: max(1, len(whole) // _N_ASKED)][:_N_ASKED]
    if 2 * sum(_is_little(path) for path in asked) <= len(asked):
        return stack
    claimed = (
        f"the pixels of {whole[0].name} make sense with the low byte first only, although PGM has "
        "the high byte first, "
        'so they were read so; state byte_order = "little" or "big" under [camera] in camera.toml'
    )
    return replace(stack, decode=partial(_decode, dtype=_DTYPES["little"]), problems=[claimed])


def _header(head: bytes) -> _Header | None:
    match = _HEADER.match(head)
    return _Header(int(match[1]), int(match[2]), int(match[3]), match.end()) if match else None


def _look(path: Path) -> Look:
    with path.open("rb") as file:
        head = file.read(_HEAD_BYTES)
    header = _header(head)
    if header is None:
        cut = b"P5".startswith(head[:2]) and len(head) < _HEAD_BYTES
        return DAMAGED if cut else something_else(path, "PGM")
    if header.largest < 256:
        raise not_depth_error(str(path), "8-bit grey", header.width, header.height)
    n_pixels = header.width * header.height
    spare = path.stat().st_size - header.n_bytes - 2 * n_pixels
    # a line's end or a comment behind the pixels is no matter; more, or less, and the header does
    # not say the truth
    fits = n_pixels > 0 and not too_large(header[:2]) and 0 <= spare < 2 * header.width
    return Look(header[:2]) if fits else DAMAGED


def _decode(path: Path, dtype: np.dtype[np.uint16]) -> NDArray[np.uint16] | None:
    with path.open("rb") as file:
        header = _header(file.read(_HEAD_BYTES))
        if header is None or too_large(header[:2]):
            return None
        file.seek(header.n_bytes)
        raw = file.read(2 * header.width * header.height)
    if len(raw) < 2 * header.width * header.height:
        return None
    return np.frombuffer(raw, dtype).reshape(header.height, header.width).astype(np.uint16)


def _is_little(path: Path) -> bool:
    """Whether neighbouring pixels are alike with the low byte first only: depth is smooth, and its
    low byte is not.
    """
    rough = {}
    for name, dtype in _DTYPES.items():
        picture = _decode(path, dtype)
        if picture is None:
            return False
        read = picture.astype(np.int64)
        both = (read[:, 1:] > 0) & (read[:, :-1] > 0)
        rough[name] = float(np.abs(np.diff(read, axis=1))[both].mean()) if both.any() else 0.0
    return 2.0 * rough["little"] < rough["big"]
