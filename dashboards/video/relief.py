"""Depth as height above the floor, in colours on one scale in millimetres with slight shading.

    height(u, v) = n . x(u, v) + d,    x = depth * ((u - cx) / fx, (v - cy) / fy, 1)

n is the arena's vertical in the camera frame and d the camera's height, so the floor of a tilted
camera is level as well. Shading is Lambert's, with light from the upper left.
"""

from collections.abc import Sequence

import cv2
import numpy as np
from matplotlib import colormaps
from numpy.typing import NDArray

from liex_lab.sessions import Session

from ..figures.animals import Array, paste

_UNREAD = 34  # grey of unread pixels
_WALLS_FROM = 1.6  # of the scale: higher pixels are not the animal
_SMOOTH_PX = 1.0
_PLAIN = 128  # neutral light
_WALL_MM = 8.0  # beyond the outline: its uncertainty
_STRENGTH = 0.3
_LIGHT = np.array([-0.5, -0.6])


class Relief:
    """The colours of a session's depth images.

    Args:
        session: its camera and floor are used.
        top_mm: height of the lightest colour, mm.
    """

    def __init__(self, session: Session, top_mm: float) -> None:
        camera = session.camera
        up = np.asarray(session.T_arena_camera.rotation, float)[2]
        u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
        rays = (u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy
        self._per_mm = (up[0] * rays[0] + up[1] * rays[1] + up[2]).astype(np.float32)
        self._above_mm = np.float32(np.asarray(session.T_arena_camera.translation, float)[2])
        self.pixel_mm = float(self._above_mm) / camera.fx
        self.top_mm = top_mm
        self.shape = (camera.height, camera.width)
        shades = colormaps["viridis"](np.linspace(0.08, 1.0, 256))
        self._colours = (255.0 * np.asarray(shades)[:, :3]).astype(np.uint8)
        self._outside = _beyond_walls(session, np.stack([*rays, np.ones_like(rays[0])], axis=-1))

    def heights(self, depth: NDArray[np.uint16]) -> NDArray[np.float32]:
        """(H, W) heights above the floor, mm, of depth (H, W) uint16 mm; NaN where unread (0)."""
        heights = depth.astype(np.float32) * self._per_mm + self._above_mm
        heights[depth == 0] = np.nan
        return heights

    def image(
        self,
        depth: NDArray[np.uint16],
        left: int,
        top: int,
        side: tuple[int, int],
        size: tuple[int, int],
    ) -> NDArray[np.uint8]:
        """A part of a depth image in colours, enlarged smoothly.

        Args:
            depth: (H, W) uint16 mm, 0 where unread.
            left: first column of the part, px; may be outside the image.
            top: its first row, px.
            side: width and height of the part, px.
            size: width and height of the result, px.

        Returns:
            (height, width, 3) uint8 RGB.
        """
        heights = _part(self.heights(depth), left, top, side)
        read = np.isfinite(heights)
        # unread pixels are floor while they are enlarged, and painted over afterwards
        clipped = np.clip(np.where(read, heights, 0.0), -10.0, 3.0 * self.top_mm)
        even = cv2.GaussianBlur(clipped.astype(np.float32), (0, 0), _SMOOTH_PX)
        smooth = cv2.resize(even, size, interpolation=cv2.INTER_CUBIC)
        share = np.clip(255.0 / self.top_mm * smooth, 0.0, 255.0).astype(np.uint8)
        colours = cv2.LUT(cv2.merge([share] * 3), self._colours[None])
        slope_y, slope_x = np.gradient(np.asarray(even, np.float32), self.pixel_mm)
        slope = 1.0 + _STRENGTH * (_LIGHT[0] * slope_x + _LIGHT[1] * slope_y)
        light = (_PLAIN * np.clip(slope, 0.6, 1.4)).astype(np.uint8)
        light = cv2.resize(light, size, interpolation=cv2.INTER_LINEAR)
        colours = cv2.multiply(colours, cv2.merge([light] * 3), scale=1.0 / _PLAIN)
        outside = _part(self._outside, left, top, side) > 0.5
        # walls are dimmed; an animal that rears at a wall remains visible in front of it
        dim = _enlarged(outside | (clipped > _WALLS_FROM * self.top_mm), size)
        colours[dim] = colours[dim] // 4
        colours[_enlarged(~read, size)] = _UNREAD
        return np.asarray(colours, np.uint8)

    def scale(self, height: int) -> NDArray[np.uint8]:
        """The colours from 0 to `top_mm`, the highest on top: (height, 6, 3) uint8 RGB."""
        at = np.linspace(255.0, 0.0, height).astype(np.uint8)
        return np.repeat(self._colours[at][:, None], 6, axis=1)


def scale_mm(sessions: Sequence[Session]) -> float:
    """The common height scale of some sessions, mm.

    A tenth more than the joints' heights, so that the surface above them has colours.
    """
    reached = [
        1.1 * float(session.table("poses", ["z_mm"])["z_mm"].quantile(0.995))
        for session in sessions
    ]
    known = [height for height in reached if np.isfinite(height)]
    return max(10.0 * float(np.ceil(max(known) / 10.0)), 20.0) if known else 80.0


def _part(
    heights: NDArray[np.float32], left: int, top: int, side: tuple[int, int]
) -> NDArray[np.float32]:
    """A part of a map, NaN outside the map."""
    out = np.full(side[::-1], np.nan, np.float32)
    paste(out, heights, -left, -top)
    return out


def _beyond_walls(session: Session, rays: Array) -> NDArray[np.float32]:
    """(H, W) 1 where a view ray (H, W, 3) meets the floor's plane outside the arena, else 0."""
    T = session.T_arena_camera
    turned = rays @ np.asarray(T.rotation, float).T
    place = np.asarray(T.translation, float)
    with np.errstate(divide="ignore", invalid="ignore"):
        on_floor = place[:2] - turned[..., :2] / turned[..., 2:] * place[2]
    distance = session.arena.wall_distance_mm(on_floor)
    return np.asarray(distance < -_WALL_MM, np.float32)


def _enlarged(mask: NDArray[np.bool_], size: tuple[int, int]) -> NDArray[np.bool_]:
    """A mask in another size, with smooth edges."""
    large = cv2.resize(mask.astype(np.uint8) * 255, size, interpolation=cv2.INTER_LINEAR)
    return np.asarray(large > 127)
