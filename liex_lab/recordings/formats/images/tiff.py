"""TIFF images, 16-bit or float32 grey, one or many per file, including BigTIFF and ImageJ.

Contiguous uncompressed pixels are read directly from their offset; other pages are decoded by
tifffile, and codecs that need an optional package of tifffile (LZW) by OpenCV. A stack ends at its
first bad page, because later ones may be noise.
"""

from __future__ import annotations

import logging
import lzma
import zlib
from dataclasses import dataclass, field
from pathlib import Path
from threading import Lock
from typing import Any, NamedTuple

import numpy as np
import tifffile
from numpy.typing import NDArray

from liex_lab.errors import RecordingError
from liex_lab.recordings.formats.images.files import (
    Stack,
    none_whole_error,
    not_depth_error,
    one_size_error,
    too_large,
)
from liex_lab.runtime.progress import Progress

_SPARE = 1 << 20  # bytes
_LZMA = (34925,)
_LZMA_MEMORY = 1 << 28  # bytes; the largest of its usual levels needs 64 MB
_UNPACKERS = (8, 32946, 50013, *_LZMA)  # codes of compression: DEFLATE, LZMA

# tifffile reports damage twice, as an exception and in the log; hide the
# log
logging.getLogger("tifffile").addHandler(logging.NullHandler())

_LEAST_DIRECTORY = 30  # bytes: the directory of an image has more
_DEPTHS = ("u2", "i2", "f4")  # types of depth pixels
_KINDS = {"u": "unsigned integer ", "i": "signed integer ", "f": "floating-point "}
_SIGNATURES = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")


class _Page(NamedTuple):
    """One image.

    Attributes:
        path: its file.
        page: its page in the file.
        offset: position of contiguous plain pixels, else -1.
        dtype: of the pixels, with byte order.
        whole: True if it is not cut short.
    """

    path: Path
    page: int
    offset: int
    dtype: str
    whole: bool


@dataclass
class TiffStack(Stack):
    """TIFF images of one size, in order, with one file open at a time.

    Attributes:
        pages: the images.
        width: columns of an image, px.
        height: rows of an image, px.
        problems: sentences about stacks that are cut short.
    """

    pages: list[_Page]
    width: int
    height: int
    problems: list[str]
    _open: tifffile.TiffFile | None = None
    _open_path: Path | None = None
    _lock: Lock = field(default_factory=Lock)

    def __len__(self) -> int:
        return len(self.pages)

    @property
    def whole(self) -> list[bool]:
        """(n,) True for images that are not cut short."""
        return [page.whole for page in self.pages]

    @property
    def truncated(self) -> bool:
        """True if an image, or the end of a stack, is missing."""
        return bool(self.problems) or not all(self.whole)

    def read(self, index: int) -> NDArray[Any] | None:
        """Stored values of one image, (H, W) uint16, int16 or float32; None if it is cut or
        damaged.
        """
        page = self.pages[index]
        if not page.whole:
            return None
        if page.offset >= 0:
            count = self.width * self.height
            return np.fromfile(page.path, page.dtype, count, offset=page.offset).reshape(
                self.height, self.width
            )
        with self._lock:
            picture = self._decode(page)
        return (
            picture if picture is not None and picture.shape == (self.height, self.width) else None
        )

    def _decode(self, page: _Page) -> NDArray[Any] | None:
        if self._open_path != page.path:
            self.close()
            self._open = tifffile.TiffFile(page.path)
            self._open_path = page.path
        assert self._open is not None
        try:
            self._check_unpacked(self._open, page.page)
            return self._open.asarray(key=page.page)
        except _LargerThanStatedError:
            return None
        except Exception:  # damage in compressed data raises almost any exception
            return _decode_with_opencv(page)

    def _check_unpacked(self, tif: tifffile.TiffFile, number: int) -> None:
        """Raises an error if a packed piece is larger than the image after unpacking.

        tifffile unpacks whole pieces of DEFLATE and LZMA in memory, of any size.
        """
        page: Any = tif.pages[number]
        if page.compression not in _UNPACKERS:
            return
        most = 4 * self.width * self.height + _SPARE
        for offset, count in zip(page.dataoffsets, page.databytecounts, strict=True):
            tif.filehandle.seek(offset)
            if not _fits(tif.filehandle.read(count), page.compression, most):
                raise _LargerThanStatedError

    def label(self, index: int) -> str:
        """Name of an image, for a message: its page and file."""
        page = self.pages[index]
        return f"page {page.page} of {page.path.name}"

    def close(self) -> None:
        """Close the open file."""
        if self._open is not None:
            self._open.close()
        self._open = self._open_path = None


class _LargerThanStatedError(Exception):
    """A packed piece of an image contains more than the image."""


def _fits(packed: bytes, compression: int, most: int) -> bool:
    """Whether a packed piece unpacks to at most `most` bytes."""
    unpacked = 0
    try:
        if compression in _LZMA:
            unpacker = lzma.LZMADecompressor(memlimit=_LZMA_MEMORY)
            while unpacked <= most and not unpacker.eof:
                unpacked += len(unpacker.decompress(packed, _SPARE))
                packed = b""
                if unpacker.needs_input:
                    break
        else:
            state = zlib.decompressobj()
            while unpacked <= most and packed and not state.eof:
                unpacked += len(state.decompress(packed, _SPARE))
                packed = state.unconsumed_tail
    except lzma.LZMAError:
        return False
    except zlib.error:
        return True  # the decoder reports damage
    return unpacked <= most


def _decode_with_opencv(page: _Page) -> NDArray[Any] | None:
    """Decode LZW and other codecs that tifffile lacks; None if OpenCV fails as well."""
    import cv2

    try:
        found, pictures = cv2.imreadmulti(str(page.path), page.page, 1, flags=cv2.IMREAD_UNCHANGED)
    except cv2.error:
        return None
    return np.asarray(pictures[0]) if found and pictures and pictures[0].ndim == 2 else None


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
    sizes: dict[tuple[int, int], str] = {}
    for number, path in enumerate(files, start=1):
        found, size, ends = _list_pages(path)
        n_whole = next((i for i, page in enumerate(found) if not page.whole), len(found))
        if n_whole and (n_whole < len(found) or not ends):
            # a stack ends at its first bad page: later ones may be noise
            problems.append(
                f"{path.name} is cut short: only its first {n_whole} pictures are whole"
            )
            found = found[:n_whole]
        pages += found or [_Page(path, 0, -1, "<u2", False)]
        if size is not None:
            sizes.setdefault(size, path.name)
        progress(number, len(files), "looking at the pictures")
    if not any(page.whole for page in pages):
        raise none_whole_error(files, "TIFF")
    if len(sizes) > 1:
        raise one_size_error([(name, *size) for size, name in sizes.items()])
    ((width, height),) = sizes
    return TiffStack(pages, width, height, problems)


def _list_pages(path: Path) -> tuple[list[_Page], tuple[int, int] | None, bool]:
    """The images of one file in order, their (width, height), and whether the page list is
    complete.

    No images and no size if the directory is cut off.
    """
    size_bytes = path.stat().st_size
    with path.open("rb") as file:
        head = file.read(4)
    if len(head) == 4 and head not in _SIGNATURES:
        raise RecordingError(
            f"{path} is named like a TIFF picture but holds something else; remove it"
        )
    listed: list[_Page] = []
    size: tuple[int, int] | None = None
    try:
        with tifffile.TiffFile(path) as tif:
            page: Any
            seen: set[int] = set()
            for page in tif.pages:
                if page.offset in seen or len(listed) * _LEAST_DIRECTORY > size_bytes:
                    return listed, size, False  # the list of directories is circular
                seen.add(page.offset)
                listed.append(_describe(path, len(listed), page, size_bytes))
                size = size or (int(page.imagewidth), int(page.imagelength))
            ends = _list_ends(tif)
            return (
                (_imagej_stack(tif, listed[0], size_bytes) if len(listed) == 1 else listed),
                size,
                ends,
            )
    except RecordingError:
        if not any(page.whole for page in listed):
            raise
        # a damaged directory, or an image of another kind after the depth: the stack ends before
        # it
        return listed, size, False
    except Exception:  # the directory of a cut file is garbage and raises almost any exception
        return listed, size, False


def _list_ends(tif: tifffile.TiffFile) -> bool:
    """Whether the last page found is marked as the last: each page ends with the offset of the
    next.
    """
    layout = tif.tiff
    last = tif.pages[len(tif.pages) - 1]
    file = tif.filehandle
    file.seek(last.offset)
    n_tags = int.from_bytes(
        file.read(layout.tagnosize), "little" if tif.byteorder == "<" else "big"
    )
    file.seek(last.offset + layout.tagnosize + n_tags * layout.tagsize)
    return file.read(layout.offsetsize) == bytes(layout.offsetsize)


def _describe(path: Path, index: int, page: Any, size_bytes: int) -> _Page:
    width = int(page.imagewidth)
    height = int(page.imagelength)
    dtype = np.dtype(page.dtype or "V1")
    if (
        page.samplesperpixel != 1
        or dtype.kind + str(dtype.itemsize) not in _DEPTHS
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
        offset=int(page.dataoffsets[0]) if plain else -1,
        dtype=page.parent.byteorder + dtype.kind + str(dtype.itemsize),
        whole=bool(ends) and max(ends) <= size_bytes and agrees and not too_large((width, height)),
    )


def _imagej_stack(tif: tifffile.TiffFile, first: _Page, size_bytes: int) -> list[_Page]:
    """The images of an ImageJ stack over 4 GB, described as one page and stored without gaps."""
    shape = tif.series[0].shape if tif.series else ()
    n_pictures = int(np.prod(shape[:-2])) if len(shape) > 2 else 1
    if n_pictures == 1 or first.offset < 0:
        return [first]
    n_bytes = shape[-1] * shape[-2] * int(first.dtype[-1])
    offsets = [first.offset + k * n_bytes for k in range(n_pictures)]
    return [
        first._replace(page=k, offset=o, whole=o + n_bytes <= size_bytes)
        for k, o in enumerate(offsets)
    ]
