"""Depth images with the scene over them: as many pixels as a page shows, in the video's colours,
and every mark where the camera sees its object.
"""

import base64
import json
import re
from pathlib import Path
from xml.etree import ElementTree

import cv2
import numpy as np
import pandas as pd
import pytest
from liex_lab.dashboards.app.server import scene_svg
from liex_lab.dashboards.figures.animals import read_cutout
from liex_lab.dashboards.report.contact_sheet import (
    Mark,
    image_svg,
    scene_marks,
    thumbnails,
    whole_image,
)
from liex_lab.dashboards.video.film import Relief, scale_mm

from liex_lab.sessions import Session
from tests.dashboards.conftest import HOUSE
from tests.sessions.walking_mouse import FLOOR_MM, SMALL

JOINTS = np.array([[20.0, 30.0], [40.0, 30.0]])
REGION = ((10.0, 8.0), (100.0, 9.0), (95.0, 70.0))


def embedded(svg: str) -> np.ndarray:
    """The image (h, w, 3) inside of an SVG."""
    found = re.search(r'base64,([^"]+)"', svg)
    assert found is not None
    packed = np.frombuffer(base64.b64decode(found[1]), np.uint8)
    return np.asarray(cv2.imdecode(packed, cv2.IMREAD_COLOR))


@pytest.mark.parametrize(("size", "kept"), [((60, 60), (60, 60)), ((800, 400), (320, 160))])
def test_a_large_image_is_averaged_and_a_small_one_stays_as_it_is(
    size: tuple[int, int], kept: tuple[int, int]
) -> None:
    rgb = np.full((*size, 3), 70, np.uint8)
    rgb[: size[0] // 2] += 30
    svg = image_svg(rgb, JOINTS, [(0, 1)], 0, 0)
    pixels = embedded(svg)
    assert pixels.shape[:2] == kept
    assert f'viewBox="0 0 {size[1]} {size[0]}"' in svg  # joints lie where they lay
    high, low = pixels[: kept[0] // 2], pixels[kept[0] // 2 :]
    assert (high == high[0, 0]).all()
    assert (low == low[0, 0]).all()
    assert (high[0, 0] != low[0, 0]).any()


def test_the_thumbnails_of_a_report_are_the_relief_of_the_video(walker: Session) -> None:
    """The same colours as a frame of the video has there, whichever way the camera looks."""
    entry = walker.metadata["thumbnails"][0]
    top_mm = scale_mm([walker])
    kept, whole = read_cutout(walker, entry)
    assert kept is not None
    assert whole is not None
    side = kept.shape[::-1]
    left, top = entry["left_px"], entry["top_px"]
    svg, *_ = thumbnails(walker)[0]
    drawn = Relief(walker, top_mm).image(whole, left, top, side, side)
    np.testing.assert_array_equal(embedded(svg)[..., ::-1], drawn)
    assert f"to {top_mm:.0f} mm (light)" in (walker.path / "report.html").read_text("utf-8")


@pytest.fixture
def session(own: Session) -> Session:
    """A session with a region, in which the animal hid from 5 s on, and another one is in view."""
    own.metadata["scene"]["region_px"] = REGION
    depth = np.full((SMALL.height, SMALL.width), round(FLOOR_MM), np.uint16)
    file = str(Path(own.metadata["thumbnails"][0]["file"]).with_name("whole.png"))
    cv2.imwrite(str(own.path / file), depth)
    entry = {"frame_index": 30, "file": file, "left_px": 0, "top_px": 0}
    entry |= {"width_px": SMALL.width, "height_px": SMALL.height}
    own.metadata["whole_picture"] = entry | {"beside_px": [70.0, 20.0]}
    (own.path / "session.json").write_text(json.dumps(own.metadata))
    gaps = pd.read_parquet(own.path / "gaps.parquet")
    row = gaps.iloc[:1].assign(reason="hidden", x_mm=30.0, y_mm=-20.0, start_s=5.0, stop_s=5.5)
    pd.concat([gaps, row]).to_parquet(own.path / "gaps.parquet")
    return Session.open(own.path)


def by_hand(x_mm: float, y_mm: float, height_mm: float) -> list[float]:
    """The pixel of a place: the camera looks down, x to the right, y up the image."""
    depth = FLOOR_MM - height_mm
    return [SMALL.cx + SMALL.fx * x_mm / depth, SMALL.cy - SMALL.fy * y_mm / depth]


def test_every_mark_lies_where_the_camera_sees_it(session: Session) -> None:
    marks = {mark.kind: mark for mark in scene_marks(session)}
    assert list(marks) == ["region", "outline", "fixture", "hidden"]
    np.testing.assert_array_equal(marks["region"].points_px, REGION)
    fixture = by_hand(*HOUSE.centre_mm, HOUSE.height_mm)
    np.testing.assert_allclose(marks["fixture"].points_px, [fixture])
    assert (marks["fixture"].label, marks["hidden"].label) == ("62 mm", "5.0 to 5.5 s")
    away = np.hypot(*(marks["outline"].points_px - [SMALL.cx, SMALL.cy]).T)
    np.testing.assert_allclose(away, SMALL.fx * 220.0 / FLOOR_MM)
    np.testing.assert_allclose(marks["hidden"].points_px, [by_hand(30.0, -20.0, 0.0)])


def test_the_contact_sheet_the_whole_image_and_the_scene_show_the_marks(session: Session) -> None:
    sheet = "".join(svg for svg, *_ in thumbnails(session))
    assert all(f'class="{kind}"' in sheet for kind in ("outline", "fixture", "hidden"))
    whole = whole_image(session)
    assert whole is not None
    assert whole[1] == "1.00 s"
    assert 'class="beside"' in whole[0]
    assert ">not measured</text>" in whole[0]
    drawn = scene_svg(session, np.full((80, 107), 700, np.uint16))
    ElementTree.fromstring(drawn)
    assert all(f'class="{mark.kind}"' in drawn for mark in scene_marks(session))


def test_a_cut_out_has_its_skeleton_and_the_marks_within_it() -> None:
    rgb = np.full((20, 20, 3), 70, np.uint8)
    marks = [
        Mark("fixture", np.array([[104.0, 55.0]]), "<b>"),
        Mark("hidden", np.array([[90.0, 55.0]])),
    ]
    uv = np.array([[104.0, 55.0], [110.0, 60.0]])
    svg = image_svg(rgb, uv, [(0, 1)], left=100, top=50, marks=marks)
    assert 'x1="4.5" y1="5.5" x2="10.5" y2="10.5"' in svg
    assert 'class="hidden"' not in svg
    assert "M4.0 5.5H5.0M4.5 5.0V6.0" in svg
    assert "<b>" not in svg
