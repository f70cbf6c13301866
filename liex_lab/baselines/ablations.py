"""Ablation of the learned metric: the plain mean of all candidates (Lie-X Tables 1 and 2).

    x_j = 1/K sum_k x_j^(k)        for each joint j over the K candidates.

The other ablation, without multiple initial poses, needs no code of its own: it is
`PoseEstimator(model, 1, start_seed=k)`, which has one initial pose, drawn from the seed k.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from liex_lab.baselines.baseline import Guesses, chosen, second_is_likelier
from liex_lab.body.skeleton import Skeleton
from liex_lab.estimation.estimator import PoseEstimator
from liex_lab.scene.height_maps import HeightMaps, in_camera_frame
from liex_lab.scene.segmenter import Segmenter

Array = NDArray[np.float64]


@dataclass(frozen=True)
class PlainMean:
    """The paper's variant that averages all of its candidates, without the learned metric.

    They are averaged "for each of the joints in the 3D Euclidean space".

    Attributes:
        estimator: the estimator whose candidates are averaged.
    """

    estimator: PoseEstimator

    @property
    def skeleton(self) -> Skeleton:
        """The animal's skeleton."""
        return self.estimator.skeleton

    @property
    def takes_size(self) -> bool:
        """Whether the animal's size is handed to the estimator."""
        return self.estimator.model.method.session_size

    def find_size(self, sample: NDArray[np.float32], scene: Segmenter) -> float:
        """Size of the animal as the estimator finds it.

        Args:
            sample: (n, H, W) float32 frames, mm, 0 where unread.
            scene: the segmenter that was fitted to the recording.
        """
        return self.estimator.find_size(sample, scene)

    def estimate(
        self, depths: NDArray[np.float32], scene: Segmenter, size: float, parallel: bool = True
    ) -> Guesses:
        """Average each joint's position over all candidates.

        Args:
            depths: (n, H, W) float32 mm, 0 where unread.
            scene: the segmenter that was fitted to the recording.
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
        """Estimate the joints of objects that were cut out already.

        Args:
            crops: height maps of n frames, along the optical axis.
            crop_cameras: (n, 17) crop cameras of the height maps.
            size: the animal's size over home size.
            parallel: use all cores rather than one.

        Returns:
            The joints in the camera frame.
        """
        _, positions, _, _ = self.estimator.candidates(crops, crop_cameras, size, parallel)
        joints = in_camera_frame(positions.mean(axis=1), crop_cameras)
        joints[~crops.found] = np.nan
        return Guesses(joints, crops.found, crops)
