"""Kernels of forward kinematics (product of exponentials) for many poses, without NumPy's overhead.

t_j = t_p + s R_p b_j, R_j = R_p Q_j exp(hat(w_j)), with exp by Rodrigues' formula; the twin of
`kinematics.forward_kinematics`.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from liex_lab.geometry._so3_kernels import exp_so3


@njit(cache=True)
def place_joints(tree, rotation, translation, angles, scale, out):
    """Positions of the joints of n poses; the kernel twin of `Pose.joints`.

    Args:
        tree: `KinematicTree` of the skeleton.
        rotation: (n, 3, 3) of the root.
        translation: (n, 3) mm of the root.
        angles: (n, J, 3) rad.
        scale: (n,) of the bones.
        out: (n, J, 3) mm, out.
    """
    n_joints = tree.parents.size
    turned = np.empty((n_joints, 3, 3))
    own = np.empty((3, 3))
    step = np.empty((3, 3))
    for i in range(scale.size):
        for a in range(3):
            out[i, 0, a] = translation[i, a]
            for b in range(3):
                turned[0, a, b] = rotation[i, a, b]
        for j in range(1, n_joints):
            p = tree.parents[j]
            if tree.turning[j]:
                exp_so3(angles[i, j, 0], angles[i, j, 1], angles[i, j, 2], own)
            for a in range(3):
                total = 0.0
                for k in range(3):
                    total += turned[p, a, k] * tree.offsets[j, k]
                out[i, j, a] = out[i, p, a] + scale[i] * total
                for b in range(3):
                    value = 0.0
                    for k in range(3):
                        value += turned[p, a, k] * tree.rest[j, k, b]
                    step[a, b] = value
            for a in range(3):
                for b in range(3):
                    if tree.turning[j]:
                        turned[j, a, b] = (
                            step[a, 0] * own[0, b] + step[a, 1] * own[1, b] + step[a, 2] * own[2, b]
                        )
                    else:
                        turned[j, a, b] = step[a, b]
