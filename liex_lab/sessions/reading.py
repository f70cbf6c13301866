"""Files of a session that may be damaged: reading them gives an answer or one sentence."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from liex_lab.errors import LiexError, SessionError, one_line


@contextmanager
def reading_from(path: Path) -> Iterator[Path]:
    """Within the block, whatever goes wrong is a damaged file's fault: a SessionError names it."""
    try:
        yield path
    except LiexError:
        raise
    except Exception as error:
        raise SessionError(
            f"{path} is damaged and cannot be read ({type(error).__name__}: {one_line(error)}); "
            "run `liex run` on the recording again"
        ) from None
