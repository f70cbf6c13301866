"""Rigid motion the slow way: 4x4 matrices, SciPy's matrix exponential, and loops."""

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import expm

Array = NDArray[np.float64]


def hat(twist: ArrayLike) -> Array:
    """The matrix (4, 4) of one twist (6,), written out as in Lie-X Eq. 2 and 3."""
    (w1, w2, w3), nu = np.asarray(twist, float)[:3], np.asarray(twist, float)[3:]
    matrix = np.zeros((4, 4))
    matrix[:3, :3] = [[0, -w3, w2], [w3, 0, -w1], [-w2, w1, 0]]
    matrix[:3, 3] = nu
    return matrix


def exp(twist: ArrayLike) -> Array:
    """The homogeneous matrix (4, 4) of one twist (6,)."""
    return np.asarray(expm(hat(twist)))


def chain(twists: ArrayLike) -> list[Array]:
    """The partial products of a chain of twists (J, 6)."""
    products, so_far = [], np.eye(4)
    for twist in np.asarray(twists, float):
        so_far = so_far @ exp(twist)
        products.append(so_far)
    return products


def angle_between(first: ArrayLike, second: ArrayLike) -> float:
    """The angle between two rotations (3, 3), rad, from the chord: exact where the trace's arc
    cosine is not.
    """
    chord = np.linalg.norm(np.asarray(first) - np.asarray(second)) / np.sqrt(8.0)
    return float(2.0 * np.arcsin(min(chord, 1.0)))
