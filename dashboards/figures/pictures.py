"""Depth pictures of a session for figures and videos, by the one function that reads them."""

from __future__ import annotations

from types import TracebackType

import numpy as np
from numpy.typing import NDArray

from liex_lab.sessions import Session
from liex_lab.sessions.cutouts import meant_to_keep_depth

from ..app.frames import Frames


class DepthReader:
    """The depth pictures of a session's replay, open for a while (a context manager).

    Args:
        session: the opened session.
    """

    def __init__(self, session: Session) -> None:
        self._session = session
        self._frames = Frames()

    def __enter__(self) -> DepthReader:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the file that is open."""
        self._frames.close()

    @property
    def whole(self) -> bool:
        """Whether the session's replay keeps depth, beyond the thumbnails of the report."""
        return meant_to_keep_depth(self._session) and self._session.has("session.mcap")

    def picture(self, row: int) -> NDArray[np.uint16] | None:
        """(H, W) uint16 mm, 0 where unread; None where the session keeps none of this frame.

        Args:
            row: the frame's row in the table `frames`.
        """
        return self._frames.depth(self._session.name, self._session, row)
