"""Cables and fibres: thin things that rise from the animal to above anything it reaches itself.

Heights above the floor are opened with a square as wide as no cable is (grey-scale opening, Serra
1982); what stands above the opened surface is thin. The thin parts, joined over small gaps, that
lead up to more than an animal can reach are a cable. Its pixels are taken for unread, and
over the body they are filled in from beside it by closing: what lies under a cable is hidden, not
absent. A tail is thin, too, but leads nowhere up.

What is thin in the same place throughout is no cable but a part of the arena, as the bars of a
cage's lid: it is cut out of the pictures likewise, but what lies behind it is hidden.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from liex_lab.arena.floor import Floor
from liex_lab.foreground.worn import Worn
from liex_lab.optics.camera import Camera
from liex_lab.runtime.shapes import check_shapes

Depths = NDArray[np.float32]
Mask = NDArray[np.bool_]

_WIDE_MM = 10.0  # a body is wider, a cable with its blurred edges is not
_RISE_MM = 6.0  # a cable stands out from what it lies over by so much
_TALLER = 1.2  # times the largest animal's length: it does not reach so high
_BACK = 95.0  # %: the height of its back, of all that is wide
_LINK_PX = 2  # a cable that is unread for so long is still one
_JOINED_PX = 3  # a cable this near to a body leads to it
_LEAST_RUN_MM = 40.0  # it is so long in the picture
_LEAST_SHARE = 0.3  # of the frames with something wide: an edge that flickers is not there so often
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
        return cable if with_one and np.mean(with_one) >= _LEAST_SHARE else None

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
        return max(3, int(_WIDE_MM / self._px_mm + 0.5) | 1)

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
