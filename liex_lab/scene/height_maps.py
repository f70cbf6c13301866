"""Height maps of segmented animals: depth above a reference plane on a 96 x 96 crop, with moments.

A segmenter (`BackgroundSubtraction` or `HandSegmenter`) finds the animal's connected component in
full images or in patches around it. Its pixels become heights above a plane by

    h = distance (1 - z (a u + b v + c)),

where 1 / z = a u + b v + c is the plane in a pinhole image (inverse depth is linear in the pixel).
The plane is the arena's floor, or (camera_view) one perpendicular to the optical axis behind the
animal, as in the depth features of Lie-X. Area, volume, centroid and principal axes are the image
moments of the map (Hu 1962), measured in mm in the view frame. The geometry of a map is its crop
camera, see `CropCamera`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from liex_lab.body.skeleton import MOUSE_VIEW, CameraView
from liex_lab.geometry import SE3
from liex_lab.optics.camera import Camera
from liex_lab.runtime.memory import Rows, check_shapes
from liex_lab.runtime.processes import in_parallel
from liex_lab.scene import _height_map_kernels as kernels
from liex_lab.scene._blob_kernels import N_MOMENTS, BlobMoments
from liex_lab.scene._height_map_kernels import N_CROP_CAMERA, CropCamera, CropRows
from liex_lab.scene.floor import Array, Floor

__all__ = [
    "N_CROP_CAMERA",
    "CropCamera",
    "crop_columns",
    "in_camera_frame",
    "mm_per_px",
    "pack_crop_cameras",
    "view_of",
]

_ROTATION = slice(CropCamera._fields.index("r00"), CropCamera._fields.index("r22") + 1)


def pack_crop_cameras(
    intrinsics: Array,
    rotation: Array,
    distance: Array,
    origin: NDArray[np.int32],
    step: NDArray[np.int32],
) -> Array:
    """Pack the cameras of n crops.

    Args:
        intrinsics: (4,) or (n, 4) fx, fy, cx, cy of the full image, px.
        rotation: (3, 3) or (n, 3, 3) of T_view_camera.
        distance: (n,) z of the camera's centre in the view frame, mm.
        origin: (n, 2) column and row of the full image at the crop's first pixel.
        step: (n,) pixels of the full image per crop pixel.

    Returns:
        (n, 17) packed crop cameras.
    """
    packed = np.empty((len(step), N_CROP_CAMERA))
    packed[:, :4] = intrinsics
    packed[:, _ROTATION] = np.reshape(rotation, (*np.shape(rotation)[:-2], 9))
    packed[:, CropCamera._fields.index("distance")] = distance
    packed[:, CropCamera._fields.index("u0") : CropCamera._fields.index("step")] = origin
    packed[:, CropCamera._fields.index("step")] = step
    return packed


def crop_columns(crop_cameras: Array) -> CropCamera:
    """The columns of packed crop cameras by name.

    Args:
        crop_cameras: (n, 17).

    Returns:
        Views (n,) of the columns.
    """
    return CropCamera(*crop_cameras.T)


def _rotations(crop_cameras: Array) -> Array:
    """Rotations (n, 3, 3) of T_view_camera."""
    return crop_cameras[:, _ROTATION].reshape(-1, 3, 3)


def view_of(crop_cameras: Array) -> SE3:
    """The camera's pose in the view frame of each crop: T_view_camera (n), mm.

    Args:
        crop_cameras: (n, 17).
    """
    translation = np.zeros((len(crop_cameras), 3))
    translation[:, 2] = crop_columns(crop_cameras).distance
    return SE3(_rotations(crop_cameras), translation)


def mm_per_px(crop_cameras: Array) -> Array:
    """Millimetres (n,) per crop pixel at the distance of the view frame's origin.

    Args:
        crop_cameras: (n, 17).
    """
    columns = crop_columns(crop_cameras)
    return np.asarray(columns.step * columns.distance / columns.fx)


def in_camera_frame(points: Array, crop_cameras: Array) -> Array:
    """Transform points from the view frames of crops to their cameras' frames.

    Args:
        points: (n, ..., 3) mm, view frames.
        crop_cameras: (n, 17).

    Returns:
        (n, ..., 3) mm, camera frames.
    """
    return np.einsum(
        "nji,n...j->n...i", _rotations(crop_cameras), points - _camera_centre(points, crop_cameras)
    )


def _camera_centre(points: Array, crop_cameras: Array) -> Array:
    """The camera's centre (n, ..., 3) mm in the view frames, to be added to points (n, ..., 3)."""
    centre = np.zeros((len(crop_cameras), *(1,) * (points.ndim - 2), 3))
    centre[..., 2] = crop_columns(crop_cameras).distance.reshape(-1, *(1,) * (points.ndim - 2))
    return centre


CROP = 96  # pixels per side of a height map
N_OBJECTS = 4  # components of a frame that are described
ANIMAL_HEIGHTS = (0.4, 2.0)  # mean height of an animal from the floor, over the usual one


@dataclass(frozen=True)
class HeightMaps(Rows):
    """Height maps of one animal in n frames, with moments of its mass in the view frame.

    The view frame is the arena frame, or (camera_view) an upright frame whose z axis is the
    reversed optical axis; for a hand without camera_view, its z axis is the reversed line of sight
    through the middle of the crop. The origin of the view frame is `distance` mm in front of the
    camera.

    Attributes:
        heights: (n, CROP, CROP) int16, 1/16 mm above the reference plane, 0 outside the animal.
        origin: (n, 2) int32, image pixel (u, v) of crop pixel (0, 0).
        step: (n,) int32, image pixels per crop pixel.
        n_px: (n,) int64, readings on the animal, 0 if it was not found.
        moments: (n, 9): pixels, area mm^2, volume mm^3, centroid x, y mm, angle of the long axis
            rad (mod pi), the standard deviations mm along and across it, and (camera_view, else 0)
            the slope of the back along it; all in the view frame. The axis of a hand points away
            from its arm if one is visible.
        distance: (n,) mm from the camera to the origin of the view frame.
        n_blobs: (n,) int64, components of the frame with about the animal's size.
        objects: (n, N_OBJECTS, 4) centre x, y, z mm, arena frame, and area mm^2 of these
            components, the most similar first; NaN if absent or not asked for.
    """

    heights: NDArray[np.int16]
    origin: NDArray[np.int32]
    step: NDArray[np.int32]
    n_px: NDArray[np.int64]
    moments: Array
    distance: Array
    n_blobs: NDArray[np.int64]
    objects: Array

    def __post_init__(self) -> None:
        """Check that the shapes match, as kernels do not."""
        check_shapes(
            "height maps",
            ("heights", self.heights, ("n", "S", "S")),
            ("origin", self.origin, ("n", 2)),
            ("step", self.step, ("n",)),
            ("n_px", self.n_px, ("n",)),
            ("moments", self.moments, ("n", N_MOMENTS)),
            ("distance", self.distance, ("n",)),
            ("n_blobs", self.n_blobs, ("n",)),
            ("objects", self.objects, ("n", N_OBJECTS, 4)),
        )

    @staticmethod
    def blank(n: int, distance_mm: Array | float) -> HeightMaps:
        """A batch of n empty height maps.

        Args:
            n: frames.
            distance_mm: of the view frame's origin from the camera, one or (n,).
        """
        return HeightMaps(
            np.zeros((n, CROP, CROP), np.int16),
            np.zeros((n, 2), np.int32),
            np.ones(n, np.int32),
            np.zeros(n, np.int64),
            np.zeros((n, N_MOMENTS)),
            np.full(n, distance_mm),
            np.zeros(n, np.int64),
            np.full((n, N_OBJECTS, 4), np.nan),
        )

    @property
    def rows(self) -> CropRows:
        """The arrays as one record for the kernels."""
        return CropRows(*(getattr(self, field) for field in CropRows._fields))

    @property
    def found(self) -> NDArray[np.bool_]:
        """(n,) bool, True where an animal is in view."""
        return self.n_px > 0

    @property
    def blobs(self) -> BlobMoments:
        """The moments (n,) of the components by name, see `BlobMoments`."""
        return moment_columns(self.moments)

    @property
    def centroid(self) -> Array:
        """The centroid (n, 3) mm of the animal's mass, at its mean height, in the view frame."""
        blob = self.blobs
        return np.stack([blob.x, blob.y, blob.volume_mm3 / blob.area_mm2], axis=1)


def size_misfit(
    crops: HeightMaps, area_mm2: float, volume_mm3: float | None, sd: tuple[float, float]
) -> Array:
    """The sum of ((log a - log a0) / sd_a)^2 over area and the same over volume, (n,).

    Args:
        crops: n height maps.
        area_mm2: the animal's usual area a0.
        volume_mm3: its usual volume; None leaves volumes out.
        sd: of the logarithms of area and of volume, between postures of one animal.
    """
    misfit = (np.log(np.maximum(crops.blobs.area_mm2, 1.0) / area_mm2) / sd[0]) ** 2
    if volume_mm3 is not None:
        misfit = (
            misfit + (np.log(np.maximum(crops.blobs.volume_mm3, 1.0) / volume_mm3) / sd[1]) ** 2
        )
    return np.asarray(misfit)


def moment_columns(moments: Array) -> BlobMoments:
    """The columns of packed moments by name.

    Args:
        moments: (n, 9), as in `HeightMaps`.

    Returns:
        Views (n,) of the columns.
    """
    return BlobMoments(*moments.T)


@dataclass(frozen=True)
class Patches:
    """Image patches from many cameras, each around one animal on a known floor.

    Attributes:
        depth: (n, H, W) uint16 or float32 mm, 0 where unread.
        background: (n, H, W) uint16 or float32 mm, 0 where unread: the floor is used there.
        intrinsics: (n, 4) fx, fy, cx, cy, pixels of the full image.
        origin: (n, 2) image pixel (u, v) of each patch's first.
        inverse_depth: (n, 3) a, b, c of the floor, 1 / z = a u + b v + c, per mm, in pixels of the
            full image.
        view: how such animals are viewed.
    """

    depth: NDArray[np.uint16] | NDArray[np.float32]
    background: NDArray[np.uint16] | NDArray[np.float32]
    intrinsics: Array
    origin: Array
    inverse_depth: Array
    view: CameraView = MOUSE_VIEW

    def __post_init__(self) -> None:
        """Check that the shapes match, as kernels do not."""
        check_shapes(
            "patches",
            ("depth", self.depth, ("n", "H", "W")),
            ("background", self.background, ("n", "H", "W")),
            ("intrinsics", self.intrinsics, ("n", 4)),
            ("origin", self.origin, ("n", 2)),
            ("inverse_depth", self.inverse_depth, ("n", 3)),
        )

    def floor(self, k: int) -> Floor:
        """The floor of patch k."""
        fx, fy, cx, cy = self.intrinsics[k]
        return Floor.from_inverse_depth(self.inverse_depth[k], Camera(fx, fy, cx, cy, 1, 1))

    def extract(
        self,
        size: Array,
        area_mm2: Array,
        min_height_mm: Array | float = 7.0,
        camera_view: bool = False,
        n_candidates: int = 1,
    ) -> tuple[HeightMaps, Array]:
        """Height maps of the component of each patch whose area is nearest to the animal's.

        Background subtraction as in `BackgroundSubtraction`, but every pixel counts as floor, and
        the background is given.

        Args:
            size: (n,) spine lengths of the animals over the home length.
            area_mm2: (n,) usual areas of the animals.
            min_height_mm: smaller heights above the background are not the animal; one or (n,).
            camera_view: whether heights are measured along the optical axis.
            n_candidates: 2 adds as many rows again for the second best components.

        Returns:
            The height maps (n or 2 n), and their crop cameras (n or 2 n, 17) in pixels of the
            patches.
        """
        n = len(self.depth)
        check_shapes("animals", ("area_mm2", area_mm2, (n,)), ("size", size, (n,)))
        distance = np.empty(n)
        # a patch is the image of a camera with a shifted centre
        intrinsics = self.intrinsics.copy()
        plane = self.inverse_depth.copy()
        intrinsics[:, 2:] -= self.origin
        plane[:, 2] += plane[:, 0] * self.origin[:, 0] + plane[:, 1] * self.origin[:, 1]
        margin = np.broadcast_to(np.asarray(min_height_mm, np.float32), (n,)).copy()
        rotation = np.empty((n, 3, 3))
        view_key = np.hstack([self.inverse_depth, self.intrinsics])
        for k in range(n):
            if (
                not k or (view_key[k] != view_key[k - 1]).any()
            ):  # consecutive patches often share a camera
                floor = self.floor(k)
            distance[k] = floor.distance_mm
            rotation[k] = (
                np.diag([1.0, -1.0, -1.0]) if camera_view else floor.T_arena_camera.rotation
            )
        crops = HeightMaps.blank(n_candidates * n, np.tile(distance, n_candidates))
        in_parallel(
            kernels.extract_windows,
            n,
            self.depth,
            self.background,
            margin,
            area_mm2,
            n_candidates,
            kernels.Sight(
                intrinsics,
                plane,
                rotation,
                behind_mm=np.full(n, self.view.behind_mm if camera_view else 0.0),
                smooth_mm=self.view.smooth_mm * size,
            ),
            crops.rows,
        )
        packed = pack_crop_cameras(
            np.tile(intrinsics, (n_candidates, 1)),
            np.tile(rotation, (n_candidates, 1, 1)),
            crops.distance,
            crops.origin,
            crops.step,
        )
        return crops, packed


# Segmentation of the animal in depth images: the base class of all methods.


class Segmenter(ABC):
    """Finds the animal in the images of one camera, and the next best candidate in the same pass.

    The base of `BackgroundSubtraction` and `HandSegmenter`.

    Attributes:
        camera: the ideal pinhole camera of the images.
        floor: the plane from which heights in a recording's results are measured.
        area_mm2: the animal's usual area in the camera's view, mm^2.
        n_animals: how many animals are in view at once in the sampled frames.
    """

    camera: Camera
    floor: Floor
    area_mm2: float
    n_animals: int = 1

    @abstractmethod
    def extract(
        self,
        depths: NDArray[np.float32],
        size: float,
        parallel: bool = True,
        camera_view: bool = False,
        n_candidates: int = 1,
    ) -> HeightMaps:
        """Height maps of the animal in each frame.

        Args:
            depths: (n, H, W) float32 mm, 0 where unread.
            size: the animal's spine length over the skeleton's home length; scales the smoothing.
            parallel: whether to use all threads.
            camera_view: whether heights are measured along the optical axis, from behind the
                animal.
            n_candidates: per frame, 1 or 2.

        Returns:
            The rows (n) of the best components, then (n_candidates 2) those of the second best.
        """

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
        crops = self.extract(depths, size, parallel, camera_view, 2)
        n = len(depths)
        return crops[:n], crops[n:]

    def levelled(
        self, depths: NDArray[np.float32], times_ns: NDArray[np.int64]
    ) -> NDArray[np.float32]:
        """Images for `extract`, with a ground that changes at one depth.

        Args:
            depths: (n, H, W) float32 mm, full images, 0 where unread.
            times_ns: (n,) of the images.

        Returns:
            (n, H, W) float32 mm, full images or at the scene's stride.
        """
        return depths

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
