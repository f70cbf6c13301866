"""Random access to depth videos: FFV1 or raw 16-bit grey pictures in AVI or Matroska.

FFV1 pictures build on the ones before them back to the last key picture (one in twelve, usually),
so reading in order decodes each once, and reading at random some more.
"""

from __future__ import annotations

from pathlib import Path
from threading import Lock
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from liex_lab.errors import RecordingError
from liex_lab.recordings.formats.images.stack import too_large
from liex_lab.recordings.formats.video.index import FFV1, RAW, DepthTrack
from liex_lab.recordings.infrared import refuse_infrared
from liex_lab.runtime.progress import Progress

if TYPE_CHECKING:
    from liex_lab.recordings.formats.video.ffv1 import Ffv1

_N_ASKED = 3  # key pictures, one of which must be depth: the first may be damaged


class DepthVideo:
    """Depth track of a video file as pictures of one size; also a `Stack`.

    Attributes:
        track: where the pictures lie, and their times.
        width: columns of the pictures, px.
        height: rows of the pictures, px.
        problems: sentences about the file.
    """

    def __init__(self, path: Path, track: DepthTrack) -> None:
        """Open the file, and find the key pictures of FFV1.

        Args:
            path: the .avi or .mkv file.
            track: its index.

        Raises:
            RecordingError: its pictures are no 16-bit depth.
        """
        self.track = track
        self.width = track.width
        self.height = track.height
        self.problems: list[str] = []
        self._path = path
        self._file = path.open("rb", buffering=0)
        self._lock = Lock()
        self._ffv1: Ffv1 | None = None
        self._keys = np.zeros(0, np.int64)
        self._next = -1
        if track.codec == FFV1:
            try:
                self._begin_ffv1()
            except BaseException:
                self._file.close()
                raise

    def _begin_ffv1(self) -> None:
        """Find the key pictures, and refuse a stream whose pictures are no depth."""
        from liex_lab.recordings.formats.video.ffv1 import Ffv1, is_key, require_depth

        track = self.track
        heads = (self._bytes(k, 2) for k in range(len(self)))
        self._keys = np.array([k for k, head in enumerate(heads) if is_key(head)], np.int64)
        self._ffv1 = Ffv1(track.width, track.height, track.private)
        require_depth(
            self._ffv1, (self._bytes(int(k)) for k in self._keys[:_N_ASKED]), str(self._path)
        )

    def __len__(self) -> int:
        return len(self.track.offsets)

    @property
    def whole(self) -> list[bool]:
        """True for each picture, (n,), for those that are listed lie whole in the file."""
        return [True] * len(self)

    @property
    def truncated(self) -> bool:
        """True where the file ends too early."""
        return not self.track.whole

    def read(self, index: int) -> NDArray[np.uint16] | None:
        """Stored values of one picture.

        Args:
            index: number of the picture.

        Returns:
            (H, W) uint16; None where the picture, or one that it builds on, is damaged.
        """
        with self._lock:
            if self._ffv1 is None:
                kind = np.dtype(RAW[self.track.codec])
                data = self._bytes(index)
                if len(data) != self.width * self.height * kind.itemsize:
                    return None
                raw = np.frombuffer(data, kind).reshape(self.height, self.width)
                return raw.astype(np.uint16)
            before = np.searchsorted(self._keys, index, side="right") - 1
            if before < 0:
                return None
            key = int(self._keys[before])
            start = self._next if key < self._next <= index else key
            self._next = -1  # until the picture has come out
            picture = None
            for k in range(start, index + 1):
                picture = self._ffv1.decode(self._bytes(k))
                if picture is None or picture.shape != (self.height, self.width):
                    return None
            self._next = index + 1
            return picture

    def _bytes(self, index: int, at_most: int | None = None) -> bytes:
        self._file.seek(self.track.offsets[index])
        size = self.track.sizes[index]
        return self._file.read(size if at_most is None else min(size, at_most))

    def label(self, index: int) -> str:
        """Name of a picture, for a sentence.

        Args:
            index: number of the picture.

        Returns:
            The picture and the file.
        """
        return f"picture {index} of {self._path.name}"

    def close(self) -> None:
        """Close the file."""
        self._file.close()


def open_video(path: Path, progress: Progress) -> DepthVideo:
    """Find the depth pictures of an AVI or Matroska file.

    Args:
        path: the file; .mkv is read as Matroska, any other as AVI.
        progress: told how many MB were walked over.

    Returns:
        The pictures.

    Raises:
        RecordingError: there is no whole picture of 16-bit depth in FFV1 or uncompressed.
    """
    if path.suffix.lower() == ".mkv":
        from liex_lab.recordings.formats.video.mkv import index_mkv

        track = index_mkv(path, progress)
    else:
        from liex_lab.recordings.formats.video.avi import index_avi

        track = index_avi(path, progress)
    refuse_infrared(path, track.title or path.stem)
    if track.codec != FFV1 and track.codec not in RAW:
        named = f"is packed with {track.codec!r}" if track.codec else "has no video in it"
        raise RecordingError(
            f"expected 16-bit depth in FFV1 or uncompressed, but {path} {named}; give the video of "
            "the depth itself"
        )
    if (
        not track.offsets
        or not (track.width and track.height)
        or too_large((track.width, track.height))
    ):
        raise RecordingError(
            f"{path} is cut short or damaged and holds no whole picture; copy it again"
        )
    return DepthVideo(path, track)
