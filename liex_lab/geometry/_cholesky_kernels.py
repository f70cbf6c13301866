"""Kernels of small symmetric positive definite systems: Cholesky's factor and two substitutions.

    A = L L^T,   L y = b,   L^T x = y

Matrices so small (at most some dozen rows) are not worth a call of LAPACK.
"""

from __future__ import annotations

import numpy as np
from numba import njit


@njit(cache=True)
def cholesky(a, factor, least):
    """Cholesky's factor of a symmetric matrix, of which only the lower half is read.

    Args:
        a: (k, k), positive definite.
        factor: (k, k), its lower half filled with L; may be `a` itself.
        least: what a square of the diagonal is raised to where it is smaller.

    Returns:
        Whether all squares of the diagonal are larger than `least`.
    """
    definite = True
    for i in range(a.shape[0]):
        for j in range(i + 1):
            total = a[i, j]
            for k in range(j):
                total -= factor[i, k] * factor[j, k]
            if i == j:
                definite &= total > least
                factor[i, i] = np.sqrt(max(total, least))
            else:
                factor[i, j] = total / factor[j, j]
    return definite


@njit(cache=True)
def substitute(factor, x):
    """Solve L L^T x = b.

    Args:
        factor: (k, k), L in its lower half.
        x: (k,) holds b, and the solution afterwards.
    """
    n = x.size
    for i in range(n):
        total = x[i]
        for k in range(i):
            total -= factor[i, k] * x[k]
        x[i] = total / factor[i, i]
    for i in range(n - 1, -1, -1):
        total = x[i]
        for k in range(i + 1, n):
            total -= factor[k, i] * x[k]
        x[i] = total / factor[i, i]
