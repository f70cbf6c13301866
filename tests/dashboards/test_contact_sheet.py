"""A picture of the contact sheet holds as many pixels as a page shows of it."""

from __future__ import annotations

import base64
import re

import cv2
import numpy as np
import pytest
from liex_lab.dashboards.report.contact_sheet import picture

JOINTS = np.array([[20.0, 30.0], [40.0, 30.0]])


def embedded(svg: str) -> np.ndarray:
    """The picture (h, w, 3) inside of an SVG."""
    found = re.search(r'base64,([^"]+)"', svg)
    assert found is not None
    return cv2.imdecode(np.frombuffer(base64.b64decode(found[1]), np.uint8), cv2.IMREAD_COLOR)


@pytest.mark.parametrize(("size", "kept"), [((60, 60), (60, 60)), ((800, 400), (320, 160))])
def test_a_large_picture_is_averaged_and_a_small_one_stays_as_it_is(
    size: tuple[int, int], kept: tuple[int, int]
) -> None:
    depth = np.full(size, 700, np.uint16)
    depth[: size[0] // 2] -= 30
    svg = picture(depth, JOINTS, [(0, 1)], 0, 0, 60.0)
    pixels = embedded(svg)
    assert pixels.shape[:2] == kept
    assert f'viewBox="0 0 {size[1]} {size[0]}"' in svg  # joints lie where they lay
    high, low = pixels[: kept[0] // 2], pixels[kept[0] // 2 :]
    assert (high == high[0, 0]).all()
    assert (low == low[0, 0]).all()
    assert (high[0, 0] != low[0, 0]).any()
