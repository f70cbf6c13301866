"""Worker pool of processes of this machine, for the shards of one recording.

Processes are spawned, as numba's threads do not survive a fork, and share the cores. The workers of
a study are Dask's, see `study.crew`.
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
from liex_lab.runtime.processes import end_children, end_with_parent

# that one process keeps busy: it uses more than one and a half
_CORES = 2
# each takes some 400 MB
_MOST = 4
# frames; a process takes two seconds to begin
_WORTH_SHARING = 6000
Work = TypeVar("Work")
Done = TypeVar("Done")


class WorkerPool(Protocol):
    """Whoever can do several tasks at once, such as processes or the workers of a cluster."""

    @property
    def fewest(self) -> int:
        """Recordings of no more frames are measured by one process: sharing them takes longer."""

    @property
    def here(self) -> bool:
        """Its workers read this machine's temporary files."""

    def each(self, do: Callable[[Work], Done], works: Sequence[Work]) -> Iterator[Done]:
        """What `do` makes of each of the tasks, as soon as it is there, in any order.

        Args:
            do: the task; it and its argument can be pickled.
            works: the arguments, one a task.
        """


@dataclass(frozen=True)
class Processes:
    """A pool of processes of this machine.

    Attributes:
        n: how many, at most one for each task.
        threads: cores of each; 0 takes an equal share.
        fewest: recordings of no more frames are not worth the start of processes.
        here: they read this machine's temporary files.
    """

    n: int
    threads: int = 0
    fewest: int = 0
    here: bool = True

    def each(self, do: Callable[[Work], Done], works: Sequence[Work]) -> Iterator[Done]:
        """What `do` makes of each of the tasks, as soon as it is there, in any order.

        Args:
            do: the task; it and its argument can be pickled.
            works: the arguments, one a task; without any, no process is started.

        Raises:
            SessionError: a process ended without a word, perhaps for want of memory.
        """
        if not works:
            return
        count = min(self.n, len(works))
        threads = self.threads or max(1, n_cores() // count)
        context = multiprocessing.get_context("spawn")  # numba's threads do not live through a fork
        others = {child.pid for child in multiprocessing.active_children() if child.pid}
        with (
            _cores_for_each(threads),
            ProcessPoolExecutor(count, context, initializer=end_with_parent) as pool,
        ):
            try:
                for future in as_completed([pool.submit(do, work) for work in works]):
                    yield future.result()
            except BrokenProcessPool:
                raise SessionError(
                    "a worker process ended without a word, perhaps for want of memory; run the "
                    "same command again, it goes on where it was, or give fewer --workers"
                ) from None
            except BaseException as error:
                if not isinstance(error, Exception):  # it has to end, and a shard takes minutes
                    end_children(but=others)
                raise
            finally:
                pool.shutdown(cancel_futures=True)


def processes_for(workers: int) -> Processes | None:
    """The pool of so many workers; None where one process does the work.

    Args:
        workers: how many; 0 takes one for every two cores, four at most, for recordings that are
            long enough.
    """
    if workers:
        return Processes(workers) if workers > 1 else None
    n = min(n_cores() // _CORES, _MOST)
    return Processes(n, fewest=_WORTH_SHARING) if n > 1 else None


def n_cores() -> int:
    """Number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def worker_environment(n_threads: int) -> dict[str, str]:
    """Environment variables by which workers share the cores instead of each taking all of them.

    Args:
        n_threads: threads of numba, OpenMP and OpenBLAS in each worker.
    """
    return {
        name: str(n_threads)
        for name in ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS")
    }


@contextmanager
def _cores_for_each(n_threads: int) -> Iterator[None]:
    """Within the block, processes that are started use so many cores."""
    before = dict(os.environ)
    os.environ.update(worker_environment(n_threads))
    try:
        yield
    finally:
        os.environ.clear()
        os.environ.update(before)
