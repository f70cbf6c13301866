"""Worn devices, such as a cable or a head stage, and their removal from depth images."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar, Self

import cv2
import numpy as np
from numpy.typing import NDArray

from liex_lab.optics.camera import Camera
from liex_lab.runtime.memory import check_shapes
from liex_lab.runtime.processes import side_by_side
from liex_lab.scene.floor import Depths, Floor, Mask, components
from liex_lab.scene.support_plane import TargetAnimal

_SQUARE = np.ones((3, 3), np.uint8)


def find_worn(
    sample: Depths, limit: Depths, floor: Floor, camera: Camera, target: TargetAnimal
) -> tuple[tuple[Worn, ...], Depths]:
    """The devices that an animal wears, in the order of their removal, and the sample without them.

    Args:
        sample: (n, H, W) float32 mm, frames spread over a recording, 0 where unread.
        limit: (H, W) float32 mm; a reading below it is foreground.
        floor: the floor in these pixels.
        camera: of these pixels.
        target: the animal.
    """
    found: list[Worn] = []
    cable = Cable.find(sample, limit, camera, floor, target.spine_mm[1], target.smallest_mm2)
    if cable is not None:
        whole, sample = sample, cable.cut(sample, limit)
        found.append(cable.with_fixed(whole, sample))
    stage = HeadStage.find(sample, limit, camera, floor, target.smallest_mm2)
    if stage is not None:
        sample = stage.cut(sample, limit)
        found.append(stage)
    return tuple(found), sample


@dataclass(frozen=True)
class Worn(ABC):
    """How a worn device is separated from the animal in one camera's images.

    Attributes:
        camera: of the analysed pixels.
        floor: the floor in pixels of that camera.
        wide_mm: a body is wider, the device is not.
        remark: what was corrected, as a sentence.
    """

    camera: Camera
    floor: Floor
    wide_mm: ClassVar[float]
    remark: ClassVar[str]

    def cut(self, depths: Depths, limit: Depths) -> Depths:
        """The frames without the device.

        Args:
            depths: (n, H, W) float32 mm, 0 where unread.
            limit: (H, W) float32 mm; a reading below it is foreground.

        Returns:
            (n, H, W) float32 mm, a copy; its pixels are 0, or the animal beneath interpolated from
            the body around it.
        """
        check_shapes("frames", ("depths", depths, ("n", *limit.shape)))
        out = depths.copy()
        for depth in out:
            self._cut_one(depth, self._heights(depth, limit))
        return out

    def worn(self, depths: Depths, limit: Depths) -> Mask:
        """Pixels (n, H, W) to clear in frames that are shown; see `cut` for the arguments."""
        return np.zeros(depths.shape, np.bool_)

    def every(self, step: int) -> Self:
        """The same for every `step`-th row and column of the image."""
        camera = self.camera.every(step)
        return replace(self, camera=camera, floor=self.floor.for_camera(camera))

    @abstractmethod
    def _cut_one(self, depth: Depths, height: Depths) -> None:
        """Remove the device from an image (H, W), in place, whose heights (H, W) mm are given."""

    @property
    def _px_mm(self) -> float:
        """Width of a pixel on the floor, mm."""
        return self.floor.distance_mm / float(np.sqrt(self.camera.fx * self.camera.fy))

    @property
    def _side(self) -> int:
        """Width in pixels, odd, of the smallest square that no such device fills."""
        return max(3, int(self.wide_mm / self._px_mm + 0.5) | 1)

    @cached_property
    def _inverse(self) -> NDArray[np.float64]:
        """(H, W) 1 / mm, of the floor's depth under every pixel."""
        rows, columns = np.mgrid[: self.camera.height, : self.camera.width]
        return self.floor.inverse_at(columns, rows)

    def _heights(self, depth: Depths, limit: Depths) -> Depths:
        """Heights (H, W) mm above the floor of an image's foreground, 0 for background."""
        near = (depth > 0) & (depth < limit)
        height = np.zeros(depth.shape, np.float32)
        above = self.floor.distance_mm * (1.0 - depth[near] * self._inverse[near])
        height[near] = np.maximum(above, 0.0)
        return height

    def _wide(self, height: NDArray[Any]) -> Depths:
        """Heights (H, W) of the parts that are wider than the device."""
        # a one-pixel hole does not split a body
        closed = cv2.morphologyEx(height, cv2.MORPH_CLOSE, _SQUARE)
        return np.asarray(
            cv2.morphologyEx(closed, cv2.MORPH_OPEN, np.ones((self._side,) * 2, np.uint8)),
            np.float32,
        )

    def _replace(self, depth: Depths, height: Depths, worn: Mask, most_mm: float = np.inf) -> None:
        """Replace pixels of an image by the animal beneath, at most `most_mm` high, in place."""
        over = np.ones((2 * self._side + 1,) * 2, np.uint8)
        under = cv2.morphologyEx(np.where(worn, np.float32(0), height), cv2.MORPH_CLOSE, over)
        under = np.minimum(under, np.float32(most_mm))
        filled = worn & (under > 0) & (self._inverse > 0)
        depth[worn] = 0.0
        depth[filled] = (1.0 - under[filled] / self.floor.distance_mm) / self._inverse[filled]


# Head stages: blocks cemented to the skull, which protrude from the animal on all sides.


_AREA_MM2 = (30.0, 260.0)  # from above
_TIMES_AREA = 2.0  # a larger block is something else, such as a raised head


@dataclass(frozen=True)
class HeadStage(Worn):
    """How a head stage is separated from the animal in one camera's images.

    Attributes:
        area_mm2: its usual area from above, mm^2.
    """

    area_mm2: float
    wide_mm = 13.0
    remark = "a head stage on the animal was removed from the images"

    @staticmethod
    def find(
        sample: Depths, limit: Depths, camera: Camera, floor: Floor, area_mm2: float
    ) -> HeadStage | None:
        """Find the head stage of a sample's animal; None if it wears none.

        Args:
            sample: (n, H, W) float32 mm, frames spread over a recording, 0 where unread.
            limit: (H, W) float32 mm; a reading below it is foreground.
            camera: of these pixels.
            floor: the floor in these pixels.
            area_mm2: area of the smallest animal, mm^2.
        """
        largest = HeadStage(camera, floor, _AREA_MM2[1] / _TIMES_AREA)

        def inspect(depth: Depths) -> tuple[bool, list[float]]:
            """Whether a frame shows something as large as an animal, and its blocks' areas, px."""
            height = largest._heights(depth, limit)
            shows = bool(np.count_nonzero(height) * largest._px_mm**2 > area_mm2)
            return shows, [float(block.sum()) for block, _ in largest._blocks(height)]

        found = side_by_side(inspect, list(sample))
        worn = [max(areas) for _, areas in found if areas]
        # of the frames with an animal show one
        if not worn or len(worn) < 0.6 * sum(shows for shows, _ in found):
            return None
        return replace(largest, area_mm2=float(np.median(worn)) * largest._px_mm**2)

    def _blocks(self, height: Depths) -> Iterator[tuple[Mask, float]]:
        """The blocks (H, W) bool of an image's heights (H, W) mm that protrude on all sides, and
        the height of the body around each, mm.
        """
        rows, columns = (np.flatnonzero((height != 0).any(axis=axis)) for axis in (1, 0))
        if not len(rows):
            return
        margin = self._side
        cut = (
            slice(max(0, int(rows[0]) - margin), int(rows[-1]) + margin + 1),
            slice(max(0, int(columns[0]) - margin), int(columns[-1]) + margin + 1),
        )
        # single readings are noise, and a one-pixel hole does not split a body
        smooth = np.asarray(cv2.medianBlur(np.ascontiguousarray(height[cut]), 3))
        # narrow parts rise this far above the wide one
        narrow = (smooth - self._wide(smooth) > 5.0) & (smooth > 0)
        labels, stats = components(narrow.astype(np.uint8))
        least, most = (value / self._px_mm**2 for value in _AREA_MM2)
        most = min(most, _TIMES_AREA * self.area_mm2 / self._px_mm**2)
        beside = np.ones((5, 5), np.uint8)
        for k in range(1, len(stats)):
            if stats[k, cv2.CC_STAT_AREA] < least:
                continue
            part = labels == k
            ring = (cv2.dilate(part.astype(np.uint8), beside) > 0) & ~part
            body = smooth[ring & (smooth > 0)]
            if len(body) < 0.3 * ring.sum():  # more is not needed, as the head ends in front
                continue
            around = float(np.median(body))
            step = float(np.percentile(smooth[part], 80)) - around
            # higher pixels are the block, not the head
            block = part & (smooth > around + 0.4 * step)
            if step > 6.0 and least <= block.sum() <= most:  # and above the surrounding body
                out = np.zeros(height.shape, np.bool_)
                out[cut] = block
                yield out, around

    def _cut_one(self, depth: Depths, height: Depths) -> None:
        for block, around in self._blocks(height):
            # the readings beside it are of both
            worn = cv2.dilate(block.astype(np.uint8), _SQUARE) > 0
            self._replace(depth, height, worn & (block | (height > around)), around)


# Cables and fibres: thin objects that rise from the animal beyond its own reach.


_LINK_PX = 2  # largest unread gap in a cable
_JOINED_PX = 3  # largest distance of a cable from the body it leads to


@dataclass(frozen=True)
class Cable(Worn):
    """How cables are separated from the animal in one camera's images.

    Attributes:
        tall_mm: no animal reaches higher above the floor.
        fixed: (H, W) bool, thin parts of the arena itself above the floor, such as a lid's bars;
            None if unknown.
    """

    tall_mm: float
    fixed: Mask | None = None
    wide_mm = 10.0
    remark = "something thin above the animal, a cable or bars, was removed from the images"

    @staticmethod
    def find(
        sample: Depths,
        limit: Depths,
        camera: Camera,
        floor: Floor,
        longest_mm: float,
        area_mm2: float,
    ) -> Cable | None:
        """Find the cable of a sample's animal.

        Args:
            sample: (n, H, W) float32 mm, frames spread over a recording, 0 where unread.
            limit: (H, W) float32 mm; a reading below it is foreground.
            camera: of these pixels.
            floor: the floor in these pixels.
            longest_mm: length of the largest expected animal, mm.
            area_mm2: area of the smallest, mm^2.

        Returns:
            None if too few frames show a cable that leads to something of an animal's size.
        """
        cable = Cable(camera, floor, 1.2 * longest_mm)  # beyond the reach of the largest animal
        if not cable._rises(sample, limit):
            return None
        least_px = area_mm2 * camera.fx * camera.fy / floor.distance_mm**2
        found = [cable._leads_to_one(depth, limit, least_px) for depth in sample]
        with_one = [leads for leads in found if leads is not None]
        # of the frames with a body: a flickering edge is rarer
        return cable if with_one and np.mean(with_one) >= 0.3 else None

    def with_fixed(self, sample: Depths, cut: Depths) -> Cable:
        """The same with the thin parts of the arena itself.

        Args:
            sample: (n, H, W) float32 mm, frames spread over a recording.
            cut: (n, H, W) the result of `cut`.

        Returns:
            A cable whose `fixed` marks the pixels that were cut in most frames.
        """
        share = np.mean([a != b for a, b in zip(sample, cut, strict=True)], axis=0)
        # the mixed readings beside them belong to the arena, too
        return replace(
            self, fixed=cv2.dilate((share > 0.5).astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
        )

    def every(self, step: int) -> Cable:
        """The same for every `step`-th row and column of the image."""
        fixed = None if self.fixed is None else np.ascontiguousarray(self.fixed[::step, ::step])
        return replace(super().every(step), fixed=fixed)

    def worn(self, depths: Depths, limit: Depths) -> Mask:
        """Pixels (n, H, W) of worn cables, without parts of the arena; see `cut`."""
        worn = self.cut(depths, limit) != depths
        return np.asarray(worn if self.fixed is None else worn & ~self.fixed)

    def _rises(self, sample: Depths, limit: Depths) -> bool:
        """Whether anything in a sample (n, H, W) may reach higher than an animal."""
        with np.errstate(divide="ignore"):
            above = (1.0 - self.tall_mm / self.floor.distance_mm) / self._inverse
        above = np.where(self._inverse > 0, 1.00001 * above, np.inf)  # allows for rounding
        nearer = np.minimum(above, limit).astype(np.float32)
        return any(bool(((depth > 0) & (depth < nearer)).any()) for depth in sample)

    def _cut_one(self, depth: Depths, height: Depths) -> None:
        wide = self._wide(height)
        body = wide[(wide > 0) & (wide < self.tall_mm)]
        # the back, as a quantile of the wide parts' heights
        back = float(np.percentile(body, 95.0)) if len(body) else 0.0
        worn = np.zeros(depth.shape, np.bool_)
        for part in self._parts(height, wide):
            # a snout is as narrow as a cable, but no higher than the back
            worn |= part & ((wide > 0) | (height > back))
        if worn.any():  # the readings beside it are of both
            self._replace(depth, height, cv2.dilate(worn.astype(np.uint8), _SQUARE) > 0)

    def _parts(self, height: Depths, wide: Depths) -> Iterator[Mask]:
        """The cables of an image, one at a time."""
        # a cable rises this far above its surroundings
        thin = (height - wide > 6.0) | (height > self.tall_mm)
        if not (height > self.tall_mm).any():
            return
        reach = np.ones((2 * _LINK_PX + 1, 2 * _LINK_PX + 1), np.uint8)
        labels, stats = components(cv2.dilate(thin.astype(np.uint8), reach))
        tall = np.unique(labels[thin & (height > self.tall_mm)])
        for k in tall[tall > 0]:
            run = max(stats[k, cv2.CC_STAT_WIDTH], stats[k, cv2.CC_STAT_HEIGHT])
            if run * self._px_mm >= 40.0:  # its least extent in the image
                yield thin & (labels == k)

    def _leads_to_one(self, depth: Depths, limit: Depths, least_px: float) -> bool | None:
        """Whether a cable leads to something wide of an animal's size; None without such a body."""
        height = self._heights(depth, limit)
        wide = self._wide(height)
        labels, stats = components(((wide > 0) & (wide < self.tall_mm)).astype(np.uint8))
        large = 1 + np.flatnonzero(stats[1:, cv2.CC_STAT_AREA] >= least_px)
        if not len(large):
            return None
        reach = np.ones((2 * _JOINED_PX + 1, 2 * _JOINED_PX + 1), np.uint8)
        around = cv2.dilate(np.isin(labels, large).astype(np.uint8), reach) > 0
        return any(bool((part & around).any()) for part in self._parts(height, wide))
