"""A picture of the contact sheet holds as many pixels as a page shows of it."""

from __future__ import annotations

import base64
import re
from pathlib import Path

import cv2
import numpy as np
import pytest
from liex_lab.dashboards.report.charts import pictures
from liex_lab.dashboards.report.contact_sheet import picture
from liex_lab.dashboards.report.report import render
from liex_lab.dashboards.video.relief import Relief, put_back, scale_mm

from tests.sessions.walking_mouse import WalkingMouse, steady, write

JOINTS = np.array([[20.0, 30.0], [40.0, 30.0]])


def embedded(svg: str) -> np.ndarray:
    """The picture (h, w, 3) inside of an SVG."""
    found = re.search(r'base64,([^"]+)"', svg)
    assert found is not None
    packed = np.frombuffer(base64.b64decode(found[1]), np.uint8)
    return np.asarray(cv2.imdecode(packed, cv2.IMREAD_COLOR))


@pytest.mark.parametrize(("size", "kept"), [((60, 60), (60, 60)), ((800, 400), (320, 160))])
def test_a_large_picture_is_averaged_and_a_small_one_stays_as_it_is(
    size: tuple[int, int], kept: tuple[int, int]
) -> None:
    rgb = np.full((*size, 3), 70, np.uint8)
    rgb[: size[0] // 2] += 30
    svg = picture(rgb, JOINTS, [(0, 1)], 0, 0)
    pixels = embedded(svg)
    assert pixels.shape[:2] == kept
    assert f'viewBox="0 0 {size[1]} {size[0]}"' in svg  # joints lie where they lay
    high, low = pixels[: kept[0] // 2], pixels[kept[0] // 2 :]
    assert (high == high[0, 0]).all()
    assert (low == low[0, 0]).all()
    assert (high[0, 0] != low[0, 0]).any()


def test_the_pictures_of_a_report_are_the_relief_of_the_video(tmp_path: Path) -> None:
    """The same colours as a frame of the video has there, whichever way the camera looks."""
    session = write(tmp_path / "m.liex", WalkingMouse(steady(2.0)))
    entry = session.metadata["thumbnails"][0]
    relief = Relief(session, scale_mm([session]))
    kept = np.asarray(cv2.imread(str(session.path / entry["file"]), cv2.IMREAD_UNCHANGED))
    left, top = entry["left_px"], entry["top_px"]
    whole = put_back(np.asarray(kept, np.uint16), left, top, relief.shape)
    side = (kept.shape[1], kept.shape[0])
    svg, *_ = pictures(session)[0]
    np.testing.assert_array_equal(
        embedded(svg)[..., ::-1], relief.picture(whole, left, top, side, side)
    )
    assert f"to {scale_mm([session]):.0f} mm (light)" in render(session)
