"""A pose: root transform in SE(3), joint rotation vectors and one scale, of one animal or a batch.

The kinematic chain of Lie-X section 3 in coordinates: joint j's transform relative to its parent is
exp of a rotation vector about its free axes, after a fixed bone; the product of these exponentials
along the tree gives every joint (`forward_kinematics`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from liex_lab.body.kinematics import chain_from_joints, forward_kinematics
from liex_lab.body.skeleton import Skeleton
from liex_lab.geometry import SE3

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Pose:
    """Skeleton coordinates, one pose or a batch (...).

    Attributes:
        root: T_frame_root (...), the base joint in the pose's frame, mm.
        angles: (..., J, 3) rad, rotation vectors of each joint relative to its parent, zero at the
            base and on axes that are not free.
        scale: (...) of all bones.
    """

    root: SE3
    angles: Array
    scale: Array

    @staticmethod
    def home(skeleton: Skeleton, *batch: int) -> Pose:
        """The straight pose at the origin, pointing along x, or a batch of the given shape."""
        return Pose(SE3.identity(*batch), np.zeros((*batch, skeleton.n_joints, 3)), np.ones(batch))

    def __getitem__(
        self, index: NDArray[np.bool_] | NDArray[np.int64] | slice | int | tuple[Any, ...]
    ) -> Pose:
        """Some poses of a batch, by mask, row numbers, slice, number, or a tuple for multiple batch
        axes.
        """
        return Pose(
            SE3(self.root.rotation[index], self.root.translation[index]),
            self.angles[index],
            self.scale[index],
        )

    def frames(self, skeleton: Skeleton) -> SE3:
        """T_frame_joint of every joint, a batch (..., J), mm."""
        rotation, position = forward_kinematics(skeleton, self.root, self.angles, self.scale)
        return SE3(rotation, position)

    def joints(self, skeleton: Skeleton) -> Array:
        """Joint positions (..., J, 3) mm in the pose's frame."""
        return forward_kinematics(skeleton, self.root, self.angles, self.scale)[1]

    def placed(self, skeleton: Skeleton) -> PlacedPose:
        """The same poses with precomputed frames of their joints."""
        return PlacedPose(self.root, self.angles, self.scale, self.frames(skeleton))

    def moved(self, T_new_old: SE3) -> Pose:
        """The same posture in another frame.

        Args:
            T_new_old: transforms the present frame to the new one; broadcasts with the batch.
        """
        return Pose(T_new_old @ self.root, self.angles, self.scale)

    @staticmethod
    def join(parts: Sequence[Pose]) -> Pose:
        """Concatenate batches (n), at least one, with one batch axis each."""
        root = SE3(
            *(
                np.concatenate([getattr(p.root, name) for p in parts])
                for name in ("rotation", "translation")
            )
        )
        return Pose(
            root,
            np.concatenate([p.angles for p in parts]),
            np.concatenate([p.scale for p in parts]),
        )

    @staticmethod
    def from_joints(skeleton: Skeleton, joints: ArrayLike, up: ArrayLike) -> Pose:
        """The pose (...) whose bones point along given joint positions of one chain.

        Each joint rotates by the smallest rotation that aims its bone; the base's roll is chosen so
        that its z axis is as near to `up` as its bone allows. Bones keep their proportions; the
        scale is computed from the total length.

        Args:
            skeleton: one chain of joints (mouse, fish).
            joints: (..., J, 3) mm.
            up: (3,) or (..., 3), any length.
        """
        root, angles, scale = chain_from_joints(
            skeleton, np.asarray(joints, float), np.asarray(up, float)
        )
        return Pose(root, angles, scale)


@dataclass(frozen=True)
class PlacedPose(Pose):
    """Poses with precomputed frames of their joints.

    Its arrays must not be modified, as the frames would become invalid. `moved` returns a plain
    `Pose`.

    Attributes:
        T_frame_joint: (..., J) frames of the joints, mm.
    """

    T_frame_joint: SE3

    def __getitem__(
        self, index: NDArray[np.bool_] | NDArray[np.int64] | slice | int | tuple[Any, ...]
    ) -> PlacedPose:
        """Some poses of a batch, see `Pose`."""
        some = super().__getitem__(index)
        placed = self.T_frame_joint
        return PlacedPose(
            some.root,
            some.angles,
            some.scale,
            SE3(placed.rotation[index], placed.translation[index]),
        )

    def frames(self, skeleton: Skeleton) -> SE3:
        """T_frame_joint of every joint, a batch (..., J), mm."""
        return self.T_frame_joint

    def joints(self, skeleton: Skeleton) -> Array:
        """Joint positions (..., J, 3) mm in the pose's frame."""
        return self.T_frame_joint.translation
