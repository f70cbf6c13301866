"""The Lie group SE(3) of rigid motions: exponential, logarithm, adjoint, geodesics.

The formulas of Lie-X section 3.

For a twist xi = (omega, nu) and th = |omega|:

    exp(hat(xi)) = [[exp(hat(omega)), A nu], [0, 1]]                                      (Eq. 4)
    A = I + (1 - cos th) / th^2 hat(omega) + (th - sin th) / th^3 hat(omega)^2            (Eq. 5)
    Ad(g) = [[R, 0], [hat(t) R, R]]

Units: radians, then millimetres.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import overload

import numpy as np

from liex_lab.arrays import Array, ArrayLike, NDArray
from liex_lab.geometry import so3
from liex_lab.runtime.memory import Rows


@dataclass(frozen=True)
class SE3(Rows):
    """Rigid transforms, one or a batch: `T_a_b` transforms points of frame b to frame a.

    A tangent vector is (wx, wy, wz, vx, vy, vz), as in the paper: radians, then millimetres.

    Attributes:
        rotation: (..., 3, 3), proper.
        translation: (..., 3) mm.
    """

    rotation: Array
    translation: Array

    def __repr__(self) -> str:
        batch = np.shape(self.translation)[:-1]
        if batch:
            return f"<SE3: a batch of {' x '.join(map(str, batch))} rigid transforms>"
        cosine = (np.trace(self.rotation) - 1.0) / 2.0
        angle = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
        x, y, z = self.translation
        return f"<SE3: rotated by {angle:.1f} degrees, moved by ({x:.1f}, {y:.1f}, {z:.1f}) mm>"

    @staticmethod
    def identity(*batch: int) -> SE3:
        """The identity, or a batch of identities of the given shape."""
        return SE3(np.broadcast_to(np.eye(3), (*batch, 3, 3)).copy(), np.zeros((*batch, 3)))

    @staticmethod
    def from_matrix(matrix: ArrayLike) -> SE3:
        """Rigid transforms from homogeneous matrices.

        Args:
            matrix: (..., 4, 4); the last row is ignored.
        """
        m = np.asarray(matrix, float)
        return SE3(m[..., :3, :3].copy(), m[..., :3, 3].copy())

    @staticmethod
    def exp(twist: ArrayLike) -> SE3:
        """The group elements of twists (Lie-X Eq. 4 and 5).

        Args:
            twist: (..., 6) rad and mm.
        """
        xi = np.asarray(twist, float)
        omega = xi[..., :3]
        nu = xi[..., 3:]
        return SE3(so3.exp(omega), np.einsum("...ij,...j->...i", so3.left_jacobian(omega), nu))

    def log(self) -> Array:
        """The twists (..., 6) rad and mm with rotation angle in [0, pi]: the inverse of `exp`."""
        omega = so3.log(self.rotation)
        nu = np.einsum("...ij,...j->...i", so3.left_jacobian_inverse(omega), self.translation)
        return np.concatenate([omega, nu], axis=-1)

    def inverse(self) -> SE3:
        """`T_b_a` of `T_a_b`."""
        transposed = np.swapaxes(self.rotation, -1, -2)
        return SE3(transposed, -np.einsum("...ij,...j->...i", transposed, self.translation))

    def adjoint(self) -> Array:
        """Adjoint matrices (..., 6, 6), which transform a twist of frame b to frame a.

        `exp(Ad xi) = g exp(xi) g^-1`.
        """
        r = self.rotation
        matrix = np.zeros((*r.shape[:-2], 6, 6))
        matrix[..., :3, :3] = r
        matrix[..., 3:, 3:] = r
        matrix[..., 3:, :3] = so3.hat(self.translation) @ r
        return matrix

    @property
    def matrix(self) -> Array:
        """Homogeneous matrices (..., 4, 4)."""
        m = np.zeros((*self.rotation.shape[:-2], 4, 4))
        m[..., :3, :3] = self.rotation
        m[..., :3, 3] = self.translation
        m[..., 3, 3] = 1.0
        return m

    @overload
    def __matmul__(self, other: SE3) -> SE3: ...
    @overload
    def __matmul__(self, other: ArrayLike) -> Array: ...
    def __matmul__(self, other: SE3 | ArrayLike) -> SE3 | Array:
        """The product of transforms, or the transform of points.

        Args:
            other: transforms (...) that broadcast, or points (..., 3) mm.
        """
        if isinstance(other, SE3):
            return SE3(self.rotation @ other.rotation, self @ other.translation)
        turned = np.einsum("...ij,...j->...i", self.rotation, np.asarray(other, float))
        return turned + self.translation

    def geodesic(self, other: SE3, s: ArrayLike) -> SE3:
        """The curve from self (s = 0) to other (s = 1); rotation and translation follow their own
        geodesics.

        R(s) = R1 exp(s log(R1^T R2)), t(s) = t1 + s (t2 - t1) (Lie-X section 3). The paper's matrix
        multiplies the translation by A, which misses the end point; it is omitted here.

        Args:
            other: the end point (...).
            s: (...) share of the path, 0 to 1.
        """
        step = np.asarray(s, float)[..., None]
        omega = so3.log(np.swapaxes(self.rotation, -1, -2) @ other.rotation)
        rotation = self.rotation @ so3.exp(step * omega)
        return SE3(rotation, self.translation + step * (other.translation - self.translation))


# Left-invariant Brownian motion on SE(3) (Lie-X Eq. 6 and 7).


def brownian_steps(
    rng: np.random.Generator, covariance: ArrayLike, n_steps: int, *batch: int
) -> NDArray[np.float64]:
    """Tangent steps z_k ~ N(0, covariance).

    Args:
        rng: random generator.
        covariance: (6, 6) in rad and mm, for one unit of time.
        n_steps: steps of one path.
        *batch: shape of the batch of paths.

    Returns:
        (*batch, n_steps, 6) rad and mm.
    """
    return rng.multivariate_normal(
        np.zeros(6), np.asarray(covariance, float), size=(*batch, n_steps)
    )


def brownian_ends(start: SE3, steps: ArrayLike, delta: float, time: float) -> SE3:
    """Points of many paths g(t) at one time, by Lie-X Eq. 6 and 7.

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
