"""How many cores a parallel kernel may use: one, or as many as numba has."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager


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
