"""Interface of the baselines: frames and a fitted segmenter in, the animal's joints per frame out.

All baselines of Lie-X section 5.2 work on the product's own segmentation, so that only the pose
estimation differs.
"""

from __future__ import annotations

import zipfile
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from liex_lab.body.skeleton import Skeleton
from liex_lab.foreground.height_maps import HeightMaps
from liex_lab.foreground.segmenter import Segmenter

Array = NDArray[np.float64]

DAMAGE = (
    OSError,
    ValueError,
    LookupError,
    EOFError,
    RuntimeError,
    zipfile.BadZipFile,
)  # what a broken .npz raises


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
    """A way to measure poses that is not ours, at work on the product's own segmentation."""

    @property
    def skeleton(self) -> Skeleton:
        """The animal's skeleton."""

    def find_size(self, sample: NDArray[np.float32], scene: Segmenter) -> float:
        """Estimate the animal's size from a sample of frames.

        Args:
            sample: (n, H, W) float32 frames, mm, 0 where unread.
            scene: the segmenter that was fitted to the recording.

        Returns:
            The animal's spine over the home length; 1 where the baseline knows of no such thing, as
            the paper's do not.
        """

    def estimate(
        self, depths: NDArray[np.float32], scene: Segmenter, size: float, parallel: bool = True
    ) -> Guesses:
        """Estimate the joints in each frame.

        Args:
            depths: (n, H, W) float32 mm, 0 where unread.
            scene: the segmenter that was fitted to the recording.
            size: the animal's size, as from `find_size`.
            parallel: use all cores rather than one.

        Returns:
            The joints in the camera frame.
        """


def see(depths: NDArray[np.float32], scene: Segmenter, parallel: bool) -> tuple[HeightMaps, Array]:
    """Segment the animal of each frame as the paper's features see it.

    Heights are measured along the optical axis, and no size is known. Where two components have
    about the animal's area, the one that is more like it in area and volume is taken, as for the
    paper's own variant of the method.

    Args:
        depths: (n, H, W) float32 mm, 0 where unread.
        scene: the segmenter that was fitted to the recording.
        parallel: use all cores rather than one.

    Returns:
        The height maps, and their packed crop cameras (n, 17).
    """
    crops, second = scene.extract_both(depths, 1.0, parallel, camera_view=True)
    unsure = np.flatnonzero(crops.n_blobs > 1)
    if len(unsure):
        misfits = [
            scene.misfit(above_floor)
            for above_floor in scene.extract_both(depths[unsure], 1.0, parallel)
        ]
        better = unsure[misfits[1] < misfits[0]]
        crops.put(better, second[better])
    return crops, scene.crop_cameras(crops, camera_view=True)
