"""Background subtraction with a learned depth background, and choice of the animal's component.

A pixel is foreground where its reading is nearer than

    limit = background - max(min_height_mm, 3 spread),

where `background` is the farthest mode of the pixel's readings over time and `spread` the standard
deviation of that mode (see `background`); where no mode is known on the floor, the plane fitted to
the floor takes over. Segmenter pixels are joined to 8-connected components of 4 x 4 blocks; the
animal is the component whose area comes nearest to the one that recurs in the most frames, and its
height map and image moments are cut by the kernels (see `height_maps`). A part of the animal that
kept still and so was absorbed into the background (the "sleeping person" problem) is found as a
lump on the floor that the moving animal touches in nearly every frame.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from liex_lab.arena.floor import Floor
from liex_lab.arena.scene import Scene, find_fixtures, region_corners, roughness
from liex_lab.body.skeleton import MOUSE_VIEW, VIEWS, View
from liex_lab.errors import EstimationError
from liex_lab.foreground import _height_map_kernels as kernels
from liex_lab.foreground._blob_kernels import MAX_BLOBS
from liex_lab.foreground.background import learn_background, sample_frames, stride_for
from liex_lab.foreground.crop_camera import pack_crop_cameras
from liex_lab.foreground.height_maps import HeightMaps
from liex_lab.foreground.segmenter import Segmenter
from liex_lab.foreground.standing import Standing, find_standing
from liex_lab.optics.camera import Camera
from liex_lab.recordings.recording import Recording
from liex_lab.runtime.shapes import check_shapes
from liex_lab.runtime.threads import threads

Array = NDArray[np.float64]

SPREADS = 3.0  # an animal stands out by this many standard deviations of the background's own noise
# of the logarithms, from posture to posture of one animal
_AREA_SD = 0.25
_VOLUME_SD = 0.2
# of the frames: a lump that the animal touches that often is a part of it that keeps still
_TOUCH_SHARE = 0.9
_OTHER = 3.0  # times larger or smaller is another thing
# what was never seen moving is an animal only if it is no longer than so many largest spines,
# higher than so many times what stands out at all, and larger than so many of the least areas
_LONGEST = 2.0
_HIGHER = 1.4
_LARGER = 1.5


@dataclass(frozen=True)
class BackgroundSubtraction(Segmenter):
    """The empty scene of one camera, and the depth nearer than which a reading is the animal.

    Attributes:
        camera: the ideal pinhole camera of the recording.
        floor: the floor plane in that camera's frame.
        background: (H, W) float32 mm, depth of the empty scene, 0 where unknown.
        limit: (H, W) float32 mm; a reading below it is in front of the background.
        on_floor: (H, W) bool, the floor, under which nothing lies, as far as the picture shows it:
            an animal stands on it with at least a part of its body.
        area_mm2: the animal's usual area seen from above, mm^2; 0 while unknown.
        volume_mm3: the animal's usual volume under its back, mm^3; 0 while unknown.
        view: how such animals are looked at.
        stride: only every so many-th row and column of the picture is looked at; H and W count
            those.
        standing: how the floor was found, None where it was given.
    """

    camera: Camera
    floor: Floor
    background: NDArray[np.float32]
    limit: NDArray[np.float32]
    on_floor: NDArray[np.bool_]
    area_mm2: float = 0.0
    volume_mm3: float = 0.0
    view: View = MOUSE_VIEW
    stride: int = 1
    standing: Standing | None = None

    @cached_property
    def grid(self) -> Camera:
        """The camera whose pixels are looked at: every `stride`-th of the picture."""
        return self.camera.every(self.stride)

    @cached_property
    def _grid_floor(self) -> Floor:
        """The floor as that camera sees it."""
        if self.stride == 1:
            return self.floor
        return Floor.from_plane(self.floor.normal, self.floor.distance_mm, self.grid)

    @staticmethod
    def from_floor(
        camera: Camera, floor: Floor, min_height_mm: float = 7.0
    ) -> BackgroundSubtraction:
        """A segmenter that knows nothing but the floor; the background is the bare plane.

        Args:
            camera: the ideal pinhole camera.
            floor: the floor plane in its frame.
            min_height_mm: what stands out from the floor by less is not the animal.
        """
        bare = floor.depth(camera.width, camera.height)
        limit = np.maximum(bare - np.float32(min_height_mm), 0).astype(np.float32)
        return BackgroundSubtraction(camera, floor, bare, limit, np.ones(bare.shape, np.bool_))

    @staticmethod
    def learn(
        recording: Recording,
        spine_mm: tuple[float, float],
        n_frames: int = 96,
        min_height_mm: float = 7.0,
        view: View = MOUSE_VIEW,
        floor: Floor | None = None,
        region: NDArray[np.bool_] | None = None,
    ) -> tuple[BackgroundSubtraction, NDArray[np.float32]]:
        """The background subtraction of a recording, learned from frames spread over it.

        The background of a pixel is the farthest depth that keeps coming back, which survives an
        animal that covers it most of the time; where the animal never leaves its place the floor
        plane takes over. On the rims and walls around the floor, which flicker between near and
        far, only what is nearer than the nearest usual depth counts. Where fewer than half of the
        frames show an animal, it perhaps sits in its own background: then the floor plane itself is
        tried as background, and kept if more frames show one.

        Args:
            recording: an ideal pinhole's recording, see `recordings.rectify`.
            spine_mm: lengths of the smallest and the largest animal to expect, mm.
            n_frames: frames that are sampled, at most.
            min_height_mm: what stands out from the background by less is not the animal.
            view: how such animals are looked at; one that does not stand on the floor may be
                anywhere.
            floor: the floor where it is stated; None finds it.
            region: (height, width) bool of the whole picture, where it is looked at; None
                everywhere.

        Returns:
            The segmenter, and the sample (n, H, W) float32 mm of frames from which it was learned,
            at its stride.

        Raises:
            EstimationError: no depth was read, nothing comes back often enough to be a background,
                no floor was found, or nothing of an animal's size stands on it.
        """
        stride = stride_for(recording, spine_mm[0])
        sample = sample_frames(recording, n_frames, stride)
        if region is not None:
            sample *= region[::stride, ::stride]
        background, spread, near = learn_background(sample)
        _check_background(sample, background)
        grid = recording.camera.every(stride)
        stated = None if floor is None else Floor.from_plane(floor.normal, floor.distance_mm, grid)
        standing = find_standing(
            sample, background, spread, grid, spine_mm, min_height_mm, view, stated
        )
        if region is not None:
            cut = region[::stride, ::stride]
            standing = replace(standing, region=cut, on_floor=standing.on_floor & cut)
        if standing.region is not None:  # what lies around is not looked at
            background = np.where(standing.region, background, np.float32(0))
            near = np.where(standing.region, near, np.float32(0))
        seen = standing.floor
        floor = (
            seen
            if stride == 1
            else Floor.from_plane(seen.normal, seen.distance_mm, recording.camera)
        )
        bare = seen.depth(grid.width, grid.height)
        on_floor = standing.on_floor
        background = np.where((background == 0) & on_floor, bare, background)
        # the rims and walls around the floor flicker between near and far: there, nearer than ever
        # is what counts
        behind = np.where(on_floor, background, near)
        margin = np.maximum(np.float32(min_height_mm), np.float32(SPREADS) * spread)
        limit = np.maximum(behind - margin, 0).astype(np.float32)
        stands = view.frame == VIEWS[0]  # one that floats may be seen before anything
        over = on_floor if stands else np.ones_like(on_floor)
        scene = BackgroundSubtraction(
            recording.camera,
            floor,
            background,
            limit,
            over,
            view=view,
            stride=stride,
            standing=standing,
        )
        area, share = scene._moving_area(sample, spine_mm, min_height_mm)
        moves = share >= 0.5 or (share > 0.0 and standing.moves)
        if share < 0.5:  # perhaps it sits in its own background: compare with the floor itself
            bare_limit = np.where(
                on_floor, np.maximum(bare - np.float32(min_height_mm), 0), limit
            ).astype(np.float32)
            still = replace(
                scene, limit=bare_limit, background=np.where(on_floor, bare, background)
            )
            still_area, still_share = still.usual_area(sample, spine_mm)
            rests = replace(still, area_mm2=still_area)
            if still_share > share and not (
                stands
                and standing.moves
                and area > 0.0
                and (
                    rests._stays_beside(replace(scene, area_mm2=area), sample)
                    or not rests._is_like_an_animal(sample, spine_mm, min_height_mm)
                )
            ):
                scene = still
                area = still_area
                share = still_share
                moves = False
        elif stands:
            scene, area = scene.with_its_still_part(sample, spine_mm, min_height_mm, area)
        # what was not seen moving is an animal only where it is as large and as high as one
        if stands and share > 0.0 and not moves:
            seen_as = replace(scene, area_mm2=area)
            share = share if seen_as._is_like_an_animal(sample, spine_mm, min_height_mm) else 0.0
        if share == 0.0:
            raise EstimationError(
                f"no animal was found in {len(sample)} frames spread over the recording: nothing "
                f"between {view.area[0] * spine_mm[0] ** 2:.0f} and "
                f"{view.area[1] * spine_mm[1] ** 2:.0f} mm^2 stands on the floor; check the depth "
                "unit, or set animal.spine_min_mm and spine_max_mm in the plan"
            )
        scene = replace(scene, area_mm2=area)
        return replace(scene, volume_mm3=scene.usual_volume(sample)), sample

    def _moving_area(
        self, sample: NDArray[np.float32], spine_mm: tuple[float, float], min_height_mm: float
    ) -> tuple[float, float]:
        """The usual area mm^2, and the share of the frames that show it, see `usual_area`.

        Where that is not the area of what was seen moving clearly, but of specks that come back in
        more frames, as before an animal came, the area of what moves counts. What is like an animal
        is no speck, though a larger thing comes and goes beside it.
        """
        area, share = self.usual_area(sample, spine_mm)
        standing = self.standing
        if standing is None or not standing.moves or self.view.frame != VIEWS[0]:
            return area, share
        if area > 0.0 and abs(np.log(area / standing.thing_mm2)) < np.log(_OTHER):
            return area, share
        if share >= 0.5 and replace(self, area_mm2=area)._is_like_an_animal(
            sample, spine_mm, min_height_mm
        ):
            return area, share
        crops = replace(self, area_mm2=standing.thing_mm2).extract(sample, 1.0)
        return standing.thing_mm2, float(crops.found.mean())

    def _stays_beside(self, moving: BackgroundSubtraction, sample: NDArray[np.float32]) -> bool:
        """Whether what stands on the bare floor is there beside what moves: another thing.

        Args:
            moving: the scene in which only what moves is seen, with its area.
            sample: (n, H, W) float32 mm, frames at this scene's stride.
        """
        mover = moving.extract(sample, 1.0)
        both = self.extract(sample, 1.0)
        seen = mover.found & both.found
        if not seen.any():
            return True
        apart = np.linalg.norm(mover[seen].centroid[:, :2] - both[seen].centroid[:, :2], axis=1)
        beside = (apart > np.sqrt(self.area_mm2)) | (both.n_blobs[seen] > 1)
        return bool(beside.mean() > 0.5)

    def _is_like_an_animal(
        self, sample: NDArray[np.float32], spine_mm: tuple[float, float], min_height_mm: float
    ) -> bool:
        """Whether what is found in a sample (n, H, W) mm is neither longer than the largest animal,
        nor as low as an uneven floor.
        """
        crops = self.extract(sample, 1.0)
        if not crops.found.any():
            return False
        blobs = crops[crops.found].blobs
        length = 4.0 * float(np.median(blobs.sd_along))
        height = float(np.median(blobs.volume_mm3 / blobs.area_mm2))
        return (
            length < _LONGEST * spine_mm[1]
            and height > _HIGHER * min_height_mm
            and self.area_mm2 > _LARGER * self.view.area[0] * spine_mm[0] ** 2
        )

    def with_its_still_part(
        self,
        sample: NDArray[np.float32],
        spine_mm: tuple[float, float],
        min_height_mm: float,
        area: float,
    ) -> tuple[BackgroundSubtraction, float]:
        """The scene with the floor put under an animal that was partly taken for background.

        Such a part is a lump on the floor that the moving animal touches in (nearly, nine tenths
        of) every frame, and together with which it is still no larger than an animal.

        Args:
            sample: (n, H, W) float32 mm, frames at this scene's stride.
            spine_mm: lengths of the smallest and the largest animal to expect, mm.
            min_height_mm: what stands out from the floor by less is not the animal.
            area: area of the moving animal, mm^2.

        Returns:
            The scene, this one where there is no such lump, and the area mm^2 of the whole animal.
        """
        import cv2

        bare = self._grid_floor.depth(self.grid.width, self.grid.height)
        lump = self.on_floor & (self.background > 0) & (bare - self.background > min_height_mm)
        n, labels, stats, _ = cv2.connectedComponentsWithStats(lump.astype(np.uint8))
        crops = replace(self, area_mm2=area).extract(sample, 1.0)
        moving = np.zeros((int(crops.found.sum()), *lump.shape), np.bool_)
        for k, i in enumerate(np.flatnonzero(crops.found)):
            rows, columns = np.nonzero(crops.heights[i])
            step, (u, v) = crops.step[i] // self.stride, crops.origin[i] // self.stride
            moving[k, v + step * rows, u + step * columns] = True
        best = self
        best_area = area
        for k in range(1, n):
            part = labels == k
            if stats[k, cv2.CC_STAT_AREA] < 16:
                continue
            near = cv2.dilate(part.astype(np.uint8), np.ones((9, 9), np.uint8)).astype(bool)
            if moving[:, near].any(axis=1).mean() < _TOUCH_SHARE:
                continue
            floor = np.where(near & self.on_floor, bare, self.background)
            limit = np.where(
                near & self.on_floor, np.maximum(bare - np.float32(min_height_mm), 0), self.limit
            )
            whole = replace(self, background=floor, limit=limit.astype(np.float32))
            whole_area, share = whole.usual_area(sample, spine_mm)
            if share >= 0.5 and whole_area > best_area:
                best = whole
                best_area = whole_area
        return best, best_area

    def usual_area(
        self, depths: NDArray[np.float32], spine_mm: tuple[float, float]
    ) -> tuple[float, float]:
        """The area that most frames have a component of, and the share of frames that do.

        One object of constant size is in (nearly) every frame, the animal; other things come and go
        or differ. The mode of a kernel density over the logarithm of area, to which each frame adds
        its nearest component with a Gaussian kernel of standard deviation 0.35.

        Args:
            depths: (n, H, W) float32 mm, frames at this scene's stride.
            spine_mm: lengths of the smallest and the largest animal to expect, mm; they bound the
                area.

        Returns:
            The area, mm^2, and the share (0 to 1) of frames with a component within a factor of 4
            of it; both 0 where no component has an animal's size.
        """
        self._check(depths)
        areas = np.zeros((len(depths), MAX_BLOBS))
        bridge = 0 if self.view.frame == VIEWS[0] else kernels.BRIDGE
        kernels.blob_areas(
            depths, self.limit, self.on_floor, bridge, 1.0 / (self.grid.fx * self.grid.fy), areas
        )
        low = self.view.area[0] * spine_mm[0] ** 2
        high = self.view.area[1] * spine_mm[1] ** 2
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
        """The animal's median volume, mm^3, over frames in which nothing else has about its area.

        Where fewer than 5 frames are such, all frames in which it was found count.

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

    def described(self) -> Scene:
        """The scene as it is written to session.json, without its outline."""
        floor = self._grid_floor
        bare = floor.depth(self.grid.width, self.grid.height)
        rough = roughness(self.background, bare, self.on_floor)
        fixtures = find_fixtures(self.background, floor, self.grid, self.on_floor)
        standing = self.standing
        if standing is None:
            return Scene(self.floor, roughness_mm=rough, fixtures=fixtures)
        return Scene(
            self.floor,
            standing.origin,
            standing.support if standing.moves else None,
            standing.n_things,
            standing.n_together,
            rough,
            region_corners(standing.region, self.stride),
            fixtures=fixtures,
            doubts=(standing.doubt,) if standing.doubt else (),
        )

    def every(self, step: int) -> BackgroundSubtraction:
        """The same segmenter for pictures of every `step`-th row and column.

        Args:
            step: pixels from one to the next, at least 1.
        """
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
        )

    def misfit(self, crops: HeightMaps) -> Array:
        """How unlike the animal each height map (n,) is in size: squared standard deviations.

        The sum of ((log a - log a0) / 0.25)^2 over area and ((log v - log v0) / 0.2)^2 over volume,
        from posture to posture of one animal. An animal that swims or is held up is judged by its
        area alone: what is below it is not its own.

        Args:
            crops: n height maps.
        """
        area = np.maximum(crops.blobs.area_mm2, 1.0)
        volume = np.maximum(crops.blobs.volume_mm3, 1.0)
        if (
            self.view.frame != VIEWS[0]
        ):  # what is below an animal that swims or is held up is not its own
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
        """The plane above which each height map is measured: the floor, or one behind the animal.

        Args:
            crops: n height maps.
            camera_view: as they were extracted.

        Returns:
            (n, 3) a, b, c of 1 / z = a u + b v + c, per mm, u and v in pixels of the picture.
        """
        if not camera_view:
            return np.tile(self.floor.inverse_depth, (len(crops.step), 1))
        level = np.zeros((len(crops.step), 3))
        level[:, 2] = 1.0 / crops.distance
        return level

    def middles(self, crops: HeightMaps, camera_view: bool = False) -> Array:
        """The centroid (n, 3) mm of what each height map shows, in the arena frame.

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
        """The crop cameras of height maps.

        Each says how its map was cut: intrinsics, T_view_camera, origin and step of the crop.

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

    def _check(self, depths: NDArray[np.float32]) -> None:
        """Refuse frames of another size than those that the scene was learned from."""
        check_shapes("frames of this scene", ("depths", depths, ("n", *self.limit.shape)))

    def _extract(
        self,
        depths: NDArray[np.float32],
        size: float,
        parallel: bool,
        camera_view: bool,
        n_things: int,
    ) -> HeightMaps:
        """Height maps of the components whose areas are nearest to the animal's own.

        Heights are measured above the floor, or (camera_view) from the view's behind_mm behind the
        animal's mean depth, as the paper's features see them.

        Args:
            depths: (n, H, W) float32 mm, whole pictures, or a sample of them with the scene's own
                stride.
            size: the animal's spine length over the skeleton's home length; scales the smoothing.
            parallel: whether to use all threads, else one.
            camera_view: whether heights are measured along the optical axis.
            n_things: candidates a frame, 1 or 2.

        Returns:
            The rows (n) of the likeliest components, and then (n_things 2) those of the next;
            origin, step and n_px are in pixels of the whole picture.
        """
        if depths.shape[1:] != self.limit.shape:
            depths = depths[:, :: self.stride, :: self.stride]
        self._check(depths)
        crops = HeightMaps.blank(n_things * len(depths), self.floor.distance_mm)
        grid = self.grid
        with threads(parallel):
            kernels.extract_all(
                depths,
                self.limit,
                self.on_floor,
                self.area_mm2,
                n_things,
                camera_view,
                kernels.Sight(
                    np.array([grid.fx, grid.fy, grid.cx, grid.cy]),
                    self._grid_floor.inverse_depth,
                    self.view_rotation(camera_view),
                    behind_mm=self.view.behind_mm if camera_view else 0.0,
                    smooth_mm=self.view.smooth_mm * size,
                ),
                crops.rows,
            )
        if self.stride > 1:  # told in pixels of the picture
            for values, factor in ((crops.origin, 1), (crops.step, 1), (crops.n_px, self.stride)):
                values *= self.stride * factor
        return crops


def _check_background(sample: NDArray[np.float32], background: NDArray[np.float32]) -> None:
    """Refuse a sample (n, H, W) mm of frames from which no background (H, W) mm can be learned."""
    n = len(sample)
    if not (sample > 0).any():
        raise EstimationError(
            f"no depth was read in {n} frames spread over the recording; check the camera, its "
            "range and its cable"
        )
    if not (background > 0).any():
        raise EstimationError(
            f"a background is what keeps coming back, and {n} frame{'' if n == 1 else 's'} cannot "
            "tell; record some seconds at least"
        )
