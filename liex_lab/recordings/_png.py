"""16-bit PNG pictures: what the header says, whether the file is whole, and its pixels."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from liex_lab.errors import RecordingError
from liex_lab.progress import Progress

_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_END = struct.pack(">I", 0) + b"IEND\xaeB`\x82"  # the last chunk: no data, its name, its CRC
_HEAD_BYTES = 26  # signature, then the length, name and first ten bytes of the header chunk
_COLOURS = {0: "grey", 2: "colour", 3: "palette colour", 4: "grey with transparency", 6: "colour with transparency"}


@dataclass(frozen=True)
class PngStack:
    """PNG pictures of one size, in order. width, height: pixels; whole: which of them are not cut short."""

    files: list[Path]
    width: int
    height: int
    whole: list[bool]

    def __len__(self) -> int:
        return len(self.files)

    @property
    def problems(self) -> list[str]:
        """Sentences about the files as a whole: none, for a picture stands alone."""
        return []

    @property
    def truncated(self) -> bool:
        """True where a picture is cut short."""
        return not all(self.whole)

    def read(self, index: int) -> NDArray[Any] | None:
        """Stored values (H, W) uint16; None where the picture is cut or damaged."""
        if not self.whole[index]:
            return None
        picture = decode_png(np.fromfile(self.files[index], np.uint8))
        return picture if picture is not None and picture.shape == (self.height, self.width) else None

    def label(self, index: int) -> str:
        """The file of a picture, for a sentence."""
        return self.files[index].name

    def close(self) -> None:
        """Nothing is held open."""


def decode_png(data: NDArray[np.uint8]) -> NDArray[np.uint16] | None:
    """Pixels (H, W) of a 16-bit grey PNG; None where it does not decode to that."""
    import cv2

    picture: NDArray[Any] | None = cv2.imdecode(data, cv2.IMREAD_UNCHANGED)
    return picture if picture is not None and picture.ndim == 2 and picture.dtype == np.uint16 else None


def open_pngs(files: list[Path], progress: Progress) -> PngStack:
    """Look at the head and the tail of every file, without decoding any."""
    sizes: dict[tuple[int, int], Path] = {}
    whole = []
    for number, path in enumerate(files, start=1):
        with path.open("rb") as file:
            head = file.read(_HEAD_BYTES)
            file.seek(max(0, path.stat().st_size - len(_END)))
            tail = file.read()
        if (size := png_size(head, str(path))) is not None:
            sizes.setdefault(size, path)
        whole.append(size is not None and tail == _END)
        progress(number, len(files), "looking at the pictures")
    if not any(whole):
        raise RecordingError(
            f"none of the {len(files)} PNG pictures in {files[0].parent} is whole; copy them again"
            if len(files) > 1
            else f"{files[0]} is cut short and holds no whole picture; copy it again"
        )
    if len(sizes) > 1:
        raise one_size_error([(path.name, *size) for size, path in sizes.items()])
    ((width, height),) = sizes
    return PngStack(files, width, height, whole)


def png_size(head: bytes, where: str) -> tuple[int, int] | None:
    """Width and height that a 16-bit grey PNG states in its first bytes; None where they are cut off."""
    if not head.startswith(_SIGNATURE[: len(head)]):
        raise RecordingError(
            f"{where} is named like a PNG picture but holds something else; remove it or give it its name"
        )
    if len(head) < _HEAD_BYTES:
        return None
    width, height, bits, colour = struct.unpack(">IIBB", head[16:26])
    if head[12:16] != b"IHDR" or colour not in _COLOURS or not (width and height):
        raise RecordingError(
            f"{where} begins like a PNG picture but its header makes no sense; remove it or copy it again"
        )
    if bits != 16 or colour != 0:
        raise not_depth_error(where, f"{bits}-bit {_COLOURS[colour]}", width, height)
    return width, height


def not_depth_error(where: str, found: str, width: int, height: int) -> RecordingError:
    """The sentence for a picture that cannot hold depth."""
    article = "an" if found.startswith(("8", "11", "18")) else "a"
    return RecordingError(
        f"expected 16-bit depth, got {article} {found} image of {width} x {height} pixels ({where}); give the camera's "
        'depth pictures, or choose them with a line such as pattern = "*_depth.png" under [camera] in camera.toml'
    )


def one_size_error(pictures: list[tuple[str, int, int]]) -> RecordingError:
    """The sentence for pictures of several sizes in one recording."""
    (one, w, h), (other, v, g) = pictures[:2]
    return RecordingError(
        f"all pictures of a recording have one size, but {one} has {w} x {h} pixels and {other} {v} x {g}; "
        "put them into two folders"
    )
