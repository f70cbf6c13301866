"""The rotation group SO(3): hat, Rodrigues' exponential, logarithm, left Jacobian, chordal mean.

    exp(hat(w)) = I + sin(th) / th hat(w) + (1 - cos th) / th^2 hat(w)^2,   th = |w|     (Rodrigues)

Small angles use the series of these factors. Vectors are (..., 3) radians, rotations (..., 3, 3).
"""

import numpy as np

from liex_lab.arrays import Array, ArrayLike, NDArray

_SMALL_EXP = 1e-8  # th^2 below which exp uses its series
_SMALL_A = 1e-6  # th^2 below which A and its inverse use their series


def hat(omega: ArrayLike) -> Array:
    """Skew matrices of vectors (Lie-X Eq. 2): `hat(w) @ x == cross(w, x)`.

    Args:
        omega: (..., 3).

    Returns:
        (..., 3, 3).
    """
    w = np.asarray(omega, float)
    matrix = np.zeros((*w.shape[:-1], 3, 3))
    for k, i, j in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        matrix[..., i, j] = -w[..., k]
        matrix[..., j, i] = w[..., k]
    return matrix


def cross(a: Array, b: Array) -> Array:
    """Cross products of vectors; np.cross, three times as fast for few.

    Args:
        a: (..., 3).
        b: (..., 3), broadcasts with a.

    Returns:
        (..., 3).
    """
    out = np.empty(np.broadcast_shapes(a.shape, b.shape))
    for k, i, j in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        out[..., k] = a[..., i] * b[..., j] - a[..., j] * b[..., i]
    return out


def _angles(omega: ArrayLike, least: float) -> tuple[Array, Array, NDArray[np.bool_], Array]:
    """Skew matrices, th^2, whether th^2 is below `least`, and th (1 where it is)."""
    w = np.asarray(omega, float)
    th2 = np.sum(w * w, axis=-1)[..., None, None]
    small = th2 < least
    return hat(w), th2, small, np.sqrt(np.where(small, 1.0, th2))


def exp(omega: ArrayLike) -> Array:
    """Rotations of rotation vectors, by Rodrigues' formula.

    Args:
        omega: (..., 3) rad.

    Returns:
        (..., 3, 3).
    """
    w_hat, th2, small, th = _angles(omega, _SMALL_EXP)
    a = np.where(small, 1.0 - th2 / 6.0, np.sin(th) / th)
    # 2 sin^2(th/2) / th^2 keeps all digits where 1 - cos(th) would cancel
    b = np.where(small, 0.5 - th2 / 24.0, 2.0 * np.sin(th / 2.0) ** 2 / (th * th))
    return np.eye(3) + a * w_hat + b * (w_hat @ w_hat)


def quaternion(rotation: ArrayLike) -> Array:
    """Unit quaternions of rotations.

    Shepperd's method (1978): the largest of the four squared components is the pivot, so no
    division is by a small number at any angle, pi included.

    Args:
        rotation: (..., 3, 3).

    Returns:
        (..., 4) as (w, x, y, z), w >= 0.
    """
    r = np.asarray(rotation, float)
    d0, d1, d2 = np.moveaxis(np.diagonal(r, axis1=-2, axis2=-1), -1, 0)
    squares = np.stack(
        [1 + d0 + d1 + d2, 1 + d0 - d1 - d2, 1 - d0 + d1 - d2, 1 - d0 - d1 + d2], axis=-1
    )
    # row k: the quaternion times four times its component k
    rows = squares[..., None] * np.eye(4)
    for i, k, value in (
        (0, 1, r[..., 2, 1] - r[..., 1, 2]),
        (0, 2, r[..., 0, 2] - r[..., 2, 0]),
        (0, 3, r[..., 1, 0] - r[..., 0, 1]),
        (1, 2, r[..., 0, 1] + r[..., 1, 0]),
        (1, 3, r[..., 0, 2] + r[..., 2, 0]),
        (2, 3, r[..., 1, 2] + r[..., 2, 1]),
    ):
        rows[..., i, k] = rows[..., k, i] = value
    pivot = np.argmax(squares, axis=-1)
    q = np.take_along_axis(rows, pivot[..., None, None], axis=-2)[..., 0, :]
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    return np.where(q[..., :1] < 0, -q, q)


def log(rotation: ArrayLike) -> Array:
    """Rotation vectors of rotations: the inverse of `exp`.

    Uses the quaternion and atan2, which keep full precision near 0 and near pi, where the arc
    cosine of the trace loses it. At exactly pi both signs are the same rotation; either may be
    returned.

    Args:
        rotation: (..., 3, 3).

    Returns:
        (..., 3) rad, length in [0, pi].
    """
    q = quaternion(rotation)
    v = q[..., 1:]
    length = np.linalg.norm(v, axis=-1, keepdims=True)
    tiny = length < 1e-9
    factor = np.where(tiny, 2.0, 2.0 * np.arctan2(length, q[..., :1]) / np.where(tiny, 1.0, length))
    return factor * v


def left_jacobian(omega: ArrayLike) -> Array:
    """The left Jacobian A of Lie-X Eq. 5: the translation of exp(omega, nu) is `A @ nu`.

    A = I + (1 - cos th) / th^2 hat(w) + (th - sin th) / th^3 hat(w)^2.

    Args:
        omega: (..., 3) rad.

    Returns:
        (..., 3, 3).
    """
    w_hat, th2, small, th = _angles(omega, _SMALL_A)
    b = np.where(small, 0.5 - th2 / 24.0, 2.0 * np.sin(th / 2.0) ** 2 / (th * th))
    c = np.where(small, 1.0 / 6.0 - th2 / 120.0, (th - np.sin(th)) / th**3)
    return np.eye(3) + b * w_hat + c * (w_hat @ w_hat)


def left_jacobian_inverse(omega: ArrayLike) -> Array:
    """The inverse of `left_jacobian`.

    A^-1 = I - 1/2 hat(w) + (1 - th/2 cot(th/2)) / th^2 hat(w)^2.

    Args:
        omega: (..., 3) rad, lengths in [0, pi]; there is a pole at 2 pi, so keep logs principal.

    Returns:
        (..., 3, 3).
    """
    w_hat, th2, small, th = _angles(omega, _SMALL_A)
    half = 0.5 * th
    c = np.where(
        small,
        1.0 / 12.0 + th2 / 720.0,
        (1.0 - half * np.cos(half) / np.sin(half)) / np.where(small, 1, th2),
    )
    return np.eye(3) - 0.5 * w_hat + c * (w_hat @ w_hat)


def nearest_rotation(matrix: ArrayLike) -> Array:
    """The proper rotation nearest to a matrix in the Frobenius norm, by SVD.

    Args:
        matrix: (..., 3, 3).

    Returns:
        (..., 3, 3).
    """
    u, _, vt = np.linalg.svd(np.asarray(matrix, float))
    sign = np.sign(np.linalg.det(u @ vt))
    u = u * np.stack([np.ones_like(sign), np.ones_like(sign), sign], axis=-1)[..., None, :]
    return u @ vt


def mean(rotations: ArrayLike, weights: ArrayLike | None = None) -> Array:
    """Weighted mean rotation: the chordal (L2) mean, unique unless the rotations cancel.

    Args:
        rotations: (n, 3, 3).
        weights: (n,); None for equal weights.

    Returns:
        (3, 3).
    """
    r = np.asarray(rotations, float)
    w = np.ones(len(r)) if weights is None else np.asarray(weights, float)
    return nearest_rotation(np.einsum("n,nij->ij", w, r))
