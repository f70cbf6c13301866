"""Kernels of forward kinematics (product of exponentials) for many poses, without NumPy's overhead.

t_j = t_p + s R_p b_j, R_j = R_p Q_j exp(hat(w_j)), with exp by Rodrigues' formula; the twin of
`kinematics.forward_kinematics`.
"""

from __future__ import annotations

import numpy as np
from numba import njit


@njit(cache=True)
def exp_so3(w, out):
    """Rotation of a rotation vector by Rodrigues' formula, with its series below 1e-4 rad.

    Args:
        w: (3,) rad.
        out: (3, 3), out.
    """
    th2 = w[0] * w[0] + w[1] * w[1] + w[2] * w[2]
    if th2 < 1e-8:
        a = 1.0 - th2 / 6.0
        b = 0.5 - th2 / 24.0
    else:
        th = np.sqrt(th2)
        a = np.sin(th) / th
        b = 2.0 * np.sin(th / 2.0) ** 2 / th2
    x = w[0]
    y = w[1]
    z = w[2]
    out[0, 0] = 1.0 - b * (y * y + z * z)
    out[0, 1] = b * x * y - a * z
    out[0, 2] = b * x * z + a * y
    out[1, 0] = b * x * y + a * z
    out[1, 1] = 1.0 - b * (x * x + z * z)
    out[1, 2] = b * y * z - a * x
    out[2, 0] = b * x * z - a * y
    out[2, 1] = b * y * z + a * x
    out[2, 2] = 1.0 - b * (x * x + y * y)


@njit(cache=True)
def place_joints(parents, offsets, rest, moves, rotation, translation, angles, scale, out):
    """Positions of the joints of n poses; the kernel twin of `Pose.joints`.

    Args:
        parents: (J,) int64.
        offsets: (J, 3) mm, bones in their parents' frames.
        rest: (J, 3, 3) rotations at home.
        moves: (J,) bool, which joints turn.
        rotation: (n, 3, 3) of the root.
        translation: (n, 3) mm of the root.
        angles: (n, J, 3) rad.
        scale: (n,) of the bones.
        out: (n, J, 3) mm, out.
    """
    n_joints = parents.size
    turned = np.empty((n_joints, 3, 3))
    own = np.empty((3, 3))
    step = np.empty((3, 3))
    for i in range(scale.size):
        for a in range(3):
            out[i, 0, a] = translation[i, a]
            for b in range(3):
                turned[0, a, b] = rotation[i, a, b]
        for j in range(1, n_joints):
            p = parents[j]
            if moves[j]:
                exp_so3(angles[i, j], own)
            for a in range(3):
                total = 0.0
                for k in range(3):
                    total += turned[p, a, k] * offsets[j, k]
                out[i, j, a] = out[i, p, a] + scale[i] * total
                for b in range(3):
                    value = 0.0
                    for k in range(3):
                        value += turned[p, a, k] * rest[j, k, b]
                    step[a, b] = value
            for a in range(3):
                for b in range(3):
                    if moves[j]:
                        turned[j, a, b] = (
                            step[a, 0] * own[0, b] + step[a, 1] * own[1, b] + step[a, 2] * own[2, b]
                        )
                    else:
                        turned[j, a, b] = step[a, b]
