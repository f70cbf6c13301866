"""Depth images in files: PNG, PGM, PCLZF and TIFF, and the interface of every stack of images.

Files are probed (header, length) without decoding; damaged ones keep their index and read as None.
OpenCV decodes PNG only if all CRCs match, because it prints messages about damage to the terminal.
PGM (Netpbm P5, 16 bits) has the high byte first, but some programs write the low byte first: the
byte order in which neighbouring pixels are at least twice as similar is used, as depth is smooth
and its low byte is not. PCLZF is PCL's format, packed with LZF, with intrinsics in a separate XML
file. TIFF is 16-bit or float32 grey, one or many images per file, including BigTIFF and ImageJ:
contiguous uncompressed pixels are read directly from their offset, other pages are decoded by
tifffile, and codecs that need an optional package of tifffile (LZW) by OpenCV. A stack ends at its
first bad page, because later ones may be noise.
"""

import logging
import lzma
import re
import struct
import xml.etree.ElementTree as ET  # nosec B405: see B314 below
import zlib
from abc import ABC, abstractmethod
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path
from threading import Lock
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from liex_lab.errors import RecordingError
from liex_lab.optics.camera import Camera
from liex_lab.recordings.frame import Depth, Stored
from liex_lab.runtime.progress import Progress

Size = tuple[int, int]  # width, height, pixels
Points = NDArray[np.float64]


class Stack(ABC):
    """Depth images of one size, in order, as stored in the files.

    Attributes:
        width: columns of an image, px.
        height: rows of an image, px.
        whole: (n,) True for images that are not cut short, as far as known without decoding.
        truncated: True if an image, or the end of a stack, is missing.
        problems: sentences about the files as a whole.
    """

    def __init__(self, size: Size, whole: list[bool], truncated: bool = False) -> None:
        """Keep the size and the state of the images."""
        self.width, self.height = size
        self.whole = whole
        self.truncated = truncated or not all(whole)
        self.problems: list[str] = []

    def __len__(self) -> int:
        return len(self.whole)

    @abstractmethod
    def read(self, index: int) -> Stored | None:
        """Stored values (H, W), or (H, W, 3) for colour; None if the image is cut or damaged."""

    @abstractmethod
    def label(self, index: int) -> str:
        """Name of an image for a message: the file, and the position in it."""

    def close(self) -> None:  # noqa: B027 (most hold no file open)
        """Close open files."""

    def depth(self, decode: Callable[[Stored], Depth]) -> Callable[[int], Depth | str]:
        """The function that reads depth for `unread_where_damaged`."""

        def read(index: int) -> Depth | str:
            """Depth (H, W) float32 mm of an image, or what is wrong with it."""
            stored = self.read(index)
            return f" ({self.label(index)}) is damaged" if stored is None else decode(stored)

        return read


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
        decode: Callable[[Path], Stored | None],
    ) -> None:
        """Keep the files, and `decode`, which reads an image or returns None for a damaged one."""
        super().__init__(size, whole)
        self.files = files
        self.decode = decode

    def read(self, index: int) -> Stored | None:
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
    decode: Callable[[Path], Stored | None],
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
    found: list[Probe] = []
    for path in files:
        found.append(probe(path))
        progress(len(found), len(files), "reading the images")
    sizes = {
        size: path.name for path, size in zip(files, found, strict=True) if isinstance(size, tuple)
    }
    why = next((error for error in found if isinstance(error, RecordingError)), None)
    size = _common_size(sizes, files, kind, why)
    return FileStack(files, size, [isinstance(one, tuple) for one in found], decode)


def _common_size(
    sizes: dict[Size, str], files: list[Path], kind: str, why: RecordingError | None = None
) -> Size:
    """The only size of images, from an example file of each size.

    Raises:
        RecordingError: there are several sizes, or no whole image; then `why`, if given.
    """
    if len(sizes) == 1:
        return next(iter(sizes))
    if sizes:
        ((w, h), one), ((v, g), other) = list(sizes.items())[:2]
        raise RecordingError(
            f"all images of a recording have one size, but {one} has {w} x {h} pixels and "
            f"{other} {v} x {g}; put them into two folders"
        )
    raise why or RecordingError(
        f"none of the {len(files)} {kind} images in {files[0].parent} is whole; copy them again"
        if len(files) > 1
        else f"{files[0]} is cut short and holds no whole image; copy it again"
    )


def something_else(path: Path | str, kind: str) -> RecordingError:
    """The error for a file whose first bytes do not match its kind, such as "PNG"."""
    return RecordingError(
        f"{path} is named like a {kind} image but holds something else; remove it or give it its "
        "name"
    )


def too_large(size: Size) -> bool:
    """Whether a size (width, height), px, is beyond any depth camera (2^24 px) and so invalid."""
    # well above any depth camera; a larger stated size is damage
    return size[0] * size[1] > (1 << 24)


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
        'depth images, or choose them with a line such as pattern = "*_depth.png" under '
        "[camera] in camera.toml"
    )


# PNG images: 16-bit grey or 8-bit colour, with size, completeness and chunk CRCs checked.


_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_END = b"\0\0\0\0IEND\xaeB`\x82"  # the last chunk: no data, its name, its CRC
_HEAD_BYTES = 33  # signature and the whole header chunk with its CRC
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
        image: NDArray[Any] | None = cv2.imdecode(data, cv2.IMREAD_UNCHANGED)
    except cv2.error:  # an empty buffer, or a size beyond OpenCV's limits
        return None
    kind = (3, np.dtype(np.uint8)) if colour else (2, np.dtype(np.uint16))
    return image if image is not None and (image.ndim, image.dtype) == kind else None


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

    def decode(path: Path) -> Stored | None:
        return decode_png(np.fromfile(path, np.uint8), colour)

    return open_files(files, "PNG", partial(_probe_png, colour=colour), decode, progress)


def _probe_png(path: Path, colour: bool) -> Probe:
    with path.open("rb") as file:
        head = file.read(_HEAD_BYTES)
        file.seek(max(0, path.stat().st_size - len(_END)))
        tail = file.read(len(_END))
    if not head.startswith(_SIGNATURE[: len(head)]):
        return something_else(path, "PNG")
    if len(head) < _HEAD_BYTES or zlib.crc32(head[12:29]) != int.from_bytes(head[29:33], "big"):
        return None
    size = png_size(head, str(path), colour)  # also shows whether a cut file was depth at all
    return size if tail == _END else None


def png_size(head: bytes, where: str, colour: bool = False) -> Size | None:
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
        raise something_else(where, "PNG")
    # part of it with size and kind
    if len(head) < 26:
        return None
    width, height, bits, kind = struct.unpack(">IIBB", head[16:26])
    if (
        head[12:16] != b"IHDR"
        or kind not in _COLOURS
        or not (width and height)
        or too_large((width, height))
    ):
        raise RecordingError(
            f"{where} begins like a PNG image but its header makes no sense; remove it or copy "
            "it again"
        )
    if (bits, kind) != ((8, 2) if colour else (16, 0)):
        raise not_depth_error(where, f"{bits}-bit {_COLOURS[kind]}", width, height)
    return width, height


# PGM images (Netpbm P5, 16 bits), in the byte order of the standard or in the reverse one.


_GAP = rb"(?:\s|#[^\n]*\n)+"
_HEADER = re.compile(rb"P5" + _GAP + rb"(\d{1,9})" + _GAP + rb"(\d{1,9})" + _GAP + rb"(\d{1,5})\s")
_PGM_HEAD_BYTES = 1024  # comments included
_N_ASKED = 5  # images, spread over the recording, that determine the byte order


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
    big, little = (partial(_decode_pgm, dtype=dtype) for dtype in (">u2", "<u2"))
    stack = open_files(
        files, "PGM", _probe_pgm, little if byte_order == "little" else big, progress
    )
    whole = [path for path, good in zip(files, stack.whole, strict=True) if good]
    asked = whole[:: max(1, len(whole) // _N_ASKED)][:_N_ASKED]
    n_little = sum(2.0 * _roughness(little(path)) < _roughness(big(path)) for path in asked)
    if byte_order is None and 2 * n_little > len(asked):
        stack.decode = little
        stack.problems.append(
            f"the pixels of {whole[0].name} make sense with the low byte first only, although PGM "
            "has the high byte first, so they were read so; state byte_order = "
            '"little" or "big" under [camera] in camera.toml'
        )
    return stack


def _pgm_header(path: Path) -> tuple[bytes, list[int]]:
    """The head of a file, and its width, height, largest value and bytes of the header, or []."""
    with path.open("rb") as file:
        head = file.read(_PGM_HEAD_BYTES)
    match = _HEADER.match(head)
    return head, [*map(int, match.groups()), match.end()] if match else []


def _probe_pgm(path: Path) -> Probe:
    head, header = _pgm_header(path)
    if not header:
        cut = b"P5".startswith(head[:2]) and len(head) < _PGM_HEAD_BYTES
        return None if cut else something_else(path, "PGM")
    width, height, largest, n_bytes = header
    if largest < 256:
        raise not_depth_error(str(path), "8-bit grey", width, height)
    spare = path.stat().st_size - n_bytes - 2 * width * height
    # a line break or a comment after the pixels is accepted; otherwise the header is
    # wrong
    fits = width * height > 0 and not too_large((width, height)) and 0 <= spare < 2 * width
    return (width, height) if fits else None


def _decode_pgm(path: Path, dtype: str) -> NDArray[np.uint16] | None:
    _, header = _pgm_header(path)
    width, height, _, n_bytes = header or (0, 0, 0, 0)
    if not header or too_large((width, height)):
        return None
    pixels = np.fromfile(path, dtype, width * height, offset=n_bytes)
    whole = pixels.size == width * height
    return pixels.astype(np.uint16).reshape(height, width) if whole else None


def _roughness(stored: NDArray[np.uint16] | None) -> float:
    """Mean difference of neighbouring pixels with readings; NaN without an image."""
    if stored is None:
        return float("nan")
    read = stored.astype(np.int64)
    both = (read[:, 1:] > 0) & (read[:, :-1] > 0)
    return float(np.abs(np.diff(read, axis=1))[both].mean()) if both.any() else 0.0


# PCL's `.pclzf` images: 16-bit depth packed with LZF, intrinsics in one XML file per image.


_PCLZF_HEADER = struct.Struct(
    "<5sII16sII"
)  # magic, width, height, type, bytes packed, bytes unpacked
_INTRINSICS = {  # element of <depth>: our name
    "focal_length_x": "fx",
    "focal_length_y": "fy",
    "principal_point_x": "cx",
    "principal_point_y": "cy",
}


def probe_pclzf(path: Path) -> Probe:
    """Check header and length of a PCLZF file.

    Raises:
        RecordingError: it is in colour.
    """
    with path.open("rb") as file:
        head = file.read(_PCLZF_HEADER.size)
    if not head.startswith(b"PCLZF"[: len(head)]):
        return something_else(path, "PCLZF")
    if len(head) < _PCLZF_HEADER.size:
        return None
    _, *size, raw_kind, packed, unpacked = _PCLZF_HEADER.unpack(head)
    width, height = size
    kind = raw_kind.rstrip(b" \0").decode("ascii", "replace")
    if kind in ("rgb24", "yuv422", "bayer8"):
        raise not_depth_error(str(path), f"8-bit {kind}", width, height)
    fits = (
        kind == "depth16" and not too_large((width, height)) and 0 < unpacked == 2 * width * height
    )
    there = path.stat().st_size >= _PCLZF_HEADER.size + packed
    return (width, height) if fits and there else None


def decode_pclzf(path: Path) -> NDArray[np.uint16] | None:
    """Stored values (H, W) of a file; None if it is damaged."""
    from liex_lab.recordings.depth_kernels import unpack_lzf

    with path.open("rb") as file:
        _, width, height, _, n_packed, _ = _PCLZF_HEADER.unpack(file.read(_PCLZF_HEADER.size))
        packed = np.frombuffer(file.read(n_packed), np.uint8)
    out = np.empty(2 * width * height, np.uint8)
    whole = unpack_lzf(packed, out) == out.size
    return out.view("<u2").reshape(height, width).astype(np.uint16) if whole else None


def read_pclzf_camera(image: Path) -> dict[str, float] | None:
    """Intrinsics and unit in the XML file of an image.

    PCL writes `frame_T.xml` next to `frame_T_depth.pclzf`, with two top-level elements, <rgb> and
    <depth>, so it is only valid XML inside another element.

    Args:
        image: the .pclzf file.

    Returns:
        fx, fy, cx, cy (px) and unit_mm (mm per stored step) by name; None if there is no XML file
        with all of them.
    """
    path = image.with_name(image.name.removesuffix(image.suffix).removesuffix("_depth") + ".xml")
    if not path.is_file():
        return None
    with path.open("rb") as file:
        text = file.read(1 << 16)
    try:
        # bandit B314: expat reads no external entities and limits the others, which tests check
        root = ET.fromstring(  # nosec B314
            b"<both>" + re.sub(rb"<\?xml[^>]*\?>", b"", text) + b"</both>"
        )
        stated = {
            name: float(root.findtext(f"depth/{theirs}", ""))
            for theirs, name in _INTRINSICS.items()
        }
        scale = float(root.findtext("depth/z_multiplication_factor", "0.001"))
    except (ET.ParseError, ValueError):
        return None
    numbers = stated | {"unit_mm": 1000.0 * scale}
    positive = min(numbers["fx"], numbers["fy"], numbers["unit_mm"]) > 0
    return numbers if positive and np.isfinite(list(numbers.values())).all() else None


# TIFF images, 16-bit or float32 grey, one or many per file, including BigTIFF and ImageJ.


_LZMA = (34925,)

# tifffile reports damage twice, as an exception and in the log; hide the
# log
logging.getLogger("tifffile").addHandler(logging.NullHandler())

_KINDS = {"u": "unsigned integer ", "i": "signed integer ", "f": "floating-point "}


class _Page(NamedTuple):
    """One image.

    Attributes:
        path: its file.
        page: its page in the file.
        size: its width and height, px.
        offset: position of contiguous plain pixels, else -1.
        dtype: of the pixels, with byte order.
        whole: True if it is not cut short.
    """

    path: Path
    page: int
    size: Size = (0, 0)
    offset: int = -1
    dtype: str = "<u2"
    whole: bool = False


class TiffStack(Stack):
    """TIFF images of one size, in order, with one file open at a time."""

    def __init__(self, pages: list[_Page], size: Size, problems: list[str]) -> None:
        """Keep the images, and sentences about stacks that are cut short."""
        super().__init__(size, [page.whole for page in pages], truncated=bool(problems))
        self.problems = problems
        self._pages = pages
        self._open: Any = None
        self._open_path: Path | None = None
        self._lock = Lock()

    def read(self, index: int) -> Stored | None:
        """Stored values of one image, (H, W) uint16, int16 or float32; None if it is cut or
        damaged.
        """
        page = self._pages[index]
        if not page.whole:
            return None
        if page.offset >= 0:
            count = self.width * self.height
            stored = np.fromfile(page.path, page.dtype, count, offset=page.offset)
            return stored.reshape(self.height, self.width)
        with self._lock:
            decoded = self._decode(page)
        fits = decoded is not None and decoded.shape == (self.height, self.width)
        return decoded if fits else None

    def _decode(self, page: _Page) -> Stored | None:
        import tifffile

        if self._open_path != page.path:
            self.close()
            self._open = tifffile.TiffFile(page.path)
            self._open_path = page.path
        try:
            if not self._unpacks_to_itself(self._open.pages[page.page]):
                return None
            return np.asarray(self._open.asarray(key=page.page))
        except Exception:  # damage in compressed data raises almost any exception
            import cv2  # decodes LZW and other codecs that tifffile lacks

            images: Any = ()
            with suppress(cv2.error):
                _, images = cv2.imreadmulti(
                    str(page.path), page.page, 1, flags=cv2.IMREAD_UNCHANGED
                )
            return np.asarray(images[0]) if images and images[0].ndim == 2 else None

    def _unpacks_to_itself(self, page: Any) -> bool:
        """Whether no packed piece is larger than the image after unpacking.

        tifffile unpacks whole pieces of DEFLATE and LZMA in memory, of any size.
        """
        # codes of compression: DEFLATE, LZMA
        if page.compression not in (8, 32946, 50013, *_LZMA):
            return True
        most = 4 * self.width * self.height + (1 << 20)
        file = page.parent.filehandle
        for offset, count in zip(page.dataoffsets, page.databytecounts, strict=True):
            file.seek(offset)
            if not _fits(file.read(count), page.compression, most):
                return False
        return True

    def label(self, index: int) -> str:
        """Name of an image, for a message: its page and file."""
        page = self._pages[index]
        return f"page {page.page} of {page.path.name}"

    def close(self) -> None:
        """Close the open file."""
        if self._open is not None:
            self._open.close()
        self._open = self._open_path = None


def _fits(packed: bytes, compression: int, most: int) -> bool:
    """Whether a packed piece unpacks to at most `most` bytes."""
    try:
        if compression not in _LZMA:
            return len(zlib.decompressobj().decompress(packed, most + 1)) <= most
        # bytes; the largest of its usual levels needs 64 MB
        unpacker = lzma.LZMADecompressor(memlimit=1 << 28)
        return len(unpacker.decompress(packed, most + 1)) <= most
    except lzma.LZMAError:
        return False
    except zlib.error:
        return True  # the decoder reports damage


def open_tiffs(files: list[Path], progress: Progress) -> TiffStack:
    """Open TIFF images: every page is listed and its bytes must exist; none is decoded.

    Args:
        files: the files, in order, of one page or many.
        progress: counts the probed files.

    Raises:
        RecordingError: none is whole, one is not depth, or their sizes differ.
    """
    pages: list[_Page] = []
    problems: list[str] = []
    for number, path in enumerate(files, start=1):
        found, ends = _list_pages(path)
        n_whole = next((i for i, page in enumerate(found) if not page.whole), len(found))
        if n_whole and (n_whole < len(found) or not ends):
            # a stack ends at its first bad page: later ones may be noise
            problems.append(f"{path.name} is cut short: only its first {n_whole} images are whole")
            found = found[:n_whole]
        pages += found or [_Page(path, 0)]
        progress(number, len(files), "reading the images")
    sizes = {page.size: page.path.name for page in reversed(pages) if page.whole}
    return TiffStack(pages, _common_size(sizes, files, "TIFF"), problems)


def _list_pages(path: Path) -> tuple[list[_Page], bool]:
    """The images of one file in order, and whether their list is complete.

    No images if the directory is cut off.
    """
    import tifffile

    size_bytes = path.stat().st_size
    with path.open("rb") as file:
        head = file.read(4)
    if len(head) == 4 and head not in (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+"):
        raise something_else(path, "TIFF")
    listed: list[_Page] = []
    known: set[int] = set()
    try:
        with tifffile.TiffFile(path) as tif:
            page: Any
            for page in tif.pages:
                # bytes: the directory of an image has more
                if page.offset in known or len(listed) * 30 > size_bytes:
                    return listed, False  # the list of directories is circular
                known.add(page.offset)
                listed.append(_describe(path, len(listed), page, size_bytes))
            ends = _list_ends(tif)
            return _imagej_stack(tif, listed, size_bytes) if len(listed) == 1 else listed, ends
    except RecordingError:
        if not any(page.whole for page in listed):
            raise
    except Exception:  # nosec B110: the directory of a cut file is garbage
        pass
    # a damaged directory, or an image of another kind after the depth: the stack ends before it
    return listed, False


def _list_ends(tif: Any) -> bool:
    """Whether the last page found is marked as the last: each page ends with the offset of the
    next.
    """
    layout = tif.tiff
    at = tif.pages[len(tif.pages) - 1].offset
    file = tif.filehandle
    file.seek(at)
    n_tags = int.from_bytes(
        file.read(layout.tagnosize), "little" if tif.byteorder == "<" else "big"
    )
    file.seek(at + layout.tagnosize + n_tags * layout.tagsize)
    return bool(file.read(layout.offsetsize) == bytes(layout.offsetsize))


def _describe(path: Path, index: int, page: Any, size_bytes: int) -> _Page:
    width, height = size = int(page.imagewidth), int(page.imagelength)
    dtype = np.dtype(page.dtype or "V1")
    # types of depth pixels
    if (
        page.samplesperpixel != 1
        or dtype.str[1:] not in ("u2", "i2", "f4")
        or not (width and height)
    ):
        colour = "grey" if page.samplesperpixel == 1 else "colour"
        kind = "" if dtype == np.uint8 else _KINDS.get(dtype.kind, "")
        found = f"{page.bitspersample}-bit {kind}{colour}"
        raise not_depth_error(str(path), found, width, height)
    ends = [
        offset + count for offset, count in zip(page.dataoffsets, page.databytecounts, strict=True)
    ]
    plain = (
        page.is_contiguous and page.compression == 1 and page.fillorder == 1 and page.predictor == 1
    )
    # without compression the size determines the bytes; an inconsistent directory is
    # damaged
    agrees = page.compression != 1 or sum(page.databytecounts) == width * height * dtype.itemsize
    return _Page(
        path=path,
        page=index,
        size=size,
        offset=int(page.dataoffsets[0]) if plain else -1,
        dtype=page.parent.byteorder + dtype.str[1:],
        whole=bool(ends) and max(ends) <= size_bytes and agrees and not too_large(size),
    )


def _imagej_stack(tif: Any, pages: list[_Page], size_bytes: int) -> list[_Page]:
    """The images of an ImageJ stack over 4 GB, described as one page and stored without gaps."""
    shape: tuple[int, ...] = tif.series[0].shape if tif.series else ()
    (first,) = pages
    if len(shape) < 3 or first.offset < 0:
        return pages
    n_bytes = shape[-1] * shape[-2] * int(first.dtype[-1])
    offsets = [first.offset + k * n_bytes for k in range(int(np.prod(shape[:-2])))]
    return [
        first._replace(page=k, offset=o, whole=o + n_bytes <= size_bytes)
        for k, o in enumerate(offsets)
    ]


def render_points(p_camera: Points, camera: Camera) -> NDArray[np.float64]:
    """Render points as a depth image: the nearest point in every pixel.

    Args:
        p_camera: (n, 3) mm, camera frame; points that are not finite or behind the lens are
            ignored.
        camera: the camera.

    Returns:
        (H, W) float64 mm, 0 without a point.
    """
    with np.errstate(invalid="ignore", over="ignore"):
        p_camera = p_camera[np.isfinite(p_camera).all(axis=1) & (p_camera[:, 2] > 0)]
        uv = np.floor(camera.project(p_camera) + 0.5)
    inside = ((uv >= 0) & (uv < [camera.width, camera.height])).all(axis=1)
    column, row = uv[inside].astype(np.int64).T
    depth = np.full((camera.height, camera.width), np.inf)
    np.minimum.at(depth, (row, column), p_camera[inside, 2])
    return np.where(np.isfinite(depth), depth, 0.0)
