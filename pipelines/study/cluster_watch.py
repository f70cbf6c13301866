"""What looks after a Dask cluster while a study is measured, and ends the study if that is in vain.

Dask waits for ever for workers that nobody starts any more.
"""

from __future__ import annotations

import threading
import time
from abc import ABC, abstractmethod
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

from liex_lab.errors import StudyError

if TYPE_CHECKING:
    from distributed import Client

_FORGOTTEN_S = 8.0  # a nanny whose process has been gone for so long starts no other by itself
_NONE_LEFT_S = 60.0  # and so long none of a study's worker processes was there at all
_CLOSING = ("closing", "closed", "closing_gracefully")


class Watch(ABC):
    """Within the block, a look at the cluster every so often, by a thread.

    Attributes:
        gave_up: why the study is ended; empty while there is no reason.
    """

    def __init__(self, client: Client, every_s: float) -> None:
        """Nothing is looked at yet.

        Args:
            client: of the cluster; its pending futures are the sessions that are left.
            every_s: between two looks, s.
        """
        self.gave_up = ""
        self._client, self._every_s = client, every_s
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._watch, name="cluster watch", daemon=True)

    @abstractmethod
    def look(self) -> None:
        """Look once: mend what can be mended, or state in `gave_up` why nothing can."""

    def __enter__(self) -> Self:
        """Begin to look."""
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        tb: TracebackType | None,
    ) -> None:
        """No more looking.

        Raises:
            StudyError: the study was ended by this.
        """
        self._over.set()
        self._thread.join()
        if self.gave_up and isinstance(error, StudyError):
            raise StudyError(self.gave_up) from None

    def _watch(self) -> None:
        from distributed import Future

        while not self._over.wait(self._every_s):
            self.look()
            if self.gave_up:
                self._client.cancel([Future(key, self._client) for key in self._client.futures])
                return


class KeptWorkers(Watch):
    """Worker processes of this machine.

    Its nanny starts a worker again when it has died, but for one that died while it was started.
    """

    def __init__(self, client: Client, cluster: Any, every_s: float = 5.0) -> None:
        """Look at the workers of a cluster.

        Args:
            client: of the cluster.
            cluster: a `distributed.LocalCluster`.
            every_s: between two looks, s.
        """
        super().__init__(client, every_s)
        self._cluster = cluster
        self._gone_since: dict[Any, float] = {}  # by nanny

    def look(self) -> None:
        """Start workers again that nobody does, and give up where none comes for a minute."""
        nannies = list(self._cluster.workers.values())
        now = time.monotonic()
        gone = [nanny for nanny in nannies if not _is_alive(nanny)]
        self._gone_since = {nanny: self._gone_since.get(nanny, now) for nanny in gone}
        waited = {nanny: now - since for nanny, since in self._gone_since.items()}
        for nanny, seconds in waited.items():
            if seconds >= _FORGOTTEN_S and nanny.status.name not in _CLOSING:
                self._cluster.loop.add_callback(nanny.instantiate)
        if len(gone) == len(nannies) and min(waited.values(), default=_NONE_LEFT_S) >= _NONE_LEFT_S:
            self.gave_up = (
                "the study's worker processes have ended and could not be started again; see "
                "whether the machine has memory left, or use fewer workers; the sessions that were "
                "measured are kept, and the same command goes on with the rest"
            )


def _is_alive(nanny: Any) -> bool:
    """Whether the process that a nanny of Dask looks after is there."""
    import psutil

    pid = nanny.pid
    if not pid:
        return False
    try:
        return bool(psutil.Process(pid).status() != psutil.STATUS_ZOMBIE)
    except psutil.Error:
        return False
