"""Analysis-by-synthesis residual: the rendered body of a pose against the observed depth.

r = median over the pixels that both cover of |z_rendered - z_observed|, with a default body of the
skeleton whose girth is found once per recording by a grid search from 0.75 to 1.35. A tube that
stretches keeps its volume, as the virtual mouse does: for bones of scale s, its girth is that of
the session's size times sqrt(size / s), because a contracted animal is thicker, not thinner. The
depth is computed from the height maps: z = (1 - h / d) / (a u + b v + c), with
h the height, d the camera's distance and a u + b v + c the inverse depth of the plane. Two
shares of the outlines are also computed: |S and B| / |S| of the silhouette S that the body B
covers, and |B without S| / |B| of the body outside it. Because a fitting trunk can hide a
misplaced head, the same median is computed for each part of the body, the pixels nearest to one of
its joints in the image and at least a twentieth of all, and the largest is reported.

Occlusion correction (not in Lie-X; for chains that swim, viewed along the optical axis): a pose
that was fitted to the visible part of an animal is centred on that part; the visible end gives the
true position. The hidden end is the one where the animal's pixels border on nearer pixels or on the
image edge. The other end is at the end of the visible pixels, corrected by their usual distance
from the end of the chain. The shift is at most 0.45 of the hidden share of the usual area, and 0 if
the animal is whole or the hidden end is unclear.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from liex_lab.body.pose import Pose
from liex_lab.body.shape import BodyShape, Surface, render_meshes
from liex_lab.body.skeleton import Skeleton
from liex_lab.geometry import SE3
from liex_lab.runtime.kernels import kernel
from liex_lab.runtime.processes import in_parallel
from liex_lab.scene.height_maps import CROP, HeightMaps, Segmenter
from liex_lab.tracking.observations import Array, joints_of
from liex_lab.tracking.trust import MOST_ERROR, MOST_RESIDUAL, finite_median


@dataclass(frozen=True)
class BodyAgreement:
    """The agreement of rendered bodies with the depth in n height maps.

    Attributes:
        residual_mm: (n,) median absolute difference between body and reading over the pixels that
            both cover, mm; NaN if both cover fewer than 20 pixels.
        covered: (n,) share (0 to 1) of the silhouette's pixels that the body covers.
        beside: (n,) share (0 to 1) of the body's pixels outside the animal; 1 if the body is
            outside the height map.
        part_mm: (n,) that difference in the part of the body where it is largest, mm; NaN as in
            `residual_mm`.
    """

    residual_mm: Array
    covered: Array
    beside: Array
    part_mm: Array


@dataclass(frozen=True)
class BodyResidual:
    """The default body of a skeleton, scaled across by `girth`, for comparison with depth.

    Attributes:
        surface: the body's surface.
        girth: factor on the default girth at the animal's size.
        camera_view: how the height maps were cut, see `BackgroundSubtraction.extract`.
        size: the animal's size over home size, about which a tube keeps its volume; None, and of
            any other body, lengths across are those of the bones' scale.
    """

    surface: Surface
    girth: float = 1.0
    camera_view: bool = False
    size: float | None = None

    def across(self, scale: Array) -> Array:
        """Factors (n,) of all lengths across the body with bones of these scales (n,)."""
        if self.size is None or not isinstance(self.surface.body, BodyShape):
            return self.girth * scale
        return self.girth * np.asarray(self.size * np.sqrt(self.size / scale))

    def of(self, pose_arena: Pose, crops: HeightMaps, scene: Segmenter) -> Array:
        """Median absolute difference between body and reading over the pixels that both cover.

        Args:
            pose_arena: (n) poses, arena frame.
            crops: their n height maps.
            scene: the segmenter that cut them.

        Returns:
            (n,) mm; NaN where fewer than 20 pixels are covered by both.
        """
        return self.agreement(pose_arena, crops, scene).residual_mm

    def agreement(self, pose_arena: Pose, crops: HeightMaps, scene: Segmenter) -> BodyAgreement:
        """Distance of the body from the depth, and overlap of their outlines.

        Args:
            pose_arena: (n) poses, arena frame.
            crops: their n height maps.
            scene: the segmenter that cut them.

        Returns:
            The agreement of each pose with its height map.
        """
        out = np.empty((4, len(pose_arena.scale)))
        if not out.size:
            return BodyAgreement(*out)
        rendered = self.rendered(pose_arena, crops, scene)
        planes = scene.planes(crops, self.camera_view)
        joints = scene.camera.project(
            scene.floor.T_arena_camera.inverse() @ joints_of(self.surface.skeleton, pose_arena)
        )
        in_parallel(
            _compare,
            out.shape[1],
            rendered,
            crops.heights,
            crops.origin,
            crops.step,
            planes,
            crops.distance,
            joints,
            out,
        )
        return BodyAgreement(*out)

    def rendered(
        self, pose_arena: Pose, crops: HeightMaps, scene: Segmenter
    ) -> NDArray[np.float32]:
        """The body's depth on the pixels of n height maps, see `render_crops`."""
        across = self.across(pose_arena.scale)
        return render_crops(self.surface, pose_arena, across, crops, scene)

    @staticmethod
    def fit(
        surface: Surface,
        pose_arena: Pose,
        crops: HeightMaps,
        scene: Segmenter,
        camera_view: bool = False,
        size: float | None = None,
    ) -> "BodyResidual":
        """The girth with which the default body explains these frames best: 13 are tried.

        Args:
            surface: the body's surface.
            pose_arena: (n) poses, arena frame.
            crops: their n height maps.
            scene: the segmenter that cut them.
            camera_view: how the height maps were cut, see `BackgroundSubtraction.extract`.
            size: of the animal, see `BodyResidual`.

        Returns:
            The body with the smallest median residual over the frames; the default girth if no
            frame shows enough of any body.
        """
        placed = pose_arena.placed(surface.skeleton)
        best = BodyResidual(surface, camera_view=camera_view, size=size)
        least = np.inf
        for girth in np.linspace(0.75, 1.35, 13):  # of the default body at the animal's size
            body = BodyResidual(surface, float(girth), camera_view, size)
            cost = finite_median(body.of(placed, crops, scene), np.inf)
            if cost < least:
                best = body
                least = cost
        return best


def render_crops(
    surface: Surface, pose_arena: Pose, across: Array, crops: HeightMaps, scene: Segmenter
) -> NDArray[np.float32]:
    """The body's depth on the pixels of the height maps, by rasterising its mesh.

    Args:
        surface: the body's surface.
        pose_arena: (n) poses, arena frame.
        across: (n,) factor of all lengths across the body.
        crops: the n height maps whose pixels are rendered.
        scene: the segmenter that cut them, for its camera and floor.

    Returns:
        (n, CROP, CROP) float32 mm, 0 outside the body.
    """
    camera = scene.camera
    n = len(pose_arena.scale)
    vertices = surface.vertices(pose_arena, girth=across)
    # a crop of every second pixel is the image of a camera of half the resolution
    step = crops.step.astype(float)
    scaled = np.stack(
        [camera.fx / step, camera.fy / step, camera.cx / step, camera.cy / step], axis=1
    )
    T = scene.floor.T_arena_camera.inverse()
    T_camera_arena = SE3(
        np.broadcast_to(T.rotation, (n, 3, 3)).copy(), np.broadcast_to(T.translation, (n, 3)).copy()
    )
    return render_meshes(
        vertices, surface.faces, T_camera_arena, scaled, crops.origin / step[:, None], (CROP, CROP)
    )


@kernel(nogil=True)
def _compare(rendered, heights, origin, step, planes, distance, joints, out, start, stop):
    """Median |rendered - observed| depth, mm, over pixels where both are, the share of the observed
    pixels that are covered, the share of the rendered ones outside, and the largest median
    of a part of the body, into out (4, n). joints (n, J, 2) are px of the image.
    """
    for i in range(start, stop):
        size = rendered.shape[1]
        plane = planes[i]
        offset = np.empty(size * size)
        own = np.empty(size * size)
        part = np.empty(size * size, np.int64)
        n = n_read = n_drawn = 0
        for r in range(size):
            v = origin[i, 1] + step[i] * r
            for c in range(size):
                n_read += heights[i, r, c] > 0
                n_drawn += rendered[i, r, c] > 0
                if rendered[i, r, c] > 0 and heights[i, r, c] > 0:
                    u = origin[i, 0] + step[i] * c
                    observed = (1.0 - heights[i, r, c] / 16.0 / distance[i]) / (
                        plane[0] * u + plane[1] * v + plane[2]
                    )
                    offset[n] = abs(rendered[i, r, c] - observed)
                    part[n] = _nearest(joints[i], u, v)
                    n += 1
        enough = n >= 20
        for k in range(n):
            own[k] = offset[k]
        out[0, i] = median_of(own[:n]) if enough else np.nan
        out[1, i] = n / max(n_read, 1)
        out[2, i] = 1.0 - n / max(n_drawn, 1)
        out[3, i] = _worst_part(offset[:n], part[:n], joints.shape[1], own) if enough else np.nan


@kernel()
def _nearest(joints, u, v):
    """Which of the joints (J, 2) px is nearest to a pixel."""
    best = 0
    least = np.inf
    for j in range(len(joints)):
        off2 = (joints[j, 0] - u) ** 2 + (joints[j, 1] - v) ** 2
        if off2 < least:
            best = j
            least = off2
    return best


@kernel()
def _worst_part(offset, part, n_parts, own):
    """The largest median of the offsets (k,) of one part, of those with enough pixels; 0 if none
    has. own is scratch, as long at least.
    """
    worst = 0.0
    for j in range(n_parts):
        n = 0
        for k in range(len(offset)):
            if part[k] == j:
                own[n] = offset[k]
                n += 1
        if n >= max(8, 0.05 * len(offset)):  # one wrong finger does not make the hand wrong
            worst = max(worst, median_of(own[:n]))
    return worst


@kernel()
def median_of(values):
    """The median of numbers by Hoare's selection; numpy's own takes three times as long to compile.

    Args:
        values: (k,) at least one; put into another order.
    """
    half = values.size // 2
    low = 0
    high = values.size - 1
    while low < high:
        pivot = values[half]
        i = low
        j = high
        while i <= j:
            while values[i] < pivot:
                i += 1
            while pivot < values[j]:
                j -= 1
            if i <= j:
                values[i], values[j] = values[j], values[i]
                i += 1
                j -= 1
        if j < half:
            low = i
        if half < i:
            high = j
    if values.size % 2:
        return values[half]
    below = values[0]
    for k in range(1, half):
        below = max(below, values[k])
    return (below + values[half]) / 2.0


# Fit of a plan's animal to a recording: absolute evidence from the sampled frames.


# of the plan's lengths: sizes are measured to a few per cent, and plans contain round numbers
_SIZE_MARGIN = 0.15
_MOST_BESIDE = 0.5


@dataclass(frozen=True)
class SampleFit:
    """The model's agreement with the frames that a session was learned from; medians over them.

    Attributes:
        n_frames: frames that hold depth.
        n_found: frames with an object of the animal's size and a pose.
        spine_mm: the animal's length, mm.
        error_mm: predicted mean joint error, mm.
        residual_mm: distance between rendered body and reading, mm; NaN if they hardly overlap.
        covered: share (0 to 1) of the silhouette that the body covers.
        beside: share (0 to 1) of the body outside the silhouette.
        n_animals: how many animals are in view at once.
    """

    n_frames: int
    n_found: int
    spine_mm: float
    error_mm: float
    residual_mm: float
    covered: float
    beside: float
    n_animals: int = 1

    def has_length(self, low_mm: float, high_mm: float) -> bool:
        """Whether a plan with these limits of the length, mm, allows the animal's length."""
        return low_mm * (1.0 - _SIZE_MARGIN) <= self.spine_mm <= high_mm * (1.0 + _SIZE_MARGIN)

    def misfits(self, low_mm: float, high_mm: float, stated: bool = False) -> list[str]:
        """The contradictions to this being the plan's animal; empty if there are none.

        Args:
            low_mm: the plan's least length of the animal, mm.
            high_mm: its largest, mm.
            stated: the plan states this animal's length, which is then not checked.

        Returns:
            Parts of a sentence, such as 'it is 743 mm long and the plan expects 130 to 220 mm'.
        """
        apart = (
            "its body and what was read hardly overlap"
            if np.isnan(self.residual_mm)
            else f"its body lies {self.residual_mm:.0f} mm from what was read"
        )
        contradictions = (
            (
                not stated and not self.has_length(low_mm, high_mm),
                f"it is {self.spine_mm:.0f} mm long and the plan expects {low_mm:g} to "
                f"{high_mm:g} mm",
            ),
            (
                self.n_found < 0.05 * self.n_frames,
                f"something of its size was found in {self.n_found} of {self.n_frames} frames",
            ),
            (
                self.error_mm > MOST_ERROR * self.spine_mm,
                f"the expected error of {self.error_mm:.0f} mm is "
                f"{self.error_mm / self.spine_mm:.0%} of its length",
            ),
            (not self.residual_mm <= MOST_RESIDUAL * self.spine_mm, apart),
            (self.covered < 0.4, f"its body covers {self.covered:.0%} of the observed outline"),
            (
                self.beside > _MOST_BESIDE,
                f"{self.beside:.0%} of its body lies beside that outline",
            ),
        )
        return [sentence for contradicts, sentence in contradictions if contradicts]


# Occlusion correction: an animal with one end hidden is shifted along its axis.


_NEARER_MM = 25.0  # of an object in front of an animal's edge
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
        _NEARER_MM,
        _REACH_PX,
        out,
    )
    return out


@kernel(nogil=True)
def _share_behind(heights, origin, step, depths, nearer_mm, reach_px, out, start, stop):
    """Fill out (n,) with the share of the edges of each height map (n, S, S) behind an object."""
    for i in range(start, stop):
        size = heights.shape[1]
        n_edges = n_behind = 0
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
    ) -> "OcclusionCorrection":
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
        """The `_visible_part` (n, 5) of each animal, with its area over the usual one.

        Its joints (n, J, 3) mm are in the camera frame.
        """
        camera = self.scene.camera
        ends = camera.project(joints[:, [0, self.skeleton.tip]])
        out = np.zeros((len(ends), 5))
        # an object nearer by this much is in front of the animal
        before = 2.0 * float(np.sqrt(self.scene.area_mm2))
        in_parallel(
            _visible_part,
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
def _visible_part(heights, origin, step, distance, depths, ends, before, out, start, stop):
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
        n = covered = 0
        aside = middle = 0.0
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
