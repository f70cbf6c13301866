"""The scene behind the animal, and the animal in front of it: background, floor, blob, height map."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from liex_lab.camera import Camera
from liex_lab.errors import EstimationError
from liex_lab.recordings import _segment as kernels
from liex_lab.recordings.arena import Floor, find_floor
from liex_lab.recordings.recording import Recording
from liex_lab.threads import threads

Array = NDArray[np.float64]

CROP = 96  # pixels a side of a height map
BEHIND_MM = 120.0  # the camera view's background lies this far behind the animal's mean depth
_MODE_SHARE, _MODE_MM = 0.012, 6.0  # readings this near to one another, of the depth or in mm, are one surface
_SPREADS = 3.0  # an animal stands out by this many standard deviations of the background's own noise
_NEAR_SHARE = 0.05  # of a pixel's readings may be nearer than its nearest usual depth
_FLAT_MM = 15.0  # background this near to the plane is floor: flatness, noise and lens errors together
_ON_FLOOR_SHARE = 0.3  # of an animal that leans out over the edge of the floor still covers it
_AREA_SD, _VOLUME_SD = 0.25, 0.2  # of the logarithms, from posture to posture of one animal
_AREA_FACTOR = 4.0  # a blob this many times larger or smaller than the animal is not the animal
_TOUCH_SHARE = 0.9  # of the frames: a lump that the animal touches that often is a part of it that keeps still
_PLAUSIBLE_AREA = (0.12, 1.3)  # of the squared spine: area seen from above, reared up to spread out


@dataclass(frozen=True)
class Crops:
    """Height maps of one animal, a batch (n), and how the animal's mass lies on the floor.

    heights (n, CROP, CROP) int16, 1/16 mm above the floor, 0 = not the animal; origin (n, 2) picture pixel (u, v) of
    crop pixel (0, 0); step (n,) picture pixels a crop pixel; n_px (n,) readings on the animal, 0 = not found; n_blobs
    (n,) how many things in the frame have about the animal's size;
    moments (n, 8): pixels, area mm^2, volume mm^3, centroid x, y mm, long-axis angle rad (mod pi), and the standard
    deviation mm along and across it, all in the view frame. The view frame is the arena frame, or (camera_view) an
    upright frame whose z axis is the optical axis backwards; its origin is `distance` (n,) mm in front of the camera.
    """

    heights: NDArray[np.int16]
    origin: NDArray[np.int32]
    step: NDArray[np.int32]
    n_px: NDArray[np.int64]
    moments: Array
    distance: Array
    n_blobs: NDArray[np.int64]

    def __getitem__(self, index: NDArray[np.bool_]) -> Crops:
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


@dataclass(frozen=True)
class Scene:
    """What the camera sees without the animal, and what nearer than that counts as the animal.

    background (H, W) mm; limit (H, W) mm: a reading below it is in front of the background; on_floor (H, W): the floor,
    under which nothing lies, as far as the picture shows it: an animal stands on it with at least a part of its body;
    area_mm2 and volume_mm3: the animal's usual area seen from above and volume under its back, 0 while unknown.
    """

    camera: Camera
    floor: Floor
    background: NDArray[np.float32]
    limit: NDArray[np.float32]
    on_floor: NDArray[np.bool_]
    area_mm2: float = 0.0
    volume_mm3: float = 0.0

    @staticmethod
    def from_floor(camera: Camera, floor: Floor, min_height_mm: float = 7.0) -> Scene:
        """A scene of nothing but a known floor."""
        bare = floor.depth(camera.width, camera.height)
        limit = np.maximum(bare - np.float32(min_height_mm), 0).astype(np.float32)
        return Scene(camera, floor, bare, limit, np.ones(bare.shape, np.bool_))

    @staticmethod
    def learn(
        recording: Recording, spine_mm: tuple[float, float], n_frames: int = 96, min_height_mm: float = 7.0
    ) -> tuple[Scene, NDArray[np.float32]]:
        """The scene of a recording, and the sample (n, H, W) mm of its frames from which it was learned.

        The background of a pixel is the farthest depth that keeps coming back, which survives an animal that covers it
        most of the time; where the animal never leaves its place the floor plane takes over. spine_mm: the smallest and
        the largest animal to expect.
        """
        sample = sample_frames(recording, n_frames)
        background, spread, near = learn_background(sample)
        floor = find_floor(background, recording.camera)
        bare = floor.depth(recording.width, recording.height)
        on_floor = floor_region(background, bare)
        background = np.where((background == 0) & on_floor, bare, background)
        # the rims and walls around the floor flicker between near and far: there, nearer than ever is what counts
        behind = np.where(on_floor, background, near)
        margin = np.maximum(np.float32(min_height_mm), np.float32(_SPREADS) * spread)
        limit = np.maximum(behind - margin, 0).astype(np.float32)
        scene = Scene(recording.camera, floor, background, limit, on_floor)
        area, share = scene.usual_area(sample, spine_mm)
        if share < 0.5:  # perhaps it sits in its own background: compare with the floor itself
            bare_limit = np.where(on_floor, np.maximum(bare - np.float32(min_height_mm), 0), limit).astype(np.float32)
            still = replace(scene, limit=bare_limit, background=bare)
            still_area, still_share = still.usual_area(sample, spine_mm)
            if still_share > share:
                scene, area, share = still, still_area, still_share
        else:
            scene, area = scene.with_its_still_part(sample, spine_mm, min_height_mm, area)
        if share == 0.0:
            raise EstimationError(
                f"no animal was found in {len(sample)} frames spread over the recording: nothing between "
                f"{_PLAUSIBLE_AREA[0] * spine_mm[0] ** 2:.0f} and {_PLAUSIBLE_AREA[1] * spine_mm[1] ** 2:.0f} mm^2 "
                "stands on the floor; check the depth unit, or set animal.spine_min_mm and spine_max_mm in the plan"
            )
        scene = replace(scene, area_mm2=area)
        return replace(scene, volume_mm3=scene.usual_volume(sample)), sample

    def with_its_still_part(
        self, sample: NDArray[np.float32], spine_mm: tuple[float, float], min_height_mm: float, area: float
    ) -> tuple[Scene, float]:
        """The scene with the floor put under an animal that has left a part of itself in the background.

        Such a part is a lump on the floor that the moving animal of area mm^2 touches in (nearly) every frame, and with
        which it is still no larger than an animal. Returns the animal's area, too.
        """
        import cv2

        bare = self.floor.depth(self.camera.width, self.camera.height)
        lump = self.on_floor & (self.background > 0) & (bare - self.background > min_height_mm)
        n, labels, stats, _ = cv2.connectedComponentsWithStats(lump.astype(np.uint8))
        crops = replace(self, area_mm2=area).extract(sample, 1.0)
        moving = np.zeros((int(crops.found.sum()), *lump.shape), np.bool_)
        for k, i in enumerate(np.flatnonzero(crops.found)):
            rows, columns = np.nonzero(crops.heights[i])
            moving[k, crops.origin[i, 1] + crops.step[i] * rows, crops.origin[i, 0] + crops.step[i] * columns] = True
        best, best_area = self, area
        for k in range(1, n):
            part = labels == k
            if stats[k, cv2.CC_STAT_AREA] < 16:
                continue
            near = cv2.dilate(part.astype(np.uint8), np.ones((9, 9), np.uint8)).astype(bool)
            if moving[:, near].any(axis=1).mean() < _TOUCH_SHARE:
                continue
            floor = np.where(near & self.on_floor, bare, self.background)
            limit = np.where(near & self.on_floor, np.maximum(bare - np.float32(min_height_mm), 0), self.limit)
            whole = replace(self, background=floor, limit=limit.astype(np.float32))
            whole_area, share = whole.usual_area(sample, spine_mm)
            if share >= 0.5 and whole_area > best_area:
                best, best_area = whole, whole_area
        return best, best_area

    def usual_area(self, depths: NDArray[np.float32], spine_mm: tuple[float, float]) -> tuple[float, float]:
        """The area mm^2 that the most frames have a blob of, and the share of frames that do.

        One object of constant size is in (nearly) every frame, the animal; other things come and go or differ.
        """
        areas = np.zeros((len(depths), kernels.MAX_BLOBS))
        _blob_areas(depths, self.limit, self.on_floor, 1.0 / (self.camera.fx * self.camera.fy), areas)
        low, high = _PLAUSIBLE_AREA[0] * spine_mm[0] ** 2, _PLAUSIBLE_AREA[1] * spine_mm[1] ** 2
        candidates = np.sort(areas[(areas > low) & (areas < high)])
        if not len(candidates):
            return 0.0, 0.0
        tried = candidates[np.linspace(0, len(candidates) - 1, min(200, len(candidates))).astype(int)]
        distance = np.abs(np.log(np.maximum(areas, 1e-9)[None] / tried[:, None, None])).min(axis=2)
        support = np.exp(-0.5 * (distance / 0.35) ** 2).sum(axis=1)
        best = tried[np.argmax(support)]
        return float(best), float((distance[np.argmax(support)] < np.log(_AREA_FACTOR)).mean())

    def usual_volume(self, depths: NDArray[np.float32]) -> float:
        """The median volume mm^3 of the animal in the frames (n, H, W) mm in which nothing else has about its area."""
        volume, n_blobs = np.zeros(len(depths)), np.zeros(len(depths), np.int64)
        for start in range(0, len(depths), 16):
            crops = self.extract(depths[start : start + 16], 1.0)
            volume[start : start + 16], n_blobs[start : start + 16] = crops.moments[:, 2], crops.n_blobs
        alone = n_blobs == 1 if (n_blobs == 1).sum() >= 5 else n_blobs > 0
        return float(np.median(volume[alone]))

    def misfit(self, crops: Crops) -> Array:
        """How unlike the animal each crop (n) is in area and volume: the square of a number of standard deviations."""
        area, volume = np.maximum(crops.moments[:, 1], 1.0), np.maximum(crops.moments[:, 2], 1.0)
        return (np.log(area / self.area_mm2) / _AREA_SD) ** 2 + (np.log(volume / self.volume_mm3) / _VOLUME_SD) ** 2

    def view_rotation(self, camera_view: bool) -> Array:
        """Rotation (3, 3) of T_view_camera: the arena's, or that of an upright camera frame."""
        return np.diag([1.0, -1.0, -1.0]) if camera_view else self.floor.T_arena_camera.rotation

    def looks(self, crops: Crops, camera_view: bool = False) -> Array:
        """How each height map was cut (n, 17): intrinsics, T_view_camera, origin and step of the crop."""
        looks = np.empty((len(crops.step), 17))
        looks[:, :4] = self.camera.fx, self.camera.fy, self.camera.cx, self.camera.cy
        looks[:, 4:13] = self.view_rotation(camera_view).ravel()
        looks[:, 13] = crops.distance
        looks[:, 14:16] = crops.origin
        looks[:, 16] = crops.step
        return looks

    def extract(
        self, depths: NDArray[np.float32], size: float, parallel: bool = True, camera_view: bool = False, rank: int = 0
    ) -> Crops:
        """The animal of each frame (n, H, W) mm; `size` is its spine over the skeleton's home length.

        rank: 0 takes the blob whose area is nearest to the animal's, 1 the next one, which may be the animal after all.
        camera_view: heights are measured along the optical axis from BEHIND_MM behind the animal's mean depth, as the
        paper's features see them; otherwise above the floor.
        """
        n = len(depths)
        crops = Crops(
            np.zeros((n, CROP, CROP), np.int16), np.zeros((n, 2), np.int32), np.ones(n, np.int32),
            np.zeros(n, np.int64), np.zeros((n, 8)), np.full(n, self.floor.distance_mm), np.zeros(n, np.int64),
        )  # fmt: skip
        camera, floor = self.camera, self.floor
        with threads(parallel):
            _extract_all(
                depths, self.limit, self.on_floor, self.area_mm2, rank, size,
                np.array([camera.fx, camera.fy, camera.cx, camera.cy]),
                floor.inverse_depth, self.view_rotation(camera_view), camera_view,
                crops.heights, crops.origin, crops.step, crops.n_px, crops.moments, crops.distance, crops.n_blobs,
            )  # fmt: skip
        return crops


def sample_frames(recording: Recording, n_frames: int) -> NDArray[np.float32]:
    """Up to `n_frames` frames (n, H, W) mm spread evenly over the recording."""
    chosen = np.unique(np.linspace(0, len(recording) - 1, min(n_frames, len(recording))).astype(int))
    sample = np.empty((len(chosen), recording.height, recording.width), np.float32)
    if len(chosen) == len(recording):  # in order, which every format reads fastest
        for frames in recording.chunks(32):
            for frame in frames:
                sample[frame.index] = frame.depth
        return sample
    for k, index in enumerate(chosen):
        sample[k] = recording.frame(int(index)).depth
    return sample


def learn_background(
    sample: NDArray[np.float32] | Recording,
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """Background depth, its spread, and the nearest usual depth (H, W) mm of a sample (n, H, W) mm or of a recording;
    0 = never read.
    """
    stack = sample if isinstance(sample, np.ndarray) else sample_frames(sample, 96)
    depth, spread, near = np.zeros((3, *stack.shape[1:]), np.float32)
    numbers = [np.float32(value) for value in (_MODE_SHARE, _MODE_MM, _NEAR_SHARE)]
    kernels.far_modes(stack, *numbers, depth, spread, near)
    return depth, spread, near


def floor_region(background: NDArray[np.float32], bare: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Where (H, W) the floor lies: the convex hull of the largest connected part of the background on the plane.

    Floors of arenas and tanks are convex; what stands on them or hides them leaves holes, which the hull closes.
    """
    import cv2

    flat = ((background > 0) & (np.abs(background - bare) < _FLAT_MM)).astype(np.uint8)
    opened = cv2.morphologyEx(flat, cv2.MORPH_OPEN, np.ones((5, 5), np.uint8))
    n, labels, stats, _ = cv2.connectedComponentsWithStats(opened)
    if n < 2:
        return flat.astype(bool)
    largest = (labels == 1 + int(np.argmax(stats[1:, cv2.CC_STAT_AREA]))).astype(np.uint8)
    points = cv2.findNonZero(largest)
    region = np.zeros(flat.shape, np.uint8)
    cv2.fillConvexPoly(region, cv2.convexHull(points), 1)
    return region.astype(bool)


@njit(cache=True, parallel=True)
def _blob_areas(depths, limit, on_floor, mm2_per_px, areas):
    """Areas mm^2 of the blobs of every frame into areas (n, MAX_BLOBS); 0 for one that does not stand on the floor."""
    for k in prange(depths.shape[0]):
        labels = np.empty((depths.shape[1] // kernels.BLOCK, depths.shape[2] // kernels.BLOCK), np.int32)
        blobs = np.empty((kernels.MAX_BLOBS, 7))
        for slot in range(kernels.label_blobs(depths[k], limit, on_floor, labels, blobs)):
            if blobs[slot, 6] >= _ON_FLOOR_SHARE * blobs[slot, 0]:
                areas[k, slot] = blob_area(blobs[slot], mm2_per_px)


@njit(cache=True)
def blob_area(blob, mm2_per_px):
    """Area mm^2 seen from above of a blob (7,); mm2_per_px is 1 / (fx fy)."""
    return blob[0] * (blob[5] / blob[0]) ** 2 * mm2_per_px


@njit(cache=True)
def choose_blob(blobs, n_blobs, area, mm2_per_px, rank):
    """The blob whose area comes next near (`rank`) to the animal's, -1 for none, and how many have about its area.

    While `area` is 0 the largest comes first.
    """
    distances = np.full(n_blobs, np.inf)
    n_near = 0
    for slot in range(n_blobs):
        if blobs[slot, 6] < _ON_FLOOR_SHARE * blobs[slot, 0]:
            continue
        here = blob_area(blobs[slot], mm2_per_px)
        distances[slot] = abs(np.log(here / area)) if area > 0 else 1.0 / here
        if area > 0 and distances[slot] > np.log(_AREA_FACTOR):
            distances[slot] = np.inf
        else:
            n_near += 1
    if rank >= n_near:
        return -1, n_near
    return np.argsort(distances)[rank], n_near


@njit(cache=True)
def extract_one(
    depth, limit, on_floor, area, rank, size, intrinsics, plane, rotation, camera_view, heights, origin, n_steps, n_px,
    moments, distance, n_blobs, k,
):  # fmt: skip
    """Find the animal in one frame and fill row k of the batch; distance[k] comes in as the floor's."""
    labels = np.empty((depth.shape[0] // kernels.BLOCK, depth.shape[1] // kernels.BLOCK), np.int32)
    blobs = np.empty((kernels.MAX_BLOBS, 7))
    mm2_per_px = 1.0 / (intrinsics[0] * intrinsics[1])
    n_found = kernels.label_blobs(depth, limit, on_floor, labels, blobs)
    slot, n_blobs[k] = choose_blob(blobs, n_found, area, mm2_per_px, rank)
    if slot < 0:
        return
    blob = blobs[slot]
    mean_depth = blob[5] / blob[0]
    view_plane = plane
    if camera_view:
        distance[k] = mean_depth + BEHIND_MM
        view_plane = np.array([0.0, 0.0, 1.0 / distance[k]])
    cut_crop(depth, limit, labels, slot, blob, mean_depth, size, intrinsics, view_plane, distance[k], rotation,
             heights, origin, n_steps, moments, k)  # fmt: skip
    n_px[k] = int(blob[0])


@njit(cache=True)
def cut_crop(
    depth, limit, labels, slot, blob, mean_depth, size, intrinsics, plane, distance, rotation, heights, origin,
    n_steps, moments, k,
):  # fmt: skip
    """The blob's height map, smoothed over about 2 mm of a home-sized animal, and its moments, into row k."""
    crop = heights.shape[1]
    v0, v1 = blob[1] * kernels.BLOCK, (blob[2] + 1) * kernels.BLOCK
    u0, u1 = blob[3] * kernels.BLOCK, (blob[4] + 1) * kernels.BLOCK
    span = max(v1 - v0, u1 - u0) + 2 * kernels.BLOCK
    step = max(1, int(np.ceil(span / (crop - 4))))
    origin[k, 0] = int((u0 + u1) / 2 - step * crop / 2)
    origin[k, 1] = int((v0 + v1) / 2 - step * crop / 2)
    n_steps[k] = step
    raw = np.empty((crop, crop), np.float32)
    kernels.cut_heights(depth, limit, labels, slot, plane, distance, origin[k], step, raw)
    kernels.keep_largest(raw, np.empty((crop, crop), np.int32), np.empty((crop * crop, 2), np.int32))
    mm_per_px = step * mean_depth / np.sqrt(intrinsics[0] * intrinsics[1])
    radius = min(3, max(1, int(2.0 * size / mm_per_px + 0.5)))
    kernels.smooth_heights(raw, radius, heights[k])
    kernels.blob_moments(heights[k], origin[k], step, plane, intrinsics, rotation, distance, moments[k])


@njit(cache=True, parallel=True)
def _extract_all(
    depths, limit, on_floor, area, rank, size, intrinsics, plane, rotation, camera_view, heights, origin, n_steps, n_px,
    moments, distance, n_blobs,
):  # fmt: skip
    for k in prange(depths.shape[0]):
        extract_one(depths[k], limit, on_floor, area, rank, size, intrinsics, plane, rotation, camera_view,
                    heights, origin, n_steps, n_px, moments, distance, n_blobs, k)  # fmt: skip




@dataclass(frozen=True)
class Windows:
    """Parts of pictures from many cameras (n), each around one animal on a known floor.

    depth, background (n, H, W) mm, 0 = unread; intrinsics (n, 4) fx fy cx cy, pixels of the whole picture; origin
    (n, 2) picture pixel of each window's first; inverse_depth (n, 3): 1 / z of the floor = a u + b v + c in pixels of
    the whole picture.
    """

    depth: NDArray[np.uint16]
    background: NDArray[np.uint16]
    intrinsics: Array
    origin: Array
    inverse_depth: Array

    def floor(self, k: int) -> Floor:
        """The floor of window k."""
        fx, fy, cx, cy = self.intrinsics[k]
        return Floor.from_inverse_depth(self.inverse_depth[k], Camera(fx, fy, cx, cy, 1, 1))

    def extract(
        self, size: Array, area_mm2: Array, min_height_mm: float = 7.0, camera_view: bool = False, rank: int = 0
    ) -> tuple[Crops, Array]:
        """The blobs of each window whose areas are nearest to area_mm2 (n,), by rank, and their looks (n, 17); see
        `Scene.extract` and `Scene.looks`.
        """
        n = len(self.depth)
        crops = Crops(
            np.zeros((n, CROP, CROP), np.int16), np.zeros((n, 2), np.int32), np.ones(n, np.int32),
            np.zeros(n, np.int64), np.zeros((n, 8)), np.empty(n), np.zeros(n, np.int64),
        )  # fmt: skip
        # a window is the picture of a camera whose centre is shifted
        intrinsics, plane = self.intrinsics.copy(), self.inverse_depth.copy()
        intrinsics[:, 2:] -= self.origin
        plane[:, 2] += plane[:, 0] * self.origin[:, 0] + plane[:, 1] * self.origin[:, 1]
        rotation = np.empty((n, 3, 3))
        for k in range(n):
            floor = self.floor(k)
            crops.distance[k] = floor.distance_mm
            rotation[k] = np.diag([1.0, -1.0, -1.0]) if camera_view else floor.T_arena_camera.rotation
        _extract_windows(
            self.depth, self.background, np.float32(min_height_mm), area_mm2, rank, size, intrinsics, plane, rotation,
            camera_view, crops.heights, crops.origin, crops.step, crops.n_px, crops.moments, crops.distance,
            crops.n_blobs,
        )  # fmt: skip
        looks = np.concatenate(
            [intrinsics, rotation.reshape(n, 9), crops.distance[:, None], crops.origin, crops.step[:, None]], axis=1
        )
        return crops, looks


@njit(cache=True, parallel=True)
def _extract_windows(
    depths, background, margin, area, rank, size, intrinsics, plane, rotation, camera_view, heights, origin, n_steps,
    n_px, moments, distance, n_blobs,
):  # fmt: skip
    for k in prange(depths.shape[0]):
        limit, everywhere = np.empty(depths.shape[1:], np.float32), np.ones(depths.shape[1:], np.bool_)
        for v in range(limit.shape[0]):
            for u in range(limit.shape[1]):
                behind = float(background[k, v, u])
                if behind == 0.0:
                    inverse = plane[k, 0] * u + plane[k, 1] * v + plane[k, 2]
                    behind = 1.0 / inverse if inverse > 1e-6 else 0.0
                limit[v, u] = max(behind - margin, 0.0)
        extract_one(depths[k], limit, everywhere, area[k], rank, size[k], intrinsics[k], plane[k], rotation[k],
                    camera_view, heights, origin, n_steps, n_px, moments, distance, n_blobs, k)  # fmt: skip
