"""Handling of Ctrl-C, SIGTERM and SIGHUP, of child processes, and of threads.

A signal raises an exception, so that checkpoints are kept and temporary folders removed. If a
kernel or a library's thread does not stop, the process exits after 4 s; a second signal ends it at
once. The disk is then in the same state as after a kill, which all writers handle.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import lru_cache
from importlib import import_module
from itertools import pairwise
from types import FrameType
from typing import TYPE_CHECKING, Protocol, TypeVar

from liex_lab.errors import SessionError

if TYPE_CHECKING:
    from threadpoolctl import ThreadpoolController


_PATIENCE_S = 4.0
_SAID = {"SIGINT": "interrupted (Ctrl-C)", "SIGTERM": "ended (SIGTERM)", "SIGHUP": "ended (SIGHUP)"}


class Ended(BaseException):
    """Raised in the main thread when the process receives a signal to end.

    Attributes:
        signal: the signal's number.
    """

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.signal = number

    def __str__(self) -> str:
        """The message for the user, one sentence."""
        return f"{_SAID[signal.Signals(self.signal).name]}; run the same command again to resume"

    @property
    def exit_code(self) -> int:
        """128 plus the signal's number, as shells use: 130 for Ctrl-C, 143 for SIGTERM."""
        return 128 + self.signal


@contextmanager
def ending() -> Iterator[None]:
    """Within the block, signals that ask the process to end raise `Ended` in the main thread.

    Signals that the process ignored from the start, as with nohup, stay ignored.
    """
    asked: list[int] = []
    unheard = threading.Event()
    usual = sys.unraisablehook

    def end(number: int, frame: FrameType | None) -> None:
        error = Ended(number)
        if unheard.is_set():
            unheard.clear()
            raise error
        if asked:
            _end_now(error, asked)
        asked.append(number)
        late = threading.Timer(_PATIENCE_S, _end_now, [error, asked])
        late.daemon = True
        late.start()
        raise error

    def again(what: sys.UnraisableHookArgs) -> None:
        """Raise again later: Python discarded the error, as in a weak reference's callback."""
        if not isinstance(what.exc_value, Ended):
            return usual(what)
        unheard.set()
        later = threading.Timer(0.05, _send, [what.exc_value.signal])
        later.daemon = True
        later.start()
        return None

    before = {}
    sys.unraisablehook = again
    for name in _SAID:
        number = getattr(signal, name, None)
        if number is None or threading.current_thread() is not threading.main_thread():
            continue
        found = signal.getsignal(number)
        if found in (signal.SIG_DFL, signal.default_int_handler):
            before[number] = signal.signal(number, end)
    try:
        yield
    finally:
        sys.unraisablehook = usual
        if asked:
            asked.append(0)  # the caller that catches the error prints the message
        else:  # a second signal would still end it at once
            for number, handler in before.items():
                signal.signal(number, handler)


def _send(number: int) -> None:
    """Send a signal to the main thread, even if it is blocked."""
    if hasattr(signal, "pthread_kill"):
        signal.pthread_kill(threading.main_thread().ident or 0, number)
    else:
        signal.raise_signal(number)


def _end_now(error: Ended, asked: list[int]) -> None:
    """End the process, whatever its threads are doing."""
    if len(asked) == 1:
        os.write(2, f"liex: {error}\n".encode())  # the handler may have interrupted a write of ours
    os._exit(error.exit_code)


# Child processes: where they import from, and that they end with this one.


def own_python(*arguments: str) -> list[str]:
    """The command line of another Python process with the packages of this one.

    It does not import from its working folder, which may contain another liex_lab, such as the
    sources this one was installed from, or files that shadow a package.

    Args:
        *arguments: "-m" and a module, or "-c" and a program, and its arguments.
    """
    return [sys.executable, "-P", *arguments]


def end_with_parent() -> None:
    """In a child process of `multiprocessing`: end with the parent, and ignore Ctrl-C.

    The parent holds the other end of a pipe, which the system closes when the parent ends: this
    works on every system, also for SIGKILL.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # a terminal sends it to both
    parent = multiprocessing.parent_process()
    if parent is None:
        return

    def watch() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


# Worker pool of processes of this machine, for the shards of one recording.


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
                    "a worker process ended without a message, perhaps from lack of memory; run "
                    "the same command again, it resumes, or give fewer --workers"
                ) from None
            except BaseException as error:
                if not isinstance(error, Exception):  # end at once, as a shard takes minutes
                    for child in multiprocessing.active_children():
                        if child.pid not in others:
                            child.terminate()
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
    # a process uses more than one and a half cores and about 400 MB, and takes two seconds to start
    n = min(n_cores() // 2, 4)
    return Processes(n, fewest=6000) if n > 1 else None


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


# Threads of numba kernels and BLAS, prefetching iterators, and background tasks.


Item = TypeVar("Item")
Result = TypeVar("Result")


def prefetch(items: Iterable[Item]) -> Generator[Item, None, None]:
    """Yield the same items, computing each on a thread while the previous one is used.

    Errors are raised when their item is due.

    Args:
        items: consumed one item ahead, on a separate thread.

    Yields:
        The items, in order.
    """
    left = iter(items)
    end = object()
    with ThreadPoolExecutor(1) as maker:
        coming = maker.submit(next, left, end)
        while True:
            item = coming.result()
            if item is end:
                return
            coming = maker.submit(next, left, end)
            yield item  # type: ignore[misc]


@contextmanager
def in_background(make: Callable[[], Item]) -> Iterator[Callable[[], Item]]:
    """Run a function on a separate thread while the block runs.

    The end of the block does not wait for the function.

    Args:
        make: the function.

    Yields:
        A function that waits for the result and returns it, or raises the function's error.
    """
    maker = ThreadPoolExecutor(1)
    coming = maker.submit(make)
    try:
        yield coming.result
    finally:
        maker.shutdown(wait=False)


def side_by_side(do: Callable[[Item], Result], items: Sequence[Item]) -> list[Result]:
    """Apply a function to each item on as many threads as kernels may use; results in order.

    For work that releases the GIL, such as on whole frames by numpy and OpenCV, or unpacking.

    Args:
        do: the function; must not change data of other items.
        items: its arguments.
    """
    import numba

    n = min(numba.get_num_threads(), len(items))
    if n < 2:
        return [do(item) for item in items]
    with ThreadPoolExecutor(n) as pool:
        return list(pool.map(do, items))


def in_parallel(kernel: Callable[..., object], n: int, *args: object) -> None:
    """Run a kernel on n items, in as many parts as kernels may use threads.

    Threads of Python share the items of kernels compiled with `nogil=True`: numba's own parallel
    loops take a third longer to compile.

    Args:
        kernel: called with the arguments and the part, start and stop; writes its results into
            arrays, each item into places of its own.
        n: number of items.
        args: the kernel's other arguments.
    """
    import numba

    n_parts = min(numba.get_num_threads(), n)
    if n_parts < 2:
        kernel(*args, 0, n)
        return
    bounds = [n * part // n_parts for part in range(n_parts + 1)]
    others = [_kernel_threads().submit(kernel, *args, *part) for part in pairwise(bounds[1:])]
    kernel(*args, *bounds[:2])
    for other in others:
        other.result()


@lru_cache(maxsize=1)
def _kernel_threads() -> ThreadPoolExecutor:
    """The threads of `in_parallel`, beside those that call it."""
    import numba

    return ThreadPoolExecutor(numba.config.NUMBA_NUM_THREADS, "kernel")


@contextmanager
def imported_ahead(*modules: str) -> Iterator[None]:
    """Import modules one after another on a separate thread while the block runs.

    An import of the same module elsewhere waits for it. Missing modules are skipped here; their
    importers report them.

    Args:
        modules: dotted names, in the order in which they will be needed.
    """
    ended = threading.Event()

    def fetch() -> None:
        for name in modules:
            if not ended.is_set():
                with suppress(ImportError):
                    import_module(name)

    with in_background(fetch):
        try:
            yield
        finally:
            ended.set()


@contextmanager
def threads(parallel: bool) -> Iterator[None]:
    """Within the block, `in_parallel` uses all threads or one.

    Args:
        parallel: whether to keep the current number of threads; False uses one.
    """
    import numba

    before = numba.get_num_threads()
    if not parallel:
        numba.set_num_threads(1)
    try:
        yield
    finally:
        numba.set_num_threads(before)


@contextmanager
def serial_products() -> Iterator[None]:
    """Within the block, BLAS uses one thread: results are bit-identical on any number of cores."""
    with _loaded(len(sys.modules)).limit(limits=1, user_api="blas"):
        yield


@lru_cache(maxsize=1)
def _loaded(n_modules: int) -> ThreadpoolController:
    """Controller of the loaded libraries; creating it takes milliseconds.

    Args:
        n_modules: number of imported modules: the cache key, as imports may load libraries.
    """
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController()
