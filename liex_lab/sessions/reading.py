"""Error translation for reading files of a session: whatever goes wrong becomes one sentence."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from liex_lab.errors import LiexError, SessionError, one_line


@contextmanager
def reading_from(path: Path) -> Iterator[Path]:
    """Within the block, turn any error into a SessionError that names the file as damaged.

    A LiexError passes as it is.

    Args:
        path: the file that is read in the block; it is what the `with` statement gives.

    Raises:
        SessionError: anything went wrong in the block.
    """
    try:
        yield path
    except LiexError:
        raise
    except Exception as error:
        raise SessionError(
            f"{path} is damaged and cannot be read ({type(error).__name__}: {one_line(error)}); "
            "run `liex run` on the recording again"
        ) from None
