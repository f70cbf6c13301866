"""Pictures of one size in order, as stored: what a stack of any kind promises, and one made of
single files.
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
    """Pictures of one size, in order; `read` gives stored values (H, W), or None where a picture is
    cut or damaged.
    """

    @property
    def width(self) -> int:
        """Pixels in a row."""

    @property
    def height(self) -> int:
        """Rows in a picture."""

    @property
    def whole(self) -> list[bool]:
        """Which pictures are not cut short or damaged, as far as that shows without
        decoding them.
        """

    @property
    def problems(self) -> list[str]:
        """Sentences about the files as a whole."""

    @property
    def truncated(self) -> bool:
        """True where a picture, or the end of a stack, is missing."""

    def __len__(self) -> int: ...

    def read(self, index: int) -> NDArray[Any] | None:
        """Stored values (H, W), or (H, W, 3) of colour pictures; None where the picture is cut or
        damaged.
        """

    def label(self, index: int) -> str:
        """The file of a picture, for a sentence."""

    def close(self) -> None:
        """Let go of open files."""


class Look(NamedTuple):
    """What a file says before its picture is decoded. size: None where it is cut or damaged; why:
    what else it is.
    """

    size: Size | None
    why: RecordingError | None = None


DAMAGED = Look(None)


@dataclass(frozen=True)
class FileStack:
    """A picture per file; `decode` gives the stored values of a file, None where it is damaged."""

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
        """Stored values (H, W); None where the picture is cut or damaged."""
        picture = self.decode(self.files[index]) if self.whole[index] else None
        return (
            picture
            if picture is not None and picture.shape[:2] == (self.height, self.width)
            else None
        )

    def label(self, index: int) -> str:
        """The file of a picture, for a sentence."""
        return self.files[index].name

    def close(self) -> None:
        """Nothing is held open."""


def open_files(
    files: list[Path],
    kind: str,
    look: Callable[[Path], Look],
    decode: Callable[[Path], NDArray[Any] | None],
    progress: Progress,
) -> FileStack:
    """Look at every file without decoding any; `look` raises for a picture that is whole but no
    depth.
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
    """The sentence for pictures none of which can be read."""
    return RecordingError(
        f"none of the {len(files)} {kind} pictures in {files[0].parent} is whole; copy them again"
        if len(files) > 1
        else f"{files[0]} is cut short and holds no whole picture; copy it again"
    )


def something_else(path: Path, kind: str) -> Look:
    """A file whose first bytes are not those of its kind."""
    return Look(
        None,
        RecordingError(
            f"{path} is named like a {kind} picture but holds something else; remove it or give it "
            "its name"
        ),
    )


def too_large(size: Size) -> bool:
    """Whether a stated size is beyond any depth camera, and so no size."""
    return size[0] * size[1] > MAX_PIXELS


def not_depth_error(where: str, found: str, width: int, height: int) -> RecordingError:
    """The sentence for a picture that cannot hold depth."""
    article = "an" if found.startswith(("8", "11", "18")) else "a"
    return RecordingError(
        f"expected 16-bit depth, got {article} {found} image of {width} x {height} pixels "
        f"({where}); give the camera's "
        'depth pictures, or choose them with a line such as pattern = "*_depth.png" under '
        "[camera] in camera.toml"
    )


def one_size_error(pictures: list[tuple[str, int, int]]) -> RecordingError:
    """The sentence for pictures of several sizes in one recording."""
    (one, w, h), (other, v, g) = pictures[:2]
    return RecordingError(
        f"all pictures of a recording have one size, but {one} has {w} x {h} pixels and {other} "
        f"{v} x {g}; put them into two folders"
    )
