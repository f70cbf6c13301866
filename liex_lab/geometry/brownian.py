"""Left-invariant Brownian motion on SE(3) (Lie-X Eq. 6 and 7).

With z_k ~ N(0, covariance) in the tangent space and step length delta,

    g((k + 1) delta) = g(k delta) exp(sqrt(delta) z_k)                            (Eq. 6)
    g(t) = g(k delta) exp((t - k delta) / sqrt(delta) z_k) between the steps      (Eq. 7)
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from liex_lab.geometry.se3 import SE3


def brownian_steps(
    rng: np.random.Generator, covariance: ArrayLike, n_steps: int, *batch: int
) -> NDArray[np.float64]:
    """Tangent steps z_k ~ N(0, covariance).

    Args:
        rng: where chance comes from.
        covariance: (6, 6) in rad and mm, for one unit of time.
        n_steps: steps of one path.
        *batch: shape of the batch of paths.

    Returns:
        (*batch, n_steps, 6) rad and mm.
    """
    return rng.multivariate_normal(
        np.zeros(6), np.asarray(covariance, float), size=(*batch, n_steps)
    )


def brownian_path(start: SE3, steps: ArrayLike, delta: float, times: ArrayLike) -> SE3:
    """The path g(t) from `start` at given times, by Lie-X Eq. 6 and 7.

    Args:
        start: one element, g(0).
        steps: (n_steps, 6) tangent steps z.
        delta: step length, s.
        times: (n,) s, in [0, n_steps * delta].

    Returns:
        A batch (n,).

    Raises:
        ValueError: a time outside the path, or a delta that is not positive.
    """
    z = np.asarray(steps, float)
    t = np.atleast_1d(np.asarray(times, float))
    if not delta > 0 or t.min() < 0 or t.max() > len(z) * delta * (1 + 1e-12):
        raise ValueError(
            f"times must lie within the path, 0 to {len(z) * delta} s, got {t.min()} to {t.max()} s"
        )
    nodes = [start]
    for step in z:
        nodes.append(nodes[-1] @ SE3.exp(np.sqrt(delta) * step))
    before = np.minimum((t / delta).astype(int), len(z) - 1)
    at_node = SE3(
        np.stack([nodes[k].rotation for k in before]),
        np.stack([nodes[k].translation for k in before]),
    )
    return at_node @ SE3.exp(((t - before * delta) / np.sqrt(delta))[:, None] * z[before])


def brownian_ends(start: SE3, steps: ArrayLike, delta: float, time: float) -> SE3:
    """Where many paths g(t) are at one time, by Lie-X Eq. 6 and 7.

    Args:
        start: a batch (n,), the elements g(0).
        steps: (n, n_steps, 6) tangent steps z of each path.
        delta: step length, s.
        time: s, in [0, n_steps * delta].

    Returns:
        A batch (n,).

    Raises:
        ValueError: a time outside the paths, or a delta that is not positive.
    """
    z = np.asarray(steps, float)
    n_steps = z.shape[1]
    if not delta > 0 or not 0 <= time <= n_steps * delta * (1 + 1e-12):
        raise ValueError(
            f"the time must lie within the paths, 0 to {n_steps * delta} s, got {time} s"
        )
    end = start
    for k in range(n_steps):
        spent = min(max(time - k * delta, 0.0), delta)
        end = end @ SE3.exp(spent / np.sqrt(delta) * z[:, k])
    return end
