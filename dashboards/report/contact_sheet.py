"""The report's contact sheet: depth images with scene and skeleton over them, as SVG.

An image is a PNG of a few pixels inside an SVG, so that the skeleton stays sharp. Drawn lengths are
in units of the SVG's viewBox.
"""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

import numpy as np
from numpy.typing import NDArray

from liex_lab.scene.scene import Fixture
from liex_lab.sessions import Session

Array = NDArray[np.float64]
_MOST_HIDDEN = 24  # hiding positions to mark, the longest first
REGION = "region"
OUTLINE = "outline"
FIXTURE = "fixture"
HIDDEN = "hidden"
BESIDE = "beside"
WORDS = {
    REGION: "region outside of which nothing is looked at",
    OUTLINE: "walls that were found",
    FIXTURE: "fixture, with its height",
    HIDDEN: "where an animal hid, and when",
    BESIDE: "another animal in view",
}
# colour and dashes (in widths of the line) of each
_LOOKS = {
    REGION: ("#fff", "1 2.5"),
    OUTLINE: ("#fff", ""),
    FIXTURE: ("#ffd24a", ""),
    HIDDEN: ("#ff8ad4", ""),
    BESIDE: ("#ffd24a", "2 1.5"),
}


# offset of a label from its point, in line widths
_BESIDE_IT = {BESIDE: (16.0, 2.0)}


@dataclass(frozen=True)
class Mark:
    """One object of the scene to draw.

    Attributes:
        kind: region, outline, fixture, hidden or beside.
        points_px: (n, 2) corners of a closed line, or one point, px of the whole image.
        said: the label of a point.
    """

    kind: str
    points_px: Array
    said: str = ""


def scene_marks(session: Session) -> list[Mark]:
    """The scene of a session in image coordinates; objects that were not found are left out."""
    scene = session.metadata.get("scene") or {}
    made = [Mark(REGION, np.array(scene.get("region_px") or np.empty((0, 2)), float))]
    made.append(Mark(OUTLINE, _in_picture(session, session.arena.outline_mm())))
    for fixture in map(Fixture.from_dict, scene.get("fixtures") or []):
        place = _in_picture(session, np.array([fixture.centre_mm]), fixture.height_mm)
        made.append(Mark(FIXTURE, place, str(fixture)))
    gaps = session.gaps
    if "x_mm" not in gaps:  # of earlier versions
        gaps = gaps.assign(x_mm=np.nan, y_mm=np.nan)
    hidden = gaps[(gaps["reason"] == "hidden") & gaps["x_mm"].notna()]
    columns = hidden[["x_mm", "y_mm", "start_s", "stop_s"]].to_numpy(float)
    longest = np.argsort(columns[:, 2] - columns[:, 3], kind="stable")[:_MOST_HIDDEN]
    for x, y, start, stop in columns[np.sort(longest)]:
        place = _in_picture(session, np.array([[x, y]]))
        made.append(Mark(HIDDEN, place, f"{start:.1f} to {stop:.1f} s"))
    least = {REGION: 3, OUTLINE: 3, FIXTURE: 1, HIDDEN: 1}
    return [one for one in made if len(one.points_px) >= least[one.kind]]


def _in_picture(session: Session, xy_mm: Array, height_mm: float = 0.0) -> Array:
    """Positions (n, 2) mm above the floor -> (n, 2) px; empty if any is behind the camera."""
    if not len(xy_mm):
        return np.empty((0, 2))
    place = np.column_stack([xy_mm, np.full(len(xy_mm), height_mm)])
    seen = session.camera.project(session.T_arena_camera.inverse() @ place)
    return seen if np.isfinite(seen).all() else np.empty((0, 2))


def svg_marks(
    marks: Sequence[Mark],
    left: float,
    top: float,
    width: float,
    height: float,
    unit: float,
    lettered: bool = True,
) -> str:
    """Marks as SVG over a part of the image.

    Args:
        marks: the marks; those outside the part are left out.
        left: first column of the part, px.
        top: its first row, px.
        width: of the part, px.
        height: of the part, px.
        unit: length of the drawing, px; lines are 0.8 units wide and letters 4 units high.
        lettered: whether to write a mark's label; its tooltip is always included.
    """
    parts = []
    for one in marks:
        # SVG counts from the image's corner, we count from a pixel's centre
        points = one.points_px - [left, top] + 0.5
        if (points.max(axis=0) < 0).any() or (points.min(axis=0) > [width, height]).any():
            continue
        colour, dashes = _LOOKS[one.kind]
        of = " ".join(f"{0.8 * unit * float(part):.2f}" for part in dashes.split())
        dashed = f' stroke-dasharray="{of}"' if of else ""
        name, path = _shape(one.kind, points, 1.8 * unit)
        told = escape(f"{WORDS[one.kind]} {one.said}".strip())
        parts.append(
            f'<{name} {path} fill="none" stroke="#000" stroke-opacity="0.5" '
            f'stroke-width="{1.8 * unit:.2f}"/>'
            f'<{name} {path} class="{one.kind}" fill="none" stroke="{colour}" '
            f'stroke-width="{0.8 * unit:.2f}"{dashed}><title>{told}</title></{name}>'
        )
        if one.said and lettered:
            x, y = points[0] + unit * np.array(_BESIDE_IT.get(one.kind, (2.4, -1.2)))
            size = (6.0 if one.kind == BESIDE else 4.0) * unit
            parts.append(
                f'<text x="{x:.1f}" y="{y:.1f}" font-size="{size:.2f}" fill="{colour}" '
                f'font-family="sans-serif" stroke="#000" stroke-width="{0.9 * unit:.2f}" '
                f'paint-order="stroke">{escape(one.said)}</text>'
            )
    return "".join(parts)


def _shape(kind: str, points: Array, reach: float) -> tuple[str, str]:
    """The SVG element of a mark and its attributes."""
    if len(points) > 1:
        return "polygon", f'points="{" ".join(f"{x:.1f},{y:.1f}" for x, y in points)}"'
    (x, y), r = points[0], reach
    if kind == BESIDE:
        return "circle", f'cx="{x:.1f}" cy="{y:.1f}" r="{7 * r:.1f}"'
    if kind == FIXTURE:
        return "path", f'd="M{x - r:.1f} {y:.1f}H{x + r:.1f}M{x:.1f} {y - r:.1f}V{y + r:.1f}"'
    way = (
        f"M{x - r:.1f} {y - r:.1f}l{2 * r:.1f} {2 * r:.1f}m0 {-2 * r:.1f}l{-2 * r:.1f} {2 * r:.1f}"
    )
    return "path", f'd="{way}"'


_MOST_PX = 320  # per side: twice the widest display
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
    """A crop of a depth image, with the scene and the skeleton over it.

    Args:
        rgb: (h, w, 3) uint8 RGB, the depth in colours, see `Relief.picture`.
        uv: (J, 2) joints, px of the whole frame, counted from the centre of its first pixel.
        bones: pairs of joints.
        left: the crop's first column, px of the frame.
        top: the crop's first row, px of the frame.
        marks: objects of the scene; those outside the crop are left out.
        unit: radius of a joint, px; None takes that of a crop around the animal, smaller if joints
            are close to each other.
        lettered: whether to write the labels of marks.
    """
    h, w = rgb.shape[:2]
    points = (
        uv - [left, top] + 0.5
    )  # SVG counts from the image's corner, we count from a pixel's centre
    bone_px = np.median([np.hypot(*(points[a] - points[b])) for a, b in bones] or [w])
    usual = w / 70.0
    r = float(np.clip(0.4 * bone_px, w / 200.0, usual)) if unit is None else unit
    parts = [f'<image href="{png_uri(_small(rgb))}" width="{w}" height="{h}"/>']
    parts.append(svg_marks(marks, left, top, w, h, 0.9 * (unit or usual), lettered))
    for colour, width in (("#222", 1.3 * r), ("#fff", 0.8 * r)):  # for light and dark surfaces
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
    """Colours (h, w, 3) RGB uint8 of a depth image: far dark, near light, unread grey (viridis).

    Args:
        depth: (h, w) uint16 mm, 0 where unread; the floor is its 95 % quantile.
        reach_mm: height above the floor of the lightest colour, mm.
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
    """An image (h, w, 3) reduced by averaging to at most `_MOST_PX` per side."""
    import cv2

    height, width, _ = rgb.shape
    share = _MOST_PX / max(height, width)
    if share >= 1.0:
        return rgb
    size = (round(share * width), round(share * height))
    return np.asarray(cv2.resize(rgb, size, interpolation=cv2.INTER_AREA), np.uint8)


def png_uri(rgb: NDArray[np.uint8]) -> str:
    """An image (h, w, 3) uint8 RGB as the data URI of a PNG."""
    import cv2

    _, encoded = cv2.imencode(".png", np.ascontiguousarray(rgb[..., ::-1]))
    return "data:image/png;base64," + base64.b64encode(encoded.tobytes()).decode()
