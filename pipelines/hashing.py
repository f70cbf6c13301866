"""A recording's hash, read in the background while its scene is learned."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from liex_lab.runtime.progress import Progress
from liex_lab.runtime.threads import in_background

if TYPE_CHECKING:
    from liex_lab.recordings.recording import Recording


class _NotWanted(Exception):
    """The block has ended before."""


@contextmanager
def hashed_ahead(
    recording: Recording, folder: Path, progress: Progress
) -> Iterator[Callable[[], None]]:
    """Hash a recording's files on a thread of its own while the block runs.

    Hours of recording take a minute, in which a core would be idle. Where the block ends by an
    error the rest is not read. A recording in no file is hashed by its pictures, which the block
    wants to itself: of that nothing is done here.

    Args:
        recording: an open recording; it keeps its hash.
        folder: the folder of the unfinished session, see `hash_once`.
        progress: told how many MB were read, as soon as that is waited for.

    Yields:
        A function that waits for the hash.
    """
    from liex_lab.sessions.checkpoint import hash_once

    left: list[bool] = []
    waiting: list[bool] = []

    def tell(done: int, total: int | None, what: str) -> None:
        if left:
            raise _NotWanted
        if waiting:
            progress(done, total, what)

    def hash_it() -> None:
        if recording.sources:
            hash_once(recording, folder, tell)

    with in_background(hash_it) as result:

        def wait() -> None:
            waiting.append(True)
            result()

        try:
            yield wait
        finally:
            left.append(True)
