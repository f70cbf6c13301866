"""Workers for the stretches of one recording: processes of this machine. Those of a study are
Dask's, see `cohort`.
"""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Protocol, TypeVar

from liex_lab.errors import SessionError

Work = TypeVar("Work")
Done = TypeVar("Done")


class Crew(Protocol):
    """Whoever can do several things at once."""

    def each(self, do: Callable[[Work], Done], works: Sequence[Work]) -> Iterator[Done]:
        """What `do` makes of each of the works, as soon as it is there, in any order."""


@dataclass(frozen=True)
class Processes:
    """n processes of this machine; threads: cores for each, 0 an equal share."""

    n: int
    threads: int = 0

    def each(self, do: Callable[[Work], Done], works: Sequence[Work]) -> Iterator[Done]:
        """See `Crew`. Raises SessionError where a process ends without a word."""
        if not works:
            return
        count = min(self.n, len(works))
        threads = self.threads or max(1, n_cores() // count)
        context = multiprocessing.get_context("spawn")  # numba's threads do not live through a fork
        with _cores_for_each(threads), ProcessPoolExecutor(count, mp_context=context) as pool:
            try:
                for future in as_completed([pool.submit(do, work) for work in works]):
                    yield future.result()
            except BrokenProcessPool:
                raise SessionError(
                    "a worker process ended without a word, perhaps for want of memory; run the "
                    "same command again, it goes on where it was, or give fewer --workers"
                ) from None
            finally:
                pool.shutdown(cancel_futures=True)


def n_cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def worker_environment(n_threads: int) -> dict[str, str]:
    """So that workers share the cores instead of each taking all of them."""
    return {
        name: str(n_threads)
        for name in ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS")
    }


@contextmanager
def _cores_for_each(n_threads: int) -> Iterator[None]:
    """Processes that are started in the block use so many cores."""
    before = dict(os.environ)
    os.environ.update(worker_environment(n_threads))
    try:
        yield
    finally:
        os.environ.clear()
        os.environ.update(before)
