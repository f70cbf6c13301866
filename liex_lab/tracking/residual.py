"""Analysis-by-synthesis residual: the rendered body of a pose against the observed depth.

r = median over the pixels that both cover of |z_rendered - z_observed|, with a default body of the
skeleton whose girth is found once per recording by a grid search from 0.75 to 1.35. The readings
are those of the height maps, taken back to depth: z = (1 - h / d) / (a u + b v + c), with h the
height, d the camera's distance and a u + b v + c the inverse depth of the plane.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from liex_lab.body.pose import Pose
from liex_lab.body.surface import Surface, render_meshes
from liex_lab.foreground.height_maps import CROP, HeightMaps
from liex_lab.foreground.segmenter import Segmenter
from liex_lab.geometry import SE3
from liex_lab.runtime.shapes import check_shapes

Array = NDArray[np.float64]

_GIRTHS = np.linspace(0.75, 1.35, 13)  # of the default body at the animal's size
_MIN_OVERLAP_PX = 20


@dataclass(frozen=True)
class BodyResidual:
    """The default body of a skeleton, fattened or thinned by `girth`, held against depth.

    Attributes:
        surface: the body's surface.
        girth: factor on the default girth at the animal's size.
        camera_view: how the height maps were cut, see `BackgroundSubtraction.extract`.
    """

    surface: Surface
    girth: float = 1.0
    camera_view: bool = False

    def of(self, pose_arena: Pose, crops: HeightMaps, scene: Segmenter) -> Array:
        """Median absolute difference between body and reading over the pixels that both cover.

        Args:
            pose_arena: (n) poses, arena frame.
            crops: their n height maps.
            scene: the segmenter that cut them.

        Returns:
            (n,) mm; NaN where fewer than 20 pixels are covered by both.
        """
        n = len(pose_arena.scale)
        check_shapes("poses", ("heights", crops.heights, (n, CROP, CROP)))
        if n == 0:
            return np.zeros(0)
        rendered = render_crops(self.surface, pose_arena, self.girth, crops, scene)
        out = np.empty(n)
        planes = scene.planes(crops, self.camera_view)
        _compare(rendered, crops.heights, crops.origin, crops.step, planes, crops.distance, out)
        return out

    @staticmethod
    def fit(
        surface: Surface,
        pose_arena: Pose,
        crops: HeightMaps,
        scene: Segmenter,
        camera_view: bool = False,
    ) -> BodyResidual:
        """The girth with which the default body explains these frames best: 13 are tried.

        Args:
            surface: the body's surface.
            pose_arena: (n) poses, arena frame.
            crops: their n height maps.
            scene: the segmenter that cut them.
            camera_view: how the height maps were cut, see `BackgroundSubtraction.extract`.

        Returns:
            The body whose median residual over the frames is least; the default girth where no
            frame shows enough of any body.
        """
        placed = pose_arena.placed(surface.skeleton)
        best = BodyResidual(surface, camera_view=camera_view)
        least = np.inf
        for girth in _GIRTHS:
            body = BodyResidual(surface, float(girth), camera_view)
            off = body.of(placed, crops, scene)
            cost = float(np.median(off[np.isfinite(off)])) if np.isfinite(off).any() else np.inf
            if cost < least:
                best = body
                least = cost
        return best


def render_crops(
    surface: Surface, pose_arena: Pose, girth: float, crops: HeightMaps, scene: Segmenter
) -> NDArray[np.float32]:
    """The body's depth on the pixels of the height maps, by rasterising its mesh.

    Args:
        surface: the body's surface.
        pose_arena: (n) poses, arena frame.
        girth: factor on the default girth at the animal's size.
        crops: the n height maps whose pixels are rendered.
        scene: the segmenter that cut them, for its camera and floor.

    Returns:
        (n, CROP, CROP) float32 mm, 0 where the body is not.
    """
    camera = scene.camera
    n = len(pose_arena.scale)
    vertices = surface.vertices(pose_arena, girth=girth * pose_arena.scale)
    # a crop of every second pixel is the picture of a camera of half the resolution
    step = crops.step.astype(float)
    scaled = np.stack(
        [camera.fx / step, camera.fy / step, camera.cx / step, camera.cy / step], axis=1
    )
    T = scene.floor.T_arena_camera.inverse()
    T_camera_arena = SE3(
        np.broadcast_to(T.rotation, (n, 3, 3)).copy(), np.broadcast_to(T.translation, (n, 3)).copy()
    )
    origin = crops.origin / step[:, None]
    return render_meshes(vertices, surface.faces, T_camera_arena, scaled, origin, (CROP, CROP))


@njit(cache=True, parallel=True)
def _compare(rendered, heights, origin, step, planes, distance, out):
    """Median |rendered - observed| depth, mm, over pixels where both are, into out (n,)."""
    for i in prange(rendered.shape[0]):
        size = rendered.shape[1]
        plane = planes[i]
        offset = np.empty(size * size)
        n = 0
        for r in range(size):
            v = origin[i, 1] + step[i] * r
            for c in range(size):
                if rendered[i, r, c] > 0 and heights[i, r, c] > 0:
                    u = origin[i, 0] + step[i] * c
                    observed = (1.0 - heights[i, r, c] / 16.0 / distance[i]) / (
                        plane[0] * u + plane[1] * v + plane[2]
                    )
                    offset[n] = abs(rendered[i, r, c] - observed)
                    n += 1
        out[i] = np.median(offset[:n]) if n >= _MIN_OVERLAP_PX else np.nan
