"""RF, the paper's regression forest: F1 finds the animal and its heading, F2 its pose (Lie-X
section 5.2).

"Two separate regression forests, F1 and F2 [...]. F1 is used to estimate the 3D location and
in-plane orientation of the subject, followed by F2 which produces a set of 3D pose candidates", 7
and 12 trees of depth 20, on the depth invariant two-point features of Shotton et al. (2013). The
rest the paper leaves open, and is chosen here:

- F1 is asked at `n_points` pixels spread over the animal. Each of its leaves votes for the way from
  the pixel to the
  base joint and for the heading. The heading that most votes agree on is taken, then the mean-shift
  mode of the places
  of those votes that agree with it.
- F2 is asked once, at the place of F1, its offsets turned by the heading of F1. Each of its trees
  gives one pose
  candidate in the skeleton's own coordinates, so bones keep their proportions; the mean-shift mode
  of the candidates is
  the answer.
- Offsets reach as far as the animal is long. In half of the tests tried the second of the two
  points is the pixel
  itself, as in Shotton's own forests.
- F2 learns from where trees of F1 that have not seen the image put it, and from that only where F1
  has not taken the
  tail for the head.
"""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from liex_lab.baselines import _forest as kernels
from liex_lab.baselines.baseline import DAMAGE, Guesses, in_camera_frame, see
from liex_lab.body.kinematics import forward_kinematics
from liex_lab.body.skeleton import Skeleton
from liex_lab.errors import ModelError
from liex_lab.estimation.training import Tell, TrainingSet
from liex_lab.foreground.height_maps import Foreground
from liex_lab.forests._kernels import VIEW
from liex_lab.forests.forest import Forest, Samples
from liex_lab.forests.grow import GrowthPlan, grow_forest
from liex_lab.geometry import SE3, so3
from liex_lab.runtime.threads import threads

Array = NDArray[np.float64]

_F1 = GrowthPlan(7, 20, 10, 300, 0.5, 0.0, 0.0, 0.63)
_F2 = GrowthPlan(12, 20, 5, 300, 0.5, 0.0, 0.0, 0.63)
_LEAST_LEVER = (
    0.05  # of the animal's length: a turn about its own axis moves no joint of a straight animal
)


@dataclass(frozen=True)
class ForestPlan:
    """How the two forests grow. training_points: pixels of an image that F1 learns from, and
    n_points that it is asked at; draws: times that F2 sees each image, from other pixels;
    bandwidths (2) of the modes, of the animal's length.
    """

    where: GrowthPlan = _F1
    pose: GrowthPlan = _F2
    training_points: int = 16
    n_points: int = 32
    draws: int = 2
    bandwidths: tuple[float, float] = (0.15, 0.25)


@dataclass(frozen=True)
class RegressionForest:
    """The trained pair. where: F1, leaves (5): way to the base mm, heading; pose: F2, leaves (D):
    skeleton coordinates in lever units.
    """

    skeleton: Skeleton
    plan: ForestPlan
    where: Forest
    pose: Forest

    def find_size(self, sample: NDArray[np.float32], scene: Foreground) -> float:
        """1: the paper's forests know nothing of size."""
        return 1.0

    def estimate(
        self, depths: NDArray[np.float32], scene: Foreground, size: float, parallel: bool = True
    ) -> Guesses:
        """Joints of frames (n, H, W) mm in the camera frame."""
        crops, looks = see(depths, scene, parallel)
        s = self.skeleton
        n = len(looks)
        joints = np.full((n, s.n_joints, 3), np.nan)
        with threads(parallel):
            kernels.guess_all(
                crops.heights,
                looks,
                crops.found,
                self.plan.n_points,
                s.length,
                s.length * np.array(self.plan.bandwidths),
                self.where.nodes,
                self.where.roots,
                self.where.leaves,
                self.pose.nodes,
                self.pose.roots,
                self.pose.leaves,
                levers(s),
                s.parents,
                s.offsets,
                s.rest,
                s.axes,
                joints,
            )
        return Guesses(in_camera_frame(joints, looks), crops.found, crops)

    def to_bytes(self) -> bytes:
        """The model as the bytes of an .npz without pickle; skeleton and plan are known to who asks
        for it.
        """
        arrays: dict[str, Any] = {}
        for name, forest in (("where", self.where), ("pose", self.pose)):
            arrays |= {
                f"{name}_{part}": getattr(forest, part) for part in ("nodes", "roots", "leaves")
            }
        packed = io.BytesIO()
        np.savez_compressed(packed, **arrays)
        return packed.getvalue()

    @staticmethod
    def load(path: Path, skeleton: Skeleton, plan: ForestPlan) -> RegressionForest:
        """The forests in a file of `to_bytes`. Raises ModelError."""
        try:
            with path.open("rb") as file, np.load(file, allow_pickle=False) as archive:
                where, pose = (
                    Forest(*(archive[f"{name}_{part}"] for part in ("nodes", "roots", "leaves")))
                    for name in ("where", "pose")
                )
        except DAMAGE as error:
            raise ModelError(
                f"{path} is not a whole regression forest ({error}); remove it and train again"
            ) from None
        return RegressionForest(skeleton, plan, where, pose)


def levers(skeleton: Skeleton) -> Array:
    """How far (D,) mm a unit of each coordinate of F2 moves the joints of the home pose, root mean
    square over joints.

    Coordinates: the base's rotation about x, y, z (rad), its translation (mm, lever 1), log scale,
    then the angles about the other joints' free axes in the skeleton's order. One unit of label is
    then about one millimetre of error.
    """
    rotations, positions = forward_kinematics(
        skeleton, SE3.identity(), np.zeros((skeleton.n_joints, 3)), np.ones(())
    )
    below = np.eye(skeleton.n_joints, dtype=bool)
    for j in range(skeleton.n_joints - 1, 0, -1):
        below[skeleton.parents[j]] |= below[j]
    rows: list[float] = []
    for j in skeleton.solved:
        off = positions[below[j]] - positions[j]
        for k in np.flatnonzero(skeleton.axes[j]):
            moved = np.cross(rotations[j][:, k], off)
            rows.append(float(np.sqrt((moved**2).sum() / skeleton.n_joints)))
        if j == 0:
            rows += [1.0, 1.0, 1.0, float(np.sqrt((off**2).sum() / skeleton.n_joints))]
    lever = np.array(rows)
    lever[3:6] = np.inf
    lever = np.maximum(lever, _LEAST_LEVER * skeleton.length)
    lever[3:6] = 1.0
    return lever


def coordinates(
    data: TrainingSet, skeleton: Skeleton, image: NDArray[np.int32], places: Array, headings: Array
) -> Array:
    """True coordinates (n, D) of F2 in lever units, as seen from places (n, 3) and headings (n,) in
    images (n,).
    """
    zero = np.zeros_like(headings)
    start = SE3(so3.exp(np.stack([zero, zero, headings], axis=1)), places)
    truth = data.truth
    twist = (start.inverse() @ SE3(truth.rotations[image, 0], truth.positions[image, 0])).log()
    parts = [twist, np.log(truth.scale[image])[:, None]]
    for j in skeleton.solved[1:]:
        parent = truth.rotations[image, skeleton.parents[j]] @ skeleton.rest[j]
        turn = so3.log(np.swapaxes(parent, 1, 2) @ truth.rotations[image, j])
        parts.append(turn[:, skeleton.axes[j]])
    return np.concatenate(parts, axis=1) * levers(skeleton)


def train_forests(
    data: TrainingSet, skeleton: Skeleton, plan: ForestPlan, rng: np.random.Generator, tell: Tell
) -> RegressionForest:
    """Grow F1, then F2 on where F1 puts images that its trees have not seen."""
    tell(0.0, "F1")
    where, in_bag = _grow_where(data, skeleton, plan, rng)
    tell(0.5, "F2")
    image = np.repeat(np.flatnonzero(data.animal).astype(np.int32), plan.draws)
    places = np.empty((len(image), 3))
    headings = np.empty(len(image))
    unseen = ~in_bag.T[image]
    unseen |= ~unseen.any(axis=1, keepdims=True)  # all trees have seen it: then all are asked
    kernels.locate_all(
        data.images.heights,
        data.images.looks,
        image,
        rng.random(len(image)),
        plan.n_points,
        skeleton.length,
        plan.bandwidths[0] * skeleton.length,
        where.nodes,
        where.roots,
        where.leaves,
        unseen,
        places,
        headings,
    )
    labels = coordinates(data, skeleton, image, places, headings)
    turned = np.linalg.norm(labels[:, :3] / levers(skeleton)[:3], axis=1)
    samples = _samples(data, skeleton, image, places, headings)
    pose, _ = grow_forest(samples, labels.astype(np.float32), turned < np.pi / 2, plan.pose, rng)
    return RegressionForest(skeleton, plan, where, pose)


def _grow_where(
    data: TrainingSet, skeleton: Skeleton, plan: ForestPlan, rng: np.random.Generator
) -> tuple[Forest, NDArray[np.bool_]]:
    """F1, and which images each of its trees has seen (T, n_images)."""
    animals = np.flatnonzero(data.animal).astype(np.int32)
    points = np.empty((len(animals), plan.training_points, 3))
    kernels.points_all(
        data.images.heights, data.images.looks, animals, rng.random(len(animals)), points
    )
    image = np.repeat(animals, plan.training_points)
    places = points.reshape(-1, 3)
    heading = 0.5 * skeleton.length * data.truth.rotations[image, 0, :2, 0]
    labels = np.concatenate([data.truth.positions[image, 0] - places, heading], axis=1).astype(
        np.float32
    )
    samples = _samples(data, skeleton, image, places, np.zeros(len(image)))
    return grow_forest(samples, labels, np.ones(len(image), np.bool_), plan.where, rng)


def _samples(
    data: TrainingSet, skeleton: Skeleton, image: NDArray[np.int32], places: Array, headings: Array
) -> Samples:
    """What the forests see from places (n, 3) of images (n,)."""
    n = len(image)
    views = np.empty((n, 1, VIEW), np.float32)
    kernels.views_all(data.images.looks, image, places, headings, skeleton.length, views)
    return Samples(
        data.images.heights, image, np.ones(n, np.float32), views, np.zeros((n, 1), np.float32)
    )
