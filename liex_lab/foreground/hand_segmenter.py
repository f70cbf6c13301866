"""The hand in front of the camera: no background is known, but nothing is nearer, and an arm leads
away from it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from liex_lab.arena.floor import Floor
from liex_lab.body.skeleton import View
from liex_lab.errors import EstimationError
from liex_lab.foreground import _hand_kernels as kernels
from liex_lab.foreground.background import sample_frames
from liex_lab.foreground.height_maps import CROP, Crops, Cutter, view_of
from liex_lab.optics.camera import Camera
from liex_lab.recordings.recording import Recording
from liex_lab.runtime.threads import threads

Array = NDArray[np.float64]

RANGE_MM = (250.0, 1600.0)  # nearer and farther than this nothing is a hand
_FLAT = np.array([0.0, 0.0, 1.0])  # across the optical axis
# of the logarithms, from posture to posture of one hand
_AREA_SD = 0.45
_VOLUME_SD = 0.45


@dataclass(frozen=True)
class NearestScene(Cutter):
    """A scene in which the nearest thing is the hand; the same interface as `Scene`.

    floor: a plane across the optical axis behind the hand, which stands for the arena's: z points
    at the camera. near_mm, far_mm: the range of depth in which a hand is looked for; area_mm2 and
    volume_mm3: the hand's usual ones.
    """

    camera: Camera
    floor: Floor
    view: View
    near_mm: float = RANGE_MM[0]
    far_mm: float = RANGE_MM[1]
    area_mm2: float = 0.0
    volume_mm3: float = 0.0

    @staticmethod
    def learn(
        recording: Recording,
        view: View,
        n_frames: int = 96,
        range_mm: tuple[float, float] = RANGE_MM,
    ) -> tuple[NearestScene, NDArray[np.float32]]:
        """The scene of a recording, and the sample (n, H, W) mm of its frames from which it was
        learned.
        """
        sample = sample_frames(recording, n_frames)
        camera = recording.camera
        scene = NearestScene(camera, Floor.from_plane(_FLAT, 1000.0, camera), view, *range_mm)
        crops = scene.extract(sample, 1.0)
        if not crops.found.any():
            raise EstimationError(
                f"no hand was found in {len(sample)} frames spread over the recording: nothing of "
                f"a hand's size lies between {range_mm[0]:g} and {range_mm[1]:g} mm; check the "
                "depth unit, foreground.near_mm and far_mm"
            )
        seen = crops.moments[crops.found]
        floor = Floor.from_plane(_FLAT, float(np.median(crops.distance[crops.found])), camera)
        return replace(
            scene,
            floor=floor,
            area_mm2=float(np.median(seen[:, 1])),
            volume_mm3=float(np.median(seen[:, 2])),
        ), sample

    def misfit(self, crops: Crops) -> Array:
        """How unlike the hand each crop (n) is in area and volume: the square of a number of
        standard deviations.
        """
        area = np.maximum(crops.moments[:, 1], 1.0)
        volume = np.maximum(crops.moments[:, 2], 1.0)
        return (np.log(area / self.area_mm2) / _AREA_SD) ** 2 + (
            np.log(volume / self.volume_mm3) / _VOLUME_SD
        ) ** 2

    def looks(self, crops: Crops, camera_view: bool = False) -> Array:
        """How each height map was cut (n, 17): intrinsics, T_view_camera, origin and step of the
        crop.
        """
        return looks_of(crops, self._intrinsics(len(crops.step)), camera_view)

    def planes(self, crops: Crops, camera_view: bool = False) -> Array:
        """The plane (n, 3) above which each height map is measured: 1 / z = a u + b v + c in pixels
        of the picture.
        """
        looks = self.looks(crops, camera_view)
        planes = np.empty((len(looks), 3))
        kernels.view_planes(looks, planes)
        return planes

    def middles(self, crops: Crops, camera_view: bool = False) -> Array:
        """The middle (n, 3) mm of what each crop shows, in the arena frame."""
        T_camera_view = view_of(self.looks(crops, camera_view)).inverse()
        middle = (
            np.einsum("nij,nj->ni", T_camera_view.rotation, crops.centroid)
            + T_camera_view.translation
        )
        return self.floor.T_arena_camera @ middle

    def _extract(
        self,
        depths: NDArray[np.float32],
        size: float,
        parallel: bool,
        camera_view: bool,
        n_things: int,
    ) -> Crops:
        """See `Cutter`: the nearest things of a hand's size. Heights are measured along the line of
        sight through the middle of the crop, from behind_mm (at home size) behind the hand's
        middle; camera_view: along the optical axis.
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
                n_things,
            )

    def every(self, step: int) -> NearestScene:
        """The same with every `step`-th pixel along rows and columns."""
        camera = self.camera.every(step)
        return replace(
            self, camera=camera, floor=Floor.from_plane(_FLAT, self.floor.distance_mm, camera)
        )

    def _intrinsics(self, n: int) -> Array:
        c = self.camera
        return np.broadcast_to(np.array([c.fx, c.fy, c.cx, c.cy]), (n, 4)).copy()


@dataclass(frozen=True)
class NearestWindows:
    """Parts of pictures from many cameras (n), each around one hand; the counterpart of
    `crops.Windows`.

    depth (n, H, W) mm, 0 = unread; intrinsics (n, 4) fx fy cx cy, pixels of the whole picture;
    origin (n, 2) picture pixel of each window's first.
    """

    depth: NDArray[np.uint16]
    intrinsics: Array
    origin: Array
    view: View

    def extract(
        self, size: Array, camera_view: bool = False, n_things: int = 1
    ) -> tuple[Crops, Array]:
        """The hands and their looks (n, 17) in pixels of the windows; see `NearestScene`. n_things:
        2 gives as many rows again, of what may be a hand as well.
        """
        intrinsics = self.intrinsics.copy()
        intrinsics[:, 2:] -= (
            self.origin
        )  # a window is the picture of a camera whose centre is shifted
        crops = cut_nearest(
            self.depth, intrinsics, size, self.view, RANGE_MM, camera_view, n_things
        )
        return crops, looks_of(crops, np.tile(intrinsics, (n_things, 1)), camera_view)


def cut_nearest(
    depths: NDArray[np.float32] | NDArray[np.uint16],
    intrinsics: Array,
    size: Array,
    view: View,
    range_mm: tuple[float, float],
    camera_view: bool,
    n_things: int,
) -> Crops:
    """Height maps of the hands in pictures (n, H, W) mm; intrinsics (n, 4), size (n,). n_things: 2
    gives as many rows again, of what may be a hand as well.

    The long axis among the moments points away from the arm, where one is seen.
    """
    crops = Crops.blank(n_things * len(depths), 1000.0)
    kernels.extract_all(
        depths,
        *range_mm,
        n_things,
        size,
        size * view.behind_mm,
        size * view.smooth_mm,
        intrinsics,
        camera_view,
        crops.heights,
        crops.origin,
        crops.step,
        crops.n_px,
        crops.moments,
        crops.distance,
        crops.n_blobs,
    )
    return crops


def looks_of(crops: Crops, intrinsics: Array, camera_view: bool) -> Array:
    """How each height map was cut (n, 17), for intrinsics (n, 4)."""
    looks = np.empty((len(crops.step), 17))
    kernels.fill_looks(
        intrinsics, crops.origin, crops.step, crops.distance, CROP, camera_view, looks
    )
    return looks


def sight_rotations(p_camera: Array) -> Array:
    """Rotations (n, 3, 3) of T_view_camera for lines of sight through points (n, 3), camera
    frame.
    """
    rotations = np.empty((len(p_camera), 3, 3))
    for rotation, (x, y, z) in zip(rotations, p_camera, strict=True):
        kernels.sight_rotation(x / z, y / z, rotation)
    return rotations
