"""Depth images of a session with scene and skeleton over them, as SVG: contact sheet, whole image.

An image is a PNG of a few pixels inside an SVG, so that the skeleton stays sharp. Drawn lengths are
in units of the SVG's viewBox.
"""

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from typing import Any

import cv2
import numpy as np
from matplotlib import colormaps

from liex_lab.actions.vocabulary import action_colours
from liex_lab.arrays import Array, NDArray
from liex_lab.errors import SessionError
from liex_lab.scene.scene import Fixture
from liex_lab.sessions import Session

from ..figures.animals import read_cutout
from ..figures.places import hidden_places, in_image
from ..video.film import Relief, scale_mm

MARKS = {  # kind: its words, colour, and dashes in widths of the line
    "region": ("region outside of which nothing is analysed", "#fff", "1 2.5"),
    "outline": ("walls that were found", "#fff", ""),
    "fixture": ("fixture, with its height", "#ffd24a", ""),
    "hidden": ("where an animal hid, and when", "#ff8ad4", ""),
    "beside": ("another animal in view", "#ffd24a", "2 1.5"),
}


@dataclass(frozen=True)
class Mark:
    """One object of the scene to draw.

    Attributes:
        kind: region, outline, fixture, hidden or beside.
        points_px: (n, 2) corners of a closed line, or one point, px of the whole image.
        label: the label of a point.
    """

    kind: str
    points_px: Array
    label: str = ""


def scene_marks(session: Session) -> list[Mark]:
    """The scene of a session in image coordinates; objects that were not found are left out."""
    scene = session.metadata.get("scene") or {}
    region = Mark("region", np.array(scene.get("region_px") or np.empty((0, 2)), float))
    outline = Mark("outline", in_image(session, session.arena.outline_mm()))
    made = [mark for mark in (region, outline) if len(mark.points_px) >= 3]
    made += [
        Mark("fixture", in_image(session, np.array([one.centre_mm]), one.height_mm), str(one))
        for one in map(Fixture.from_dict, scene.get("fixtures") or [])
    ]
    hidden = hidden_places(session)
    # the 24 longest ones
    longest = np.argsort(hidden[:, 2] - hidden[:, 3], kind="stable")[:24]
    made += [
        Mark("hidden", in_image(session, np.array([[x, y]])), f"{start:.1f} to {stop:.1f} s")
        for x, y, start, stop in hidden[np.sort(longest)]
    ]
    return [mark for mark in made if len(mark.points_px)]


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
    for mark in marks:
        # SVG counts from the image's corner, we count from a pixel's centre
        points = mark.points_px - [left, top] + 0.5
        if (points.max(axis=0) < 0).any() or (points.min(axis=0) > [width, height]).any():
            continue
        words, colour, dashes = MARKS[mark.kind]
        of = " ".join(f"{0.8 * unit * float(part):.2f}" for part in dashes.split())
        dashed = f' stroke-dasharray="{of}"' if of else ""
        name, path = _shape(mark.kind, points, 1.8 * unit)
        parts.append(
            f'<{name} {path} fill="none" stroke="#000" stroke-opacity="0.5" '
            f'stroke-width="{1.8 * unit:.2f}"/>'
            f'<{name} {path} class="{mark.kind}" fill="none" stroke="{colour}" '
            f'stroke-width="{0.8 * unit:.2f}"{dashed}>'
            f"<title>{escape(f'{words} {mark.label}'.strip())}</title></{name}>"
        )
        if mark.label and lettered:
            # the size of the letters and the offset of the label, in units
            size, offset = (6.0, (16.0, 2.0)) if mark.kind == "beside" else (4.0, (2.4, -1.2))
            x, y = points[0] + unit * np.array(offset)
            parts.append(
                f'<text x="{x:.1f}" y="{y:.1f}" font-size="{size * unit:.2f}" fill="{colour}" '
                f'font-family="sans-serif" stroke="#000" stroke-width="{0.9 * unit:.2f}" '
                f'paint-order="stroke">{escape(mark.label)}</text>'
            )
    return "".join(parts)


def _shape(kind: str, points: Array, r: float) -> tuple[str, str]:
    """The SVG element of a mark and its attributes; `r` is half the size of a point's mark."""
    if len(points) > 1:
        return "polygon", f'points="{" ".join(f"{x:.1f},{y:.1f}" for x, y in points)}"'
    x, y = points[0]
    if kind == "beside":
        return "circle", f'cx="{x:.1f}" cy="{y:.1f}" r="{7 * r:.1f}"'
    if kind == "fixture":
        return "path", f'd="M{x - r:.1f} {y:.1f}H{x + r:.1f}M{x:.1f} {y - r:.1f}V{y + r:.1f}"'
    d = 2 * r
    cross = f"M{x - r:.1f} {y - r:.1f}l{d:.1f} {d:.1f}m0 {-d:.1f}l{-d:.1f} {d:.1f}"
    return "path", f'd="{cross}"'


def image_svg(
    rgb: NDArray[np.uint8],
    uv: Array,
    bones: Sequence[Sequence[int]],
    left: int,
    top: int,
    marks: Sequence[Mark] = (),
    unit: float | None = None,
    lettered: bool = False,
) -> str:
    """A crop of a depth image, with the scene and the skeleton over it.

    Args:
        rgb: (h, w, 3) uint8 RGB, the depth in colours, see `Relief.image`.
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
    # SVG counts from the image's corner, we count from a pixel's centre
    points = uv - [left, top] + 0.5
    bone_px = np.median([np.hypot(*(points[a] - points[b])) for a, b in bones] or [w])
    usual = w / 70.0
    r = float(np.clip(0.4 * bone_px, w / 200.0, usual)) if unit is None else unit
    # 320 px per side is twice the widest display
    share = min(320 / max(h, w), 1.0)
    small = np.asarray(
        cv2.resize(rgb, (round(share * w), round(share * h)), interpolation=cv2.INTER_AREA),
        np.uint8,
    )
    parts = [f'<image href="{png_uri(small)}" width="{w}" height="{h}"/>']
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
    far = (float(np.percentile(depth[read], 95.0)) if read.any() else 0.0) + 3.0
    rgb = colormaps["viridis"](np.clip((far - depth) / reach_mm, 0.0, 1.0), bytes=True)[..., :3]
    # grey
    return np.asarray(np.where(read[..., None], rgb, 90), np.uint8)


def png(rgb: NDArray[np.uint8], fast: bool = False) -> bytes:
    """An image (h, w, 3) uint8 RGB as PNG; `fast` compresses less.

    Raises:
        SessionError: it cannot be encoded.
    """
    done, encoded = cv2.imencode(
        ".png",
        np.ascontiguousarray(rgb[..., ::-1]),
        [cv2.IMWRITE_PNG_COMPRESSION, 1] if fast else [],
    )
    if not done:
        raise SessionError("the image cannot be encoded as PNG")
    return bytes(encoded)


def png_uri(rgb: NDArray[np.uint8]) -> str:
    """An image (h, w, 3) uint8 RGB as the data URI of a PNG."""
    return "data:image/png;base64," + base64.b64encode(png(rgb)).decode()


def thumbnails(session: Session) -> list[tuple[str, str, str, str]]:
    """The contact sheet: the session's thumbnails with scene and skeleton, in order of time.

    Returns:
        (SVG, time, the ethogram's action at that time or an empty text, its colour) of each.
    """
    marks = scene_marks(session)
    colours = action_colours(list(session.metadata.get("actions", {})))
    bouts = session.bouts
    made = []
    for svg, time_s in _drawn(session, session.metadata.get("thumbnails", []), marks):
        here = (bouts["start_s"] <= time_s + 1e-6) & (bouts["stop_s"] > time_s + 1e-6)
        word = next(iter(bouts.loc[here, "action"].astype(str)), "")
        made.append((svg, f"{time_s:.2f} s", word, colours.get(word, "")))
    return made


def whole_image(session: Session) -> tuple[str, str] | None:
    """The whole depth image with another animal in view that is not tracked.

    Returns:
        SVG, and its time; None if the session has none.
    """
    entry = session.metadata.get("whole_picture")
    if not entry:
        return None
    marks = [
        *scene_marks(session),
        Mark("beside", np.array([entry["beside_px"]], float), "not measured"),
    ]
    drawn = _drawn(session, [entry], marks, unit=session.camera.width / 250.0, lettered=True)
    return next(((svg, f"{time_s:.2f} s") for svg, time_s in drawn), None)


def _drawn(
    session: Session, entries: Sequence[dict[str, Any]], marks: Sequence[Mark], **style: Any
) -> list[tuple[str, float]]:
    """Kept depth images as SVG with their times, s; images that cannot be read are left out."""
    if not entries:
        return []
    index = [entry["frame_index"] for entry in entries]
    poses = session.table("poses", ["frame_index", "u_px", "v_px"], index)
    time_s = session.frames.set_index("frame_index")["time_s"]
    bones = session.metadata["animal"]["bones"]
    relief = Relief(session, scale_mm([session]))  # as in the session's video
    made = []
    for k, entry in zip(index, entries, strict=True):
        cut, whole = read_cutout(session, entry)
        if cut is not None and whole is not None:
            left, top = int(entry["left_px"]), int(entry["top_px"])
            rgb = relief.image(whole, left, top, cut.shape[::-1], cut.shape[::-1])
            uv = poses.loc[poses["frame_index"] == k, ["u_px", "v_px"]].to_numpy(float)
            made.append((image_svg(rgb, uv, bones, left, top, marks, **style), float(time_s[k])))
    return made
