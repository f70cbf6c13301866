"""Segmentation: which pixels of a depth picture are the animal; the base of every method."""

from __future__ import annotations

from abc import ABC, abstractmethod

import numpy as np
from numpy.typing import NDArray

from liex_lab.optics.camera import Camera
from liex_lab.scene.floor import Floor
from liex_lab.scene.height_maps import HeightMaps

Array = NDArray[np.float64]


class Segmenter(ABC):
    """What finds the animal in the pictures of one camera, and in one pass the next candidate.

    The base of `BackgroundSubtraction` and `HandSegmenter`.

    Attributes:
        camera: the ideal pinhole camera whose pictures are segmented.
        floor: the plane from which heights in a recording's results are measured.
        area_mm2: the animal's usual area as the camera sees it, mm^2.
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
            parallel: whether to use all threads, else one.
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
        """Height maps of the animal in each frame, and of the next thing that may be it after all.

        Args:
            depths: (n, H, W) float32 mm, 0 where unread.
            size: the animal's spine length over the skeleton's home length; scales the smoothing.
            parallel: whether to use all threads, else one.
            camera_view: whether heights are measured along the optical axis, from behind the
                animal.

        Returns:
            The best candidates (n rows), and the second best (n rows), found where `n_blobs` is
            more than one.
        """
        crops = self._extract(depths, size, parallel, camera_view, 2)
        n = len(depths)
        return crops[:n], crops[n:]

    def cleared(self, depths: NDArray[np.float32]) -> NDArray[np.float32]:
        """Pictures without what the animal wears, 0 there; the same where it wears nothing.

        Args:
            depths: (n, H, W) float32 mm, whole pictures, 0 where unread.
        """
        return depths

    @property
    def remarks(self) -> tuple[str, ...]:
        """What was found in the pictures and undone, in sentences; nothing where they are clean."""
        return ()

    @property
    def doubts(self) -> tuple[str, ...]:
        """Why what is measured here may be wrong all the same, in sentences; usually none."""
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
        """The plane above which each height map is measured.

        Args:
            crops: n height maps.
            camera_view: as they were extracted.

        Returns:
            (n, 3) a, b, c of 1 / z = a u + b v + c, per mm, u and v in pixels of the picture.
        """

    @abstractmethod
    def middles(self, crops: HeightMaps, camera_view: bool = False) -> Array:
        """The centroid (n, 3) mm of what each height map shows, in the arena frame.

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
        """The same segmenter for pictures of every `step`-th row and column.

        Args:
            step: pixels from one to the next, at least 1.
        """

    @abstractmethod
    def _extract(
        self,
        depths: NDArray[np.float32],
        size: float,
        parallel: bool,
        camera_view: bool,
        n_things: int,
    ) -> HeightMaps:
        """Height maps of the likeliest component of each frame and, where asked, of the next.

        Args:
            depths: (n, H, W) float32 mm, 0 where unread.
            size: the animal's spine length over the skeleton's home length.
            parallel: whether to use all threads, else one.
            camera_view: whether heights are measured along the optical axis.
            n_things: candidates a frame, 1 or 2.

        Returns:
            The rows (n) of the likeliest components, and then (n_things 2) those of the next.
        """
