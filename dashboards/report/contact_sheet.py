"""The report's contact sheet: depth pictures with scene and skeleton over them, as SVG.

A picture is a PNG of a few pixels inside an SVG, so that the skeleton stays sharp. Lengths on the
paper are in units of the SVG's viewBox.
"""

from __future__ import annotations

import base64
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from .scene_marks import Mark, svg_marks

Array = NDArray[np.float64]

_MOST_PX = 320  # to a side: twice what the widest page shows
_VIRIDIS = np.array(
    [
        [68, 1, 84],
        [71, 44, 122],
        [59, 81, 139],
        [44, 113, 142],
        [33, 144, 141],
        [39, 173, 129],
        [92, 200, 99],
        [170, 220, 50],
        [253, 231, 37],
    ],
    float,
)


def picture(
    rgb: NDArray[np.uint8],
    uv: Array,
    bones: Sequence[tuple[int, int]],
    left: int,
    top: int,
    marks: Sequence[Mark] = (),
    unit: float | None = None,
    lettered: bool = False,
) -> str:
    """A depth picture cut out of a frame, with the scene and the skeleton over it.

    Args:
        rgb: (h, w, 3) uint8 RGB, the depth in colours, see `Relief.picture`.
        uv: (J, 2) joints, px of the whole frame, counted from the centre of its first pixel.
        bones: pairs of joints.
        left: column of the frame at which the picture begins, px.
        top: row of the frame at which the picture begins, px.
        marks: what stands still, as far as it is in the picture.
        unit: radius of a joint, px; None takes that of a picture around the animal, smaller where
            joints are close to each other.
        lettered: whether is written what a mark says.
    """
    h, w = rgb.shape[:2]
    points = (
        uv - [left, top] + 0.5
    )  # the paper counts from the corner of the picture, we from a pixel's centre
    bone_px = np.median([np.hypot(*(points[a] - points[b])) for a, b in bones] or [w])
    usual = w / 70.0
    r = float(np.clip(0.4 * bone_px, w / 200.0, usual)) if unit is None else unit
    parts = [f'<image href="{png_uri(_small(rgb))}" width="{w}" height="{h}"/>']
    parts.append(svg_marks(marks, left, top, w, h, 0.9 * (unit or usual), lettered))
    for colour, width in (("#222", 1.3 * r), ("#fff", 0.8 * r)):  # seen on light and dark surfaces
        for a, b in bones:
            (x0, y0), (x1, y1) = points[a], points[b]
            parts.append(
                f'<line x1="{x0:.1f}" y1="{y0:.1f}" x2="{x1:.1f}" y2="{y1:.1f}" stroke="{colour}" '
                f'stroke-width="{width:.2f}"/>'
            )
    for k, (x, y) in enumerate(points):
        fill = "#fff" if k < len(points) - 1 else "#EE6677"
        parts.append(
            f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{r:.2f}" fill="{fill}" stroke="#222" '
            f'stroke-width="{0.25 * r:.2f}"/>'
        )
    return f'<svg viewBox="0 0 {w:g} {h:g}" role="img">{"".join(parts)}</svg>'


def shade(depth: NDArray[np.uint16], reach_mm: float) -> NDArray[np.uint8]:
    """Colours (h, w, 3) RGB uint8 of a depth picture: far dark, near light, unread grey (viridis).

    Args:
        depth: (h, w) uint16 mm, 0 where unread; the floor is taken at its 95 % quantile.
        reach_mm: how much nearer than the floor is the lightest colour, mm.
    """
    read = depth > 0
    if not read.any():
        return np.full((*depth.shape, 3), 90, np.uint8)
    far = float(np.percentile(depth[read], 95.0)) + 3.0
    share = np.clip((far - depth) / reach_mm, 0.0, 1.0)
    at = share * (len(_VIRIDIS) - 1)
    low = np.minimum(at.astype(int), len(_VIRIDIS) - 2)
    rgb = _VIRIDIS[low] + (at - low)[..., None] * (_VIRIDIS[low + 1] - _VIRIDIS[low])
    rgb[~read] = 90.0
    return rgb.astype(np.uint8)


def _small(rgb: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """A picture (h, w, 3) with at most so many pixels to a side as a page shows of it, averaged."""
    import cv2

    height, width, _ = rgb.shape
    share = _MOST_PX / max(height, width)
    if share >= 1.0:
        return rgb
    size = (round(share * width), round(share * height))
    return np.asarray(cv2.resize(rgb, size, interpolation=cv2.INTER_AREA), np.uint8)


def png_uri(rgb: NDArray[np.uint8]) -> str:
    """A picture as a data URI of a PNG.

    Args:
        rgb: (h, w, 3) uint8 RGB.
    """
    import cv2

    _, encoded = cv2.imencode(".png", np.ascontiguousarray(rgb[..., ::-1]))
    return "data:image/png;base64," + base64.b64encode(encoded.tobytes()).decode()
