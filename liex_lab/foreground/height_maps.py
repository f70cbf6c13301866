"""Height maps of one animal, cut out of whole pictures (see `Scene`) or out of windows
around it.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from liex_lab.arena.floor import Floor
from liex_lab.body.skeleton import MOUSE_VIEW, View
from liex_lab.foreground import _height_map_kernels as kernels
from liex_lab.foreground._blob_kernels import N_MOMENTS
from liex_lab.geometry import SE3
from liex_lab.optics.camera import Camera

Array = NDArray[np.float64]

CROP = 96  # pixels a side of a height map


@dataclass(frozen=True)
class Crops:
    """Height maps of one animal, a batch (n), and how the animal's mass lies on the floor.

    heights (n, CROP, CROP) int16, 1/16 mm above the floor, 0 = not the animal; origin (n, 2)
    picture pixel (u, v) of crop pixel (0, 0); step (n,) picture pixels a crop pixel; n_px (n,)
    readings on the animal, 0 = not found; n_blobs (n,) how many things in the frame have about the
    animal's size; moments (n, 9): pixels, area mm^2, volume mm^3, centroid x, y mm, long-axis angle
    rad (mod pi), the standard deviation mm along and across it, and (camera_view, else 0) the slope
    of the back along it, all in the view frame. The view frame is the arena frame, or (camera_view)
    an upright frame whose z axis is the optical axis backwards; its origin is `distance` (n,) mm in
    front of the camera.
    """

    heights: NDArray[np.int16]
    origin: NDArray[np.int32]
    step: NDArray[np.int32]
    n_px: NDArray[np.int64]
    moments: Array
    distance: Array
    n_blobs: NDArray[np.int64]

    @staticmethod
    def blank(n: int, distance_mm: Array | float) -> Crops:
        """A batch in which nothing is found yet."""
        return Crops(
            np.zeros((n, CROP, CROP), np.int16),
            np.zeros((n, 2), np.int32),
            np.ones(n, np.int32),
            np.zeros(n, np.int64),
            np.zeros((n, N_MOMENTS)),
            np.full(n, distance_mm),
            np.zeros(n, np.int64),
        )

    @staticmethod
    def join(parts: Sequence[Crops]) -> Crops:
        """Several batches as one."""
        return Crops(
            *(
                np.concatenate([getattr(part, field.name) for part in parts])
                for field in fields(Crops)
            )
        )

    def __getitem__(self, index: NDArray[np.bool_] | NDArray[np.int64] | slice) -> Crops:
        """Some crops out of a batch."""
        return Crops(*(getattr(self, field.name)[index] for field in fields(self)))

    def put(self, rows: NDArray[np.int64], other: Crops) -> None:
        """Replace some rows by all of another batch."""
        for field in fields(self):
            getattr(self, field.name)[rows] = getattr(other, field.name)

    @property
    def found(self) -> NDArray[np.bool_]:
        """(n,) True where an animal is in view."""
        return self.n_px > 0

    @property
    def centroid(self) -> Array:
        """The middle (n, 3) mm of the animal's mass, at its mean height, in the view frame."""
        moments = self.moments
        return np.stack([moments[:, 3], moments[:, 4], moments[:, 2] / moments[:, 1]], axis=1)


class Foreground(Protocol):
    """What finds the animal in the pictures of one camera: `foreground.Scene`, or
    `nearest.NearestScene`.
    """

    @property
    def camera(self) -> Camera:
        """The camera that looks."""

    @property
    def floor(self) -> Floor:
        """Where heights of a recording's results are measured from."""

    @property
    def area_mm2(self) -> float:
        """The animal's usual area seen by the camera."""

    def extract(
        self,
        depths: NDArray[np.float32],
        size: float,
        parallel: bool = True,
        camera_view: bool = False,
    ) -> Crops:
        """The animal of each frame (n, H, W) mm."""

    def extract_both(
        self,
        depths: NDArray[np.float32],
        size: float,
        parallel: bool = True,
        camera_view: bool = False,
    ) -> tuple[Crops, Crops]:
        """The animal of each frame (n, H, W) mm, and what else may be it, found where n_blobs is
        more than one.
        """

    def looks(self, crops: Crops, camera_view: bool = False) -> Array:
        """How each height map was cut (n, 17)."""

    def planes(self, crops: Crops, camera_view: bool = False) -> Array:
        """The plane (n, 3) above which each height map is measured: 1 / z = a u + b v + c in pixels
        of the picture.
        """

    def middles(self, crops: Crops, camera_view: bool = False) -> Array:
        """The middle (n, 3) mm of what each crop shows, in the arena frame."""

    def misfit(self, crops: Crops) -> Array:
        """How unlike the animal each crop (n) is."""

    def every(self, step: int) -> Foreground:
        """The same with every `step`-th pixel along rows and columns."""


class Cutter(ABC):
    """What cuts the animal out of pictures, and what else may be it in the same pass; the part that
    scenes share.
    """

    def extract(
        self,
        depths: NDArray[np.float32],
        size: float,
        parallel: bool = True,
        camera_view: bool = False,
    ) -> Crops:
        """The animal of each frame (n, H, W) mm; `size` is its spine over the skeleton's home
        length. camera_view: heights are measured along the optical axis.
        """
        return self._extract(depths, size, parallel, camera_view, 1)

    def extract_both(
        self,
        depths: NDArray[np.float32],
        size: float,
        parallel: bool = True,
        camera_view: bool = False,
    ) -> tuple[Crops, Crops]:
        """`extract`, and the next thing that may be the animal after all."""
        crops = self._extract(depths, size, parallel, camera_view, 2)
        n = len(depths)
        return crops[:n], crops[n:]

    @abstractmethod
    def _extract(
        self,
        depths: NDArray[np.float32],
        size: float,
        parallel: bool,
        camera_view: bool,
        n_things: int,
    ) -> Crops:
        """The rows (n) of the most likely things, and then (n_things 2) those of the next."""


def view_of(looks: Array) -> SE3:
    """T_view_camera (n) of looks (n, 17)."""
    translation = np.zeros((len(looks), 3))
    translation[:, 2] = looks[:, 13]
    return SE3(looks[:, 4:13].reshape(-1, 3, 3), translation)


@dataclass(frozen=True)
class Windows:
    """Parts of pictures from many cameras (n), each around one animal on a known floor.

    depth, background (n, H, W) mm, 0 = unread; intrinsics (n, 4) fx fy cx cy, pixels of the whole
    picture; origin (n, 2) picture pixel of each window's first; inverse_depth (n, 3): 1 / z of the
    floor = a u + b v + c in pixels of the whole picture; view: how such animals are looked at.
    """

    depth: NDArray[np.uint16] | NDArray[np.float32]
    background: NDArray[np.uint16] | NDArray[np.float32]
    intrinsics: Array
    origin: Array
    inverse_depth: Array
    view: View = MOUSE_VIEW

    def floor(self, k: int) -> Floor:
        """The floor of window k."""
        fx, fy, cx, cy = self.intrinsics[k]
        return Floor.from_inverse_depth(self.inverse_depth[k], Camera(fx, fy, cx, cy, 1, 1))

    def extract(
        self,
        size: Array,
        area_mm2: Array,
        min_height_mm: Array | float = 7.0,
        camera_view: bool = False,
        n_things: int = 1,
    ) -> tuple[Crops, Array]:
        """The blob of each window whose area is nearest to area_mm2 (n,), and its looks (n, 17);
        see `Scene.extract` and `Scene.looks`. size (n,) of the animals over home; min_height_mm:
        one, or (n,); n_things: 2 gives as many rows again, of what is next near.
        """
        n = len(self.depth)
        distance = np.empty(n)
        # a window is the picture of a camera whose centre is shifted
        intrinsics = self.intrinsics.copy()
        plane = self.inverse_depth.copy()
        intrinsics[:, 2:] -= self.origin
        plane[:, 2] += plane[:, 0] * self.origin[:, 0] + plane[:, 1] * self.origin[:, 1]
        margin = np.broadcast_to(np.asarray(min_height_mm, np.float32), (n,)).copy()
        rotation = np.empty((n, 3, 3))
        of_whom = np.hstack([self.inverse_depth, self.intrinsics])
        for k in range(n):
            if (
                not k or (of_whom[k] != of_whom[k - 1]).any()
            ):  # many in a row are often before one camera
                floor = self.floor(k)
            distance[k] = floor.distance_mm
            rotation[k] = (
                np.diag([1.0, -1.0, -1.0]) if camera_view else floor.T_arena_camera.rotation
            )
        crops = Crops.blank(n_things * n, np.tile(distance, n_things))
        kernels.extract_windows(
            self.depth,
            self.background,
            margin,
            area_mm2,
            n_things,
            self.view.smooth_mm * size,
            intrinsics,
            plane,
            rotation,
            np.full(n, self.view.behind_mm if camera_view else 0.0),
            crops.heights,
            crops.origin,
            crops.step,
            crops.n_px,
            crops.moments,
            crops.distance,
            crops.n_blobs,
        )
        cut = np.tile(np.concatenate([intrinsics, rotation.reshape(n, 9)], axis=1), (n_things, 1))
        looks = np.concatenate(
            [cut, crops.distance[:, None], crops.origin, crops.step[:, None]], axis=1
        )
        return crops, looks
