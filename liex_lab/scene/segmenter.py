"""Segmentation of the animal in depth images: the base class of all methods."""

from __future__ import annotations

from abc import ABC, abstractmethod

import numpy as np
from numpy.typing import NDArray

from liex_lab.optics.camera import Camera
from liex_lab.scene.floor import Floor
from liex_lab.scene.height_maps import HeightMaps

Array = NDArray[np.float64]


class Segmenter(ABC):
    """Finds the animal in the images of one camera, and the next best candidate in the same pass.

    The base of `BackgroundSubtraction` and `HandSegmenter`.

    Attributes:
        camera: the ideal pinhole camera of the images.
        floor: the plane from which heights in a recording's results are measured.
        area_mm2: the animal's usual area in the camera's view, mm^2.
    """

    camera: Camera
    floor: Floor
    area_mm2: float

    def extract(
        self,
        depths: NDArray[np.float32],
        size: float,
        parallel: bool = True,
        camera_view: bool = False,
    ) -> HeightMaps:
        """Height maps of the animal in each frame.

        Args:
            depths: (n, H, W) float32 mm, 0 where unread.
            size: the animal's spine length over the skeleton's home length; scales the smoothing.
            parallel: whether to use all threads.
            camera_view: whether heights are measured along the optical axis, from behind the
                animal.

        Returns:
            One row for each frame.
        """
        return self._extract(depths, size, parallel, camera_view, 1)

    def extract_both(
        self,
        depths: NDArray[np.float32],
        size: float,
        parallel: bool = True,
        camera_view: bool = False,
    ) -> tuple[HeightMaps, HeightMaps]:
        """Height maps of the animal in each frame, and of the next best candidate.

        Args:
            depths: (n, H, W) float32 mm, 0 where unread.
            size: the animal's spine length over the skeleton's home length; scales the smoothing.
            parallel: whether to use all threads.
            camera_view: whether heights are measured along the optical axis, from behind the
                animal.

        Returns:
            The best candidates (n rows), and the second best (n rows), found if `n_blobs` is more
            than one.
        """
        crops = self._extract(depths, size, parallel, camera_view, 2)
        n = len(depths)
        return crops[:n], crops[n:]

    def cleared(self, depths: NDArray[np.float32]) -> NDArray[np.float32]:
        """Images without worn devices, 0 there; unchanged if there are none.

        Args:
            depths: (n, H, W) float32 mm, full images, 0 where unread.
        """
        return depths

    @property
    def remarks(self) -> tuple[str, ...]:
        """Corrections applied to the images, in sentences; usually empty."""
        return ()

    @property
    def doubts(self) -> tuple[str, ...]:
        """Remaining reasons why measurements may be wrong, in sentences; usually empty."""
        return ()

    @abstractmethod
    def crop_cameras(self, crops: HeightMaps, camera_view: bool = False) -> Array:
        """The crop cameras (n, 17) of height maps, packed as `CropCamera`.

        Args:
            crops: n height maps.
            camera_view: as they were extracted.
        """

    @abstractmethod
    def planes(self, crops: HeightMaps, camera_view: bool = False) -> Array:
        """The reference plane of each height map.

        Args:
            crops: n height maps.
            camera_view: as they were extracted.

        Returns:
            (n, 3) a, b, c of 1 / z = a u + b v + c, per mm, u and v in image pixels.
        """

    @abstractmethod
    def middles(self, crops: HeightMaps, camera_view: bool = False) -> Array:
        """The centroid (n, 3) mm of each height map, in the arena frame.

        Args:
            crops: n height maps.
            camera_view: as they were extracted.
        """

    @abstractmethod
    def misfit(self, crops: HeightMaps) -> Array:
        """How unlike the animal each height map (n,) is in size: squared standard deviations.

        Args:
            crops: n height maps.
        """

    @abstractmethod
    def every(self, step: int) -> Segmenter:
        """The same segmenter for images of every `step`-th row and column."""

    @abstractmethod
    def _extract(
        self,
        depths: NDArray[np.float32],
        size: float,
        parallel: bool,
        camera_view: bool,
        n_candidates: int,
    ) -> HeightMaps:
        """Height maps of the best component of each frame and, if requested, of the second best.

        Args:
            depths: (n, H, W) float32 mm, 0 where unread.
            size: the animal's spine length over the skeleton's home length.
            parallel: whether to use all threads.
            camera_view: whether heights are measured along the optical axis.
            n_candidates: per frame, 1 or 2.

        Returns:
            The rows (n) of the best components, then (n_candidates 2) those of the second best.
        """
