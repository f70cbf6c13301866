"""The floor's level while a sensor warms up: the depth of one and the same floor wanders.

A time-of-flight camera that was just switched on reads a still floor some millimetres nearer or
farther as it warms up (5 mm in 10 min of a Kinect v2). The level of a frame is the trimmed mean of
reading less background over the floor that it shows; the animal covers little of that. Where the
levels of a recording wander slowly and by more than a camera's noise, each frame is brought to the
level at its beginning before anything stands out from it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from liex_lab.runtime.shapes import check_shapes

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
            levels[k] = off.mean()
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
