"""Room on disk that a session takes, estimated before its first frame.

    bytes = once + n_frames (1,000 + 260 J + 2 (c A + 1,500))

Of every frame there are rows of tables and messages, some 260 bytes a joint, and two copies of the
depth that is kept (session.rrd, session.mcap): A pixels that pack to c bytes each, as pictures of
the recording itself do. Once there are a report, figures, descriptions and sixteen thumbnails. The
numbers were measured on sessions of mice, fish and hands of 100 to 1,500 frames; the estimate is
within a factor of two of what they take.
"""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from liex_lab.errors import SessionError
from liex_lab.sessions.cutouts import ALL, ANIMAL, NONE
from liex_lab.sessions.older import part_folder

_ONCE = 1_200_000
_A_FRAME = 1_000
_A_JOINT = 260
_A_CUTOUT = 1_500
_COPIES = 2
_THUMBNAILS = 16
_THUMBNAIL_SIDE = 2.3  # lengths of the animal
_CUTOUT_SIDE = 1.1
_CUTOUT_PX = 8.0
_LEVEL = 3  # of Zstandard, as the logs are packed
_SURE = 0.5  # of the estimate: with less room than that it is no use to begin


@dataclass(frozen=True)
class Shown:
    """How the animal lies in a recording's pictures.

    Attributes:
        n_frames: frames of the recording.
        n_joints: joints of the animal.
        length_px: its length in the picture, px.
        pictures: some pictures (H, W) as they are stored, uint16 mm.
    """

    n_frames: int
    n_joints: int
    length_px: float
    pictures: Sequence[NDArray[np.uint16]]


def needed_bytes(shown: Shown, kept: str = ANIMAL) -> int:
    """Bytes that a session takes, see above.

    Args:
        shown: how the animal lies in the recording's pictures.
        kept: how much of the depth is kept, as in `[replay] depth`.
    """
    a_pixel = _packed(shown.pictures)
    a_frame = _A_FRAME + _A_JOINT * shown.n_joints
    if kept != NONE:
        whole = float(np.mean([picture.size for picture in shown.pictures] or [0]))
        around = min((_CUTOUT_SIDE * shown.length_px + _CUTOUT_PX) ** 2, whole)
        kept_px = around if kept == ANIMAL else whole
        a_frame += int(_COPIES * (a_pixel * kept_px + (0 if kept == ALL else _A_CUTOUT)))
    thumbnails = _THUMBNAILS * (_THUMBNAIL_SIDE * shown.length_px) ** 2 * a_pixel
    return _ONCE + int(thumbnails) + shown.n_frames * a_frame


def check_room(folder: Path, needed: int) -> None:
    """Refuse to begin a session that the disk has by far no room for.

    What an unfinished session of that place has written already is there. Whoever has between half
    and all of the estimate may begin, for it is no more than that.

    Args:
        folder: the session folder to be.
        needed: what it takes, bytes.

    Raises:
        SessionError: the disk has less than half of that.
    """
    nearest = next(place for place in folder.absolute().parents if place.is_dir())
    begun = part_folder(folder)
    written = folder_bytes(begun)
    free = shutil.disk_usage(nearest).free
    if free < _SURE * (needed - written):
        raise SessionError(
            f"the session takes about {megabytes(needed - written)} and the disk that holds "
            f"{nearest} has {megabytes(free)} free; make room there, choose another place (--out, "
            "in Python out=), or keep less depth (--set replay.depth=animal or none)"
        )


def folder_bytes(folder: Path) -> int:
    """Bytes of all files of a folder; 0 of one that is not there.

    Args:
        folder: the folder.
    """
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())


def megabytes(size: float) -> str:
    """A size as people read it, in MB or GB.

    Args:
        size: bytes.
    """
    return f"{size / 1e9:.1f} GB" if size >= 1e9 else f"{size / 1e6:.1f} MB"


def _packed(pictures: Sequence[NDArray[np.uint16]]) -> float:
    """Bytes that a pixel packs to."""
    import zstandard

    packer = zstandard.ZstdCompressor(level=_LEVEL)
    size = sum(len(packer.compress(np.ascontiguousarray(one).tobytes())) for one in pictures)
    return size / max(sum(picture.size for picture in pictures), 1)
