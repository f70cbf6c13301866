"""Depth picture of any frame of a session, as it is kept there."""

from __future__ import annotations

import threading
from contextlib import ExitStack
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from liex_lab.errors import LiexError
from liex_lab.sessions import cutouts
from liex_lab.sessions.seeking import SeekablePictures

if TYPE_CHECKING:
    from liex_lab.recordings.recording import Recording
    from liex_lab.sessions import Session

_HELD = 3  # session.mcap files that stay open


class Frames:
    """Depth pictures by session and row; the files that they come from stay open for a while.

    It may be used from several threads at once.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._open: dict[str, tuple[Any, ExitStack, Recording]] = {}
        self._seekable: dict[str, tuple[Any, SeekablePictures | None, NDArray[Any]]] = {}

    def depth(self, key: str, session: Session, row: int) -> NDArray[np.uint16] | None:
        """(H, W) uint16 mm, 0 where unread; None where the session keeps no depth of this frame.

        Outside of the cut-outs that a session keeps it is the still scene. Without a replay file
        that can be read, a thumbnail of this very frame does.

        Args:
            key: the session's name in the study.
            session: the opened session.
            row: the frame's row in the table `frames`.
        """
        path = session.path / "session.mcap"
        with self._lock:
            try:
                found = path.stat()
                stamp = (found.st_mtime_ns, found.st_size, found.st_ino)
                sought = self._sought(key, session, stamp, row)
                if sought is not None:
                    return sought
                known = self._open.pop(key, None)
                if known is None or known[0] != stamp:
                    if known is not None:
                        known[1].close()
                    stack = ExitStack()
                    known = (stamp, stack, stack.enter_context(cutouts.open_pictures(session)))
                self._open[key] = known
                while len(self._open) > _HELD:
                    self._open.pop(next(iter(self._open)))[1].close()
                return np.asarray(known[2].frame(row).depth, np.uint16)
            except (LiexError, OSError, IndexError):
                return _kept(session, row)

    def _sought(
        self, key: str, session: Session, stamp: Any, row: int
    ) -> NDArray[np.uint16] | None:
        """The picture by the index of its file; None where that does not know it."""
        known = self._seekable.pop(key, None)
        if known is None or known[0] != stamp:
            if known is not None and known[1] is not None:
                known[1].close()
            times_ns = session.table("frames", ["time_ns"])["time_ns"].to_numpy(np.int64)
            try:
                pictures = SeekablePictures(session.path / "session.mcap", session.camera)
                known = (stamp, pictures, times_ns)
            except LiexError:
                known = (stamp, None, times_ns)
        self._seekable[key] = known
        while len(self._seekable) > _HELD:
            old = self._seekable.pop(next(iter(self._seekable)))[1]
            if old is not None:
                old.close()
        _, pictures_there, times_ns = known
        if pictures_there is None or not 0 <= row < len(times_ns):
            return None
        return pictures_there.at(int(times_ns[row]))

    def close(self) -> None:
        """Close the files that are open."""
        with self._lock:
            while self._seekable:
                pictures = self._seekable.popitem()[1][1]
                if pictures is not None:
                    pictures.close()
            while self._open:
                self._open.popitem()[1][1].close()


def _kept(session: Session, row: int) -> NDArray[np.uint16] | None:
    """The thumbnail of this very frame, put back where it was cut out; None where there is none."""
    import cv2

    index = int(session.frames["frame_index"].iloc[row])
    for entry in session.metadata.get("thumbnails", []):
        if entry["frame_index"] != index:
            continue
        cut = cv2.imread(str(session.path / entry["file"]), cv2.IMREAD_UNCHANGED)
        if cut is not None:
            depth = np.zeros((session.camera.height, session.camera.width), np.uint16)
            left = int(entry["left_px"])
            top = int(entry["top_px"])
            x0 = max(left, 0)
            y0 = max(top, 0)
            x1 = min(left + cut.shape[1], depth.shape[1])
            y1 = min(top + cut.shape[0], depth.shape[0])
            depth[y0:y1, x0:x1] = cut[y0 - top : y1 - top, x0 - left : x1 - left]
            return depth
    return None
