"""Pytest plugin of .ci/with-bounds: compiled kernels check every index.

Run with `-p tests.bounds`, which is imported before the library. NUMBA_BOUNDSCHECK alone is not
enough: numba drops an IndexError inside a parallel loop without a word, so that here all loops are
compiled as serial ones. The forests' walk in `liex_lab.forests._walk` is LLVM code of its own and
stays unchecked.
"""

import os
from collections.abc import Callable
from typing import Any

import numba
import numpy as np
import pytest

_njit = numba.njit


def _serial_njit(*functions: Callable[..., Any], **options: Any) -> Any:
    """`numba.njit` without parallel loops."""
    options.pop("parallel", None)
    return _njit(*functions, **options)


def pytest_configure() -> None:
    """Compile as serial loops from now on, and see that an index out of bounds is told."""
    if not numba.config.BOUNDSCHECK:
        raise pytest.UsageError("tests.bounds wants NUMBA_BOUNDSCHECK=1, set before Python starts")
    if not os.environ.get("NUMBA_CACHE_DIR"):
        raise pytest.UsageError(
            "tests.bounds wants a NUMBA_CACHE_DIR of its own: what it compiles is not for others"
        )
    numba.njit = _serial_njit

    @numba.njit(parallel=True)
    def _beyond(row, total):
        for k in numba.prange(row.size + 1):
            total[0] += row[k]

    try:
        _beyond(np.zeros(3), np.zeros(1))
    except IndexError:
        return
    raise pytest.UsageError("numba reads beyond an array without telling: no index is checked")
