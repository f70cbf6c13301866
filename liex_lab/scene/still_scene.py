"""The empty scene of one camera, and segmentation of the animal in front of it.

A pixel is foreground if its reading is nearer than the scene's limit. Foreground pixels are
connected to 8-connected components of 4 x 4 blocks; the animal is the component whose area is
nearest to the animal's usual one. The kernels cut its height map and image moments (see
`height_maps`). `background_segmenter` learns the scene from a recording.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from liex_lab.body.skeleton import MOUSE_VIEW, VIEWS, CameraView
from liex_lab.optics.camera import Camera, SensorCard
from liex_lab.runtime.shapes import check_shapes
from liex_lab.runtime.threads import threads
from liex_lab.scene import _height_map_kernels as kernels
from liex_lab.scene._blob_kernels import MAX_BLOBS
from liex_lab.scene.background import FloorLevel
from liex_lab.scene.floor import Floor
from liex_lab.scene.height_maps import HeightMaps, Segmenter, pack_crop_cameras
from liex_lab.scene.scene import Fixture, Scene, find_fixtures, region_corners, roughness
from liex_lab.scene.support_plane import SupportPlane
from liex_lab.scene.worn import Cable, HeadStage

Array = NDArray[np.float64]

_N_PARTS = 4
_LEAST_FRAMES = 8  # of a part
_N_PIXELS = 10_000
_ELSEWHERE_MM = 12.0  # exceeds the drift and noise that remain in a median
_LEAST_SHARE = 0.06  # of the readings
_LEAST_ANIMALS = 4.0  # in areas of the animal, whose own movement changes up to two


@dataclass(frozen=True)
class SceneChange:
    """A lasting change of the still scene.

    Attributes:
        at_s: when it happened, s since the first frame.
        share: of the readable image that changed.
    """

    at_s: float
    share: float

    @staticmethod
    def find(
        sample: NDArray[np.float32], times_s: Array, camera: Camera, area_mm2: float
    ) -> SceneChange | None:
        """Find the change of a recording from frames spread over it.

        Args:
            sample: (n, H, W) float32 mm, the frames, 0 where unread.
            times_s: (n,) of the frames, s since the first.
            camera: of those pixels.
            area_mm2: the animal's usual area seen from above, mm^2.

        Returns:
            The change; None if the scene does not change, or too few frames are given.
        """
        check_shapes("frames", ("sample", sample, ("n", "H", "W")), ("times_s", times_s, ("n",)))
        n_parts = min(_N_PARTS, len(sample) // _LEAST_FRAMES)
        if n_parts < 2:
            return None
        step = max(1, int(np.sqrt(sample[0].size / _N_PIXELS)))
        depths = sample[:, ::step, ::step].reshape(len(sample), -1)
        usual = [_usual(part) for part in np.array_split(depths, n_parts)]
        found = None
        for a, b in [*zip(range(n_parts), range(1, n_parts), strict=False), (0, n_parts - 1)]:
            read = (usual[a] > 0) & (usual[b] > 0)
            changed_px = read & (np.abs(usual[b] - usual[a]) > _ELSEWHERE_MM)
            share = float(changed_px.sum() / max(read.sum(), 1))
            pixels_mm2 = (step * usual[a][changed_px].astype(float)) ** 2 / (camera.fx * camera.fy)
            is_more = share > (found[0] if found else _LEAST_SHARE)
            if is_more and pixels_mm2.sum() > _LEAST_ANIMALS * area_mm2:
                found = share, usual[a][changed_px], usual[b][changed_px], changed_px
        if found is None:
            return None
        share, before, after, changed_px = found
        readings = depths[:, changed_px]
        is_after = (np.abs(readings - after) < np.abs(readings - before)).mean(axis=1) > 0.5
        since = int(np.argmax(is_after & np.append(is_after[1:], True)))
        return SceneChange(float(times_s[since]), share)

    @property
    def sentence(self) -> str:
        """The change in words."""
        return (
            f"the camera was displaced or its scene rearranged at {self.at_s:.1f} s "
            f"({self.share:.0%} of the image changed): cut the recording there"
        )


def _usual(depths: NDArray[np.float32]) -> NDArray[np.float32]:
    """The median (P,) of the readings in frames (n, P), mm; 0 where most are unread."""
    n_read = (depths > 0).sum(axis=0)
    # unread pixels come first
    row = np.minimum(len(depths) - (n_read + 1) // 2, len(depths) - 1)
    median = np.take_along_axis(np.sort(depths, axis=0), row[None], axis=0)[0]
    return np.where(2 * n_read >= len(depths), median, np.float32(0))


AnyNumber = TypeVar("AnyNumber", bound=np.generic)

# of the logarithms, from posture to posture of one animal
_AREA_SD = 0.25
_VOLUME_SD = 0.2
_ALIKE = np.log(1.5)  # areas that differ by less belong to one object


@dataclass(frozen=True)
class StillScene(Segmenter):
    """The empty scene of one camera, and the depth limit of the foreground.

    Attributes:
        camera: the ideal pinhole camera of the recording.
        floor: the floor plane in that camera's frame.
        background: (H, W) float32 mm, depth of the empty scene, 0 where unknown.
        limit: (H, W) float32 mm; a reading below it is foreground.
        on_floor: (H, W) bool, the visible floor: an animal stands on it with at least a part of its
            body.
        area_mm2: the animal's usual area seen from above, mm^2; 0 while unknown.
        volume_mm3: the animal's usual volume under its back, mm^3; 0 while unknown.
        view: how such animals are viewed.
        stride: step between analysed rows and columns of the image; H and W count those.
        support_plane: how the floor was found; None if it was given.
        cable: how cables are separated from the animal; None without one.
        stage: how a head stage is separated from it; None without one.
        level: reference level of the floor; None if it does not drift.
        changed: a lasting change of the scene; None without one.
        sensor: quality of its readings; None without a sample.
        transient_objects: objects that stand on the floor for a part of the recording.
    """

    camera: Camera
    floor: Floor
    background: NDArray[np.float32]
    limit: NDArray[np.float32]
    on_floor: NDArray[np.bool_]
    area_mm2: float = 0.0
    volume_mm3: float = 0.0
    view: CameraView = MOUSE_VIEW
    stride: int = 1
    support_plane: SupportPlane | None = None
    level: FloorLevel | None = None
    cable: Cable | None = None
    stage: HeadStage | None = None
    changed: SceneChange | None = None
    sensor: SensorCard | None = None
    transient_objects: tuple[Fixture, ...] = ()

    @cached_property
    def grid(self) -> Camera:
        """The camera of the analysed pixels: every `stride`-th of the image."""
        return self.camera.every(self.stride)

    @cached_property
    def grid_floor(self) -> Floor:
        """The floor in pixels of that camera."""
        if self.stride == 1:
            return self.floor
        return Floor.from_plane(self.floor.normal, self.floor.distance_mm, self.grid)

    def described(self) -> Scene:
        """The scene as written to session.json, without its outline."""
        floor = self.grid_floor
        bare = floor.depth(self.grid.width, self.grid.height)
        described = Scene(
            self.floor,
            roughness_mm=roughness(self.background, bare, self.on_floor),
            fixtures=(
                *find_fixtures(self.background, floor, self.grid, self.on_floor),
                *self.transient_objects,
            ),
            doubts=self.doubts,
            wander_mm=None if self.level is None else self.level.wander_mm,
            thin_above=self.cable is not None,
            sensor=self.sensor,
        )
        support_plane = self.support_plane
        if support_plane is None:
            return described
        return replace(
            described,
            floor_from=support_plane.origin,
            floor_support=support_plane.support if support_plane.moves else None,
            n_moving=support_plane.n_moving,
            n_animals=support_plane.n_together,
            region_px=region_corners(support_plane.region, self.stride),
            doubts=((support_plane.doubt,) if support_plane.doubt else ()) + self.doubts,
        )

    def every(self, step: int) -> Self:
        """The same segmenter for images of every `step`-th row and column."""
        camera = self.camera.every(step)
        cut = (slice(None, None, step), slice(None, None, step))
        floor = Floor.from_plane(self.floor.normal, self.floor.distance_mm, camera)
        return replace(
            self,
            camera=camera,
            floor=floor,
            background=np.ascontiguousarray(self.background[cut]),
            limit=np.ascontiguousarray(self.limit[cut]),
            on_floor=np.ascontiguousarray(self.on_floor[cut]),
            level=None if self.level is None else self.level.every(step),
            cable=None if self.cable is None else self.cable.every(step),
            stage=None if self.stage is None else self.stage.every(step),
        )

    def misfit(self, crops: HeightMaps) -> Array:
        """How unlike the animal each height map (n,) is in size: squared standard deviations.

        The sum of ((log a - log a0) / 0.25)^2 over area and ((log v - log v0) / 0.2)^2 over volume,
        where the deviations are those between postures of one animal. An animal that swims or is
        lifted is judged by its area alone, as the space below it is not its own.

        Args:
            crops: n height maps.
        """
        area = np.maximum(crops.blobs.area_mm2, 1.0)
        volume = np.maximum(crops.blobs.volume_mm3, 1.0)
        if self.view.frame != VIEWS[0]:
            return (np.log(area / self.area_mm2) / _AREA_SD) ** 2
        return (np.log(area / self.area_mm2) / _AREA_SD) ** 2 + (
            np.log(volume / self.volume_mm3) / _VOLUME_SD
        ) ** 2

    def view_rotation(self, camera_view: bool) -> Array:
        """Rotation (3, 3) of T_view_camera: the arena's, or that of an upright camera frame.

        Args:
            camera_view: whether heights are measured along the optical axis.
        """
        return np.diag([1.0, -1.0, -1.0]) if camera_view else self.floor.T_arena_camera.rotation

    def planes(self, crops: HeightMaps, camera_view: bool = False) -> Array:
        """The reference plane of each height map: the floor, or one behind the animal.

        Args:
            crops: n height maps.
            camera_view: as they were extracted.

        Returns:
            (n, 3) a, b, c of 1 / z = a u + b v + c, per mm, u and v in image pixels.
        """
        if not camera_view:
            return np.tile(self.floor.inverse_depth, (len(crops.step), 1))
        level = np.zeros((len(crops.step), 3))
        level[:, 2] = 1.0 / crops.distance
        return level

    def middles(self, crops: HeightMaps, camera_view: bool = False) -> Array:
        """The centroid (n, 3) mm of each height map, in the arena frame.

        Args:
            crops: n height maps.
            camera_view: as they were extracted.
        """
        middle = crops.centroid
        if camera_view:  # the view's frame is not the arena's
            middle[:, 2] -= crops.distance
            middle = self.floor.T_arena_camera @ (middle @ self.view_rotation(camera_view))
        return middle

    def crop_cameras(self, crops: HeightMaps, camera_view: bool = False) -> Array:
        """The crop cameras of height maps: intrinsics, T_view_camera, origin and step of each crop.

        Args:
            crops: n height maps.
            camera_view: as they were extracted.

        Returns:
            (n, 17), packed as `CropCamera`.
        """
        camera = self.camera
        return pack_crop_cameras(
            np.array([camera.fx, camera.fy, camera.cx, camera.cy]),
            self.view_rotation(camera_view),
            crops.distance,
            crops.origin,
            crops.step,
        )

    @property
    def remarks(self) -> tuple[str, ...]:
        """Corrections applied to the images, in sentences."""
        remarks = []
        if self.cable is not None:
            remarks.append(
                "something thin above the animal, a cable or bars, was removed from the images"
            )
        if self.stage is not None:
            remarks.append("a head stage on the animal was removed from the images")
        if self.level is not None:
            remarks.append(
                f"the depth of the floor drifted by {self.level.wander_mm:.1f} mm, as of a sensor "
                "that warms up, and was corrected to its initial value"
            )
        return tuple(remarks)

    @property
    def doubts(self) -> tuple[str, ...]:
        """Whether the camera was displaced or the scene rearranged during the recording."""
        return () if self.changed is None else (self.changed.sentence,)

    def cleared(self, depths: NDArray[np.float32]) -> NDArray[np.float32]:
        """Full images without worn cables, 0 there.

        The bars of a lid remain, as they hide the animal but are not worn.

        Args:
            depths: (n, H, W) float32 mm, full images, or a sample at the scene's own stride.
        """
        if self.cable is None:
            return depths
        step = 1 if depths.shape[1:] == self.limit.shape else self.stride
        worn = self.cable.worn(depths[:, ::step, ::step], self.limit)
        return np.where(at_every_pixel(worn, step, depths.shape[1:]), np.float32(0), depths)

    def animal_masks(self, crops: HeightMaps) -> list[NDArray[np.bool_]]:
        """The animal's pixels (H, W) bool in each frame that shows it.

        Args:
            crops: of frames at this scene's stride, see `extract`.
        """
        masks = []
        for i in np.flatnonzero(crops.found):
            rows, columns = np.nonzero(crops.heights[i])
            step, (u, v) = crops.step[i] // self.stride, crops.origin[i] // self.stride
            own = np.zeros(self.limit.shape, np.bool_)
            own[v + step * rows, u + step * columns] = True
            masks.append(own)
        return masks

    def usual_area(
        self,
        depths: NDArray[np.float32],
        spine_mm: tuple[float, float],
        without_mm2: Sequence[float] = (),
    ) -> tuple[float, float]:
        """The component area that recurs in most frames, and the share of frames that contain it.

        The animal has nearly constant size and is in nearly every frame; other objects appear,
        disappear or differ in size. The result is the mode of a kernel density over the logarithm
        of area, to which each frame adds its nearest component with a Gaussian kernel of standard
        deviation 0.35.

        Args:
            depths: (n, H, W) float32 mm, frames at this scene's stride.
            spine_mm: lengths of the smallest and the largest expected animal, mm; they bound the
                area.
            without_mm2: areas to exclude, with those within a factor of 1.5.

        Returns:
            The area, mm^2, and the share (0 to 1) of frames with a component within a factor of 4
            of it; both 0 if no component has an animal's size.
        """
        self._check(depths)
        areas = np.zeros((len(depths), MAX_BLOBS))
        bridge = 0 if self.view.frame == VIEWS[0] else kernels.BRIDGE
        kernels.blob_areas(
            depths, self.limit, self.on_floor, bridge, 1.0 / (self.grid.fx * self.grid.fy), areas
        )
        low = self.view.area[0] * spine_mm[0] ** 2
        high = self.view.area[1] * spine_mm[1] ** 2
        for other in without_mm2:
            areas[np.abs(np.log(np.maximum(areas, 1e-9) / other)) < _ALIKE] = 0.0
        candidates = np.sort(areas[(areas > low) & (areas < high)])
        if not len(candidates):
            return 0.0, 0.0
        tried = candidates[
            np.linspace(0, len(candidates) - 1, min(200, len(candidates))).astype(int)
        ]
        distance = np.abs(np.log(np.maximum(areas, 1e-9)[None] / tried[:, None, None])).min(axis=2)
        support = np.exp(-0.5 * (distance / 0.35) ** 2).sum(axis=1)
        best = tried[np.argmax(support)]
        return float(best), float(
            (distance[np.argmax(support)] < np.log(kernels.AREA_FACTOR)).mean()
        )

    def usual_volume(self, depths: NDArray[np.float32]) -> float:
        """The animal's median volume, mm^3, over frames in which nothing else has a similar area.

        If fewer than 5 frames qualify, all frames with the animal count.

        Args:
            depths: (n, H, W) float32 mm, frames at this scene's stride.
        """
        volume = np.zeros(len(depths))
        n_blobs = np.zeros(len(depths), np.int64)
        for start in range(0, len(depths), 16):
            crops = self.extract(depths[start : start + 16], 1.0)
            volume[start : start + 16] = crops.blobs.volume_mm3
            n_blobs[start : start + 16] = crops.n_blobs
        alone = n_blobs == 1 if (n_blobs == 1).sum() >= 5 else n_blobs > 0
        return float(np.median(volume[alone]))

    def _check(self, depths: NDArray[np.float32]) -> None:
        """Refuse frames whose size differs from that of the scene."""
        check_shapes("frames of this scene", ("depths", depths, ("n", *self.limit.shape)))

    def _extract(
        self,
        depths: NDArray[np.float32],
        size: float,
        parallel: bool,
        camera_view: bool,
        n_candidates: int,
    ) -> HeightMaps:
        """Height maps of the components whose areas are nearest to the animal's own.

        Heights are measured above the floor, or (camera_view) from the view's behind_mm behind the
        animal's mean depth, as in the paper's features.

        Args:
            depths: (n, H, W) float32 mm, full images, or a sample at the scene's own stride.
            size: the animal's spine length over the skeleton's home length; scales the smoothing.
            parallel: whether to use all threads.
            camera_view: whether heights are measured along the optical axis.
            n_candidates: per frame, 1 or 2.

        Returns:
            The rows (n) of the best components, then (n_candidates 2) those of the second best;
            origin, step and n_px are in pixels of the full image.
        """
        if depths.shape[1:] != self.limit.shape:
            depths = depths[:, :: self.stride, :: self.stride]
        self._check(depths)
        if self.level is not None:
            depths = self.level.brought_back(depths)
        if self.cable is not None:
            depths = self.cable.cut(depths, self.limit)
        if self.stage is not None:
            depths = self.stage.cut(depths, self.limit)
        crops = HeightMaps.blank(n_candidates * len(depths), self.floor.distance_mm)
        grid = self.grid
        with threads(parallel):
            kernels.extract_all(
                depths,
                self.limit,
                self.on_floor,
                self.area_mm2,
                n_candidates,
                camera_view,
                kernels.Sight(
                    np.array([grid.fx, grid.fy, grid.cx, grid.cy]),
                    self.grid_floor.inverse_depth,
                    self.view_rotation(camera_view),
                    behind_mm=self.view.behind_mm if camera_view else 0.0,
                    smooth_mm=self.view.smooth_mm * size,
                ),
                crops.rows,
            )
        if self.stride > 1:  # in pixels of the full image
            for values, factor in ((crops.origin, 1), (crops.step, 1), (crops.n_px, self.stride)):
                values *= self.stride * factor
        return crops


def at_every_pixel(
    values: NDArray[AnyNumber], step: int, shape: tuple[int, ...]
) -> NDArray[AnyNumber]:
    """Values of every `step`-th pixel, repeated for all pixels of the image.

    Args:
        values: (..., h, w) of every `step`-th row and column.
        step: at least 1.
        shape: (H, W) of the image.

    Returns:
        (..., H, W) the values.
    """
    for axis in (-2, -1):
        values = np.repeat(values, step, axis=axis)
    return values[..., : shape[0], : shape[1]]
