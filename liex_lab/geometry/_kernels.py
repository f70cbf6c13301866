"""Kernels of small symmetric positive definite systems: Cholesky's factor and two substitutions.

    A = L L^T,   L y = b,   L^T x = y

Matrices this small (at most some dozen rows) do not justify a LAPACK call.
"""

import numpy as np

from liex_lab.runtime.kernels import inner_kernel, kernel


@inner_kernel()
def cholesky(a, factor, least):
    """Cholesky's factor of a symmetric matrix, of which only the lower half is read.

    Args:
        a: (k, k), positive definite.
        factor: (k, k), its lower half filled with L; may be `a` itself.
        least: smaller squares of the diagonal are raised to this.

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


@inner_kernel()
def substitute(factor, x):
    """Solve L L^T x = b.

    Args:
        factor: (k, k), L in its lower half.
        x: (k,) b on entry, the solution on return.
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


# Kernels of the rotation group SO(3): Rodrigues' exponential and the logarithm by a quaternion.


@kernel()
def exp_so3(wx, wy, wz, out):
    """Rotation matrix of a rotation vector (Rodrigues), the scalar twin of `geometry.so3.exp`.

    Args:
        wx: x component, rad.
        wy: y component, rad.
        wz: z component, rad.
        out: (3, 3), filled.
    """
    th2 = wx * wx + wy * wy + wz * wz
    if th2 < 1e-8:
        a = 1.0 - th2 / 6.0
        b = 0.5 - th2 / 24.0
    else:
        th = np.sqrt(th2)
        a = np.sin(th) / th
        b = 2.0 * np.sin(th / 2.0) ** 2 / th2
    out[0, 0] = 1.0 - b * (wy * wy + wz * wz)
    out[0, 1] = b * wx * wy - a * wz
    out[0, 2] = b * wx * wz + a * wy
    out[1, 0] = b * wx * wy + a * wz
    out[1, 1] = 1.0 - b * (wx * wx + wz * wz)
    out[1, 2] = b * wy * wz - a * wx
    out[2, 0] = b * wx * wz - a * wy
    out[2, 1] = b * wy * wz + a * wx
    out[2, 2] = 1.0 - b * (wx * wx + wy * wy)


@kernel()
def log_so3(r, out):
    """Logarithm of SO(3), through the quaternion's largest component, so that it is exact up to π.

    Args:
        r: (3, 3) rotation.
        out: (3,) output, rotation vector, rad.
    """
    q = np.empty(4)
    d0 = r[0, 0]
    d1 = r[1, 1]
    d2 = r[2, 2]
    squares = np.array([1 + d0 + d1 + d2, 1 + d0 - d1 - d2, 1 - d0 + d1 - d2, 1 - d0 - d1 + d2])
    wx = r[2, 1] - r[1, 2]
    wy = r[0, 2] - r[2, 0]
    wz = r[1, 0] - r[0, 1]
    xy = r[0, 1] + r[1, 0]
    xz = r[0, 2] + r[2, 0]
    yz = r[1, 2] + r[2, 1]
    pivot = int(np.argmax(squares))
    if pivot == 0:
        q[0] = squares[0]
        q[1] = wx
        q[2] = wy
        q[3] = wz
    elif pivot == 1:
        q[0] = wx
        q[1] = squares[1]
        q[2] = xy
        q[3] = xz
    elif pivot == 2:
        q[0] = wy
        q[1] = xy
        q[2] = squares[2]
        q[3] = yz
    else:
        q[0] = wz
        q[1] = xz
        q[2] = yz
        q[3] = squares[3]
    if q[0] < 0.0:
        q = -q
    length = np.sqrt(q[1] ** 2 + q[2] ** 2 + q[3] ** 2)
    whole = np.sqrt(q[0] ** 2 + length**2)
    factor = 2.0 / whole if length < 1e-9 * whole else 2.0 * np.arctan2(length, q[0]) / length
    for k in range(3):
        out[k] = factor * q[1 + k]
