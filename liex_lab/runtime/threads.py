"""Threads of numba kernels and BLAS, prefetching iterators, and background tasks."""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from functools import lru_cache
from importlib import import_module
from itertools import pairwise
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    from threadpoolctl import ThreadpoolController

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

    For work on whole frames by numpy and OpenCV, which release the GIL.

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
    """Within the block, `in_parallel` and numba's parallel loops use all threads or one.

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
