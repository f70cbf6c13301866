"""What every baseline does: frames and a learned scene in, the joints of the animal in each frame
out.
"""

from __future__ import annotations

import zipfile
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from liex_lab.body.skeleton import Skeleton
from liex_lab.foreground.height_maps import Crops, Foreground

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
    """Joints (n, J, 3) mm of n frames in the camera frame, NaN where no animal was found; found
    (n,).
    """

    joints: Array
    found: NDArray[np.bool_]
    crops: Crops


class Baseline(Protocol):
    """A way to measure poses that is not ours, at work on the product's own foreground."""

    @property
    def skeleton(self) -> Skeleton:
        """The animal's skeleton."""

    def find_size(self, sample: NDArray[np.float32], scene: Foreground) -> float:
        """The animal's size over home size; 1 where the baseline knows of no such thing, as the
        paper's do not.
        """

    def estimate(
        self, depths: NDArray[np.float32], scene: Foreground, size: float, parallel: bool = True
    ) -> Guesses:
        """Joints of frames (n, H, W) mm in the camera frame; on one core unless `parallel`."""


def see(depths: NDArray[np.float32], scene: Foreground, parallel: bool) -> tuple[Crops, Array]:
    """The animal of each frame (n, H, W) mm as the paper's features see it, and how it was cut (n,
    17).

    Heights along the optical axis, no size known. Where two things have about the animal's area,
    the one that is more like it in area and volume is taken, as for the paper's own variant of the
    method.
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
    return crops, scene.looks(crops, camera_view=True)


def in_camera_frame(points: Array, looks: Array) -> Array:
    """Points (n, ..., 3) mm of the view frames given by `looks` (n, 17) in their camera frames."""
    off = points - _origin(points, looks)
    return np.einsum("nji,n...j->n...i", looks[:, 4:13].reshape(-1, 3, 3), off)


def in_view_frame(points: Array, looks: Array) -> Array:
    """The inverse of `in_camera_frame`."""
    turned = np.einsum("nij,n...j->n...i", looks[:, 4:13].reshape(-1, 3, 3), points)
    return turned + _origin(points, looks)


def _origin(points: Array, looks: Array) -> Array:
    """The camera's centre (n, ..., 3) mm in the view frames."""
    origin = np.zeros((len(looks), *(1,) * (points.ndim - 2), 3))
    origin[..., 2] = looks[:, 13].reshape(-1, *(1,) * (points.ndim - 2))
    return origin
