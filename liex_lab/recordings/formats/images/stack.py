"""Interface of a stack of stored pictures of one size, and its form with one picture to a file.

Files are first looked at (header, length) without decoding any; damaged ones stay in their place
and read as None.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple, Protocol

from numpy.typing import NDArray

from liex_lab.errors import RecordingError
from liex_lab.runtime.progress import Progress

MAX_PIXELS = 1 << 24  # well above any depth camera; a header that states more is damaged

Size = tuple[int, int]  # width, height, pixels


class Stack(Protocol):
    """Pictures of one size, in order, as the files hold them."""

    @property
    def width(self) -> int:
        """Columns of a picture, px."""

    @property
    def height(self) -> int:
        """Rows of a picture, px."""

    @property
    def whole(self) -> list[bool]:
        """(n,) True for pictures that are not cut short or damaged.

        As far as that shows without decoding them.
        """

    @property
    def problems(self) -> list[str]:
        """Sentences about the files as a whole."""

    @property
    def truncated(self) -> bool:
        """True where a picture, or the end of a stack, is missing."""

    def __len__(self) -> int: ...

    def read(self, index: int) -> NDArray[Any] | None:
        """Stored values of one picture.

        Args:
            index: number of the picture.

        Returns:
            (H, W), or (H, W, 3) of colour pictures; None where the picture is cut or damaged.
        """

    def label(self, index: int) -> str:
        """Name of a picture, for a sentence.

        Args:
            index: number of the picture.

        Returns:
            The file, and where in it.
        """

    def close(self) -> None:
        """Let go of open files."""


class Look(NamedTuple):
    """What a file says before its picture is decoded.

    Attributes:
        size: (width, height), px; None where it is cut or damaged.
        why: the error that says what else it is; None where it is of its kind.
    """

    size: Size | None
    why: RecordingError | None = None


DAMAGED = Look(None)


@dataclass(frozen=True)
class FileStack:
    """A stack with one picture to a file.

    Attributes:
        files: the pictures, in order.
        width: columns of a picture, px.
        height: rows of a picture, px.
        whole: (n,) True for pictures that are not cut short or damaged.
        decode: gives the stored values of a file; None where it is damaged.
        problems: sentences about the files as a whole.
    """

    files: list[Path]
    width: int
    height: int
    whole: list[bool]
    decode: Callable[[Path], NDArray[Any] | None]
    problems: list[str] = field(default_factory=list)

    def __len__(self) -> int:
        return len(self.files)

    @property
    def truncated(self) -> bool:
        """True where a picture is cut short or damaged."""
        return not all(self.whole)

    def read(self, index: int) -> NDArray[Any] | None:
        """Stored values of one picture.

        Args:
            index: number of the picture.

        Returns:
            (H, W), or (H, W, 3) of colour pictures; None where the picture is cut or damaged.
        """
        picture = self.decode(self.files[index]) if self.whole[index] else None
        return (
            picture
            if picture is not None and picture.shape[:2] == (self.height, self.width)
            else None
        )

    def label(self, index: int) -> str:
        """Name of a picture's file, for a sentence.

        Args:
            index: number of the picture.

        Returns:
            The file's name.
        """
        return self.files[index].name

    def close(self) -> None:
        """Do nothing, for no file is held open."""


def open_files(
    files: list[Path],
    kind: str,
    look: Callable[[Path], Look],
    decode: Callable[[Path], NDArray[Any] | None],
    progress: Progress,
) -> FileStack:
    """Open pictures, one to a file: every file is looked at and none is decoded.

    Args:
        files: the pictures, in order.
        kind: their kind, for sentences, such as "PNG".
        look: reads a file's header; raises for a picture that is whole but no depth.
        decode: gives the stored values of a file; None where it is damaged.
        progress: told how many were looked at.

    Returns:
        The pictures as a stack.

    Raises:
        RecordingError: none is whole, or their sizes differ.
    """
    looks = []
    for number, path in enumerate(files, start=1):
        looks.append(look(path))
        progress(number, len(files), "looking at the pictures")
    sizes: dict[Size, Path] = {}
    for path, found in zip(files, looks, strict=True):
        if found.size is not None:
            sizes.setdefault(found.size, path)
    if not sizes:
        raise next(
            (found.why for found in looks if found.why is not None), None
        ) or none_whole_error(files, kind)
    if len(sizes) > 1:
        raise one_size_error([(path.name, *size) for size, path in sizes.items()])
    ((width, height),) = sizes
    return FileStack(files, width, height, [found.size is not None for found in looks], decode)


def none_whole_error(files: list[Path], kind: str) -> RecordingError:
    """The error for pictures none of which can be read.

    Args:
        files: the pictures.
        kind: their kind, such as "PNG".

    Returns:
        The error, to be raised.
    """
    return RecordingError(
        f"none of the {len(files)} {kind} pictures in {files[0].parent} is whole; copy them again"
        if len(files) > 1
        else f"{files[0]} is cut short and holds no whole picture; copy it again"
    )


def something_else(path: Path, kind: str) -> Look:
    """The finding that a file's first bytes are not those of its kind.

    Args:
        path: the file.
        kind: what its name says it is, such as "PNG".

    Returns:
        A look without a size, and with the error.
    """
    return Look(
        None,
        RecordingError(
            f"{path} is named like a {kind} picture but holds something else; remove it or give it "
            "its name"
        ),
    )


def too_large(size: Size) -> bool:
    """Whether a stated size is beyond any depth camera (2^24 px), and so no size.

    Args:
        size: (width, height), px.

    Returns:
        True where it is too large.
    """
    return size[0] * size[1] > MAX_PIXELS


def not_depth_error(where: str, found: str, width: int, height: int) -> RecordingError:
    """The error for a picture that cannot hold depth.

    Args:
        where: the file.
        found: what it holds, such as "8-bit grey".
        width: its columns, px.
        height: its rows, px.

    Returns:
        The error, to be raised.
    """
    article = "an" if found.startswith(("8", "11", "18")) else "a"
    return RecordingError(
        f"expected 16-bit depth, got {article} {found} image of {width} x {height} pixels "
        f"({where}); give the camera's "
        'depth pictures, or choose them with a line such as pattern = "*_depth.png" under '
        "[camera] in camera.toml"
    )


def one_size_error(pictures: list[tuple[str, int, int]]) -> RecordingError:
    """The error for pictures of several sizes in one recording.

    Args:
        pictures: (name, width, height) of one picture of each size.

    Returns:
        The error, to be raised.
    """
    (one, w, h), (other, v, g) = pictures[:2]
    return RecordingError(
        f"all pictures of a recording have one size, but {one} has {w} x {h} pixels and {other} "
        f"{v} x {g}; put them into two folders"
    )
