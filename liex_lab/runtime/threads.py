"""Threads of numba kernels and of BLAS, prefetching of an iterator, tasks in the background."""

from __future__ import annotations

import gc
import sys
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from functools import lru_cache
from importlib import import_module
from typing import TYPE_CHECKING, TypeVar

from liex_lab.runtime.memory import uncollected

if TYPE_CHECKING:
    from threadpoolctl import ThreadpoolController

Item = TypeVar("Item")
Result = TypeVar("Result")


def prefetch(items: Iterable[Item]) -> Generator[Item, None, None]:
    """Prefetch: the same items, each made by a thread while the one before it is used.

    What goes wrong while an item is made is raised in its turn.

    Args:
        items: what is iterated over, one item ahead, on a thread of its own.

    Yields:
        The items, in their order.
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
    """Run one function in the background, on a thread of its own, while the block runs.

    A block that ends before is not held up.

    Args:
        make: the function.

    Yields:
        A function that waits for the result and returns it, or raises what went wrong.
    """
    maker = ThreadPoolExecutor(1)
    coming = maker.submit(make)
    try:
        yield coming.result
    finally:
        maker.shutdown(wait=False)


def side_by_side(do: Callable[[Item], Result], items: Sequence[Item]) -> list[Result]:
    """Results of a function for each item, in their order, on as many threads as kernels may use.

    For work on whole pictures by numpy and OpenCV, which let other threads run meanwhile.

    Args:
        do: the function; it changes nothing that another item needs.
        items: its arguments.
    """
    import numba

    n = min(numba.get_num_threads(), len(items))
    if n < 2:
        return [do(item) for item in items]
    with ThreadPoolExecutor(n) as pool:
        return list(pool.map(do, items))


@contextmanager
def imported_ahead(*modules: str) -> Iterator[None]:
    """Import modules one after another, on a thread of its own, while the block runs.

    Who imports one of them meanwhile waits until it is there. One that is missing is told of by who
    wants it. From then on Python's collector of garbage leaves alone what is in memory, until the
    block ends: it would go through all of the modules again and again, a sixth of a short run.

    Args:
        modules: their dotted names, in the order in which they will be wanted.
    """

    def fetch() -> None:
        with uncollected():
            for name in modules:
                if left:
                    return
                with suppress(ImportError):
                    import_module(name)
            gc.freeze()
            if left:  # the block has ended meanwhile, and nobody else would take that back
                gc.unfreeze()

    left: list[bool] = []
    with in_background(fetch):
        try:
            yield
        finally:
            left.append(True)
            gc.unfreeze()


@contextmanager
def threads(parallel: bool) -> Iterator[None]:
    """Within the block, parallel numba kernels run on all threads or on one.

    One kernel serves both: two numba functions made from one Python function, with and without
    parallel=True, share an entry in numba's cache, and whichever was compiled first is loaded for
    both.

    Args:
        parallel: whether as many threads as before, else one.
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
    """Within the block, BLAS multiplies on one thread: the same bits on any number of cores."""
    with _loaded(len(sys.modules)).limit(limits=1, user_api="blas"):
        yield


@lru_cache(maxsize=1)
def _loaded(n_modules: int) -> ThreadpoolController:
    """The libraries that are loaded, which takes milliseconds to find out.

    Of more modules there may be more libraries.
    """
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController()
