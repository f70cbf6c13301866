"""Height maps of segmented animals: depth above a reference plane on a 96 x 96 crop, with moments.

A segmenter (`BackgroundSubtraction` or `HandSegmenter`) finds the animal's connected component in
whole pictures or in patches around it. Its pixels become heights above a plane by

    h = distance (1 - z (a u + b v + c)),

where 1 / z = a u + b v + c is the plane in a pinhole picture (inverse depth is linear in the
pixel). The plane is the arena's floor, or (camera_view) one across the optical axis behind the
animal, as the depth features of Lie-X see it. Area, volume, centroid and principal axes are the
image moments of the map (Hu 1962), taken in mm in the view frame. How a map was cut is its crop
camera, see `CropCamera`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from liex_lab.body.skeleton import MOUSE_VIEW, View
from liex_lab.geometry import SE3
from liex_lab.optics.camera import Camera
from liex_lab.runtime.shapes import check_shapes
from liex_lab.scene import _height_map_kernels as kernels
from liex_lab.scene._blob_kernels import N_MOMENTS, BlobMoments
from liex_lab.scene._height_map_kernels import N_CROP_CAMERA, CropCamera, CropRows
from liex_lab.scene.floor import Floor

__all__ = [
    "N_CROP_CAMERA",
    "CropCamera",
    "crop_columns",
    "in_camera_frame",
    "in_view_frame",
    "mm_per_px",
    "pack_crop_cameras",
    "view_of",
]

Array = NDArray[np.float64]
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
        intrinsics: (4,) or (n, 4) fx, fy, cx, cy of the whole picture, px.
        rotation: (3, 3) or (n, 3, 3) of T_view_camera.
        distance: (n,) z of the camera's centre in the view frame, mm.
        origin: (n, 2) column and row of the whole picture that are the crop's first.
        step: (n,) pixels of the whole picture from one crop pixel to the next.

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
        crop_cameras: (n, 17) packed crop cameras.

    Returns:
        Views (n,) of the columns.
    """
    return CropCamera(*crop_cameras.T)


def _rotations(crop_cameras: Array) -> Array:
    """Rotations (n, 3, 3) of T_view_camera."""
    return crop_cameras[:, _ROTATION].reshape(-1, 3, 3)


def view_of(crop_cameras: Array) -> SE3:
    """Where the cameras stand in the view frames of their crops.

    Args:
        crop_cameras: (n, 17) packed crop cameras.

    Returns:
        T_view_camera (n), mm.
    """
    translation = np.zeros((len(crop_cameras), 3))
    translation[:, 2] = crop_columns(crop_cameras).distance
    return SE3(_rotations(crop_cameras), translation)


def mm_per_px(crop_cameras: Array) -> Array:
    """How many millimetres a crop pixel covers at the distance of the view frame's origin.

    Args:
        crop_cameras: (n, 17) packed crop cameras.

    Returns:
        (n,) mm per crop pixel.
    """
    columns = crop_columns(crop_cameras)
    return np.asarray(columns.step * columns.distance / columns.fx)


def in_camera_frame(points: Array, crop_cameras: Array) -> Array:
    """Points of the view frames of crops, in their cameras' frames.

    Args:
        points: (n, ..., 3) mm, view frames.
        crop_cameras: (n, 17) packed crop cameras.

    Returns:
        (n, ..., 3) mm, camera frames.
    """
    offset = points - _camera_centre(points, crop_cameras)
    return np.einsum("nji,n...j->n...i", _rotations(crop_cameras), offset)


def in_view_frame(points: Array, crop_cameras: Array) -> Array:
    """The inverse of `in_camera_frame`.

    Args:
        points: (n, ..., 3) mm, camera frames.
        crop_cameras: (n, 17) packed crop cameras.

    Returns:
        (n, ..., 3) mm, view frames.
    """
    turned = np.einsum("nij,n...j->n...i", _rotations(crop_cameras), points)
    return turned + _camera_centre(points, crop_cameras)


def _camera_centre(points: Array, crop_cameras: Array) -> Array:
    """The camera's centre (n, ..., 3) mm in the view frames, to be added to points (n, ..., 3)."""
    centre = np.zeros((len(crop_cameras), *(1,) * (points.ndim - 2), 3))
    distance = crop_columns(crop_cameras).distance
    centre[..., 2] = distance.reshape(-1, *(1,) * (points.ndim - 2))
    return centre


CROP = 96  # pixels a side of a height map


@dataclass(frozen=True)
class HeightMaps:
    """Height maps of one animal in n frames, and how the animal's mass lies in the view frame.

    The view frame is the arena frame, or (camera_view) an upright frame whose z axis is the optical
    axis backwards; of a hand without camera_view, its z axis runs backwards along the line of sight
    through the middle of the crop. The origin of the view frame is `distance` mm in front of the
    camera.

    Attributes:
        heights: (n, CROP, CROP) int16, 1/16 mm above the reference plane, 0 where it is not the
            animal.
        origin: (n, 2) int32, picture pixel (u, v) of crop pixel (0, 0).
        step: (n,) int32, picture pixels a crop pixel.
        n_px: (n,) int64, readings on the animal, 0 where it was not found.
        moments: (n, 9): pixels, area mm^2, volume mm^3, centroid x, y mm, angle of the long axis
            rad (mod pi), the standard deviations mm along and across it, and (camera_view, else 0)
            the slope of the back along it; all in the view frame. The axis of a hand points away
            from its arm where one is seen.
        distance: (n,) mm from the camera to the origin of the view frame.
        n_blobs: (n,) int64, how many components of the frame have about the animal's size.
    """

    heights: NDArray[np.int16]
    origin: NDArray[np.int32]
    step: NDArray[np.int32]
    n_px: NDArray[np.int64]
    moments: Array
    distance: Array
    n_blobs: NDArray[np.int64]

    def __post_init__(self) -> None:
        """Refuse arrays that do not fit together, for kernels do not check them."""
        check_shapes(
            "height maps",
            ("heights", self.heights, ("n", "S", "S")),
            ("origin", self.origin, ("n", 2)),
            ("step", self.step, ("n",)),
            ("n_px", self.n_px, ("n",)),
            ("moments", self.moments, ("n", N_MOMENTS)),
            ("distance", self.distance, ("n",)),
            ("n_blobs", self.n_blobs, ("n",)),
        )

    @staticmethod
    def blank(n: int, distance_mm: Array | float) -> HeightMaps:
        """A batch of n empty height maps, in which nothing is found yet.

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
        )

    @staticmethod
    def join(parts: Sequence[HeightMaps]) -> HeightMaps:
        """Several batches as one, in their order.

        Args:
            parts: at least one batch.
        """
        return HeightMaps(
            *(
                np.concatenate([getattr(part, field.name) for part in parts])
                for field in fields(HeightMaps)
            )
        )

    def __getitem__(self, index: NDArray[np.bool_] | NDArray[np.int64] | slice) -> HeightMaps:
        """Some of the rows as a batch of their own.

        Args:
            index: mask (n,), row numbers, or a slice.
        """
        return HeightMaps(*(getattr(self, field.name)[index] for field in fields(self)))

    def put(self, rows: NDArray[np.int64], other: HeightMaps) -> None:
        """Replace some rows, in place, by all rows of another batch.

        Args:
            rows: (m,) row numbers.
            other: a batch of m rows.
        """
        for field in fields(self):
            getattr(self, field.name)[rows] = getattr(other, field.name)

    @property
    def rows(self) -> CropRows:
        """The arrays themselves, as kernels fill them."""
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
    """Patches of pictures from many cameras, each around one animal on a known floor.

    Attributes:
        depth: (n, H, W) uint16 or float32 mm, 0 where unread.
        background: (n, H, W) uint16 or float32 mm, 0 where unread: there the floor takes over.
        intrinsics: (n, 4) fx, fy, cx, cy, pixels of the whole picture.
        origin: (n, 2) picture pixel (u, v) of each patch's first.
        inverse_depth: (n, 3) a, b, c of the floor, 1 / z = a u + b v + c, per mm, in pixels of the
            whole picture.
        view: how such animals are looked at.
    """

    depth: NDArray[np.uint16] | NDArray[np.float32]
    background: NDArray[np.uint16] | NDArray[np.float32]
    intrinsics: Array
    origin: Array
    inverse_depth: Array
    view: View = MOUSE_VIEW

    def __post_init__(self) -> None:
        """Refuse arrays that do not fit together, for kernels do not check them."""
        check_shapes(
            "patches",
            ("depth", self.depth, ("n", "H", "W")),
            ("background", self.background, ("n", "H", "W")),
            ("intrinsics", self.intrinsics, ("n", 4)),
            ("origin", self.origin, ("n", 2)),
            ("inverse_depth", self.inverse_depth, ("n", 3)),
        )

    def floor(self, k: int) -> Floor:
        """The floor of one patch.

        Args:
            k: the patch.
        """
        fx, fy, cx, cy = self.intrinsics[k]
        return Floor.from_inverse_depth(self.inverse_depth[k], Camera(fx, fy, cx, cy, 1, 1))

    def extract(
        self,
        size: Array,
        area_mm2: Array,
        min_height_mm: Array | float = 7.0,
        camera_view: bool = False,
        n_things: int = 1,
    ) -> tuple[HeightMaps, Array]:
        """Height maps of the component of each patch whose area is nearest to the animal's.

        Background subtraction as in `BackgroundSubtraction`, but every pixel counts as floor, and
        the background is given.

        Args:
            size: (n,) spine lengths of the animals over the home length.
            area_mm2: (n,) usual areas of the animals.
            min_height_mm: what is nearer than the background by less is not the animal; one or
                (n,).
            camera_view: whether heights are measured along the optical axis.
            n_things: 2 gives as many rows again, those of the next nearest components.

        Returns:
            The height maps (n or 2 n), and their crop cameras (n or 2 n, 17) in pixels of the
            patches.
        """
        n = len(self.depth)
        check_shapes("animals", ("area_mm2", area_mm2, (n,)), ("size", size, (n,)))
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
        crops = HeightMaps.blank(n_things * n, np.tile(distance, n_things))
        kernels.extract_windows(
            self.depth,
            self.background,
            margin,
            area_mm2,
            n_things,
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
            np.tile(intrinsics, (n_things, 1)),
            np.tile(rotation, (n_things, 1, 1)),
            crops.distance,
            crops.origin,
            crops.step,
        )
        return crops, packed
