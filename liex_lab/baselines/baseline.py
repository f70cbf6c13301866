"""Interface of the baselines: frames and a fitted segmenter in, the animal's joints per frame out.

This module also has the ablation without the learned metric, the plain mean of all candidates,

    x_j = 1/K sum_k x_j^(k)        for each joint j over the K candidates.

The ablation without multiple initial poses needs no code of its own: it is `PoseEstimator(model, 1,
start_seed=k)`, with one initial pose drawn from the seed k.

All baselines of Lie-X section 5.2 use liex_lab's segmentation, so that only the pose estimation
differs.
"""

from __future__ import annotations

import zipfile
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from liex_lab.body.skeleton import Skeleton
from liex_lab.estimation.estimator import PoseEstimator
from liex_lab.scene.height_maps import HeightMaps, Segmenter, in_camera_frame

Array = NDArray[np.float64]

DAMAGE = (
    OSError,
    ValueError,
    LookupError,
    EOFError,
    RuntimeError,
    zipfile.BadZipFile,
)  # exceptions that a broken .npz raises


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


class Baseline(Protocol):
    """A pose estimator from the literature that uses liex_lab's segmentation."""

    @property
    def skeleton(self) -> Skeleton:
        """The animal's skeleton."""

    @property
    def takes_size(self) -> bool:
        """Whether it uses the animal's size; otherwise it treats all sizes alike."""

    def find_size(self, sample: NDArray[np.float32], scene: Segmenter) -> float:
        """Estimate the animal's size from a sample of frames.

        Args:
            sample: (n, H, W) float32 frames, mm, 0 where unread.
            scene: the segmenter fitted to the recording.

        Returns:
            The animal's spine over the home length; 1 if the baseline has no notion of size, as the
            paper's.
        """

    def estimate(
        self, depths: NDArray[np.float32], scene: Segmenter, size: float, parallel: bool = True
    ) -> Guesses:
        """Estimate the joints in each frame.

        Args:
            depths: (n, H, W) float32 mm, 0 where unread.
            scene: the segmenter fitted to the recording.
            size: the animal's size, as from `find_size`.
            parallel: use all cores rather than one.

        Returns:
            The joints in the camera frame.
        """

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


class Sizeless:
    """A baseline without a notion of size, like the paper's: it treats all sizes alike."""

    takes_size = False

    def find_size(self, sample: NDArray[np.float32], scene: Segmenter) -> float:
        """Always 1."""
        return 1.0

    def estimate(
        self: Baseline,
        depths: NDArray[np.float32],
        scene: Segmenter,
        size: float,
        parallel: bool = True,
    ) -> Guesses:
        """Estimate the joints in each frame, of the component chosen by area and volume.

        Heights are measured along the optical axis.
        """
        second = second_is_likelier(depths, scene, parallel)
        cut = chosen(depths, scene, 1.0, second, True, parallel)
        return self.guesses(*cut, size, parallel)


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
    likelier = np.zeros(len(depths), np.bool_)
    n_blobs = scene.extract_both(depths, 1.0, parallel, camera_view=True)[0].n_blobs
    unsure = np.flatnonzero(n_blobs > 1)
    if len(unsure):
        first, second = (
            scene.misfit(above_floor)
            for above_floor in scene.extract_both(depths[unsure], 1.0, parallel)
        )
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


@dataclass(frozen=True)
class PlainMean:
    """The paper's variant that averages all of its candidates, without the learned metric.

    They are averaged "for each of the joints in the 3D Euclidean space".
    """

    estimator: PoseEstimator

    @property
    def skeleton(self) -> Skeleton:
        """The animal's skeleton."""
        return self.estimator.skeleton

    @property
    def takes_size(self) -> bool:
        """Whether the estimator uses the animal's size."""
        return self.estimator.model.method.session_size

    def find_size(self, sample: NDArray[np.float32], scene: Segmenter) -> float:
        """Size of the animal over home size, estimated from a sample (n, H, W) of frames, mm."""
        return self.estimator.find_size(sample, scene)

    def estimate(
        self, depths: NDArray[np.float32], scene: Segmenter, size: float, parallel: bool = True
    ) -> Guesses:
        """Average each joint's position over all candidates.

        Args:
            depths: (n, H, W) float32 mm, 0 where unread.
            scene: the segmenter fitted to the recording.
            size: the animal's size over home size.
            parallel: use all cores rather than one.

        Returns:
            The joints in the camera frame; bones do not keep their lengths.
        """
        second = second_is_likelier(depths, scene, parallel)
        return self.guesses(*chosen(depths, scene, size, second, True, parallel), size, parallel)

    def guesses(
        self, crops: HeightMaps, crop_cameras: Array, size: float, parallel: bool = True
    ) -> Guesses:
        """Estimate the joints of objects that are already cut out, see `Baseline.guesses`."""
        _, positions, _, _ = self.estimator.candidates(crops, crop_cameras, size, parallel)
        joints = in_camera_frame(positions.mean(axis=1), crop_cameras)
        joints[~crops.found] = np.nan
        return Guesses(joints, crops.found, crops)
