"""Worn devices, such as a cable or a head stage, and their removal from depth images."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from liex_lab.optics.camera import Camera
from liex_lab.runtime.shapes import check_shapes
from liex_lab.runtime.threads import side_by_side
from liex_lab.scene.floor import Floor


@dataclass(frozen=True)
class Worn:
    """How a worn device is separated from the animal in one camera's images.

    Attributes:
        camera: of the analysed pixels.
        floor: the floor in pixels of that camera.
    """

    camera: Camera
    floor: Floor

    def every(self, step: int) -> Self:
        """The same for every `step`-th row and column of the image."""
        camera = self.camera.every(step)
        floor = Floor.from_plane(self.floor.normal, self.floor.distance_mm, camera)
        return replace(self, camera=camera, floor=floor)

    @property
    def _px_mm(self) -> float:
        """Width of a pixel on the floor, mm."""
        return self.floor.distance_mm / float(np.sqrt(self.camera.fx * self.camera.fy))


# Heights of the foreground above the floor.


Depths = NDArray[np.float32]


def heights_before(depth: Depths, limit: Depths, floor: Floor) -> Depths:
    """Heights of readings nearer than the background's limit.

    Args:
        depth: (H, W) float32 mm, 0 where unread.
        limit: (H, W) float32 mm; a reading below it is foreground.
        floor: the floor in image pixels.

    Returns:
        (H, W) float32 mm above the floor's plane, 0 for background.
    """
    a, b, c = floor.inverse_depth
    rows, columns = np.nonzero((depth > 0) & (depth < limit))
    height = np.zeros(depth.shape, np.float32)
    inverse = a * columns + b * rows + c
    above = floor.distance_mm * (1.0 - depth[rows, columns] * inverse)
    height[rows, columns] = np.maximum(above, 0.0)
    return height


# Connected components of a mask, searched in its bounding box.


class Components(NamedTuple):
    """Connected components (8-connected) of a mask, in the order of `cv2.connectedComponents`.

    Attributes:
        labels: (H, W) int32, 0 outside, 1 and up inside.
        stats: (n, 5) int32, row k of component k: left, top, width, height, pixels (`cv2.CC_STAT_*`
            columns); row 0 is not filled.
    """

    labels: NDArray[np.int32]
    stats: NDArray[np.int32]


def components(mask: NDArray[np.uint8]) -> Components:
    """The connected components of a mask (H, W) uint8, nonzero inside."""
    import cv2

    left, top, width, height = cv2.boundingRect(mask)
    # OpenCV numbers components in the order of 2 x 2 blocks, so the box starts at an even pixel
    box = (slice(top - top % 2, top + height), slice(left - left % 2, left + width))
    labels = np.zeros(mask.shape, np.int32)
    if not width:
        return Components(labels, np.zeros((1, 5), np.int32))
    _, labels[box], stats, _ = cv2.connectedComponentsWithStats(mask[box])
    stats[:, cv2.CC_STAT_LEFT] += box[1].start
    stats[:, cv2.CC_STAT_TOP] += box[0].start
    stats[0] = 0
    return Components(labels, np.asarray(stats, np.int32))


# Head stages: blocks cemented to the skull, which protrude from the animal on all sides.


Mask = NDArray[np.bool_]

_WIDE_MM = 13.0  # a body is wider
_NARROW_MM = 5.0  # least height of a narrow part above the wide one
_STEP_MM = 6.0  # and above the surrounding body
_AREA_MM2 = (30.0, 260.0)  # seen from above
_BESIDE_PX = 2
_ON_BODY = 0.3  # least share of animal around it, as the head ends in front
_LEAST_SHARE = 0.6  # least share of the frames with an animal that show one
_TIMES_AREA = 2.0  # a larger block is something else, such as a raised head
_FOOT = 0.4  # of the step: higher pixels are the block, not the head


@dataclass(frozen=True)
class HeadStage(Worn):
    """How a head stage is separated from the animal in one camera's images.

    Attributes:
        camera: see `Worn`.
        floor: see `Worn`.
        area_mm2: its usual area seen from above, mm^2.
    """

    area_mm2: float

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
            height = heights_before(depth, limit, floor)
            shows = bool(np.count_nonzero(height) * largest._px_mm**2 > area_mm2)
            return shows, [float(block.sum()) for block, _ in largest._blocks(height)]

        found = side_by_side(inspect, list(sample))
        worn = [max(areas) for _, areas in found if areas]
        if not worn or len(worn) < _LEAST_SHARE * sum(shows for shows, _ in found):
            return None
        return replace(largest, area_mm2=float(np.median(worn)) * largest._px_mm**2)

    def cut(self, depths: Depths, limit: Depths) -> Depths:
        """The frames without it.

        Args:
            depths: (n, H, W) float32 mm, 0 where unread.
            limit: (H, W) float32 mm; a reading below it is foreground.

        Returns:
            (n, H, W) float32 mm, a copy; the head under the device is interpolated from the body
            around it.
        """
        check_shapes("frames", ("depths", depths, ("n", *limit.shape)))
        out = depths.copy()
        for depth in out:
            height = heights_before(depth, limit, self.floor)
            for block, around in self._blocks(height):
                self._cut_one(depth, height, block, around)
        return out

    @property
    def _side(self) -> int:
        """Width in pixels, odd, of the smallest square that no head stage fills."""
        return max(3, int(_WIDE_MM / self._px_mm + 0.5) | 1)

    def _blocks(self, height: Depths) -> Iterator[tuple[Mask, float]]:
        """The blocks (H, W) bool of an image's heights (H, W) mm that protrude on all sides, and
        the height of the body around each, mm.
        """
        import cv2

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
        closed = cv2.morphologyEx(smooth, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
        wide = cv2.morphologyEx(closed, cv2.MORPH_OPEN, np.ones((self._side,) * 2, np.uint8))
        labels, stats = components(((smooth - wide > _NARROW_MM) & (smooth > 0)).astype(np.uint8))
        least, most = (value / self._px_mm**2 for value in _AREA_MM2)
        most = min(most, _TIMES_AREA * self.area_mm2 / self._px_mm**2)
        beside = np.ones((2 * _BESIDE_PX + 1,) * 2, np.uint8)
        for k in range(1, len(stats)):
            if stats[k, cv2.CC_STAT_AREA] < least:
                continue
            part = labels == k
            ring = (cv2.dilate(part.astype(np.uint8), beside) > 0) & ~part
            body = smooth[ring & (smooth > 0)]
            if len(body) < _ON_BODY * ring.sum():
                continue
            around = float(np.median(body))
            step = float(np.percentile(smooth[part], 80)) - around
            block = part & (smooth > around + _FOOT * step)
            if step > _STEP_MM and least <= block.sum() <= most:
                out = np.zeros(height.shape, np.bool_)
                out[cut] = block
                yield out, around

    def _cut_one(self, depth: Depths, height: Depths, block: Mask, around: float) -> None:
        """Remove a block from an image (H, W) mm, in place, and fill in the head beneath."""
        import cv2

        # the readings beside it are of both
        worn = (cv2.dilate(block.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0) & (
            block | (height > around)
        )
        kept = np.where(worn, np.float32(0), height)
        over = np.ones((2 * self._side + 1,) * 2, np.uint8)
        under = np.minimum(cv2.morphologyEx(kept, cv2.MORPH_CLOSE, over), np.float32(around))
        a, b, c = self.floor.inverse_depth
        rows, columns = np.nonzero(worn)
        inverse = a * columns + b * rows + c
        filled = under[worn]
        depth[worn] = np.where(
            filled > 0, (1.0 - filled / self.floor.distance_mm) / inverse, 0.0
        ).astype(np.float32)


# Cables and fibres: thin objects that rise from the animal beyond its own reach.


_CABLE_WIDE_MM = 10.0  # a body is wider, a cable with its blurred edges is not
_RISE_MM = 6.0  # least height of a cable above its surroundings
_TALLER = 1.2  # in lengths of the largest animal: beyond its reach
_BACK = 95.0  # %: quantile of the wide parts' heights that is the back
_LINK_PX = 2  # largest unread gap in a cable
_JOINED_PX = 3  # largest distance of a cable from the body it leads to
_LEAST_RUN_MM = 40.0  # least extent in the image
_CABLE_LEAST_SHARE = 0.3  # of the frames with a body: a flickering edge is rarer
_FIXED = 0.5  # parts that are thin in more frames belong to the arena
_FIXED_EDGE_PX = 2  # as do the mixed readings beside them
_NEARLY = 1.00001  # allows for rounding


@dataclass(frozen=True)
class Cable(Worn):
    """How cables are separated from the animal in one camera's images.

    Attributes:
        camera: see `Worn`.
        floor: see `Worn`.
        tall_mm: no animal reaches higher above the floor.
        fixed: (H, W) bool, thin parts of the arena itself above the floor, such as a lid's bars;
            None if unknown.
    """

    tall_mm: float
    fixed: Mask | None = None

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
        cable = Cable(camera, floor, _TALLER * longest_mm)
        if not cable._rises(sample, limit):
            return None
        least_px = area_mm2 * camera.fx * camera.fy / floor.distance_mm**2
        found = [cable._leads_to_one(depth, limit, least_px) for depth in sample]
        with_one = [leads for leads in found if leads is not None]
        return cable if with_one and np.mean(with_one) >= _CABLE_LEAST_SHARE else None

    def cut(self, depths: Depths, limit: Depths) -> Depths:
        """The frames without cables.

        Args:
            depths: (n, H, W) float32 mm, 0 where unread.
            limit: (H, W) float32 mm; a reading below it is foreground.

        Returns:
            (n, H, W) float32 mm, a copy; cable pixels are 0, or the back beneath interpolated from
            the body around it.
        """
        check_shapes("frames", ("depths", depths, ("n", *limit.shape)))
        out = depths.copy()
        for depth in out:
            self._cut_one(depth, limit)
        return out

    def with_fixed(self, sample: Depths, cut: Depths) -> Cable:
        """The same with the thin parts of the arena itself.

        Args:
            sample: (n, H, W) float32 mm, frames spread over a recording.
            cut: (n, H, W) the result of `cut`.

        Returns:
            A cable whose `fixed` marks the pixels that were cut in most frames.
        """
        import cv2

        share = np.mean(
            [before != after for before, after in zip(sample, cut, strict=True)], axis=0
        )
        edge = np.ones((2 * _FIXED_EDGE_PX + 1,) * 2, np.uint8)
        return replace(self, fixed=cv2.dilate((share > _FIXED).astype(np.uint8), edge) > 0)

    def every(self, step: int) -> Cable:
        """The same for every `step`-th row and column of the image."""
        fixed = None if self.fixed is None else np.ascontiguousarray(self.fixed[::step, ::step])
        return replace(super().every(step), fixed=fixed)

    def worn(self, depths: Depths, limit: Depths) -> Mask:
        """Pixels (n, H, W) of worn cables, without parts of the arena.

        Args:
            depths: (n, H, W) float32 mm, 0 where unread.
            limit: (H, W) float32 mm; a reading below it is foreground.
        """
        worn = self.cut(depths, limit) != depths
        return np.asarray(worn if self.fixed is None else worn & ~self.fixed)

    @cached_property
    def _inverse(self) -> NDArray[np.float64]:
        """(H, W) 1 / mm, of the floor's depth under every pixel."""
        a, b, c = self.floor.inverse_depth
        rows, columns = np.mgrid[: self.camera.height, : self.camera.width]
        return np.asarray(a * columns + b * rows + c)

    @property
    def _side(self) -> int:
        """Width in pixels, odd, of the smallest square that no cable fills."""
        return max(3, int(_CABLE_WIDE_MM / self._px_mm + 0.5) | 1)

    def _rises(self, sample: Depths, limit: Depths) -> bool:
        """Whether anything in a sample (n, H, W) may reach higher than an animal."""
        with np.errstate(divide="ignore"):
            above = (1.0 - self.tall_mm / self.floor.distance_mm) / self._inverse
        above = np.where(self._inverse > 0, _NEARLY * above, np.inf)
        nearer = np.minimum(above, limit).astype(np.float32)
        return any(bool(((depth > 0) & (depth < nearer)).any()) for depth in sample)

    def _heights(self, depth: Depths, limit: Depths) -> tuple[Depths, Depths]:
        """Heights (H, W) mm of the foreground of an image, and of its wide parts."""
        import cv2

        above = self.floor.distance_mm * (1.0 - depth * self._inverse)
        near = (depth > 0) & (depth < limit)
        height = np.where(near, np.maximum(above, 0.0), 0.0).astype(np.float32)
        # a one-pixel hole does not split a body
        closed = cv2.morphologyEx(height, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
        wide = cv2.morphologyEx(closed, cv2.MORPH_OPEN, np.ones((self._side,) * 2, np.uint8))
        return height, np.asarray(wide, np.float32)

    def _cut_one(self, depth: Depths, limit: Depths) -> None:
        """Remove cables from an image (H, W), in place, and fill in what they cover."""
        import cv2

        height, wide = self._heights(depth, limit)
        body = wide[(wide > 0) & (wide < self.tall_mm)]
        back = float(np.percentile(body, _BACK)) if len(body) else 0.0
        worn = np.zeros(depth.shape, np.bool_)
        for part in self._parts(height, wide):
            # a snout is as narrow as a cable, but no higher than the back
            worn |= part & ((wide > 0) | (height > back))
        if not worn.any():
            return
        # the readings beside it are of both
        worn = cv2.dilate(worn.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
        kept = np.where(worn, np.float32(0), height)
        over = np.ones((2 * self._side + 1,) * 2, np.uint8)
        under = cv2.morphologyEx(kept, cv2.MORPH_CLOSE, over)
        filled = worn & (under > 0) & (self._inverse > 0)
        depth[worn] = 0.0
        depth[filled] = (1.0 - under[filled] / self.floor.distance_mm) / self._inverse[filled]

    def _parts(self, height: Depths, wide: Depths) -> Iterator[Mask]:
        """The cables of an image, one at a time."""
        import cv2

        thin = (height - wide > _RISE_MM) | (height > self.tall_mm)
        if not (height > self.tall_mm).any():
            return
        reach = np.ones((2 * _LINK_PX + 1, 2 * _LINK_PX + 1), np.uint8)
        _, labels, stats, _ = cv2.connectedComponentsWithStats(
            cv2.dilate(thin.astype(np.uint8), reach)
        )
        tall = np.unique(labels[thin & (height > self.tall_mm)])
        for k in tall[tall > 0]:
            run = max(stats[k, cv2.CC_STAT_WIDTH], stats[k, cv2.CC_STAT_HEIGHT])
            if run * self._px_mm >= _LEAST_RUN_MM:
                yield thin & (labels == k)

    def _leads_to_one(self, depth: Depths, limit: Depths, least_px: float) -> bool | None:
        """Whether a cable leads to something wide of an animal's size; None without such a body."""
        import cv2

        height, wide = self._heights(depth, limit)
        body = ((wide > 0) & (wide < self.tall_mm)).astype(np.uint8)
        _, labels, stats, _ = cv2.connectedComponentsWithStats(body)
        large = 1 + np.flatnonzero(stats[1:, cv2.CC_STAT_AREA] >= least_px)
        if not len(large):
            return None
        reach = np.ones((2 * _JOINED_PX + 1, 2 * _JOINED_PX + 1), np.uint8)
        around = cv2.dilate(np.isin(labels, large).astype(np.uint8), reach) > 0
        return any(bool((part & around).any()) for part in self._parts(height, wide))
