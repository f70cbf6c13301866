"""Head stages: blocks cemented to the skull, which stand out from the animal all around.

What is narrower than a body is told by opening its heights with a square (grey-scale opening, Serra
1982). A snout or an ear is narrow, too, but no step leads down from it to all of the body beside
it; from a head stage one does. Where most frames show such a block of one size, it is cut out, and
the skull beneath is filled in from beside it by closing, so that the head is not taken for raised.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from liex_lab.arena.floor import Floor
from liex_lab.foreground.components import components
from liex_lab.foreground.heights import heights_before
from liex_lab.foreground.worn import Worn
from liex_lab.optics.camera import Camera
from liex_lab.runtime.shapes import check_shapes
from liex_lab.runtime.threads import side_by_side

Depths = NDArray[np.float32]
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
