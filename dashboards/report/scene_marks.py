"""What stands still before the camera, as marks over its depth pictures: region, outline, fixtures,
and where an animal hid.

Places on the floor are carried into the picture by the pinhole projection; what lies behind the
camera has no mark.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

import numpy as np
from numpy.typing import NDArray

from liex_lab.scene.scene import Fixture
from liex_lab.sessions import Session

Array = NDArray[np.float64]
_MOST_HIDDEN = 24  # places that are marked: the longest times
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


# from a place to the words about it, in widths of the line
_BESIDE_IT = {BESIDE: (16.0, 2.0)}


@dataclass(frozen=True)
class Mark:
    """One thing of the scene, as it is drawn.

    Attributes:
        kind: region, outline, fixture, hidden or beside.
        points_px: (n, 2) corners of a closed line, or the one place, px of the whole picture.
        said: what is written beside a place.
    """

    kind: str
    points_px: Array
    said: str = ""


def scene_marks(session: Session) -> list[Mark]:
    """The scene of a session in its pictures; none of what was not found.

    Args:
        session: the opened session.
    """
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
    """Places (n, 2) mm above the floor -> (n, 2) px; empty where one lies behind the camera."""
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
    """Marks as SVG over a part of the picture.

    Args:
        marks: what is drawn; what lies outside of the part is left out.
        left: first column of the part, px.
        top: its first row, px.
        width: of the part, px.
        height: of the part, px.
        unit: length on the paper, px, of which lines are 0.8 wide and letters 4 high.
        lettered: whether is written what a mark says; else a pointer that rests on it is told.
    """
    parts = []
    for one in marks:
        # the paper counts from the corner of the picture, we from a pixel's centre
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
    """SVG's word for the shape of a mark, and what it needs to be drawn."""
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
