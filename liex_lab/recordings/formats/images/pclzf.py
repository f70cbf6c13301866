"""PCL's `.pclzf` pictures: 16-bit depth packed with LZF, intrinsics in the XML beside each."""

from __future__ import annotations

import re
import struct
import xml.etree.ElementTree as ET  # nosec B405: see B314 below
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

_MAGIC = b"PCLZF"
_HEADER = struct.Struct("<5sII16sII")  # magic, width, height, type, bytes packed, bytes unpacked
_DEPTH = "depth16"
_XML_BYTES = 1 << 16
_INTRINSICS = {  # element of <depth>: our name
    "focal_length_x": "fx",
    "focal_length_y": "fy",
    "principal_point_x": "cx",
    "principal_point_y": "cy",
}


class _Header(NamedTuple):
    magic: bytes
    width: int
    height: int
    kind: bytes
    packed: int
    unpacked: int


def open_pclzfs(files: list[Path], progress: Progress) -> FileStack:
    """Open PCLZF pictures: the header and the length of every file are checked, none is decoded.

    Args:
        files: the pictures, in order.
        progress: told how many were looked at.

    Returns:
        The pictures as a stack.

    Raises:
        RecordingError: none is whole, one holds colour, or their sizes differ.
    """
    return open_files(files, "PCLZF", _look, _decode, progress)


def _look(path: Path) -> Look:
    with path.open("rb") as file:
        head = file.read(_HEADER.size)
    if not head.startswith(_MAGIC[: len(head)]):
        return something_else(path, "PCLZF")
    if len(head) < _HEADER.size:
        return DAMAGED
    header = _Header(*_HEADER.unpack(head))
    size = (header.width, header.height)
    kind = header.kind.rstrip(b" \0").decode("ascii", "replace")
    if kind in ("rgb24", "yuv422", "bayer8"):
        raise not_depth_error(str(path), f"8-bit {kind}", *size)
    fits = kind == _DEPTH and not too_large(size) and 0 < header.unpacked == 2 * size[0] * size[1]
    there = path.stat().st_size >= _HEADER.size + header.packed
    return Look(size) if fits and there else DAMAGED


def _decode(path: Path) -> NDArray[np.uint16] | None:
    from liex_lab.recordings.formats.images._lzf_kernels import unpack_lzf

    with path.open("rb") as file:
        header = _Header(*_HEADER.unpack(file.read(_HEADER.size)))
        packed = np.frombuffer(file.read(header.packed), np.uint8)
    out = np.empty(2 * header.width * header.height, np.uint8)
    if unpack_lzf(packed, out) != out.size:
        return None
    return out.view("<u2").reshape(header.height, header.width).astype(np.uint16)


def read_pclzf_camera(picture: Path) -> dict[str, float] | None:
    """Intrinsics and unit in the XML beside a picture.

    PCL writes `frame_T.xml` beside `frame_T_depth.pclzf`, with two elements at the top, <rgb> and
    <depth>, which is why it is no XML until something stands around them.

    Args:
        picture: the .pclzf file.

    Returns:
        fx, fy, cx, cy (px) and unit_mm (mm per stored step) by name; None where there is no XML
        that states them.
    """
    path = picture.with_name(
        picture.name.removesuffix(picture.suffix).removesuffix("_depth") + ".xml"
    )
    if not path.is_file():
        return None
    with path.open("rb") as file:
        text = file.read(_XML_BYTES)
    try:
        # bandit B314: expat reads no external entities and bounds the others; tests hold it to that
        root = ET.fromstring(  # nosec B314
            b"<both>" + re.sub(rb"<\?xml[^>]*\?>", b"", text) + b"</both>"
        )
        depth = root.find("depth")
        if depth is None:
            return None
        numbers = {ours: float(depth.findtext(theirs, "")) for theirs, ours in _INTRINSICS.items()}
        numbers["unit_mm"] = 1000.0 * float(depth.findtext("z_multiplication_factor", "0.001"))
    except (ET.ParseError, ValueError):
        return None
    good = (
        np.isfinite(list(numbers.values())).all()
        and min(numbers["fx"], numbers["fy"], numbers["unit_mm"]) > 0
    )
    return numbers if good else None
