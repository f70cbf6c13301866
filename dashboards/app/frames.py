"""Depth picture of any frame of a session, as it is kept there, with the skeleton over it."""

from __future__ import annotations

import threading
from contextlib import ExitStack
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from liex_lab.errors import LiexError

if TYPE_CHECKING:
    from liex_lab.recordings.recording import Recording
    from liex_lab.sessions import Session

_HELD = 3  # session.mcap files that stay open
_LEAST_PX = 16


class Frames:
    """Depth pictures by session and row; the files that they come from stay open for a while.

    It may be used from several threads at once.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._open: dict[str, tuple[Any, ExitStack, Recording]] = {}

    def depth(self, key: str, session: Session, row: int) -> NDArray[np.uint16] | None:
        """(H, W) uint16 mm, 0 where unread; None where the session keeps no depth of this frame.

        Outside of the cut-outs that a session keeps it is the still scene. Without a replay file
        that can be read, a thumbnail of this very frame does.

        Args:
            key: the session's name in the study.
            session: the opened session.
            row: the frame's row in the table `frames`.
        """
        from liex_lab.sessions.cutouts import open_pictures

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
                    known = (stamp, stack, stack.enter_context(open_pictures(session)))
                self._open[key] = known
                while len(self._open) > _HELD:
                    self._open.pop(next(iter(self._open)))[1].close()
                return np.asarray(known[2].frame(row).depth, np.uint16)
            except (LiexError, OSError, IndexError):
                return _kept(session, row)

    def close(self) -> None:
        """Close the files that are open."""
        with self._lock:
            while self._open:
                self._open.popitem()[1][1].close()

    def figure(self, key: str, session: Session, row: int, *, whole: bool) -> dict[str, Any]:
        """The picture of a frame with its skeleton, as plotly takes it.

        Args:
            key: the session's name in the study.
            session: the opened session.
            row: the frame's row in the table `frames`.
            whole: the whole picture, else what is around the animal.
        """
        from . import plots

        depth = self.depth(key, session, row)
        index = int(session.frames["frame_index"].iloc[row])
        joints = session.table("poses", ["frame_index", "joint", "u_px", "v_px"], [index])
        uv = joints[["u_px", "v_px"]].to_numpy(float)
        posed = len(uv) > 0 and bool(np.isfinite(uv).all())
        if depth is None:
            height = session.camera.height
            width = session.camera.width
            depth = np.zeros((height, width), np.uint16)
        left, top, cut = (0, 0, depth) if whole or not posed else _around(depth, uv)
        bones = [(int(a), int(b)) for a, b in session.metadata["animal"]["bones"]] if posed else []
        reach_mm = 0.9 * float(np.nan_to_num(session.frames["spine_mm"].median(), nan=80.0))
        names = [str(name) for name in joints["joint"]] if posed else []
        shown = plots.frame_picture(cut, uv if posed else uv[:0], names, bones, left, top, reach_mm)
        if not posed:
            shown["layout"]["annotations"] = [
                {
                    "text": "no pose in this frame",
                    "showarrow": False,
                    "xref": "paper",
                    "yref": "paper",
                    "x": 0.5,
                    "y": 0.97,
                    "font": {"color": "#fff", "size": 13},
                    "bgcolor": "rgba(0,0,0,0.6)",
                    "borderpad": 4,
                }
            ]
        return shown


def _around(depth: NDArray[np.uint16], uv: np.ndarray) -> tuple[int, int, NDArray[np.uint16]]:
    """The square around a skeleton (J, 2) px: left, top, and what of it is in the picture."""
    centre = uv.mean(axis=0)
    half = max(1.6 * float(np.linalg.norm(uv - centre, axis=1).max()), _LEAST_PX)
    height, width = depth.shape
    left, right = (int(np.clip(round(centre[0] + side * half), 0, width)) for side in (-1, 1))
    top, bottom = (int(np.clip(round(centre[1] + side * half), 0, height)) for side in (-1, 1))
    if right - left < 2 or bottom - top < 2:
        return 0, 0, depth
    return left, top, depth[top:bottom, left:right]


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
