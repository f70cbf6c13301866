"""How many cores a kernel or a product may use: one, or as many as there are."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import TypeVar

Item = TypeVar("Item")


def ahead(items: Iterable[Item]) -> Generator[Item, None, None]:
    """The same items, each made by a thread while the one before it is used; what goes wrong is
    raised in its turn.
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
def meanwhile(make: Callable[[], Item]) -> Iterator[Callable[[], Item]]:
    """What `make` makes on a thread of its own while the block runs; what is yielded waits for it,
    and raises what went wrong. A block that ends before is not held up.
    """
    maker = ThreadPoolExecutor(1)
    coming = maker.submit(make)
    try:
        yield coming.result
    finally:
        maker.shutdown(wait=False)


@contextmanager
def threads(parallel: bool) -> Iterator[None]:
    """Within the block, parallel kernels run on one thread unless `parallel`.

    One kernel serves both: two numba functions made from one Python function, with and without
    parallel=True, share an entry in numba's cache, and whichever was compiled first is loaded for
    both.
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
    from threadpoolctl import threadpool_limits

    with threadpool_limits(1, user_api="blas"):
        yield
