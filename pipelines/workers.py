"""Worker pool of processes of this machine, for the shards of one recording.

Processes are spawned, as numba's threads do not survive a fork, and share the cores. A study's
workers belong to Dask, see `study.crew`.
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

# cores per process, which uses more than one and a half
_CORES = 2
# maximum number of processes, each of about 400 MB
_MOST = 4
# frames; a process takes two seconds to start
_WORTH_SHARING = 6000
Work = TypeVar("Work")
Done = TypeVar("Done")


class WorkerPool(Protocol):
    """A pool that runs several tasks at once, such as processes or the workers of a cluster."""

    @property
    def fewest(self) -> int:
        """Up to this number of frames a recording is measured by one process, which is faster."""

    @property
    def here(self) -> bool:
        """Whether its workers can read this machine's temporary files."""

    def each(self, do: Callable[[Work], Done], works: Sequence[Work]) -> Iterator[Done]:
        """Results of `do` for each task, as they arrive, in any order; tasks can be pickled."""


@dataclass(frozen=True)
class Processes:
    """A pool of processes of this machine.

    Attributes:
        n: maximum number, at most one for each task.
        threads: cores of each; 0 means an equal share.
        fewest: number of frames up to which processes are not worth their start.
        here: True, as they can read this machine's temporary files.
    """

    n: int
    threads: int = 0
    fewest: int = 0
    here: bool = True

    def each(self, do: Callable[[Work], Done], works: Sequence[Work]) -> Iterator[Done]:
        """Results of `do` for each task, as they arrive, in any order; tasks can be pickled.

        Raises:
            SessionError: a process died, perhaps from lack of memory.
        """
        if not works:
            return
        count = min(self.n, len(works))
        threads = self.threads or max(1, n_cores() // count)
        context = multiprocessing.get_context("spawn")  # numba's threads do not survive a fork
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
                if not isinstance(error, Exception):  # end at once, as a shard takes minutes
                    end_children(but=others)
                raise
            finally:
                pool.shutdown(cancel_futures=True)


def processes_for(workers: int) -> Processes | None:
    """The pool of so many workers; None if one process does the work.

    Args:
        workers: number of workers; 0 means one for every two cores, four at most, for recordings
            that are long enough.
    """
    if workers:
        return Processes(workers) if workers > 1 else None
    n = min(n_cores() // _CORES, _MOST)
    return Processes(n, fewest=_WORTH_SHARING) if n > 1 else None


def n_cores() -> int:
    """Number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def worker_environment(n_threads: int) -> dict[str, str]:
    """Environment variables that limit a worker to so many threads (numba, OpenMP, OpenBLAS)."""
    return {
        name: str(n_threads)
        for name in ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS")
    }


@contextmanager
def _cores_for_each(n_threads: int) -> Iterator[None]:
    """A context in which newly started processes use so many cores."""
    before = dict(os.environ)
    os.environ.update(worker_environment(n_threads))
    try:
        yield
    finally:
        os.environ.clear()
        os.environ.update(before)
