"""The scene over depth pictures: every mark lies where the camera sees what it is of."""

from __future__ import annotations

from xml.etree import ElementTree

import numpy as np
import pytest
from liex_lab.dashboards.app.page_region import scene_svg
from liex_lab.dashboards.report.charts import pictures
from liex_lab.dashboards.report.contact_sheet import Mark, picture, scene_marks

from liex_lab.scene.floor import Floor
from liex_lab.scene.scene import Arena, Fixture, Scene
from liex_lab.sessions import Session
from tests.sessions import walking_mouse
from tests.sessions.walking_mouse import FLOOR_MM, SMALL, WalkingMouse, steady, write

LEVEL = Floor.from_plane(np.array([0.0, 0.0, 1.0]), FLOOR_MM, SMALL)
HOUSE = Fixture((120.0, -40.0), 62.0, 9000.0)
REGION = ((10.0, 8.0), (100.0, 9.0), (95.0, 70.0))


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Session:
    scene = Scene(LEVEL, region_px=REGION, fixtures=(HOUSE,))
    mouse = WalkingMouse(steady(2.0), lost=tuple(range(30, 40)))
    forget = walking_mouse.forget
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(walking_mouse, "forget", lambda track, rows: forget(track, rows, "hidden"))
        bowl = Arena("round", (0.0, 0.0), 220.0)
        return write(tmp_path_factory.mktemp("marks") / "a.liex", mouse, arena=bowl, scene=scene)


def test_every_mark_lies_where_the_camera_sees_it(session: Session) -> None:
    marks = {mark.kind: mark for mark in scene_marks(session)}
    assert list(marks) == ["region", "outline", "fixture", "hidden"]
    np.testing.assert_array_equal(marks["region"].points_px, REGION)
    depth = FLOOR_MM - HOUSE.height_mm  # the camera looks down: x to the right, y up the picture
    x, y = HOUSE.centre_mm
    by_hand = [SMALL.cx + SMALL.fx * x / depth, SMALL.cy - SMALL.fy * y / depth]
    np.testing.assert_allclose(marks["fixture"].points_px, [by_hand])
    assert marks["fixture"].said == "62 mm"
    away = np.hypot(*(marks["outline"].points_px - [SMALL.cx, SMALL.cy]).T)
    np.testing.assert_allclose(away, SMALL.fx * 220.0 / FLOOR_MM)
    joints = session.table("poses", ["frame_index", "u_px", "v_px"])
    before = joints[joints["frame_index"] == 29][["u_px", "v_px"]].to_numpy(float)
    assert np.hypot(*(before.mean(axis=0) - marks["hidden"].points_px[0])) < 5.0


def test_the_contact_sheet_and_the_scene_show_the_marks(session: Session) -> None:
    sheet = "".join(svg for svg, *_ in pictures(session))
    assert all(f'class="{kind}"' in sheet for kind in ("outline", "fixture", "hidden"))
    drawn = scene_svg(session, np.full((80, 107), 700, np.uint16))
    ElementTree.fromstring(drawn)
    assert all(f'class="{mark.kind}"' in drawn for mark in scene_marks(session))


def test_a_mark_outside_of_a_cut_out_is_not_in_it_and_one_within_is_in_its_place() -> None:
    depth, uv = np.full((20, 20, 3), 70, np.uint8), np.full((2, 2), 105.0)
    marks = [
        Mark("fixture", np.array([[104.0, 55.0]]), "<b>"),
        Mark("hidden", np.array([[90.0, 55.0]])),
    ]
    svg = picture(depth, uv, [(0, 1)], left=100, top=50, marks=marks)
    assert 'class="hidden"' not in svg
    assert "M4.0 5.5H5.0M4.5 5.0V6.0" in svg
    assert "<b>" not in svg
