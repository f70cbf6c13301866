"""The method without its learned metric: the plain mean of all candidates (Lie-X Tables 1 and 2).

The other ablation, without multiple initial poses, needs no code of its own: it is
`PoseEstimator(model, 1)`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from liex_lab.baselines.baseline import Guesses, in_camera_frame, see
from liex_lab.body.skeleton import Skeleton
from liex_lab.estimation.estimator import PoseEstimator
from liex_lab.foreground.height_maps import Foreground


@dataclass(frozen=True)
class PlainMean:
    """The paper's variant whose candidates are averaged "for each of the joints in the 3D Euclidean
    space".
    """

    estimator: PoseEstimator

    @property
    def skeleton(self) -> Skeleton:
        """The animal's skeleton."""
        return self.estimator.skeleton

    def find_size(self, sample: NDArray[np.float32], scene: Foreground) -> float:
        """As the paper's variant: the home size."""
        return self.estimator.find_size(sample, scene)

    def estimate(
        self, depths: NDArray[np.float32], scene: Foreground, size: float, parallel: bool = True
    ) -> Guesses:
        """The mean over all candidates of each joint's position."""
        crops, looks = see(depths, scene, parallel)
        _, positions, _, _ = self.estimator.candidates(crops, looks, size, parallel)
        joints = in_camera_frame(positions.mean(axis=1), looks)
        joints[~crops.found] = np.nan
        return Guesses(joints, crops.found, crops)
