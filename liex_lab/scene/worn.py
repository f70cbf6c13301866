"""What an animal wears, such as a cable or a head stage, as one camera sees it."""

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
    """How something that an animal wears is told from it before one camera.

    Attributes:
        camera: whose pixels are looked at.
        floor: the floor as that camera sees it.
    """

    camera: Camera
    floor: Floor

    def every(self, step: int) -> Self:
        """The same in pictures of every `step`-th row and column.

        Args:
            step: pixels from one to the next, at least 1.
        """
        camera = self.camera.every(step)
        floor = Floor.from_plane(self.floor.normal, self.floor.distance_mm, camera)
        return replace(self, camera=camera, floor=floor)

    @property
    def _px_mm(self) -> float:
        """Width of a pixel on the floor, mm."""
        return self.floor.distance_mm / float(np.sqrt(self.camera.fx * self.camera.fy))


# Heights above the floor of what stands out in a picture.


Depths = NDArray[np.float32]


def heights_before(depth: Depths, limit: Depths, floor: Floor) -> Depths:
    """Heights of what is nearer than the background's limit.

    Args:
        depth: (H, W) float32 mm, 0 where unread.
        limit: (H, W) float32 mm; a reading below it is in front of the background.
        floor: the floor in the pixels of the picture.

    Returns:
        (H, W) float32 mm above the floor's plane, 0 where nothing stands out.
    """
    a, b, c = floor.inverse_depth
    rows, columns = np.nonzero((depth > 0) & (depth < limit))
    height = np.zeros(depth.shape, np.float32)
    inverse = a * columns + b * rows + c
    above = floor.distance_mm * (1.0 - depth[rows, columns] * inverse)
    height[rows, columns] = np.maximum(above, 0.0)
    return height


# Connected components of a mask, looked for in the box that holds all of it.


class Components(NamedTuple):
    """Connected components (8-connected) of a mask, in the order of `cv2.connectedComponents`.

    Attributes:
        labels: (H, W) int32, 0 outside, 1 and up inside.
        stats: (n, 5) int32, row k of component k: left, top, width, height, pixels (`cv2.CC_STAT_*`
            columns); row 0 is not filled in.
    """

    labels: NDArray[np.int32]
    stats: NDArray[np.int32]


def components(mask: NDArray[np.uint8]) -> Components:
    """The connected components of a mask.

    Args:
        mask: (H, W) uint8, nonzero inside.
    """
    import cv2

    left, top, width, height = cv2.boundingRect(mask)
    # OpenCV numbers components as it meets them in blocks of 2 x 2 pixels: they stay where they are
    box = (slice(top - top % 2, top + height), slice(left - left % 2, left + width))
    labels = np.zeros(mask.shape, np.int32)
    if not width:
        return Components(labels, np.zeros((1, 5), np.int32))
    _, labels[box], stats, _ = cv2.connectedComponentsWithStats(mask[box])
    stats[:, cv2.CC_STAT_LEFT] += box[1].start
    stats[:, cv2.CC_STAT_TOP] += box[0].start
    stats[0] = 0
    return Components(labels, np.asarray(stats, np.int32))


# Head stages: blocks cemented to the skull, which stand out from the animal all around.


Mask = NDArray[np.bool_]

_WIDE_MM = 13.0  # a body is wider
_NARROW_MM = 5.0  # what is narrow stands out from what is wide by so much
_STEP_MM = 6.0  # and from the body beside it
_AREA_MM2 = (30.0, 260.0)  # seen from above
_BESIDE_PX = 2
_ON_BODY = 0.3  # of what lies beside it is the animal, for a head ends in front of it
_LEAST_SHARE = 0.6  # of the frames with something of an animal's size show one
_TIMES_AREA = 2.0  # larger than usual it is something else, as a head held up
_FOOT = 0.4  # of the step: what is higher is the block, not the head


@dataclass(frozen=True)
class HeadStage(Worn):
    """How a head stage is told from the animal before one camera.

    Attributes:
        camera: see `Worn`.
        floor: likewise.
        area_mm2: its usual area seen from above, mm^2.
    """

    area_mm2: float

    @staticmethod
    def find(
        sample: Depths, limit: Depths, camera: Camera, floor: Floor, area_mm2: float
    ) -> HeadStage | None:
        """How the head stage of a sample's animal is told; None where it wears none.

        Args:
            sample: (n, H, W) float32 mm, frames spread over a recording, 0 where unread.
            limit: (H, W) float32 mm; a reading below it is in front of the background.
            camera: whose pixels these are.
            floor: the floor as it sees it.
            area_mm2: area of the smallest animal, mm^2.
        """
        largest = HeadStage(camera, floor, _AREA_MM2[1] / _TIMES_AREA)

        def look(depth: Depths) -> tuple[bool, list[float]]:
            """Whether a frame shows something as large as an animal, and its blocks' areas, px."""
            height = heights_before(depth, limit, floor)
            shows = bool(np.count_nonzero(height) * largest._px_mm**2 > area_mm2)
            return shows, [float(block.sum()) for block, _ in largest._blocks(height)]

        found = side_by_side(look, list(sample))
        worn = [max(areas) for _, areas in found if areas]
        if not worn or len(worn) < _LEAST_SHARE * sum(shows for shows, _ in found):
            return None
        return replace(largest, area_mm2=float(np.median(worn)) * largest._px_mm**2)

    def cut(self, depths: Depths, limit: Depths) -> Depths:
        """The frames without it.

        Args:
            depths: (n, H, W) float32 mm, 0 where unread.
            limit: (H, W) float32 mm; a reading below it is in front of the background.

        Returns:
            (n, H, W) float32 mm, a copy; where it stands, the head as the body beside it says.
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
        """Width in pixels, odd, of the square that no head stage fills."""
        return max(3, int(_WIDE_MM / self._px_mm + 0.5) | 1)

    def _blocks(self, height: Depths) -> Iterator[tuple[Mask, float]]:
        """The blocks (H, W) bool of a picture's heights (H, W) mm that stand out all around, and
        how high the body beside each is, mm.
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
        # single readings are noise, and a hole of one pixel parts no body
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
        """Cut a block out of a picture (H, W) mm, in place, and fill in the head beneath."""
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


# Cables and fibres: thin things that rise from the animal to above anything it reaches itself.


_CABLE_WIDE_MM = 10.0  # a body is wider, a cable with its blurred edges is not
_RISE_MM = 6.0  # a cable stands out from what it lies over by so much
_TALLER = 1.2  # times the largest animal's length: it does not reach so high
_BACK = 95.0  # %: the height of its back, of all that is wide
_LINK_PX = 2  # a cable that is unread for so long is still one
_JOINED_PX = 3  # a cable this near to a body leads to it
_LEAST_RUN_MM = 40.0  # it is so long in the picture
_CABLE_LEAST_SHARE = (
    0.3  # of the frames with something wide: an edge that flickers is not there so often
)
_FIXED = 0.5  # what is thin in so many frames is a part of the arena
_FIXED_EDGE_PX = 2  # and so are the readings beside it, which are of both
_NEARLY = 1.00001  # what rounding may change


@dataclass(frozen=True)
class Cable(Worn):
    """How cables are told from the animal before one camera.

    Attributes:
        camera: see `Worn`.
        floor: likewise.
        tall_mm: no animal reaches higher above the floor.
        fixed: (H, W) bool, where the arena itself has thin parts above the floor, as a lid's bars;
            None where nothing is known of them.
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
        """How cables are told, where the animal of a sample wears one.

        Args:
            sample: (n, H, W) float32 mm, frames spread over a recording, 0 where unread.
            limit: (H, W) float32 mm; a reading below it is in front of the background.
            camera: whose pixels these are.
            floor: the floor as it sees it.
            longest_mm: length of the largest animal to expect, mm.
            area_mm2: area of the smallest, mm^2.

        Returns:
            None where too few frames show a cable that leads to something of an animal's size.
        """
        cable = Cable(camera, floor, _TALLER * longest_mm)
        if not cable._rises(sample, limit):
            return None
        least_px = area_mm2 * camera.fx * camera.fy / floor.distance_mm**2
        told = [cable._leads_to_one(depth, limit, least_px) for depth in sample]
        with_one = [leads for leads in told if leads is not None]
        return cable if with_one and np.mean(with_one) >= _CABLE_LEAST_SHARE else None

    def cut(self, depths: Depths, limit: Depths) -> Depths:
        """The frames without cables.

        Args:
            depths: (n, H, W) float32 mm, 0 where unread.
            limit: (H, W) float32 mm; a reading below it is in front of the background.

        Returns:
            (n, H, W) float32 mm, a copy; where a cable was 0, or the back beneath it as the body
            beside it says.
        """
        check_shapes("frames", ("depths", depths, ("n", *limit.shape)))
        out = depths.copy()
        for depth in out:
            self._cut_one(depth, limit)
        return out

    def with_fixed(self, sample: Depths, cut: Depths) -> Cable:
        """The same, knowing where the arena itself has thin parts.

        Args:
            sample: (n, H, W) float32 mm, frames spread over a recording.
            cut: (n, H, W) what `cut` made of them.

        Returns:
            A cable whose `fixed` says where most frames were cut.
        """
        import cv2

        share = np.mean(
            [before != after for before, after in zip(sample, cut, strict=True)], axis=0
        )
        edge = np.ones((2 * _FIXED_EDGE_PX + 1,) * 2, np.uint8)
        return replace(self, fixed=cv2.dilate((share > _FIXED).astype(np.uint8), edge) > 0)

    def every(self, step: int) -> Cable:
        """The same in pictures of every `step`-th row and column.

        Args:
            step: pixels from one to the next, at least 1.
        """
        fixed = None if self.fixed is None else np.ascontiguousarray(self.fixed[::step, ::step])
        return replace(super().every(step), fixed=fixed)

    def worn(self, depths: Depths, limit: Depths) -> Mask:
        """Where (n, H, W) something was cut that the animal wears, and no part of the arena.

        Args:
            depths: (n, H, W) float32 mm, 0 where unread.
            limit: (H, W) float32 mm; a reading below it is in front of the background.
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
        """Width in pixels, odd, of the square that no cable fills."""
        return max(3, int(_CABLE_WIDE_MM / self._px_mm + 0.5) | 1)

    def _rises(self, sample: Depths, limit: Depths) -> bool:
        """Whether anything in a sample (n, H, W) perhaps reaches higher than an animal does."""
        with np.errstate(divide="ignore"):
            above = (1.0 - self.tall_mm / self.floor.distance_mm) / self._inverse
        above = np.where(self._inverse > 0, _NEARLY * above, np.inf)
        nearer = np.minimum(above, limit).astype(np.float32)
        return any(bool(((depth > 0) & (depth < nearer)).any()) for depth in sample)

    def _heights(self, depth: Depths, limit: Depths) -> tuple[Depths, Depths]:
        """Heights (H, W) mm of what stands out in a picture, and of those the wide ones."""
        import cv2

        above = self.floor.distance_mm * (1.0 - depth * self._inverse)
        near = (depth > 0) & (depth < limit)
        height = np.where(near, np.maximum(above, 0.0), 0.0).astype(np.float32)
        # a hole of one pixel parts no body
        closed = cv2.morphologyEx(height, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
        wide = cv2.morphologyEx(closed, cv2.MORPH_OPEN, np.ones((self._side,) * 2, np.uint8))
        return height, np.asarray(wide, np.float32)

    def _cut_one(self, depth: Depths, limit: Depths) -> None:
        """Cut cables out of a picture (H, W), in place; what they lie over is filled in."""
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
        """The cables of a picture, one after the other."""
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
        """Whether a cable leads to something wide of an animal's size; None where there is none."""
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
