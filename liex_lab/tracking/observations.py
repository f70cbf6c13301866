"""Pose hypotheses of single frames as columns: the measurements used by the tracker.

Each frame has four hypotheses in the arena frame: for the best and the second-best component of
about the animal's size, the best pose and the best pose with the opposite heading. Hypothesis h ^ 1
is hypothesis h with head and tail exchanged. The fields are the columns of `observations.npz`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from liex_lab.arrays import Array, NDArray
from liex_lab.body._skinning_kernels import place_joints
from liex_lab.body.pose import KinematicTree, Pose
from liex_lab.body.skeleton import Skeleton
from liex_lab.geometry import SE3, so3
from liex_lab.runtime.memory import Allocator, Rows, blocks, put
from liex_lab.scene.height_maps import N_OBJECTS

Small = NDArray[np.float32]


@dataclass(frozen=True)
class Observations(Rows):
    """Hypotheses (n, H) of n frames, NaN if absent.

    The first is the single-frame estimate. Single precision, as a recording may last hours.

    Attributes:
        skeleton: kinematic tree of the animal.
        times_ns: (n,) int64.
        turn: (n, H, 3) rotation of T_arena_root as its rotation vector, rad.
        place: (n, H, 3) position of the root, mm, arena frame.
        angles: (n, H, D) rad about the skeleton's D free axes, joint by joint, without the base.
        scale: (n, H) of the bones.
        error_mm: (n, H) expected mean joint error, mm.
        score: (n, H) score of the learned metric for the candidates, mm at home size.
        residual_mm: (n, H) distance between rendered body and depth, mm.
        n_px: (n, H) int32 pixels of the hypothesis's component, 0 if absent.
        centroid_mm: (n, H, 3) centre of that component, arena frame, mm.
        centroid_px: (n, H, 2) its projection, px of the depth image.
        has_depth: (n,) True if the frame has depth that is not copied from the previous frame.
        covered: (n, H) share of the silhouette that is covered by the rendered body.
        beside: (n, H) share of the rendered body that is outside the silhouette.
        behind: (n, H) share of the component's outline that borders on something nearer.
        part_mm: (n, H) largest residual of a part of the body, mm.
        repeats: (n,) True if the depth image is bit-identical to the previous one.
        objects: (n, N_OBJECTS, 4) centre x, y, z mm, arena frame, and area mm^2 of the components
            of about the animal's size.
    """

    skeleton: Skeleton
    times_ns: NDArray[np.int64]
    turn: Small
    place: Small
    angles: Small
    scale: Small
    error_mm: Small
    score: Small
    residual_mm: Small
    n_px: NDArray[np.int32]
    centroid_mm: Small
    centroid_px: Small
    has_depth: NDArray[np.bool_]
    covered: Small
    beside: Small
    behind: Small
    part_mm: Small
    repeats: NDArray[np.bool_]
    objects: Small

    @staticmethod
    def empty(
        skeleton: Skeleton, times_ns: NDArray[np.int64], n_components: int = 2
    ) -> Observations:
        """Observations of frames without detections; `has_depth` is True throughout.

        Args:
            skeleton: kinematic tree of the animal.
            times_ns: (n,) time stamps.
            n_components: components of a frame, each with two hypotheses.

        Returns:
            n frames of hypotheses, four by default, all NaN.
        """
        n = len(times_ns)
        h = 2 * n_components
        d = int(skeleton.axes[1:].sum())

        def nothing(*shape: int) -> Small:
            """NaN (n, H, *shape), float32."""
            return np.full((n, h, *shape), np.nan, np.float32)

        return Observations(
            skeleton,
            np.asarray(times_ns, np.int64),
            nothing(3),
            nothing(3),
            nothing(d),
            nothing(),
            nothing(),
            nothing(),
            nothing(),
            np.zeros((n, h), np.int32),
            nothing(3),
            nothing(2),
            np.ones(n, np.bool_),
            nothing(),
            nothing(),
            nothing(),
            nothing(),
            np.zeros(n, np.bool_),
            np.full((n, N_OBJECTS, 4), np.nan, np.float32),
        )

    def put_pose(self, h: int, pose: Pose) -> None:
        """Set poses as hypothesis h of all frames, in place.

        Args:
            h: index of the hypothesis.
            pose: (n) poses in the arena frame, NaN if absent.
        """
        known = np.isfinite(pose.scale)
        self.turn[known, h] = so3.log(pose.root.rotation[known])
        self.place[:, h] = pose.root.translation
        self.scale[:, h] = pose.scale
        self.angles[:, h] = pose.angles[:, 1:][:, self.skeleton.axes[1:]]

    def __len__(self) -> int:
        """The number of frames n."""
        return len(self.times_ns)

    @property
    def seconds(self) -> Array:
        """(n,) s since the first frame."""
        return np.asarray((self.times_ns - self.times_ns[:1]) * 1e-9)

    @property
    def known(self) -> NDArray[np.bool_]:
        """(n, H) True if the hypothesis exists."""
        return np.isfinite(self.score)

    def copied(self, allocate: Allocator) -> Observations:
        """The same observations in columns of their own, made by `allocate`."""
        columns: dict[str, Any] = {}
        own = {name: getattr(self, name) for name in COLUMNS}
        put(columns, slice(None), own, len(self), allocate)
        return replace(self, **columns)

    def forget(self, copies: NDArray[np.bool_]) -> None:
        """Clear, in place, the observations of frames (n,) whose depth image is a copy."""
        nothing = Observations.empty(self.skeleton, self.times_ns, self.score.shape[1] // 2)
        for name in {*COLUMNS} - {"times_ns", "repeats"}:
            getattr(self, name)[copies] = getattr(nothing, name)[copies]
        self.has_depth[copies] = False

    @property
    def copies(self) -> NDArray[np.bool_]:
        """(n,) True if the depth image is a copy of the previous one, without new information."""
        return self.repeats & ~self.has_depth

    @property
    def shown(self) -> NDArray[np.int64]:
        """(n,) row of the frame in which each depth image was taken; for copies, the original's."""
        return np.maximum.accumulate(np.where(self.copies, 0, np.arange(len(self))))

    def pose(self, path: NDArray[np.int64]) -> Pose:
        """Poses (n) along a path of hypotheses, arena frame.

        Args:
            path: (n,) index of a hypothesis for each frame, negative for none.

        Returns:
            (n) poses; NaN if the path is negative or the hypothesis is absent.
        """
        turn, place, free, scale = (
            self.along(v, path) for v in (self.turn, self.place, self.angles, self.scale)
        )
        angles = np.zeros((len(path), self.skeleton.n_joints, 3))
        angles[:, 1:][:, self.skeleton.axes[1:]] = free
        return Pose(SE3(so3.exp(turn), place), angles, scale)

    def along(self, values: NDArray[np.generic], path: NDArray[np.int64]) -> Array:
        """Values along a path of hypotheses, in double precision.

        Args:
            values: (n, H, ...) one of the columns.
            path: (n,) index of a hypothesis for each frame, negative for none.

        Returns:
            (n, ...) float64, NaN if the path is negative.
        """
        taken = values[np.arange(len(path)), np.maximum(path, 0)].astype(np.float64)
        taken[path < 0] = np.nan
        return taken

    def joints(self, joints: Sequence[int], allocate: Allocator = np.empty) -> Small:
        """Positions of some joints in all hypotheses, by forward kinematics.

        Args:
            joints: indices of k joints.
            allocate: allocator of the result.

        Returns:
            (n, H, k, 3) mm, float32, arena frame; NaN if the hypothesis is absent.
        """
        out = allocate((*self.score.shape, len(joints), 3), np.float32)
        for rows in blocks(len(self), _BLOCK):
            part = self[rows]
            for h in range(self.score.shape[1]):
                out[rows, h] = part.joints_as(h, joints)
        return out

    def joints_as(self, h: int, joints: Sequence[int]) -> Small:
        """Positions of some joints in one of the hypotheses, by forward kinematics.

        Args:
            h: index of the hypothesis.
            joints: indices of k joints.

        Returns:
            (n, k, 3) mm, float32, arena frame; NaN if the hypothesis is absent.
        """
        out = np.full((len(self), len(joints), 3), np.nan, np.float32)
        rows = np.flatnonzero(self.known[:, h])
        if len(rows):
            pose = self.pose(np.full(len(self), h))[rows]
            out[rows] = joints_of(self.skeleton, pose)[:, list(joints)]
        return out


def joints_of(skeleton: Skeleton, pose: Pose) -> Array:
    """Joint positions of poses by forward kinematics; as `Pose.joints`, but faster.

    Returns:
        (n, J, 3) mm in the poses' frame.
    """
    out = np.empty((len(pose.scale), skeleton.n_joints, 3))
    place_joints(
        KinematicTree.of(skeleton),
        pose.root.rotation,
        pose.root.translation,
        pose.angles,
        np.asarray(pose.scale, float),
        out,
    )
    return out


_BLOCK = 4096
COLUMNS = tuple(field.name for field in fields(Observations) if field.name != "skeleton")
OF_COMPONENTS = {*COLUMNS} - {"times_ns", "has_depth", "repeats", "objects"}


def reversed_pose(skeleton: Skeleton, pose: Pose) -> Pose:
    """The same poses with head and tail exchanged.

    Joints are moved along the body's midline to the arc lengths measured from its other end.

    Args:
        skeleton: a kinematic tree that is one chain.
        pose: (n) poses.

    Returns:
        (n) poses in the same frame.
    """
    joints = pose.joints(skeleton)
    up = pose.root.rotation[:, :, 2]
    reach = np.concatenate([[0.0], np.cumsum(np.linalg.norm(skeleton.offsets[1:], axis=1))])
    turned = np.empty_like(joints)
    for i, line in enumerate(joints):
        along = reach[-1] - reach[::-1]
        for k in range(3):
            turned[i, :, k] = np.interp(reach, along, line[::-1, k])
    return Pose.from_joints(skeleton, turned, up)
