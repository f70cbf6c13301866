"""The cascade: regressors joint by joint and round by round, and the candidates they move (Lie-X
Algorithm 1).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from liex_lab.body.kinematics import aim
from liex_lab.body.skeleton import Skeleton
from liex_lab.body.spheres import Balls
from liex_lab.estimation import _feature_kernels as kernels
from liex_lab.estimation import _residual_kernels as explaining
from liex_lab.estimation.method import Method
from liex_lab.forests._kernels import VIEW
from liex_lab.forests.forest import Forest, Samples, predict
from liex_lab.geometry import SE3, so3

Array = NDArray[np.float64]


@dataclass
class Candidates:
    """Poses under way, n of them on a set of images: all joints' frames, in the view frame of their
    image.

    image (n,) int32; rotations (n, J, 3, 3); positions (n, J, 3) mm; scale (n,) of the bones; size
    (n,) of the animal over home size, by which features are normalised.
    """

    image: NDArray[np.int32]
    rotations: Array
    positions: Array
    scale: Array
    size: Array

    @staticmethod
    def start(
        skeleton: Skeleton,
        image: NDArray[np.int32],
        rotation: Array,
        position: Array,
        scale: Array,
        size: Array,
    ) -> Candidates:
        """Candidates with only their base in place."""
        n = len(image)
        j = skeleton.n_joints
        rotations = np.zeros((n, j, 3, 3))
        positions = np.zeros((n, j, 3))
        rotations[:, 0] = rotation
        positions[:, 0] = position
        return Candidates(image, rotations, positions, scale.copy(), size)

    def __len__(self) -> int:
        return len(self.image)


@dataclass(frozen=True)
class ImageSet:
    """Height maps and how they were cut: heights (m, S, S) int16, looks (m, 17), moments (m, 8)."""

    heights: NDArray[np.int16]
    looks: Array
    moments: Array

    def __getitem__(self, rows: NDArray[np.int64]) -> ImageSet:
        """Some of them."""
        return ImageSet(self.heights[rows], self.looks[rows], self.moments[rows])


def mm_per_px(looks: Array) -> Array:
    """How many mm (m,) a pixel of each height map covers at the distance of its view's origin;
    looks (m, 17).
    """
    return looks[:, 16] * looks[:, 13] / looks[:, 0]


@dataclass(frozen=True)
class Cascade:
    """A skeleton, a method, and one forest per solved joint and round, in order; proposals say
    where to start.
    """

    skeleton: Skeleton
    method: Method
    forests: list[list[Forest]]
    proposals: Forest | None = None

    def n_values(self, joint: int) -> int:
        """Length of a joint's correction: base 6, or 7 with the scale; others one for each free
        axis.
        """
        if joint == 0:
            return 7 if self.method.regress_scale else 6
        return int(self.skeleton.axes[joint].sum())

    def place(self, candidates: Candidates, joint: int) -> None:
        """Put a joint where its parent carries it."""
        s = self.skeleton
        kernels.place_all(
            joint,
            s.parents,
            s.offsets,
            s.rest,
            candidates.scale,
            candidates.rotations,
            candidates.positions,
        )

    def steps(self, images: ImageSet, candidates: Candidates) -> Iterator[tuple[int, int]]:
        """Algorithm 1 as it is written: move the candidates, each by itself, by one forest after
        the other; yields the joint and the round of each.
        """
        for joint, rounds in zip(self.skeleton.solved, self.forests, strict=True):
            if joint:
                self.place(candidates, joint)
            for c, forest in enumerate(rounds):
                self.apply(
                    candidates, joint, predict(forest, self.samples(images, candidates, [joint]))
                )
                yield joint, c
        self.place_ends(candidates)

    def place_ends(self, candidates: Candidates) -> None:
        """Put every joint that no regressor moves where its parent carries it."""
        for joint in range(1, self.skeleton.n_joints):
            if joint not in self.skeleton.solved:
                self.place(candidates, joint)

    def samples(self, images: ImageSet, candidates: Candidates, joints: list[int]) -> Samples:
        """What forests see of the candidates at the given joints."""
        n = len(candidates)
        views = np.empty((n, len(joints), VIEW), np.float32)
        scalars = np.empty((n, kernels.N_SCALARS), np.float32)
        kernels.look_all(
            np.array(joints),
            images.looks,
            images.moments,
            candidates.image,
            candidates.size,
            self.method.reaches(self.skeleton.n_joints)[joints],
            candidates.rotations,
            candidates.positions,
            candidates.scale,
            views,
            scalars,
        )
        inverse_size = (1.0 / candidates.size).astype(np.float32)
        return Samples(images.heights, candidates.image, inverse_size, views, scalars)

    @cached_property
    def balls(self) -> Balls:
        """The body that candidates are held against the picture with."""
        return Balls.of(self.skeleton)

    def metric_samples(self, images: ImageSet, candidates: Candidates) -> Samples:
        """What the learned metric sees of finished candidates: all joints, and how well they
        explain the picture.
        """
        samples = self.samples(images, candidates, list(range(self.skeleton.n_joints)))
        if not self.method.explains:
            return samples
        fit = np.empty((len(candidates), explaining.N_FIT), np.float32)
        explaining.explain_all(
            images.heights,
            images.looks,
            images.moments,
            candidates.image,
            candidates.rotations,
            candidates.positions,
            candidates.scale,
            candidates.size,
            body_of(self.balls),
            fit,
        )
        return replace(samples, scalars=np.concatenate([samples.scalars, fit], axis=1))

    def apply(self, candidates: Candidates, joint: int, values: NDArray[np.float32]) -> None:
        """Move the candidates by a forest's prediction (n, n_values), Eq. 10."""
        method = self.method
        if joint == 0:
            levers = np.array([method.base_lever_mm, method.scale_lever_mm])
            kernels.correct_base_all(
                candidates.rotations,
                candidates.positions,
                candidates.scale,
                values,
                levers,
                candidates.size,
            )
        else:
            kernels.correct_joint_all(
                joint,
                candidates.rotations,
                self.skeleton.axes[joint],
                values,
                method.joint_lever_mm,
            )

    def labels(
        self, candidates: Candidates, joint: int, truth: Truth
    ) -> tuple[Array, NDArray[np.bool_]]:
        """Corrections (n, n_values) that lead to the truth, in lever units, and which samples are
        worth learning from.

        Base: log(g_est^-1 g_true) (Eq. 11) with lengths at home size. Other joints: the rotation
        about the free axes that remains, or the one that aims the bone at the true next joint.
        """
        method = self.method
        i = candidates.image
        estimate = SE3(candidates.rotations[:, joint], candidates.positions[:, joint])
        true = SE3(truth.rotations[i, joint], truth.positions[i, joint])
        if joint == 0:
            twist = (estimate.inverse() @ true).log()
            keep = np.linalg.norm(twist[:, :3], axis=1) < method.keep_turned
            twist[:, :3] *= method.base_lever_mm
            twist[:, 3:] /= candidates.size[:, None]
            if not method.regress_scale:
                return twist, keep
            grow = np.log(truth.scale[i] / candidates.scale) * method.scale_lever_mm
            return np.concatenate([twist, grow[:, None]], axis=1), keep
        if method.point_at:
            child = self.skeleton.next_joint[joint]
            ahead = (truth.positions[i, child] - estimate.translation)[
                :, None, :
            ] @ estimate.rotation
            turn = aim_about(self.skeleton.offsets[child], ahead[:, 0], self.skeleton.axes[joint])
        else:
            turn = so3.log(np.swapaxes(estimate.rotation, 1, 2) @ true.rotation)
        turn = turn[:, self.skeleton.axes[joint]]
        off = np.linalg.norm(true.translation - estimate.translation, axis=1) / candidates.size
        keep = (np.linalg.norm(turn, axis=1) < method.keep_bent) & (off < method.keep_off_mm)
        return turn * method.joint_lever_mm, keep


def body_of(balls: Balls) -> explaining.Body:
    """A body of balls as the kernels want it."""
    return explaining.Body(
        balls.unit_mm, balls.n_own, balls.joints, balls.offsets, balls.share, balls.radius
    )


@dataclass(frozen=True)
class Truth:
    """True poses of m images in their view frames: rotations (m, J, 3, 3), positions (m, J, 3) mm,
    scale (m,).
    """

    rotations: Array
    positions: Array
    scale: Array


def aim_about(bone: Array, wanted: Array, axes: NDArray[np.bool_]) -> Array:
    """Rotation vectors (n, 3) about the free axes that turn `bone` (3,) towards directions `wanted`
    (n, 3).

    A hinge turns by the angle seen along its axis; a joint with more axes takes the smallest
    rotation's share of them.
    """
    if axes.sum() > 1:
        return aim(bone, wanted)
    axis = axes.astype(float)
    flat_bone = bone - (bone @ axis) * axis
    flat = wanted - (wanted @ axis)[:, None] * axis
    angle = np.arctan2(
        np.cross(np.broadcast_to(flat_bone, flat.shape), flat) @ axis, flat @ flat_bone
    )
    return angle[:, None] * axis
