"""Occlusion correction: an animal with one end hidden is shifted along its axis.

A pose that was fitted to the visible part of an animal is centred on that part; the visible end
gives the true position. The hidden end is the one where the animal's pixels border on nearer pixels
or on the image edge. The other end is at the end of the visible pixels, corrected by their usual
distance from the end of the chain. The shift is at most 0.45 of the hidden share of the usual area,
and 0 if the animal is whole or the hidden end is unclear.
Not in Lie-X; used for chains that swim, viewed along the optical axis.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from liex_lab.body.pose import Pose
from liex_lab.body.skeleton import Skeleton
from liex_lab.geometry import SE3
from liex_lab.runtime.kernels import kernel
from liex_lab.runtime.processes import in_parallel
from liex_lab.scene.height_maps import HeightMaps, Segmenter
from liex_lab.tracking.observations import joints_of

Array = NDArray[np.float64]

_REACH_PX = 3  # pixels next to the edge, often unread by a sensor


def behind_something(crops: HeightMaps, depths: NDArray[np.float32]) -> Array:
    """The share of each animal's outline that ends at a nearer object or at the image edge.

    Args:
        crops: n height maps.
        depths: (n, H, W) float32 mm, the depth images that they were cut from, 0 where unread.

    Returns:
        (n,) 0 to 1; 0 if nothing was found.
    """
    out = np.zeros(len(crops.n_px))
    in_parallel(
        _share_behind,
        len(out),
        crops.heights,
        crops.origin,
        crops.step,
        depths,
        25.0,  # mm nearer than the animal's edge is in front of it
        _REACH_PX,
        out,
    )
    return out


@kernel(nogil=True)
def _share_behind(heights, origin, step, depths, nearer_mm, reach_px, out, start, stop):
    """Fill out (n,) with the share of the edges of each height map (n, S, S) behind an object."""
    for i in range(start, stop):
        size = heights.shape[1]
        n_edges = 0
        n_behind = 0
        for r in range(1, size - 1):
            v = origin[i, 1] + step[i] * r
            for c in range(1, size - 1):
                u = origin[i, 0] + step[i] * c
                if heights[i, r, c] <= 0 or not (
                    0 <= v < depths.shape[1] and 0 <= u < depths.shape[2]
                ):
                    continue
                z = depths[i, v, u]
                for dr, dc in ((1, 0), (-1, 0), (0, 1), (0, -1)):
                    if heights[i, r + dr, c + dc] > 0:
                        continue
                    n_edges += 1
                    n_behind += z > 0 and _is_behind_another(
                        heights[i], step[i], r, c, depths[i], v, u, dr, dc, z - nearer_mm, reach_px
                    )
        out[i] = n_behind / max(n_edges, 1)


@kernel()
def _is_behind_another(height, step, r, c, depth, v, u, dr, dc, nearer, reach_px):
    """The same as `is_behind` for the cell (r, c), without readings of the animal's own cells."""
    size = height.shape[0]
    for k in range(1, reach_px + 1):
        cells = (k + step - 1) // step
        row, column = r + cells * dr, c + cells * dc
        own = 0 <= row < size and 0 <= column < size and height[row, column] > 0
        if not own and is_behind(depth, v + (k - 1) * dr, u + (k - 1) * dc, dr, dc, nearer, 1):
            return True
    return False


@kernel()
def is_behind(depth, v, u, dv, du, nearer, reach_px):
    """Whether a reading nearer than `nearer`, or the image edge, is close in one direction."""
    for k in range(1, reach_px + 1):
        row = v + k * dv
        column = u + k * du
        if not (0 <= row < depth.shape[0] and 0 <= column < depth.shape[1]):
            return True
        if 0 < depth[row, column] < nearer:
            return True
    return False


_WHOLE = 0.95  # of the animal's usual area: it is completely visible


@dataclass(frozen=True)
class OcclusionCorrection:
    """Shifts poses along their axes according to the visible end (occlusion correction).

    Positions along the axis run from the base (0) to the tip (1) in the image.

    Attributes:
        skeleton: kinematic tree of the animal, one chain.
        scene: the segmenter that cut the height maps.
        begins: start of the visible pixels of a whole animal, usually about 0.
        ends: their end, usually about 1.
    """

    skeleton: Skeleton
    scene: Segmenter
    begins: float = 0.0
    ends: float = 1.0

    @staticmethod
    def fit(
        skeleton: Skeleton,
        scene: Segmenter,
        pose: Pose,
        crops: HeightMaps,
        depths: NDArray[np.float32],
    ) -> OcclusionCorrection:
        """A correction with the usual ends from sampled frames that show the whole animal.

        Args:
            skeleton: kinematic tree of the animal, one chain.
            scene: the segmenter that cut the height maps.
            pose: (n) poses, camera frame.
            crops: their n height maps, cut along the optical axis.
            depths: (n, H, W) float32 mm, the frames.

        Returns:
            The correction, with the medians of those frames; ends 0 and 1 if no frame shows the
            whole animal.
        """
        ends = OcclusionCorrection(skeleton, scene)
        sight = ends._sight(joints_of(skeleton, pose), crops, depths)
        whole = (sight[:, 0] > _WHOLE) & (sight[:, 1] == 0)
        if not whole.any():
            return ends
        begins, stops = np.median(sight[whole, 3:], axis=0)
        return replace(ends, begins=float(begins), ends=float(stops))

    def slid(self, pose: Pose, crops: HeightMaps, depths: NDArray[np.float32]) -> Pose:
        """The poses, each moved along the line from base to tip according to its free end.

        Args:
            pose: (n) poses, camera frame.
            crops: their n height maps, cut along the optical axis.
            depths: (n, H, W) float32 mm, the frames.

        Returns:
            (n) poses, camera frame; unchanged if nothing is hidden or the hidden end is unknown.
        """
        joints = joints_of(self.skeleton, pose)
        shown, covered, aside, begins, ends = self._sight(joints, crops, depths).T
        most = 0.45 * np.clip(1.0 - shown, 0.0, 1.0)
        forwards = np.clip(begins - self.begins, 0.0, most)
        direction = np.where(aside > 0, forwards, np.clip(ends - self.ends, -most, 0.0))
        # nearer to the middle, the hidden end is unknown
        direction[(covered == 0) | (np.abs(aside) < 0.25) | (shown > _WHOLE)] = 0.0
        along = joints[:, self.skeleton.tip] - joints[:, 0]
        place = pose.root.translation + direction[:, None] * along
        return replace(pose, root=SE3(pose.root.rotation, place))

    def _sight(self, joints: Array, crops: HeightMaps, depths: NDArray[np.float32]) -> Array:
        """The visible part (n, 5) of each animal, see `_look`, with its area over the usual one.

        Its joints (n, J, 3) mm are in the camera frame.
        """
        camera = self.scene.camera
        ends = camera.project(joints[:, [0, self.skeleton.tip]])
        out = np.zeros((len(ends), 5))
        # an object nearer by this much is in front of the animal
        before = 2.0 * float(np.sqrt(self.scene.area_mm2))
        in_parallel(
            _look,
            len(ends),
            crops.heights,
            crops.origin,
            crops.step,
            crops.distance,
            depths,
            ends,
            before,
            out,
        )
        out[:, 0] /= camera.fx * camera.fy * self.scene.area_mm2
        return out


@kernel(nogil=True)
def _look(heights, origin, step, distance, depths, ends, before, out, start, stop):
    """Fill out (n, 5) with the visible pixels of each animal along its line from base to tip.

    ends (n, 2, 2) px are the line's ends. Columns: visible pixels times their squared depth; how
    many of them are next to an object nearer by `before` mm or to the image edge; the distance of
    these from the middle of all, over half the visible length; start and end of the visible part.
    """
    for i in range(start, stop):
        size = heights.shape[1]
        depth = depths[i]
        line = ends[i, 1] - ends[i, 0]
        squared = max(line[0] ** 2 + line[1] ** 2, 1.0)
        n = 0
        covered = 0
        aside = 0.0
        middle = 0.0
        first = np.inf
        last = -np.inf
        for r in range(size):
            for c in range(size):
                v = origin[i, 1] + step[i] * r
                u = origin[i, 0] + step[i] * c
                if heights[i, r, c] <= 0 or not (
                    0 <= v < depth.shape[0] and 0 <= u < depth.shape[1]
                ):
                    continue
                z = distance[i] - heights[i, r, c] / 16.0
                if depth[v, u] > 0 and abs(depth[v, u] - z) > 0.5 * before:
                    continue  # a hole in the height map, filled from its neighbours
                at = ((u - ends[i, 0, 0]) * line[0] + (v - ends[i, 0, 1]) * line[1]) / squared
                n = n + 1
                middle = middle + at
                first = min(first, at)
                last = max(last, at)
                out[i, 0] += (step[i] * z) ** 2
                if _beside(depth, v, u, step[i], z - before):
                    covered = covered + 1
                    aside = aside + at
        if n > 0:
            out[i, 1] = covered
            out[i, 3] = first
            out[i, 4] = last
        if covered > 0:
            out[i, 2] = (aside / covered - middle / n) / max(0.5 * (last - first), 1e-6)


@kernel()
def _beside(depth, v, u, step, nearer):
    """Whether a pixel is within three crop pixels of a nearer one or of the image edge."""
    for dv, du in ((1, 0), (-1, 0), (0, 1), (0, -1)):
        if is_behind(depth, v, u, step * dv, step * du, nearer, _REACH_PX):
            return True
    return False
