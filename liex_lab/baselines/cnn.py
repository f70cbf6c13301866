"""AlexNet that regresses all joints from one depth patch, the paper's CNN baseline.

Lie-X section 5.2. The paper fine-tunes an AlexNet pre-trained on ImageNet for 50 epochs on its
95,000 to 104,000 images. This one is trained from scratch, since weights learned from photographs
are not available here, within a budget of two CPU cores (`CnnPlan`). Therefore it has batch
normalisation after every convolution, without which an AlexNet hardly learns from scratch in so few
steps; no dropout, since no image is used more than a few times; and fully connected layers of 1,024
instead of 4,096. The five convolutions are AlexNet's (Krizhevsky 2014, one column), at a `width` of
its numbers of channels. Products use bfloat16, which takes half the time on CPUs that support it.
The loss is the mean distance of the joints,

    L = 1/J sum_j |y_j - y_j*|,        in half sides of the patch.

A patch is the square around the animal's bounding box, a tenth larger, resampled to 224 x 224.
Depth is scaled by the same factor as the image, so the animal keeps its proportions (the paper only
states "rescaled to be in the range of 0 to 255"): 127.5 is the animal's mean depth, and half the
square's side in mm maps to 0 or 255. Nearer is brighter; the background is 0. Joints have the same
unit: (right, down, nearer) from the square's centre at the animal's mean depth, in half sides of
the square.

torch is an optional dependency: `pip install '.[cnn]'` in the folder of liex_lab.
"""

from __future__ import annotations

import io
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from liex_lab.baselines import _kernels as kernels
from liex_lab.baselines.baseline import DAMAGE, Baseline, Guesses
from liex_lab.body.skeleton import Skeleton
from liex_lab.errors import MissingPackageError, ModelError
from liex_lab.estimation.cascade import TrainingSet
from liex_lab.estimation.training import ProgressCallback
from liex_lab.runtime.processes import in_parallel, threads
from liex_lab.scene.height_maps import HeightMaps, in_camera_frame

if TYPE_CHECKING:
    import torch

Array = NDArray[np.float64]

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

    @staticmethod
    def load(path: Path, skeleton: Skeleton, plan: CnnPlan) -> Cnn:
        """Read the weights of a trained network from a file with the bytes of `to_bytes`.

        Raises:
            ModelError: the file is damaged, or its weights do not fit the plan.
        """
        import torch

        net = alexnet(3 * skeleton.n_joints, plan)
        try:
            with path.open("rb") as file, np.load(file, allow_pickle=False) as archive:
                net.load_state_dict(
                    {name: torch.from_numpy(archive[name]) for name in archive.files}
                )
        except DAMAGE as error:
            message = str(error).splitlines()[0]
            raise ModelError(
                f"{path} does not hold the CNN's weights ({message}); remove it and train again"
            ) from None
        return Cnn(skeleton, net)


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
