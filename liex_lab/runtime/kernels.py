"""The decorators of all numba kernels."""

from typing import Any

from numba import njit
from numba.core.caching import IndexDataCacheFile


def kernel(**options: Any) -> Any:
    """Compile a function with numba, cached on disk.

    A division by zero gives inf or nan as in numpy: raising an error takes a branch per division.
    With this and without wrappers for callers in C, kernels compile a fifth faster.

    Args:
        options: further ones of `numba.njit`, such as `nogil=True`.

    Returns:
        The decorator.
    """
    return njit(cache=True, error_model="numpy", no_cfunc_wrapper=True, **options)


def inner_kernel(**options: Any) -> Any:
    """`kernel` for a function that only other kernels call: without the wrapper for Python.

    Args:
        options: further ones of `numba.njit`.

    Returns:
        The decorator.
    """
    return kernel(no_cpython_wrapper=True, **options)


def ignore_outdated_kernels() -> None:
    """Make numba treat an index that names record types of an earlier version as empty.

    numba resolves all names in an index before it compares the index's age with the source, so a
    renamed or moved record type would end every run until the cache is deleted by hand.
    """
    load = IndexDataCacheFile._load_index

    def load_index(self: Any) -> Any:
        try:
            return load(self)
        except (AttributeError, ImportError):
            return {}

    IndexDataCacheFile._load_index = load_index


ignore_outdated_kernels()
