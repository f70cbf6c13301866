"""Parametric hand and arm shapes: random bone lengths, girths and palms, as capsules.

Log-normal factors (clipped at two standard deviations) multiply the preset's bone lengths finger by
finger, the breadth of the palm, and the capsules' radii. A forearm, a sleeve and an upper arm are
additional capsules behind the wrist, opposite to the direction of the hand.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from liex_lab.body.capsules import Capsules
from liex_lab.body.kinematics import aim
from liex_lab.body.pose import Pose
from liex_lab.body.shape import FAMILIES
from liex_lab.body.skeleton import Skeleton
from liex_lab.errors import LiexError
from liex_lab.geometry import so3

Array = NDArray[np.float64]

_FINGERS = ("thumb", "index", "middle", "ring", "little")
ARM_MM = 260.0  # from the wrist to the elbow, at scale 1
_ELBOW = 1
_SHOULDER = 2
_MOST_AWAY = 0.0  # largest component of a forearm's direction away from the camera
N_ARM_CAPSULES = 4


@dataclass(frozen=True)
class HandShape:
    """The hands of n people. Lengths in mm at scale 1.

    Attributes:
        offsets: (n, J, 3) mm, the joints as in `Skeleton.offsets`.
        flesh: capsules, a batch (n).
        arm: (n, 4) radii mm at wrist and elbow, ratio of width to thickness, and the start of a
            sleeve along the forearm as a share (1: no sleeve).
    """

    offsets: Array
    flesh: Capsules
    arm: Array

    def __len__(self) -> int:
        """Number of people."""
        return len(self.offsets)

    def __getitem__(self, index: slice | NDArray[np.int64]) -> HandShape:
        """Some of the people, by slice or row numbers."""
        return HandShape(self.offsets[index], self.flesh[index], self.arm[index])

    def joints(self, skeleton: Skeleton, pose: Pose) -> tuple[Array, Array]:
        """Joints of each person's own hand in a pose: forward kinematics with individual bone
        lengths.

        Args:
            skeleton: of the hand.
            pose: (n) poses.

        Returns:
            Rotations (n, J, 3, 3) and positions (n, J, 3) mm, in the poses' frame.
        """
        rotations = pose.frames(skeleton).rotation
        positions = np.empty(self.offsets.shape)
        positions[:, 0] = pose.root.translation
        for j in range(1, skeleton.n_joints):
            p = skeleton.parents[j]
            step = np.einsum("nij,nj->ni", rotations[:, p], self.offsets[:, j])
            positions[:, j] = positions[:, p] + pose.scale[:, None] * step
        return rotations, positions


def draw_hands(rng: np.random.Generator, skeleton: Skeleton, family: str, n: int) -> HandShape:
    """Draw the hands of n people of a family.

    Args:
        rng: random generator.
        skeleton: of the hand, with names that begin with a finger's and an underscore.
        family: 'train' varies the preset as people vary, 'augmented' somewhat more; 'other' has
            hands that no model is trained on: short and plump ones, and long and slender ones.
        n: people.

    Returns:
        A batch (n) of hands.

    Raises:
        LiexError: there is no such family.
    """
    if family not in FAMILIES:
        raise LiexError(f"there is no shape family '{family}'; choose one of {', '.join(FAMILIES)}")
    wide = {"train": 1.0, "augmented": 1.5, "wide": 2.0, "other": 1.0}[family]

    def draw(sd: float, *shape: int) -> Array:
        """Log-normal factors (n, *shape), clipped at two standard deviations.

        Args:
            sd: of their logarithm, before the family's own factor.
            *shape: axes behind n.
        """
        return np.exp(wide * sd * np.clip(rng.standard_normal((n, *shape)), -2.0, 2.0))

    lengths = draw(0.03, 5)
    girth = draw(0.09)
    breadth = draw(0.05)
    if family == "other":
        plump = rng.random(n) < 0.5
        lengths *= np.where(plump, rng.uniform(0.82, 0.9, n), rng.uniform(1.1, 1.18, n))[:, None]
        girth *= np.where(plump, rng.uniform(1.25, 1.4, n), rng.uniform(0.72, 0.8, n))
        breadth *= np.where(plump, rng.uniform(1.08, 1.16, n), rng.uniform(0.84, 0.92, n))
    offsets = np.broadcast_to(skeleton.offsets, (n, skeleton.n_joints, 3)).copy()
    for j, name in enumerate(skeleton.names[1:], start=1):
        finger = name.split("_")[0]
        if skeleton.parents[j] == 0:
            offsets[:, j] *= np.stack([draw(0.03), breadth, np.ones(n)], axis=1)
        else:
            offsets[:, j] *= (lengths[:, _FINGERS.index(finger)] * draw(0.02))[:, None]
    flesh = Capsules.of(skeleton)
    n_capsules = len(flesh.joints)
    radii = flesh.radii * girth[:, None, None] * draw(0.05, n_capsules, 1)
    bones = flesh.joints[: skeleton.n_joints - 1]
    of_finger = np.concatenate([bones[:, 0] > 0, np.zeros(n_capsules - len(bones), bool)])
    radii *= np.where(of_finger[None, :], draw(0.06)[:, None], 1.0)[..., None]
    wrist = rng.uniform(22.0, 29.0, n) * np.sqrt(girth)
    sleeve = np.where(rng.random(n) < 0.5, rng.uniform(0.0, 0.7, n), 1.0)
    arm = np.stack(
        [wrist, wrist * rng.uniform(1.15, 1.55, n), rng.uniform(1.1, 1.45, n), sleeve], axis=1
    )
    ends = np.broadcast_to(flesh.offsets, (n, *flesh.offsets.shape)).copy()
    return HandShape(offsets, Capsules(flesh.joints, ends, radii, np.zeros(n)), arm)


def forearms(
    rng: np.random.Generator,
    rotations: Array,
    positions: Array,
    scale: Array,
    bent: Array | None = None,
) -> tuple[Array, Array]:
    """Frames and elbows of the forearms that carry hands.

    The wrist bends within its usual range, and further if the arm would otherwise point towards the
    camera: a person stands behind the hand.

    Args:
        rng: random generator.
        rotations: (n, J, 3, 3) of the hands' joints, camera frame.
        positions: (n, J, 3) mm of the joints, camera frame.
        scale: (n,) of the hands.
        bent: (n, 3) rad, the wrists' bends; None to draw them.

    Returns:
        Frames (n, 3, 3), x from the elbow to the wrist, and elbows (n, 3) mm, camera frame.
    """
    n = len(scale)
    bend = np.zeros((n, 3))
    if bent is None:
        bent = np.radians(
            np.stack([np.zeros(n), rng.normal(0.0, 22.0, n), rng.normal(0.0, 12.0, n)], axis=1)
        )
    bend[:, 1] = np.clip(bent[:, 1], -1.0, 1.0)
    bend[:, 2] = np.clip(bent[:, 2], -0.4, 0.4)
    turned = rotations[:, 0] @ so3.exp(bend)
    forward = turned[:, :, 0].copy()
    forward[:, 2] = np.minimum(forward[:, 2], _MOST_AWAY)
    frame = so3.exp(aim(turned[:, :, 0], forward)) @ turned
    return frame, positions[:, 1:3].mean(axis=1) - (scale * ARM_MM)[:, None] * frame[:, :, 0]


def arm_vertices(frame: Array, elbow: Array, shoulder: Array, scale: Array, arm: Array) -> Array:
    """Meshes of forearm, sleeve and upper arm: four capsules for each.

    Args:
        frame: (n, 3, 3) of the forearms, from `forearms`.
        elbow: (n, 3) mm, from `forearms`.
        shoulder: (n, 3) mm, in the same frame.
        scale: (n,) of the hands.
        arm: (n, 4) as in `HandShape`.

    Returns:
        (n, V, 3) mm.
    """
    n = len(scale)
    wrist = elbow + (scale * ARM_MM)[:, None] * frame[:, :, 0]
    joints = np.stack([wrist, elbow, shoulder], axis=1)
    # two adjacent tubes make an arm that is wider than thick
    side = 0.5 * arm[:, 0] * (arm[:, 2] - 1.0) * 2.0
    offsets = np.zeros((n, 4, 2, 3))
    radii = np.zeros((n, 4, 2))
    for c, sign in enumerate((1.0, -1.0)):
        offsets[:, c, :, 1] = sign * side[:, None]
        offsets[:, c, 0, 0] = 12.0
        radii[:, c] = arm[:, :2]
    sleeve = arm[:, 3]
    offsets[:, 2, 0, 0] = -np.minimum(sleeve, 0.98) * ARM_MM  # a tube needs some length
    wide = 1.25 * (arm[:, 0] + sleeve * (arm[:, 1] - arm[:, 0]) + side)
    radii[:, 2] = np.where(sleeve < 1.0, [wide, 1.3 * arm[:, 1]], 1.0).T
    radii[:, 3] = 1.3 * arm[:, 1:2]
    ends = np.array([[0, _ELBOW], [0, _ELBOW], [0, _ELBOW], [_ELBOW, _SHOULDER]])
    tubes = Capsules(ends, offsets, radii, np.zeros(n))
    return tubes.vertices(np.repeat(frame[:, None], 3, axis=1), joints, scale, scale)
