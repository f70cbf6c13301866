"""Background subtraction with a learned depth background, and choice of the animal's component.

A pixel is foreground if its reading is nearer than

    limit = background - max(min_height_mm, 3 spread),

where `background` is the farthest mode of the pixel's readings over time and `spread` the standard
deviation of that mode (see `background`); pixels of the floor without a mode use the fitted floor
plane. Foreground pixels are connected to 8-connected components of 4 x 4 blocks; the animal is the
component whose area is nearest to the one that recurs in the most frames. The kernels cut its
height map and image moments (see `height_maps`). `find_resting_animal` finds an animal that is at
rest, wholly or in part, and therefore absorbed into the background.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from liex_lab.body.skeleton import MOUSE_VIEW, VIEWS, CameraView
from liex_lab.optics.camera import Camera, SensorCard
from liex_lab.runtime.memory import check_shapes
from liex_lab.runtime.processes import in_parallel, threads
from liex_lab.scene import _height_map_kernels as kernels
from liex_lab.scene._blob_kernels import MAX_BLOBS
from liex_lab.scene.background import FloorLevel, SceneChange
from liex_lab.scene.changing_ground import ChangingGround, RaisedGround
from liex_lab.scene.floor import Array, Depths, Floor, Mask
from liex_lab.scene.height_maps import (
    N_OBJECTS,
    HeightMaps,
    Segmenter,
    pack_crop_cameras,
    size_misfit,
)
from liex_lab.scene.scene import Fixture, Scene, find_fixtures, region_corners, roughness
from liex_lab.scene.support_plane import SupportPlane
from liex_lab.scene.worn import Cable, Worn

AnyNumber = TypeVar("AnyNumber", bound=np.generic)


@dataclass(frozen=True)
class BackgroundSubtraction(Segmenter):
    """The empty scene of one camera, and the depth limit of the foreground.

    Attributes:
        camera: the ideal pinhole camera of the recording.
        floor: the floor plane in that camera's frame.
        background: (H, W) float32 mm, depth of the empty scene, 0 where unknown.
        limit: (H, W) float32 mm; a reading below it is foreground.
        on_floor: (H, W) bool, the visible floor: an animal stands on it with at least a part of its
            body.
        area_mm2: the animal's usual area from above, mm^2; 0 while unknown.
        volume_mm3: the animal's usual volume under its back, mm^3; 0 while unknown.
        view: how such animals are viewed.
        stride: step between analysed rows and columns of the image; H and W count those.
        support_plane: how the floor was found; None if it was given.
        worn: how worn devices are separated from the animal, in the order of their removal.
        level: reference level of the floor; None if it does not drift.
        changed: a lasting change of the scene that may make measurements wrong; None without one.
        ground: where the ground changes, to which frames are brought with `levelled` before
            `extract`; None if it does not.
        sensor: quality of its readings; None without a sample.
        transient_objects: objects that stand on the floor for a part of the recording.
        n_animals: how many animals are in view at once in the sampled frames.
        n_animals_share: share of the frames with an animal in which as many stand free.
    """

    camera: Camera
    floor: Floor
    background: Depths
    limit: Depths
    on_floor: Mask
    area_mm2: float = 0.0
    volume_mm3: float = 0.0
    view: CameraView = MOUSE_VIEW
    stride: int = 1
    support_plane: SupportPlane | None = None
    level: FloorLevel | None = None
    worn: tuple[Worn, ...] = ()
    changed: SceneChange | RaisedGround | ChangingGround | None = None
    ground: ChangingGround | None = None
    sensor: SensorCard | None = None
    transient_objects: tuple[Fixture, ...] = ()
    n_animals: int = 1
    n_animals_share: float = 1.0

    @cached_property
    def grid(self) -> Camera:
        """The camera of the analysed pixels: every `stride`-th of the image."""
        return self.camera.every(self.stride)

    @cached_property
    def grid_floor(self) -> Floor:
        """The floor in pixels of that camera."""
        return self.floor if self.stride == 1 else self.floor.for_camera(self.grid)

    @cached_property
    def bare(self) -> Depths:
        """(H, W) float32 mm, depth of the floor's plane in the analysed pixels."""
        return self.grid_floor.depth(self.grid.width, self.grid.height)

    def described(self) -> Scene:
        """The scene as written to session.json, without its outline."""
        fixtures = find_fixtures(self.background, self.grid_floor, self.grid, self.on_floor)
        described = Scene(
            self.floor,
            roughness_mm=roughness(self.background, self.bare, self.on_floor),
            fixtures=(*fixtures, *self.transient_objects),
            doubts=self.doubts,
            wander_mm=None if self.level is None else self.level.wander_mm,
            thin_above=any(isinstance(device, Cable) for device in self.worn),
            sensor=self.sensor,
            ground_changes_s=() if self.ground is None else self.ground.changes_s,
        )
        found = self.support_plane
        if found is None:
            return described
        return replace(
            described,
            floor_from=found.origin,
            floor_support=found.support if found.moves else None,
            n_moving=found.n_moving,
            n_animals=self.n_animals if found.n_moving else 0,
            n_animals_share=self.n_animals_share,
            region_px=region_corners(found.region, self.stride),
            doubts=(*filter(None, [found.doubt]), *self.doubts),
        )

    def every(self, step: int) -> Self:
        """The same segmenter for images of every `step`-th row and column."""
        camera = self.camera.every(step)
        cut = (slice(None, None, step), slice(None, None, step))
        return replace(
            self,
            camera=camera,
            floor=self.floor.for_camera(camera),
            background=np.ascontiguousarray(self.background[cut]),
            limit=np.ascontiguousarray(self.limit[cut]),
            on_floor=np.ascontiguousarray(self.on_floor[cut]),
            level=None if self.level is None else self.level.every(step),
            worn=tuple(device.every(step) for device in self.worn),
        )

    def misfit(self, crops: HeightMaps) -> Array:
        """See `Segmenter`.

        An animal that swims or is lifted is judged by its area alone, as the space below it is not
        its own.
        """
        # of the logarithms, from posture to posture of one animal
        return size_misfit(
            crops,
            self.area_mm2,
            self.volume_mm3 if self.view.frame == VIEWS[0] else None,
            (0.25, 0.2),
        )

    def view_rotation(self, camera_view: bool) -> Array:
        """Rotation (3, 3) of T_view_camera: the arena's, or that of an upright camera frame.

        Args:
            camera_view: whether heights are measured along the optical axis.
        """
        return np.diag([1.0, -1.0, -1.0]) if camera_view else self.floor.T_arena_camera.rotation

    def planes(self, crops: HeightMaps, camera_view: bool = False) -> Array:
        """The reference plane of each height map: the floor, one above it or behind the animal.

        Args:
            crops: n height maps.
            camera_view: as they were extracted.

        Returns:
            (n, 3) a, b, c of 1 / z = a u + b v + c, per mm, u and v in image pixels.
        """
        if not camera_view:
            higher = self.floor.distance_mm / crops.distance  # 1 on the floor
            return higher[:, None] * self.floor.inverse_depth
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
        if not camera_view:
            middle[:, 2] += self.floor.distance_mm - crops.distance
        else:  # the view's frame is not the arena's
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
        drift = (
            ()
            if self.level is None
            else (
                f"the depth of the floor drifted by {self.level.wander_mm:.1f} mm, as of a sensor "
                "that warms up, and was corrected to its initial value",
            )
        )
        followed = () if self.ground is None or self.changed else (self.ground.sentence,)
        return (*(device.remark for device in self.worn), *drift, *followed)

    @property
    def doubts(self) -> tuple[str, ...]:
        """Whether the camera was displaced, or the scene or its ground changed."""
        return () if self.changed is None else (self.changed.sentence,)

    def levelled(self, depths: Depths, times_ns: NDArray[np.int64]) -> Depths:
        """See `Segmenter`; without a ground that changes, the same images."""
        if self.ground is None:
            return depths
        return self.ground.levelled(depths[:, :: self.stride, :: self.stride], times_ns)

    def cleared(self, depths: Depths) -> Depths:
        """Full images without worn cables, 0 there.

        The bars of a lid remain, as they hide the animal but are not worn.

        Args:
            depths: (n, H, W) float32 mm, full images, or a sample at the scene's own stride.
        """
        if not self.worn:
            return depths
        step = 1 if depths.shape[1:] == self.limit.shape else self.stride
        thinned = depths[:, ::step, ::step]
        worn = np.any([device.worn(thinned, self.limit) for device in self.worn], axis=0)
        return np.where(at_every_pixel(worn, step, depths.shape[1:]), np.float32(0), depths)

    def animal_masks(self, crops: HeightMaps) -> list[Mask]:
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
        depths: Depths,
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
        in_parallel(
            kernels.blob_areas,
            len(depths),
            depths,
            self.limit,
            self.on_floor,
            bridge,
            1.0 / (self.grid.fx * self.grid.fy),
            areas,
        )
        low = self.view.area[0] * spine_mm[0] ** 2
        high = self.view.area[1] * spine_mm[1] ** 2
        for other in without_mm2:
            areas[np.abs(np.log(np.maximum(areas, 1e-9) / other)) < np.log(1.5)] = 0.0
        candidates = np.sort(areas[(areas > low) & (areas < high)])
        if not len(candidates):
            return 0.0, 0.0
        tried = candidates[
            np.linspace(0, len(candidates) - 1, min(200, len(candidates))).astype(int)
        ]
        distance = np.abs(np.log(np.maximum(areas, 1e-9)[None] / tried[:, None, None])).min(axis=2)
        support = np.exp(-0.5 * (distance / 0.35) ** 2).sum(axis=1)
        return float(tried[np.argmax(support)]), float(
            (distance[np.argmax(support)] < np.log(kernels.AREA_FACTOR)).mean()
        )

    def usual_volume(self, depths: Depths) -> float:
        """The animal's median volume, mm^3, over frames in which nothing else has a similar area.

        If fewer than 5 frames qualify, all frames with the animal count.

        Args:
            depths: (n, H, W) float32 mm, frames at this scene's stride.
        """
        crops = self.extract(depths, 1.0)
        volume, n_blobs = crops.blobs.volume_mm3, crops.n_blobs
        alone = n_blobs == 1 if (n_blobs == 1).sum() >= 5 else n_blobs > 0
        return float(np.median(volume[alone]))

    def _check(self, depths: Depths) -> None:
        """Refuse frames whose size differs from that of the scene."""
        check_shapes("frames of this scene", ("depths", depths, ("n", *self.limit.shape)))

    def extract(
        self,
        depths: Depths,
        size: float,
        parallel: bool = True,
        camera_view: bool = False,
        n_candidates: int = 1,
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
            depths = np.ascontiguousarray(depths[:, :: self.stride, :: self.stride])
        self._check(depths)
        if self.level is not None:
            depths = self.level.brought_back(depths)
        for device in self.worn:
            depths = device.cut(depths, self.limit)
        n_ranks = N_OBJECTS if n_candidates > 1 else 1
        crops = HeightMaps.blank(n_ranks * len(depths), self.floor.distance_mm)
        grid = self.grid
        with threads(parallel):
            in_parallel(
                kernels.extract_all,
                len(depths),
                depths,
                self.limit,
                self.on_floor,
                self.area_mm2,
                n_ranks,
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
        if n_ranks == 1:
            return crops
        n = len(depths)
        objects = np.full((n_ranks * n, 4), np.nan)
        found = np.flatnonzero(crops.moments[:, 0] > 0)
        objects[found, :3] = self.middles(crops[found], camera_view)
        objects[found, 3] = crops.blobs.area_mm2[found]
        crops.objects[:] = np.tile(
            objects.reshape(n_ranks, n, 4).transpose(1, 0, 2), (n_ranks, 1, 1)
        )
        return crops[: n_candidates * n]


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
