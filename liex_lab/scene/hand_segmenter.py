"""Segmentation of a hand in depth images by geodesic extrema, without a background.

Nothing is nearer to the camera than the hand, and an arm leads away from it. Each surface (a
connected component of blocks whose depths differ by less than 50 mm) is traversed from where it
leaves the image; maxima of the geodesic distance with enough persistence are candidate hands. This
is the idea of accumulative geodesic extrema (Plagemann et al., ICRA 2010; Baak et al., ICCV 2011).
Mean shift centres a sphere on such an end, the part that leaves the sphere is the arm, and the
surface is cut a hand's length behind the fingertips. A score with weights learned by logistic
regression selects the best end; see the kernels.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from liex_lab.body.skeleton import CameraView
from liex_lab.errors import EstimationError
from liex_lab.optics.camera import Camera
from liex_lab.recordings.recording import Recording
from liex_lab.runtime.memory import check_shapes
from liex_lab.runtime.processes import in_parallel, threads
from liex_lab.scene import _hand_kernels as kernels
from liex_lab.scene.background import sample_frames
from liex_lab.scene.floor import Array, Floor
from liex_lab.scene.height_maps import (
    CROP,
    HeightMaps,
    Segmenter,
    crop_columns,
    pack_crop_cameras,
    size_misfit,
    view_of,
)

RANGE_MM = (250.0, 1600.0)  # least and largest depth of a hand
_FLAT = np.array([0.0, 0.0, 1.0])  # perpendicular to the optical axis


@dataclass(frozen=True)
class HandSegmenter(Segmenter):
    """Segmentation of the hand in one camera's images.

    The same interface as that of `BackgroundSubtraction`.

    Attributes:
        camera: the ideal pinhole camera of the recording.
        floor: a plane across the optical axis behind the hand, which replaces the arena's: z points
            at the camera.
        view: how hands are viewed.
        near_mm: least depth of a hand.
        far_mm: largest depth of a hand.
        area_mm2: the hand's usual area in the camera's view, mm^2; 0 while unknown.
        volume_mm3: the hand's usual volume above its reference plane, mm^3; 0 while unknown.
    """

    camera: Camera
    floor: Floor
    view: CameraView
    near_mm: float = RANGE_MM[0]
    far_mm: float = RANGE_MM[1]
    area_mm2: float = 0.0
    volume_mm3: float = 0.0

    @staticmethod
    def learn(
        recording: Recording,
        view: CameraView,
        n_frames: int = 96,
        range_mm: tuple[float, float] = RANGE_MM,
    ) -> "tuple[HandSegmenter, NDArray[np.float32]]":
        """The hand segmenter of a recording, with the hand's usual area, volume and depth.

        Args:
            recording: of an ideal pinhole camera, see `recordings.rectify`.
            view: how hands are viewed.
            n_frames: sampled frames at most.
            range_mm: least and largest depth of a hand.

        Returns:
            The segmenter, and the sample (n, H, W) float32 mm of frames that it was learned from.

        Raises:
            EstimationError: nothing of a hand's size lies within the range.
        """
        sample = sample_frames(recording, n_frames)
        camera = recording.camera
        scene = HandSegmenter(camera, Floor.from_plane(_FLAT, 1000.0, camera), view, *range_mm)
        crops = scene.extract(sample, 1.0)
        if not crops.found.any():
            raise EstimationError(
                f"no hand was found in {len(sample)} frames spread over the recording: nothing of "
                f"a hand's size lies between {range_mm[0]:g} and {range_mm[1]:g} mm; check the "
                "depth unit, foreground.near_mm and far_mm"
            )
        blobs = crops[crops.found].blobs
        floor = Floor.from_plane(_FLAT, float(np.median(crops.distance[crops.found])), camera)
        return replace(
            scene,
            floor=floor,
            area_mm2=float(np.median(blobs.area_mm2)),
            volume_mm3=float(np.median(blobs.volume_mm3)),
        ), sample

    def misfit(self, crops: HeightMaps) -> Array:
        """See `Segmenter`."""
        # of the logarithms, between postures of one hand
        return size_misfit(crops, self.area_mm2, self.volume_mm3, (0.45, 0.45))

    def crop_cameras(self, crops: HeightMaps, camera_view: bool = False) -> Array:
        """The crop cameras of height maps: intrinsics, T_view_camera, origin and step of each crop.

        Args:
            crops: n height maps.
            camera_view: as they were extracted.

        Returns:
            (n, 17), packed as `CropCamera`.
        """
        return crop_cameras_of(crops, self._intrinsics(len(crops.step)), camera_view)

    def planes(self, crops: HeightMaps, camera_view: bool = False) -> Array:
        """The reference plane of each height map, perpendicular to its line of sight.

        Args:
            crops: n height maps.
            camera_view: as they were extracted.

        Returns:
            (n, 3) a, b, c of 1 / z = a u + b v + c, per mm, u and v in image pixels.
        """
        camera = crop_columns(self.crop_cameras(crops, camera_view))
        a = -camera.r20 / camera.fx / camera.distance
        b = -camera.r21 / camera.fy / camera.distance
        c = -camera.r22 / camera.distance - a * camera.cx - b * camera.cy
        return np.stack([a, b, c], axis=-1)

    def middles(self, crops: HeightMaps, camera_view: bool = False) -> Array:
        """The centroid (n, 3) mm of each height map, in the arena frame.

        Args:
            crops: n height maps.
            camera_view: as they were extracted.
        """
        T_camera_view = view_of(self.crop_cameras(crops, camera_view)).inverse()
        middle = (
            np.einsum("nij,nj->ni", T_camera_view.rotation, crops.centroid)
            + T_camera_view.translation
        )
        return self.floor.T_arena_camera @ middle

    def extract(
        self,
        depths: NDArray[np.float32],
        size: float,
        parallel: bool = True,
        camera_view: bool = False,
        n_candidates: int = 1,
    ) -> HeightMaps:
        """Height maps of the best hands; see `Segmenter`.

        Heights are measured along the line of sight through the middle of the crop, from behind_mm
        (at home size) behind the hand's middle; camera_view: along the optical axis.
        """
        n = len(depths)
        with threads(parallel):
            return cut_nearest(
                depths,
                self._intrinsics(n),
                np.full(n, size),
                self.view,
                (self.near_mm, self.far_mm),
                camera_view,
                n_candidates,
            )

    def every(self, step: int) -> "HandSegmenter":
        """The same segmenter for images of every `step`-th row and column."""
        camera = self.camera.every(step)
        return replace(self, camera=camera, floor=self.floor.for_camera(camera))

    def _intrinsics(self, n: int) -> Array:
        c = self.camera
        return np.broadcast_to(np.array([c.fx, c.fy, c.cx, c.cy]), (n, 4)).copy()


@dataclass(frozen=True)
class HandPatches:
    """Image patches from many cameras, each around one hand; the counterpart of `Patches`.

    Attributes:
        depth: (n, H, W) uint16 mm, 0 where unread.
        intrinsics: (n, 4) fx, fy, cx, cy, pixels of the full image.
        origin: (n, 2) image pixel (u, v) of each patch's first.
        view: how hands are viewed.
    """

    depth: NDArray[np.uint16]
    intrinsics: Array
    origin: Array
    view: CameraView

    def extract(
        self, size: Array, camera_view: bool = False, n_candidates: int = 1
    ) -> tuple[HeightMaps, Array]:
        """Height maps of the hands and their crop cameras; see `HandSegmenter`.

        Args:
            size: (n,) lengths of the hands over the home length.
            camera_view: whether heights are measured along the optical axis.
            n_candidates: 2 adds as many rows again for the second best candidates.

        Returns:
            The height maps (n or 2 n), and their crop cameras (n or 2 n, 17) in pixels of the
            patches.
        """
        intrinsics = self.intrinsics.copy()
        intrinsics[:, 2:] -= self.origin  # a patch is the image of a camera with a shifted centre
        crops = cut_nearest(
            self.depth, intrinsics, size, self.view, RANGE_MM, camera_view, n_candidates
        )
        return crops, crop_cameras_of(crops, np.tile(intrinsics, (n_candidates, 1)), camera_view)


def cut_nearest(
    depths: NDArray[np.float32] | NDArray[np.uint16],
    intrinsics: Array,
    size: Array,
    view: CameraView,
    range_mm: tuple[float, float],
    camera_view: bool,
    n_candidates: int,
) -> HeightMaps:
    """Height maps of the hands in images.

    The long axis among the moments points away from the arm, if one is visible.

    Args:
        depths: (n, H, W) float32 or uint16 mm, 0 where unread.
        intrinsics: (n, 4) fx, fy, cx, cy px of each image.
        size: (n,) lengths of the hands over the home length.
        view: how hands are viewed; its lengths are those at home size.
        range_mm: least and largest depth of a hand.
        camera_view: whether heights are measured along the optical axis, else along the line of
            sight through the middle of the crop.
        n_candidates: 2 adds as many rows again for the second best candidates.

    Returns:
        n or 2 n height maps.
    """
    check_shapes(
        "images of hands",
        ("depths", depths, ("n", "H", "W")),
        ("intrinsics", intrinsics, ("n", 4)),
        ("size", size, ("n",)),
    )
    crops = HeightMaps.blank(n_candidates * len(depths), 1000.0)
    sights = kernels.HandSight(
        *range_mm,
        size=size,
        behind=size * view.behind_mm,
        smooth=size * view.smooth_mm,
        intrinsics=intrinsics,
        along_axis=camera_view,
    )
    in_parallel(kernels.extract_all, len(depths), depths, n_candidates, sights, crops.rows)
    return crops


def crop_cameras_of(crops: HeightMaps, intrinsics: Array, camera_view: bool) -> Array:
    """The crop cameras (n, 17) of height maps of hands, packed as `CropCamera`.

    Args:
        crops: n height maps.
        intrinsics: (n, 4) fx, fy, cx, cy px of each image.
        camera_view: as they were extracted.
    """
    n = len(crops.step)
    check_shapes("height maps", ("intrinsics", intrinsics, (n, 4)))
    rotations = np.empty((n, 3, 3))
    kernels.fill_rotations(intrinsics, crops.origin, crops.step, CROP, camera_view, rotations)
    return pack_crop_cameras(intrinsics, rotations, crops.distance, crops.origin, crops.step)


def sight_rotations(p_camera: Array) -> Array:
    """Rotations (n, 3, 3) of T_view_camera for lines of sight through points.

    The view's z axis points from the point to the camera, its x axis is as near as possible to the
    camera's.

    Args:
        p_camera: (n, 3) points in front of the camera, in its frame; any unit.
    """
    rotations = np.empty((len(p_camera), 3, 3))
    for rotation, (x, y, z) in zip(rotations, p_camera, strict=True):
        kernels.sight_rotation(x / z, y / z, rotation)
    return rotations
