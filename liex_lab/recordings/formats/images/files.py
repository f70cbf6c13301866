"""Depth images, one per file: PNG, PGM and PCLZF, and the interface of every stack of images.

Files are probed (header, length) without decoding; damaged ones keep their index and read as None.
OpenCV decodes PNG only if all CRCs match, because it prints messages about damage to the terminal.
PGM (Netpbm P5, 16 bits) has the high byte first, but some programs write the low byte first: the
byte order in which neighbouring pixels are at least twice as similar is used, as depth is smooth
and its low byte is not. PCLZF is PCL's format, packed with LZF, with intrinsics in a separate XML
file.
"""

from __future__ import annotations

import re
import struct
import xml.etree.ElementTree as ET  # nosec B405: see B314 below
import zlib
from abc import ABC, abstractmethod
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from liex_lab.errors import RecordingError
from liex_lab.runtime.progress import Progress

MAX_PIXELS = 1 << 24  # well above any depth camera; a larger stated size is damage

Size = tuple[int, int]  # width, height, pixels


class Stack(ABC):
    """Depth images of one size, in order, as stored in the files.

    Attributes:
        width: columns of an image, px.
        height: rows of an image, px.
        problems: sentences about the files as a whole.
    """

    width: int
    height: int
    problems: list[str]

    @abstractmethod
    def __len__(self) -> int: ...

    @abstractmethod
    def read(self, index: int) -> NDArray[Any] | None:
        """Stored values (H, W), or (H, W, 3) for colour; None if the image is cut or damaged."""

    @abstractmethod
    def label(self, index: int) -> str:
        """Name of an image for a message: the file, and the position in it."""

    @property
    def whole(self) -> list[bool]:
        """(n,) True for images that are not cut short, as far as known without decoding."""
        return [True] * len(self)

    @property
    def truncated(self) -> bool:
        """True if an image, or the end of a stack, is missing."""
        return not all(self.whole)

    def close(self) -> None:  # noqa: B027 (most hold no file open)
        """Close open files."""


# result of probing a file: its size, the error for another type, or None if it is cut or
# damaged
Probe = Size | RecordingError | None


class FileStack(Stack):
    """A stack with one image per file."""

    def __init__(
        self,
        files: list[Path],
        size: Size,
        whole: list[bool],
        decode: Callable[[Path], NDArray[Any] | None],
    ) -> None:
        """Keep the files, and `decode`, which reads an image or returns None for a damaged one."""
        self.files = files
        self.width, self.height = size
        self.problems = []
        self.decode = decode
        self._whole = whole

    def __len__(self) -> int:
        return len(self.files)

    @property
    def whole(self) -> list[bool]:
        """(n,) True for images that are not cut short or damaged."""
        return self._whole

    def read(self, index: int) -> NDArray[Any] | None:
        """Stored values (H, W), or (H, W, 3) for colour; None if the image is cut or damaged."""
        stored = self.decode(self.files[index]) if self.whole[index] else None
        fits = stored is not None and stored.shape[:2] == (self.height, self.width)
        return stored if fits else None

    def label(self, index: int) -> str:
        """Name of an image's file."""
        return self.files[index].name


def open_files(
    files: list[Path],
    kind: str,
    probe: Callable[[Path], Probe],
    decode: Callable[[Path], NDArray[Any] | None],
    progress: Progress,
) -> FileStack:
    """Open images, one per file: every file is probed and none is decoded.

    Args:
        files: the images, in order.
        kind: their kind, for messages, such as "PNG".
        probe: reads a file's header; raises for an image that is whole but not depth.
        decode: reads the stored values of a file; None if it is damaged.
        progress: counts the probed files.

    Raises:
        RecordingError: none is whole, or their sizes differ.
    """
    whole: list[bool] = []
    sizes: dict[Size, Path] = {}
    why: RecordingError | None = None
    for number, path in enumerate(files, start=1):
        found = probe(path)
        whole.append(isinstance(found, tuple))
        if isinstance(found, tuple):
            sizes.setdefault(found, path)
        else:
            why = why or found
        progress(number, len(files), "looking at the pictures")
    if not sizes:
        raise why or none_whole_error(files, kind)
    if len(sizes) > 1:
        raise one_size_error([(path.name, *size) for size, path in sizes.items()])
    return FileStack(files, next(iter(sizes)), whole, decode)


def none_whole_error(files: list[Path], kind: str) -> RecordingError:
    """The error if none of the images, of a kind such as "PNG", can be read."""
    return RecordingError(
        f"none of the {len(files)} {kind} pictures in {files[0].parent} is whole; copy them again"
        if len(files) > 1
        else f"{files[0]} is cut short and holds no whole picture; copy it again"
    )


def something_else(path: Path, kind: str) -> RecordingError:
    """The error for a file whose first bytes do not match its kind, such as "PNG"."""
    return RecordingError(
        f"{path} is named like a {kind} picture but holds something else; remove it or give it its "
        "name"
    )


def too_large(size: Size) -> bool:
    """Whether a size (width, height), px, is beyond any depth camera (2^24 px) and so invalid."""
    return size[0] * size[1] > MAX_PIXELS


def not_depth_error(where: str, found: str, width: int, height: int) -> RecordingError:
    """The error for an image that cannot contain depth.

    Args:
        where: the file.
        found: its type, such as "8-bit grey".
        width: its columns, px.
        height: its rows, px.
    """
    article = "an" if found.startswith(("8", "11", "18")) else "a"
    return RecordingError(
        f"expected 16-bit depth, got {article} {found} image of {width} x {height} pixels "
        f"({where}); give the camera's "
        'depth pictures, or choose them with a line such as pattern = "*_depth.png" under '
        "[camera] in camera.toml"
    )


def one_size_error(pictures: list[tuple[str, int, int]]) -> RecordingError:
    """The error for images of several sizes in one recording.

    Args:
        pictures: (name, width, height) of one image of each size.
    """
    (one, w, h), (other, v, g) = pictures[:2]
    return RecordingError(
        f"all pictures of a recording have one size, but {one} has {w} x {h} pixels and {other} "
        f"{v} x {g}; put them into two folders"
    )


# PNG images: 16-bit grey or 8-bit colour, with size, completeness and chunk CRCs checked.


_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_END = struct.pack(">I", 0) + b"IEND\xaeB`\x82"  # the last chunk: no data, its name, its CRC
_HEAD_BYTES = 33  # signature and the whole header chunk with its CRC
_SIZE_BYTES = 26  # part of it with size and kind
_COLOURS = {
    0: "grey",
    2: "colour",
    3: "palette colour",
    4: "grey with transparency",
    6: "colour with transparency",
}


def decode_png(data: NDArray[np.uint8], colour: bool = False) -> NDArray[Any] | None:
    """Decode a PNG.

    Args:
        data: (m,) uint8 bytes of the file.
        colour: 8-bit colour is expected instead of 16-bit grey.

    Returns:
        (H, W) uint16, or for colour (H, W, 3) uint8 (blue, green, red); None if it is damaged or of
        another type.
    """
    import cv2

    if not _sums_agree(data):  # the decoder would print a message to the terminal
        return None
    try:
        picture: NDArray[Any] | None = cv2.imdecode(data, cv2.IMREAD_UNCHANGED)
    except cv2.error:  # an empty buffer, or a size beyond OpenCV's limits
        return None
    kind = (3, np.dtype(np.uint8)) if colour else (2, np.dtype(np.uint16))
    return picture if picture is not None and (picture.ndim, picture.dtype) == kind else None


def _sums_agree(data: NDArray[np.uint8]) -> bool:
    """Whether all chunks up to the last match their check sums."""
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
    """Open PNG images: head and tail of every file are checked, and none is decoded.

    Args:
        files: the images, in order.
        progress: counts the probed files.
        colour: 8-bit colour is expected instead of 16-bit grey.

    Raises:
        RecordingError: none is whole, one is of another kind, or their sizes differ.
    """
    return open_files(
        files, "PNG", partial(_look, colour=colour), partial(_decode, colour=colour), progress
    )


def _decode(path: Path, colour: bool) -> NDArray[Any] | None:
    return decode_png(np.fromfile(path, np.uint8), colour)


def _look(path: Path, colour: bool) -> Probe:
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
        # a whole header still shows whether this was depth at all
        if not damaged:
            png_size(head, str(path), colour)
        return None
    return png_size(head, str(path), colour)


def png_size(head: bytes, where: str, colour: bool = False) -> tuple[int, int] | None:
    """Width and height in the header of a PNG.

    Args:
        head: the first bytes of the file; 26 are needed.
        where: the file, for the error message.
        colour: 8-bit colour is expected instead of 16-bit grey.

    Returns:
        (width, height), px; None if the header is cut off.

    Raises:
        RecordingError: it is not a PNG, its header is invalid, or it is of another kind.
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


# PGM images (Netpbm P5, 16 bits), in the byte order of the standard or in the reverse one.


_DTYPES = {"big": np.dtype(">u2"), "little": np.dtype("<u2")}
_GAP = rb"(?:\s|#[^\n]*\n)+"
_HEADER = re.compile(rb"P5" + _GAP + rb"(\d{1,9})" + _GAP + rb"(\d{1,9})" + _GAP + rb"(\d{1,5})\s")
_PGM_HEAD_BYTES = 1024  # comments included
_N_ASKED = 5  # images, spread over the recording, that determine the byte order


class _Header(NamedTuple):
    width: int
    height: int
    largest: int
    n_bytes: int


def open_pgms(files: list[Path], progress: Progress, byte_order: str | None = None) -> FileStack:
    """Open PGM images: header and length of every file are checked, and none is decoded.

    Args:
        files: the images, in order.
        progress: counts the probed files.
        byte_order: "big", as in the format's definition, or "little"; None for big, unless most
            images are clearly little endian, which `problems` then report.

    Raises:
        RecordingError: none is whole, one is not depth, or their sizes differ.
    """
    stack = open_files(
        files, "PGM", _pgm_look, partial(_pgm_decode, dtype=_DTYPES[byte_order or "big"]), progress
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
    stack.decode = partial(_pgm_decode, dtype=_DTYPES["little"])
    stack.problems = [claimed]
    return stack


def _header(head: bytes) -> _Header | None:
    match = _HEADER.match(head)
    return _Header(int(match[1]), int(match[2]), int(match[3]), match.end()) if match else None


def _pgm_look(path: Path) -> Probe:
    with path.open("rb") as file:
        head = file.read(_PGM_HEAD_BYTES)
    header = _header(head)
    if header is None:
        cut = b"P5".startswith(head[:2]) and len(head) < _PGM_HEAD_BYTES
        return None if cut else something_else(path, "PGM")
    if header.largest < 256:
        raise not_depth_error(str(path), "8-bit grey", header.width, header.height)
    n_pixels = header.width * header.height
    spare = path.stat().st_size - header.n_bytes - 2 * n_pixels
    # a line break or a comment after the pixels is accepted; otherwise the header is
    # wrong
    fits = n_pixels > 0 and not too_large(header[:2]) and 0 <= spare < 2 * header.width
    return header[:2] if fits else None


def _pgm_decode(path: Path, dtype: np.dtype[np.uint16]) -> NDArray[np.uint16] | None:
    with path.open("rb") as file:
        header = _header(file.read(_PGM_HEAD_BYTES))
        if header is None or too_large(header[:2]):
            return None
        file.seek(header.n_bytes)
        raw = file.read(2 * header.width * header.height)
    if len(raw) < 2 * header.width * header.height:
        return None
    return np.frombuffer(raw, dtype).reshape(header.height, header.width).astype(np.uint16)


def _is_little(path: Path) -> bool:
    """Whether neighbouring pixels are at least twice as similar with the low byte first."""
    rough = {}
    for name, dtype in _DTYPES.items():
        picture = _pgm_decode(path, dtype)
        if picture is None:
            return False
        read = picture.astype(np.int64)
        both = (read[:, 1:] > 0) & (read[:, :-1] > 0)
        rough[name] = float(np.abs(np.diff(read, axis=1))[both].mean()) if both.any() else 0.0
    return 2.0 * rough["little"] < rough["big"]


# PCL's `.pclzf` images: 16-bit depth packed with LZF, intrinsics in one XML file per image.


_MAGIC = b"PCLZF"
_PCLZF_HEADER = struct.Struct(
    "<5sII16sII"
)  # magic, width, height, type, bytes packed, bytes unpacked
_DEPTH = "depth16"
_XML_BYTES = 1 << 16
_INTRINSICS = {  # element of <depth>: our name
    "focal_length_x": "fx",
    "focal_length_y": "fy",
    "principal_point_x": "cx",
    "principal_point_y": "cy",
}


class _PclzfHeader(NamedTuple):
    magic: bytes
    width: int
    height: int
    kind: bytes
    packed: int
    unpacked: int


def open_pclzfs(files: list[Path], progress: Progress) -> FileStack:
    """Open PCLZF images: header and length of every file are checked, and none is decoded.

    Args:
        files: the images, in order.
        progress: counts the probed files.

    Raises:
        RecordingError: none is whole, one is colour, or their sizes differ.
    """
    return open_files(files, "PCLZF", _pclzf_look, _pclzf_decode, progress)


def _pclzf_look(path: Path) -> Probe:
    with path.open("rb") as file:
        head = file.read(_PCLZF_HEADER.size)
    if not head.startswith(_MAGIC[: len(head)]):
        return something_else(path, "PCLZF")
    if len(head) < _PCLZF_HEADER.size:
        return None
    header = _PclzfHeader(*_PCLZF_HEADER.unpack(head))
    size = (header.width, header.height)
    kind = header.kind.rstrip(b" \0").decode("ascii", "replace")
    if kind in ("rgb24", "yuv422", "bayer8"):
        raise not_depth_error(str(path), f"8-bit {kind}", *size)
    fits = kind == _DEPTH and not too_large(size) and 0 < header.unpacked == 2 * size[0] * size[1]
    there = path.stat().st_size >= _PCLZF_HEADER.size + header.packed
    return size if fits and there else None


def _pclzf_decode(path: Path) -> NDArray[np.uint16] | None:
    from liex_lab.recordings.depth_kernels import unpack_lzf

    with path.open("rb") as file:
        header = _PclzfHeader(*_PCLZF_HEADER.unpack(file.read(_PCLZF_HEADER.size)))
        packed = np.frombuffer(file.read(header.packed), np.uint8)
    out = np.empty(2 * header.width * header.height, np.uint8)
    if unpack_lzf(packed, out) != out.size:
        return None
    return out.view("<u2").reshape(header.height, header.width).astype(np.uint16)


def read_pclzf_camera(picture: Path) -> dict[str, float] | None:
    """Intrinsics and unit in the XML file of an image.

    PCL writes `frame_T.xml` next to `frame_T_depth.pclzf`, with two top-level elements, <rgb> and
    <depth>, so it is only valid XML inside another element.

    Args:
        picture: the .pclzf file.

    Returns:
        fx, fy, cx, cy (px) and unit_mm (mm per stored step) by name; None if there is no XML file
        with all of them.
    """
    path = picture.with_name(
        picture.name.removesuffix(picture.suffix).removesuffix("_depth") + ".xml"
    )
    if not path.is_file():
        return None
    with path.open("rb") as file:
        text = file.read(_XML_BYTES)
    try:
        # bandit B314: expat reads no external entities and limits the others, which tests check
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
