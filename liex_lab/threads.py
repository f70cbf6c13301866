"""How many cores a parallel kernel may use: one, or as many as numba has."""

from __future__ import annotations

from collections.abc import Generator, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import TypeVar

Item = TypeVar("Item")


def ahead(items: Iterable[Item]) -> Generator[Item, None, None]:
    """The same items, each made by a thread while the one before it is used; what goes wrong is raised in its turn."""
    left, end = iter(items), object()
    with ThreadPoolExecutor(1) as maker:
        coming = maker.submit(next, left, end)
        while True:
            item = coming.result()
            if item is end:
                return
            coming = maker.submit(next, left, end)
            yield item  # type: ignore[misc]


@contextmanager
def threads(parallel: bool) -> Iterator[None]:
    """Within the block, parallel kernels run on one thread unless `parallel`.

    One kernel serves both: two numba functions made from one Python function, with and without parallel=True, share an
    entry in numba's cache, and whichever was compiled first is loaded for both.
    """
    import numba

    before = numba.get_num_threads()
    if not parallel:
        numba.set_num_threads(1)
    try:
        yield
    finally:
        numba.set_num_threads(before)
