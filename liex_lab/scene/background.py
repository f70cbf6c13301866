"""Per-pixel background model of a depth recording: the farthest mode of its readings over time.

An animal is always nearer than what it covers, so the background of a pixel is the farthest depth
that keeps coming back, neither its median nor its most frequent depth: a pixel that is covered nine
tenths of the time still shows its background. A mode is a cluster of at least a twentieth of the
pixel's readings (and at least 3) within 6 mm or 1.2 % of the depth; its median is the background,
half of its 16 to 84 % range the standard deviation. The kernel is `far_modes`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from liex_lab.body.skeleton import VIEWS, View
from liex_lab.errors import EstimationError
from liex_lab.optics.camera import Camera
from liex_lab.recordings.recording import Recording
from liex_lab.runtime.shapes import check_shapes
from liex_lab.scene import _height_map_kernels as kernels
from liex_lab.scene.floor import Floor, near_plane
from liex_lab.scene.support_plane import SampledScene, Standing, find_standing, levelled, thing_at

# readings this near to one another, of the depth or in mm, are one surface
_MODE_SHARE = 0.012
_MODE_MM = 6.0
_NEAR_SHARE = 0.05  # of a pixel's readings may be nearer than its nearest usual depth
# an animal of this many pixels is looked at finely enough
_LENGTH_PX = 64.0
_MAX_STRIDE = 4
_ROWS = 32  # of pixels whose readings are sorted at once
# noise changes something in this share of an image's cells, so many to a row and to a column, in
# the median of so many pairs; a moving animal changes the few cells in which it is
_EVERYWHERE = 0.8
_CELLS = 8
_PAIRS = 32


def sampled(n: int, most: int) -> NDArray[np.int64]:
    """Indices of frames spread evenly over a recording.

    Args:
        n: frames of the recording.
        most: frames at most; all where the recording has fewer.
    """
    return np.unique(np.linspace(0, n - 1, min(most, n)).astype(np.int64))


def sample_frames(recording: Recording, n_frames: int, stride: int = 1) -> NDArray[np.float32]:
    """Frames spread evenly over a recording, thinned to every `stride`-th pixel.

    Args:
        recording: where they are read from.
        n_frames: frames at most; all where the recording has fewer.
        stride: pixels from one to the next along rows and columns.

    Returns:
        (n, ceil(H / stride), ceil(W / stride)) float32 mm, 0 where unread.
    """
    chosen = sampled(len(recording), n_frames)
    sample = np.empty(
        (len(chosen), -(-recording.height // stride), -(-recording.width // stride)), np.float32
    )
    if len(chosen) == len(recording):  # in order, which every format reads fastest
        for frames in recording.chunks(32):
            for frame in frames:
                sample[frame.index] = frame.depth[::stride, ::stride]
        return sample
    for k, index in enumerate(chosen):
        sample[k] = recording.frame(int(index)).depth[::stride, ::stride]
    return sample


def has_noise(sample: NDArray[np.float32]) -> bool:
    """Whether the sensor has noise: two depth images differ nearly everywhere, not at the animal.

    Where it has none, as in a rendered recording, an image of a still scene may repeat bit for bit.

    Args:
        sample: (n, H, W) float32 mm, 0 where unread, frames spread over the recording.
    """
    shares = []
    cells = [np.unique(np.arange(_CELLS) * n // _CELLS) for n in sample.shape[1:]]
    for before, after in pairwise(sample[:: max(1, len(sample) // _PAIRS)]):
        changed, read = (
            np.maximum.reduceat(np.maximum.reduceat(where, cells[0]), cells[1], axis=1)
            for where in (before != after, (before > 0) | (after > 0))
        )
        if changed.any():
            shares.append(float(changed.sum() / read.sum()))
    return len(shares) > 0 and float(np.median(shares)) > _EVERYWHERE


def usual_depth(pictures: NDArray[np.uint16]) -> NDArray[np.uint16]:
    """Each pixel's median over some pictures, of those in which it was read.

    Args:
        pictures: (n, H, W) uint16 mm, 0 where unread.

    Returns:
        (H, W) uint16 mm, 0 where it was read in none.
    """
    ordered = np.sort(pictures, axis=0)
    unread = (ordered == 0).sum(axis=0)
    middle = np.minimum(unread + (len(ordered) - unread) // 2, len(ordered) - 1)
    return np.asarray(np.take_along_axis(ordered, middle[None], axis=0)[0])


def stride_for(recording: Recording, length_mm: float) -> int:
    """The stride at which an animal is still some pixels long: 64 or more where it is above 1.

    Args:
        recording: its first and middle frame tell the usual depth; 1 where both are unread.
        length_mm: of the smallest animal.

    Returns:
        Pixels from one to the next, 1 to 4.
    """
    for index in {0, len(recording) // 2}:
        depth = recording.frame(index).depth
        if (depth > 0).any():
            px = length_mm * recording.camera.fx / float(np.median(depth[depth > 0]))
            return min(_MAX_STRIDE, max(1, int(px / _LENGTH_PX)))
    return 1


def learn_background(
    sample: NDArray[np.float32] | Recording,
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """Background depth, its spread, and the nearest usual depth of every pixel.

    Args:
        sample: (n, H, W) float32 mm, 0 where unread, or a recording, of which 96 frames are
            sampled.

    Returns:
        Three arrays (H, W) float32 mm, 0 where never read: depth of the farthest mode, its standard
        deviation, and the depth that a twentieth of the readings are nearer than.
    """
    stack = sample if isinstance(sample, np.ndarray) else sample_frames(sample, 96)
    check_shapes("a sample", ("frames", stack, ("n", "H", "W")))
    found = np.zeros((3, *stack.shape[1:]), np.float32)
    numbers = [np.float32(value) for value in (_MODE_SHARE, _MODE_MM, _NEAR_SHARE)]
    for start in range(0, stack.shape[1], _ROWS):
        rows = slice(start, start + _ROWS)
        # numpy sorts many short rows five times as fast as a compiled loop does
        ordered = np.ascontiguousarray(stack[:, rows].reshape(len(stack), -1).T)
        ordered.sort(axis=1)
        depth, spread, near = (np.ravel(one[rows]) for one in found)
        kernels.far_modes(ordered, *numbers, depth, spread, near)
    return found[0], found[1], found[2]


# The floor's level while a sensor warms up: the depth of one and the same floor wanders.


Array = NDArray[np.float64]
Depths = NDArray[np.float32]

_N_PIXELS = 4096
_REACH_MM = 15.0  # a reading farther from the middle of all is no floor
_LEAST_READ = 0.25  # of the pixels: a frame that shows less of the floor keeps its level
_LEAST_MM = 2.0  # of the levels' range from 5 to 95 %: less is a camera's noise
_MOST_MM = 30.0  # more is another scene, or a camera that was pushed
_ROUGH = 0.25  # of that range may be the step from one frame of the sample to the next
_FIRST = 0.05  # of the sample is the beginning of the recording


@dataclass(frozen=True)
class FloorLevel:
    """Where the floor is looked at, and what was read there at the beginning.

    Attributes:
        rows: (m,) of the pixels, in the grid of the scene.
        columns: (m,) of the pixels.
        depth_mm: (m,) float32, the background there.
        wander_mm: range of the levels from 5 to 95 %, mm.
    """

    rows: NDArray[np.int64]
    columns: NDArray[np.int64]
    depth_mm: NDArray[np.float32]
    wander_mm: float = 0.0

    @staticmethod
    def on(background: Depths, on_floor: NDArray[np.bool_]) -> FloorLevel:
        """The level of a background, looked at in some thousand pixels of its floor.

        Args:
            background: (H, W) float32 mm, 0 where unknown.
            on_floor: (H, W) bool, bare floor.
        """
        rows, columns = np.nonzero(on_floor & (background > 0))
        some = np.linspace(0, max(len(rows) - 1, 0), min(len(rows), _N_PIXELS)).astype(int)
        return FloorLevel(rows[some], columns[some], background[rows[some], columns[some]])

    def of(self, depths: Depths) -> Array:
        """How much farther than at the beginning the floor is read in frames.

        Args:
            depths: (n, H, W) float32 mm, 0 where unread, in the grid of the scene.

        Returns:
            (n,) mm; 0 where a frame shows too little of the floor.
        """
        check_shapes("frames", ("depths", depths, ("n", "H", "W")))
        levels = np.zeros(len(depths))
        for k, depth in enumerate(depths):
            read = depth[self.rows, self.columns]
            known = read > 0
            if known.sum() < max(1.0, _LEAST_READ * len(self.rows)):
                continue
            off = (read[known] - self.depth_mm[known]).astype(float)
            off = off[np.abs(off - np.median(off)) < _REACH_MM]
            levels[k] = off.mean() if len(off) else 0.0  # half is near, half far: no level
        return levels

    def brought_back(self, depths: Depths, levels: Array | None = None) -> Depths:
        """The frames with the floor where it was at the beginning.

        Args:
            depths: (n, H, W) float32 mm, 0 where unread, in the grid of the scene.
            levels: (n,) mm, of the frames; None measures them.

        Returns:
            (n, H, W) float32 mm, 0 where unread.
        """
        off = (self.of(depths) if levels is None else levels).astype(np.float32)
        return np.where(depths > 0, depths - off[:, None, None], np.float32(0))

    def every(self, step: int) -> FloorLevel:
        """The same in pictures of every `step`-th row and column.

        Args:
            step: pixels from one to the next, at least 1.
        """
        kept = (self.rows % step == 0) & (self.columns % step == 0)
        return FloorLevel(
            self.rows[kept] // step,
            self.columns[kept] // step,
            self.depth_mm[kept],
            self.wander_mm,
        )


def wandering(levels: Array) -> tuple[float, float] | None:
    """Whether the floor's level wanders slowly and by more than noise.

    Args:
        levels: (n,) mm, of frames spread over a recording, in order of time.

    Returns:
        The level at the beginning and the range of all from 5 to 95 %, mm; None where it is still,
        or jumps.
    """
    if len(levels) < 2:
        return None
    low, high = np.percentile(levels, [5, 95])
    wander = float(high - low)
    rough = float(np.abs(np.diff(levels)).mean())
    if not _LEAST_MM <= wander <= _MOST_MM or rough > _ROUGH * wander:
        return None
    first = max(3, round(_FIRST * len(levels)))
    return float(np.median(levels[:first])), wander


# Floor that is never read: the mirror image of the camera in a glossy floor, dark patches.


Mask = NDArray[np.bool_]

_READ = 0.5  # of the frames: what is read less often is a hole
_AROUND = 0.7  # of what surrounds a hole is floor
_FLAT_MM = 15.0  # this near to the plane


def unread_floor(
    sample: NDArray[np.float32],
    background: NDArray[np.float32],
    bare: NDArray[np.float32],
    on_floor: Mask,
    min_height_mm: float,
    least_px: float,
) -> Mask:
    """Where the floor is unread and something else was taken for it.

    Args:
        sample: (n, H, W) float32 mm, frames spread over a recording, 0 where unread.
        background: (H, W) float32 mm, the farthest mode of each pixel, 0 where there is none.
        bare: (H, W) float32 mm, depth of the floor's plane.
        on_floor: (H, W) bool, the floor with what stands on it.
        min_height_mm: a background that stands out by less is the floor.
        least_px: pixels of a hole at least; smaller ones hide no animal.

    Returns:
        (H, W) bool: pixels whose background is not the floor but should be.
    """
    import cv2

    dark = on_floor & ((sample > 0).mean(axis=0) < _READ)
    raised = dark & (background > 0) & (bare - background > min_height_mm)
    found = np.zeros(dark.shape, np.bool_)
    if not raised.any():
        return found
    n, labels, stats, _ = cv2.connectedComponentsWithStats(dark.astype(np.uint8))
    flat = (background > 0) & (np.abs(background - bare) < _FLAT_MM)
    ring = np.ones((7, 7), np.uint8)
    for k in range(1, n):
        hole = labels == k
        if stats[k, cv2.CC_STAT_AREA] < least_px or not (hole & raised).any():
            continue
        around = (cv2.dilate(hole.astype(np.uint8), ring) > 0) & ~dark & (background > 0)
        if around.any() and flat[around].mean() > _AROUND:
            found |= hole & raised
    return found


# What sampled frames say of the empty scene: background, floor, and what is nearer than both.


SPREADS = 3.0  # an animal stands out by this many standard deviations of the background's own noise


@dataclass(frozen=True)
class Wanted:
    """What animal is looked for.

    Attributes:
        spine_mm: lengths of the smallest and the largest one, mm.
        min_height_mm: what stands out from the background by less is none.
        view: how such animals are looked at.
    """

    spine_mm: tuple[float, float]
    min_height_mm: float
    view: View

    @property
    def stands(self) -> bool:
        """Whether it stands on the floor; one that floats may be seen before anything."""
        return self.view.frame == VIEWS[0]

    @property
    def smallest_mm2(self) -> float:
        """Area of the smallest one as it is seen, mm^2."""
        return self.view.area[0] * self.spine_mm[0] ** 2

    @property
    def largest_mm2(self) -> float:
        """Area of the largest one as it is seen, mm^2."""
        return self.view.area[1] * self.spine_mm[1] ** 2


@dataclass(frozen=True)
class BareGround:
    """The empty scene without what is known of its animal.

    Attributes:
        background: (H, W) float32 mm, 0 where unknown.
        spread: (H, W) float32 mm, its standard deviation.
        near: (H, W) float32 mm, the nearest usual depth.
        standing: the floor that was found.
        camera: whose pixels these are.
        wanted: what animal is looked for.
    """

    background: Depths
    spread: Depths
    near: Depths
    standing: Standing
    camera: Camera
    wanted: Wanted

    @staticmethod
    def learn(
        sample: Depths,
        camera: Camera,
        wanted: Wanted,
        stated: Floor | None = None,
        region: NDArray[np.bool_] | None = None,
    ) -> BareGround:
        """The ground that a sample of frames shows.

        Args:
            sample: (n, H, W) float32 mm, frames spread over a recording.
            camera: whose pixels these are.
            wanted: what animal is looked for.
            stated: the floor where a person states it, in the pixels of the camera.
            region: (H, W) bool, where it is looked at; None everywhere.

        Raises:
            EstimationError: no depth was read, nothing comes back often enough, or no floor was
                found.
        """
        background, spread, near = learn_background(sample)
        _check_background(sample, background)
        seen = SampledScene(
            sample, background, spread, camera, wanted.spine_mm, wanted.min_height_mm, wanted.view
        )
        standing = find_standing(seen, stated)
        if region is not None:
            standing = replace(standing, region=region, on_floor=standing.on_floor & region)
        if standing.region is not None:  # what lies around is not looked at
            background = np.where(standing.region, background, np.float32(0))
            near = np.where(standing.region, near, np.float32(0))
        return BareGround(background, spread, near, standing, camera, wanted)

    @staticmethod
    def steady(
        sample: Depths,
        camera: Camera,
        wanted: Wanted,
        floor: Floor | None = None,
        region: NDArray[np.bool_] | None = None,
    ) -> tuple[BareGround, Depths, FloorLevel | None]:
        """The same, where the floor's depth wanders from frames brought back to its beginning.

        Args:
            sample: (n, H, W) float32 mm, frames spread over a recording.
            camera: whose pixels these are.
            wanted: what animal is looked for.
            floor: the floor where a person states it, in any camera's pixels.
            region: (H, W) bool, where it is looked at; None everywhere.

        Returns:
            The ground, the sample at one level, and what brings frames there, None where the floor
            is still.

        Raises:
            EstimationError: as `learn`.
        """
        stated = (
            None if floor is None else Floor.from_plane(floor.normal, floor.distance_mm, camera)
        )
        ground = BareGround.learn(sample, camera, wanted, stated, region)
        level = ground.level
        levels = level.of(sample) if wanted.stands else np.empty(0)
        wander = wandering(levels) if wanted.stands else None
        if wander is None:
            return ground, sample, None
        first, range_mm = wander
        sample = level.brought_back(sample, levels - first)
        ground = BareGround.learn(sample, camera, wanted, stated, region)
        return ground, sample, replace(ground.level, wander_mm=range_mm)

    def _sampled(self, sample: Depths) -> SampledScene:
        """A sample (n, H, W) mm, and what is known of the empty scene."""
        wanted = self.wanted
        return SampledScene(
            sample,
            self.background,
            self.spread,
            self.camera,
            wanted.spine_mm,
            wanted.min_height_mm,
            wanted.view,
        )

    def under(self, sample: Depths, places: list[NDArray[np.bool_]]) -> BareGround:
        """The same with the plane of the ground on which an animal keeps still, see `levelled`.

        Args:
            sample: (n, H, W) float32 mm, the frames that it was learned from.
            places: (H, W) bool each, the animal's pixels in some frames.
        """
        things = [thing_at(own, self.background, self.camera, k) for k, own in enumerate(places)]
        return replace(self, standing=levelled(self.standing, self._sampled(sample), things))

    @property
    def level(self) -> FloorLevel:
        """The level of its bare floor."""
        return FloorLevel.on(
            self.background, self.standing.on_floor & near_plane(self.background, self._bare)
        )

    @property
    def _bare(self) -> Depths:
        """Depth (H, W) mm of the floor's plane."""
        return self.standing.floor.depth(self.camera.width, self.camera.height)

    def background_and_limit(self, sample: Depths) -> tuple[Depths, Depths]:
        """The background with the floor's plane where it is unknown, and the limit before it.

        Args:
            sample: (n, H, W) float32 mm, the frames that the ground was learned from.

        Returns:
            Both (H, W) float32 mm; what is nearer than the limit stands out.
        """
        background = self.background
        spread = self.spread
        bare = self._bare
        on_floor = self.standing.on_floor
        min_height_mm = self.wanted.min_height_mm
        if self.wanted.stands:
            px_mm2 = self.standing.floor.distance_mm**2 / (self.camera.fx * self.camera.fy)
            least_px = self.wanted.smallest_mm2 / px_mm2
            dark = unread_floor(sample, background, bare, on_floor, min_height_mm, least_px)
            background = np.where(dark, np.float32(0), background)
            spread = np.where(dark, np.float32(0), spread)
        background = np.where((background == 0) & on_floor, bare, background)
        behind = np.where(on_floor, background, self.near)
        margin = np.maximum(np.float32(min_height_mm), np.float32(SPREADS) * spread)
        return background, np.maximum(behind - margin, 0).astype(np.float32)


def _check_background(sample: Depths, background: Depths) -> None:
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
