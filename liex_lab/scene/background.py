"""Per-pixel background model of a depth recording: the farthest mode of its readings over time.

An animal is always nearer than what it covers, so the background of a pixel is the farthest
recurring depth, neither the median nor the most frequent depth: a pixel covered nine tenths of the
time still shows its background. A mode is a cluster of at least a twentieth of the pixel's readings
(and at least 3) within 6 mm or 1.2 % of the depth; its median is the background, half of its 16 to
84 % range the standard deviation. The kernel is `far_modes`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from liex_lab.errors import EstimationError
from liex_lab.optics.camera import Camera
from liex_lab.recordings.recording import Recording
from liex_lab.runtime.memory import check_shapes
from liex_lab.runtime.processes import in_parallel
from liex_lab.scene import _height_map_kernels as kernels
from liex_lab.scene.floor import Array, Depths, Floor, Mask, near_plane, parts
from liex_lab.scene.support_plane import (
    SampledScene,
    SupportPlane,
    TargetAnimal,
    find_support_plane,
    levelled,
    still_object,
)

_ROWS = 32  # of pixels whose readings are sorted at once
_CELLS = 8  # of the image per side, inspected for noise


def sampled(n: int, most: int) -> NDArray[np.int64]:
    """Indices of at most `most` frames spread evenly over a recording of n."""
    return np.unique(np.linspace(0, n - 1, min(most, n)).astype(np.int64))


def sample_frames(recording: Recording, n_frames: int, stride: int = 1) -> NDArray[np.float32]:
    """Frames spread evenly over a recording, thinned to every `stride`-th pixel.

    Args:
        recording: to read from.
        n_frames: frames at most; all of a shorter recording.
        stride: step along rows and columns, px.

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
    """Whether the sensor has noise: two depth images differ nearly everywhere, not only at the
    animal.

    Without noise, as in a rendered recording, images of a still scene may be identical.

    Args:
        sample: (n, H, W) float32 mm, 0 where unread, frames spread over the recording.
    """
    shares = []
    cells = [np.unique(np.arange(_CELLS) * n // _CELLS) for n in sample.shape[1:]]
    for before, after in pairwise(sample[:: max(1, len(sample) // 32)]):  # about 32 pairs of frames
        changed, read = (
            np.maximum.reduceat(np.maximum.reduceat(where, cells[0]), cells[1], axis=1)
            for where in (before != after, (before > 0) | (after > 0))
        )
        if changed.any():
            shares.append(float(changed.sum() / read.sum()))
    # noise changes readings in at least this share of the cells, a moving animal only its own
    return len(shares) > 0 and float(np.median(shares)) > 0.8


def usual_depth(depth_images: NDArray[Any]) -> NDArray[Any]:
    """Median of each pixel over the images in which it was read.

    Args:
        depth_images: (n, ...) mm, 0 where unread.

    Returns:
        (...) mm of the same type, 0 where never read.
    """
    ordered = np.sort(depth_images, axis=0)
    unread = (ordered == 0).sum(axis=0)
    middle = np.minimum(unread + (len(ordered) - unread) // 2, len(ordered) - 1)
    return np.asarray(np.take_along_axis(ordered, middle[None], axis=0)[0])


def stride_for(recording: Recording, length_mm: float) -> int:
    """The largest stride, 1 to 4, at which the animal remains at least 64 pixels long.

    Args:
        recording: its first and middle frame give the typical depth; 1 if both are unread.
        length_mm: of the smallest animal.
    """
    for index in {0, len(recording) // 2}:
        depth = recording.frame(index).depth
        if (depth > 0).any():
            px = length_mm * recording.camera.fx / float(np.median(depth[depth > 0]))
            return min(4, max(1, int(px / 64.0)))
    return 1


def learn_background(
    sample: NDArray[np.float32] | Recording,
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """Background depth, its spread, and the nearest usual depth of every pixel.

    Args:
        sample: (n, H, W) float32 mm, 0 where unread; or a recording, of which 96 frames are
            sampled.

    Returns:
        Three arrays (H, W) float32 mm, 0 where never read: depth of the farthest mode, its standard
        deviation, and the 5 % quantile of the depth.
    """
    stack = sample if isinstance(sample, np.ndarray) else sample_frames(sample, 96)
    check_shapes("a sample", ("frames", stack, ("n", "H", "W")))
    found = np.zeros((3, *stack.shape[1:]), np.float32)
    # readings within 1.2 % or 6 mm belong to one surface; a twentieth of a pixel's readings may
    # be nearer than its nearest usual depth
    numbers = [np.float32(value) for value in (0.012, 6.0, 0.05)]
    for start in range(0, stack.shape[1], _ROWS):
        rows = slice(start, start + _ROWS)
        # numpy sorts many short rows five times as fast as a compiled loop does
        ordered = np.ascontiguousarray(stack[:, rows].reshape(len(stack), -1).T)
        ordered.sort(axis=1)
        depth, spread, near = (np.ravel(one[rows]) for one in found)
        in_parallel(kernels.far_modes, len(ordered), ordered, *numbers, depth, spread, near)
    return found[0], found[1], found[2]


# The floor's level while a sensor warms up: the measured depth of the same floor drifts.


@dataclass(frozen=True)
class FloorLevel:
    """Pixels of the floor and their initial depth, as a reference for depth drift.

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
        """The reference level of a background, from a few thousand pixels of its floor.

        Args:
            background: (H, W) float32 mm, 0 where unknown.
            on_floor: (H, W) bool, bare floor.
        """
        rows, columns = np.nonzero(on_floor & (background > 0))
        some = np.linspace(0, max(len(rows) - 1, 0), min(len(rows), 4096)).astype(int)
        return FloorLevel(rows[some], columns[some], background[rows[some], columns[some]])

    def of(self, depths: Depths) -> Array:
        """Offset of the floor's depth from its initial level in each frame.

        Args:
            depths: (n, H, W) float32 mm, 0 where unread, in the grid of the scene.

        Returns:
            (n,) mm; 0 where a frame shows too little of the floor.
        """
        check_shapes("frames", ("depths", depths, ("n", "H", "W")))
        levels = np.zeros(len(depths))
        for k, depth in enumerate(depths):
            read = depth[self.rows, self.columns]
            valid = read > 0
            if valid.sum() < max(1.0, 0.25 * len(self.rows)):  # too little of the floor is read
                continue
            off = (read[valid] - self.depth_mm[valid]).astype(float)
            off = off[np.abs(off - np.median(off)) < 15.0]  # farther from the median is no floor
            levels[k] = off.mean() if len(off) else 0.0  # no reading near the median: no level
        return levels

    def brought_back(self, depths: Depths, levels: Array | None = None) -> Depths:
        """The frames with the floor corrected to its initial level.

        Args:
            depths: (n, H, W) float32 mm, 0 where unread, in the grid of the scene.
            levels: (n,) mm, of the frames; None to measure them.

        Returns:
            (n, H, W) float32 mm, 0 where unread.
        """
        off = (self.of(depths) if levels is None else levels).astype(np.float32)
        return np.where(depths > 0, depths - off[:, None, None], np.float32(0))

    def every(self, step: int) -> FloorLevel:
        """The same level for every `step`-th row and column of the image."""
        kept = (self.rows % step == 0) & (self.columns % step == 0)
        return FloorLevel(
            self.rows[kept] // step,
            self.columns[kept] // step,
            self.depth_mm[kept],
            self.wander_mm,
        )


def wandering(levels: Array) -> tuple[float, float] | None:
    """Whether the floor's level drifts slowly and by more than noise.

    Args:
        levels: (n,) mm, of frames spread over a recording, in order of time.

    Returns:
        The initial level and the range of all from 5 to 95 %, mm; None if it is constant or jumps.
    """
    if len(levels) < 2:
        return None
    low, high = np.percentile(levels, [5, 95])
    wander = float(high - low)
    # less is noise, more another scene or a displaced camera; a rough course is no drift
    if not 2.0 <= wander <= 30.0 or float(np.abs(np.diff(levels)).mean()) > 0.25 * wander:
        return None
    first = max(3, round(0.05 * len(levels)))  # the beginning
    return float(np.median(levels[:first])), wander


# Floor that is never read: the mirror image of the camera in a glossy floor, dark patches.


_FLAT_MM = 15.0  # distance from the plane


def unread_floor(
    sample: NDArray[np.float32],
    background: NDArray[np.float32],
    bare: NDArray[np.float32],
    on_floor: Mask,
    min_height_mm: float,
    least_px: float,
) -> Mask:
    """Where the floor is unread and something else was mistaken for it.

    Args:
        sample: (n, H, W) float32 mm, frames spread over a recording, 0 where unread.
        background: (H, W) float32 mm, the farthest mode of each pixel, 0 if absent.
        bare: (H, W) float32 mm, depth of the floor's plane.
        on_floor: (H, W) bool, the floor including objects on it.
        min_height_mm: a background that rises less is the floor.
        least_px: smallest hole that can hide an animal, px.

    Returns:
        (H, W) bool: pixels whose background should be the floor but is not.
    """
    dark = on_floor & ((sample > 0).mean(axis=0) < 0.5)  # holes: read in fewer frames
    raised = dark & (background > 0) & (bare - background > min_height_mm)
    flat = (background > 0) & (np.abs(background - bare) < _FLAT_MM)
    found = np.zeros(dark.shape, np.bool_)
    for hole in parts(dark, least_px) if raised.any() else ():
        ring = cv2.dilate(hole.astype(np.uint8), np.ones((7, 7), np.uint8)) > 0
        around = ring & ~dark & (background > 0)
        # the share of a hole's surroundings that is floor
        if (hole & raised).any() and around.any() and flat[around].mean() > 0.7:
            found |= hole & raised
    return found


# A lasting change of the scene: the camera was displaced, or its scene rearranged.


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
            area_mm2: the animal's usual area from above, mm^2.

        Returns:
            The change; None if the scene does not change, or too few frames are given.
        """
        check_shapes("frames", ("sample", sample, ("n", "H", "W")), ("times_s", times_s, ("n",)))
        n_parts = min(4, len(sample) // 8)  # of at least 8 frames each
        if n_parts < 2:
            return None
        step = max(1, int(np.sqrt(sample[0].size / 10_000)))  # of about 10,000 pixels
        depths = sample[:, ::step, ::step].reshape(len(sample), -1)
        usual = [_usual(part) for part in np.array_split(depths, n_parts)]
        found = None
        for a, b in [*zip(range(n_parts), range(1, n_parts), strict=False), (0, n_parts - 1)]:
            read = (usual[a] > 0) & (usual[b] > 0)
            # more than the drift and noise that remain in a median
            changed_px = read & (np.abs(usual[b] - usual[a]) > 12.0)
            share = float(changed_px.sum() / max(read.sum(), 1))
            pixels_mm2 = (step * usual[a][changed_px].astype(float)) ** 2 / (camera.fx * camera.fy)
            is_more = share > (found[0] if found else 0.06)  # of the readings
            # the animal's own movement changes up to two of its areas
            if is_more and pixels_mm2.sum() > 4.0 * area_mm2:
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
    return np.where(2 * (depths > 0).sum(axis=0) >= len(depths), usual_depth(depths), np.float32(0))


# The empty scene of sampled frames: background, floor and foreground limit.


SPREADS = 3.0  # least height of an animal in standard deviations of the background


def sampled_scene(sample: Depths, camera: Camera, target: TargetAnimal) -> SampledScene:
    """The scene of sampled frames with its background; see `SampledScene` for the arguments."""
    return SampledScene(sample, *learn_background(sample), camera, target)


@dataclass(frozen=True)
class BareGround:
    """The empty scene before its animal is identified.

    Attributes:
        scene: the sampled frames and their background, which is unknown outside of the region.
        support_plane: the detected floor.
    """

    scene: SampledScene
    support_plane: SupportPlane

    @staticmethod
    def learn(
        sample: Depths,
        camera: Camera,
        target: TargetAnimal,
        stated: Floor | None = None,
        region: Mask | None = None,
    ) -> BareGround:
        """Learn the ground from a sample of frames.

        Args:
            sample: (n, H, W) float32 mm, frames spread over a recording.
            camera: of these pixels.
            target: the animal to detect.
            stated: the floor stated in the plan, in pixels of the camera.
            region: (H, W) bool, analysed pixels; None for all.

        Raises:
            EstimationError: no depth was read, no depth recurs often enough, or no floor was found.
        """
        scene = sampled_scene(sample, camera, target)
        n = len(sample)
        if not (sample > 0).any():
            raise EstimationError(
                f"no depth was read in {n} frames spread over the recording; check the camera, its "
                "range and its cable"
            )
        if not (scene.background > 0).any():
            raise EstimationError(
                "the background, the depth that recurs in each pixel, cannot be learned from "
                f"{n} frame{'' if n == 1 else 's'}; record at least a few seconds"
            )
        plane = find_support_plane(scene, stated)
        if region is not None:
            plane = replace(plane, region=region, on_floor=plane.on_floor & region)
        if plane.region is not None:  # exclude the surroundings
            background, near = (
                np.where(plane.region, depth, np.float32(0))
                for depth in (scene.background, scene.near)
            )
            scene = replace(scene, background=background, near=near)
        return BareGround(scene, plane)

    @staticmethod
    def steady(
        sample: Depths,
        camera: Camera,
        target: TargetAnimal,
        floor: Floor | None = None,
        region: Mask | None = None,
    ) -> tuple[BareGround, FloorLevel | None]:
        """The same after correcting drift of the floor's depth.

        Args:
            sample: (n, H, W) float32 mm, frames spread over a recording.
            camera: of these pixels.
            target: the animal to detect.
            floor: the floor stated in the plan, in any camera's pixels.
            region: (H, W) bool, analysed pixels; None for all.

        Returns:
            The ground with the corrected sample, and the reference level, None if the floor does
            not drift.

        Raises:
            EstimationError: as `learn`.
        """
        stated = None if floor is None else floor.for_camera(camera)
        ground = BareGround.learn(sample, camera, target, stated, region)
        if not target.stands_on_floor:
            return ground, None
        levels = ground.level.of(sample)
        wander = wandering(levels)
        if wander is None:
            return ground, None
        sample = ground.level.brought_back(sample, levels - wander[0])
        ground = BareGround.learn(sample, camera, target, stated, region)
        return ground, replace(ground.level, wander_mm=wander[1])

    def under(self, masks: list[Mask]) -> BareGround:
        """The same with the plane fitted to the ground under a resting animal, see `levelled`.

        Args:
            masks: (H, W) bool each, the animal's pixels in some frames.
        """
        background, camera = self.scene.background, self.scene.camera
        movers = [still_object(own, background, camera, k) for k, own in enumerate(masks)]
        return replace(self, support_plane=levelled(self.support_plane, self.scene, movers))

    @cached_property
    def level(self) -> FloorLevel:
        """The level of its bare floor."""
        background = self.scene.background
        on_floor = self.support_plane.on_floor & near_plane(background, self._bare)
        return FloorLevel.on(background, on_floor)

    @property
    def _bare(self) -> Depths:
        """Depth (H, W) mm of the floor's plane."""
        camera = self.scene.camera
        return self.support_plane.floor.depth(camera.width, camera.height)

    def background_and_limit(self) -> tuple[Depths, Depths]:
        """The background, with the floor's plane where it is unknown, and the foreground limit.

        Returns:
            Both (H, W) float32 mm; readings below the limit are foreground.
        """
        scene, camera, target = self.scene, self.scene.camera, self.scene.target
        background, spread = scene.background, scene.spread
        bare, on_floor = self._bare, self.support_plane.on_floor
        if target.stands_on_floor:
            px_mm2 = self.support_plane.floor.distance_mm**2 / (camera.fx * camera.fy)
            least_px = target.smallest_mm2 / px_mm2
            dark = unread_floor(
                scene.sample, background, bare, on_floor, target.min_height_mm, least_px
            )
            background, spread = (
                np.where(dark, np.float32(0), values) for values in (background, spread)
            )
        background = np.where((background == 0) & on_floor, bare, background)
        behind = np.where(on_floor, background, scene.near)
        margin = np.maximum(np.float32(target.min_height_mm), np.float32(SPREADS) * spread)
        return background, np.maximum(behind - margin, 0).astype(np.float32)
