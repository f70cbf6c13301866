"""A region drawn over the depth picture in a real browser, and the plan that then states it."""

import numpy as np
import pytest
from playwright.sync_api import Page, expect

from liex_lab.cli.options import region_setting
from liex_lab.plan import Plan
from liex_lab.scene.zones import read_zones
from liex_lab.sessions import Session
from tests.dashboards.conftest import KEY, Watched
from tests.dashboards.served import Served
from tests.sessions.walking_mouse import SMALL

CORNERS = [(12.0, 10.0), (92.0, 8.0), (95.0, 70.0), (9.0, 66.0)]


@pytest.fixture
def served(own: Session) -> Served:
    return Served(own.path.parent)


def opened(served: Served, page: Page) -> None:
    page.goto(f"{served.address}/arena/{KEY}")
    page.wait_for_selector("#region.is-open")
    page.locator(".region-stage").scroll_into_view_if_needed()


def on_screen(page: Page, u: float, v: float) -> tuple[float, float]:
    """Where a pixel's centre is: the picture is fitted into its box, so by its own size alone."""
    box = page.locator(".region-stage").bounding_box()
    assert box is not None
    scale = min(box["width"] / SMALL.width, box["height"] / SMALL.height)
    left = box["x"] + (box["width"] - scale * SMALL.width) / 2
    top = box["y"] + (box["height"] - scale * SMALL.height) / 2
    return left + (u + 0.5) * scale, top + (v + 0.5) * scale


def click(page: Page, u: float, v: float) -> None:
    page.mouse.click(*on_screen(page, u, v))


def corners(page: Page) -> list[list[float]]:
    text = page.locator("#region-corners").input_value()
    return [[float(value) for value in one.split(",")] for one in text.split()]


def test_a_region_is_drawn_by_clicks_and_keys_over_the_scene_and_saved_as_a_run_takes_it(
    served: Served, watched: Watched
) -> None:
    page = watched.page
    page.goto(f"{served.address}/session/{KEY}")
    scene = page.locator("img.scene")
    scene.scroll_into_view_if_needed()
    expect(scene).to_have_js_property("naturalWidth", SMALL.width)
    page.get_by_role("link", name="Draw the region of the arena").click()
    page.wait_for_selector("#region.is-open .scene-line")
    page.locator(".region-stage").scroll_into_view_if_needed()
    save = page.get_by_role("button", name="Save into the plan")
    expect(save).to_be_disabled()
    drawn_by_keys(page)
    page.locator("#region-corners").fill("10,10 90,60 90,10 10,60")
    save.focus()
    save.click()
    expect(page.locator(".region-message.is-wrong")).to_contain_text("sides 1 and 3 of its polygon")
    assert_saved_by_nobody_else(served, page)
    assert len(watched.complaints) == 1  # the browser's own, of an answer 400
    watched.complaints.clear()
    page.get_by_role("button", name="Clear").click()
    for corner in CORNERS:
        click(page, *corner)
    np.testing.assert_allclose(corners(page), CORNERS, atol=0.3)
    click(page, 50.0, 40.0)
    page.keyboard.press("u")
    click(page, *CORNERS[0])  # on the first corner: closed
    expect(save).to_be_enabled()
    page.mouse.move(*on_screen(page, *CORNERS[1]))
    page.mouse.down()
    page.mouse.move(*on_screen(page, 80.0, 15.0), steps=4)
    page.mouse.up()
    drawn = [CORNERS[0], (80.0, 15.0), *CORNERS[2:]]
    np.testing.assert_allclose(corners(page), drawn, atol=0.3)
    click(page, 52.0, 68.0)  # on the lowest side: a corner more
    assert len(corners(page)) == 5
    page.keyboard.press("Delete")
    np.testing.assert_allclose(corners(page), drawn, atol=0.3)
    line = page.locator("#region-command").inner_text()
    save.click()
    expect(page.locator(".region-message")).to_contain_text("walker.plan.toml states this region")
    file = served.study / "walker.plan.toml"
    region = Plan.load(file).arena.region
    assert region is not None
    np.testing.assert_allclose(np.array(region.polygon), drawn, atol=0.3)
    told = " ".join(f"{u:g},{v:g}" for u, v in region.polygon or ())
    assert line.endswith(f"--region '{told}'")
    opened(served, page)  # what the plan states is there again
    assert corners(page) == region.polygon
    taken = Plan.load("mouse").with_settings(region_setting(line.split("'")[1])).arena.region
    assert taken is not None
    assert taken.polygon == region.polygon  # liex doctor takes what the page says
    watched.nothing_went_wrong()


def drawn_by_keys(page: Page) -> None:
    page.locator(".region-stage").focus()
    for keys in (["Shift+ArrowLeft"] * 3, ["Shift+ArrowRight"] * 6, ["Shift+ArrowDown"] * 2):
        for key in (*keys, "Enter"):
            page.keyboard.press(key)
    page.keyboard.press("c")
    assert corners(page) == [[23.0, 40.0], [83.0, 40.0], [83.0, 60.0]]
    page.keyboard.press("n")
    page.keyboard.press("ArrowUp")
    assert corners(page)[0] == [23.0, 39.0]


def assert_saved_by_nobody_else(served: Served, page: Page) -> None:
    """Neither without the page's own request nor by a form of another site."""
    address = f"{served.address}/region/{KEY}/save"
    form = page.request.post(address, form={"place": "beside"})
    assert (form.status, form.json()["message"]) == (400, "no region is saved here")
    asked = {"place": "beside", "corners": CORNERS, "was": None}
    foreign = {"Origin": "http://elsewhere.example"}
    assert page.request.post(address, data=asked, headers=foreign).status == 403
    assert not (served.study / "walker.plan.toml").exists()


def test_a_zone_is_drawn_named_and_saved_as_a_run_takes_it(
    served: Served, watched: Watched
) -> None:
    page = watched.page
    opened(served, page)
    drawn_by_keys(page)
    page.locator("#zone-name").fill("nest")
    page.locator("#zone-part").select_option("nose")
    page.get_by_role("button", name="Save as a zone").click()
    expect(page.locator(".region-message")).to_contain_text("walker.zones.toml holds the zone nest")
    expect(page.locator(".zone-line")).to_have_count(1)
    file = Plan.load(served.study / "walker.plan.toml").arena.zones
    (zone,) = read_zones(str(file))
    assert (zone.name, zone.part, zone.unit) == ("nest", "nose", "px")
    page.locator("#zones").get_by_role("button", name="take out").click()
    expect(page.locator(".region-message")).to_contain_text("no longer holds the zone nest")
    expect(page.locator(".zone-line")).to_have_count(0)
    watched.nothing_went_wrong()
