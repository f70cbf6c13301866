"""Interface of the baselines: frames and a fitted segmenter in, the animal's joints per frame out.

This module also has the ablation without the learned metric, the plain mean of all candidates,

    x_j = 1/K sum_k x_j^(k)        for each joint j over the K candidates.

The ablation without multiple initial poses needs no code of its own: it is `PoseEstimator(model, 1,
start_seed=k)`, with one initial pose drawn from the seed k.

All baselines of Lie-X section 5.2 use liex_lab's segmentation, so that only the pose estimation
differs.

The paper's RF baseline is a two-stage regression forest (F1 position and heading, F2 pose).
Lie-X section 5.2: "Two separate regression forests, F1 and F2 [...]. F1 is used to estimate the 3D
location and in-plane orientation of the subject, followed by F2 which produces a set of 3D pose
candidates", 7 and 12 trees of depth 20, on the depth invariant two-point features of Shotton et al.
(2013). The paper leaves the rest open; the choices here are:

- F1 is evaluated at `n_points` pixels spread over the animal. Each leaf votes for the offset from
  the pixel to the base joint and for the heading (Hough voting). The heading is the one that most
  votes agree on, the position the mean-shift mode of the votes that agree with that heading.
- F2 is evaluated once, at F1's position, its offsets turned by F1's heading. Each tree gives one
  pose candidate in the skeleton's own coordinates, so bones keep their proportions; the result is
  the mean-shift mode of the candidates.
- Offsets reach as far as the animal is long. In half of the tests tried the second of the two
  points is the pixel itself, as in Shotton's forests.
- F2 learns from the estimates of those F1 trees that were not grown on the image, and only from
  estimates that do not mistake the tail for the head.
- F2's coordinates are relative to the home pose as the camera usually observes the animal: a hand
  that shows its palm is turned by pi from one that lies like a mouse.
"""

from __future__ import annotations

import io
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from liex_lab.arrays import Array, NDArray
from liex_lab.baselines import _kernels as kernels
from liex_lab.body.pose import KinematicTree, forward_kinematics
from liex_lab.body.skeleton import Skeleton
from liex_lab.errors import MissingPackageError, ModelError, expecting
from liex_lab.estimation.cascade import TrainingSet
from liex_lab.estimation.estimator import PoseEstimator
from liex_lab.estimation.training import ProgressCallback
from liex_lab.forests._kernels import VIEW
from liex_lab.forests.forest import Forest, Samples, check_forest
from liex_lab.forests.grow import GrowthPlan, grow_forest
from liex_lab.geometry import SE3, so3
from liex_lab.runtime.processes import in_parallel, threads
from liex_lab.scene.height_maps import HeightMaps, Segmenter, in_camera_frame

if TYPE_CHECKING:
    import torch


# exceptions that a broken .npz raises
_DAMAGE = (OSError, ValueError, LookupError, EOFError, RuntimeError, zipfile.BadZipFile)


@dataclass(frozen=True)
class Guesses:
    """Joints that a baseline estimates in n frames.

    Attributes:
        joints: (n, J, 3) joints, mm, camera frame; NaN where no animal was found.
        found: (n,) bool, where an animal was found.
        crops: the height maps that the estimate was made from.
    """

    joints: Array
    found: NDArray[np.bool_]
    crops: HeightMaps


class Baseline:
    """A pose estimator from the literature that uses liex_lab's segmentation.

    Attributes:
        skeleton: the animal's skeleton.
        takes_size: whether it uses the animal's size; the paper's baselines treat all sizes alike.
    """

    skeleton: Skeleton
    takes_size = False

    def find_size(self, sample: NDArray[np.float32], scene: Segmenter) -> float:
        """Estimate the animal's size from a sample of frames.

        Args:
            sample: (n, H, W) float32 frames, mm, 0 where unread.
            scene: the segmenter fitted to the recording.

        Returns:
            The animal's spine over the home length; 1 if the baseline has no notion of size.
        """
        return 1.0

    def estimate(
        self, depths: NDArray[np.float32], scene: Segmenter, size: float, parallel: bool = True
    ) -> Guesses:
        """Estimate the joints in each frame, of the component chosen by area and volume.

        Heights are measured along the optical axis.

        Args:
            depths: (n, H, W) float32 mm, 0 where unread.
            scene: the segmenter fitted to the recording.
            size: the animal's size, as from `find_size`.
            parallel: use all cores rather than one.

        Returns:
            The joints in the camera frame.
        """
        second = second_is_likelier(depths, scene, parallel)
        cut = chosen(depths, scene, size if self.takes_size else 1.0, second, True, parallel)
        return self.guesses(*cut, size, parallel)

    def guesses(
        self, crops: HeightMaps, crop_cameras: Array, size: float, parallel: bool = True
    ) -> Guesses:
        """Estimate the joints of objects that are already cut out, as by `chosen`.

        Args:
            crops: height maps of n frames, along the optical axis.
            crop_cameras: (n, 17) crop cameras of the height maps.
            size: the animal's size, as from `find_size`.
            parallel: use all cores rather than one.

        Returns:
            The joints in the camera frame.
        """
        raise NotImplementedError


def second_is_likelier(
    depths: NDArray[np.float32], scene: Segmenter, parallel: bool = True
) -> NDArray[np.bool_]:
    """Choose between two components of about the animal's area without estimating a pose.

    The component closer to the animal in area and volume is chosen, as in the paper's variant of
    the method.

    Args:
        depths: (n, H, W) float32 mm, 0 where unread.
        scene: the segmenter fitted to the recording.
        parallel: use all cores rather than one.

    Returns:
        (n,) bool, whether the second one is chosen.
    """
    likelier = scene.extract_both(depths, 1.0, parallel, camera_view=True)[0].n_blobs > 1
    unsure = np.flatnonzero(likelier)
    if len(unsure):
        above_floor = scene.extract_both(depths[unsure], 1.0, parallel)
        first, second = (scene.misfit(crops) for crops in above_floor)
        likelier[unsure] = second < first
    return likelier


def chosen(
    depths: NDArray[np.float32],
    scene: Segmenter,
    size: float,
    second: NDArray[np.bool_],
    camera_view: bool,
    parallel: bool = True,
) -> tuple[HeightMaps, Array]:
    """Cut one chosen component out of each frame, the same for every estimator.

    Args:
        depths: (n, H, W) float32 mm, 0 where unread.
        scene: the segmenter fitted to the recording.
        size: the animal's spine over the home length; scales the smoothing.
        second: (n,) bool, whether to use the second of two components.
        camera_view: measure heights along the optical axis.
        parallel: use all cores rather than one.

    Returns:
        The height maps, and their packed crop cameras (n, 17).
    """
    crops, others = scene.extract_both(depths, size, parallel, camera_view)
    rows = np.flatnonzero(second)
    if len(rows):
        crops.put(rows, others[rows])
    return crops, scene.crop_cameras(crops, camera_view)


class PlainMean(Baseline):
    """The paper's variant that averages all of its candidates, without the learned metric.

    They are averaged "for each of the joints in the 3D Euclidean space"; bones do not keep their
    lengths.
    """

    def __init__(self, estimator: PoseEstimator) -> None:
        self.estimator = estimator
        self.skeleton = estimator.skeleton
        self.takes_size = estimator.model.method.session_size

    def find_size(self, sample: NDArray[np.float32], scene: Segmenter) -> float:
        """Size of the animal over home size, estimated from a sample (n, H, W) of frames, mm."""
        return self.estimator.find_size(sample, scene)

    def guesses(
        self, crops: HeightMaps, crop_cameras: Array, size: float, parallel: bool = True
    ) -> Guesses:
        """Average each joint's position over all candidates, see `Baseline.guesses`."""
        found = self.estimator.candidates(crops, crop_cameras, size, parallel)
        joints = in_camera_frame(found.positions.mean(axis=1), crop_cameras)
        joints[~crops.found] = np.nan
        return Guesses(joints, crops.found, crops)


# Two-stage regression forest.


_F1 = GrowthPlan(7, 20, 10, 300, 0.5, 0.0, 0.0, 0.63)
_F2 = GrowthPlan(12, 20, 5, 300, 0.5, 0.0, 0.0, 0.63)


@dataclass(frozen=True)
class ForestPlan:
    """How the two forests grow and vote.

    Attributes:
        where: plan of F1.
        pose: plan of F2.
        training_points: pixels per image that F1 learns from.
        n_points: pixels per image at which F1 is evaluated.
        draws: samples of each image for F2, from different pixels.
        bandwidths: (2,) bandwidths of the modes of F1 and F2, in units of the animal's length.
        home_turn: (3,) rotation vector, rad, from the home pose to the animal as usually observed,
            see `Method`.
    """

    where: GrowthPlan = _F1
    pose: GrowthPlan = _F2
    training_points: int = 16
    n_points: int = 32
    draws: int = 2
    bandwidths: tuple[float, float] = (0.15, 0.25)
    home_turn: tuple[float, ...] = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class RegressionForest(Baseline):
    """The trained pair of forests.

    Attributes:
        skeleton: the animal's skeleton.
        plan: how the forests grew and vote.
        where: F1; leaves (5,): offset to the base joint, mm, and heading (cosine, sine) times half
            the animal's length.
        pose: F2; leaves (D,): skeleton coordinates in lever units, see `levers`.
    """

    skeleton: Skeleton
    plan: ForestPlan
    where: Forest
    pose: Forest

    def __post_init__(self) -> None:
        """Refuse forests that do not match their samples, since kernels do not check bounds."""
        n_coordinates = len(levers(self.skeleton))
        for name, forest, n in (("F1", self.where, 5), ("F2", self.pose, n_coordinates)):
            try:
                check_forest(forest, 1, 0, n)
            except ValueError as error:
                raise ValueError(f"{name} of a regression forest cannot be used: {error}") from None

    def guesses(
        self, crops: HeightMaps, crop_cameras: Array, size: float, parallel: bool = True
    ) -> Guesses:
        """Estimate the joints of objects that are already cut out, see `Baseline.guesses`.

        `size` is not used.
        """
        s = with_home_turn(self.skeleton, self.plan.home_turn)
        joints = np.full((len(crop_cameras), s.n_joints, 3), np.nan)
        with threads(parallel):
            in_parallel(
                kernels.guess_all,
                len(crop_cameras),
                crops.heights,
                crop_cameras,
                crops.found,
                _settings(self.plan, s),
                _voting(self.where),
                _voting(self.pose),
                levers(s),
                KinematicTree.of(s),
                joints,
            )
        return Guesses(in_camera_frame(joints, crop_cameras), crops.found, crops)

    def to_bytes(self) -> bytes:
        """The forests as the bytes of an .npz without pickle; skeleton and plan are not stored."""
        arrays: dict[str, Any] = {}
        for name, forest in (("where", self.where), ("pose", self.pose)):
            arrays |= {
                f"{name}_{part}": getattr(forest, part) for part in ("nodes", "roots", "leaves")
            }
        packed = io.BytesIO()
        np.savez_compressed(packed, **arrays)
        return packed.getvalue()


def with_home_turn(skeleton: Skeleton, home_turn: tuple[float, ...]) -> Skeleton:
    """The same body with its base joint's frame, and so its home pose, turned.

    Args:
        skeleton: the animal's skeleton.
        home_turn: (3,) rotation vector by which the home pose is turned about the base joint, rad.

    Returns:
        The skeleton; a pose of base rotation R has the same joints with R exp(home_turn)^T.
    """
    if not any(home_turn):
        return skeleton
    turn = so3.exp(np.array(home_turn))
    offsets = skeleton.offsets.copy()
    rest = skeleton.rest.copy()
    children = skeleton.parents == 0
    offsets[children] = offsets[children] @ turn.T
    rest[children] = turn @ rest[children]
    return replace(skeleton, offsets=offsets, rest=rest)


def levers(skeleton: Skeleton) -> Array:
    """Lever arms (D,) mm of F2's coordinates: how far a unit moves the home pose's joints.

    It is the root mean square over all joints, and at least 5 % of the animal's length for
    rotations. Coordinates are the base's rotation about x, y, z (rad), its translation (mm, lever
    1), the logarithm of the scale, then the angles about the other joints' free axes in the
    skeleton's order (rad). One unit of a label is then about one millimetre of error.
    """
    rotations, positions = forward_kinematics(
        skeleton, SE3.identity(), np.zeros((skeleton.n_joints, 3)), np.ones(())
    )
    below = np.eye(skeleton.n_joints, dtype=bool)
    for j in range(skeleton.n_joints - 1, 0, -1):
        below[skeleton.parents[j]] |= below[j]
    rows: list[float] = []
    for j in skeleton.solved:
        offset = positions[below[j]] - positions[j]
        for k in np.flatnonzero(skeleton.axes[j]):
            moved = np.cross(rotations[j][:, k], offset)
            rows.append(float(np.sqrt((moved**2).sum() / skeleton.n_joints)))
        if j == 0:
            rows += [1.0, 1.0, 1.0, float(np.sqrt((offset**2).sum() / skeleton.n_joints))]
    lever = np.array(rows)
    lever[3:6] = np.inf
    # a rotation about its own axis moves no joint of a straight animal
    lever = np.maximum(lever, 0.05 * skeleton.length)
    lever[3:6] = 1.0
    return lever


def coordinates(
    data: TrainingSet,
    skeleton: Skeleton,
    image: NDArray[np.int32],
    places: Array,
    headings: Array,
    home_turn: tuple[float, ...] = (0.0, 0.0, 0.0),
) -> Array:
    """True coordinates of F2, relative to a position and a heading that F1 estimated.

    Args:
        data: training images with truth.
        skeleton: the animal's skeleton.
        image: (n,) int32 index of each sample's image.
        places: (n, 3) base positions, mm, view frame.
        headings: (n,) headings, rad, view frame.
        home_turn: (3,) rotation vector by which the home pose is turned, rad, see `with_home_turn`.

    Returns:
        (n, D) coordinates in lever units.
    """
    zero = np.zeros_like(headings)
    start = SE3(so3.exp(np.stack([zero, zero, headings], axis=1)), places)
    truth = data.truth
    base = truth.rotations[image, 0] @ so3.exp(np.array(home_turn)).T
    twist = (start.inverse() @ SE3(base, truth.positions[image, 0])).log()
    parts = [twist, np.log(truth.scale[image])[:, None]]
    for j in skeleton.solved[1:]:
        parent = truth.rotations[image, skeleton.parents[j]] @ skeleton.rest[j]
        turn = so3.log(np.swapaxes(parent, 1, 2) @ truth.rotations[image, j])
        parts.append(turn[:, skeleton.axes[j]])
    return np.concatenate(parts, axis=1) * levers(with_home_turn(skeleton, home_turn))


def _settings(plan: ForestPlan, skeleton: Skeleton) -> kernels.VoteSettings:
    """Settings of the votes for the kernels."""
    return kernels.VoteSettings(
        plan.n_points, skeleton.length, skeleton.length * np.array(plan.bandwidths)
    )


def _voting(forest: Forest) -> kernels.VotingForest:
    """A forest for the kernels."""
    return kernels.VotingForest(forest.nodes, forest.roots, forest.leaves)


def train_forests(
    data: TrainingSet,
    skeleton: Skeleton,
    plan: ForestPlan,
    rng: np.random.Generator,
    report: ProgressCallback,
) -> RegressionForest:
    """Grow F1, then F2 from F1's estimates in images that F1's trees were not grown on.

    Args:
        data: training images with truth; those without an animal are left out.
        skeleton: the animal's skeleton.
        plan: how the forests grow.
        rng: random number generator for pixels, bags and seeds.
        report: called before each forest with the share done and the name of the part.
    """
    report(0.0, "F1")
    where, in_bag = _grow_where(data, skeleton, plan, rng)
    report(0.5, "F2")
    image = np.repeat(np.flatnonzero(data.animal).astype(np.int32), plan.draws)
    places = np.empty((len(image), 3))
    headings = np.empty(len(image))
    unseen = ~in_bag.T[image]
    unseen |= ~unseen.any(axis=1, keepdims=True)  # all trees were grown on it: use all
    in_parallel(
        kernels.locate_all,
        len(image),
        data.images.heights,
        data.images.crop_cameras,
        image,
        rng.random(len(image)),
        _settings(plan, skeleton),
        _voting(where),
        unseen,
        places,
        headings,
    )
    labels = coordinates(data, skeleton, image, places, headings, plan.home_turn)
    turned = np.linalg.norm(
        labels[:, :3] / levers(with_home_turn(skeleton, plan.home_turn))[:3], axis=1
    )
    samples = _samples(data, skeleton, image, places, headings)
    pose, _ = grow_forest(samples, labels.astype(np.float32), turned < np.pi / 2, plan.pose, rng)
    return RegressionForest(skeleton, plan, where, pose)


def _grow_where(
    data: TrainingSet, skeleton: Skeleton, plan: ForestPlan, rng: np.random.Generator
) -> tuple[Forest, NDArray[np.bool_]]:
    """Grow F1; also returns (T, n_images) bool, the images that each tree was grown on."""
    animals = np.flatnonzero(data.animal).astype(np.int32)
    points = np.empty((len(animals), plan.training_points, 3))
    in_parallel(
        kernels.points_all,
        len(animals),
        data.images.heights,
        data.images.crop_cameras,
        animals,
        rng.random(len(animals)),
        points,
    )
    image = np.repeat(animals, plan.training_points)
    places = points.reshape(-1, 3)
    forward = data.truth.rotations[image, 0] @ so3.exp(np.array(plan.home_turn)).T[:, 0]
    heading = 0.5 * skeleton.length * forward[:, :2]
    labels = np.concatenate([data.truth.positions[image, 0] - places, heading], axis=1).astype(
        np.float32
    )
    samples = _samples(data, skeleton, image, places, np.zeros(len(image)))
    return grow_forest(samples, labels, np.ones(len(image), np.bool_), plan.where, rng)


def _samples(
    data: TrainingSet, skeleton: Skeleton, image: NDArray[np.int32], places: Array, headings: Array
) -> Samples:
    """Features from positions (n, 3) of images (n,), with offsets turned by headings (n,)."""
    n = len(image)
    views = np.empty((n, 1, VIEW), np.float32)
    in_parallel(
        kernels.views_all,
        n,
        data.images.crop_cameras,
        image,
        places,
        headings,
        skeleton.length,
        views,
    )
    return Samples(
        data.images.heights, image, np.ones(n, np.float32), views, np.zeros((n, 1), np.float32)
    )


# AlexNet that regresses all joints from one depth patch, the paper's CNN baseline.


_BATCH = 64


def frames_of(heights: NDArray[np.int16], crop_cameras: Array) -> Array:
    """Squares around the animals, from which patches are resampled.

    Args:
        heights: (n, S, S) int16 height maps, 1/16 mm, each with at least one pixel of the animal.
        crop_cameras: (n, 17) packed crop cameras of the height maps.

    Returns:
        (n, 5): image pixel (u, v) of the square's centre, half the side in image pixels, the
        animal's mean depth, mm, and half the side in mm at that depth.
    """
    frames = np.empty((len(crop_cameras), 5))
    in_parallel(kernels.frames_all, len(frames), heights, crop_cameras, frames)
    return frames


def patches_of(
    heights: NDArray[np.int16], crop_cameras: Array, frames: Array
) -> NDArray[np.float32]:
    """Resample patches from height maps, bilinearly.

    Args:
        heights: (n, S, S) int16 height maps, 1/16 mm.
        crop_cameras: (n, 17) packed crop cameras of the height maps.
        frames: (n, 5) squares from `frames_of`.

    Returns:
        (n, PATCH, PATCH) float32 brightness, 0 to 255; 0 outside the animal.
    """
    patches = np.empty((len(crop_cameras), kernels.PATCH, kernels.PATCH), np.float32)
    in_parallel(kernels.patches_all, len(frames), heights, crop_cameras, frames, patches)
    return patches


def targets_of(joints_camera: Array, crop_cameras: Array, frames: Array) -> NDArray[np.float32]:
    """Training targets of the CNN from true joints.

    Args:
        joints_camera: (n, J, 3) joints, mm, camera frame.
        crop_cameras: (n, 17) packed crop cameras of the height maps.
        frames: (n, 5) squares from `frames_of`.

    Returns:
        (n, 3 J) float32 (right, down, nearer) of each joint, in half sides of its square.
    """
    x, y, z = np.moveaxis(joints_camera, -1, 0)
    u0, v0, half_px, depth, half_mm = frames.T[:, :, None]
    fx, fy, cx, cy = crop_cameras.T[:4, :, None]
    right = (fx * x / z + cx - u0) / half_px
    down = (fy * y / z + cy - v0) / half_px
    coordinates = np.stack([right, down, (depth - z) / half_mm], axis=-1)
    return coordinates.reshape(len(crop_cameras), -1).astype(np.float32)


def joints_of(coordinates: NDArray[np.float32], crop_cameras: Array, frames: Array) -> Array:
    """Joints from outputs of the CNN; the inverse of `targets_of`.

    Args:
        coordinates: (n, 3 J) float32 outputs.
        crop_cameras: (n, 17) packed crop cameras of the height maps.
        frames: (n, 5) squares from `frames_of`.

    Returns:
        (n, J, 3) joints, mm, camera frame.
    """
    right, down, nearer = np.moveaxis(
        coordinates.astype(float).reshape(len(crop_cameras), -1, 3), -1, 0
    )
    u0, v0, half_px, depth, half_mm = frames.T[:, :, None]
    fx, fy, cx, cy = crop_cameras.T[:4, :, None]
    z = depth - nearer * half_mm
    return np.stack(
        [(u0 + right * half_px - cx) / fx * z, (v0 + down * half_px - cy) / fy * z, z], axis=-1
    )


@dataclass(frozen=True)
class CnnPlan:
    """Size of the network and of its training.

    The budget is about seven minutes of two cores with bfloat16 for 122,880 views.

    Attributes:
        width: factor on AlexNet's numbers of channels; half, to train on more images in that time.
        connected: neurons of each of the two hidden fully connected layers.
        epochs: passes over the images.
        rate: peak learning rate of the one-cycle schedule.
        decay: weight decay of AdamW.
    """

    width: float = 0.5
    connected: int = 1024
    epochs: int = 3
    rate: float = 1e-3
    decay: float = 0.01


def require_torch() -> None:
    """Raise MissingPackageError unless torch is installed."""
    from importlib.util import find_spec

    if find_spec("torch") is None:
        raise MissingPackageError(
            "the CNN baseline needs torch, which is not installed; in the folder of liex_lab, run "
            "pip install '.[cnn]'"
        )


def alexnet(n_outputs: int, plan: CnnPlan) -> torch.nn.Sequential:
    """Build the network for three channels of 224 x 224.

    Args:
        n_outputs: number of outputs, 3 J.
        plan: width of the convolutions and of the hidden layers.

    Returns:
        The untrained network; its convolutions have no bias and are followed by batch
        normalisation.
    """
    import torch
    from torch import nn

    def convolution(
        before: int, after: int, size: int, stride: int, padding: int
    ) -> list[nn.Module]:
        """A convolution from `before` to `after` channels with batch normalisation and ReLU.

        `size`, `stride` and `padding` are its kernel's, in pixels.
        """
        layer = nn.Conv2d(before, after, size, stride, padding, bias=False)
        return [layer, nn.BatchNorm2d(after), nn.ReLU(inplace=True)]

    a, b, c, d, e = (round(plan.width * channels) for channels in (64, 192, 384, 256, 256))
    net = nn.Sequential(
        *convolution(3, a, 11, 4, 2),
        nn.MaxPool2d(3, 2),
        *convolution(a, b, 5, 1, 2),
        nn.MaxPool2d(3, 2),
        *convolution(b, c, 3, 1, 1),
        *convolution(c, d, 3, 1, 1),
        *convolution(d, e, 3, 1, 1),
        nn.MaxPool2d(3, 2),
        nn.Flatten(),
        nn.Linear(36 * e, plan.connected),
        nn.ReLU(inplace=True),
        nn.Linear(plan.connected, plan.connected),
        nn.ReLU(inplace=True),
        nn.Linear(plan.connected, n_outputs),
    )
    # channels last: convolutions on a CPU are about a third faster
    net.to(memory_format=torch.channels_last)
    return net


@contextmanager
def torch_threads(parallel: bool) -> Iterator[None]:
    """A context in which torch runs on one thread unless `parallel`."""
    import torch

    before = torch.get_num_threads()
    if not parallel:
        torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


@dataclass(frozen=True)
class Cnn(Baseline):
    """The trained network as a baseline.

    Lie-X section 5.2. The paper fine-tunes an AlexNet pre-trained on ImageNet for 50 epochs on its
    95,000 to 104,000 images. This one is trained from scratch, since weights learned from
    photographs are not available here, within a budget of two CPU cores (`CnnPlan`). Therefore it
    has batch normalisation after every convolution, without which an AlexNet hardly learns from
    scratch in so few steps; no dropout, since no image is used more than a few times; and fully
    connected layers of 1,024 instead of 4,096. The five convolutions are AlexNet's (Krizhevsky
    2014, one column), at a `width` of its numbers of channels. Products use bfloat16, which takes
    half the time on CPUs that support it. The loss is the mean distance of the joints,

        L = 1/J sum_j |y_j - y_j*|,        in half sides of the patch.

    A patch is the square around the animal's bounding box, a tenth larger, resampled to 224 x 224.
    Depth is scaled by the same factor as the image, so the animal keeps its proportions (the paper
    only states "rescaled to be in the range of 0 to 255"): 127.5 is the animal's mean depth, and
    half the square's side in mm maps to 0 or 255. Nearer is brighter; the background is 0. Joints
    have the same unit: (right, down, nearer) from the square's centre at the animal's mean depth,
    in half sides of the square.

    torch is an optional dependency: `pip install '.[cnn]'` in the folder of liex_lab.

    It estimates joints, not a pose: bone lengths are not constrained.
    """

    skeleton: Skeleton
    net: torch.nn.Sequential

    def guesses(
        self, crops: HeightMaps, crop_cameras: Array, size: float, parallel: bool = True
    ) -> Guesses:
        """Estimate the joints of objects that are already cut out, see `Baseline.guesses`.

        `size` is not used.
        """
        joints = np.full((len(crop_cameras), self.skeleton.n_joints, 3), np.nan)
        rows = np.flatnonzero(crops.found)
        for start in range(0, len(rows), _BATCH):
            part = rows[start : start + _BATCH]
            joints[part] = self.joints(crops.heights[part], crop_cameras[part], parallel)
        return Guesses(joints, crops.found, crops)

    def joints(
        self, heights: NDArray[np.int16], crop_cameras: Array, parallel: bool = True
    ) -> Array:
        """Estimate the joints of animals from their height maps.

        Args:
            heights: (n, S, S) int16 height maps, 1/16 mm, each with at least one pixel of the
                animal.
            crop_cameras: (n, 17) packed crop cameras of the height maps.
            parallel: use all cores rather than one.

        Returns:
            (n, J, 3) joints, mm, camera frame.
        """
        import torch

        precision = torch.autocast("cpu", torch.bfloat16)
        with threads(parallel), torch_threads(parallel), torch.no_grad(), precision:
            frames = frames_of(heights, crop_cameras)
            output = self.net.eval()(_channels(patches_of(heights, crop_cameras, frames)))
        return joints_of(output.float().numpy(), crop_cameras, frames)

    def to_bytes(self) -> bytes:
        """The weights as the bytes of an .npz without pickle."""
        packed = io.BytesIO()
        np.savez(packed, **{name: values.numpy() for name, values in self.net.state_dict().items()})
        return packed.getvalue()


def load_baseline(
    path: Path, skeleton: Skeleton, plan: ForestPlan | CnnPlan
) -> RegressionForest | Cnn:
    """Read a trained baseline from a file with the bytes of its `to_bytes`.

    Args:
        path: the file.
        skeleton: the animal's skeleton.
        plan: the parameters that it was trained with.

    Raises:
        ModelError: the file is damaged, or was trained with another plan.
    """
    with (
        expecting(
            ModelError,
            f"{path} should hold a whole baseline",
            *_DAMAGE,
            advice="remove it and train again",
        ),
        path.open("rb") as file,
        np.load(file, allow_pickle=False) as archive,
    ):
        if isinstance(plan, CnnPlan):
            import torch

            net = alexnet(3 * skeleton.n_joints, plan)
            net.load_state_dict({name: torch.from_numpy(archive[name]) for name in archive.files})
            return Cnn(skeleton, net)
        where, pose = (
            Forest(*(archive[f"{name}_{part}"] for part in ("nodes", "roots", "leaves")))
            for name in ("where", "pose")
        )
        return RegressionForest(skeleton, plan, where, pose)


def _channels(patches: NDArray[np.float32]) -> torch.Tensor:
    """Patches (n, 224, 224) of 0-255 as the network's input, three equal channels of about -1
    to 1.
    """
    import torch

    grey = torch.from_numpy((patches - 127.5) / 127.5)
    return grey[:, None].expand(-1, 3, -1, -1).contiguous(memory_format=torch.channels_last)


def train_cnn(
    data: TrainingSet,
    skeleton: Skeleton,
    plan: CnnPlan,
    rng: np.random.Generator,
    report: ProgressCallback,
) -> Cnn:
    """Train the network from scratch with AdamW and a one-cycle learning rate.

    Args:
        data: training images with truth; those without an animal are left out.
        skeleton: the animal's skeleton.
        plan: size of the network and of its training.
        rng: random number generator for the initial weights' seed and the order of images.
        report: called before each step with the share done and the name of the part being trained.

    Raises:
        MissingPackageError: torch is not installed.
    """
    import torch

    require_torch()
    torch.manual_seed(int(rng.integers(2**31)))
    animals = np.flatnonzero(data.animal)
    net = alexnet(3 * skeleton.n_joints, plan)
    steps = plan.epochs * (len(animals) // _BATCH)
    optimiser = torch.optim.AdamW(net.parameters(), lr=plan.rate, weight_decay=plan.decay)
    schedule = torch.optim.lr_scheduler.OneCycleLR(
        optimiser, plan.rate, total_steps=max(steps, 1), pct_start=0.15
    )
    net.train()
    done = 0
    for _ in range(plan.epochs):
        order = rng.permutation(animals)
        for start in range(0, len(order) - _BATCH + 1, _BATCH):
            report(done / steps, "CNN")
            loss = _loss(net, data, order[start : start + _BATCH])
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
            schedule.step()
            done += 1
    return Cnn(skeleton, net)


def _loss(net: torch.nn.Sequential, data: TrainingSet, rows: NDArray[np.int64]) -> torch.Tensor:
    """Mean distance of the joints of the images `rows`, in half sides of their patches."""
    import torch

    heights = data.images.heights[rows]
    crop_cameras = data.images.crop_cameras[rows]
    frames = frames_of(heights, crop_cameras)
    wanted = torch.from_numpy(
        targets_of(in_camera_frame(data.truth.positions[rows], crop_cameras), crop_cameras, frames)
    )
    with torch.autocast("cpu", torch.bfloat16):
        output = net(_channels(patches_of(heights, crop_cameras, frames)))
    difference = (output.float() - wanted).reshape(len(rows), -1, 3)
    return torch.sqrt((difference**2).sum(-1) + 1e-8).mean()
