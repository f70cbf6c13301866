"""Depth images of a session's frames, from its own files."""

from __future__ import annotations

import threading
from contextlib import ExitStack
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from liex_lab.errors import LiexError
from liex_lab.sessions import cutouts

from ..video.relief import put_back

if TYPE_CHECKING:
    from liex_lab.recordings.recording import Recording
    from liex_lab.sessions import Session

_HELD = 3  # session.mcap files that stay open


class Frames:
    """Depth images by session and row; their source files stay open for a while.

    Thread-safe.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._open: dict[str, tuple[Any, ExitStack, Recording]] = {}

    def depth(self, key: str, session: Session, row: int) -> NDArray[np.uint16] | None:
        """(H, W) uint16 mm, 0 where unread; None if the session has no depth of this frame.

        Outside the stored cut-outs, it is the static background. Without a readable replay file, a
        thumbnail of the same frame is used.

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
                known = self._open.pop(key, None)
                if known is None or known[0] != stamp:
                    if known is not None:
                        known[1].close()
                    stack = ExitStack()
                    known = (stamp, stack, stack.enter_context(cutouts.open_depth(session)))
                self._open[key] = known
                while len(self._open) > _HELD:
                    self._open.pop(next(iter(self._open)))[1].close()
                return np.asarray(known[2].frame(row).depth, np.uint16)
            except (LiexError, OSError, IndexError):
                return _kept(session, row)

    def close(self) -> None:
        """Close all files."""
        with self._lock:
            while self._open:
                self._open.popitem()[1][1].close()


def _kept(session: Session, row: int) -> NDArray[np.uint16] | None:
    """The thumbnail of this frame at its position in the whole image; None if absent."""
    import cv2

    index = int(session.frames["frame_index"].iloc[row])
    for entry in session.metadata.get("thumbnails", []):
        if entry["frame_index"] != index:
            continue
        cut = cv2.imread(str(session.path / entry["file"]), cv2.IMREAD_UNCHANGED)
        if cut is not None:
            shape = (session.camera.height, session.camera.width)
            picture = np.asarray(cut, np.uint16)
            return put_back(picture, int(entry["left_px"]), int(entry["top_px"]), shape)
    return None
